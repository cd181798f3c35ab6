"""Whether the checks before the solution mend a fault, from the problem that they make."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_fault_judging import ROUNDS, Class, Outcome
from sensor_fault_kinds import Inputs, repaired

from telerig.errors import TelerigError
from telerig.estimator.sensors.findings import SensorError, settled
from telerig.estimator.smoothing.problem.problem import SmoothingProblem
from telerig.estimator.smoothing.smooth import problem_of, with_sensors_aligned

Array = NDArray[np.float64]

ALIKE, ALIKE_MM_S2 = 0.05, 300.0
"""Largest difference of two records of a sensor, relative to its RMS, and of their medians (the
bias is a variable)."""
MOST_SPOILT_MM_S2 = 500.0
"""Largest difference of single samples that are used."""
MOST_LOST = 0.01
"""Largest share of a record's samples that are masked, within the frames."""


def checked(inputs: Inputs) -> SmoothingProblem:
    """What `telerig.smooth` would solve. Raises what it would raise before."""
    given = {k: v for k, v in inputs.items() if k not in ("tracks", "calibration")}
    problem, _, _, known = problem_of(inputs["tracks"], inputs["calibration"], **given)
    problem, found = with_sensors_aligned(problem, known)
    settled(found, frozenset())
    return problem


def mended_by_checks(inputs: Inputs, clean: SmoothingProblem) -> Outcome:
    """MENDED if the checks, with the corrections that refusals propose, make the problem that an
    undisturbed run gives; OPEN if only the solution can tell.
    """
    begin = time.perf_counter()
    codes: list[str] = []
    fixes: list[str] = []

    def outcome(kind: Class, said: str = "") -> Outcome:
        return Outcome(
            kind, codes=tuple(codes), fixes=tuple(fixes), said=said,
            seconds=time.perf_counter() - begin,
        )  # fmt: skip

    for _ in range(ROUNDS):
        try:
            problem = checked(inputs)
        except SensorError as error:
            codes.append(error.code)
            fix = dict(error.findings[0].fix) if error.findings else {}
            mended = repaired(inputs, fix)
            if mended is None:
                return outcome(Class.OPEN, str(error))
            fixes.append(json.dumps(fix, default=lambda a: np.asarray(a).tolist()))
            inputs = mended
        except TelerigError as error:
            return outcome(Class.OPEN, str(error))
        except Exception as error:  # noqa: BLE001 - to be counted is what they are here for
            return outcome(Class.BARE, f"{type(error).__name__}: {error}")
        else:
            return outcome(Class.MENDED if alike(problem, clean) else Class.OPEN)
    return outcome(Class.OPEN)


def alike(one: SmoothingProblem, two: SmoothingProblem) -> bool:
    """Whether two problems have the same frames, encoder and sensors, to what the noise hides."""
    if not np.allclose(one.t_s, two.t_s, rtol=1e-9, atol=1e-9):
        return False
    if not np.allclose(one.encoder_mm, two.encoder_mm, rtol=1e-6, atol=0.05):
        return False
    first, second = ({s.name: s for s in p.accelerometers} for p in (one, two))
    return first.keys() == second.keys() and all(
        _alike_records(first[n], second[n], two.t_s) for n in second
    )


def _alike_records(one: Any, two: Any, t_s: Array) -> bool:
    at = two.t_s[(two.t_s >= t_s[0]) & (two.t_s <= t_s[-1])]
    used = [s if s.kept is None else s.of(s.kept) for s in (one, two)]
    count = [np.count_nonzero((s.t_s >= t_s[0]) & (s.t_s <= t_s[-1])) for s in used]
    if (one.camera, one.unused_axes) != (two.camera, two.unused_axes):
        return False
    if count[0] < (1 - MOST_LOST) * count[1]:
        return False
    force = [
        np.stack([np.interp(at, s.t_s, c) for c in (s.reading_mm_s2 @ s.axes).T], -1) for s in used
    ]
    middle_of = [np.median(f, axis=0) for f in force]
    shake = [f - m for f, m in zip(force, middle_of)]
    rms = np.sqrt(np.mean(shake[1] ** 2, axis=0)).max()
    # where samples are masked the interpolation differs, so the median of the difference decides
    off = np.median(np.abs(shake[0] - shake[1])) / 0.6745
    if not (off < ALIKE * rms and np.abs(np.subtract(*middle_of)).max() < ALIKE_MM_S2):
        return False
    inside = used[0].of((used[0].t_s >= t_s[0]) & (used[0].t_s <= t_s[-1]))
    sound = np.stack([np.interp(inside.t_s, two.t_s, c) for c in (two.reading_mm_s2 @ two.axes).T])
    spoilt = inside.reading_mm_s2 @ inside.axes - sound.T
    return bool(np.abs(spoilt - np.median(spoilt, axis=0)).max() < MOST_SPOILT_MM_S2 + ALIKE * rms)
