"""Compares the sensors of a run with its images: clocks, mounting, units, encoder, frame times.

In: a `SmoothingProblem` with complete sensor records. Out: the problem with each record on the
clock of the frames and cut to them, and findings. The regressions are in
`telerig.estimator.sensors`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from telerig.estimator.sensors.alignment import Alignment
from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.sensors.response import FAR_SDS
from telerig.estimator.smoothing.problem.problem import Accelerometer, SmoothingProblem
from telerig.estimator.smoothing.problem.sensor_records import near_frames
from telerig.estimator.smoothing.sensor_alignment.clocks import (
    clock_of,
    clocks,
    clocks_by_images,
    encoder_clock,
    in_place,
    placed_on_frames,
    sure,
    unaligned,
)
from telerig.estimator.smoothing.sensor_alignment.drift import without_drift
from telerig.estimator.smoothing.sensor_alignment.encoder import encoder_findings
from telerig.estimator.smoothing.sensor_alignment.frame_times import fast_rise, frame_times
from telerig.estimator.smoothing.sensor_alignment.images import Images
from telerig.estimator.smoothing.sensor_alignment.mountings import LogEvidence, mounting_findings
from telerig.estimator.smoothing.sensor_alignment.stuck_encoder import stuck


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
    images, wrong = Images.of(problem), None
    encoder = None if images is None else encoder_clock(problem, images)
    findings: list[Finding]
    seen = iter(()) if images is None else clocks_by_images(problem, images, encoder)
    elsewhere = 0.0
    for one in seen:
        if one.connected and in_place(one, encoder, problem):
            break
        elsewhere = max(elsewhere, one.log_ratio)
    else:
        wrong = frame_times(problem, elsewhere)
        if wrong is not None:
            images = None
    if images is None:
        sensors = [unaligned(s, problem.t_s) for s in problem.accelerometers]
        findings = [*([] if wrong is None else [wrong]), *(f for _, said in sensors for f in said)]
        findings += [*stuck(problem), *fast_rise(problem)] if wrong is None else []
        return _with(problem, [s for s, _ in sensors if s is not None]), findings
    findings = []
    placed: dict[int, Accelerometer] = {}
    late = [] if encoder is None else [encoder]
    for group, clock in clocks(problem, images):
        if not sure(clock):
            beside = [s for s in placed.values() if s.confirmed]
            clock = clock_of(problem, images, group, beside=beside) or clock
        if clock is not None and all(problem.accelerometers[i].clock == "frames" for i in group):
            late.append(clock)
        for index in group:
            sensor, found = placed_on_frames(problem.accelerometers[index], clock, problem)
            findings += found
            if sensor is not None:
                placed[index] = sensor
        known = [i for i in group if i in placed and placed[i].confirmed]
        if known:
            corrected, found = without_drift([placed[i] for i in known], known, problem, images)
            placed.update(zip(known, corrected))
            findings += found
    problem = _with(problem, [placed[i] for i in sorted(placed)])
    problem = _with_late_images(problem, late)
    findings += mounting_findings(problem, images, refused, log_evidence)
    findings += encoder_findings(problem, images, encoder, [*refused, *findings])
    findings += fast_rise(problem)
    near = [near_frames(s, problem.t_s) for s in problem.accelerometers]
    return _with(problem, near), findings


def _with_late_images(problem: SmoothingProblem, clocks: Sequence[Alignment]) -> SmoothingProblem:
    """Return the problem with an encoder that may be as late as records on the frames' clock are.

    A delay of the images is one of all these records. The arms answer the stage with a delay of
    their own, so that what the images show of the encoder's is no correction of it.
    """
    if problem.stage is None:
        return problem
    shown = [c.offset_s for c in clocks if c.unique and abs(c.offset_s) > FAR_SDS * c.sd_s]
    sigma = np.hypot(problem.stage.delay_sigma_s, max(map(abs, shown), default=0.0))
    return replace(problem, stage=replace(problem.stage, delay_sigma_s=float(sigma)))


def _with(problem: SmoothingProblem, sensors: Sequence[Accelerometer]) -> SmoothingProblem:
    return replace(problem, accelerometers=tuple(sensors))
