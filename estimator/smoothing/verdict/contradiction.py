"""Tests whether the measurements of a run contradict each other.

If they do, no standard deviation of the result can be right. Tested are the squared residuals
against those expected from the model (`graph.draws`), by source, axis and time window; biases and
delays against their priors; the bubbles' speed against a limit; and what the residuals of one
camera share (`shared`). If a test fails, the run is solved again with each accelerometer, and the
marks, left out in turn. The source whose removal resolves the contradiction is named, and the
standard deviations are enlarged to cover the difference of the two results.

Only the residuals of pixels and encoder readings are tested. Bubbles that are livelier than their
prior (20 instead of 10 mm/s) raise the squared residuals of the motion prior to 2.3 times the
expected ones, and leave those of the pixels unchanged (1.00).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array
from telerig.errors import CalibrationError
from telerig.estimator.smoothing.graph.layout import variances
from telerig.estimator.smoothing.graph.linear import ENCODER, MARKS
from telerig.estimator.smoothing.graph.solve import Options, Solution, drawn, solve
from telerig.estimator.smoothing.graph.stage_travel import considered_variance
from telerig.estimator.smoothing.learning.default_priors import default_model
from telerig.estimator.smoothing.problem.problem import Observations, SmoothingProblem
from telerig.estimator.smoothing.verdict.evidence import BUBBLES, Evidence, Tally
from telerig.io.results.smoothing import Contradiction, Disagreement
from telerig.io.tables.smoothing import AXES

HIGHEST_SPEED_MM_S = 10_000.0
MOST_OUTLIERS = 0.2
_MOST_SD = 5.0
_LEAST_RISE_MM_S = 5.0
_RATIO, _SURE, _LEAST_EXPECTED = 1.2, 6.0, 20.0
_WINDOW_SURE = 3.0
_BEYOND_NOISE = 3.0


@dataclass(frozen=True)
class Contradictions:
    """The contradictions of a run and how much they enlarge its standard deviations.

    found : the contradictions, the largest first.
    inflation : factors of the standard deviations along x, y and z of the rig frame.
    """

    found: tuple[Contradiction, ...] = ()
    inflation: tuple[float, float, float] = (1.0, 1.0, 1.0)


def contradictions(solution: Solution, evidence: Evidence) -> Contradictions:
    """Test a solved run for contradictions and name the source that causes them.

    solution : of the run, or of its middle piece; it is solved again with sources left out.
    evidence : sums over the whole run.
    """
    found = list(_of_one(solution, evidence))
    if not found:
        return Contradictions()
    factor = max(1.0, *(f.statistic for f in found))
    inflation = (factor, factor, factor)
    blamed, other = _blamed(solution, found)
    if other is not None:
        inflation = _spread(solution, other)
        found = [_named(one, blamed) for one in found]
    order = sorted(found, key=lambda one: -one.statistic)
    return Contradictions(tuple(dict.fromkeys(order)), inflation)


def _of_one(solution: Solution, evidence: Evidence) -> Iterator[Contradiction]:
    yield from _outliers(evidence)
    yield from _constants(evidence)
    yield from _speeds(solution, evidence)
    yield from residual_contradictions(evidence)
    yield from _shared(evidence)


def _outliers(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield the sources of which more than `MOST_OUTLIERS` of the pixels were rejected."""
    for one in evidence.pixels.values():
        share = one.lost / max(one.count, 1)
        if share > MOST_OUTLIERS:
            yield Contradiction(
                source=one.source, from_s=one.from_s, to_s=one.to_s,
                statistic=share / MOST_OUTLIERS, test=Disagreement.OUTLIERS,
            )  # fmt: skip


def _constants(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield the biases and delays that are more than 5 prior standard deviations off."""
    first, last = evidence.times_s
    for name, off in evidence.off.items():
        axis = int(off[:3].argmax())
        if off[axis] > _MOST_SD:
            yield Contradiction(
                source=name, axis=AXES[axis], from_s=first, to_s=last,
                statistic=float(off[axis]), test=Disagreement.BIAS,
            )  # fmt: skip
        if off[3] > _MOST_SD:
            yield Contradiction(
                source=name, from_s=first, to_s=last, statistic=float(off[3]),
                test=Disagreement.DELAY,
            )  # fmt: skip


def _speeds(solution: Solution, evidence: Evidence) -> Iterator[Contradiction]:
    """Yield a contradiction if the bubbles' median velocity exceeds `HIGHEST_SPEED_MM_S`."""
    problem, means = solution.graph.problem, evidence.mean_velocities
    if not len(means):
        return
    speed = np.median(means, axis=0)
    axis = int(np.abs(speed).argmax())
    if abs(speed[axis]) > HIGHEST_SPEED_MM_S:
        yield Contradiction(
            source=BUBBLES if problem.stage is None else ENCODER, axis=AXES[axis],
            from_s=evidence.times_s[0], to_s=evidence.times_s[1],
            statistic=float(abs(speed[axis]) / HIGHEST_SPEED_MM_S), test=Disagreement.SPEED,
        )  # fmt: skip


def _shared(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield what the residuals of one camera share."""
    for source, one in evidence.shared.items():
        yield Contradiction(
            source=source, camera=one.camera, from_s=one.from_s, to_s=one.to_s, hz=one.hz,
            statistic=one.sigmas, test=Disagreement(one.motion),
        )  # fmt: skip


def speed_warnings(problem: SmoothingProblem, means: Array) -> list[str]:
    """Return a warning if the bubbles do not rise although the stage moves.

    Either the liquid flows downwards, or the encoder has a wrong sign or unit, which without marks
    leaves no trace in the residuals.

    means : (K, 3) mean velocities of the bubbles, mm/s.
    """
    stage = problem.stage
    if not len(means) or stage is None or not np.ptp(stage.position_mm):
        return []
    rise = float(np.median(means @ problem.up))
    if rise > _LEAST_RISE_MM_S:
        return []
    how = "sink" if rise < -_LEAST_RISE_MM_S else "hover"
    return [
        f"the bubbles {how} in the laboratory frame (mean rise {rise:.3g} mm/s). Unless liquid "
        "flows downwards, check the sign and the unit of the encoder, and that its t_s is in s"
    ]


def sample_warnings(evidence: Evidence) -> list[str]:
    """Return a warning for each accelerometer with samples that other measurements contradict."""
    return [
        f"accelerometer {name}: {len(lost.t_s)} of {lost.samples} samples, from "
        f"{lost.t_s[0]:.4g} to {lost.t_s[-1]:.4g} s, are not used: there it and the other "
        "measurements contradict each other"
        for name, lost in evidence.lost.items()
        if len(lost.t_s)
    ]


def residual_contradictions(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield the sources whose sum of squared residuals is too large for model and noise.

    The sum has to exceed the expectation from the model by 6 standard deviations and 20 %, and also
    the number of residuals: a short run's fit absorbs most of the noise, so that the first test
    alone would raise false alarms.
    """
    for tally in evidence.tallies.values():
        seen, expected, count = float(tally.seen.sum()), float(tally.expected.sum()), tally.count
        spread = np.sqrt(2 * expected * (1 + 1 / tally.draws))
        sure = seen > expected + _SURE * spread and seen > _RATIO * expected
        sure &= seen > count + _BEYOND_NOISE * np.sqrt(2 * count)
        if expected < _LEAST_EXPECTED or not sure:
            continue
        first, last = _when(tally, evidence)
        yield Contradiction(
            source=tally.source, axis=tally.axis, from_s=first, to_s=last,
            statistic=float(np.sqrt(seen / expected)), test=Disagreement.RESIDUALS,
        )  # fmt: skip


def _when(tally: Tally, evidence: Evidence) -> tuple[float, float]:
    """Return the start and end (s) of the time in which the residuals are too large."""
    (begin, end), width = evidence.times_s, evidence.window_s
    seen, expected = tally.seen, tally.expected
    off = seen > np.maximum(_RATIO * expected, expected + _WINDOW_SURE * np.sqrt(2 * expected))
    which = np.flatnonzero(off) if off.any() else np.arange(len(seen))
    return float(begin + width * which[0]), float(min(begin + width * (which[-1] + 1), end))


def _without(problem: SmoothingProblem) -> Iterator[tuple[tuple[str, ...], SmoothingProblem]]:
    """Yield the problem without each accelerometer in turn, without the marks, and without all
    sensors.
    """
    problem = replace(problem, known=())
    sensors = problem.accelerometers
    for one in sensors:
        rest = tuple(a for a in sensors if a is not one)
        yield (one.name,), replace(problem, accelerometers=rest)
    if len(problem.references):
        yield (MARKS,), replace(problem, marks=(), references=Observations.none())
    if len(sensors) > 1:
        yield tuple(a.name for a in sensors), replace(problem, accelerometers=())


def _blamed(
    solution: Solution, found: list[Contradiction]
) -> tuple[tuple[str, ...], Solution | None]:
    """Return the sources whose removal reduces the contradictions most, and the solution without
    them.
    """
    problem = solution.graph.problem
    named = {f.source for f in found if f.test in (Disagreement.BIAS, Disagreement.DELAY)}
    best: tuple[float, tuple[str, ...], Solution | None] = (np.inf, (), None)
    for names, rest in _without(problem):
        if named and not named <= set(names):
            continue
        model = replace(
            default_model(rest, solution.graph.model.encoder_sigma_mm),
            bubble=solution.graph.model.bubble,
        )
        try:
            other = solve(rest, model, Options(draws=True))
        except CalibrationError:
            continue
        sums = Evidence.of(other, drawn(other))
        misfit = [*_outliers(sums), *_constants(sums), *residual_contradictions(sums)]
        misfit += _shared(sums)
        off = sum(f.statistic for f in misfit)
        if off < best[0]:
            best = off, names, other
        if not off:
            break
    return best[1], best[2]


def _named(one: Contradiction, blamed: tuple[str, ...]) -> Contradiction:
    """Return the contradiction with the sources that it contradicts."""
    if one.source not in blamed:
        return one.model_copy(update={"against": blamed})
    return one


def _spread(solution: Solution, other: Solution) -> tuple[float, float, float]:
    """Return the factors by axis that make our standard deviations cover the other solution."""
    ours, theirs = solution.graph, other.graph
    assert solution.covariances is not None and other.covariances is not None
    if not ours.rows:
        return 1.0, 1.0, 1.0
    row = ours.bubble.position, theirs.bubble.position
    off = other.state.bubbles @ row[1].T - solution.state.bubbles @ row[0].T
    own, their = (
        variances(a, s.covariances.bubbles) + considered_variance(s)[0]
        for a, s in zip(row, (solution, other))
        if s.covariances is not None
    )
    x, y, z = np.sqrt(np.median((off**2 + their) / own, axis=0)).clip(1.0).tolist()
    return x, y, z
