"""Learns the low-pass of the bubbles' forces, and the white noise of their pixels, from a solution.

The stated covariance of a pixel contains what the bubble's unknown shape adds. That part changes
slowly: it belongs to a position, not to a velocity. So the white noise is learned, too.

Along the rise and across it, the time of the low-pass, the intensity of the path's forces, the
damping of the zigzags and the noise maximise the expectation of the log-likelihood of triangulated
positions over draws of the rig's errors, as a step of expectation maximisation does. A Kalman
filter gives the likelihood (Harvey, Forecasting, Structural Time Series Models and the Kalman
Filter, 1989, eq. 3.4.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.accelerations import are_seen
from telerig.estimator.smoothing.graph.layout import GraphLayout
from telerig.estimator.smoothing.graph.linear import images
from telerig.estimator.smoothing.graph.solve import Solution, drawn
from telerig.factors.bubble_motion import (
    FORCES,
    INERTIA_S,
    NOISE,
    SWINGS,
    BubbleModel,
    Inertia,
    Prior,
    Triple,
    bubble_processes,
    inertial_bubble_path,
)
from telerig.factors.state_space import Component, distinct_steps, exact_step

RigErrors = tuple[Array, Array]
"""Draws of the errors of shake (N, D, K) and constants (n, K)."""

_PIECE_FRAMES, LEARNED_ROWS, _DRAWS = 250, 6000, 2
"""Pieces of tracks of at most so many frames, so many together, with so many draws of the rig."""
_FREQUENCY_HZ = np.geomspace(0.1, 3e4, 4000)
_STILL_MM_S, _NONE = 1e-9, np.zeros(0)
_EXCLUDED, _HALVINGS, _SHORTEST_S = 0.5, 6, 1e-5
"""A low-pass is excluded if its log-likelihood is so much less than that of the most probable."""
_ENOUGH = 1e-6
"""Relative gain of a log-likelihood, which is some 1e4, that is far below `_EXCLUDED`."""


class Series(NamedTuple):
    """A bubble's positions along a direction, mm.

    step : (N - 1,) which length each step has.
    values : (N, 1 + K), for the rig's mean and for K draws of its errors.
    variance : (N,) as stated, infinite where not both cameras saw it.
    """

    step: Ints
    values: Array
    variance: Array


def learned_inertia(solution: Solution) -> Inertia | None:
    """Return the most probable low-pass with the intensities of the forces and the white noise.

    The shorter a low-pass is, the more velocity it allows that no image shows. What the shortest
    one that is not excluded would add is stated with it, so that a velocity is never stated too
    well. Where no bubble is seen in two frames, the solution's own is returned.

    solution : with covariances.
    """
    graph, draws = solution.graph, drawn(solution)
    pieces = _pieces(graph)
    if not pieces:
        return graph.model.bubble.inertia
    rig = (
        draws.of_family(graph, "shake")[..., :_DRAWS],
        draws.of_family(graph, "constants")[0, :, :_DRAWS],
    )
    place, information = _positions(solution, rig, np.concatenate(pieces))
    t_s, up, bubble = graph.problem.t_s[graph.frame_of_row], graph.problem.up, graph.model.bubble
    dt_s, step = distinct_steps(np.concatenate([np.diff(t_s[p]) for p in pieces]))
    steps = np.split(step, np.cumsum([len(p) - 1 for p in pieces])[:-1])
    ends = np.cumsum([len(p) for p in pieces])[:-1]

    def paths(
        directions: Array,
        bubble: BubbleModel = bubble,
        inertia: Prior = INERTIA_S,
        modelled: Array | None = None,
    ) -> _Paths:
        every = []
        for direction in np.broadcast_to(directions, (len(directions), len(place), 3)):
            cut = (np.split(x, ends) for x in (direction, place, _variance(direction, information)))
            every.append([_series(*part) for part in zip(steps, *cut, strict=True)])
        as_along = directions[:, 0] if modelled is None else modelled
        return _Paths(bubble, as_along, dt_s, every, inertia)

    across = paths(np.linalg.svd(up[None])[2][1:, None]).learned()
    # swings show the low-pass; along the vertical there may be none that shows it
    alike = replace(INERTIA_S, median=float(across[0, 0]))
    both = [paths(up[None, None], inertia=alike).learned(), across]
    probable, shortest = (_by_axis(a, b, up) for a, b in zip(*both, strict=True))
    seen = information.any((1, 2))
    if not seen.any():
        return probable
    path = solution.state.bubbles[np.concatenate(pieces)] @ graph.bubble.velocity.T
    path = path / np.maximum(np.linalg.norm(path, axis=-1, keepdims=True), _STILL_MM_S)
    share = (path**2).mean(0)
    # the speed swings as the rise does, twice in a zigzag
    speed, time_s = _of_speed(bubble, share), np.array([share @ probable.time_s])
    found = paths(path[None], speed, modelled=up[None]).best(time_s)
    along = inertial_bubble_path(speed, up, _everywhere(found))
    every = np.diagonal(np.linalg.inv(information[seen]), axis1=1, axis2=2)
    stated = 2 * float(np.median(dt_s[step])) * np.median(every, axis=0)
    used, other = (_Filtered.of(bubble, one, up, stated) for one in (probable, shortest))
    x, y, z = used.unseen(other).tolist()
    cancelled = used.cancelled(along, share, 1), used.cancelled(along, share, 2)
    return replace(probable, unseen=(x, y, z), cancelled=cancelled)


@dataclass(frozen=True)
class _Filtered:
    """The axes' motion and noise, whose filter S / (S + N) makes the estimate.

    density, noise : (3, F) and (3, 1) one-sided densities S and N of the positions, mm^2/Hz.
    """

    density: Array
    noise: Array

    @classmethod
    def of(cls, bubble: BubbleModel, inertia: Inertia, up: Array, stated: Array) -> _Filtered:
        """stated : (3,) density of the noise if all that is stated were white."""
        axes = [inertial_bubble_path(bubble, axis, inertia) for axis in np.eye(3)]
        white = inertia.noise[1] + (inertia.noise[0] - inertia.noise[1]) * up**2
        return cls(np.stack([a.density(_FREQUENCY_HZ) for a in axes]), (white**2 * stated)[:, None])

    @property
    def kept(self) -> Array:
        return np.asarray(self.density / (self.density + self.noise))

    def unseen(self, other: _Filtered) -> Array:
        """Return the variances (3,) of the velocity that are stated too small, at least 0, if the
        other motion and noise are true."""
        kept = self.kept
        left = (1 - kept) ** 2 * other.density + kept**2 * other.noise - kept * self.noise
        return _integral(left, 1).clip(0.0)

    def cancelled(self, along: Component, share: Array, derivative: int) -> float:
        """Return the variance by which a derivative's errors along the path are smaller than errors
        of axes that are independent.

        along : process that moves the bubbles along their paths. share : (3,) mean squares of the
        components of the paths' directions.
        """
        kept, mean = self.kept, share @ self.kept
        # forces across the path cancel along it where all axes are filtered alike
        hidden = (1 - mean) ** 2 * along.density(_FREQUENCY_HZ)
        hidden += share @ ((kept - mean) ** 2 * self.density)
        return float(_integral(share @ (kept * (1 - kept) * self.noise) - hidden, derivative))


def _integral(density: Array, derivative: int) -> Array:
    """Return the variances (...) of a derivative of positions with densities (..., F)."""
    weight = (2 * np.pi * _FREQUENCY_HZ) ** (2 * derivative)
    return np.asarray(np.trapezoid(weight * density, _FREQUENCY_HZ, axis=-1))


def _of_speed(bubble: BubbleModel, share: Array) -> BubbleModel:
    """Return the model of a speed that wanders, driven as strongly as the axes are on average.

    share : (3,) of each axis.
    """
    driven = [
        part * sum((p.component.noise[1] ** 2).sum() for p in bubble_processes(bubble, axis))
        for part, axis in zip(share, np.eye(3), strict=True)
    ]
    sigma = float(np.sqrt(sum(driven) * bubble.velocity_tau_s / 2))
    return replace(bubble, velocity_sigma_mm_s=sigma)


def _by_axis(along: Array, across: Array, up: Array) -> Inertia:
    each = across[:, None] + (along - across)[:, None] * np.square(up)
    time_s, forces, swings = ((float(x), float(y), float(z)) for x, y, z in each[:3])
    return Inertia(time_s, forces, swings, (float(along[3]), float(across[3])))


def _everywhere(values: Array) -> Inertia:
    """Return values (4,) of `_Paths.learned`, or the first three, for all directions."""
    time_s, forces, swings = values[:3].tolist()
    return Inertia((time_s,) * 3, (forces,) * 3, (swings,) * 3)


def _pieces(graph: GraphLayout) -> list[Ints]:
    """Return rows of the graph, spread evenly over all times and bubbles of two frames or more."""
    pieces = [
        piece
        for a, b in pairwise(graph.first_row.tolist())
        if b - a > 1
        for piece in np.array_split(np.arange(a, b), -(-(b - a) // _PIECE_FRAMES))
    ]
    count = min(len(pieces), -(-LEARNED_ROWS * len(pieces) // max(graph.rows, 1)))
    chosen = np.unique(np.linspace(0, len(pieces) - 1, count).astype(int))
    return [pieces[i] for i in chosen]


def _positions(solution: Solution, rig: RigErrors, rows: Ints) -> tuple[Array, Array]:
    """Return triangulated positions (n, 3, 1 + K) in the laboratory and their information.

    rows : (n,) of the graph. The first column is for the rig's mean, the others are how K draws of
    its errors move it. The information (n, 3, 3) is 0 unless all directions are seen.
    """
    graph, observed = solution.graph, solution.graph.problem.observations
    number = np.full(graph.rows, -1)
    number[rows] = np.arange(len(rows))
    mine = np.flatnonzero(number[graph.row(observed.item, observed.frame)] >= 0)
    few = replace(graph, problem=replace(graph.problem, observations=observed.of(mine)))
    information = np.zeros((len(rows), 3, 3))
    side = np.zeros((len(rows), 3, 1 + rig[0].shape[-1]))
    for linear in images(few, solution.state, solution.weights[0][mine]).linear:
        row, node = np.asarray(linear.keys[0]) - graph.base().bubbles, np.asarray(linear.keys[1])
        by_state = linear.blocks[0] @ np.linalg.inv(graph.bubble_basis(row))
        by_place = by_state[..., graph.bubble.path_position]
        pushed = linear.blocks[1] @ rig[0][node] + linear.blocks[2] @ rig[1]
        right = np.concatenate([linear.rhs[..., None], -pushed], -1)
        np.add.at(information, number[row], by_place.mT @ by_place)
        np.add.at(side, number[row], by_place.mT @ right)
    seen = are_seen(information)
    information[~seen], side[~seen] = 0.0, 0.0
    side[seen] = np.linalg.solve(information[seen], side[seen])
    side[..., 0] += solution.state.bubbles[rows] @ graph.bubble.position.T
    return side, information


def _variance(direction: Array, information: Array) -> Array:
    """Return the variances (n,) of positions along directions (n, 3)."""
    variance = np.full(len(information), np.inf)
    seen = information.any((1, 2))
    along = np.linalg.solve(information[seen], direction[seen][..., None])[..., 0]
    variance[seen] = (direction[seen] * along).sum(-1)
    return variance


def _series(step: Ints, direction: Array, place: Array, variance: Array) -> Series:
    """Return the way (n, 1 + K) along directions (n, 3) that may turn, from places (n, 3, 1 + K).

    The white noise of the places stays white, unless the direction turns quickly.
    """
    middle = (direction[1:] + direction[:-1]) / 2
    way = np.einsum("nd,ndk->nk", middle, np.diff(place, axis=0))
    start = direction[0] @ place[0]
    start[0] = 0.0
    return Series(step, np.cumsum(np.vstack([start, way]), 0), variance)


@dataclass(frozen=True)
class _Paths:
    """Series of all bubbles along each of some directions.

    directions : (k, 3) along which the model moves them.  dt_s : (U,) lengths of steps.
    inertia : prior of the low-pass's time.
    """

    bubble: BubbleModel
    directions: Array
    dt_s: Array
    series: Sequence[Sequence[Series]]
    inertia: Prior

    def learned(self) -> Array:
        """Return (2, 4): time of the low-pass in s, intensity of the path's forces and damping of
        the zigzags over the model's, and noise over the stated one, of the most probable and of the
        shortest low-pass."""
        probable = self.best()
        least = self.log_likelihood(probable) - _EXCLUDED
        low, high = np.log(_SHORTEST_S), np.log(probable[0])
        shortest = probable
        for _ in range(_HALVINGS):
            middle = self.best(np.array([np.exp((low + high) / 2)]), shortest)
            if self.log_likelihood(middle) > least:
                shortest, high = middle, np.log(middle[0])
            else:
                low = np.log(middle[0])
        return np.array([probable, shortest])

    def best(self, held: Array = _NONE, start: Array | None = None) -> Array:
        """Return the most probable values (4,) of `learned`, the first ones held."""
        from scipy.optimize import minimize

        priors = [self.inertia, FORCES, SWINGS, NOISE]
        free = priors[len(held) :]
        begin = np.array([p.median for p in free]) if start is None else start[len(held) :]

        def values_at(place: Array) -> Array:
            steps = [p.step for p in free]
            return np.concatenate([held, begin * np.exp(np.multiply(steps, place))])

        def score(place: Array) -> float:
            values = values_at(place)
            prior = sum(p.log_density(v) for p, v in zip(priors, values, strict=True))
            return -prior - self.log_likelihood(values)

        bounds = [
            np.log([p.low / x, p.high / x]) / p.step for p, x in zip(free, begin, strict=True)
        ]
        best = minimize(
            score, np.zeros(len(free)), method="L-BFGS-B", bounds=bounds, options={"ftol": _ENOUGH}
        )
        return values_at(best.x)

    def log_likelihood(self, values: Array) -> float:
        """Return it for the values (4,) of `learned`."""
        total, inertia = 0.0, _everywhere(values)
        for direction, series in zip(self.directions, self.series, strict=True):
            moves = _moves_of(self.bubble, tuple(direction.tolist()), inertia, self.dt_s.tobytes())
            total += log_likelihood(moves, series, float(values[3]))
        return total


class Moves(NamedTuple):
    """A process and its constant mean as one state (s,), over steps of U lengths.

    begin : (s, s) covariance of the first state.
    transition, extra : (U, s, s) of each step, and the covariance that it adds.
    """

    begin: Array
    transition: Array
    extra: Array


@lru_cache(maxsize=16)
def _moves_of(bubble: BubbleModel, direction: Triple, inertia: Inertia, dt_s: bytes) -> Moves:
    """Return the moves along a direction. The optimiser changes the noise alone in every fourth or
    fifth call, which changes none of them."""
    process = inertial_bubble_path(bubble, np.array(direction), inertia)
    return moves_of(process, bubble.mean_sigma_mm_s, np.frombuffer(dt_s))


def moves_of(process: Component, mean_sigma_mm_s: float, dt_s: Array) -> Moves:
    """Return the moves of a process with one input, its mean, over steps of lengths dt_s (U,)."""
    size = process.size
    drift, begin = np.zeros((2, size + 1, size + 1))
    drift[:size, :size], drift[:size, size:] = process.drift, process.input
    begin[:size, :size] = process.start_covariance
    pushed = mean_sigma_mm_s * np.append(process.start_from_input, 1.0)
    begin += np.outer(pushed, pushed)
    noise = np.vstack([process.noise, np.zeros_like(process.noise[:1])])
    return Moves(begin, *exact_step(drift, noise, dt_s))


def log_likelihood(moves: Moves, paths: Sequence[Series], noise: float) -> float:
    """Return its expectation over the draws of the rig, up to a constant."""
    from telerig.estimator.smoothing.learning.kernels import filtered

    total = 0.0
    for step, values, variance in paths:
        columns = values.shape[1]
        squares = np.zeros(columns)
        total += filtered(
            np.zeros((len(moves.begin), columns)), moves.begin.copy(), moves.transition,
            moves.extra, step, values, noise**2 * variance, squares,
        )  # fmt: skip
        total -= (squares[0] + (squares[1:].mean() if columns > 1 else 0.0)) / 2
    return float(total)
