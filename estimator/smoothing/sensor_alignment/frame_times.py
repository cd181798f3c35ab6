"""Times of the frames, or units, with which images and sensors cannot agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from telerig.estimator.sensors.alignment import REFUSED, beyond_chance
from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.smoothing.problem.problem import SmoothingProblem
from telerig.estimator.smoothing.sensor_alignment.clocks import (
    LEAST_FRAMES,
    SAME_CLOCK_S,
    clocks_by_images,
    encoder_clock,
)
from telerig.estimator.smoothing.sensor_alignment.images import Images

_FRAME_FACTORS = {
    1e-3: "they are in milliseconds",
    0.5: "the stated frame rate is half the true one",
    2.0: "the stated frame rate is twice the true one",
}
_FASTEST_S = 2e-5
_FASTEST_MM_S = 3000.0


def fast_rise(problem: SmoothingProblem) -> list[Finding]:
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


def frame_times(problem: SmoothingProblem, as_stated: float) -> Finding | None:
    """Return a finding if the images agree with the sensors after scaling the frame times.

    as_stated : largest log-likelihood ratio of an alignment at the stated times.
    """
    if len(problem.t_s) < LEAST_FRAMES:
        return None
    log_ratio: dict[float, float] = {}
    pace = float(np.median(np.diff(problem.t_s)))
    for factor in (f for f in _FRAME_FACTORS if f * pace > _FASTEST_S):
        trial = replace(problem, t_s=problem.t_s * factor)
        images = Images.of(trial)
        if images is not None:
            found = clocks_by_images(trial, images, encoder_clock(trial, images))
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
