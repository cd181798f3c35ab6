"""The clocks of encoder and accelerometers: their offsets from the frames', by the images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from telerig.arrays import Array
from telerig.estimator.sensors.alignment import LEAST_SAMPLES, Alignment, Channel, align
from telerig.estimator.sensors.findings import Finding
from telerig.estimator.smoothing.problem.problem import (
    DELAY_SIGMA_S,
    Accelerometer,
    SmoothingProblem,
)
from telerig.estimator.smoothing.problem.sensor_records import near_frames
from telerig.estimator.smoothing.sensor_alignment.images import (
    SLOWEST_S,
    Images,
    along_axis,
    readings_on,
)

SAME_CLOCK_S = 3 * DELAY_SIGMA_S
"""Largest offset of a clock that counts as that of the frames."""

LEAST_FRAMES = 150
"""In a run with fewer frames no clock is refused, nor the times of the frames."""

MOST_REFINEMENTS = 6
_SHARED_S = 2.0
"""Before and after the frames, so much of a record is searched first whose clock is the frames'."""


def clocks_by_images(
    problem: SmoothingProblem, images: Images, encoder: Alignment | None
) -> Iterator[Alignment]:
    """Yield the alignments of encoder and accelerometers with the images alone."""
    if encoder is not None:
        yield encoder
    for group in groups(problem):
        found = clock_of(problem, images, group, images_alone=True)
        if found is not None:
            yield found


def encoder_clock(problem: SmoothingProblem, images: Images) -> Alignment | None:
    """Return the offset of the encoder's clock, by the images' acceleration along its axis."""
    if images.encoder is None:
        return None
    channels = [
        images.channel(values, seen.known, (0,))
        for c, _, seen in images.cameras
        if (values := along_axis(problem, c, seen)) is not None
    ]
    return align(images.grid, channels, [images.encoder], SAME_CLOCK_S) if channels else None


def in_place(clock: Alignment, encoder: Alignment | None, problem: SmoothingProblem) -> bool:
    """Return whether a clock's offset is near 0, or unknown before the alignment."""
    free = clock is not encoder and any(s.clock == "unknown" for s in problem.accelerometers)
    return free or abs(clock.offset_s) < 2 * SAME_CLOCK_S


def sure(clock: Alignment | None) -> bool:
    return clock is not None and (clock.unique or clock.at_zero)


def clocks(problem: SmoothingProblem, images: Images) -> list[tuple[list[int], Alignment | None]]:
    """Return groups of sensors with their clocks, the most significant first.

    Sensors with equal time stamps are aligned together, or one by one if that fails.
    """
    out = []
    for group in groups(problem):
        clock = clock_of(problem, images, group)
        if sure(clock) or len(group) == 1:
            out.append((group, clock))
            continue
        out += [([index], clock_of(problem, images, [index])) for index in group]
    return sorted(out, key=lambda g: -(g[1].log_ratio if g[1] is not None else 0.0))


def groups(problem: SmoothingProblem) -> list[list[int]]:
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


def clock_of(
    problem: SmoothingProblem,
    images: Images,
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
        values, known = images.read_by(other)
        force = values @ other.axes
        numbers = range(len(group))
        channels += [images.channel(f, known, (n,)) for f in force.T for n in numbers]
    found = None
    if all(s.clock == "frames" for s in sensors):
        near = [near_frames(s, problem.t_s, _SHARED_S) for s in sensors]
        found = aligned_by(images, channels, near)
        if found is not None and found.at_zero:
            sensors = near
    if found is None or not found.at_zero:
        found = aligned_by(images, channels, sensors)
    if found is None or images_alone:
        return found
    return _between_steps(found, problem, images, channels, sensors)


def _between_steps(
    found: Alignment,
    problem: SmoothingProblem,
    images: Images,
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
    for _ in range(MOST_REFINEMENTS):
        moved = [replace(s, t_s=s.t_s - found.offset_s) for s in sensors]
        near = [near_frames(s, problem.t_s) for s in moved]
        again = aligned_by(images, channels, near)
        if again is None or not abs(again.offset_s) < step_s or not np.isfinite(again.sd_s):
            break
        found = replace(found, offset_s=found.offset_s + again.offset_s, sd_s=again.sd_s)
        if abs(again.offset_s) < 0.2 * again.sd_s:
            break
    return found


def aligned_by(
    images: Images, channels: Sequence[Channel], sensors: Sequence[Accelerometer]
) -> Alignment | None:
    if min(len(s.t_s) for s in sensors) < LEAST_SAMPLES:
        return None
    if max(float(np.median(np.diff(s.t_s))) for s in sensors) > SLOWEST_S:
        return None
    readings = [readings_on(images.grid, s) for s in sensors]
    if readings[0].grid.count < 8 * images.grid.knots:
        return None
    return align(images.grid, channels, readings, SAME_CLOCK_S)


def unaligned(sensor: Accelerometer, t_s: Array) -> tuple[Accelerometer | None, list[Finding]]:
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


def keeps_clock(sensor: Accelerometer, clock: Alignment | None) -> bool:
    """Return whether the images confirm a sensor that is stated to be on the frames' clock."""
    return sensor.clock == "frames" and clock is not None and clock.at_zero


def placed_on_frames(
    sensor: Accelerometer, clock: Alignment | None, problem: SmoothingProblem
) -> tuple[Accelerometer | None, list[Finding]]:
    """Return a sensor on the clock of the frames, or None if it is left out, and findings."""
    where = f"accelerometer {sensor.name}"
    shared = sensor.clock == "frames"
    if clock is not None and keeps_clock(sensor, clock):
        near_zero = abs(clock.offset_s) <= SAME_CLOCK_S
        return replace(sensor, confirmed=True, offset_sd_s=clock.sd_s if near_zero else None), []
    if clock is not None and (clock.clear if shared else clock.unique):
        moved = replace(
            sensor, t_s=sensor.t_s - clock.offset_s, offset_s=clock.offset_s,
            offset_sd_s=clock.sd_s, confirmed=True,
        )  # fmt: skip
        findings = []
        if shared and abs(clock.offset_s) > SAME_CLOCK_S:
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
