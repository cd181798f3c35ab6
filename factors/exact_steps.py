"""Transitions and noise of linear stochastic processes over exact steps, as arrays.

For x' = F x + L w, w white noise of unit density: Van Loan's matrix exponential (IEEE Trans. Autom.
Control 23:395, 1978) over a short step, doubled as often as the step needs, so that neither a long
gap nor the tiny variance of an often integrated noise loses digits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TERMS = 26
_SHORT = 0.5


def exact_steps(drift: Array, noise: Array, dt_s: Array) -> tuple[Array, Array]:
    """Transitions and covariances (M, n, n) of steps dt_s (M,), of one process or one each.

    drift : (n, n) or (M, n, n), noise : (n, m) or (M, n, m), of the same `integrations` then.
    """
    rate = np.abs(np.linalg.eigvals(drift)).max(-1, initial=0.0)
    doublings = np.ceil(np.log2(np.maximum(rate * dt_s / _SHORT, 1.0))).astype(int)
    transition, q = _short_step(drift, noise, dt_s / 2.0**doublings)
    for step in range(int(doublings.max(initial=0))):
        more = doublings > step
        phi = transition[more]
        q[more] += phi @ q[more] @ np.swapaxes(phi, -1, -2)
        transition[more] = phi @ phi
    return transition, (q + np.swapaxes(q, -1, -2)) / 2


def _short_step(drift: Array, noise: Array, h: Array) -> tuple[Array, Array]:
    """Van Loan's exponential by its series, states scaled by the powers of h they grow with."""
    n = drift.shape[-1]
    one = (0,) * (drift.ndim - 2)
    scale = h[:, None] ** integrations(drift[one], noise[one])
    ratio = scale[:, None, :] / scale[:, :, None]
    f = drift * h[:, None, None] * ratio
    q = (
        noise
        @ np.swapaxes(noise, -1, -2)
        * h[:, None, None]
        / scale[:, :, None]
        / scale[:, None, :]
    )
    block = np.zeros((len(h), 2 * n, 2 * n))
    block[:, :n, :n], block[:, :n, n:], block[:, n:, n:] = -f, q, np.swapaxes(f, -1, -2)
    total = np.broadcast_to(np.eye(2 * n), block.shape).copy()
    term = total.copy()
    for i in range(1, _TERMS):
        term = term @ block / i
        total += term
    phi = np.swapaxes(total[:, n:, n:], -1, -2)
    covariance = phi @ total[:, :n, n:]
    return phi / ratio, covariance * scale[:, :, None] * scale[:, None, :]


def integrations(drift: Array, noise: Array) -> Array:
    """(n,) how many integrations lie between the white noise and each state."""
    orders = np.full(len(drift), np.nan)
    reached = np.abs(noise).sum(1)
    for order in range(len(orders)):
        orders[np.isnan(orders) & (reached > 0)] = order
        reached = np.abs(drift) @ reached
    return np.asarray(np.nan_to_num(orders, nan=0.0))


def inverse_root(covariance: Array) -> Array:
    """(..., n, n) lower W with W C W^T = 1, scaled so that small variances keep their digits."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    scaled = covariance / sigma[..., :, None] / sigma[..., None, :]
    root = np.linalg.cholesky(scaled)
    unit = np.broadcast_to(np.eye(root.shape[-1]), root.shape)
    return np.asarray(np.tril(np.linalg.solve(root, unit)) / sigma[..., None, :])
