"""Reads the sensors of a run and checks them, and its tracks, before it is smoothed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.estimator.sensors.encoder_checks import check_encoder
from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.sensors.given import Sensor, given_sensors, table_columns
from telerig.estimator.sensors.gravity import check_accelerometer
from telerig.estimator.sensors.mounting import check_motion
from telerig.estimator.sensors.samples import mostly_masked, screened
from telerig.rig.units import STANDARD_GRAVITY_M_S2
from telerig.short_text import counted

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.io.dataset.run import RunData
    from telerig.io.rig_file.description import StageDescription


_COVERED, _MOSTLY, _LEAST_COVERED = 0.999, 0.8, 0.1
_SMALLER_UNITS = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
_FOREIGN_PX = 5.0
_DIFFERENT_PX = 0.5
_SAMPLED = 2000
_SLOWER = 0.95
_UP = (0.0, -1.0, 0.0)


@dataclass(frozen=True)
class Encoder:
    """Hold the usable readings of an encoder: t_s (E,) times, position_mm (E,) positions."""

    t_s: Array
    position_mm: Array


@dataclass(frozen=True)
class Mounting:
    """Hold how the rig stands in the laboratory.

    axis, up : (3,) unit vectors in the rig frame along the travel and against gravity.
    gravity_m_s2 : gravity of the laboratory.
    """

    axis: Array
    up: Array
    gravity_m_s2: float

    @staticmethod
    def of(described: StageDescription | None, axis: ArrayLike | None = None) -> Mounting:
        """Return the mounting that rig.toml describes; without it up is upwards in the images.

        axis : the travel axis, if a calibration knows it better.
        """
        if described is None:
            up, gravity = np.asarray(_UP), STANDARD_GRAVITY_M_S2
        else:
            up, gravity = np.asarray(described.up, float), float(described.gravity_m_s2)
        up = up / np.linalg.norm(up)
        known = up if described is None else np.asarray(described.axis, float)
        return Mounting(known if axis is None else np.asarray(axis, float), up, gravity)


@dataclass(frozen=True)
class Sensors:
    """Hold the records that can be used, and what the checks found in all of them."""

    encoder: Encoder | None
    accelerometers: tuple[Sensor, ...]
    findings: tuple[Finding, ...]


def read_sensors(
    stage: Any,
    accelerometers: Any,
    rig: Any,
    cameras: Sequence[str],
    frames_t_s: ArrayLike,
    mounting: Mounting,
    *,
    files: tuple[str, str] = ("stage", ""),
) -> Sensors:
    """Return encoder and accelerometers with their unusable samples masked, and the findings.

    stage, accelerometers, rig : as for `telerig.smooth`.
    frames_t_s : (F,).
    files : names of both tables for messages, or "".

    Raises InputError for records that cannot be read.
    """
    frames = np.asarray(frames_t_s, float)
    encoder, findings = _encoder(stage, frames, files[0])
    given, found = given_sensors(accelerometers, rig, cameras, file=files[1])
    findings += found
    kept = []
    for raw in given:
        sensor, found = screened(raw)
        findings += found
        left_out = mostly_masked(sensor)
        if left_out is not None:
            findings.append(left_out)
            continue
        kept.append(sensor)
        findings += _slower_than(frames, sensor)
        if sensor.clock == "frames":
            findings += check_overlap(
                sensor.t_s, frames, where=sensor.where, code=Code.SENSOR_CLOCK, sensor=sensor.name
            )
        found = check_accelerometer(sensor, mounting.up, mounting.gravity_m_s2)
        if not found and encoder is not None:
            found = check_motion(
                sensor, encoder.t_s, encoder.position_mm, mounting.axis, mounting.up
            )
        findings += found
    return Sensors(encoder, tuple(kept), tuple(findings))


def _slower_than(frames_t_s: Array, sensor: Sensor) -> list[Finding]:
    """Return a warning for a sensor with fewer samples a second than there are frames."""
    if len(frames_t_s) < 2 or len(sensor.t_s) < 2:
        return []
    rate, frames = (1 / float(np.median(np.diff(t))) for t in (sensor.t_s, frames_t_s))
    if rate >= _SLOWER * frames:
        return []
    return [
        Finding(
            f"it records {rate:.4g} samples a second, fewer than the {frames:.4g} frames: it does "
            f"not show a shake above {rate / 2:.4g} Hz, or shows it at a wrong frequency",
            sensor.where,
            f"record at {2 * frames:.4g} Hz or more",
        )
    ]


def _encoder(stage: Any, frames: Array, where: str) -> tuple[Encoder | None, list[Finding]]:
    """Return the encoder's usable readings, None if they cover no frame, and findings."""
    if stage is None:
        return None, []
    t, position = table_columns(
        stage, ("t_s", "position_mm"), where, what="telerig.load_run(folder), or a table"
    )
    bad = np.flatnonzero(~(np.diff(t) > 0))
    if len(bad) or len(t) < 2:
        raise InputError(
            f"times do not increase at row {int(bad[0]) + 1}"
            if len(bad)
            else f"has {counted(len(t), 'reading')}",
            where=where,
            todo="sort the rows and remove duplicates; a stage that stands needs no encoder",
        )
    outside = check_overlap(t, frames, where=where, code=Code.ENCODER_CLOCK)
    if outside and outside[0].code is not None:
        return None, outside
    kept, found = check_encoder(t, position, frames, where=where)
    return Encoder(t[kept], position[kept]), outside + found


def check_sensors(
    run: RunData, *, tracks: Any = None, calibration: Calibration | None = None
) -> list[Finding]:
    """Return the findings about a run's encoder, accelerometers and, if given, tracks.

    tracks : `Tracks`, or a table like tracks.csv, which is compared with ``calibration``. Raises
    InputError for data that cannot be read: sensors that rig.toml does not name, values that are
    not finite, and tracks from another rig.
    """
    found = read_sensors(
        run.stage, run.accelerometers, run.rig, run.cameras, run.t_s,
        Mounting.of(None if run.rig is None else run.rig.stage), files=files_of(run),
    )  # fmt: skip
    findings = list(found.findings)
    if tracks is not None and calibration is not None:
        findings += check_tracks(getattr(tracks, "table", tracks), calibration)
    return findings


def files_of(run: RunData) -> tuple[str, str]:
    """Return the names of the encoder's and the accelerometers' tables of a run, for messages."""
    return f"{run.name}/stage.csv", f"{run.name}/accelerometer.csv"


def check_overlap(
    t: Array, frames_t_s: ArrayLike, *, where: str, code: Code, sensor: str = ""
) -> list[Finding]:
    """Return a finding if a sensor's record does not cover all frames.

    It has the code ``code``, so that the record is refused, if hardly any frame is covered.

    t : (N,) times of the record.
    frames_t_s : (F,) times of the frames.
    where, sensor : for the message.
    """
    frames = np.asarray(frames_t_s, float)
    share = _covered(t, frames)
    if share >= _COVERED:
        return []
    spans = f"{t[0]:.6g} to {t[-1]:.6g} s, the frames {frames[0]:.6g} to {frames[-1]:.6g} s"
    words = f"the record covers {100 * share:.0f} % of the frames ({spans})"
    if share >= _LEAST_COVERED:
        return [Finding(words, where)]
    for name, factor in _SMALLER_UNITS:
        if _covered(t, frames / factor) > _MOSTLY:
            todo = f"the frames' times look like {name}: divide them by {factor:g}"
            return [
                Finding(words, where, todo, Code.FRAME_TIMES, {"frame_time_factor": 1 / factor})
            ]
    if share == 0:
        words = f"the record does not overlap the frames in time: it covers {spans}"
    offset = {"sensor": sensor or "encoder", "offset_s": float(frames[0] - t[0])}
    return [Finding(words, where, _clock_remedy(t, frames), code, offset)]


def _covered(t: Array, frames: Array) -> float:
    """Return the share of the frames' times (F,) that lie within a record's times (N,)."""
    return float(((frames >= t[0]) & (frames <= t[-1])).mean())


def _clock_remedy(t: Array, frames: Array) -> str:
    """Return the unit or the offset that would make the record's clock agree with the frames'."""
    length, wanted = t[-1] - t[0], frames[-1] - frames[0]
    for name, factor in _SMALLER_UNITS:
        near = t[0] / factor <= frames[-1] and t[-1] / factor >= frames[0]
        if near and wanted > 0 and 0.5 < length / factor / wanted < 5:
            return f"its times look like {name}: divide them by {factor:g}"
    offset = frames[0] - t[0]
    return f"put both on one clock; if both started together, add {offset:.6g} s to its times"


def check_tracks(table: Any, calibration: Calibration) -> list[Finding]:
    """Return a warning if points and pixels of tracks do not agree with this calibration.

    The pixels are triangulated again, and old and new points projected: a median difference above
    0.5 px gives a warning, above 5 px or without a camera InputError.
    """
    for camera in calibration.cameras:
        if f"{camera.name}_u_px" not in table:
            there = sorted({c[: -len("_u_px")] for c in table.columns if str(c).endswith("_u_px")})
            raise InputError(
                f"the tracks have no pixels of camera {camera.name!r}",
                where="tracks",
                todo=f"the tracks hold pixels of {', '.join(there) or 'no camera'}: track the "
                "run again "
                "with this calibration",
            )
    if len(calibration.cameras) < 2 or not len(table):
        return []
    off = _off_px(table, calibration)
    if off < _DIFFERENT_PX:
        return []
    what = f"points and pixels of the tracks disagree by {off:.3g} px (median)"
    if off > _FOREIGN_PX:
        raise InputError(
            f"{what}: the tracks were made with another calibration",
            where="tracks",
            todo="run `telerig track` with this calibration, or give the calibration with which "
            "the tracks were made",
        )
    words = f"{what}: the tracks were made with another calibration; only the pixels are used"
    return [Finding(words, "tracks")]


def _off_px(table: Any, calibration: Calibration) -> float:
    """Return the median distance in px between the tracks' points and points from their pixels."""
    some = np.unique(np.linspace(0, len(table) - 1, min(len(table), _SAMPLED)).astype(int))
    rows = table.iloc[some]
    points = rows[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    uv = {}
    for camera in calibration.cameras:
        pixels = rows[[f"{camera.name}_u_px", f"{camera.name}_v_px"]].to_numpy(float)
        shift = [f"{camera.name}_du_px", f"{camera.name}_dv_px"]
        if all(c in rows for c in shift):
            pixels = pixels + np.nan_to_num(rows[shift].to_numpy(float))
        uv[camera.name] = pixels
    seen = np.sum([np.isfinite(pixels).all(1) for pixels in uv.values()], axis=0)
    good = np.isfinite(points).all(1) & (seen >= 2)
    if not good.any():
        return 0.0
    pixels_of = {name: pixels[good] for name, pixels in uv.items()}
    again = calibration.triangulate(pixels_of, include_calibration=False).points_mm
    distance = [
        np.linalg.norm(c.project(again) - c.project(points[good]), axis=-1)
        for c in calibration.cameras
    ]
    return float(np.median(np.max(distance, axis=0)))
