"""Checks the sensors and the tracks of a run before it is smoothed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.errors import InputError, suggestion
from telerig.estimator.sensors.accelerometer_checks import (
    check_accelerometer,
    check_axes,
    check_motion,
)
from telerig.estimator.sensors.encoder_checks import check_encoder

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.io.dataset.run import RunData


_COVERED = 0.999
_FOREIGN_PX = 5.0
_DIFFERENT_PX = 0.5
_SAMPLED = 2000


def check_sensors(
    run: RunData, *, tracks: Any = None, calibration: Calibration | None = None
) -> list[str]:
    """Return warnings about a run's encoder and accelerometers, and about its tracks if they are
    given.

    tracks : `Tracks`, or a table like tracks.csv, which is compared with ``calibration``.

    Raises InputError for data that cannot be used: clocks that do not overlap, an encoder that
    jumps during the frames, accelerometers in another unit or without gravity, sensors that
    rig.toml does not name, and tracks from another rig.
    """
    words = []
    if run.stage is not None:
        where = f"{run.name}/stage.csv"
        t, position = run.stage[["t_s", "position_mm"]].to_numpy(float).T
        words += _check_overlap(t, run.t_s, where=where)
        words += check_encoder(t, position, run.t_s, where=where)
    if run.accelerometers is not None:
        words += _check_accelerometers(run)
    if tracks is not None and calibration is not None:
        words += check_tracks(getattr(tracks, "table", tracks), calibration)
    return words


def _check_overlap(t: Array, frames_t_s: ArrayLike, *, where: str) -> list[str]:
    """Return a warning if the record does not cover all frames.

    t, frames_t_s : (N,) times of the record and (F,) times of the frames, in s.

    Raises InputError if the record covers no frame. The error names the offset or the unit that
    would explain this.
    """
    frames = np.asarray(frames_t_s, float)
    share = float(((frames >= t[0]) & (frames <= t[-1])).mean())
    spans = f"{t[0]:.6g} to {t[-1]:.6g} s, the frames {frames[0]:.6g} to {frames[-1]:.6g} s"
    if share == 0:
        raise InputError(
            f"the record's clock does not overlap the frames': it covers {spans}",
            where=where,
            todo=_clock_remedy(t, frames),
        )
    if share < _COVERED:
        return [f"{where}: the record covers {100 * share:.0f} % of the frames ({spans})"]
    return []


def _clock_remedy(t: Array, frames: Array) -> str:
    """Return the unit or the offset that would make the record's clock agree with that of the
    frames.
    """
    length, wanted = t[-1] - t[0], frames[-1] - frames[0]
    for name, factor in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        near = t[0] / factor <= frames[-1] and t[-1] / factor >= frames[0]
        if near and wanted > 0 and 0.5 < length / factor / wanted < 5:
            return f"its times look like {name}: divide them by {factor:g}"
    offset = frames[0] - t[0]
    return f"put both on one clock; if both started together, add {offset:.6g} s to its times"


def _check_accelerometers(run: RunData) -> list[str]:
    """Return the warnings of all checks for each accelerometer of the run."""
    table, words = run.accelerometers, []
    assert table is not None
    file = f"{run.name}/accelerometer.csv"
    described = {} if run.rig is None else dict(run.rig.accelerometers)
    stage = None if run.rig is None else run.rig.stage
    for sensor, rows in table.groupby("sensor", sort=False):
        name = str(sensor)
        where = f"{file}, sensor {name}"
        if run.rig is not None and name not in described:
            raise InputError(
                f"there is no accelerometer {name!r} in rig.toml",
                where=file,
                todo=suggestion(name, list(described))
                if described
                else f"add a table [accelerometers.{name}]",
            )
        t = rows["t_s"].to_numpy(float)
        reading = rows[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy(float)
        words += _check_overlap(t, run.t_s, where=where)
        words += check_accelerometer(t, reading, where=where)
        if stage is None:
            continue
        axes = np.asarray(described[name].axes, float)
        tilted = check_axes(reading, axes, stage.up, where=where)
        words += tilted
        if not tilted and run.stage is not None:
            encoder = run.stage[["t_s", "position_mm"]].to_numpy(float)
            words += check_motion(t, reading, encoder, axes @ np.asarray(stage.axis), where=where)
    return words


def check_tracks(table: Any, calibration: Calibration) -> list[str]:
    """Return a warning if points and pixels of a table of tracks do not agree with this
    calibration.

    The pixels are triangulated again, and the old and the new points are projected. There is a
    warning if they differ by more than 0.5 px (median). Raises InputError if they differ by more
    than 5 px, or if a camera is missing from the table.
    """
    for camera in calibration.cameras:
        if f"{camera.name}_u_px" not in table:
            there = sorted({c[: -len("_u_px")] for c in table.columns if str(c).endswith("_u_px")})
            raise InputError(
                f"the tracks have no pixels of camera {camera.name!r}",
                where="tracks",
                todo=f"they have {', '.join(there) or 'none'}: track with this calibration",
            )
    if len(calibration.cameras) != 2 or not len(table):
        return []
    off = _off_px(table, calibration)
    if off < _DIFFERENT_PX:
        return []
    what = f"points and pixels of the tracks disagree by {off:.3g} px (median)"
    if off > _FOREIGN_PX:
        raise InputError(
            f"{what}: they were made with another calibration",
            where="tracks",
            todo="run `telerig track` with this calibration, or give the one they were made with",
        )
    return [f"{what}: they were made with another calibration; only the pixels are used"]


def _off_px(table: Any, calibration: Calibration) -> float:
    """Return the median distance in px between the tracks' points and points from their pixels."""
    some = np.unique(np.linspace(0, len(table) - 1, min(len(table), _SAMPLED)).astype(int))
    rows = table.iloc[some]
    points = rows[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    uv = []
    for camera in calibration.cameras:
        pixels = rows[[f"{camera.name}_u_px", f"{camera.name}_v_px"]].to_numpy(float)
        shift = [f"{camera.name}_du_px", f"{camera.name}_dv_px"]
        if all(c in rows for c in shift):
            pixels = pixels + np.nan_to_num(rows[shift].to_numpy(float))
        uv.append(pixels)
    good = np.isfinite(points).all(1) & np.isfinite(np.hstack(uv)).all(1)
    if not good.any():
        return 0.0
    again = calibration.triangulate(uv[0][good], uv[1][good], include_calibration=False).points_mm
    distance = [
        np.linalg.norm(c.project(again) - c.project(points[good]), axis=-1)
        for c in calibration.cameras
    ]
    return float(np.median(np.max(distance, axis=0)))
