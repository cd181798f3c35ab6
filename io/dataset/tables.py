"""Read the CSV tables of a dataset and of a run, and check them against rig, frames and cameras.

Every error names the file, the row (the header is row 1), the column, and what to do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from telerig.arrays import Bools, Ints
from telerig.errors import InputError, suggestion
from telerig.io.files.csv_table import Column, read_part, read_table, rows_of
from telerig.io.files.frame_table import FrameTable
from telerig.io.files.toml import read_toml
from telerig.io.rig_file.description import RigDescription
from telerig.io.rig_file.target import FARTHEST
from telerig.io.tables.calibration import DOTS
from telerig.io.tables.run import ACCELEROMETER, DETECTIONS, FRAMES, REFERENCES, STAGE
from telerig.io.tables.table import EDGE_COVARIANCE, OF_PIXELS, PIXEL, PIXEL_COVARIANCE
from telerig.rig.target import Target
from telerig.short_text import counted

AnySource = TypeVar("AnySource", bound=str)

DEFAULT_SIGMA_PX = 0.02
"""Standard deviation (px) of a dot's centre that is assumed where the table does not state one."""

OUTSIDE_PX = 3.0
"""A centre may lie at most this far (px) outside the image, for example after cropping."""

DOTS_COLUMNS = ["view", "camera", "dot", "row", "column", *PIXEL, *PIXEL_COVARIANCE]


def choose_source(
    has: Mapping[AnySource, bool], source: str | None, folder: Path
) -> AnySource | None:
    """Return whether images or a table of measurements are used; None if there is neither.

    has : whether the folder has "images", and whether it has the table ("dots" or "detections").
    source : the one that the user asked for; None takes the only one that there is.
    Raises InputError for another word, and if there are both and the user chose none.
    """
    first, second = has
    if source is not None and source not in has:
        todo = f'give "{first}" or "{second}" (--from)'
        raise InputError(f"source is {source!r}", where=str(folder), todo=todo)
    found = [s for s in has if has[s] and source in (None, s)]
    if len(found) > 1:
        raise InputError(
            f"holds measurements in two forms, {first} and {second}.csv",
            where=str(folder),
            todo=f"choose with --from {first} or --from {second}",
        )
    return found[0] if found else None


def read_dots_csv(path: str | PathLike[str], rig: RigDescription) -> pd.DataFrame:
    """Read a CSV table of detected dots: `calibration/dots.csv` or `results/calibration/dots.csv`.

    Returns one row per dot with the columns `DOTS_COLUMNS`: view and camera (text), dot (its number
    on `rig.target`), row, column, the centre u_px, v_px, its covariance suu_px2, suv_px2, svv_px2;
    and chi2_dof and the edge's part of the covariance (`EDGE_COVARIANCE`) if the file has them. The
    covariance is computed by `fill_covariance`, from `DEFAULT_SIGMA_PX` where the file states none;
    ``attrs["sigma_known"]`` is True when it does.
    On an unbounded target the numbers are computed from row and column, which the file must have.
    Raises InputError, with row and column, for impossible values and a dot twice in one image.
    """
    file = Path(path)
    table = read_table(file, _columns(rig.target))
    check_cameras(table, list(rig.cameras), file)
    check_pixels(table, {name: c.image_size_px for name, c in rig.cameras.items()}, file)
    if rig.target.bounded:
        _check_dots(table, rig.target, file)
    else:
        # Row and column give the ids of `Target`, in place of the file's opaque ones.
        todo = f"rows and columns count from the origin mark, within +-{FARTHEST}"
        for column in ("row", "column"):
            far = table[column].abs().to_numpy() > FARTHEST
            rows_of(table, file).refuse(far, column, "is too far from the origin mark", todo)
        table["dot"] = rig.target.id_from_row_column(table["row"], table["column"])
    _check_repeats(table, rig.target, file)
    known = fill_covariance(table, file, DEFAULT_SIGMA_PX, of="the dot's centre")
    columns = DOTS_COLUMNS + [name for name in ("chi2_dof", *EDGE_COVARIANCE) if name in table]
    dots = table[columns].reset_index(drop=True)
    dots.attrs["sigma_known"] = known
    return dots


def _columns(target: Target) -> list[Column]:
    """Return the columns that a dots.csv for this target may have."""
    if target.bounded:
        return DOTS.of()
    own: dict[str, dict[str, Any]] = {
        "dot": {"kind": "text", "blank": True},
        "row": {"required": True},
    }
    own["column"] = own["row"]
    return [replace(column, **own.get(column.name, {})) for column in DOTS.of()]


def check_cameras(table: pd.DataFrame, names: list[str], file: Path) -> None:
    """Raise InputError for the first row whose camera is not one of ``names``."""
    check_names(table, "camera", "camera", names, file)


def check_names(table: pd.DataFrame, column: str, thing: str, names: list[str], file: Path) -> None:
    """Raise InputError for the first row whose cell in ``column`` is not one of ``names``."""
    unknown = ~table[column].isin(names).to_numpy()
    name = str(table[column][unknown].iloc[0]) if unknown.any() else ""
    todo = suggestion(name, names) if names else f"add a table [{thing}s.{name}]"
    what = f"there is no {thing} {name!r} in rig.toml"
    rows_of(table, file).refuse(unknown, column, what, todo)


def check_pixels(table: pd.DataFrame, sizes_px: Mapping[str, tuple[int, int]], file: Path) -> None:
    """Raise InputError for the first pixel more than `OUTSIDE_PX` outside its camera's image.

    The centre of an outline with a semi-axis a_px may lie farther outside by a_px: the image's
    border cuts the outline.
    """
    sizes = np.array([sizes_px[name] for name in table["camera"]], float).reshape(-1, 2)
    reach = np.nan_to_num(table["a_px"].to_numpy(float)) if "a_px" in table else 0.0
    for column, size in zip(("u_px", "v_px"), sizes.T):
        _check_inside(table, column, size, OUTSIDE_PX + reach, file)


def _check_inside(table: pd.DataFrame, column: str, size: Any, reach: Any, file: Path) -> None:
    """Raise InputError for a pixel coordinate outside its image.

    size : (rows,) limit in px. reach : how far (px) outside a coordinate may be.
    """
    value = table[column].to_numpy()
    rows_of(table, file).refuse(
        (value < -0.5 - reach) | (value > size - 0.5 + reach),
        column,
        lambda i: f"is {value[i]:g}, outside the image of {size[i]:.0f} px",
        "correct the cell, or image_size_px = [width, height] in rig.toml",
    )


def _check_dots(table: pd.DataFrame, target: Target, file: Path) -> None:
    """Check the dots' numbers against the target; fill in or check row and column, in place."""
    dot, ids = table["dot"].to_numpy(), target.ids()
    numbers = f"its {len(ids)} dots are numbered from {ids.min()} to {ids.max()}"
    rows_of(table, file).refuse(
        ~target.known_id(dot),
        "dot",
        lambda i: f"is {dot[i]}, which the target of rig.toml does not have",
        numbers + (", missing marks left out" if target.mark_style == "missing" else ""),
    )
    for column, expected in zip(("row", "column"), target.row_column_from_id(dot)):
        if column in table:
            _check_place(table, column, expected, file)
        table[column] = expected


def _check_place(table: pd.DataFrame, column: str, expected: Any, file: Path) -> None:
    """Raise InputError for the first row whose row or column differs from ``expected`` (rows,)."""
    given, dot = table[column].to_numpy(), table["dot"].to_numpy()
    rows_of(table, file).refuse(
        given != expected,
        column,
        lambda i: f"is {given[i]}, but dot {dot[i]} lies in {column} {expected[i]}",
        "dot = row * columns + column, from 0; correct one of them, or rig.toml",
    )


def _check_repeats(table: pd.DataFrame, target: Target, file: Path) -> None:
    """Raise InputError when a dot stands twice in the same view of the same camera."""
    keys = ["view", "camera", "dot"]
    again = table.duplicated(keys).to_numpy()
    if not again.any():
        return
    this = table[again].iloc[0]
    earlier = table.index[(table[keys] == this[keys]).all(axis=1)][0]
    place = f"at row {this['row']}, column {this['column']}"
    dot = f"dot {this['dot']}" if target.bounded else f"the dot {place}"
    what = f"{dot} of view {this['view']!r}, camera {this['camera']!r} is in row {earlier} already"
    rows_of(table, file).refuse(again, "dot", what, "keep one of the two rows")


def fill_covariance(table: pd.DataFrame, file: Path, default_sigma_px: float, *, of: str) -> bool:
    """Add the columns suu_px2, suv_px2, svv_px2 (px^2) to a table in place, if it lacks them.

    They are computed from the column sigma_px, or from ``default_sigma_px`` if there is no such
    column.

    of : what the points are, for errors, for example "a dot's centre".
    Returns whether the file stated the noise. Raises InputError if only some of the columns exist,
    and for values that are no covariance.
    """
    given = [name for name in PIXEL_COVARIANCE if name in table]
    if 0 < len(given) < 3:
        missing = ", ".join(name for name in PIXEL_COVARIANCE if name not in table)
        raise InputError(
            f"has {', '.join(given)} without {missing}",
            where=f"{file} row 1",
            todo=f"give all three, {', '.join(PIXEL_COVARIANCE)}, or sigma_px alone",
        )
    if given:
        uu, uv, vv = (table[name].to_numpy() for name in PIXEL_COVARIANCE)
        rows_of(table, file).refuse(
            (uu <= 0) | (vv <= 0) | (uu * vv <= uv**2),
            "suu_px2",
            lambda i: f"[[{uu[i]:g}, {uv[i]:g}], [{uv[i]:g}, {vv[i]:g}]] is no covariance",
            "variances must be positive and suu svv > suv^2",
        )
        return True
    known = "sigma_px" in table
    sigma = table["sigma_px"].to_numpy() if known else np.full(len(table), default_sigma_px)
    rows_of(table, file).refuse(
        sigma <= 0,
        "sigma_px",
        lambda i: f"is {sigma[i]:g}, not positive",
        f"give the standard deviation of {of}, or leave the column out",
    )
    table["suu_px2"], table["suv_px2"], table["svv_px2"] = sigma**2, 0.0 * sigma, sigma**2
    return known


def assumed_noise(table: pd.DataFrame | FrameTable, name: str, sigma_px: float) -> list[str]:
    """Return the note that a table's noise is assumed; no note where its file states the noise."""
    if isinstance(table, FrameTable):
        known = "sigma_px" in table.columns or set(PIXEL_COVARIANCE) <= set(table.columns)
    else:
        known = table.attrs["sigma_known"]
    text = f"{name} states no sigma_px: its centres count as good to {sigma_px:g} px (1 sd)"
    return [] if known else [text]


Sizes = Mapping[str, tuple[int, int]]

DETECTION_SIGMA_PX = 0.5
"""Standard deviation (px) of a bubble's centre that is assumed where detections.csv states none."""

REFERENCE_SIGMA_PX = 0.1
"""Standard deviation (px) of a mark's centre that is assumed where references.csv states none."""

_RUN_KEYS = ["frame_rate_hz", "start_s"]


def read_frames_csv(path: Path, cameras: list[str]) -> pd.DataFrame:
    """Read `frames.csv`, which gives the time of every frame of a run.

    Returns one row per frame, counted from 0 without gaps, with the columns frame, t_s (the middle
    of the exposure in s) and all further ones. The optional column ``missing`` names the cameras
    that dropped the frame, joined by ``|``. The index is the row in the file.
    Raises InputError for times that do not increase, a frame without a time, and an unknown camera
    in ``missing``.
    """
    table = read_table(path, FRAMES.of(), extra=True)
    rows = rows_of(table, path)
    frame, expected = table["frame"].to_numpy(), np.arange(len(table))

    def refuse(bad: Bools, what: Callable[[int], str], todo: str) -> None:
        rows.refuse(bad, "frame", lambda i: f"is {frame[i]}{what(i)}", todo)

    again = table.duplicated("frame").to_numpy()
    rows.refuse(again, "frame", lambda i: f"{frame[i]} stands twice", "keep one of the rows")
    refuse(frame < 0, lambda i: ", before 0", "frames count from 0")
    falls = np.diff(frame, prepend=frame[0]) < 0
    refuse(falls, lambda i: f" after {frame[i - 1]}", "sort the rows by frame")
    refuse(
        frame != expected,
        lambda i: f", and no row gives the time of frame {expected[i]}",
        "add the missing row; frames count from 0",
    )
    _check_increasing(table, path, "times must increase from frame to frame")
    if "missing" in table:
        named = [cell.split("|") if cell else [] for cell in table["missing"]]
        unknown = [next((c for c in names if c not in cameras), None) for names in named]
        rows.refuse(
            np.array([name is not None for name in unknown], bool),
            "missing",
            lambda i: f"names {unknown[i]!r}, which is no camera of the rig",
            f"join names of cameras by |; known: {', '.join(cameras)}",
        )
    return table


def check_frame_count(table: pd.DataFrame, path: Path, frame_count: int, skipped: Ints) -> None:
    """Raise InputError unless `read_frames_csv` found as many frames as the images have.

    skipped : the frames among them of which no camera has an image.
    """
    frame, rows = table["frame"].to_numpy(), rows_of(table, path)
    rows.refuse(
        frame >= frame_count,
        "frame",
        lambda i: f"is {frame[i]}, but the last frame with images is {frame_count - 1}",
        "remove the row, or add the missing images",
    )
    if len(frame) == frame_count:
        return
    what = (
        f"has {counted(len(frame), 'row')}, but there are images of {frame_count} frames: "
        f"frame {len(frame)} has no time"
    )
    todo = "add the missing rows, or remove the images that do not belong to the run"
    if len(skipped):
        some = ", ".join(map(str, skipped[:8])) + (", ..." if len(skipped) > 8 else "")
        what += f"; the numbers in the images' names skip {counted(len(skipped), 'frame')} ({some})"
        todo = (
            "add a row for each of these frames, too; or, if the images follow each other "
            "without a gap, add a blank column `missing`: then their order counts"
        )
    raise InputError(what, where=f"{path} row {rows.numbers[-1]}", todo=todo)


def read_run_toml(path: Path) -> tuple[float, float]:
    """Read `run.toml`, and return the frame rate (Hz) and the time of frame 0 (s, by default 0).

    Raises InputError if the file is no TOML, has an unknown key, or has no positive frame rate.
    """
    raw = read_toml(path, "write frame_rate_hz = 500.0")
    for key in raw:
        if key not in _RUN_KEYS:
            raise InputError("unknown key", where=f"{path} {key}", todo=suggestion(key, _RUN_KEYS))
    rate = _number(raw, "frame_rate_hz", path)
    if rate is None or rate <= 0:
        what = "is missing" if rate is None else f"is {rate:g}, not positive"
        raise InputError(what, where=f"{path} frame_rate_hz", todo="write frame_rate_hz = 500.0")
    return rate, _number(raw, "start_s", path) or 0.0


def _number(raw: dict[str, Any], key: str, path: Path) -> float | None:
    """Return the finite number at ``key``, None without the key; InputError for another value."""
    value = raw.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        what = f"is {value!r}, not a finite number"
        raise InputError(what, where=f"{path} {key}", todo="write it as 500.0, without a unit")
    return float(value)


def read_stage_csv(path: Path) -> pd.DataFrame:
    """Read `stage.csv`, the encoder's record: t_s, position_mm and all further columns.

    Raises InputError for fewer than two rows and for times that do not increase.
    """
    table = read_table(path, STAGE.of(), extra=True)
    if len(table) < 2:
        raise InputError(
            "has a single row, between which nothing can be interpolated",
            where=str(path),
            todo="record the encoder during the run; a rig that stands needs no stage.csv",
        )
    _check_increasing(table, path)
    return table.reset_index(drop=True)


def read_accelerometer_csv(path: Path, sensors: list[str] | None) -> pd.DataFrame:
    """Read `accelerometer.csv`, the readings of all accelerometers of a run.

    sensors : the names of the sensors in rig.toml; None accepts any name.
    Returns the columns t_s (s), sensor (text), ax_m_s2, ay_m_s2, az_m_s2 (m/s^2 along the sensor's
    axes) and all further ones. Raises InputError for an unknown sensor and times that do not
    increase.
    """
    table = read_table(path, ACCELEROMETER.of(), extra=True)
    if sensors is not None:
        check_names(table, "sensor", "accelerometer", sensors, path)
    for _, one in table.groupby("sensor"):
        _check_increasing(one, path)
    return table.reset_index(drop=True)


_SORT = "sort the rows by time and keep one row for each time"


def _check_increasing(table: pd.DataFrame, path: Path, todo: str = _SORT) -> None:
    """Raise InputError for the first row whose t_s is not later than that of the row before."""
    t = table["t_s"].to_numpy()
    rows_of(table, path).refuse(
        np.diff(t, prepend=-np.inf) <= 0,
        "t_s",
        lambda i: f"is {t[i]:.9g} s, not later than {t[i - 1]:.9g} s in the row before",
        todo,
    )


def read_references_csv(
    path: Path, cameras: list[str], sizes_px: Sizes, frame_count: int | None
) -> pd.DataFrame:
    """Read `references.csv`, the image positions of the marks that are fixed to the tank.

    sizes_px : (width, height) of the image by camera. frame_count : of the run; None if not known.
    Returns one row per mark, frame and camera with the columns frame, camera, mark (text), u_px,
    v_px, suu_px2, suv_px2, svv_px2 and all further ones. The covariance is that of
    `fill_covariance`, from `REFERENCE_SIGMA_PX` where the file states none. Raises InputError for
    impossible values.
    """
    table = read_table(path, REFERENCES.of(), extra=True)
    _check_pixels(table, path, cameras, sizes_px, frame_count)
    _check_named_once(table, "mark", path)
    known = fill_covariance(table, path, REFERENCE_SIGMA_PX, of="the mark's place")
    return _finished(table, known)


def read_detections_csv(
    path: Path, cameras: list[str], sizes_px: Sizes, frame_count: int | None
) -> pd.DataFrame:
    """Read `detections.csv`, the bubbles that were found in the images.

    sizes_px : (width, height) of the image by camera; pixels of a camera without one are not
    checked. frame_count : of the run; None where the table decides.
    Returns one row per bubble, frame and camera, with the columns frame, camera, u_px, v_px, the
    covariance suu_px2, suv_px2, svv_px2, particle (text; "" where not yet matched) and all further
    ones; the ellipse's a_px, b_px, angle_rad may be NaN. The covariance is that of
    `fill_covariance`, from `DETECTION_SIGMA_PX` where the file states none;
    ``attrs["sigma_known"]`` is True when it does.
    Raises InputError, with the row and the column, for values that are not possible.
    """
    table = read_table(path, _DETECTIONS, extra=True)
    return _detections(table, path, cameras, sizes_px, frame_count)


def read_detections_part(
    path: Path, content: bytes, row: int, cameras: list[str], sizes_px: Sizes,
    frame_count: int | None,
) -> pd.DataFrame | None:  # fmt: skip
    """Read some rows of `detections.csv` as `read_detections_csv` reads all of them.

    content : the header and some rows as bytes. row : number of the first of these rows in the
    file. Returns None for an unusual text, as `read_part` does.
    """
    table = read_part(path, content, row, _DETECTIONS)
    if table is None:
        return None
    return _detections(table, path, cameras, sizes_px, frame_count)


_MEASURED = (*PIXEL, *(column.name for column in OF_PIXELS))
_DETECTIONS = [
    replace(column, blank=False) if column.name in _MEASURED else column
    for column in DETECTIONS.of(need=("frame", "camera", *PIXEL), ids="name")
]
"""Ids that a lab gives stay as they are; every row of an input has a place."""


def _detections(
    table: pd.DataFrame, path: Path, cameras: list[str], sizes_px: Sizes, frame_count: int | None
) -> pd.DataFrame:
    """Check rows of `detections.csv` and fill in what they lack."""
    _check_pixels(table, path, cameras, sizes_px, frame_count)
    if "particle" not in table:
        table["particle"] = ""
    _check_named_once(table, "particle", path)
    _check_axes(table, path)
    known = fill_covariance(table, path, DETECTION_SIGMA_PX, of="the bubble's centre")
    return _finished(table, known)


def _check_pixels(
    table: pd.DataFrame, path: Path, cameras: list[str], sizes_px: Sizes, frame_count: int | None
) -> None:
    """Check the cameras, pixels and frames of a table of pixels."""
    check_cameras(table, cameras, path)
    if all(name in sizes_px for name in cameras):
        check_pixels(table, sizes_px, path)
    frame = table["frame"].to_numpy()
    last = np.iinfo(np.int64).max if frame_count is None else frame_count - 1
    rows_of(table, path).refuse(
        (frame < 0) | (frame > last),
        "frame",
        lambda i: (
            f"is {frame[i]}, " + ("before 0" if frame[i] < 0 else f"but the last frame is {last}")
        ),
        "frames count from 0; correct the cell, or add the frame to frames.csv",
    )


def _check_named_once(table: pd.DataFrame, name: str, path: Path) -> None:
    """Raise InputError when a name in the column ``name`` is repeated in a frame of a camera."""
    again = table.duplicated(["frame", "camera", name]) & (table[name] != "")
    frame, camera, label = (table[key].to_numpy() for key in ("frame", "camera", name))
    rows_of(table, path).refuse(
        again.to_numpy(),
        name,
        lambda i: f"{label[i]!r} stands twice in frame {frame[i]} of camera {camera[i]}",
        "keep one of the rows, or leave the name blank where it is not known",
    )


def _check_axes(table: pd.DataFrame, path: Path) -> None:
    """Raise InputError unless a_px >= b_px (px) are positive semi-axes and angles are radians."""
    given = [name for name in ("a_px", "b_px", "angle_rad") if name in table]
    missing = [name for name in ("a_px", "b_px") if name not in given]
    if given and missing:
        raise InputError(
            f"has {', '.join(given)} without {' and '.join(missing)}",
            where=f"{path} row 1",
            todo="give a_px, b_px and angle_rad, or none of them",
        )
    if not given:
        return
    rows = rows_of(table, path)
    a, b = table["a_px"].to_numpy(), table["b_px"].to_numpy()
    rows.refuse(
        (a <= 0) | (b <= 0) | (np.isnan(a) != np.isnan(b)),
        "a_px",
        lambda i: f"{a[i]:g} with b_px {b[i]:g} is no pair of semi-axes",
        "give both positive, a_px >= b_px, or leave both blank",
    )
    rows.refuse(
        a < b,
        "a_px",
        lambda i: f"is {a[i]:g}, less than b_px = {b[i]:g}",
        "the long semi-axis comes first: swap them and turn angle_rad by pi/2",
    )
    if "angle_rad" in table:
        angle = table["angle_rad"].to_numpy()
        rows.refuse(
            np.abs(angle) > 2 * np.pi + 1e-6,
            "angle_rad",
            lambda i: f"is {angle[i]:g}, more than a whole turn in radians",
            "give radians; degrees are multiplied by pi / 180",
        )


def _finished(table: pd.DataFrame, sigma_known: bool) -> pd.DataFrame:
    """Return the table with rows counted from 0 and with ``attrs["sigma_known"]`` set."""
    table = table.reset_index(drop=True)
    table.attrs["sigma_known"] = sigma_known
    return table
