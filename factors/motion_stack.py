"""Exact steps of many processes at once: those with as many states share one batch of arrays.

What `telerig.factors.motion.motion` works out component by component, for searches that need it a
thousand times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from telerig.factors.exact_steps import exact_steps, integrations, inverse_root
from telerig.factors.motion import Motion
from telerig.factors.state_space import Component

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Stack:
    """Components ``which`` of a list, N of n states each, over U lengths of steps.

    transition, whitener : (N, U, n, n).  log_det : (N, U) of the whitener.
    start : (N, n, n) whitener of the first state.  start_log_det : (N,).
    """

    which: Ints
    transition: Array
    whitener: Array
    log_det: Array
    start: Array
    start_log_det: Array

    def bases(self) -> Array:
        """(N, U + 1, n, n), see `telerig.factors.state_space.elimination_basis`."""
        count, lengths, size, _ = self.whitener.shape
        ahead = np.zeros((count, lengths + 1, size, size))
        ahead[:, :-1] = self.whitener @ self.transition
        prior = np.broadcast_to(self.start[:, None], ahead.shape)
        root = np.linalg.qr(np.concatenate([ahead, prior], -2), mode="r")
        return np.asarray(np.linalg.inv(root))


def stacks(components: Sequence[Component], dt_s: Array) -> list[Stack]:
    """All components over steps dt_s (U,), sorted by their states. Inputs are not stepped."""
    kinds: dict[tuple[float, ...], list[int]] = {}
    for i, c in enumerate(components):
        kinds.setdefault(_kind(c), []).append(i)
    return [_stack([components[i] for i in mine], mine, dt_s) for mine in kinds.values()]


def _kind(component: Component) -> tuple[float, ...]:
    """Alike for processes that one batch can hold."""
    drift, noise = (a.astype(bool).tobytes() for a in (component.drift, component.noise))
    return _integrations(drift, noise, component.size)


@lru_cache(maxsize=64)
def _integrations(drift: bytes, noise: bytes, size: int) -> tuple[float, ...]:
    pattern = [np.frombuffer(b, bool).reshape(size, -1).astype(float) for b in (drift, noise)]
    return tuple(integrations(*pattern).tolist())


def _stack(components: Sequence[Component], which: Sequence[int], dt_s: Array) -> Stack:
    count, lengths, size = len(components), len(dt_s), components[0].size
    drift, noise, begin = (
        np.array([getattr(c, name) for c in components])
        for name in ("drift", "noise", "start_covariance")
    )
    transition, q = exact_steps(
        np.repeat(drift, lengths, 0), np.repeat(noise, lengths, 0), np.tile(dt_s, count)
    )
    whitener = inverse_root(q).reshape(count, lengths, size, size)
    first = inverse_root(begin)
    return Stack(
        np.array(which),
        transition.reshape(whitener.shape),
        whitener,
        _log_det(whitener),
        first,
        _log_det(first),
    )


def _log_det(lower: Array) -> Array:
    return np.asarray(np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1))


def stacked_motion(components: Sequence[Component], dt_s: Array) -> Motion:
    """As `motion` of components without inputs, (M,) steps."""
    distinct, index = lengths_of(dt_s.tobytes())
    sizes = np.array([c.size for c in components])
    begin = np.r_[0, np.cumsum(sizes)]
    width, lengths = int(begin[-1]), len(distinct)
    last, following = np.zeros((2, lengths, width, width))
    basis = np.zeros((lengths + 1, width, width))
    log_det = np.zeros(lengths)
    for stack in stacks(components, distinct):
        at = begin[stack.which, None] + np.arange(stack.start.shape[-1])
        rows, columns = at[:, :, None], at[:, None]
        for out, blocks in (
            (last, -stack.whitener @ stack.transition),
            (following, stack.whitener),
            (basis, stack.bases()),
        ):
            out[:, rows, columns] = np.swapaxes(blocks, 0, 1)
        log_det += stack.log_det.sum(0)
    none = np.zeros((lengths, width, 0))
    return Motion(last, following, none, log_det, basis, index)


@lru_cache(maxsize=64)
def lengths_of(dt_s: bytes) -> tuple[Array, Ints]:
    """Distinct lengths (U,) of steps given as bytes of (M,) numbers, and (M,) which one each is."""
    dt = np.frombuffer(dt_s)
    # as in `discretise`: clocks that jitter in the last digit of a nanosecond make no new steps
    _, first, index = np.unique(np.round(dt * 1e11), return_index=True, return_inverse=True)
    return dt[first], index.ravel().astype(np.int64)
