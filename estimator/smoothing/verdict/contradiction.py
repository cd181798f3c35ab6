"""Do the measurements of a run disagree? Then no standard deviation of its result can be right.

Residuals are compared with those that a right model would leave (`graph.draws`), by source,
axis and window of time; constants with their priors; the bubbles' speed with what is possible.
Where something is off, the run is solved again without each source in turn: the source whose
absence removes the contradiction is named, and the distance of the two results widens the bands.

A bubble that is more lively than its prior leaves its mark in the motion prior, not in the pixels
(of 20 in place of 10 mm/s: 2.3 and 1.00 times the expected squares), so that only pixels and the
encoder's readings are tested.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array
from telerig.errors import CalibrationError
from telerig.estimator.smoothing.graph.draws import Draws
from telerig.estimator.smoothing.graph.linear import encoder
from telerig.estimator.smoothing.graph.solve import Options, Solution, drawn, solve
from telerig.estimator.smoothing.graph.stage_travel import considered_variance
from telerig.estimator.smoothing.learning.default_priors import default_model
from telerig.estimator.smoothing.problem.problem import Observations, SmoothingProblem
from telerig.io.results.smoothing import AXES, Contradiction, Disagreement

BUBBLES, MARKS, ENCODER = "bubbles", "marks", "encoder"
HIGHEST_SPEED_MM_S = 10_000.0
MOST_OUTLIERS = 0.2
_MOST_SD = 5.0
_LEAST_RISE_MM_S = 5.0
_RATIO, _SURE, _LEAST_EXPECTED = 1.2, 6.0, 20.0
_WINDOW_S, _LEAST_FRAMES = 0.1, 10
_WINDOW_SURE = 3.0
_BEYOND_NOISE = 3.0


@dataclass(frozen=True)
class Contradictions:
    """Contradictions, the worst first, and factors (3,) for the standard deviations by axis."""

    found: tuple[Contradiction, ...] = ()
    inflation: tuple[float, float, float] = (1.0, 1.0, 1.0)


def contradictions(solution: Solution, draws: Draws) -> Contradictions:
    """Return what disagrees in a solved run.  draws : at the solution."""
    found = list(_of_one(solution, draws))
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


def _of_one(solution: Solution, draws: Draws) -> Iterator[Contradiction]:
    yield from _outliers(solution)
    yield from _constants(solution)
    yield from _speeds(solution)
    yield from residual_contradictions(solution, draws)


def _outliers(solution: Solution) -> Iterator[Contradiction]:
    """Return the sources of which so many pixels are left out that these cannot be outliers."""
    problem = solution.graph.problem
    for source, obs, weights in (
        (BUBBLES, problem.observations, solution.weights[0]),
        (MARKS, problem.references, solution.weights[1]),
    ):
        out = weights < 0.5
        if len(out) and out.mean() > MOST_OUTLIERS:
            when = problem.t_s[obs.frame[out]]
            yield Contradiction(
                source=source, from_s=float(when.min()), to_s=float(when.max()),
                statistic=float(out.mean() / MOST_OUTLIERS), test=Disagreement.OUTLIERS,
            )  # fmt: skip


def _constants(solution: Solution) -> Iterator[Contradiction]:
    """Return the biases and delays that their priors do not allow."""
    graph = solution.graph
    delays = solution.delays_s
    for i, sensor in enumerate(graph.problem.accelerometers):
        first, last = float(graph.problem.t_s[0]), float(graph.problem.t_s[-1])
        by_axis = np.abs(solution.state.sensors[i, :3]) / sensor.bias_sigma_mm_s2
        axis = int(by_axis.argmax())
        if by_axis[axis] > _MOST_SD:
            yield Contradiction(
                source=sensor.name, axis=AXES[axis], from_s=first, to_s=last,
                statistic=float(by_axis[axis]), test=Disagreement.BIAS,
            )  # fmt: skip
        sigma = graph.model.accelerometer_delay_sigma_s
        late = abs(delays[i] - sensor.delay_s) / sigma if sigma else 0.0
        if late > _MOST_SD:
            yield Contradiction(
                source=sensor.name, from_s=first, to_s=last, statistic=float(late),
                test=Disagreement.DELAY,
            )  # fmt: skip


def _speeds(solution: Solution) -> Iterator[Contradiction]:
    """Return a mean speed of the bubbles that no bubble has."""
    problem = solution.graph.problem
    if not problem.bubbles:
        return
    speed = np.median(solution.state.means, axis=0)
    axis = int(np.abs(speed).argmax())
    if abs(speed[axis]) > HIGHEST_SPEED_MM_S:
        yield Contradiction(
            source=BUBBLES if problem.stage is None else ENCODER, axis=AXES[axis],
            from_s=float(problem.t_s[0]), to_s=float(problem.t_s[-1]),
            statistic=float(abs(speed[axis]) / HIGHEST_SPEED_MM_S), test=Disagreement.SPEED,
        )  # fmt: skip


def speed_warnings(solution: Solution) -> list[str]:
    """Return a warning for bubbles that hover or sink, as in a flow downwards.

    An encoder with another sign or unit has the same effect, and without marks no residual shows
    it.
    """
    problem = solution.graph.problem
    if not problem.bubbles or problem.stage is None or not np.ptp(problem.stage.position_mm):
        return []
    rise = float(np.median(solution.state.means @ problem.up))
    if rise > _LEAST_RISE_MM_S:
        return []
    how = "sink" if rise < -_LEAST_RISE_MM_S else "hover"
    return [
        f"the bubbles {how} in the laboratory frame (mean rise {rise:.3g} mm/s). Unless liquid "
        "flows downwards, check the sign and the unit of the encoder"
    ]


def sample_warnings(solution: Solution) -> list[str]:
    """Return a warning for each accelerometer with samples that other measurements contradict."""
    words = []
    for sensor, weight in zip(solution.graph.problem.accelerometers, solution.sample_weights):
        if weight is None:
            continue
        lost = weight < 0.5
        if sensor.kept is not None:
            lost &= sensor.kept
        if lost.any():
            when = sensor.t_s[lost]
            words.append(
                f"accelerometer {sensor.name}: {len(when)} of {len(lost)} samples, from "
                f"{when[0]:.4g} to {when[-1]:.4g} s, are not used: there it and the other "
                "measurements contradict each other"
            )
    return words


@dataclass(frozen=True)
class Group:
    """Squared residuals of one source along one axis (n,), and of draws from the model (n, K)."""

    source: str
    axis: str
    t_s: Array
    square: Array
    expected: Array


def residual_contradictions(solution: Solution, draws: Draws) -> Iterator[Contradiction]:
    """Return the sources whose residuals are larger than a right model leaves them, and than noise.

    The latter keeps short runs, whose fit takes up most of the noise, from false alarms.
    """
    for group in groups(solution, draws):
        seen, number = float(group.square.sum()), group.expected.shape[-1]
        expected = float(group.expected.sum() / number)
        spread = np.sqrt(2 * expected * (1 + 1 / number))
        sure = seen > expected + _SURE * spread and seen > _RATIO * expected
        count = len(group.square)
        sure &= seen > count + _BEYOND_NOISE * np.sqrt(2 * count)
        if expected < _LEAST_EXPECTED or not sure:
            continue
        first, last = _when(solution, group)
        yield Contradiction(
            source=group.source, axis=group.axis, from_s=first, to_s=last,
            statistic=float(np.sqrt(seen / expected)), test=Disagreement.RESIDUALS,
        )  # fmt: skip


def _when(solution: Solution, group: Group) -> tuple[float, float]:
    """Return the first and last time of the windows in which the residuals are too large."""
    t = solution.graph.problem.t_s
    width = max(_WINDOW_S, _LEAST_FRAMES * float(np.median(np.diff(t))))
    window = ((group.t_s - t[0]) / width).astype(np.int64).clip(0)
    seen = np.bincount(window, group.square)
    expected = np.bincount(window, group.expected.mean(-1))
    off = seen > np.maximum(_RATIO * expected, expected + _WINDOW_SURE * np.sqrt(2 * expected))
    which = np.flatnonzero(off) if off.any() else np.arange(len(seen))
    end = min(t[0] + width * (which[-1] + 1), t[-1])
    return float(t[0] + width * which[0]), float(end)


def groups(solution: Solution, draws: Draws) -> list[Group]:
    """Return the tested residuals: pixels of bubbles and marks by axis, and the encoder's."""
    graph, problem = solution.graph, solution.graph.problem
    parts: dict[tuple[str, str], list[tuple[Array, Array, Array]]] = {}
    for source, obs, residual, weight, expected in (
        (BUBBLES, problem.observations, solution.residuals[0], solution.weights[0], draws.pixels),
        (MARKS, problem.references, solution.residuals[1], solution.weights[1], draws.marks),
    ):
        for camera in np.unique(obs.camera).tolist():
            mine = obs.camera == camera
            t, square = problem.t_s[obs.frame[mine]], residual[mine] ** 2 * weight[mine, None]
            for row in range(2):
                direction = problem.cameras[camera].camera_from_rig.rotation[row]
                axis = AXES[int(np.abs(direction).argmax())]
                both = (t, square[:, row], expected[mine, row] ** 2)
                parts.setdefault((source, axis), []).append(both)
    for linear in encoder(graph, solution.state):
        t = graph.nodes.t_s[np.asarray(linear.keys[0])]
        parts[ENCODER, ""] = [(t, linear.rhs[:, 0] ** 2, draws.encoder**2)]
    return [
        Group(source, axis, *(np.concatenate(p) for p in zip(*mine)))
        for (source, axis), mine in parts.items()
    ]


def _without(problem: SmoothingProblem) -> Iterator[tuple[tuple[str, ...], SmoothingProblem]]:
    """Yield the problem without one accelerometer, without the marks, without all of the former."""
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
    """Return the sources without which least is off, and the solution without them."""
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
        misfit = residual_contradictions(other, drawn(other))
        off = sum(f.statistic for f in [*_outliers(other), *_constants(other), *misfit])
        if off < best[0]:
            best = off, names, other
        if not off:
            break
    return best[1], best[2]


def _named(one: Contradiction, blamed: tuple[str, ...]) -> Contradiction:
    """Return the contradiction with the other side of it."""
    if one.source not in blamed:
        return one.model_copy(update={"against": blamed})
    return one


def _spread(solution: Solution, other: Solution) -> tuple[float, float, float]:
    """Return the factor by which the sd have to grow to hold the other result with its own sd."""
    ours, theirs = solution.graph, other.graph
    assert solution.covariances is not None and other.covariances is not None
    if not ours.rows:
        return 1.0, 1.0, 1.0
    row = ours.bubble.position, theirs.bubble.position
    off = other.state.bubbles @ row[1].T - solution.state.bubbles @ row[0].T
    variances = [
        np.einsum("id,nde,ie->ni", a, s.covariances.bubbles, a, optimize=True)
        + considered_variance(s)[0]
        for a, s in zip(row, (solution, other))
        if s.covariances is not None
    ]
    x, y, z = np.sqrt(np.median((off**2 + variances[1]) / variances[0], axis=0)).clip(1.0).tolist()
    return x, y, z
