"""The bubbles' velocity and acceleration, after a run is solved: each bubble by itself, under a
smoother prior.

White noise drives the bubbles of the smoothing graph, so that their acceleration has no finite
variance. Here their forces pass a low-pass (`factors.bubble_motion.inertial_bubble_path`), and the
acceleration is a state. Positions stay those of the graph.

Given the rig the bubbles are independent chains (`bubble_chains`). The rig's posterior under the
graph's prior takes the place of that under the smoother one: the chains are solved for the rig's
mean, which gives the motion, and for draws of its errors, whose covariance is added to that of the
chains.

The stated covariance of a pixel contains what the bubble's unknown shape adds. That part changes
slowly: it belongs to a position, not to a velocity. So the white noise is learned together with
the low-pass (`low_pass`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.bubble_chains import bubble_chains
from telerig.estimator.smoothing.graph.draws import Draws
from telerig.estimator.smoothing.graph.layout import (
    GraphLayout,
    bubble_layout,
    with_bubbles,
)
from telerig.estimator.smoothing.graph.linear import bubble_priors, images
from telerig.estimator.smoothing.graph.low_pass import RigErrors, learned_low_passes
from telerig.estimator.smoothing.graph.solve import Accelerations, Solution
from telerig.estimator.smoothing.problem.problem import Bubble, Observations
from telerig.factors.bubble_motion import Inertia, LowPasses, inertial_bubble_path
from telerig.factors.linear_factors import LinearFactors, transposed_product
from telerig.factors.state_space import Component
from telerig.rig.triangulation import stacked_jacobian

_ROWS_AT_ONCE = 20_000
_LEAST_RISE, _STILL_MM_S = 1e-6, 1e-9
_POOLED_S = 0.1
"""Over so much time on either side the few draws are averaged; the errors' statistics change more
slowly."""
_LOWEST_HZ, _FREQUENCIES, _ABOVE = 1e-2, 6000, 1e3
"""Of the spectra: the lowest frequency, their number, and the highest one over the low-pass's."""


def accelerations_of(
    solution: Solution, draws: Draws, low_passes: LowPasses | None = None
) -> Accelerations | None:
    """Return the bubbles' velocities and accelerations at a solution.

    They are None if there are no bubbles, or if the covariances were not computed.

    draws : at the solution.  low_passes : None to learn them.
    """
    graph, found = solution.graph, solution.covariances
    if found is None or not graph.rows:
        return None
    rig = _rig_errors(solution, draws)
    low_passes = low_passes or learned_low_passes(solution, rig)
    probable, shortest, _ = low_passes
    velocity, value = np.empty((2, graph.rows, 3))
    velocity_covariance, covariance = np.empty((2, graph.rows, 3, 3))
    ways = list[tuple[Array, Array]]()
    for rows, chains in _chains(solution, rig, shortest):
        velocity[rows], velocity_covariance[rows] = chains.moments(chains.graph.bubble.velocity)
        ways.append(chains.way_variances(velocity[rows]))
    for rows, chains in _chains(solution, rig, probable):
        value[rows], covariance[rows] = chains.moments(chains.graph.bubble.acceleration)
    variance = np.diagonal(covariance, axis1=1, axis2=2).mean(0)
    band = [
        _bandwidth_hz(
            inertial_bubble_path(graph.model.bubble, axis, probable),
            float(one), _ABOVE / (2 * np.pi * time_s),
        )
        for axis, one, time_s in zip(np.eye(3), variance, probable.time_s, strict=True)
    ]  # fmt: skip
    displacement, length = (np.concatenate(parts) for parts in zip(*ways, strict=True))
    return Accelerations(
        velocity, velocity_covariance, displacement, length, value, covariance, np.array(band),
        low_passes,
    )  # fmt: skip


def _chains(
    solution: Solution, rig: RigErrors, inertia: Inertia
) -> Iterator[tuple[slice, _Chains]]:
    """Yield some bubbles after the other, with their rows in the solution's graph."""
    graph = solution.graph
    ends = graph.first_row[1:]
    portions = np.split(
        np.arange(len(ends)), np.flatnonzero(np.diff((ends - 1) // _ROWS_AT_ONCE)) + 1
    )
    for some in portions:
        bubbles = [np.arange(graph.first_row[i], ends[i]) for i in some]
        rows = slice(int(bubbles[0][0]), int(bubbles[-1][-1]) + 1)
        yield rows, _Chains(solution, rig, bubbles, inertia)


def _rig_errors(solution: Solution, draws: Draws) -> RigErrors:
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
        self, solution: Solution, rig: RigErrors, pieces: list[Ints], inertia: Inertia
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
        seen = _of_white_noise(seen, whole, inertia)
        layout = bubble_layout(whole.model.bubble, len(problem.cameras), inertia)
        self.graph = graph = with_bubbles(whole, bubbles, seen, layout)
        states = np.zeros((graph.rows, layout.size))
        states[:, layout.path_position], states[:, layout.path_velocity] = place, speed
        means = solution.state.means[whole.bubble_of_row[[p[0] for p in pieces]]]
        self.state = state = replace(solution.state, bubbles=states, means=means)
        prior = bubble_priors(graph, state)
        pixels = images(graph, state, solution.weights[0][piece >= 0]).linear
        self.chains = bubble_chains(graph, [*prior, *pixels])
        self._solve(prior, pixels, rig)

    def _solve(
        self, priors: list[LinearFactors], pixels: list[LinearFactors], rig: RigErrors
    ) -> None:
        """found : (D, 1 + K) increments."""
        graph, (shake, constants) = self.graph, rig
        first, size, draws = graph.base().bubbles, graph.bubble.size, shake.shape[-1]
        starts = np.r_[
            size * np.arange(graph.rows),
            size * graph.rows + 3 * np.arange(len(graph.problem.bubbles) + 1),
        ]
        own, sides = list[LinearFactors](), list[Array]()
        for number, linear in enumerate([*priors, *pixels]):
            pushed = np.zeros((*linear.rhs.shape, draws))
            chain = [i for i in range(len(linear.keys)) if number < len(priors) or i == 0]
            if number >= len(priors):
                pushed -= linear.blocks[1] @ shake[np.asarray(linear.keys[1])]
                pushed -= linear.blocks[2] @ constants
            keys = tuple(np.asarray(linear.keys[i]) - first for i in chain)
            own.append(replace(linear, keys=keys, blocks=tuple(linear.blocks[i] for i in chain)))
            sides.append(np.concatenate([linear.rhs[..., None], pushed], -1))
        self.found = self._solved(transposed_product(own, starts, sides))

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

    def moments(self, wanted: Array) -> tuple[Array, Array]:
        """Return linear combinations (rows, 3) of the states, and covariances (rows, 3, 3)."""
        graph = self.graph
        every = np.arange(graph.rows)
        rows = graph.in_bubble_basis(wanted[None], every)
        found = self.found[: graph.rows * graph.bubble.size]
        moved = rows @ found.reshape(graph.rows, graph.bubble.size, -1)
        value = self.state.bubbles @ wanted.T + moved[..., 0]
        own = self.chains.covariances(self.chains.places.place_of_row)
        covariance = rows @ own @ np.swapaxes(rows, -1, -2)
        errors = moved[..., 1:]
        by_rig = errors @ np.swapaxes(errors, -1, -2) / max(errors.shape[-1], 1)
        return value, covariance + self._pooled(by_rig)

    def way_variances(self, velocity: Array) -> tuple[Array, Array]:
        """Return variances in mm^2 of the displacement (bubbles, 3) from each track's first frame
        to its last one, and of the length (bubbles,) of the way.

        velocity : (rows, 3), whose directions the steps of the way have.
        """
        graph = self.graph
        first, last = graph.first_row[:-1], graph.first_row[1:] - 1
        along = velocity / np.maximum(np.linalg.norm(velocity, axis=-1, keepdims=True), _STILL_MM_S)
        step = (along[1:] + along[:-1]) / 2
        step[last[:-1]] = 0.0
        by_place = np.zeros((graph.rows, 3, 4))
        by_place[last, :, :3] += np.eye(3)
        by_place[first, :, :3] -= np.eye(3)
        by_place[1:, :, 3] += step
        by_place[:-1, :, 3] -= step
        rows = graph.in_bubble_basis(graph.bubble.position[None], np.arange(graph.rows))
        by_state = rows.mT @ by_place
        cut = graph.rows * graph.bubble.size
        errors = self.found[:cut, 1:].reshape(graph.rows, graph.bubble.size, -1)
        moved = np.add.reduceat(np.einsum("nsk,nsd->nkd", by_state, errors), first)
        side = np.zeros((len(self.found), 4))
        side[:cut] = by_state.reshape(cut, 4)
        own = (by_state * self._solved(side)[:cut].reshape(by_state.shape)).sum(1)
        variance = np.add.reduceat(own, first) + (moved**2).sum(-1) / max(errors.shape[-1], 1)
        return variance[:, :3], variance[:, 3]

    def _pooled(self, values: Array) -> Array:
        """Average values (rows, 3, 3) over neighbours in time, each bubble by itself."""
        from scipy.ndimage import uniform_filter1d

        t_s, first = self.graph.problem.t_s, self.graph.first_row
        step = float(np.median(np.diff(t_s))) if len(t_s) > 1 else np.inf
        width = 1 + 2 * int(_POOLED_S / step)
        parts = [values[a:b] for a, b in pairwise(first)]
        return np.concatenate([uniform_filter1d(p, width, axis=0, mode="reflect") for p in parts])


def _of_white_noise(seen: Observations, graph: GraphLayout, inertia: Inertia) -> Observations:
    """Return pixels with the covariance of their white noise alone."""
    along, across = inertia.noise
    scale = []
    for camera in graph.problem.cameras:
        rise = stacked_jacobian((camera,), np.zeros((1, 3)))[1][0] @ graph.problem.up
        length = np.linalg.norm(rise)
        rise = rise / length if length > _LEAST_RISE else np.zeros(2)
        scale.append(across * np.eye(2) + (along - across) * np.outer(rise, rise))
    each = np.array(scale)[seen.camera]
    return replace(seen, covariance_px2=each @ seen.covariance_px2 @ each)


def _bandwidth_hz(process: Component, variance: float, highest_hz: float) -> float:
    """Return the frequency at which a smoother passes half of a process's acceleration.

    variance : of the acceleration after smoothing. White noise of the positions that leaves so much
    is compared with the process's spectrum.
    """
    from scipy.optimize import brentq

    frequency = np.geomspace(_LOWEST_HZ, highest_hz, _FREQUENCIES)
    omega = 2 * np.pi * frequency
    density = process.density(frequency)

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
