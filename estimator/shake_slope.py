"""Slope of a channel's evidence by its hyper-parameters, all at the price of a few evaluations.

Fisher's identity: the derivative of the log evidence is the posterior mean of the derivative of the
log density of states and measurements together (Cappe, Moulines, Ryden, Inference in Hidden Markov
Models, 2005, sec. 10.1.3). That density is a sum over independent processes, each a function of its
own few states: second moments of these, summed over the frames, are all that is needed of the
posterior. They come from the blocks of the inverse of the banded precision beside its diagonal
(Takahashi's recursion); what a parameter does to a process of two or four states is cheap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.shake_channels import Channel
from telerig.estimator.shake_evidence import Factor, processes, shake_components
from telerig.estimator.shake_parameters import value_of, with_values
from telerig.estimator.smoother.model import ShakeModel
from telerig.factors.measurements import whitener_of
from telerig.factors.state_space import Component, Steps, discretise

Array = NDArray[np.float64]

_DIFFERENCE = 1e-4


@dataclass(frozen=True)
class _Moments:
    """Second moments under the posterior, summed over replicates.

    step : (U, 2 D, 2 D) of (w, x), the whitened noise of a step and the state before it, summed
    over the steps of one length.  start : (D, D) of the first state.  residual : of the whitened
    measurements less what is predicted, summed.
    """

    step: Array
    start: Array
    residual: float


@dataclass(frozen=True)
class _Process:
    """One process of the channel, or several alike: ``copies`` of them.

    steps : of ``component``.  counts : (U,) steps of each length, ``dt_s`` (U,).
    moments, start : (U, 2 n, 2 n), (n, n) as `_Moments`, summed over the copies.
    """

    component: Component
    steps: Steps
    dt_s: Array
    counts: Array
    moments: Array
    start: Array
    copies: int

    def expected(self, component: Component) -> float:
        """Posterior mean of the states' log density were they a process like ``component``."""
        steps, last = discretise(component, self.dt_s), self.steps
        turned = np.swapaxes(last.whitener, -1, -2)
        fresh = np.swapaxes(np.linalg.solve(turned, np.swapaxes(steps.whitener, -1, -2)), -1, -2)
        moved = steps.whitener @ (last.transition - steps.transition)
        rows = np.concatenate([fresh, moved], -1)
        first = whitener_of(component.start_covariance)
        square = float(np.sum((rows @ self.moments) * rows))
        square += float(np.sum((first @ self.start) * first))
        log_det = float(self.counts @ steps.log_det + np.log(np.diag(first)).sum())
        return self.copies * log_det - square / 2


def channel_slope(
    channel: Channel, model: ShakeModel, names: Sequence[str]
) -> tuple[float, Array]:
    """The log evidence, as `channel_evidence`, and (n,) its derivatives by log-parameters."""
    factor = Factor(channel, model)
    moments = _moments(factor)
    found = _processes(factor, moments, model)
    slope = np.zeros(len(names))
    for i, name in enumerate(names):
        if name == "pixel_inflation":
            slope[i] = moments.residual - factor.count * int((channel.weight > 0).sum())
        else:
            slope[i] = _process_slope(channel, model, name, found)
    return factor.log_evidence(), slope


def _process_slope(
    channel: Channel, model: ShakeModel, name: str, found: list[_Process]
) -> float:
    at = value_of(model, name)
    up, down = (
        processes(channel, with_values(model, [name], [at * np.exp(sign * _DIFFERENCE)]))
        for sign in (1, -1)
    )
    total = 0.0
    for process, above, below in zip(found, up, down, strict=True):
        if above is not process.component:
            total += process.expected(above) - process.expected(below)
    return total / (2 * _DIFFERENCE)


def _processes(factor: Factor, moments: _Moments, model: ShakeModel) -> list[_Process]:
    channel = factor.channel
    lengths, first, counts = np.unique(factor.steps.index, return_index=True, return_counts=True)
    assert len(lengths) == len(factor.steps.by_next)
    dt_s = np.diff(channel.t_s)[first]
    out, at, size = [], 0, len(moments.start)
    shake = len(shake_components(channel, model))
    parts = processes(channel, model)
    movers = int(channel.moving.sum())
    width = sum(c.size for c in parts[shake:])
    for i, part in enumerate(parts):
        copies = 1 if i < shake else movers
        step, start = 0.0, 0.0
        for k in range(copies):
            mine = np.arange(at, at + part.size) + k * width
            both = np.r_[mine, size + mine]
            step = step + moments.step[:, both[:, None], both]
            start = start + moments.start[mine[:, None], mine]
        at += part.size
        steps = discretise(part, dt_s)
        alike = factor.count * copies
        out.append(
            _Process(part, steps, dt_s, counts, np.asarray(step), np.asarray(start), alike)
        )
    return out


def _moments(factor: Factor) -> _Moments:
    steps, count = factor.steps, factor.count
    states, mixed = factor.spread()
    own, below = inverse_blocks(factor)
    lengths = len(steps.by_next)
    size = own.shape[-1]
    total = np.zeros((lengths, 2 * size, 2 * size))
    kinds = steps.index * (lengths + 1) + factor.which[1:]
    for kind in np.unique(kinds):
        step, after = divmod(int(kind), lengths + 1)
        mine = np.flatnonzero(kinds == kind)
        some = slice(mine[0], mine[-1] + 1) if len(mine) == np.ptp(mine) + 1 else mine
        basis = steps.basis[step]
        last, ahead = steps.by_last[step] @ basis, steps.by_next[step] @ steps.basis[after]
        here, there, across = own[:-1][some].sum(0), own[1:][some].sum(0), below[some].sum(0)
        noise_state = ahead @ across + last @ here
        noise = noise_state @ last.T + (ahead @ there + last @ across.T) @ ahead.T
        now = states[:-1][some] @ basis.T
        new = states[1:][some] @ ahead.T + states[:-1][some] @ last.T
        both = np.concatenate([new, now], -1).reshape(-1, 2 * size)
        total[step] += both.T @ both
        total[step, :size, :size] += count * noise
        total[step, :size, size:] += count * noise_state @ basis.T
        total[step, size:, :size] += count * basis @ noise_state.T
        total[step, size:, size:] += count * basis @ here @ basis.T
    basis = factor.bases[factor.which[0]]
    begin = states[0] @ basis.T
    start = begin.T @ begin + count * basis @ own[0] @ basis.T
    return _Moments(total, start, _residual(factor, states, mixed, own))


def _residual(factor: Factor, states: Array, constants: Array, own: Array) -> float:
    """Posterior mean of the measurements' chi-square.  constants : (c, K)."""
    weight, rows = factor.weight, factor.rows
    values = np.zeros((*weight.shape, states.shape[1]))
    values[..., : factor.count] = factor.rest
    predicted = factor.system.columns @ constants
    predicted += np.swapaxes(states @ np.swapaxes(rows, -1, -2)[factor.which], -1, -2)
    square = float(np.sum(weight[..., None] * (values - predicted) ** 2))
    for basis in np.unique(factor.which):
        mine = factor.which == basis
        summed = (weight[mine].T @ own[mine].reshape(int(mine.sum()), -1)).reshape(
            -1, *own.shape[1:]
        )
        square += factor.count * float(
            np.einsum("pi,pij,pj->", rows[basis], summed, rows[basis], optimize=True)
        )
    return square


def inverse_blocks(factor: Factor) -> tuple[Array, Array]:
    """(F, D, D) and (F - 1, D, D): blocks of the inverse precision on and below the diagonal."""
    from scipy.linalg.lapack import dtrtri

    lower, under = factor.blocks()
    frames = len(lower)
    for block in lower:
        dtrtri(block.T, lower=0, overwrite_c=1)
    own = np.swapaxes(lower, -1, -2) @ lower
    gain = under @ lower[:-1]
    below = np.empty_like(gain)
    back = np.swapaxes(gain, -1, -2)
    for t in range(frames - 2, -1, -1):
        np.matmul(own[t + 1], gain[t], out=below[t])
        own[t] += back[t] @ below[t]
    return own, np.negative(below, out=below)
