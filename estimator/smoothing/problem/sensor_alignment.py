"""Compares the sensors of a run with its images: clocks, mounting, units, encoder, frame times.

In: a `SmoothingProblem` with complete sensor records. Out: the problem with each record on the
clock of the frames and cut to them, and findings. The regressions are in
`telerig.estimator.sensors`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.accelerations import (
    Accelerations,
    Grid,
    of_positions,
    of_readings,
)
from telerig.estimator.sensors.alignment import (
    LEAST_LOG_RATIO,
    REFUSED,
    Alignment,
    Channel,
    align,
    beyond_chance,
)
from telerig.estimator.sensors.drift import LEAST_PARTS, drift_of
from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.sensors.image_motion import accelerations, directions, frame_grid
from telerig.estimator.sensors.mounting import (
    Expected,
    Mounting,
    Regression,
    is_clear,
    mounting,
)
from telerig.estimator.sensors.response import CommonGain, Response
from telerig.estimator.smoothing.problem.mark_motion import LENS_SIGMA, MarkMotion
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    DELAY_SIGMA_S,
    Accelerometer,
    SmoothingProblem,
)
from telerig.estimator.smoothing.problem.tables import near_frames
from telerig.rig.pose import across

SAME_CLOCK_S = 3 * DELAY_SIGMA_S
"""Largest offset of a clock that counts as that of the frames."""

_MOST_REFINEMENTS = 6
_SHARED_S = 2.0
"""Before and after the frames, so much of a record is searched first whose clock is the frames'."""

_SLOWEST_S, _FASTEST_S = 0.05, 2e-5
_MOST_STEPS = 3e6
_LEAST_SAMPLES = 100
_DIFFERENT_SDS = 5.0
_LONG_S = 1.2
_WINDOW_S = 3.0
_MOST_DRIFT = 0.02
"""No clock's rate is off by a larger share."""
_WINDOW_MARGIN_S = 0.1
_LEAST_FRAMES = 150
_FRAME_FACTORS = {
    1e-3: "they are in milliseconds",
    0.5: "the stated frame rate is half the true one",
    2.0: "the stated frame rate is twice the true one",
}
_USUAL_GAIN, _KNOWN_GAIN = (0.75, 1.35), 0.01
_STANDS = 1e5
"""An encoder that reads less than a hundredth of its motion in metres stands still; a gain would
only be the noise of its numbers."""
_FAR = 3.0
"""Prior standard deviations beyond which a lens or an axis is wrong rather than a little off."""

_AXIS_SIGMA = 3e-3
"""Standard deviation (rad) of a travel axis that is stated and not measured."""

_FASTEST_MM_S = 3000.0
_STUCK_S = 0.05
_MOVING_MM_S = 20.0


LogEvidence = Callable[[SmoothingProblem], float]


def aligned(
    problem: SmoothingProblem, known: Sequence[Finding], log_evidence: LogEvidence
) -> tuple[SmoothingProblem, list[Finding]]:
    """Put the sensors on the clock of the frames and check them against the images.

    problem : with complete sensor records.
    known : findings of earlier checks.
    log_evidence : function that returns the log-likelihood of all measurements of a run.

    Returns the problem, without sensors whose unknown clock cannot be found, and all findings.
    Where gravity has shown wrong axes, the axes that fit the images replace the earlier proposal. A
    record that hardly overlaps the frames is accepted if the images show its clock offset.
    """
    refused = [f for f in known if f.code is not None]
    placed, found = _aligned(problem, refused, log_evidence)
    better: dict[tuple[Code | None, Any], Finding] = {
        (f.code, f.fix.get("sensor")): f for f in found if f.code is not None
    }
    confirmed = {s.name for s in placed.accelerometers if s.confirmed}
    out = []
    for finding in known:
        if finding.code == Code.SENSOR_CLOCK and finding.fix.get("sensor") in confirmed:
            continue
        mine = better.pop((finding.code, finding.fix.get("sensor")), None)
        if mine is not None and mine.code == Code.SENSOR_AXES:
            finding = replace(finding, todo=mine.todo, fix=mine.fix)
        out.append(finding)
    return placed, [*out, *(f for f in found if f.code is None), *better.values()]


def _aligned(
    problem: SmoothingProblem, refused: Sequence[Finding], log_evidence: LogEvidence
) -> tuple[SmoothingProblem, list[Finding]]:
    images, wrong = _Images.of(problem), None
    encoder = None if images is None else images.encoder_alignment(problem)
    findings: list[Finding]
    seen = iter(()) if images is None else _of_images(problem, images, encoder)
    elsewhere = 0.0
    for one in seen:
        if one.connected and _in_place(one, encoder, problem):
            break
        elsewhere = max(elsewhere, one.log_ratio)
    else:
        wrong = _frame_times(problem, elsewhere)
        if wrong is not None:
            images = None
    if images is None:
        sensors = [_unaligned(s, problem.t_s) for s in problem.accelerometers]
        findings = [*([] if wrong is None else [wrong]), *(f for _, said in sensors for f in said)]
        findings += [*_stuck(problem), *_rise(problem)] if wrong is None else []
        return _with(problem, [s for s, _ in sensors if s is not None]), findings
    findings = []
    placed: dict[int, Accelerometer] = {}
    late = [] if encoder is None else [encoder]
    for group, clock in _clocks(problem, images):
        if not _sure(clock):
            beside = [s for s in placed.values() if s.confirmed]
            clock = _clock(problem, images, group, beside=beside) or clock
        if clock is not None and all(problem.accelerometers[i].clock == "frames" for i in group):
            late.append(clock)
        for index in group:
            sensor, found = _placed(problem.accelerometers[index], clock, problem)
            findings += found
            if sensor is not None:
                placed[index] = sensor
        free = [i for i in group if not _keeps_clock(problem.accelerometers[i], clock)]
        if clock is not None and clock.unique and free:
            corrected, found = _without_drift([placed[i] for i in free], free, problem, images)
            placed.update(zip(free, corrected))
            findings += found
    problem = _with(problem, [placed[i] for i in sorted(placed)])
    problem = _with_late_images(problem, late)
    findings += _mountings(problem, images, refused, log_evidence)
    findings += _encoder(problem, images, encoder, [*refused, *findings])
    findings += _rise(problem)
    near = [near_frames(s, problem.t_s) for s in problem.accelerometers]
    return _with(problem, near), findings


def _with_late_images(problem: SmoothingProblem, clocks: Sequence[Alignment]) -> SmoothingProblem:
    """Return the problem with an encoder that may be as late as records on the frames' clock are.

    A delay of the images is one of all these records. The arms answer the stage with a delay of
    their own, so that what the images show of the encoder's is no correction of it.
    """
    if problem.stage is None:
        return problem
    shown = [c.offset_s for c in clocks if c.unique and abs(c.offset_s) > _FAR * c.sd_s]
    sigma = np.hypot(problem.stage.delay_sigma_s, max(map(abs, shown), default=0.0))
    return replace(problem, stage=replace(problem.stage, delay_sigma_s=float(sigma)))


def _in_place(clock: Alignment, encoder: Alignment | None, problem: SmoothingProblem) -> bool:
    """Return whether a clock's offset is near 0, or unknown before the alignment."""
    free = clock is not encoder and any(s.clock == "unknown" for s in problem.accelerometers)
    return free or abs(clock.offset_s) < 2 * SAME_CLOCK_S


def _with(problem: SmoothingProblem, sensors: Sequence[Accelerometer]) -> SmoothingProblem:
    return replace(problem, accelerometers=tuple(sensors))


def _sure(clock: Alignment | None) -> bool:
    return clock is not None and (clock.unique or clock.at_zero)


def _clocks(problem: SmoothingProblem, images: _Images) -> list[tuple[list[int], Alignment | None]]:
    """Return groups of sensors with their clocks, the most significant first.

    Sensors with equal time stamps are aligned together, or one by one if that fails.
    """
    out = []
    for group in _groups(problem):
        clock = _clock(problem, images, group)
        if _sure(clock) or len(group) == 1:
            out.append((group, clock))
            continue
        out += [([index], _clock(problem, images, [index])) for index in group]
    return sorted(out, key=lambda g: -(g[1].log_ratio if g[1] is not None else 0.0))


def _groups(problem: SmoothingProblem) -> list[list[int]]:
    """Return the indices of the sensors, grouped by equal time stamps."""
    groups: list[list[int]] = []
    for index, sensor in enumerate(problem.accelerometers):
        for group in groups:
            if np.array_equal(problem.accelerometers[group[0]].t_s, sensor.t_s):
                group.append(index)
                break
        else:
            groups.append([index])
    return groups


@dataclass(frozen=True)
class _Images:
    """Accelerations that images and encoder show, on a common time grid.

    grid : n times.
    cameras : (camera index, "marks" or "bubbles", accelerations (n, 2)).
    encoder : acceleration (n, 1) of the carriage along its axis; None without an encoder.
    """

    grid: Grid
    cameras: tuple[tuple[int, str, Accelerations], ...]
    encoder: Accelerations | None

    @classmethod
    def of(cls, problem: SmoothingProblem) -> _Images | None:
        """Return the accelerations of a problem.

        Returns None for a run that is too short, a frame rate too low to show shake, or no
        detections.
        """
        noise = _noise_mm(problem)
        pace = float(np.median(np.diff(problem.t_s)))
        if noise is None or pace > _SLOWEST_S or np.ptp(problem.t_s) > _MOST_STEPS * pace:
            return None

        def sensed_rms(grid: Grid) -> float:
            rms = [_readings(grid, s).values.std(0).max() for s in problem.accelerometers]
            return float(min(rms))

        grid = frame_grid(problem.t_s, noise, sensed_rms if problem.accelerometers else None)
        if grid.count < 8 * grid.knots:
            return None
        seen = (("marks", problem.references), ("bubbles", problem.observations))
        cameras = []
        for index, camera in enumerate(problem.cameras):
            for source, observed in seen:
                mine = observed.camera == index
                if mine.any():
                    part = observed.of(mine)
                    found = accelerations(
                        grid, problem.t_s, camera, part.item, part.frame, part.uv_px
                    )
                    if found.known.any():
                        cameras.append((index, source, found))
        stage, encoder = problem.stage, None
        if stage is not None and len(stage.t_s) > 1:
            encoder = of_positions(grid, stage.t_s, stage.position_mm[:, None])
            if not encoder.known.any() or not np.ptp(stage.position_mm) > 0:
                encoder = None
        return cls(grid, tuple(cameras), encoder) if cameras else None

    def channels(
        self, problem: SmoothingProblem, group: Sequence[int], *, images_alone: bool = False
    ) -> list[Channel]:
        """Return the accelerations that a group of sensors has to explain: images and encoder.

        group : indices of the sensors.
        images_alone : leave out the encoder.
        """
        mounts = {i: problem.accelerometers[i].camera for i in group}
        number = {i: n for n, i in enumerate(group)}
        out = []
        for camera, source, seen in self.cameras:
            name = f"{source} in camera {problem.cameras[camera].name}"
            mounted = tuple(number[i] for i in group if mounts[i] in (camera, CARRIAGE))
            if mounted:
                out += [
                    Channel(f"{name}, {way}", seen.values[:, k], seen.known, mounted)
                    for k, way in enumerate(("along rows", "along columns"))
                ]
        for source in ("marks", "bubbles"):
            for name, values, known, two in self.differences(problem, source):
                carried = [i for i in group if mounts[i] in two]
                if {mounts[i] for i in carried} == set(two):
                    out.append(Channel(name, values, known, tuple(number[i] for i in carried)))
        if self.encoder is not None and not images_alone:
            out += [
                Channel(f"encoder, {problem.accelerometers[i].name}", self.encoder.values[:, 0],
                        self.encoder.known, (number[i],))
                for i in group
            ]  # fmt: skip
        return out

    def differences(
        self, problem: SmoothingProblem, source: str
    ) -> list[tuple[str, Array, Bools, tuple[int, int]]]:
        """Return the differential accelerations of each pair of cameras along their shared
        direction.

        In the difference the motion of the observed points cancels.

        Returns (name, values (n,), known (n,), indices of both cameras).
        """
        seen = {camera: a for camera, kind, a in self.cameras if kind == source}
        out = []
        for first in seen:
            for second in (c for c in seen if c > first):
                shared = shared_rows(problem, first, second)
                both = np.concatenate([seen[first].values, seen[second].values], 1)
                names = [problem.cameras[c].name for c in (first, second)]
                out.append(
                    (
                        f"{source}, cameras {names[0]} and {names[1]} against each other",
                        both @ shared,
                        seen[first].known & seen[second].known,
                        (first, second),
                    )
                )
        return out

    def encoder_alignment(self, problem: SmoothingProblem) -> Alignment | None:
        """Return the offset of the encoder's clock, by the images' acceleration along the travel
        axis.
        """
        if self.encoder is None:
            return None
        channels = [
            Channel(f"{source} in camera {problem.cameras[c].name}", values, seen.known, (0,))
            for c, source, seen in self.cameras
            if (values := along_axis(problem, c, seen)) is not None
        ]
        return align(self.grid, channels, [self.encoder], SAME_CLOCK_S) if channels else None


def shared_rows(problem: SmoothingProblem, first: int, second: int) -> Array:
    """Return the combination (4,) of two cameras' image directions in which a point's motion
    cancels.
    """
    seen = np.concatenate([directions(problem.cameras[c]) for c in (first, second)])
    return np.asarray(np.linalg.svd(seen)[0][:, 3])


def along_axis(problem: SmoothingProblem, camera: int, seen: Accelerations) -> Array | None:
    """Return a camera's acceleration (n,) along the travel axis; None if it looks along that
    axis."""
    axis = directions(problem.cameras[camera]) @ problem.axis
    size = float(axis @ axis)
    return np.asarray(seen.values @ axis / size) if size > 0.1 else None


def _noise_mm(problem: SmoothingProblem) -> float | None:
    """Return the smaller sd of the mean position of marks or bubbles in a frame."""
    found = []
    for observed in (problem.references, problem.observations):
        if len(observed):
            scale = np.mean([c["scale_px_per_mm"] for c in problem.cameras])
            sd = np.sqrt(np.median(observed.covariance_px2[:, 0, 0])) / scale
            each = len(observed) / (len(np.unique(observed.frame)) * len(problem.cameras))
            found.append(float(sd / np.sqrt(max(each, 1.0))))
    return min(found, default=None)


def _readings(grid: Grid, sensor: Accelerometer) -> Accelerations:
    used = sensor if sensor.kept is None else sensor.of(sensor.kept)
    readings = used.reading_mm_s2.copy()
    readings[:, list(used.unused_axes)] = 0.0
    return of_readings(grid, used.t_s, readings, sensor.t_s)


def _of_images(
    problem: SmoothingProblem, images: _Images, encoder: Alignment | None
) -> Iterator[Alignment]:
    """Yield the alignments of encoder and accelerometers with the images alone."""
    if encoder is not None:
        yield encoder
    for group in _groups(problem):
        found = _clock(problem, images, group, images_alone=True)
        if found is not None:
            yield found


def _clock(
    problem: SmoothingProblem,
    images: _Images,
    group: list[int],
    *,
    images_alone: bool = False,
    beside: Sequence[Accelerometer] = (),
) -> Alignment | None:
    """Return the clock offset of a group of sensors; None if it cannot be computed.

    images_alone : do not compare with the encoder.
    beside : sensors on the clock of the frames to compare with as well.
    """
    sensors = [problem.accelerometers[i] for i in group]
    channels = images.channels(problem, group, images_alone=images_alone)
    for other in beside:
        values, known = _at_frames(images, other)
        force = values @ other.axes
        channels += [
            Channel(f"{other.name}, {axis}, {n}", force[:, k], known, (n,))
            for k, axis in enumerate("xyz")
            for n in range(len(group))
        ]
    found = None
    if all(s.clock == "frames" for s in sensors):
        near = [near_frames(s, problem.t_s, _SHARED_S) for s in sensors]
        found = _aligned_by(images, channels, near)
        if found is not None and found.at_zero:
            sensors = near
    if found is None or not found.at_zero:
        found = _aligned_by(images, channels, sensors)
    if found is None or images_alone:
        return found
    return _between_steps(found, problem, images, channels, sensors)


def _between_steps(
    found: Alignment,
    problem: SmoothingProblem,
    images: _Images,
    channels: Sequence[Channel],
    sensors: Sequence[Accelerometer],
) -> Alignment:
    """Refine a unique offset by repeated alignment of the shifted records.

    One alignment interpolates between the lags of the grid, with an error of up to a tenth of a
    step.
    """
    step_s = images.grid.step_s
    if not found.unique:
        return found
    for _ in range(_MOST_REFINEMENTS):
        moved = [replace(s, t_s=s.t_s - found.offset_s) for s in sensors]
        near = [near_frames(s, problem.t_s, _WINDOW_MARGIN_S) for s in moved]
        again = _aligned_by(images, channels, near)
        if again is None or not abs(again.offset_s) < step_s or not np.isfinite(again.sd_s):
            break
        found = replace(found, offset_s=found.offset_s + again.offset_s, sd_s=again.sd_s)
        if abs(again.offset_s) < 0.2 * again.sd_s:
            break
    return found


def _aligned_by(
    images: _Images, channels: Sequence[Channel], sensors: Sequence[Accelerometer]
) -> Alignment | None:
    if min(len(s.t_s) for s in sensors) < _LEAST_SAMPLES:
        return None
    if max(float(np.median(np.diff(s.t_s))) for s in sensors) > _SLOWEST_S:
        return None
    readings = [_readings(images.grid, s) for s in sensors]
    if readings[0].grid.count < 8 * images.grid.knots:
        return None
    return align(images.grid, channels, readings, SAME_CLOCK_S)


def _unaligned(sensor: Accelerometer, t_s: Array) -> tuple[Accelerometer | None, list[Finding]]:
    """Return a sensor for which no comparison is possible: unchanged if it has the frames'
    clock."""
    where = f"accelerometer {sensor.name}"
    near = near_frames(sensor, t_s)
    if sensor.clock == "frames":
        if len(near.t_s) < 2:
            return None, [_left_out(where, "its record does not overlap the frames")]
        return near, []
    return None, [_left_out(where, "its clock is unknown, and no image shows the rig's motion")]


def _left_out(where: str, why: str) -> Finding:
    return Finding(
        f"{why}: it is not used", where,
        'put its times on the clock of the frames and state clock = "frames", or tap the arm or '
        "start the stage within both records",
    )  # fmt: skip


def _keeps_clock(sensor: Accelerometer, clock: Alignment | None) -> bool:
    """Return whether the images confirm a sensor that is stated to be on the frames' clock."""
    return sensor.clock == "frames" and clock is not None and clock.at_zero


def _placed(
    sensor: Accelerometer, clock: Alignment | None, problem: SmoothingProblem
) -> tuple[Accelerometer | None, list[Finding]]:
    """Return a sensor on the clock of the frames, or None if it is left out, and findings."""
    where = f"accelerometer {sensor.name}"
    shared = sensor.clock == "frames"
    if clock is not None and _keeps_clock(sensor, clock):
        near_zero = abs(clock.offset_s) <= SAME_CLOCK_S
        return replace(sensor, confirmed=True, offset_sd_s=clock.sd_s if near_zero else None), []
    if clock is not None and clock.unique:
        moved = replace(
            sensor, t_s=sensor.t_s - clock.offset_s, offset_s=clock.offset_s,
            offset_sd_s=clock.sd_s, confirmed=True,
        )  # fmt: skip
        findings = []
        if shared and abs(clock.offset_s) > max(SAME_CLOCK_S, _DIFFERENT_SDS * clock.sd_s):
            findings.append(
                Finding(
                    f"its clock is {abs(clock.offset_s):.4f} ± {clock.sd_s:.4f} s "
                    f"{'ahead of' if clock.offset_s > 0 else 'behind'} that of the frames, judged "
                    "by the motion in the images; its times have been corrected",
                    where,
                    "if this accelerometer has a clock of its own, state clock = \"unknown\" in "
                    f"rig.toml [accelerometers.{sensor.name}]",
                )
            )  # fmt: skip
        return moved, findings
    if shared:
        if len(near_frames(sensor, problem.t_s).t_s) < 2:
            return None, [_left_out(where, "its record does not overlap the frames")]
        words = "the images cannot confirm that its clock is that of the frames"
        return replace(sensor, confirmed=False), [Finding(words, where)]
    return None, [_left_out(where, _unconfirmed_words(clock))]


def _unconfirmed_words(clock: Alignment | None) -> str:
    """Return why the offset of an unknown clock is not accepted."""
    if clock is None:
        return (
            "its clock is unknown, and its record is too short or too slow to be compared with the "
            "images"
        )
    if not clock.connected:
        return "its clock is unknown, and there is no offset at which its readings fit the images"
    if clock.at_end:
        return (
            f"its clock is unknown, and the offset that fits best, {clock.offset_s:.3f} s, is the "
            "last one that the record permits, so the true one may be beyond it"
        )
    return (
        f"its clock is unknown, and offsets of {clock.offset_s:.3f} and {clock.runner_up_s:.3f} s "
        "fit the images equally well, as happens if the shake has only one frequency"
    )


def _without_drift(
    sensors: Sequence[Accelerometer], group: list[int], problem: SmoothingProblem, images: _Images
) -> tuple[Sequence[Accelerometer], list[Finding]]:
    """Correct the drift of a clock if the run is long enough and this explains the images
    better."""
    t = problem.t_s
    channels = images.channels(problem, group)

    def log_ratio(some: Sequence[Accelerometer]) -> float:
        near = [near_frames(s, t, _WINDOW_MARGIN_S) for s in some]
        found = _aligned_by(images, channels, near)
        return -np.inf if found is None else found.log_ratio

    best = sensors
    for _ in range(_MOST_REFINEMENTS if t[-1] - t[0] >= _LONG_S else 0):
        sds, needed = (_DIFFERENT_SDS, LEAST_LOG_RATIO) if best is sensors else (1.0, 0.0)
        corrected = _corrected_drift(best, t, channels, images, sds)
        if corrected is None or not log_ratio(corrected) > log_ratio(best) + needed:
            break
        best = corrected
    if best is sensors:
        return sensors, []
    words = (
        f"its clock drifts by {best[0].drift_ppm:+.0f} ppm against that of the frames; corrected"
    )
    return best, [Finding(words, f"accelerometer {s.name}") for s in best]


def _corrected_drift(
    sensors: Sequence[Accelerometer],
    t_s: Array,
    channels: Sequence[Channel],
    images: _Images,
    least_sds: float,
) -> list[Accelerometer] | None:
    """Return the sensors corrected for the drift of their offsets over the run, or None without
    one.
    """
    length_s, stamps = float(t_s[-1] - t_s[0]), sensors[0].t_s
    windows = max(round(length_s / _WINDOW_S), LEAST_PARTS)
    edges = np.linspace(t_s[0], t_s[-1], windows + 1)
    middles, found = [], []
    for low, high in pairwise(edges):
        near = (stamps > low - _WINDOW_MARGIN_S) & (stamps < high + _WINDOW_MARGIN_S)
        first, last = (round((e - t_s[0]) / images.grid.step_s) for e in (low, high))
        grid = replace(images.grid, start_s=t_s[0] + first * images.grid.step_s, count=last - first)
        parts = [
            replace(c, values=c.values[first:last], known=c.known[first:last]) for c in channels
        ]
        if np.count_nonzero(near) < _LEAST_SAMPLES:
            continue
        readings = [_readings(grid, s.of(near)) for s in sensors]
        one = align(grid, parts, readings, SAME_CLOCK_S)
        if one is not None:
            middles.append((low + high) / 2)
            found.append(one)
    line = drift_of(np.array(middles), found, images.grid.step_s, _MOST_DRIFT)
    if line is None or abs(line[1]) < least_sds * line[2]:
        return None
    shift, drift, _ = line
    middle = float(np.mean(middles))
    return [
        replace(
            s, t_s=s.t_s - shift - drift * (s.t_s - middle),
            drift_ppm=s.drift_ppm + float(1e6 * drift), offset_s=s.offset_s + float(shift),
        )
        for s in sensors
    ]  # fmt: skip


def _at_frames(images: _Images, sensor: Accelerometer) -> tuple[Array, Bools]:
    """Return a sensor's smoothed readings (n, 3) on the images' grid, and which are known (n,)."""
    found = _readings(images.grid, sensor)
    if found.grid.count < 2:
        return np.zeros((images.grid.count, 3)), np.zeros(images.grid.count, bool)
    return found.at(images.grid.t_s)


def _mountings(
    problem: SmoothingProblem, images: _Images, refused: Sequence[Finding],
    log_evidence: LogEvidence,
) -> list[Finding]:  # fmt: skip
    """Return findings about sensors whose axes or place contradict the other measurements.

    The clearest contradiction comes first. Axes that gravity allows are judged by the images of the
    sensor's own camera, with the other sensors where these images prefer other axes, and a
    correction has to make all measurements together at least as likely as before; where gravity
    excludes those stated, the encoder and the other sensors, corrected so far, help to choose.
    Scales are judged by gravity alone: in a short record a bubble that swings as fast as the rig
    shakes shows any.

    refused : earlier findings. Axes are not tested without gravity.
    """
    without = {f.fix.get("sensor") for f in refused if f.code == Code.SENSOR_GRAVITY}
    sensors = [
        s
        for s in problem.accelerometers
        if s.confirmed and not s.unused_axes and s.name not in without
    ]
    read = {s.name: _at_frames(images, s) for s in sensors}
    exchanged = _exchanged(problem, images, sensors, read, log_evidence)
    if exchanged is not None:
        return [exchanged]
    axes = {s.name: s.axes for s in sensors}
    findings: list[Finding] = []

    def judge(sensor: Accelerometer) -> Mounting:
        expected = _expected(problem, images, sensor, axes, read)
        at_rest = sensor.reading_mm_s2.mean(0)
        return mounting(sensor.axes, at_rest, problem.up, *read[sensor.name], expected)

    def log_evidence_of(axes: dict[str, Array]) -> float:
        return log_evidence(_with(problem, [replace(s, axes=axes[s.name]) for s in sensors]))

    judged = {s.name: judge(s) for s in sensors}
    for sensor in sorted(sensors, key=lambda s: -judged[s.name].lead):
        found = judge(sensor)
        if not found.clear:
            continue
        corrected = axes | {sensor.name: found.axes}
        if np.isfinite(found.lead) and log_evidence_of(corrected) < log_evidence_of(axes):
            continue
        axes = corrected
        findings.append(_axes_finding(sensor.name, found))
    return findings


def _axes_finding(name: str, found: Mounting) -> Finding:
    rows = np.round(found.axes, 6) + 0.0
    line = ", ".join("[" + ", ".join(f"{v:.4g}" for v in row) + "]" for row in rows)
    return Finding(
        "its axes do not fit what images, encoder and gravity show",
        f"accelerometer {name}",
        f"[accelerometers.{name}] axes = [{line}] would fit",
        Code.SENSOR_AXES,
        {"sensor": name, "axes": rows.tolist()},
    )


def _expected(
    problem: SmoothingProblem,
    images: _Images,
    sensor: Accelerometer,
    axes: dict[str, Array],
    read: dict[str, tuple[Array, Bools]],
) -> list[Expected]:
    """Return the accelerations that a sensor should measure, by images, encoder and other
    sensors."""
    out = []
    for camera, _, seen in images.cameras:
        if sensor.camera in (camera, CARRIAGE):
            out += [
                Expected(d, seen.values[:, k], seen.known, whole=sensor.camera == camera)
                for k, d in enumerate(directions(problem.cameras[camera]))
            ]
    if images.encoder is not None:
        out.append(
            Expected(
                problem.axis,
                images.encoder.values[:, 0],
                images.encoder.known,
                whole=sensor.camera == CARRIAGE,
            )
        )
    for other in problem.accelerometers:
        if other.name != sensor.name and other.name in read:
            values, known = read[other.name]
            force = values @ axes[other.name]
            out += [Expected(d, force @ d, known, whole=False) for d in np.eye(3)]
    return out


def _exchanged(
    problem: SmoothingProblem,
    images: _Images,
    sensors: Sequence[Accelerometer],
    read: dict[str, tuple[Array, Bools]],
    log_evidence: LogEvidence,
) -> Finding | None:
    """Return a finding if the records of two cameras' sensors fit better when exchanged.

    In a short record a bubble's own motion fits either; all measurements together have to, too.
    """

    def log_evidence_of(*exchanged: Accelerometer) -> float:
        others = {s.name: s for s in (*sensors, *exchanged)}
        return log_evidence(_with(problem, list(others.values())))

    for i, one in enumerate(sensors):
        for two in sensors[i + 1 :]:
            if CARRIAGE in (one.camera, two.camera) or one.camera == two.camera:
                continue
            new_one = replace(one, camera=two.camera, axes=two.axes)
            new_two = replace(two, camera=one.camera, axes=one.axes)
            if (
                _fits_exchanged(problem, images, one, two, read)
                and log_evidence_of(new_one, new_two) > log_evidence_of()
            ):
                names = f"{one.name} and {two.name}"
                return Finding(
                    "the images of each camera fit the readings of the other camera's sensor",
                    f"accelerometers {names}",
                    f"exchange mounted_on of {names}, or their records",
                    Code.SENSOR_MOUNT,
                    {"exchange": [one.name, two.name]},
                )
    return None


def _fits_exchanged(
    problem: SmoothingProblem,
    images: _Images,
    one: Accelerometer,
    two: Accelerometer,
    read: dict[str, tuple[Array, Bools]],
) -> bool:
    """Return whether two cameras' sensors fit clearly better with their records exchanged."""
    known = read[one.name][1] & read[two.name][1]
    readings = np.concatenate([read[one.name][0], read[two.name][0]], 1)
    axes = {one.camera: one.axes, two.camera: two.axes}
    seen = [
        (values.values[:, k], values.known, {c: d})
        for c, _, values in images.cameras
        if c in axes
        for k, d in enumerate(directions(problem.cameras[c]))
    ]
    for source in ("marks", "bubbles"):
        for _, differences, there, pair in images.differences(problem, source):
            if set(pair) == set(axes):
                weights = np.split(shared_rows(problem, *pair), 2)
                rows = (w @ directions(problem.cameras[c]) for c, w in zip(pair, weights))
                seen.append((differences, there, dict(zip(pair, rows))))
    fits = []
    for values, there, along in seen:
        fit = Regression.of(values, there & known, readings)
        if fit is not None:
            mounts = [axes[c] @ along.get(c, np.zeros(3)) for c in (one.camera, two.camera)]
            fits.append((fit, np.array([np.concatenate(mounts[::-1]), np.concatenate(mounts)])))
    return is_clear(lambda shift: sum((f.log_ratios(h, shift) for f, h in fits), np.zeros(2)))


def _encoder(
    problem: SmoothingProblem,
    images: _Images,
    clock: Alignment | None,
    refused: Sequence[Finding],
) -> list[Finding]:
    """Return findings about the encoder (stuck, or a wrong sign, unit or clock), the travel axis
    and the cameras' magnifications.

    clock : its alignment with the images.
    refused : earlier findings; the sensors that they concern are not compared with.
    """
    where = "stage"
    if problem.stage is None:
        return []
    stuck = _stuck(problem)
    if stuck:
        return stuck
    doubtful = {f.fix.get("sensor") for f in refused}
    sensors = [s for s in problem.accelerometers if s.confirmed and s.name not in doubtful]
    marks, common = MarkMotion.of(problem), None
    if marks is not None:
        found = marks.gain()
        gain, sd = float(found.value[0]), float(found.sd[0])
        usual = _USUAL_GAIN[0] < gain < _USUAL_GAIN[1]
        if not usual and found.excludes(0.0) and found.excludes(1.0):
            return [_gain_finding(gain, max(3 * sd / abs(gain), 0.02), sd, where)]
        wrong = list(_cameras(problem, marks))
        if wrong:
            return wrong
        if found.excludes(1.0) and abs(gain - 1) > _FAR * _stated_sigma(problem):
            off = _gain_finding(gain, 0.0, sd, where)
            todo = f"{off.todo}, state that it may be off so much (scale_sigma in rig.toml [stage])"
            return [replace(off, todo=f"{todo}, or calibrate magnifications that have changed")]
    elif images.encoder is not None:
        common = CommonGain.of(_responses(problem, images, images.encoder, sensors))
    if common is not None and (common.excludes(1.0) or common.opposed):
        gain = -common.gain if common.opposed else common.gain
        return [_gain_finding(gain, common.reach, common.gain * common.sd, where)]
    judged = clock is not None and clock.clear and len(problem.t_s) >= _LEAST_FRAMES
    if clock is not None and judged and abs(clock.offset_s) > 2 * SAME_CLOCK_S:
        return [
            Finding(
                f"its clock is {abs(clock.offset_s):.4f} ± {clock.sd_s:.4f} s "
                f"{'ahead of' if clock.offset_s > 0 else 'behind'} that of the frames, judged by "
                "the motion in the images",
                where,
                f"subtract {clock.offset_s:.6g} s from its times",
                Code.ENCODER_CLOCK,
                {"encoder_offset_s": -clock.offset_s},
            )
        ]
    return []


def _responses(
    problem: SmoothingProblem,
    images: _Images,
    encoder: Accelerations,
    sensors: Sequence[Accelerometer],
) -> list[Response]:
    """Return the responses of the cameras, as images and sensors show them, to the encoder."""
    shown = [
        (values, seen.known)
        for camera, _, seen in images.cameras
        if (values := along_axis(problem, camera, seen)) is not None
    ]
    for sensor in sensors:
        values, there = _at_frames(images, sensor)
        shown.append((values @ sensor.axes @ problem.axis, there))
    x = encoder.values[:, 0]
    return [Response.of(y, x, known & encoder.known) for y, known in shown]


def _cameras(problem: SmoothingProblem, marks: MarkMotion) -> Iterator[Finding]:
    """Yield what marks show of a magnification that has changed, and of a wrong travel axis."""
    for first, second in combinations(range(len(problem.cameras)), 2):
        found = marks.ratio(first, second)
        two = [problem.cameras[c] for c in (first, second)]
        depth = max(abs(c["kappa_per_mm"]) for c in two) * _depth_sigma_mm(problem)
        if found is None or not found.excludes(1.0):
            continue
        ratio, sd = float(found.value[0]), float(found.sd[0])
        if abs(ratio - 1) > _FAR * np.hypot(LENS_SIGMA, depth):
            yield Finding(
                f"marks move {ratio:.4f} ± {sd:.2g} times as far in it as in {two[0].name}, by the "
                "calibration: a magnification has changed",
                f"camera {two[1].name}", "check both lenses, and calibrate again",
                Code.CAMERA_SCALE,
            )  # fmt: skip
    basis = across(problem.axis)
    tilt = marks.tilt(basis)
    stated = 0.0 if problem.travel is None else float(np.sqrt(problem.travel.covariance[0, 0]))
    if tilt is not None and tilt.beyond(_FAR * max(stated, _AXIS_SIGMA)):
        axis = problem.axis + basis @ tilt.value
        axis /= np.linalg.norm(axis)
        angle = np.rad2deg(np.linalg.norm(tilt.value))
        line = ", ".join(f"{v:.5g}" for v in axis)
        yield Finding(
            f"the marks show that the stage moves {angle:.2g} degrees from the stated axis",
            "stage", f"[stage] axis = [{line}] would fit; or measure it (stage_axis/)",
            Code.STAGE_AXIS, {"stage_axis": axis.tolist()},
        )  # fmt: skip


def _stated_sigma(problem: SmoothingProblem) -> float:
    """Return the standard deviation of marks' motion over the encoder's, by what is stated of its
    scale and known of the lenses; infinite where its scale is assumed, so that it is estimated.
    """
    if problem.travel is None or problem.travel.source == "assumed":
        return np.inf
    depth = max(abs(c["kappa_per_mm"]) for c in problem.cameras) * _depth_sigma_mm(problem)
    return float(np.sqrt(LENS_SIGMA**2 + depth**2 + problem.travel.covariance[2, 2]))


def _depth_sigma_mm(problem: SmoothingProblem) -> float:
    return max((mark.sigma_mm for mark in problem.marks), default=0.0)


def _gain_finding(gain: float, reach: float, sd: float, where: str) -> Finding:
    """Return a finding that names the sign or unit which explains a gain.

    gain, sd : true motion over the encoder's, and its standard deviation. A gain that no unit
        explains is proposed as a factor only if it is known to 1 %.
    reach : largest difference of its logarithm from that of its unit.
    """
    units = {1000.0: "m", 25.4: "inches", 10.0: "cm", 0.001: "µm", 1.0: "mm"}
    size = min(units, key=lambda u: abs(np.log(abs(gain) / u)))
    named = abs(np.log(abs(gain) / size)) < reach and (size != 1.0 or gain < 0)
    factor = float(np.copysign(size, gain)) if named else gain
    seen = f"images and sensors show {gain:.4g} ± {sd:.2g} times the motion that it reads"
    if abs(gain) > _STANDS:
        seen = "it reads hardly any motion, but images and sensors show some"
    todo, fix = f"multiply position_mm by {factor:.6g}", {"encoder_factor": factor}
    if factor == -1.0:
        words, code = f"{seen}: its sign is turned", Code.ENCODER_SIGN
    elif named:
        words, code = f"{seen}: it reads {units[size]}, not mm", Code.ENCODER_UNIT
    else:
        words, code = f"{seen}: its scale is wrong", Code.ENCODER_SCALE
        if not sd < _KNOWN_GAIN * abs(gain):
            todo, fix = "check its unit, its counts per mm, and that t_s is in s", {}
    return Finding(words, where, todo, code, fix)


def _stuck(problem: SmoothingProblem) -> list[Finding]:
    """Return a finding if the encoder's reading is constant while the carriage must be moving."""
    stage = problem.stage
    if stage is None:
        return []
    t, x = stage.t_s, stage.position_mm
    inside = (t >= problem.t_s[0]) & (t <= problem.t_s[-1])
    t, x = t[inside], x[inside]
    if len(t) < 20:
        return []
    change = np.flatnonzero(np.diff(x) != 0)
    ends = np.r_[-1, change, len(x) - 1]
    longest = int(np.argmax(np.diff(ends)))
    first, last = int(ends[longest]) + 1, int(ends[longest + 1])
    length = float(t[last] - t[first])
    if length < _STUCK_S or last - first < 10:
        return []
    if len(change):
        around = np.r_[np.diff(x[: first + 1])[-10:], np.diff(x[last:])[:10]]
        pace = float(np.median(np.diff(t)))
        moving = len(around) > 0 and np.median(np.abs(around)) / pace > _MOVING_MM_S
    else:
        moving = _sweeps(problem)
    if not moving:
        return []
    return [
        Finding(
            f"the encoder reads {x[first]:.6g} mm from {t[first]:.6g} to {t[last]:.6g} s without "
            "any change, while the carriage moves: it is stuck",
            "stage",
            "leave those rows out or repair the encoder; without the stage's positions, positions "
            "and velocities are relative to the carriage",
            Code.ENCODER_STUCK,
        )
    ]


def _sweeps(problem: SmoothingProblem) -> bool:
    """Return whether the carriage moves according to the images, although the encoder is constant.

    It does if marks move through the images, or if there are none and all bubbles rest in them.
    """
    speeds = []
    for observed in (problem.references, problem.observations):
        for c, camera in enumerate(problem.cameras):
            mine = np.flatnonzero(observed.camera == c)
            axis = directions(camera) @ problem.axis
            if not len(mine) or axis @ axis < 0.1:
                continue
            place = camera.unproject(observed.uv_px[mine])[0] @ directions(camera).T @ axis
            for item in np.unique(observed.item[mine])[:50]:
                one = mine[observed.item[mine] == item]
                x, t = place[observed.item[mine] == item], problem.t_s[observed.frame[one]]
                if len(one) > 10:
                    speeds.append(abs(float(np.polyfit(t - t[0], x, 1)[0])))
        if speeds:
            fast = float(np.median(speeds)) > _MOVING_MM_S
            return fast if observed is problem.references else not fast
    return False


def _rise(problem: SmoothingProblem) -> list[Finding]:
    """Return a finding if the bubbles rise or sink faster than 3 m/s."""
    speeds = []
    for bubble in problem.bubbles:
        seconds = float(problem.t_s[bubble.last] - problem.t_s[bubble.first])
        if len(bubble) > 5 and seconds > 0:
            speeds.append(float((bubble.guess_mm[-1] - bubble.guess_mm[0]) @ problem.up) / seconds)
    if not speeds:
        return []
    rise = float(np.median(speeds))
    if abs(rise) <= _FASTEST_MM_S:
        return []
    return [
        Finding(
            f"the bubbles rise at {rise / 1000:.4g} m/s, which no bubble does",
            "stage and frames",
            "check the units of the frames' times and of the encoder",
            Code.RISE_SPEED,
        )
    ]


def _frame_times(problem: SmoothingProblem, as_stated: float) -> Finding | None:
    """Return a finding if the images agree with the sensors after scaling the frame times.

    as_stated : largest log-likelihood ratio of an alignment at the stated times.
    """
    if len(problem.t_s) < _LEAST_FRAMES:
        return None
    log_ratio: dict[float, float] = {}
    pace = float(np.median(np.diff(problem.t_s)))
    for factor in (f for f in _FRAME_FACTORS if f * pace > _FASTEST_S):
        trial = replace(problem, t_s=problem.t_s * factor)
        images = _Images.of(trial)
        if images is not None:
            found = _of_images(trial, images, images.encoder_alignment(trial))
            shift = abs(factor - 1) * abs(float(problem.t_s[0])) + SAME_CLOCK_S
            free = any(s.clock == "unknown" for s in problem.accelerometers)
            near = [c for c in found if free or abs(c.offset_s) < shift]
            log_ratio[factor] = sum(c.log_ratio for c in near if c.unique)
    best = max(log_ratio, key=lambda f: log_ratio[f], default=None)
    if best is None or not beyond_chance(log_ratio[best], as_stated, REFUSED):
        return None
    return Finding(
        f"the images agree with the sensors only if the times are multiplied by {best:g}: "
        + _FRAME_FACTORS[best],
        "times of the frames",
        f"multiply the times t_s of the frames by {best:g}, or correct the frame rate",
        Code.FRAME_TIMES,
        {"frame_time_factor": best},
    )
