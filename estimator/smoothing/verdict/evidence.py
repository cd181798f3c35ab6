"""Statistics of a solution that the verdict and the summary need, as sums over frames.

The sums of the pieces of a long run add up to those of the run, so that only one piece has to be
in memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.smoothing.graph.draws import Draws
from telerig.estimator.smoothing.graph.layout import variances
from telerig.estimator.smoothing.graph.linear import ENCODER, MARKS, encoder, white_noise
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.graph.stage_travel import considered_variance
from telerig.estimator.smoothing.verdict.shared import Shared, shared_motion
from telerig.estimator.smoothing.verdict.whiteness import Lagged, lagged
from telerig.io.tables.smoothing import AXES

BUBBLES = "bubbles"
_STILL = 1e-12
_WINDOW_S, _LEAST_FRAMES = 0.1, 10
EDGE = 0.1
"""Share of a run, and of each track, at both ends that says little of the whole."""
_SAMPLED = 20_000
_USED = 0.5


@dataclass(frozen=True)
class Span:
    """The frames of a piece that belong to it alone, without its overlap with other pieces.

    own : these frames, numbered as in the piece's solution.
    first : number in the run of the solution's frame 0.
    t_s : (F,) times of all frames of the run.
    """

    own: range
    first: int
    t_s: Array

    @classmethod
    def whole(cls, solution: Solution) -> Span:
        """Return the span of a solution that covers the whole run."""
        t_s = solution.graph.problem.t_s
        return cls(range(len(t_s)), 0, t_s)

    def holds(self, frame: Ints) -> Bools:
        """Return for frames (n,) of the solution whether they belong to the piece (n,)."""
        return np.asarray((frame >= self.own.start) & (frame < self.own.stop))

    def spans(self, t_s: Array) -> Bools:
        """Return whether times (n,) are nearer to the piece's frames than to others (n,)."""
        first, last = self.first + self.own.start, self.first + self.own.stop - 1
        low = self.t_s[first] if first else -np.inf
        high = self.t_s[last + 1] if last + 1 < len(self.t_s) else np.inf
        return np.asarray((t_s >= low) & (t_s < high))

    @property
    def window_s(self) -> float:
        """Length of the time windows in which `Tally` sums the residuals."""
        return max(_WINDOW_S, _LEAST_FRAMES * float(np.median(np.diff(self.t_s))))


@dataclass(frozen=True)
class Tally:
    """Sums of squared residuals of one source along one axis.

    source : "bubbles", "marks" or "encoder".
    axis : "x", "y" or "z"; "" for the encoder.
    seen : (n,) sums in consecutive time windows from the run's first frame on; in units of all the
        noise that is stated.
    expected : (n,) mean of the same sums over random draws from the model.
    count : number of residuals.
    draws : number of draws behind ``expected``.
    """

    source: str
    axis: str
    seen: Array
    expected: Array
    count: int
    draws: int

    def __add__(self, other: Tally) -> Tally:
        return replace(
            self,
            seen=_padded_sum(self.seen, other.seen),
            expected=_padded_sum(self.expected, other.expected),
            count=self.count + other.count,
            draws=min(self.draws, other.draws),
        )


def _padded_sum(one: Array, other: Array) -> Array:
    out = np.zeros(max(len(one), len(other)))
    out[: len(one)] += one
    out[: len(other)] += other
    return out


@dataclass(frozen=True)
class Pixels:
    """Sums over the detections of one source.

    source : "bubbles" or "marks".
    count : number of detections.
    lost : number of those rejected as outliers.
    from_s, to_s : times of the first and the last rejected one.
    total : sum of the squared residuals of the others.
    some : up to 20,000 of these squares.
    """

    source: str
    count: int
    lost: int
    from_s: float
    to_s: float
    total: float
    some: Array

    def __add__(self, other: Pixels) -> Pixels:
        return Pixels(
            self.source, self.count + other.count, self.lost + other.lost,
            min(self.from_s, other.from_s), max(self.to_s, other.to_s), self.total + other.total,
            np.concatenate([self.some, other.some]),
        )  # fmt: skip


@dataclass(frozen=True)
class Shake:
    """Sums over the cameras' offsets, without a tenth of the run at both ends.

    frames : number of frames.
    variance : for each camera (k,), posterior variance along its k directions of view, summed
        (mm^2).
    square : for each camera (k,), squared estimate plus its variance, summed (mm^2).
    """

    frames: int
    variance: tuple[Array, ...]
    square: tuple[Array, ...]

    def __add__(self, other: Shake) -> Shake:
        return Shake(
            self.frames + other.frames,
            tuple(a + b for a, b in zip(self.variance, other.variance)),
            tuple(a + b for a, b in zip(self.square, other.square)),
        )


@dataclass(frozen=True)
class Lost:
    """Samples of one accelerometer that the solution does not use.

    samples : number of all samples.
    masked : number of unused ones.
    t_s : (n,) times of those that the solution rejected because other measurements contradict them.
    """

    samples: int
    masked: int
    t_s: Array

    def __add__(self, other: Lost) -> Lost:
        return Lost(
            self.samples + other.samples, self.masked + other.masked,
            np.concatenate([self.t_s, other.t_s]),
        )  # fmt: skip


@dataclass(frozen=True)
class Mean:
    """Mean velocity of one bubble.

    frames : number of frames from its first to its last detection.
    velocity_mm_s : (3,).
    sigma_mm_s : (3,) its standard deviation; None without covariances.
    way_sigma_mm : (3,) standard deviation of the displacement from the first to the last frame.
    length_sigma_mm : standard deviation of the length of the path between these frames.
    """

    frames: int
    velocity_mm_s: Array
    sigma_mm_s: Array | None
    way_sigma_mm: Array | None = None
    length_sigma_mm: float | None = None


@dataclass(frozen=True)
class Evidence:
    """Sums over one solution, or over all pieces of a run.

    times_s : times of the run's first and last frame.
    window_s : length of the time windows of `Tally`.
    tallies : squared residuals by (source, axis).
    pixels : detections by source.
    lagged : products of the bubbles' residuals by camera.
    lost : unused samples by accelerometer.
    off : (4,) by accelerometer: how many standard deviations of their priors the biases along x, y
        and z of the sensor, and its delay, are off.
    means : mean velocities by particle number.
    shake : None without a shake in the model.
    nodes : number of times at which the shake is estimated.
    passes : number of iterations of the solver.
    shared : motions that the residuals of one camera share, by source.
    """

    times_s: tuple[float, float]
    window_s: float
    tallies: Mapping[tuple[str, str], Tally]
    pixels: Mapping[str, Pixels]
    lagged: Mapping[str, Lagged]
    lost: Mapping[str, Lost]
    off: Mapping[str, Array]
    means: Mapping[int, Mean]
    shake: Shake | None
    nodes: int
    passes: int
    shared: Mapping[str, Shared]

    @classmethod
    def of(cls, solution: Solution, draws: Draws, span: Span | None = None) -> Evidence:
        """Return the sums over one solution.

        draws : random draws at the solution.
        span : which frames count; None for all.
        """
        span = span or Span.whole(solution)
        tallies = {(t.source, t.axis): t for t in _tallies(solution, draws, span)}
        nodes, pieces = solution.graph.nodes, len(span.t_s) / max(len(span.own), 1)
        shared = {
            source: found
            for source, drawn in ((BUBBLES, draws.pixels), (MARKS, draws.marks))
            if (found := shared_motion(solution, source, drawn, span.own, pieces)) is not None
        }
        return cls(
            (float(span.t_s[0]), float(span.t_s[-1])), span.window_s, tallies,
            _pixels(solution, span),
            lagged(solution, draws, span.holds(solution.graph.problem.observations.frame)),
            _lost(solution, span), _off(solution), _means(solution, span),
            shake_of(solution, span), int(np.count_nonzero(span.spans(nodes.t_s))), solution.passes,
            shared,
        )  # fmt: skip

    def __add__(self, other: Evidence) -> Evidence:
        means = dict(self.means)
        for particle, mean in other.means.items():
            if particle not in means or mean.frames > means[particle].frames:
                means[particle] = mean
        shake = [s for s in (self.shake, other.shake) if s is not None]
        shared = dict(self.shared)
        for source, found in other.shared.items():
            if source not in shared or found.sigmas > shared[source].sigmas:
                shared[source] = found
        return replace(
            self,
            tallies=_added(self.tallies, other.tallies),
            pixels=_added(self.pixels, other.pixels),
            lagged=_added(self.lagged, other.lagged),
            lost=_added(self.lost, other.lost),
            off={**self.off, **other.off},  # each piece knows what all tell of the constants
            means=means,
            shake=reduce(Shake.__add__, shake) if shake else None,
            nodes=self.nodes + other.nodes,
            passes=max(self.passes, other.passes),
            shared=shared,
        )

    @property
    def mean_velocities(self) -> Array:
        """Mean velocities (K, 3) of all bubbles, mm/s."""
        return np.array([m.velocity_mm_s for m in self.means.values()]).reshape(-1, 3)


def _added(one: Mapping[Any, Any], other: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return the union of two mappings, with the values of common keys added."""
    both = {key: value + other[key] for key, value in one.items() if key in other}
    return {**one, **other, **both}


def _tallies(solution: Solution, draws: Draws, span: Span) -> Iterator[Tally]:
    """Yield the sums for pixels of bubbles and marks by axis, and for the encoder's readings."""
    graph, problem = solution.graph, solution.graph.problem
    parts: dict[tuple[str, str], list[tuple[Array, Array, Array]]] = {}
    # what changes slowly is stated, too: it is an error of the images, but no contradiction
    stated = {
        BUBBLES: white_noise(graph, 1.0),
        MARKS: np.tile(np.eye(2), (len(problem.cameras), 1, 1)),
    }
    for source, obs, residual, weight, expected in (
        (BUBBLES, problem.observations, solution.residuals[0], solution.weights[0], draws.pixels),
        (MARKS, problem.references, solution.residuals[1], solution.weights[1], draws.marks),
    ):
        for camera in np.unique(obs.camera).tolist():
            mine = (obs.camera == camera) & span.holds(obs.frame)
            within = residual[mine] @ stated[source][camera]
            t, square = problem.t_s[obs.frame[mine]], within**2 * weight[mine, None]
            for row in range(2):
                direction = problem.cameras[camera].camera_from_rig.rotation[row]
                axis = AXES[int(np.abs(direction).argmax())]
                both = (t, square[:, row], expected[mine, row] ** 2)
                parts.setdefault((source, axis), []).append(both)
    for linear in encoder(graph, solution.state):
        t = graph.nodes.t_s[np.asarray(linear.keys[0])]
        mine = span.spans(t)
        parts[ENCODER, ""] = [(t[mine], linear.rhs[mine, 0] ** 2, draws.encoder[mine] ** 2)]
    for (source, axis), found in parts.items():
        t, square, drawn = (np.concatenate(p) for p in zip(*found))
        window = ((t - span.t_s[0]) / span.window_s).astype(np.int64).clip(0)
        yield Tally(
            source, axis, np.asarray(np.bincount(window, square), np.float64),
            np.asarray(np.bincount(window, drawn.mean(-1)), np.float64), len(square),
            drawn.shape[-1],
        )  # fmt: skip


def _pixels(solution: Solution, span: Span) -> dict[str, Pixels]:
    problem, out = solution.graph.problem, {}
    for i, (source, obs) in enumerate(
        ((BUBBLES, problem.observations), (MARKS, problem.references))
    ):
        mine = span.holds(obs.frame)
        lost = solution.weights[i][mine] <= _USED
        when = problem.t_s[obs.frame[mine][lost]]
        square = (solution.residuals[i][mine][~lost] ** 2).sum(-1)
        whole = len(span.own) == len(span.t_s)
        step = 1 if whole else -(-len(square) // _SAMPLED) or 1
        out[source] = Pixels(
            source, int(np.count_nonzero(mine)), len(when), float(when.min(initial=np.inf)),
            float(when.max(initial=-np.inf)), float(square.sum()), square[::step].copy(),
        )  # fmt: skip
    return out


def _lost(solution: Solution, span: Span) -> dict[str, Lost]:
    out = {}
    for i, sensor in enumerate(solution.graph.problem.accelerometers):
        mine = span.spans(sensor.t_s)
        weight = solution.sample_weights[i] if solution.sample_weights else None
        given = np.ones(len(mine), bool) if sensor.kept is None else sensor.kept
        used = given if weight is None else weight >= _USED
        gone = given & ~used & mine
        masked = np.count_nonzero(mine & ~used)
        out[sensor.name] = Lost(int(mine.sum()), int(masked), sensor.t_s[gone])
    return out


def _off(solution: Solution) -> dict[str, Array]:
    graph = solution.graph
    sigma = graph.model.accelerometer_delay_sigma_s
    out = {}
    for i, sensor in enumerate(graph.problem.accelerometers):
        biases = solution.state.sensors[i, :3] / sensor.bias_sigma_mm_s2
        late = (solution.delays_s[i] - sensor.delay_s) / sigma if sigma else 0.0
        out[sensor.name] = np.abs([*biases, late])
    return out


def _means(solution: Solution, span: Span) -> dict[int, Mean]:
    """Return the mean velocity of each bubble that is seen in the span."""
    found, ways, out = solution.covariances, solution.ways, {}
    graph, velocity = solution.graph, solution.velocities_mm_s
    speed = considered_variance(solution)[1] if ways is not None else np.zeros((graph.rows, 3))
    for i, bubble in enumerate(graph.problem.bubbles):
        if bubble.last < span.own.start or bubble.first >= span.own.stop:
            continue
        sigma = None if found is None else np.sqrt(np.diagonal(found.means[i]))
        way = length = None
        if ways is not None:
            begin, end = graph.problem.t_s[[bubble.first, bubble.last]]
            rows = slice(graph.first_row[i], graph.first_row[i + 1])
            stage = speed[rows].mean(0) * (end - begin) ** 2
            way = np.sqrt(ways[0][i] + stage)
            share = (velocity[rows] ** 2).mean(0)
            along = float(stage @ share / max(share.sum(), _STILL))
            length = float(np.sqrt(ways[1][i] + along))
        out[bubble.particle] = Mean(len(bubble), solution.state.means[i], sigma, way, length)
    return out


def shake_of(solution: Solution, span: Span | None = None) -> Shake | None:
    """Return the sums over the cameras' offsets; None without a shake in the model or covariances.

    span : which frames count; None for all.
    """
    span = span or Span.whole(solution)
    graph, found = solution.graph, solution.covariances
    if found is None or not graph.shake.size:
        return None
    count = len(span.t_s)
    edge = int(EDGE * count)
    inner = np.arange(
        max(span.own.start, edge - span.first), min(span.own.stop, count - edge - span.first)
    )
    states = graph.shake_at_frames(solution.state.shake)[inner]
    left, squares = list[Array](), list[Array]()
    for camera, seen in enumerate(graph.shake.seen):
        rows = seen @ graph.shake.offset[camera]
        left.append(variances(rows, found.shake[inner]).sum(0))
        squares.append(((states @ rows.T) ** 2).sum(0) + left[-1])
    return Shake(len(inner), tuple(left), tuple(squares))


def evidence_of(parts: Sequence[Evidence]) -> Evidence:
    """Return the sum over the pieces of a run."""
    return reduce(Evidence.__add__, parts)
