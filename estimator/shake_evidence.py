"""Marginal likelihood and posterior of one channel, from a banded Cholesky factor.

The precision of a chain of states is block-tridiagonal: LAPACK's `pbtrf` takes it in time linear
in the frames. Constants (mean velocities, places of marks) are eliminated after the chain. The
evidence equals the graph's, channel by channel (see tests/test_shake_learning.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.shake_channels import Channel
from telerig.estimator.shake_processes import bubble_processes, shake_processes
from telerig.estimator.smoother.model import CARRIAGE, ShakeModel
from telerig.factors.measurements import whitener_of
from telerig.factors.motion import Motion, start
from telerig.factors.motion_stack import stacked_motion
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
    """The Cholesky factor of the states' precision, and the constants' after them."""

    def __init__(self, channel: Channel, model: ShakeModel) -> None:
        from scipy.linalg import cholesky_banded

        self.channel = channel
        self.system = _system(channel, model)
        self.steps = steps = stacked_motion(self.system.components, np.diff(channel.t_s))
        self.which = np.append(steps.index, len(steps.basis) - 1)
        self.bases = steps.basis
        self.weight = weight = channel.weight / model.pixel_inflation**2
        diagonal, below, self.log_prior = _chain(self.system, steps)
        self.rows = self.system.rows @ self.bases
        size = self.rows.shape[-1]
        for basis, rows in enumerate(self.rows):
            mine = self.which == basis
            outer = (rows[:, :, None] * rows[:, None, :]).reshape(len(rows), -1)
            diagonal[mine] += (weight[mine] @ outer).reshape(-1, size, size)
        band = _banded(diagonal, below)
        self.factor = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
        self._eliminate(weight)

    def _eliminate(self, weight: Array) -> None:
        from scipy.linalg import cho_factor

        channel, system = self.channel, self.system
        guess = _fitted(channel, system, weight)
        self.guess = guess
        values = _replicates(channel)
        count = values.shape[-1]
        self.rest = values - system.columns @ guess
        data = np.concatenate([self.rest, system.columns], -1)
        weighted = weight[..., None] * data
        right = np.swapaxes(self.rows, -1, -2)[self.which] @ weighted
        self.right = right.reshape(-1, right.shape[-1])
        self.half = _solve_half(self.factor, self.right)
        wide = data.shape[-1]
        square = data.reshape(-1, wide).T @ weighted.reshape(-1, wide) - self.half.T @ self.half
        prior = 1 / system.prior_sigma**2
        inner = square[count:, count:] + np.diag(prior)
        self.inner = cho_factor(inner, lower=True)
        linear = square[count:, :count] - prior[:, None] * guess
        from scipy.linalg import cho_solve

        self.constants = cho_solve(self.inner, linear)
        self.square = float(np.trace(square[:count, :count]) + (prior @ guess**2).sum())
        self.square -= float((linear * self.constants).sum())
        self.count = count
        used = weight > 0
        self.log_noise = 0.5 * float(np.log(weight[used] / (2 * np.pi)).sum())

    def log_evidence(self) -> float:
        log_chain = float(np.log(self.factor[0]).sum())
        log_inner = float(np.log(np.diag(self.inner[0])).sum())
        log_sigma = float(np.log(self.system.prior_sigma).sum())
        each = self.log_noise + self.log_prior - log_chain - log_inner - log_sigma
        return float(self.count * each - self.square / 2)

    def _back(self, half: Array) -> Array:
        """(F, D, c) states, in the bases, from L^-1 of the right side."""
        from scipy.linalg import lapack

        solved, info = lapack.dtbtrs(self.factor, half, uplo="L", trans="T")
        assert info == 0
        return np.asarray(solved.reshape(len(self.which), -1, half.shape[1]))

    def blocks(self) -> tuple[Array, Array]:
        """(F, D, D) and (F - 1, D, D): the Cholesky factor's blocks on and below the diagonal."""
        frames, size = len(self.which), self.rows.shape[-1]
        band = self.factor.T.reshape(-1)
        lower, under = np.zeros((2, frames, size, size))
        view = band.reshape(frames, size, 2 * size)
        for j in range(size):
            lower[:, j:, j] = view[:, j, : size - j]
            under[:, :, j] = view[:, j, size - j : 2 * size - j]
        return lower, under[:-1]

    def spread(self) -> tuple[Array, Array]:
        """States (F, K, D), in the bases, and constants (c, K), whose squares add up.

        Over the replicates' posterior means, and what not knowing the constants adds: the second
        moments are the sum over K, and those of states whose constants are known.
        """
        from scipy.linalg import solve_triangular

        first, count = self.half[:, : self.count], self.count
        by_constant = self.half[:, count:]
        unit = np.sqrt(count) * np.eye(by_constant.shape[1])
        off = solve_triangular(self.inner[0], unit, lower=True, trans="T")
        constants = np.concatenate([self.constants, off], -1)
        mixed = -by_constant @ constants
        mixed[:, :count] += first
        return np.swapaxes(self._back(mixed), -1, -2), constants

    def posterior(self) -> ChannelPosterior:
        system, channel, count = self.system, self.channel, self.count
        mixed = self.half[:, :count] - self.half[:, count:] @ self.constants
        states = self.bases[self.which] @ self._back(mixed)
        movers = np.flatnonzero(channel.moving)
        speed = (self.guess + self.constants)[movers, :, None]
        since = (channel.t_s - channel.t_s[channel.first[movers], None])[:, None]
        position, velocity, offset = (
            np.einsum("bd,fdr->brf", row, states, optimize=True)
            for row in (system.position, system.velocity, system.offset)
        )
        found = position + speed * since, velocity + speed, offset
        frames = len(channel.t_s)
        return ChannelPosterior(self.log_evidence(), *(a.reshape(-1, frames) for a in found))

    def position_sigma(self, frames: NDArray[np.int64]) -> Array:
        from scipy.linalg import cho_solve

        system, channel = self.system, self.channel
        movers, size = np.flatnonzero(channel.moving), self.system.rows.shape[1]
        count = len(movers) * len(frames)
        unit = np.zeros((len(self.right), count))
        by_constant = np.zeros((count, len(channel.moving)))
        for k, item in enumerate(movers):
            for i, f in enumerate(frames):
                column = k * len(frames) + i
                row = system.position[k] @ self.bases[self.which[f]]
                unit[f * size : (f + 1) * size, column] = row
                by_constant[column, item] = channel.t_s[f] - channel.t_s[channel.first[item]]
        half = _solve_half(self.factor, unit)
        rest = by_constant - half.T @ self.half[:, 1:]
        variance = (half**2).sum(0) + (rest * cho_solve(self.inner, rest.T).T).sum(-1)
        return np.asarray(np.sqrt(variance)).reshape(len(movers), len(frames))


def _solve_half(factor: Array, right: Array) -> Array:
    from scipy.linalg import lapack

    solved, info = lapack.dtbtrs(factor, right, uplo="L")
    assert info == 0
    return np.asarray(solved)


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


def _banded(diagonal: Array, below: Array) -> Array:
    """(2 D, F D) lower form of `scipy.linalg.cholesky_banded`, a column after the other."""
    frames, size, _ = diagonal.shape
    out = np.zeros((frames, size, 2 * size))
    for b in range(size):
        out[:, b, : size - b] = diagonal[:, b:, b]
        out[:-1, b, size - b : 2 * size - b] = below[:, :, b]
    return out.reshape(frames * size, 2 * size).T
