"""The low-pass of the bubbles' forces, and the white noise of their pixels, learned from a run.

Along the rise and across it, the time of the low-pass, the intensity of the forces and the noise
maximise the expectation of the log-likelihood of triangulated positions over draws of the rig's
errors, as a step of expectation maximisation does. A Kalman filter gives the likelihood
(Harvey, Forecasting, Structural Time Series Models and the Kalman Filter, 1989, eq. 3.4.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.layout import GraphLayout
from telerig.estimator.smoothing.graph.linear import images
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.factors.bubble_motion import (
    FORCES,
    INERTIA_S,
    NOISE,
    BubbleModel,
    Inertia,
    LowPasses,
    Prior,
    inertial_bubble_path,
)
from telerig.factors.state_space import Component, discretise, distinct_steps

RigErrors = tuple[Array, Array]
"""Draws of the errors of shake (N, D, K) and constants (n, K)."""

_PIECE_FRAMES, LEARNED_ROWS, _DRAWS = 250, 6000, 2
"""Pieces of tracks of at most so many frames, so many together, with so many draws of the rig."""
_LEAST_INFORMATION = 1e-6
_EXCLUDED, _HALVINGS, _SHORTEST_S = 0.5, 6, 1e-5
"""A low-pass is excluded if its log-likelihood is so much less than that of the most probable."""


class Series(NamedTuple):
    """A bubble's positions along a direction, mm.

    step : (N - 1,) which length each step has.
    values : (N, 1 + K), for the rig's mean and for K draws of its errors.
    variance : (N,) as stated, infinite where not both cameras saw it.
    """

    step: Ints
    values: Array
    variance: Array


def learned_low_passes(solution: Solution, rig: RigErrors) -> LowPasses:
    """Return low-passes with their intensity of the forces and white noise.

    The shorter a low-pass is, the more velocity it allows that no image shows: with the shortest
    one a velocity is never stated too well. An acceleration grows without limit with it.
    """
    graph = solution.graph
    pieces = _pieces(graph)
    place, information = _positions(
        solution, (rig[0][..., :_DRAWS], rig[1][..., :_DRAWS]), np.concatenate(pieces)
    )
    t_s, up = graph.problem.t_s[graph.frame_of_row], graph.problem.up
    dt_s, step = distinct_steps(np.concatenate([np.diff(t_s[p]) for p in pieces]))
    steps = np.split(step, np.cumsum([len(p) - 1 for p in pieces])[:-1])
    ends, first = np.cumsum([len(p) for p in pieces])[:-1], np.eye(place.shape[-1])[0]

    def learned(directions: Array) -> Array:
        paths = []
        for direction in directions:
            values, variance = _along(direction, place, information)
            parts = zip(steps, np.split(values, ends), np.split(variance, ends), strict=True)
            paths.append([Series(step, x - x[0, 0] * first, v) for step, x, v in parts])
        return _Paths(graph.model.bubble, directions, dt_s, paths).learned()

    along, across = learned(up[None]), learned(np.linalg.svd(up[None])[2][1:])
    return LowPasses(*(_by_axis(*both, up) for both in zip(along, across, strict=True)))


def _by_axis(along: Array, across: Array, up: Array) -> Inertia:
    each = across[:, None] + (along - across)[:, None] * np.square(up)
    time_s, forces = ((float(x), float(y), float(z)) for x, y, z in each[:2])
    return Inertia(time_s, forces, (float(along[2]), float(across[2])))


def _pieces(graph: GraphLayout) -> list[Ints]:
    """Return rows of the graph, spread evenly over all bubbles and times."""
    cuts = [
        np.array_split(np.arange(a, b), -(-(b - a) // _PIECE_FRAMES))
        for a, b in pairwise(graph.first_row.tolist())
    ]
    pieces = [piece for cut in cuts for piece in cut]
    count = min(len(pieces), -(-LEARNED_ROWS * len(pieces) // graph.rows))
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
    size = np.linalg.eigvalsh(information)
    seen = size[:, 0] > _LEAST_INFORMATION * size[:, -1]
    information[~seen] = 0.0
    side[seen] = np.linalg.solve(information[seen], side[seen])
    side[..., 0] += solution.state.bubbles[rows] @ graph.bubble.position.T
    return side, information


def _along(direction: Array, place: Array, information: Array) -> tuple[Array, Array]:
    """Return values (n, 1 + K) and variances (n,) along a direction (3,)."""
    variance = np.full(len(place), np.inf)
    seen = information.any((1, 2))
    variance[seen] = direction @ np.linalg.solve(information[seen], direction[:, None])[..., 0].T
    return np.asarray(np.einsum("d,ndk->nk", direction, place)), variance


@dataclass(frozen=True)
class _Paths:
    """Series of all bubbles along each of some directions (k, 3); dt_s : (U,) lengths of steps."""

    bubble: BubbleModel
    directions: Array
    dt_s: Array
    series: Sequence[Sequence[Series]]

    def learned(self) -> Array:
        """Return (2, 3): time of the low-pass in s, intensity of the forces and noise over the
        stated one, of the most probable and of the shortest low-pass."""
        fixed, free = self.bubble.inertia_s, [INERTIA_S, FORCES, NOISE]
        probable = self._best(free, np.array([], float) if fixed is None else np.array([fixed]))
        if fixed is not None:
            return np.array([probable, probable])
        least = self.log_likelihood(probable) - _EXCLUDED
        low, high = np.log(_SHORTEST_S), np.log(probable[0])
        shortest = probable
        for _ in range(_HALVINGS):
            middle = self._best(free, np.array([np.exp((low + high) / 2)]), shortest)
            if self.log_likelihood(middle) > least:
                shortest, high = middle, np.log(middle[0])
            else:
                low = np.log(middle[0])
        return np.array([probable, shortest])

    def _best(self, priors: list[Prior], held: Array, start: Array | None = None) -> Array:
        """Return the most probable values (3,), the first ones held."""
        from scipy.optimize import minimize

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
        best = minimize(score, np.zeros(len(free)), method="L-BFGS-B", bounds=bounds)
        return values_at(best.x)

    def log_likelihood(self, values: Array) -> float:
        """Return it for the values (3,) of `learned`."""
        time_s, forces, noise = values.tolist()
        inertia, total = Inertia((time_s,) * 3, (forces,) * 3), 0.0
        for direction, series in zip(self.directions, self.series, strict=True):
            process = inertial_bubble_path(self.bubble, direction, inertia)
            sigma = self.bubble.mean_sigma_mm_s
            total += log_likelihood(process, sigma, self.dt_s, series, noise)
        return total


def log_likelihood(
    process: Component, mean_sigma_mm_s: float, dt_s: Array, paths: Sequence[Series], noise: float
) -> float:
    """Return its expectation over the draws of the rig, up to a constant."""
    from telerig.estimator.smoothing.graph.kernels import filtered

    steps, size = discretise([process], dt_s)[0], process.size
    transition, extra = np.zeros((2, len(dt_s), size + 1, size + 1))
    transition[:, :size, :size], transition[:, :size, size:] = steps.transition[0], steps.input[0]
    transition[:, size, size] = 1.0
    extra[:, :size, :size] = steps.covariance[0]
    begin = np.zeros((size + 1, size + 1))
    begin[:size, :size] = process.start_covariance
    pushed = mean_sigma_mm_s * np.append(process.start_from_input, 1.0)
    begin += np.outer(pushed, pushed)
    total = 0.0
    for step, values, variance in paths:
        columns = values.shape[1]
        squares = np.zeros(columns)
        total += filtered(
            np.zeros((size + 1, columns)), begin.copy(), transition, extra, step, values,
            noise**2 * variance, squares,
        )  # fmt: skip
        total -= (squares[0] + (squares[1:].mean() if columns > 1 else 0.0)) / 2
    return float(total)
