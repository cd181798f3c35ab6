"""The target as it is: how its dots deviate from a perfect flat grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.io.report.plot.axes import COLOURS, axes_of, nothing_to_draw
from telerig.short_text import nice_below, number

__all__ = ["target"]

_MOST_LABELS = 40
_MOST_SHAPES = 1500


@dataclass(frozen=True)
class TargetShape:
    """Dots against the best perfect target.

    place_mm : (N, 2) where the best target has them.
    off_um, sd_um : (N, 3) estimated minus best; sd 0 where it is not known.
    in_plane : False when only flatness is known.
    """

    place_mm: Array
    off_um: Array
    sd_um: Array
    in_plane: bool


def target_shape(
    points_mm: Array, row_column: Array, covariance_mm2: Array | None = None
) -> TargetShape | None:
    """Return deviations from an affinely fitted nominal target; None for under five dots.

    points_mm : (N, 3) in the target's frame. row_column : (N, 2) of each dot, NaN where it is not
    known; it gives the nominal places, up to the pitch that the fit finds. covariance_mm2 : (3, N,
    N) of the coordinates x, y, z.
    """
    known = np.isfinite(row_column).all(axis=1)
    in_plane = (
        bool(known.all()) and len(points_mm) > 4 and bool(np.ptp(row_column, axis=0).min() > 0)
    )
    design = np.c_[row_column if in_plane else points_mm[:, :2], np.ones(len(points_mm))]
    if len(points_mm) < 5 or np.linalg.matrix_rank(design) < 3:
        return None
    basis, _ = np.linalg.qr(design)
    best = basis @ (basis.T @ points_mm)
    sd = np.zeros(points_mm.shape)
    for axis, covariance in enumerate(() if covariance_mm2 is None else covariance_mm2):
        shared = basis.T @ covariance  # the fitted part's share is taken out
        variance = np.diag(covariance) - 2 * np.sum(basis * shared.T, axis=1)
        variance = variance + np.sum((basis @ (shared @ basis)) * basis, axis=1)
        sd[:, axis] = np.sqrt(np.maximum(variance, 0))
    return TargetShape(best[:, :2], 1e3 * (points_mm - best), 1e3 * sd, in_plane)


def target(
    points_mm: Array,
    row_column: Array,
    covariance_mm2: Array | None = None,
    *,
    heights: bool = False,
    axes: Any = None,
) -> Any:
    """Draw how the dots of a target lie off a perfect, evenly stretched, flat grid; returns axes.

    As arrows in its plane, with rings of one standard deviation, or with ``heights`` as colours.
    Arguments are those of `target_shape`. Raises InputError for too few dots, and for the plane of
    a target whose rows and columns are not known.
    """
    shape = target_shape(points_mm, row_column, covariance_mm2)
    if shape is None or not (heights or shape.in_plane):
        raise nothing_to_draw("it takes five dots, and in the plane their rows and columns")
    margin = 0.1 * np.ptp(shape.place_mm, axis=0).max()
    low, high = shape.place_mm.min(axis=0) - margin, shape.place_mm.max(axis=0) + margin
    axes = axes_of(axes, xlabel="x on the target / mm", ylabel="y / mm", aspect="equal")
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]))
    (_heights if heights else _in_plane)(axes, shape)
    return axes


def _in_plane(axes: Any, shape: TargetShape) -> None:
    from matplotlib.collections import EllipseCollection

    off, sd = shape.off_um[:, :2], shape.sd_um[:, :2]
    extent = np.ptp(shape.place_mm, axis=0).max()
    typical = max(float(np.quantile(np.hypot(*off.T), 0.9)), 1e-9)
    per_um = nice_below(0.08 * extent / typical * 1e3) / 1e3
    quiver = axes.quiver(
        *shape.place_mm.T, *(off * per_um).T, angles="xy", scale_units="xy", scale=1,
        color=COLOURS[0], width=0.005,
    )  # fmt: skip
    if sd.any() and len(sd) <= _MOST_SHAPES:
        tip, (wide, high) = shape.place_mm + off * per_um, 2 * sd.T * per_um
        rings = EllipseCollection(
            wide, high, np.zeros(len(sd)), units="xy", offsets=tip, linewidths=0.8,
            offset_transform=axes.transData, facecolors="none", edgecolors=COLOURS[1],
        )  # fmt: skip
        axes.add_collection(rings)
    key = nice_below(1.5 * typical)
    axes.set_title(" ", fontsize=8)  # room for the key
    axes.quiverkey(quiver, 0.5, 1.05, key * per_um, f"{number(key, 1)} µm", labelpos="E")


def _heights(axes: Any, shape: TargetShape) -> None:
    height = shape.off_um[:, 2]
    limit = max(float(np.abs(height).max()), 1e-9)
    dots = axes.scatter(
        *shape.place_mm.T, c=height, s=np.clip(9000 / len(height), 12, 320), cmap="RdBu_r",
        vmin=-limit, vmax=limit, edgecolors="#555555", linewidths=0.4,
    )  # fmt: skip
    if len(height) <= _MOST_LABELS:
        for place, z in zip(shape.place_mm, height):
            shade = "white" if abs(z) > 0.65 * limit else "black"
            words = {"ha": "center", "va": "center", "fontsize": 7, "color": shade}
            axes.text(*place, f"{round(z):d}", **words)
    axes.figure.colorbar(dots, ax=axes, label="height / µm", orientation="horizontal")
