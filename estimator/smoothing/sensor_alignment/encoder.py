"""The encoder against images and sensors: its sign, unit, scale and clock.

Where there are marks, they also show the travel axis and the cameras' magnifications.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from telerig.estimator.sensors.alignment import Alignment
from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.sensors.response import FAR_SDS, CommonGain, Response
from telerig.estimator.smoothing.problem.problem import Accelerometer, SmoothingProblem
from telerig.estimator.smoothing.sensor_alignment.clocks import LEAST_FRAMES, SAME_CLOCK_S
from telerig.estimator.smoothing.sensor_alignment.images import Images, along_axis, read_at_frames
from telerig.estimator.smoothing.sensor_alignment.mark_motion import LENS_SIGMA, MarkMotion
from telerig.estimator.smoothing.sensor_alignment.stuck_encoder import stuck, unfollowed
from telerig.rig.pose import across

_KNOWN_GAIN = 0.01
"""A factor that no unit explains is proposed if it is known to 1 %."""

_STANDS = 1e5
"""An encoder that reads less than a hundredth of its motion in metres stands still; a gain would
only be the noise of its numbers."""

_ASSUMED_SIGMA = 0.1
"""Standard deviation of an encoder's scale that is not stated: it is estimated from the marks."""

_AXIS_SIGMA = 3e-3
"""Standard deviation (rad) of a travel axis that is stated and not measured."""


def encoder_findings(
    problem: SmoothingProblem,
    images: Images,
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
    halted = stuck(problem)
    if halted:
        return halted
    doubtful = {f.fix.get("sensor") for f in refused}
    sensors = [s for s in problem.accelerometers if s.confirmed and s.name not in doubtful]
    marks, common = MarkMotion.of(problem), None
    if marks is not None:
        found = marks.gain()
        wrong = list(_cameras(problem, marks))
        if wrong:
            return wrong
        gain, sd, least = *found.first, FAR_SDS * _stated_sigma(problem)
        if found.excludes(0.0) and found.excludes(1.0) and abs(gain - 1) > least:
            return [_gain_finding(gain, max(FAR_SDS * sd / abs(gain), least), sd, where)]
        halted = unfollowed(problem)
        if halted:
            return halted
    elif images.encoder is not None:
        common = CommonGain.of(_responses(problem, images, sensors))
    if common is not None and (common.excludes(1.0) or common.opposed):
        gain = -common.gain if common.opposed else common.gain
        return [_gain_finding(gain, common.reach, common.gain * common.sd, where)]
    judged = clock is not None and clock.clear and len(problem.t_s) >= LEAST_FRAMES
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
    problem: SmoothingProblem, images: Images, sensors: Sequence[Accelerometer]
) -> list[Response]:
    """Return the responses of the cameras, as images and sensors show them, to the encoder."""
    at_frame = images.at_frames()
    encoder = at_frame.encoder
    assert encoder is not None, "the caller has looked"
    shown = [
        (values, seen.known)
        for camera, _, seen in at_frame.cameras
        if (values := along_axis(problem, camera, seen)) is not None
    ]
    for sensor in sensors:
        values, there = read_at_frames(images, sensor)
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
        ratio, sd = found.first
        if abs(ratio - 1) > FAR_SDS * np.hypot(LENS_SIGMA, depth):
            yield Finding(
                f"marks move {ratio:.4f} ± {sd:.2g} times as far in it as in {two[0].name}, by the "
                "calibration: a magnification has changed",
                f"camera {two[1].name}", "check both lenses, and calibrate again",
                Code.CAMERA_SCALE,
            )  # fmt: skip
    basis = across(problem.axis)
    tilt = marks.tilt(basis)
    stated = 0.0 if problem.travel is None else float(np.sqrt(problem.travel.covariance[0, 0]))
    if tilt is not None and tilt.beyond(FAR_SDS * max(stated, _AXIS_SIGMA)):
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
    scale and known of the lenses.
    """
    if problem.travel is None or problem.travel.source == "assumed":
        return _ASSUMED_SIGMA
    depth = max(abs(c["kappa_per_mm"]) for c in problem.cameras) * _depth_sigma_mm(problem)
    return float(np.sqrt(LENS_SIGMA**2 + depth**2 + problem.travel.covariance[2, 2]))


def _depth_sigma_mm(problem: SmoothingProblem) -> float:
    return max((mark.sigma_mm for mark in problem.marks), default=0.0)


def _gain_finding(gain: float, reach: float, sd: float, where: str) -> Finding:
    """Return a finding that names the sign or unit which explains a gain.

    gain, sd : true motion over the encoder's, and its standard deviation.
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
        todo += (
            ", state that it may be off so much (scale_sigma in rig.toml [stage]), or calibrate "
            "magnifications that have changed"
        )
    return Finding(words, where, todo, code, fix)
