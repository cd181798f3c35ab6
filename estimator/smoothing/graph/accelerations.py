"""The bubbles' acceleration, after a run is solved: each bubble by itself, under a smoother prior.

White noise drives the bubbles of the smoothing graph, so that their acceleration has no finite
variance. Here their forces pass a low-pass (`factors.bubble_motion.inertial_bubble_path`), and the
acceleration is a state. Positions and velocities of the run stay those of the graph.

Given the rig the bubbles are independent chains (`bubble_chains`). The rig's posterior under the
graph's prior takes the place of that under the smoother one: the chains are solved for the rig's
mean, which gives the acceleration, and for draws of its errors, whose covariance is added to that
of the chains. The time of the low-pass maximises the expectation of the chains' log-likelihood over
these draws, as a step of expectation maximisation does.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.bubble_chains import bubble_chains
from telerig.estimator.smoothing.graph.draws import Draws
from telerig.estimator.smoothing.graph.layout import (
    bubble_layout,
    with_bubbles,
)
from telerig.estimator.smoothing.graph.linear import bubble_priors, images
from telerig.estimator.smoothing.graph.solve import Accelerations, Solution
from telerig.estimator.smoothing.problem.problem import Bubble
from telerig.factors.bubble_motion import (
    FORCES,
    INERTIA_S,
    Inertia,
    inertial_bubble_path,
)
from telerig.factors.linear_factors import LinearFactors, product, transposed_product
from telerig.factors.state_space import Component

_ROWS_AT_ONCE = 20_000
_PIECE_FRAMES, LEARNED_ROWS, _LEARNED_DRAWS = 150, 2400, 2
"""The low-pass is learned from pieces of tracks of at most so many frames, so many together, and
with so many draws of the rig."""
_MOST_TRIALS = 40
_POOLED_S = 0.1
"""Over so much time on either side the few draws are averaged; the errors' statistics change more
slowly."""
_LOWEST_HZ, _FREQUENCIES, _ABOVE = 1e-2, 6000, 1e3
"""Of the spectra: the lowest frequency, their number, and the highest one over the low-pass's."""


def accelerations_of(
    solution: Solution, draws: Draws, inertia: Inertia | None = None
) -> Accelerations | None:
    """Return the bubbles' accelerations at a solution.

    They are None if there are no bubbles, or if the covariances were not computed.

    draws : at the solution.  inertia : the low-pass; None to learn it.
    """
    graph, found = solution.graph, solution.covariances
    if found is None or not graph.rows:
        return None
    rig = _rig_errors(solution, draws)
    inertia = inertia or _learned(solution, rig)
    value, covariance = np.empty((graph.rows, 3)), np.empty((graph.rows, 3, 3))
    ends = graph.first_row[1:]
    portions = np.split(
        np.arange(len(ends)), np.flatnonzero(np.diff((ends - 1) // _ROWS_AT_ONCE)) + 1
    )
    for some in portions:
        pieces = [np.arange(graph.first_row[i], ends[i]) for i in some]
        rows = slice(int(pieces[0][0]), int(pieces[-1][-1]) + 1)
        chains = _Chains(solution, rig, pieces, inertia)
        value[rows], covariance[rows] = chains.accelerations()
    processes = [inertial_bubble_path(graph.model.bubble, axis, inertia) for axis in np.eye(3)]
    variance = np.diagonal(covariance, axis1=1, axis2=2).mean(0)
    highest = _ABOVE / (2 * np.pi * inertia.time_s)
    band = [_bandwidth_hz(p, v, highest) for p, v in zip(processes, variance.tolist(), strict=True)]
    return Accelerations(value, covariance, np.array(band), inertia)


_RigErrors = tuple[Array, Array]
"""Draws of the errors of shake (N, D, K) and constants (n, K)."""


def _rig_errors(solution: Solution, draws: Draws) -> _RigErrors:
    """Widened by what was learned, which the draws do not know."""
    graph, found = solution.graph, solution.covariances
    shake, constants = draws.of_family(graph, 0), draws.of_family(graph, 4)[0]
    if found is None or not graph.model.learned or not graph.shake.size:
        return shake, constants
    rows = graph.shake.offset[:-1].reshape(-1, graph.shake.size)
    each = [graph.shake_at_frames(graph.shake_moved(one)) for one in np.moveaxis(shake, -1, 0)]
    variance = np.mean([np.mean((moved @ rows.T) ** 2) for moved in each])
    stated = np.mean(((rows @ found.shake) * rows).sum(-1))
    return shake * (np.sqrt(max(stated / variance, 1.0)) if variance > 0 else 1.0), constants


class _Chains:
    """Pieces of tracks under the smoother prior, solved for the rig's mean and for its draws."""

    def __init__(
        self, solution: Solution, rig: _RigErrors, pieces: list[Ints], inertia: Inertia
    ) -> None:
        """pieces : of each the rows in the solution's graph."""
        whole, every = solution.graph, np.concatenate(pieces)
        problem, row_of = whole.problem, np.full(whole.rows, -1)
        row_of[every] = np.repeat(np.arange(len(pieces)), [len(p) for p in pieces])
        piece = row_of[whole.row(problem.observations.item, problem.observations.frame)]
        place = solution.state.bubbles[every] @ whole.bubble.position.T
        speed = solution.state.bubbles[every] @ whole.bubble.velocity.T
        frame, ends = whole.frame_of_row, np.cumsum([len(p) for p in pieces])
        bubbles = [
            Bubble(i, int(frame[p[0]]), int(frame[p[-1]]), place[end - len(p)], np.zeros((0, 3)))
            for i, (p, end) in enumerate(zip(pieces, ends, strict=True))
        ]
        seen = replace(problem.observations.of(piece >= 0), item=piece[piece >= 0])
        layout = bubble_layout(whole.model.bubble, len(problem.cameras), inertia)
        self.graph = graph = with_bubbles(whole, bubbles, seen, layout)
        states = np.zeros((graph.rows, layout.size))
        states[:, layout.path_position], states[:, layout.path_velocity] = place, speed
        means = solution.state.means[whole.bubble_of_row[[p[0] for p in pieces]]]
        self.state = state = replace(solution.state, bubbles=states, means=means)
        prior = bubble_priors(graph, state)
        pixels = images(graph, state, solution.weights[0][piece >= 0]).linear
        self.chains = bubble_chains(graph, [*prior, *pixels])
        self.factors = [*prior, *pixels]
        self._solve(len(prior), rig)

    def _solve(self, priors: int, rig: _RigErrors) -> None:
        """found : (D, 1 + K) increments.  own : the chains' factors.  sides : their right sides."""
        graph, (shake, constants) = self.graph, rig
        first, size, draws = graph.base().bubbles, graph.bubble.size, shake.shape[-1]
        starts = np.r_[
            size * np.arange(graph.rows),
            size * graph.rows + 3 * np.arange(len(graph.problem.bubbles) + 1),
        ]
        own, sides = list[LinearFactors](), list[Array]()
        for number, linear in enumerate(self.factors):
            pushed = np.zeros((*linear.rhs.shape, draws))
            chain = [i for i in range(len(linear.keys)) if number < priors or i == 0]
            if number >= priors:
                pushed -= linear.blocks[1] @ shake[np.asarray(linear.keys[1])]
                pushed -= linear.blocks[2] @ constants
            keys = tuple(np.asarray(linear.keys[i]) - first for i in chain)
            own.append(replace(linear, keys=keys, blocks=tuple(linear.blocks[i] for i in chain)))
            sides.append(np.concatenate([linear.rhs[..., None], pushed], -1))
        self.found = self._solved(transposed_product(own, starts, sides))
        self.own, self.starts, self.sides = own, starts, sides

    def _solved(self, side: Array) -> Array:
        graph, places = self.graph, self.chains.places
        cut, count = graph.rows * graph.bubble.size, side.shape[-1]
        rows = np.empty((graph.rows, graph.bubble.size, count))
        rows[places.place_of_row] = side[:cut].reshape(rows.shape)
        rows, means = self.chains.solved(rows, side[cut:].reshape(-1, 3, count)[places.order])
        back = np.empty_like(means)
        back[places.order] = means
        return np.concatenate(
            [rows[places.place_of_row].reshape(cut, count), back.reshape(-1, count)]
        )

    def accelerations(self) -> tuple[Array, Array]:
        """Return the accelerations (rows, 3) and their covariances (rows, 3, 3)."""
        graph = self.graph
        every = np.arange(graph.rows)
        rows = graph.in_bubble_basis(graph.bubble.acceleration[None], every)
        found = self.found[: graph.rows * graph.bubble.size]
        moved = rows @ found.reshape(graph.rows, graph.bubble.size, -1)
        value = self.state.bubbles @ graph.bubble.acceleration.T + moved[..., 0]
        own = self.chains.covariances(self.chains.places.place_of_row)
        covariance = rows @ own @ np.swapaxes(rows, -1, -2)
        errors = moved[..., 1:]
        by_rig = errors @ np.swapaxes(errors, -1, -2) / max(errors.shape[-1], 1)
        return value, covariance + self._pooled(by_rig)

    def _pooled(self, values: Array) -> Array:
        """Means of values (rows, 3, 3) over neighbours in time, each bubble by itself."""
        from scipy.ndimage import uniform_filter1d

        t_s, first = self.graph.problem.t_s, self.graph.first_row
        step = float(np.median(np.diff(t_s))) if len(t_s) > 1 else np.inf
        width = 1 + 2 * int(_POOLED_S / step)
        parts = [values[a:b] for a, b in pairwise(first)]
        return np.concatenate([uniform_filter1d(p, width, axis=0, mode="reflect") for p in parts])

    def log_likelihood(self) -> float:
        """Return its expectation over the draws of the rig, up to a constant."""
        basis = np.linalg.slogdet(self.graph.bubble_motion.basis)[1]
        norm = float(basis[self.graph.row_basis].sum()) + sum(f.log_norm() for f in self.factors)
        fitted = product(self.own, self.starts, self.found)
        left = [np.subtract(a, b, out=b) for a, b in zip(self.sides, fitted, strict=True)]
        total = np.sum([(one**2).reshape(-1, one.shape[-1]).sum(0) for one in left], axis=0)
        spread = float(total[1:].mean()) if len(total) > 1 else 0.0
        return norm - self.chains.log_det - (float(total[0]) + spread) / 2


def _learned(solution: Solution, rig: _RigErrors) -> Inertia:
    """Return the most probable low-pass, with forces along the rise and across it.

    It decides how much acceleration a bubble has that the images do not show.
    """
    from scipy.optimize import minimize

    graph = solution.graph
    given, rise = graph.model.bubble.inertia_s, np.square(graph.problem.up)
    cuts = [
        np.array_split(np.arange(a, b), -(-(b - a) // _PIECE_FRAMES))
        for a, b in pairwise(graph.first_row.tolist())
    ]
    pieces = [piece for cut in cuts for piece in cut]
    count = min(len(pieces), -(-LEARNED_ROWS * len(pieces) // graph.rows))
    chosen = np.unique(np.linspace(0, len(pieces) - 1, count).astype(int))
    some = [pieces[i] for i in chosen]
    few = (rig[0][..., :_LEARNED_DRAWS], rig[1][..., :_LEARNED_DRAWS])
    priors = [FORCES, FORCES, INERTIA_S][: 3 if given is None else 2]

    def values_at(place: Array) -> Array:
        """Intensities along and across the rise, and time, from logarithms over steps."""
        return np.array([p.median * np.exp(p.step * x) for p, x in zip(priors, place, strict=True)])

    def inertia_at(values: Array) -> Inertia:
        along, across = values[:2]
        x, y, z = (across + (along - across) * rise).tolist()
        return Inertia(float(values[2]) if given is None else given, (x, y, z))

    def score(place: Array) -> float:
        values = values_at(place)
        chains = _Chains(solution, few, some, inertia_at(values))
        return -chains.log_likelihood() - sum(p.log_density(v) for p, v in zip(priors, values))

    bounds = [np.log([p.low / p.median, p.high / p.median]) / p.step for p in priors]
    start = np.zeros(len(priors))
    simplex = np.vstack([start, np.eye(len(priors))])
    options = {"initial_simplex": simplex, "xatol": 0.3, "fatol": 1.0, "maxfev": _MOST_TRIALS}
    best = minimize(score, start, method="Nelder-Mead", bounds=bounds, options=options)
    return inertia_at(values_at(best.x))


def _bandwidth_hz(process: Component, variance: float, highest_hz: float) -> float:
    """Return the frequency at which a smoother passes half of a process's acceleration.

    variance : of the acceleration after smoothing. White noise of the positions that leaves so much
    is compared with the process's spectrum.
    """
    from scipy.optimize import brentq

    frequency = np.geomspace(_LOWEST_HZ, highest_hz, _FREQUENCIES)
    omega = 2 * np.pi * frequency
    swing = 1j * omega[:, None, None] * np.eye(process.size) - process.drift
    gain = np.linalg.solve(swing, process.noise[None])
    density = 2 * (np.abs(process.position @ gain) ** 2).sum(-1)

    def left(log_noise: float) -> float:
        after = density / (1 + density / np.exp(log_noise))
        return float(np.trapezoid(omega**4 * after, frequency)) / variance - 1

    low, high = np.log(density.min() * 1e-3), np.log(density.max() * 1e3)
    if left(high) <= 0:
        return 0.0
    if left(low) >= 0:
        return float(frequency[-1])
    followed = np.flatnonzero(density > np.exp(brentq(left, low, high, xtol=1e-3)))
    return float(frequency[followed[-1]]) if len(followed) else 0.0
