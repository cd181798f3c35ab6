"""Checks a short recording before the long one: light, focus, synchrony, sensors, shake, verdict.

The recording is tracked and smoothed as any other run. Every check states a number, its limit, and
what to do where the number is beyond it.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.command_options import Experiment
from telerig.errors import TelerigError
from telerig.estimator.bubbles.background.screen import screen_level
from telerig.estimator.bubbles.flat_field import BYTE_SCALE, SCALES_OF_16_BITS, full_scale
from telerig.estimator.calibration.result.calibration import Calibration, of_run
from telerig.estimator.doctor.checks import Check, Status
from telerig.estimator.plan import MOST_STATES, expect
from telerig.estimator.rig_drift.change import LATE_SIGMAS
from telerig.estimator.rig_drift.estimate import with_speeds
from telerig.estimator.sensors.checks import check_sensors
from telerig.estimator.sensors.findings import Finding, SensorError
from telerig.estimator.smoothing.result import Smoothing
from telerig.estimator.smoothing.smooth import smooth
from telerig.estimator.tracking.detect_run import described_fields
from telerig.estimator.tracking.track import track
from telerig.estimator.tracking.tracks import Tracks
from telerig.io.dataset.run import RunData
from telerig.io.results.smoothing import SmoothingFile, Verdict
from telerig.io.results.verdict_words import number_words
from telerig.io.rig_file.description import RigDescription
from telerig.io.tables.smoothing import AXES
from telerig.progress import Progress
from telerig.short_text import counted, share
from telerig.spectra import motion_spectrum, welch_density

LEAST_LEVEL = 0.3
"""Least level of the backlight as a share of full scale. A pixel's shot noise is the square root of
its electrons: at less light the bubbles' centres are less certain, 1.8 times at this level."""
MOST_SATURATED = 0.01
"""Largest share of pixels at full scale, where a rim's slope is cut off."""
LEAST_EVENNESS = 0.5
"""Least ratio of the darkest to the brightest twentieth of the backlight."""
MOST_BLUR_PX = 2.5
"""Largest blur of the sharpest quarter of the outlines. A centre's standard deviation grows with
the square root of the blur, and a blur hides the waist between two bubbles."""
MOST_SMEAR_PX = 0.5
"""Largest path of a bubble's image during an exposure; more smears the outline as defocus does."""
MOST_MISSING = 0.002
"""Largest share of frames that are missing or doubled: such gaps break tracks of crossing bubbles,
and a camera that loses some frames may lose many."""
MOST_SHAKE = 0.02
"""Largest RMS of the shake as a share of the field of view."""
_LATE_PX = 0.1
"""A delay is a failure if bubbles move by more during it, beside being significant."""

_SEGMENT = 512
_LOOKED_AT = 24
_MOST_REFUSED = 4
_GAP = 1.5
_MOST_PLANNED = 4000
"""Bubbles times frames of the planned run; a longer one is at least as good."""


@dataclass(frozen=True)
class Recording:
    """Hold what was found in a short recording.

    checks : the answers. tracks, smoothing : what tracking and smoothing gave; None where they
    could not be made. expected : the verdict to expect of the planned run.
    """

    run: RunData
    checks: tuple[Check, ...]
    tracks: Tracks | None = None
    smoothing: Smoothing | None = None
    expected: Verdict | None = None


def check_recording(
    run: RunData,
    calibration: Calibration,
    *,
    seconds: float | None = None,
    progress: Progress | bool = False,
) -> Recording:
    """Check a short recording of a rig that is about to record a long run.

    run : the recording, some hundred frames of images or of detections.
    seconds : duration of the run that is planned; None for that of the recording.
    progress : as for `telerig.smooth`.

    Raises InputError for a recording that cannot be read.
    """
    checks: list[Check] = []
    if calibration.rejection:
        todo = "correct its cause and calibrate again before the long run"
        checks.append(Check("calibration", "failure", calibration.rejection, todo))
    if run.source == "images":
        checks += [c for camera in run.cameras for c in _images(run, camera)]
    checks += _steps(run)
    tracks = track(run, calibration, progress=progress)
    if not len(tracks):
        todo = "let bubbles rise through the view; then look at the images' light and focus"
        checks.append(Check("bubbles", "failure", "none was tracked", todo))
        return Recording(run, tuple(checks))
    speed = _speed_px_s(tracks, run.cameras)
    checks += [*_outlines(tracks, run.cameras), _exposure(speed), *_rig(tracks, speed)]
    smoothing, used, found = _smoothed(tracks, calibration, run, progress)
    checks += found
    expected = None
    if smoothing is None:
        checks += _sensor_shake(run, calibration)
    else:
        checks += _shake(smoothing, calibration, run.cameras)
        length = float(np.ptp(run.t_s)) if seconds is None else seconds
        expected = _expected(used, tracks, smoothing, calibration, length)
        checks.append(_verdict(expected, length, smoothing))
    return Recording(run, tuple(checks), tracks, smoothing, expected)


def _judged(what: str, words: str, good: bool, todo: str) -> Check:
    return Check(what, "ok", words) if good else Check(what, "failure", words, todo)


def _images(run: RunData, camera: str) -> Iterator[Check]:
    """Check light and frames of a camera's images."""
    region = described_fields(run).get(camera)
    some = np.unique(np.linspace(0, run.frame_count - 1, _LOOKED_AT).round().astype(int))
    levels, saturated = list[Array](), list[tuple[float, float]]()
    missing: list[int] = []
    doubled: list[int] = []
    before, scale, peak = None, 0.0, 0.0
    for frame in range(run.frame_count):
        image = run.image(camera, frame)
        if image is None:
            missing.append(frame)
            continue
        same = zlib.crc32(np.ascontiguousarray(image).data)
        if same == before:
            doubled.append(frame)
        before = same
        white = full_scale(image)
        scale, peak = max(scale, white), max(peak, float(image.max()))
        if frame in some:
            screen = screen_level(image, region)
            inside = screen[::8, ::8] if region is None else screen[region][::64]
            levels.append(np.quantile(inside, [0.05, 0.5, 0.95]))
            saturated.append((white, float(np.mean(image >= white))))
    if not levels:
        yield Check(f"images of {camera}", "failure", "no image can be read", "look at the files")
        return
    dark, level, bright = np.median(levels, axis=0)
    at_white = [part if white == scale else 0.0 for white, part in saturated]
    yield _light(camera, level, scale, depth_known=peak >= scale)
    worst = float(np.median(at_white))
    yield _judged(
        f"saturation of {camera}",
        f"{share(worst, 1)} of the pixels are at full scale (at most {share(MOST_SATURATED, 1)})",
        worst <= MOST_SATURATED,
        "give less light, expose for less time, or lower the gain",
    )
    yield _judged(
        f"evenness of {camera}",
        f"the darkest part of the backlight has {share(dark, bright)} of the brightest (at least "
        f"{share(LEAST_EVENNESS, 1)})",
        dark >= LEAST_EVENNESS * bright,
        "centre the light behind the tank, or move it away from the diffuser",
    )
    for kind, frames, todo in (
        ("missing", missing, "record to a faster disk, or with fewer frames per second"),
        ("doubled", doubled, "look at the trigger and at the camera's driver: an image is stored "
         "again where a new one was not there in time"),
    ):  # fmt: skip
        first = f", the first is {frames[0]}" if frames else ""
        yield _judged(
            f"{kind} frames of {camera}",
            f"{len(frames)} of {run.frame_count} (at most {share(MOST_MISSING, 1)}){first}",
            len(frames) <= MOST_MISSING * run.frame_count,
            todo,
        )


def _light(camera: str, level: float, scale: float, *, depth_known: bool) -> Check:
    """Check the grey level of the backlight.

    scale : full scale by the least depth (bits) that holds all images. depth_known : whether some
    pixels are at this level; if not, the camera may have more bits.
    """
    what, words = f"light of {camera}", f"the backlight is at {share(level, scale)} of full scale"
    words += f" (at least {share(LEAST_LEVEL, 1)})"
    good = level >= LEAST_LEVEL * scale
    other = next((white for white in SCALES_OF_16_BITS if white > scale > BYTE_SCALE), None)
    if depth_known or not good or other is None:
        todo = "give more light, open the aperture, or expose for longer if the motion permits it"
        return _judged(what, words, good, todo)
    bits, more = (round(np.log2(white + 1)) for white in (scale, other))
    return Check(
        what,
        "note",
        f"{words} if the camera has {bits} bits, the least that hold all grey levels: the images "
        f"do not tell; of {more} bits it would be {share(level, other)}",
        f"look up the camera's bit depth, and give more light if it is more than {bits} bits",
    )


def _steps(run: RunData) -> Iterator[Check]:
    """Check the times of the frames."""
    steps = np.diff(run.t_s)
    if len(steps):
        step = float(np.median(steps))
        lost = round(float((steps[steps > _GAP * step] / step - 1).sum()))
        yield _judged(
            "times of the frames",
            f"{counted(lost, 'frame')} of {run.frame_count + lost} missing by the times in "
            f"frames.csv (at most {share(MOST_MISSING, 1)})",
            lost <= MOST_MISSING * (run.frame_count + lost),
            "record to a faster disk, or with fewer frames per second",
        )


def _outlines(tracks: Tracks, cameras: Sequence[str]) -> Iterator[Check]:
    """Check how sharp the outlines are."""
    found = tracks.detections
    if "edge_px" not in found:
        return
    for camera in cameras:
        blur = found.loc[(found["camera"] == camera) & found["particle"].notna(), "edge_px"]
        sharp = float(blur.quantile(0.25))
        if np.isfinite(sharp):
            yield _judged(
                f"focus of {camera}",
                f"the sharpest quarter of the outlines is blurred by {sharp:.2g} px (at most "
                f"{MOST_BLUR_PX:g} px)",
                sharp <= MOST_BLUR_PX,
                "focus on the middle of the bubbles, or close the aperture",
            )


def _speed_px_s(tracks: Tracks, cameras: Sequence[str]) -> float:
    """Return the speed in px/s below which the images of bubbles move in 95 % of the frames.

    It is nan if no bubble was seen in three frames one after the other.
    """
    moving = with_speeds(tracks.table, cameras)
    each = [np.hypot(moving[f"{c}_u_px_s"], moving[f"{c}_v_px_s"]) for c in cameras]
    known = np.concatenate(each)
    known = known[known > 0]
    return float(np.quantile(known, 0.95)) if len(known) else float("nan")


def _exposure(speed: float) -> Check:
    if not np.isfinite(speed):
        words = "no bubble was seen in three frames one after the other"
        return Check("motion", "note", words, "record for longer")
    longest = 1e3 * MOST_SMEAR_PX / speed
    return Check(
        "motion",
        "ok",
        f"bubbles move by up to {speed:.0f} px/s in the images, so the longest exposure without "
        f"smeared outlines is {longest:.2g} ms",
    )


def _rig(tracks: Tracks, speed: float) -> Iterator[Check]:
    """Check whether the cameras expose together, and stand as they did at the calibration."""
    change = tracks.summary.get("rig_change")
    if change is None:
        words = "too few bubbles were seen by two cameras to compare them"
        yield Check("cameras together", "note", words, "record for longer")
        return
    camera, other = change["camera"], change["against"]
    if "late_s" in change:
        late, sd = change["late_s"], change["slate_s"]
        limit = max(LATE_SIGMAS * sd, _LATE_PX / speed)
        yield _judged(
            "synchrony",
            f"camera {camera!r} exposes {1e3 * late:+.2g} ± {1e3 * sd:.1g} ms after {other!r} (at "
            f"most {1e3 * limit:.2g} ms)",
            abs(late) <= limit,
            "trigger both cameras by one signal, and compare their delays and exposure times",
        )
    yield _judged(
        "cameras since calibration",
        f"camera {camera!r} against {other!r}: {1e3 * change['offset_mm']:+.2g} ± "
        f"{1e3 * change['soffset_mm']:.1g} µm, rolled by {1e3 * change['roll_rad']:+.2g} ± "
        f"{1e3 * change['sroll_rad']:.1g} mrad, pitched by {1e3 * change['pitch_rad']:+.2g} ± "
        f"{1e3 * change['spitch_rad']:.1g} mrad: probability by chance {change['chance']:.1g}",
        not change["moved"],
        "fasten the cameras, calibrate again, and record again",
    )


def _smoothed(
    tracks: Tracks, calibration: Calibration, run: RunData, progress: Progress | bool
) -> tuple[Smoothing | None, RunData, list[Check]]:
    """Smooth the recording, if need be without the sensors that are refused; also return it so."""
    try:
        said = check_sensors(run)
    except TelerigError as error:
        words = f"{error.where}: {error.what}" if error.where else error.what
        return None, run, [Check("sensors", "failure", words, error.todo)]
    checks = [_of_sensor(finding) for finding in said]
    smoothing = None
    for _ in range(1 + _MOST_REFUSED):
        try:
            smoothing = smooth(tracks, calibration, stage=run, progress=progress)
            break
        except SensorError as error:
            checks += [_of_sensor(f) for f in error.findings if f not in said]
            said += error.findings
            run = _without_refused(run, error.findings)
        except TelerigError as error:
            checks.append(Check("smoothing", "failure", error.what, error.todo))
            return None, run, checks
    warnings = [] if smoothing is None else smoothing.summary.get("warnings", ())
    known = [finding.warning for finding in said]
    checks += [Check("sensors", "warning", str(w)) for w in warnings if str(w) not in known]
    if all(check.status == "note" for check in checks):
        present = run.stage is not None or run.accelerometers is not None
        words = "encoder and accelerometers agree with the images" if present else "none"
        checks.append(Check("sensors", "ok" if present else "note", words))
    return smoothing, run, checks


def _of_sensor(finding: Finding) -> Check:
    status: Status = "failure" if finding.is_fault else "note"
    return Check("sensors", status, f"{finding.where}: {finding.words}", finding.todo)


def _without_refused(run: RunData, findings: Sequence[Finding]) -> RunData:
    """Return the run without the accelerometers of the findings, or else without the encoder."""
    table = run.accelerometers
    if table is not None:
        refused = [
            name
            for name in table["sensor"].unique()
            if any(f.fix.get("sensor") == name or f.where.endswith(f" {name}") for f in findings)
        ]
        if refused:
            kept = table[~table["sensor"].isin(refused)].reset_index(drop=True)
            return replace(run, accelerometers=kept if len(kept) else None)
    return replace(run, stage=None, position_mm=None, accelerometers=None)


def sensor_shake(run: RunData) -> tuple[float, float] | None:
    """Return the RMS (mm) of the strongest shake along an axis of an accelerometer, and its line.

    Frequencies (Hz) are those of `motion_spectrum`. None without an accelerometer.
    """
    found = []
    for _, rows in () if run.accelerometers is None else run.accelerometers.groupby("sensor"):
        readings = rows[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy(float)
        motion = motion_spectrum(rows["t_s"].to_numpy(float), readings)
        if motion is not None:
            rms = 1e-3 * np.sqrt(motion.density.sum(0) * motion.step_hz)
            axis = int(np.argmax(rms))
            line = motion.frequency_hz[np.argmax(motion.density[:, axis])]
            found.append((float(rms[axis]), float(line)))
    return max(found, default=None)


def shake_line(smoothing: Smoothing, cameras: Sequence[str]) -> tuple[Array, float]:
    """Return the RMS (C, 3) in mm of the cameras' shake, and the frequency of its main line.

    The frequency is in Hz; cameras : their names.
    """
    shake = smoothing.shake
    columns = [f"{camera}_{axis}_mm" for camera in cameras for axis in AXES]
    values = shake[columns].to_numpy(float)
    hz, density = welch_density(shake["t_s"].to_numpy(float), values, _SEGMENT)
    rms = values.std(0).reshape(len(cameras), 3)
    return rms, float(hz[1 + np.argmax(density.sum(1)[1:])])


def _shake(
    smoothing: Smoothing, calibration: Calibration, cameras: Sequence[str]
) -> Iterator[Check]:
    rms, hz = shake_line(smoothing, cameras)
    for one, camera in zip(rms, of_run(calibration, cameras).cameras):
        field = min(camera.image_size_px) / camera["scale_px_per_mm"]
        size = float(np.hypot.reduce(one))
        yield _judged(
            f"shake of {camera.name}",
            f"{size:.2g} mm RMS (at most {MOST_SHAKE * field:.2g} mm), most of it at {hz:.3g} Hz; "
            + ", ".join(f"{a} {1e3 * v:.0f} µm" for a, v in zip(AXES, one)),
            size <= MOST_SHAKE * field,
            f"stiffen or damp what resonates at {hz:.3g} Hz",
        )


def _sensor_shake(run: RunData, calibration: Calibration) -> Iterator[Check]:
    """Check the shake by the accelerometers alone, for a recording that cannot be smoothed."""
    found = sensor_shake(run)
    if found is not None:
        field = min(min(c.image_size_px) / c["scale_px_per_mm"] for c in calibration.cameras)
        yield _judged(
            "shake by accelerometers",
            f"{found[0]:.2g} mm RMS along one axis (at most {MOST_SHAKE * field:.2g} mm), most of "
            f"it at {found[1]:.3g} Hz",
            found[0] <= MOST_SHAKE * field,
            f"stiffen or damp what resonates at {found[1]:.3g} Hz",
        )


def _recorded_rig(run: RunData, smoothing: Smoothing) -> RigDescription:
    """Return the rig with the sensors that the smoothing used."""
    used = set(smoothing.summary.get("accelerometers", ()))
    rig = run.rig
    assert rig is not None
    kept = {name: one for name, one in rig.accelerometers.items() if name in used}
    return replace(rig, accelerometers=kept, stage=rig.stage if run.stage is not None else None)


def _expected(
    run: RunData, tracks: Tracks, smoothing: Smoothing, calibration: Calibration, seconds: float
) -> Verdict:
    """Return the verdict to expect of a run of so many seconds.

    It is the recording's own, better by as many steps as the plan of the longer run is better than
    that of the recording; the plan alone does not know how the rig shakes.
    """
    own = Verdict(smoothing.verdict["verdict"])
    if run.rig is None:  # nothing says which sensors a longer run would have
        return own
    short = _planned(run, tracks, smoothing)
    most = max(short.seconds, min(MOST_STATES, _MOST_PLANNED) / short.bubbles / short.rate_hz)
    if own not in (Verdict.PARTIAL, Verdict.UNRESOLVED) or seconds <= short.seconds:
        return own
    rig, order = _recorded_rig(run, smoothing), list(Verdict)
    before, after = (
        order.index(expect(rig, calibration, plan).verdict)
        for plan in (short, replace(short, seconds=min(seconds, most)))
    )
    return order[max(0, order.index(own) - max(0, before - after))]


def _planned(run: RunData, tracks: Tracks, smoothing: Smoothing) -> Experiment:
    """Return the plan of a run like the recording, of at most `MOST_STATES`."""
    table = tracks.table
    rate = 1 / float(np.median(np.diff(run.t_s)))
    in_sight = max(1, round(float(table.groupby("frame").size().median())))
    rms, hz = shake_line(smoothing, run.cameras)
    variances = [table[f"{c}_s{a}{a}_px2"] for c in run.cameras for a in "uv"]
    rise = np.zeros(1) if run.position_mm is None else np.diff(run.position_mm) * rate
    marked = run.references if tracks.references is None else tracks.references
    marks = 0
    if marked is not None and len(marked):
        marks = round(float(marked.groupby(["frame", "camera"]).size().median()))
    vertical = "xyz".index(str(smoothing.verdict.get("vertical", "y")))
    return Experiment(
        rate_hz=rate, seconds=min(float(np.ptp(run.t_s)), MOST_STATES / in_sight / rate),
        bubbles=in_sight,
        diameter_mm=float(np.nanmedian(table["d_eq_mm"])) if "d_eq_mm" in table else 3.0,
        sigma_px=float(np.sqrt(pd.concat(variances).median())),
        rise_mm_s=max(0.0, float(np.nanmedian(rise))),
        shake_hz=hz, shake_mm=float(rms[:, vertical].mean()), marks=marks,
    )  # fmt: skip


def _verdict(expected: Verdict, seconds: float, smoothing: Smoothing) -> Check:
    """Check which verdict the planned run may expect."""
    file = SmoothingFile.model_validate(smoothing.verdict)
    numbers = number_words(file.axes, file.vertical, file.verdict) or "its measurements disagree"
    return _judged(
        "expected verdict",
        f"{expected} of a run of {seconds:.3g} s; of this recording {file.verdict}: {numbers}",
        expected is Verdict.RESOLVED,
        "add an accelerometer to each arm or marks fixed to the tank; `telerig plan` compares them",
    )
