"""What a user should know of a run's sensors before it is smoothed, and what cannot be used."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.errors import InputError, suggestion
from telerig.estimator.sensors.accelerometer_checks import (
    clippings,
    dead_axes,
    fitting_axes,
    gravity_of,
    motion_contradicts,
    motion_correlation,
    plausible_gravity,
    tilt_deg,
    unit_of,
    without_gravity,
)
from telerig.estimator.sensors.encoder_checks import EncoderFault, encoder_faults

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.io.dataset.run_data import RunData

Array = NDArray[np.float64]

_HARMLESS_MM = 0.05
_REAL_M_S2 = 50.0
_TILTED_DEG = 20.0
_COVERED = 0.999
_FOREIGN_PX = 5.0
_DIFFERENT_PX = 0.5
_SAMPLED = 2000


def check_sensors(
    run: RunData, *, tracks: Any = None, calibration: Calibration | None = None
) -> list[str]:
    """Warnings in words about a run's encoder and accelerometers, and about tracks if given.

    tracks : `Tracks` or a table like tracks.csv, checked against ``calibration``.
    Raises InputError for what cannot be used: clocks that do not overlap, an encoder that jumps
    during the frames, accelerometers in another unit or without gravity, sensors that rig.toml
    does not name, tracks of another rig.
    """
    words = []
    if run.stage is not None:
        stage = run.stage[["t_s", "position_mm"]].to_numpy(float)
        words += check_encoder(stage[:, 0], stage[:, 1], run.t_s, where=f"{run.name}/stage.csv")
    if run.accelerometers is not None:
        words += _check_accelerometers(run)
    if tracks is not None and calibration is not None:
        words += check_tracks(getattr(tracks, "table", tracks), calibration)
    return words


def check_overlap(t_s: ArrayLike, frames_t_s: ArrayLike, *, where: str) -> list[str]:
    """A warning when the record does not cover all frames; InputError when it covers none.

    t_s (N,), frames_t_s (F,) in s. The error names the offset or the unit that would explain it.
    """
    t, frames = np.asarray(t_s, float), np.asarray(frames_t_s, float)
    inside = (frames >= t[0]) & (frames <= t[-1])
    share = float(inside.mean())
    spans = f"{t[0]:.6g} to {t[-1]:.6g} s, the frames {frames[0]:.6g} to {frames[-1]:.6g} s"
    if not inside.any():
        raise InputError(
            f"its clock does not overlap the frames': it covers {spans}",
            where=where,
            todo=_clock_remedy(t, frames),
        )
    if share < _COVERED:
        return [f"{where}: covers {100 * share:.0f} % of the frames ({spans})"]
    return []


def _clock_remedy(t: Array, frames: Array) -> str:
    length, wanted = t[-1] - t[0], frames[-1] - frames[0]
    for name, factor in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        near = t[0] / factor <= frames[-1] and t[-1] / factor >= frames[0]
        if near and wanted > 0 and 0.5 < length / factor / wanted < 5:
            return f"its times look like {name}: divide them by {factor:g}"
    offset = frames[0] - t[0]
    return f"put both on one clock; if both started together, add {offset:.6g} s to its times"


def check_encoder(
    t_s: ArrayLike, position_mm: ArrayLike, frames_t_s: ArrayLike, *, where: str = "stage"
) -> list[str]:
    """Warnings about the encoder's record (E,); InputError for jumps that reach the frames."""
    t, frames = np.asarray(t_s, float), np.asarray(frames_t_s, float)
    words = check_overlap(t, frames, where=where)
    faults = encoder_faults(t, position_mm)
    grave = [
        f
        for f in faults
        if abs(f.size_mm) > _HARMLESS_MM and f.acceleration_m_s2 > _REAL_M_S2
        if _touches(f, t, frames)
    ]
    if grave:
        more = f" (and {len(grave) - 1} more)" if len(grave) > 1 else ""
        raise InputError(grave[0].words + more, where=where, todo=_encoder_remedy(grave[0]))
    shown = [f"{where}: {fault.words}" for fault in faults[:3]]
    if len(faults) > 3:
        shown.append(f"{where}: and {len(faults) - 3} more jumps")
    return words + shown


def _touches(fault: EncoderFault, t: Array, frames: Array) -> bool:
    """Whether positions at frames, taken as differences within the run, are wrong by the fault."""
    first = int(np.searchsorted(t, fault.t_s))
    begin = t[max(first - 1, 0)]
    if fault.kind == "spike":
        end = t[min(first + fault.readings, len(t) - 1)]
        return bool(np.any((frames > begin) & (frames < end)))
    return bool(frames[0] < fault.t_s and frames[-1] > begin)


def _encoder_remedy(fault: EncoderFault) -> str:
    if fault.kind == "spike":
        return "remove those rows from stage.csv"
    what = "unwrap the counter: " if fault.kind == "wrap" else ""
    return (
        f"{what}subtract {fault.size_mm:.6g} mm from every position from {fault.t_s:.6g} s on, or "
        "cut the run there"
    )


def _check_accelerometers(run: RunData) -> list[str]:
    table, words = run.accelerometers, []
    assert table is not None
    file = f"{run.name}/accelerometer.csv"
    described = {} if run.rig is None else dict(run.rig.accelerometers)
    up = None if run.rig is None or run.rig.stage is None else np.asarray(run.rig.stage.up)
    for name, rows in table.groupby("sensor", sort=False):
        where = f"{file}, sensor {name}"
        if run.rig is not None and name not in described:
            raise InputError(
                f"there is no accelerometer {str(name)!r} in rig.toml",
                where=file,
                todo=suggestion(str(name), list(described))
                if described
                else f"add a table [accelerometers.{name}]",
            )
        t = rows["t_s"].to_numpy(float)
        reading = rows[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy(float)
        words += check_overlap(t, run.t_s, where=where)
        words += check_accelerometer(t, reading, where=where)
        if name in described and up is not None:
            axes = described[str(name)].axes
            words += check_axes(reading, axes, up, where=where) or _check_motion(
                run, t, reading, axes, where
            )
    return words


def check_accelerometer(t_s: ArrayLike, reading_m_s2: ArrayLike, *, where: str) -> list[str]:
    """Warnings about one sensor's readings (N,), (N, 3); InputError for a wrong unit."""
    t, reading = np.asarray(t_s, float), np.asarray(reading_m_s2, float).reshape(-1, 3)
    if not (np.isfinite(t).all() and np.isfinite(reading).all()):
        row = int(np.flatnonzero(~(np.isfinite(t) & np.isfinite(reading).all(1)))[0])
        raise InputError(f"sample {row} is not finite", where=where, todo="leave it out")
    _check_gravity(gravity_of(reading), where)
    words = []
    for found in clippings(reading):
        words.append(
            f"{where}: {found.count} of {len(t)} samples of a{'xyz'[found.axis]} are clipped at "
            f"{found.value:.4g} m/s^2, the first at {t[found.first]:.6g} s: the sensor's range is "
            "too small; leave those rows out, or choose a wider range"
        )
    for axis in dead_axes(reading):
        words.append(f"{where}: a{'xyz'[axis]} never changes: stuck, or not connected")
    return words


def _check_gravity(gravity: Array, where: str) -> None:
    size = float(np.linalg.norm(gravity))
    unit = unit_of(gravity)
    if unit is not None:
        raise InputError(
            f"reads {size:.4g} at rest, where m/s^2 would be 9.81: it is in {unit[0]}",
            where=where,
            todo=f"multiply ax_m_s2, ay_m_s2, az_m_s2 by {unit[1]:.6g}",
        )
    if without_gravity(gravity):
        raise InputError(
            f"reads {size:.2g} m/s^2 at rest: gravity has been taken out",
            where=where,
            todo="give the specific force as the sensor measures it, 9.81 m/s^2 upwards at rest",
        )
    if not plausible_gravity(gravity):
        raise InputError(
            f"reads {size:.4g} at rest, which is gravity in no unit",
            where=where,
            todo="check the sensor's scale: 9.81 m/s^2 upwards at rest",
        )


def check_axes(reading_m_s2: ArrayLike, axes: ArrayLike, up: ArrayLike, *, where: str) -> list[str]:
    """A warning when gravity does not point up by the stated mounting, with axes that would fit.

    reading_m_s2 (N, 3); axes (3, 3) rows are the sensor's axes in rig coordinates; up (3,).
    """
    gravity = gravity_of(reading_m_s2)
    angle = tilt_deg(gravity, axes, up)
    if angle < _TILTED_DEG:
        return []
    fits = fitting_axes(gravity, axes, up)
    words = f"{where}: by its axes in rig.toml gravity points {angle:.0f} deg away from up; "
    if fits is None:
        direction = ", ".join(f"{v:.2f}" for v in gravity / np.linalg.norm(gravity))
        return [f"{words}no exchange of axes fits: up is ({direction}) in the sensor's axes"]
    rows = ", ".join("[" + ", ".join(f"{v:.4g}" for v in row + 0.0) + "]" for row in fits)
    return [f"{words}axes = [{rows}] would fit (or that turned about the vertical)"]


def _check_motion(run: RunData, t: Array, reading: Array, axes: ArrayLike, where: str) -> list[str]:
    """The carriage's acceleration seen by the encoder, looked for on the stated sensor axis."""
    if run.stage is None or run.rig is None or run.rig.stage is None or len(t) < 2:
        return []
    stage = run.stage[["t_s", "position_mm"]].to_numpy(float)
    found = motion_correlation(t, reading, stage[:, 0], stage[:, 1])
    along = np.asarray(axes, float) @ np.asarray(run.rig.stage.axis)
    if found is None or not motion_contradicts(found, along):
        return []
    best = int(np.argmax(np.abs(found)))
    sign = "-" if found[best] < 0 else "+"
    return [
        f"{where}: the carriage's acceleration is felt along {sign}{'xyz'[best]} of the sensor "
        f"(correlation {abs(found[best]):.2f}), not where its axes in rig.toml put the travel "
        f"direction (correlation {float(found @ along):.2f}): check axes"
    ]


def check_tracks(table: Any, calibration: Calibration) -> list[str]:
    """Whether points and pixels of a tracks table belong together by this calibration.

    The pixels are triangulated anew and both points projected; a warning when they differ by more
    than 0.5 px in the median, InputError by more than 5 px or for cameras that are missing.
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
    return [f"{what}: they were made with another calibration; the pixels are what counts"]


def _off_px(table: Any, calibration: Calibration) -> float:
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
