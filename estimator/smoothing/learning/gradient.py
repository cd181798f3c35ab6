"""Slope of a channel's evidence by its hyper-parameters, all at the price of a few evaluations.

Fisher's identity: the derivative of the log evidence is the posterior mean of the derivative of the
log density of states and measurements together (Cappe, Moulines, Ryden, Inference in Hidden Markov
Models, 2005, sec. 10.1.3). That density is a sum over independent processes, each a function of its
own few states: second moments of these, summed over the frames, are all that is needed of the
posterior; what a parameter does to a process of two or four states is cheap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoothing.learning.evidence import Factor, runs
from telerig.estimator.smoothing.learning.lines_of_sight import Channel
from telerig.estimator.smoothing.learning.processes import (
    Process,
    bubble_processes,
    shake_processes,
)
from telerig.estimator.smoothing.problem.problem import ShakeModel
from telerig.factors.state_space import Component, Steps, discretise, distinct_steps

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

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
class _Change:
    """A process with one hyper-parameter moved.

    process : place among the channel's.  name : index into the names.  sign : up or down.
    """

    process: int
    name: int
    sign: int
    component: Component


def channel_slope(channel: Channel, model: ShakeModel, names: Sequence[str]) -> tuple[float, Array]:
    """The log evidence, as `channel_evidence`, and (n,) its derivatives by log-parameters."""
    factor = Factor(channel, model)
    moments = _moments(factor)
    slope = np.zeros(len(names))
    if "pixel_inflation" in names:
        seen = factor.count * int((channel.weight > 0).sum())
        slope[names.index("pixel_inflation")] = moments.residual - seen
    shake, bubble = shake_processes(channel, model), bubble_processes(channel, model)
    changes = _changes([*shake, *bubble], names)
    if changes:
        expected = _expected(factor, moments, shake, bubble, changes)
        for change, value in zip(changes, expected):
            slope[change.name] += change.sign * value / (2 * _DIFFERENCE)
    return factor.log_evidence(), slope


def _changes(found: list[Process], names: Sequence[str]) -> list[_Change]:
    where = {name: i for i, name in enumerate(names)}
    return [
        _Change(i, where[name], sign, p.moved(last, np.exp(sign * _DIFFERENCE)))
        for i, p in enumerate(found)
        for name, last in p.names.items()
        if name in where
        for sign in (1, -1)
    ]


@dataclass(frozen=True)
class _Places:
    """begin : (N + 1,) first state of each process.  copies : (N,) of it, ``width`` apart."""

    begin: Ints
    copies: Ints
    width: int

    def moments(self, found: _Moments, which: Ints) -> tuple[Array, Array]:
        """(m, U, 2 n, 2 n) and (m, n, n): those of processes of n states, their copies' summed."""
        size, count = len(found.start), self.copies[which]
        states = np.arange(self.begin[which[0] + 1] - self.begin[which[0]])
        step, start = np.zeros(()), np.zeros(())
        for k in range(max(count)):
            used = (count > k)[:, None, None]
            at = self.begin[which, None] + states + np.minimum(k, count - 1)[:, None] * self.width
            both = np.concatenate([at, size + at], -1)
            more = found.step[:, both[:, :, None], both[:, None]]
            step = step + used[:, None] * np.swapaxes(more, 0, 1)
            start = start + used * found.start[at[:, :, None], at[:, None]]
        return step, start


def _expected(
    factor: Factor,
    found: _Moments,
    shake: list[Process],
    bubble: list[Process],
    changes: list[_Change],
) -> Array:
    """(changes,) posterior mean of the states' log density, were a process like the change's."""
    dt_s, index = distinct_steps(np.diff(factor.channel.t_s))
    counts = np.bincount(index, minlength=len(dt_s))
    own = [p.component for p in (*shake, *bubble)]
    begin = np.r_[0, np.cumsum([c.size for c in own])]
    copies = np.repeat([1, int(factor.channel.moving.sum())], [len(shake), len(bubble)])
    places = _Places(begin, copies, int(begin[-1] - begin[len(shake)]))
    process = np.array([c.process for c in changes])
    out = np.zeros(len(changes))
    for stack in discretise([*own, *(c.component for c in changes)], dt_s):
        new = np.flatnonzero(stack.which >= len(own))
        if not len(new):
            continue
        mine = stack.which[new] - len(own)
        which = process[mine]
        old = np.searchsorted(stack.which, which)
        step, start = places.moments(found, which)
        rows = _noise_rows(stack, old, new)
        square = ((rows @ step) * rows).sum((1, 2, 3))
        square += ((stack.start[new] @ start) * stack.start[new]).sum((1, 2))
        log_det = stack.log_det[new] @ counts + stack.start_log_det[new]
        out[mine] = factor.count * copies[which] * log_det - square / 2
    return out


def _noise_rows(stack: Steps, old: Ints, new: Ints) -> Array:
    """(m, U, n, 2 n) whitened noise under new processes, from that under old ones and the state."""
    one, two = (np.swapaxes(stack.whitener[at], -1, -2) for at in (old, new))
    same = np.swapaxes(np.linalg.solve(one, two), -1, -2)
    moved = stack.whitener[new] @ (stack.transition[old] - stack.transition[new])
    return np.concatenate([same, moved], -1)


def _moments(factor: Factor) -> _Moments:
    steps, count = factor.steps, factor.count
    sides, constants = factor.spread()
    states, own, below = factor.chain.moments(sides)
    lengths, size = len(steps.by_next), own.shape[-1]
    total = np.zeros((lengths, 2 * size, 2 * size))
    for kind, some in runs(steps.index * (lengths + 1) + factor.which[1:]):
        step, after = divmod(kind, lengths + 1)
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
    return _Moments(total, start, _residual(factor, states, constants, own))


def _residual(factor: Factor, states: Array, constants: Array, own: Array) -> float:
    """Posterior mean of the measurements' chi-square.  constants : (c, K)."""
    weight, count, total = factor.weight, factor.count, 0.0
    values = -factor.system.columns @ constants
    values[..., :count] += factor.rest
    for basis, mine in runs(factor.which):
        rows = factor.rows[basis]
        off = values[mine] - np.swapaxes(states[mine] @ rows.T, -1, -2)
        total += float((weight[mine] * (off**2).sum(-1)).sum())
        mean = (weight[mine].T @ own[mine].reshape(len(off), -1)).reshape(-1, *own.shape[1:])
        total += count * float(((rows[:, None] @ mean)[:, 0] * rows).sum())
    return total
