"""Marginal likelihood (evidence), posterior means and gradient for one line-of-sight signal.

The precision matrix of a Markov chain of states is block tridiagonal and is eliminated frame by
frame. With H_t the precision of frame t given the earlier frames, and J_t its coupling to the next:

    L_t L_t^T = H_t,   M_t = J_t L_t^-T,   H_{t+1} -= M_t M_t^T

The covariances follow backward, with the gain G_t = M_t L_t^-1 (Takahashi, Fagan, Chin, Proc. 8th
PICA Conf., 1973):

    S_t = (L_t L_t^T)^-1 + G_t^T S_{t+1} G_t,   S_{t+1,t} = -S_{t+1} G_t

Constants (mean velocities, positions of marks) are eliminated last. The evidence is equal to that
of the graph (tests/estimator/smoothing/test_shake_learning.py).

The gradient costs as much as a few evaluations, whatever the number of hyper-parameters. By
Fisher's identity it is the posterior mean of the derivative of the joint log density of states and
measurements (Cappe, Moulines, Ryden, Inference in Hidden Markov Models, 2005, sec. 10.1.3). That
density is a sum over independent processes with few states each, so that it needs only the
posterior second moments of these, summed over the frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.learning.lines_of_sight import Signal
from telerig.estimator.smoothing.learning.parameters import (
    moving_processes,
    names_of_process,
    shake_processes,
)
from telerig.estimator.smoothing.problem.problem import ARMS, CARRIAGE, ShakeModel
from telerig.factors.bubble_motion import Process
from telerig.factors.motion import Motion, motion, start
from telerig.factors.state_space import (
    Component,
    Steps,
    discretise,
    distinct_steps,
    whitener_of,
)


@dataclass(frozen=True)
class Chain:
    """Cholesky factor of a block tridiagonal precision matrix with F blocks of D states.

    lower : (F, D, D) L_t.
    rows : (F, S + D, D) right-hand sides times L_t^-T, then M_t, which is 0 in the last frame.
    """

    lower: Array
    rows: Array

    @property
    def sides(self) -> Array:
        """The right-hand sides (F, S, D) times L_t^-T."""
        return self.rows[:, : -self.lower.shape[-1]]

    def log_det(self) -> float:
        """Return half the logarithm of the precision's determinant."""
        return float(np.log(np.diagonal(self.lower, axis1=-2, axis2=-1)).sum())

    def moments(self, sides: Array) -> tuple[Array, Array, Array]:
        """Return means (F, K, D) for eliminated right-hand sides (F, K, D), covariances (F, D, D),
        and cross-covariances (F - 1, D, D).

        The cross-covariances are those of a frame's states (rows) with the states one frame before.
        """
        from telerig.estimator.smoothing.learning.kernels import swept_back

        mean, own = np.array(sides, order="C"), np.empty_like(self.lower)
        below = np.empty_like(own[1:])
        swept_back(self.lower, self.rows, mean, own, below)
        return mean, own, below


def eliminated(own: Array, following: Array, sides: Array) -> Chain:
    """Factorise a block tridiagonal precision matrix.

    own : (F, D, D) diagonal blocks; overwritten.
    following : (F - 1, D, D) blocks below the diagonal.
    sides : (F, S, D) right-hand sides.

    Raises numpy.linalg.LinAlgError if the matrix is not positive definite.
    """
    from telerig.estimator.smoothing.learning.kernels import factorised

    count = sides.shape[1]
    rows = np.zeros((len(own), count + own.shape[-1], own.shape[-1]))
    rows[:, :count], rows[:-1, count:] = sides, following
    frame = factorised(own, rows)
    if frame >= 0:
        raise np.linalg.LinAlgError(f"frame {frame}")
    return Chain(own, rows)


_DIFFERENCE = 1e-4
_ROUNDING = 1e-14
"""The last frame's states have their own units, in which a very still rig's pivots are rounding."""


@dataclass(frozen=True)
class SignalPosterior:
    """Posterior means for one line-of-sight signal.

    position_mm, velocity_mm_s : (B, F) of the B moving items along the signal's direction;
        positions are relative to the item's start. R replicates of an item are consecutive rows.
    offset_mm : (J, F) shake of the J cameras.
    """

    position_mm: Array
    velocity_mm_s: Array
    offset_mm: Array


@dataclass(frozen=True)
class _System:
    """Linear state-space model of a signal: D states of the shake's components, then of each
    item's.

    rows : (P, D) measurement of each pair of item and camera.
    offset : (J, D) shake of each camera.
    position, velocity : (B, D) of each moving item.
    columns : (F, P, c) measurement matrix of the constants.
    prior_sigma : (c,) of the constants.
    """

    components: tuple[Component, ...]
    rows: Array
    offset: Array
    position: Array
    velocity: Array
    columns: Array
    prior_sigma: Array


def signal_evidence(signal: Signal, model: ShakeModel) -> float:
    """Return the log marginal likelihood of a signal."""
    return Factor(signal, model).log_evidence()


def signal_posterior(signal: Signal, model: ShakeModel) -> SignalPosterior:
    """Return the posterior means of a signal."""
    return Factor(signal, model).posterior()


def _system(signal: Signal, model: ShakeModel) -> _System:
    shake = [(p.component, p.camera) for p in shake_processes(signal, model)]
    bubble = [p.component for p in moving_processes(signal, model)]
    parts = [c for c, _ in shake] + bubble * int(signal.moving.sum())
    size, shaken = sum(c.size for c in parts), sum(c.size for c, _ in shake)
    offset = np.zeros((len(signal.cameras), size))
    at = 0
    for part, camera in shake:
        which = slice(None) if camera in (CARRIAGE, ARMS) else signal.cameras.index(camera)
        offset[which, at : at + part.size] += part.position
        at += part.size
    width = sum(c.size for c in bubble)
    movers = np.flatnonzero(signal.moving)
    position, velocity = np.zeros((len(signal.moving), size)), np.zeros((len(movers), size))
    for k, item in enumerate(movers):
        columns = slice(shaken + k * width, shaken + (k + 1) * width)
        position[item, columns] = np.concatenate([c.position for c in bubble])
        velocity[k, columns] = np.concatenate([c.velocity for c in bubble])
    columns_, sigma = _constants(signal, model)
    rows = position[signal.item] - offset[signal.camera]
    return _System(tuple(parts), rows, offset, position[movers], velocity, columns_, sigma)


def _constants(signal: Signal, model: ShakeModel) -> tuple[Array, Array]:
    """Return the measurement matrix (F, P, I) and prior sd (I,) of the constants, one per item.

    The constant is the mean velocity of a moving item and the position of a fixed one.
    """
    t = signal.t_s
    columns = np.zeros((len(t), len(signal.item), len(signal.moving)))
    for p, item in enumerate(signal.item):
        since = t - t[signal.first[item]]
        columns[:, p, item] = since if signal.moving[item] else 1.0
    speed = model.bubble.mean_sigma_mm_s / np.sqrt(signal.pooled)
    sigma = np.where(signal.moving, speed, signal.start_sigma_mm)
    return columns, sigma


class Factor:
    """Factorised posterior precision of a signal's states and constants.

    which : (F,) index of each frame's basis.
    bases : (U + 1, D, D) bases of the states.
    rows : (U + 1, P, D) measurement matrix in each basis.
    guess : (c, R) approximate constants, which are subtracted first to keep digits.
    rest : (F, P, R) measured values minus those of ``guess``.
    constants : (c, R) posterior means, minus ``guess``.
    square : minimum of chi-square.
    """

    def __init__(self, signal: Signal, model: ShakeModel) -> None:
        self.signal = signal
        self.system = system = _system(signal, model)
        self.steps = steps = motion(system.components, np.diff(signal.t_s), batched=True)
        self.which = np.append(steps.index, len(steps.basis) - 1)
        self.bases = steps.basis
        self.weight = weight = signal.weight / model.pixel_inflation**2
        self.rows = system.rows @ self.bases
        self.guess = _fitted(signal, weight)
        self.rest = _replicates(signal) - system.columns @ self.guess
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
        own[-1] += _ROUNDING * np.diag(np.diag(own[-1]))
        self.chain = eliminated(own, following, sides)
        wide = data.shape[-1]
        self._fix_constants(data.reshape(-1, wide).T @ weighted.reshape(-1, wide))

    def _fix_constants(self, square: Array) -> None:
        """Eliminate the constants.

        square : (R + c, R + c) weighted products of measurements and columns of the constants.
        """
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
        """Return the logarithm of the marginal likelihood of the signal."""
        used = self.weight[self.weight > 0]
        log_noise = 0.5 * float(np.log(used / (2 * np.pi)).sum())
        log_inner = float(np.log(np.diag(self.inner[0])).sum())
        log_sigma = float(np.log(self.system.prior_sigma).sum())
        each = log_noise + self.log_prior - self.chain.log_det() - log_inner - log_sigma
        return float(self.count * each - self.square / 2)

    def spread(self) -> tuple[Array, Array]:
        """Return right-hand sides (F, K, D) and constants (c, K) for the posterior second moments.

        The first R of the K belong to the replicates' posterior means. The other c spread by one
        standard deviation of the constants. The sum of squares over K, plus the covariance for
        known constants, gives the second moments.
        """
        from scipy.linalg import solve_triangular

        count, size = self.count, len(self.constants)
        unit = np.sqrt(count) * np.eye(size)
        off = solve_triangular(self.inner[0], unit, lower=True, trans="T")
        constants = np.concatenate([self.constants, off], -1)
        sides = -constants.T @ self.chain.sides[:, count:]
        sides[:, :count] += self.chain.sides[:, :count]
        return sides, constants

    def posterior(self) -> SignalPosterior:
        """Return the positions, velocities and offsets that the signal gives."""
        system, signal, count = self.system, self.signal, self.count
        states = self.chain.moments(self.spread()[0][:, :count])[0]
        states = states @ np.swapaxes(self.bases, -1, -2)[self.which]
        movers = np.flatnonzero(signal.moving)
        speed = (self.guess + self.constants)[movers, :, None]
        since = (signal.t_s - signal.t_s[signal.first[movers], None])[:, None]
        position, velocity, offset = (
            np.einsum("bd,frd->brf", row, states, optimize=True)
            for row in (system.position, system.velocity, system.offset)
        )
        found = position + speed * since, velocity + speed, offset
        frames = len(signal.t_s)
        return SignalPosterior(*(a.reshape(-1, frames) for a in found))


def runs(index: Ints) -> Iterator[tuple[int, slice | Ints]]:
    """Yield each distinct value of an index (n,) with its positions, as a slice if they are
    contiguous.
    """
    order = np.argsort(index, kind="stable")
    values, first = np.unique(index[order], return_index=True)
    for value, mine in zip(values.tolist(), np.split(order, first[1:])):
        whole = mine[-1] - mine[0] + 1 == len(mine)
        yield value, slice(int(mine[0]), int(mine[-1]) + 1) if whole else mine


def _replicates(signal: Signal) -> Array:
    """Return the measurements (F, P, R) of R replicates, which share their weights."""
    values = signal.value_mm
    return values if values.ndim == 3 else values[..., None]


def _fitted(signal: Signal, weight: Array) -> Array:
    """Return approximate constants (c, R) by a straight-line fit to each moving item."""
    values = _replicates(signal)
    out = np.zeros((len(signal.moving), values.shape[-1]))
    for item in np.flatnonzero(signal.moving):
        mine = signal.item == item
        w, t = weight[:, mine].sum(1), signal.t_s - signal.t_s[signal.first[item]]
        if not w.any():
            continue
        mean = (weight[:, mine, None] * values[:, mine]).sum(1) / np.where(w > 0, w, 1.0)[:, None]
        off = t - (w @ t) / w.sum()
        spread = float(w @ off**2)
        if spread > 0:
            out[item] = (w * off) @ mean / spread
    return out


def _chain(system: _System, steps: Motion) -> tuple[Array, Array, float]:
    """Return the prior's diagonal (F, D, D) and lower (F - 1, D, D) blocks, half its log det."""
    which = np.append(steps.index, len(steps.basis) - 1)
    last, ahead, place = steps.distinct_in_basis(which[1:])
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


@dataclass(frozen=True)
class _Moments:
    """Posterior second moments, summed over replicates.

    step : (U, 2 D, 2 D) of (w, x), the whitened process noise of a step and the state before it,
        summed over the steps of equal length.
    start : (D, D) of the first state.
    residual : of the whitened measurements.
    """

    step: Array
    start: Array
    residual: float


@dataclass(frozen=True)
class _Change:
    """A process with one hyper-parameter moved by a small step, for a difference quotient.

    process, name : indices of the process and of the hyper-parameter.
    sign : 1 or -1.
    component : the changed process.
    """

    process: int
    name: int
    sign: int
    component: Component


def signal_gradient(signal: Signal, model: ShakeModel, names: Sequence[str]) -> tuple[float, Array]:
    """Return the log marginal likelihood of a signal and its gradient (n,).

    names : n hyper-parameters; the derivatives are with respect to their logarithms.
    """
    factor = Factor(signal, model)
    moments = _moments(factor)
    slope = np.zeros(len(names))
    if "pixel_inflation" in names:
        seen = factor.count * int((signal.weight > 0).sum())
        slope[names.index("pixel_inflation")] = moments.residual - seen
    shake, bubble = shake_processes(signal, model), moving_processes(signal, model)
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
        for name, last in names_of_process(p).items()
        if name in where
        for sign in (1, -1)
    ]


@dataclass(frozen=True)
class _Places:
    """Where the states of each process stand in the state vector.

    begin : (N + 1,) first state of each process.
    copies : (N,) number of copies of it (bubbles).
    width : distance between copies.
    """

    begin: Ints
    copies: Ints
    width: int

    def moments(self, found: _Moments, which: Ints) -> tuple[Array, Array]:
        """Return moments (m, U, 2 n, 2 n) and (m, n, n) of processes of n states, summed over
        copies.
        """
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
    """Return the posterior mean of the log density of the states under each changed process."""
    dt_s, index = distinct_steps(np.diff(factor.signal.t_s))
    counts = np.bincount(index, minlength=len(dt_s))
    own = [p.component for p in (*shake, *bubble)]
    begin = np.r_[0, np.cumsum([c.size for c in own])]
    copies = np.repeat([1, int(factor.signal.moving.sum())], [len(shake), len(bubble)])
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
    """Return the whitened noise of new processes (m, U, n, 2 n), linear in (w, x) of the old."""
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
    """Return the posterior mean of the measurements' chi-square.  constants : (c, K)."""
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
