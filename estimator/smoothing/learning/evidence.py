"""Marginal likelihood and posterior of one channel, from the Cholesky factor of its chain.

The precision of a chain of states is block-tridiagonal and eliminated frame by frame. Constants
(mean velocities, places of marks) are eliminated after the chain. The evidence equals the graph's,
channel by channel (see tests/test_shake_learning.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoothing.graph.block_tridiagonal import eliminated
from telerig.estimator.smoothing.learning.lines_of_sight import Channel
from telerig.estimator.smoothing.learning.processes import bubble_processes, shake_processes
from telerig.estimator.smoothing.problem.problem import CARRIAGE, ShakeModel
from telerig.factors.measurements import whitener_of
from telerig.factors.motion import Motion, motion, start
from telerig.factors.state_space import Component, slow_ou

Array = NDArray[np.float64]

_STILL_MM = 1e-6


@dataclass(frozen=True)
class ChannelPosterior:
    """log_evidence : of the measurements.  position_mm : (B, F) of the moving items, lab, along
    the direction, less their start.  offset_mm : (J, F) of each camera.

    Of a channel of R replicates (B R, F) and (J R, F), those of an item one after the other.
    """

    log_evidence: float
    position_mm: Array
    velocity_mm_s: Array
    offset_mm: Array


@dataclass(frozen=True)
class _System:
    """States per frame: the shake's components , then each moving item's.

    rows : (P, D) that read a pair's measurement.  columns : (F, P, c) effects of the constants.
    prior_sigma : (c,).  offset : (J, D).
    """

    components: tuple[Component, ...]
    rows: Array
    offset: Array
    position: Array
    velocity: Array
    columns: Array
    prior_sigma: Array


def channel_evidence(channel: Channel, model: ShakeModel) -> float:
    """Natural log of the density of the channel's measurements."""
    return Factor(channel, model).log_evidence()


def channel_posterior(channel: Channel, model: ShakeModel) -> ChannelPosterior:
    """Evidence and means."""
    return Factor(channel, model).posterior()


def position_sigma(channel: Channel, model: ShakeModel, frames: NDArray[np.int64]) -> Array:
    """(B, n) standard deviation of the moving items' positions at some frames."""
    return Factor(channel, model).position_sigma(frames)


def _system(channel: Channel, model: ShakeModel) -> _System:
    shake = [(p.component, p.camera) for p in shake_processes(channel, model)]
    bubble = [p.component for p in bubble_processes(channel, model)]
    if not shake and not channel.moving.any():
        shake = [(slow_ou(_STILL_MM, 1.0), CARRIAGE)]
    parts = [c for c, _ in shake] + bubble * int(channel.moving.sum())
    size, shaken = sum(c.size for c in parts), sum(c.size for c, _ in shake)
    offset = np.zeros((len(channel.cameras), size))
    at = 0
    for part, camera in shake:
        which = slice(None) if camera == CARRIAGE else channel.cameras.index(camera)
        offset[which, at : at + part.size] += part.position
        at += part.size
    width = sum(c.size for c in bubble)
    movers = np.flatnonzero(channel.moving)
    position, velocity = np.zeros((len(channel.moving), size)), np.zeros((len(movers), size))
    for k, item in enumerate(movers):
        columns = slice(shaken + k * width, shaken + (k + 1) * width)
        position[item, columns] = np.concatenate([c.position for c in bubble])
        velocity[k, columns] = np.concatenate([c.velocity for c in bubble])
    columns_, sigma = _constants(channel, model)
    rows = position[channel.item] - offset[channel.camera]
    return _System(tuple(parts), rows, offset, position[movers], velocity, columns_, sigma)


def _constants(channel: Channel, model: ShakeModel) -> tuple[Array, Array]:
    """(F, P, I): a moving item's travel at 1 mm/s, a fixed item's place; priors (I,)."""
    t = channel.t_s
    columns = np.zeros((len(t), len(channel.item), len(channel.moving)))
    for p, item in enumerate(channel.item):
        since = t - t[channel.first[item]]
        columns[:, p, item] = since if channel.moving[item] else 1.0
    speed = model.bubble.mean_sigma_mm_s / np.sqrt(channel.pooled)
    sigma = np.where(channel.moving, speed, channel.start_sigma_mm)
    return columns, sigma


class Factor:
    """The Cholesky factor of the states' precision, and the constants' after them.

    which : (F,) of each frame among ``bases``, (U + 1, D, D) in which its states are.
    rows : (U + 1, P, D).  rest : (F, P, R) measured less ``guess``.  constants : (c, R).
    """

    def __init__(self, channel: Channel, model: ShakeModel) -> None:
        self.channel = channel
        self.system = system = _system(channel, model)
        self.steps = steps = motion(system.components, np.diff(channel.t_s), batched=True)
        self.which = np.append(steps.index, len(steps.basis) - 1)
        self.bases = steps.basis
        self.weight = weight = channel.weight / model.pixel_inflation**2
        self.rows = system.rows @ self.bases
        self.guess = _fitted(channel, system, weight)
        self.rest = _replicates(channel) - system.columns @ self.guess
        self.count = self.rest.shape[-1]
        data = np.concatenate([self.rest, system.columns], -1)
        weighted = weight[..., None] * data
        own, following, self.log_prior = _chain(system, steps)
        sides = np.empty((len(own), data.shape[-1], own.shape[-1]))
        for basis, mine in runs(self.which):
            rows = self.rows[basis]
            outer = (rows[:, :, None] * rows[:, None, :]).reshape(len(rows), -1)
            own[mine] += (weight[mine] @ outer).reshape(-1, *own.shape[1:])
            sides[mine] = np.swapaxes(weighted[mine], -1, -2) @ rows
        self.chain = eliminated(own, following, sides)
        wide = data.shape[-1]
        self._fix_constants(data.reshape(-1, wide).T @ weighted.reshape(-1, wide))

    def _fix_constants(self, square: Array) -> None:
        """square : (R + c, R + c) of measurements and columns."""
        from scipy.linalg import cho_factor, cho_solve

        count, prior = self.count, 1 / self.system.prior_sigma**2
        half = np.swapaxes(self.chain.sides, 0, 1).reshape(len(square), -1)
        square = square - half @ half.T
        self.inner = cho_factor(square[count:, count:] + np.diag(prior), lower=True)
        linear = square[count:, :count] - prior[:, None] * self.guess
        self.constants = cho_solve(self.inner, linear)
        self.square = float(np.trace(square[:count, :count]) + (prior @ self.guess**2).sum())
        self.square -= float((linear * self.constants).sum())

    def log_evidence(self) -> float:
        used = self.weight[self.weight > 0]
        log_noise = 0.5 * float(np.log(used / (2 * np.pi)).sum())
        log_inner = float(np.log(np.diag(self.inner[0])).sum())
        log_sigma = float(np.log(self.system.prior_sigma).sum())
        each = log_noise + self.log_prior - self.chain.log_det() - log_inner - log_sigma
        return float(self.count * each - self.square / 2)

    def spread(self) -> tuple[Array, Array]:
        """Right sides (F, K, D) of states, and constants (c, K), whose squares add up.

        Over the replicates' posterior means, and what not knowing the constants adds: the second
        moments are the sum over K, and those of states whose constants are known.
        """
        from scipy.linalg import solve_triangular

        count, size = self.count, len(self.constants)
        unit = np.sqrt(count) * np.eye(size)
        off = solve_triangular(self.inner[0], unit, lower=True, trans="T")
        constants = np.concatenate([self.constants, off], -1)
        sides = -constants.T @ self.chain.sides[:, count:]
        sides[:, :count] += self.chain.sides[:, :count]
        return sides, constants

    def posterior(self) -> ChannelPosterior:
        system, channel, count = self.system, self.channel, self.count
        states = self.chain.means(self.spread()[0][:, :count])
        states = states @ np.swapaxes(self.bases, -1, -2)[self.which]
        movers = np.flatnonzero(channel.moving)
        speed = (self.guess + self.constants)[movers, :, None]
        since = (channel.t_s - channel.t_s[channel.first[movers], None])[:, None]
        position, velocity, offset = (
            np.einsum("bd,frd->brf", row, states, optimize=True)
            for row in (system.position, system.velocity, system.offset)
        )
        found = position + speed * since, velocity + speed, offset
        frames = len(channel.t_s)
        return ChannelPosterior(self.log_evidence(), *(a.reshape(-1, frames) for a in found))

    def position_sigma(self, frames: NDArray[np.int64]) -> Array:
        system, channel = self.system, self.channel
        movers = np.flatnonzero(channel.moving)
        sides, constants = self.spread()
        mean, own, _ = self.chain.moments(sides[:, self.count :])
        since = (channel.t_s - channel.t_s[channel.first[movers], None])[:, frames, None]
        rows = system.position @ self.bases[self.which[frames]]
        by_constant = np.einsum("fbd,fkd->bfk", rows, mean[frames])
        by_constant += since * constants[movers, None, self.count :]
        variance = np.einsum("fbd,fde,fbe->bf", rows, own[frames], rows, optimize=True)
        return np.asarray(np.sqrt(variance + (by_constant**2).sum(-1)))


def runs(index: NDArray[np.int64]) -> Iterator[tuple[int, slice | NDArray[np.int64]]]:
    """Each value of an index with where it stands, as a slice where that is one stretch."""
    order = np.argsort(index, kind="stable")
    values, first = np.unique(index[order], return_index=True)
    for value, mine in zip(values.tolist(), np.split(order, first[1:])):
        whole = mine[-1] - mine[0] + 1 == len(mine)
        yield value, slice(int(mine[0]), int(mine[-1]) + 1) if whole else mine


def _replicates(channel: Channel) -> Array:
    """(F, P, R) the measurements, R of them alike but for their values."""
    values = channel.value_mm
    return values if values.ndim == 3 else values[..., None]


def _fitted(channel: Channel, system: _System, weight: Array) -> Array:
    """(c, R) constants near the answer: what is small without them keeps its digits.

    Moving items by straight lines, what is fixed where it was guessed.
    """
    values = _replicates(channel)
    out = np.zeros((len(channel.moving), values.shape[-1]))
    for item in np.flatnonzero(channel.moving):
        mine = channel.item == item
        w, t = weight[:, mine].sum(1), channel.t_s - channel.t_s[channel.first[item]]
        if not w.any():
            continue
        mean = (weight[:, mine, None] * values[:, mine]).sum(1) / np.where(w > 0, w, 1.0)[:, None]
        off = t - (w @ t) / w.sum()
        spread = float(w @ off**2)
        if spread > 0:
            out[item] = (w * off) @ mean / spread
    return out


def _chain(system: _System, steps: Motion) -> tuple[Array, Array, float]:
    """Diagonal (F, D, D) and lower (F - 1, D, D) blocks of the prior; half log of its determinant.

    The determinant is of the states' precision in the whitening bases.
    """
    count = len(steps.basis)
    which = np.append(steps.index, count - 1)
    kind, place = np.unique(steps.index * count + which[1:], return_inverse=True)
    step, after = np.divmod(kind, count)
    last, ahead = steps.by_last[step] @ steps.basis[step], steps.by_next[step] @ steps.basis[after]
    backward, forward = (np.swapaxes(a, -1, -2) for a in (last, ahead))
    frames, size = len(which), system.rows.shape[1]
    diagonal = np.zeros((frames, size, size))
    diagonal[:-1] = (backward @ last)[place]
    diagonal[1:] += (forward @ ahead)[place]
    covariance, _ = start(system.components)
    whitener = whitener_of(covariance)
    first = whitener @ steps.basis[which[0]]
    diagonal[0] += first.T @ first
    log_det = float(np.log(np.abs(np.diag(whitener))).sum() + steps.log_det[steps.index].sum())
    each = np.linalg.slogdet(steps.basis)[1]
    return diagonal, (forward @ last)[place], log_det + float(each[which].sum())
