"""Pictures of a rig: residuals and coverage of its calibration, uncertainty in space, shake."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.report.plot.axes import COLOURS, axes_of, columns_of, finite
from telerig.short_text import no_formula

_RESIDUALS = "results/calibration/residuals.csv"
_LEAST_WEIGHT = 0.5
_LEVELS = 8


def residuals(
    table: pd.DataFrame, camera: str, *, magnified: float | None = None, axes: Any = None
) -> Any:
    """Draw an arrow from the predicted towards the measured place of each dot; returns axes.

    table : residuals.csv of a calibration.
    camera : its name.
    magnified : how many times as long as true the arrows are drawn; None for a twentieth of the
        image at the 90 % quantile.

    Dots that were left out are not drawn. Raises InputError for a camera without dots.
    """
    mine = _of_camera(table, camera)
    u, v, du, dv, weight = columns_of(
        mine, "u_px", "v_px", "du_px", "dv_px", "weight", made_by=_RESIDUALS
    )
    kept = weight > _LEAST_WEIGHT
    u, v, du, dv = finite(*(column[kept] for column in (u, v, du, dv)))
    typical = float(np.quantile(np.hypot(du, dv), 0.9))
    if magnified is None:
        magnified = 0.05 * float(np.ptp(u) or 1.0) / typical if typical > 0 else 1.0
        magnified = 10.0 ** np.floor(np.log10(magnified)) if magnified > 0 else 1.0
    axes = _image(axes_of(axes, title=f"{no_formula(camera)}, arrows {magnified:,g} times as long"))
    axes.quiver(u, v, magnified * du, magnified * dv, angles="xy", scale_units="xy", scale=1,
                color=COLOURS[0], width=0.003)  # fmt: skip
    return axes


def coverage(
    table: pd.DataFrame,
    camera: str,
    image_size_px: tuple[int, int] | None = None,
    *,
    axes: Any = None,
) -> Any:
    """Draw where in a camera's images dots or bubbles were measured; returns axes.

    table : residuals.csv, dots.csv or detections.csv. image_size_px : (width, height); None for
    what the points cover. Raises InputError for a camera without points.
    """
    u, v = finite(*columns_of(_of_camera(table, camera), "u_px", "v_px", made_by=_RESIDUALS))
    axes = _image(axes_of(axes, title=f"{no_formula(camera)}, {len(u)} points"))
    dots = {"markersize": 3, "alpha": 0.6, "markeredgewidth": 0, "color": COLOURS[0]}
    axes.plot(u, v, ".", **dots)
    if image_size_px is not None:
        width, height = image_size_px
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    return axes


def uncertainty(
    source: str | PathLike[str] | Mapping[str, Array],
    share: Literal["calibration", "measurement"] = "calibration",
    *,
    across: Literal["x", "y"] = "x",
    axes: Any = None,
) -> Any:
    """Draw one standard deviation of a point's position over a plane of the rig, in µm.

    It is √(sx² + sy² + sz²). source : uncertainty.npz of a calibration, or its arrays points_mm
    (N, 3), a regular grid, and <share>_mm2 (N, 3, 3). share : the calibration's, or that of the
    pixels. across : the plane is that of this axis and z, nearest to the origin; both optical axes
    are near that of x where the cameras stand side by side, and near that of y where one stands
    above the other. Returns axes. Raises InputError for a file that is not one.
    """
    arrays = source if isinstance(source, Mapping) else _npz(source)
    name = f"{share}_mm2"
    if "points_mm" not in arrays or name not in arrays:
        what = f"holds no {name}"
        raise InputError(what, where="telerig.plot.uncertainty", todo="give uncertainty.npz")
    side, z, sd_um = sd_in_plane(arrays, name, "xy".index(across))
    axes = axes_of(axes, xlabel=f"{across} / mm", ylabel="z / mm", aspect="equal")
    drawn = axes.contourf(side, z, sd_um.T, levels=_LEVELS, cmap="viridis")
    axes.figure.colorbar(drawn, ax=axes, label=f"1 sd / µm, share of the {share}")
    return axes


def sd_in_plane(arrays: Mapping[str, Array], name: str, across: int) -> tuple[Array, Array, Array]:
    """Return a grid's coordinates across (S,) and along z (Z,) in mm, and sds (S, Z) in µm.

    name : of covariances (N, 3, 3) in ``arrays``. across : 0 for x, 1 for y.
    """
    points = arrays["points_mm"]
    sd_um = 1e3 * np.sqrt(np.trace(arrays[name], axis1=-2, axis2=-1))
    flat = in_plane(points, across)
    side, z = (np.unique(points[flat, i]) for i in (across, 2))
    return side, z, sd_um[flat].reshape(len(side), len(z))


def in_plane(points_mm: Array, across: int) -> Array:
    """Return which points (N, 3) of a grid lie in the plane of ``across`` and z, (N,)."""
    level = np.abs(points_mm[:, 1 - across])
    return np.asarray(level <= level.min() + 1e-6)


def shake(
    table: pd.DataFrame, camera: str, axis: str = "y", *, y_up: bool = True, axes: Any = None
) -> Any:
    """Draw a camera's shake against time with a band of 2 standard deviations; returns axes.

    table : `Smoothing.shake` or shake.csv.
    axis : "x", "y" or "z" of the rig.
    y_up : y is drawn as height, -y, which is positive upwards.

    Raises InputError for an unknown camera or axis.
    """
    t, values = columns_of(table, "t_s", f"{camera}_{axis}_mm", made_by="Smoothing.shake")
    turned = y_up and axis == "y"
    name = "height" if turned else axis
    values = -values if turned else values
    axes = axes_of(axes, xlabel="t / s", ylabel=f"shake of {no_formula(camera)}, {name} / µm")
    if f"s{camera}_{axis}_mm" in table:
        far = 2 * table[f"s{camera}_{axis}_mm"].to_numpy(float)
        band = {"color": COLOURS[0], "alpha": 0.25, "linewidth": 0, "label": "± 2 sd"}
        axes.fill_between(t, 1e3 * (values - far), 1e3 * (values + far), **band)
    axes.plot(t, 1e3 * values, color=COLOURS[0], linewidth=1.0, label="shake")
    return axes


def _of_camera(table: pd.DataFrame, camera: str) -> pd.DataFrame:
    """Return the rows of a camera. Raises InputError if there are none."""
    if "camera" not in table:
        raise InputError(
            "the table has no column camera", where="telerig.plot", todo=f"give {_RESIDUALS}"
        )
    mine = table[table["camera"] == camera]
    if not len(mine):
        known = ", ".join(sorted(table["camera"].astype(str).unique()))
        raise InputError(
            f"there is no camera {camera!r}", where="telerig.plot", todo=f"it has {known}"
        )
    return mine


def _image(axes: Any) -> Any:
    """Set axes to an image's: u right, v down."""
    axes.set(xlabel="u / px", ylabel="v / px", aspect="equal")
    if not axes.yaxis_inverted():
        axes.invert_yaxis()
    return axes


def _npz(path: str | PathLike[str]) -> dict[str, Array]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, TypeError, BadZipFile) as error:
        what = f"cannot be read: {error}"
        raise InputError(what, where=str(path), todo="give uncertainty.npz") from error
