"""What users had before: triangulate and add the encoder, and a plain smoother of that."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoothing.problem.problem import BubbleModel
from telerig.factors.state_space import discretise, ou_velocity

Array = NDArray[np.float64]


def central_velocity(t_s: Array, position_mm: Array) -> Array:
    """(n, 3) differences over two frames, one at the ends; NaN beside a missing position."""
    out = np.full_like(position_mm, np.nan)
    if len(t_s) < 2:
        return out
    before, after = np.maximum(np.arange(len(t_s)) - 1, 0), np.arange(len(t_s)) + 1
    after = np.minimum(after, len(t_s) - 1)
    out = (position_mm[after] - position_mm[before]) / (t_s[after] - t_s[before])[:, None]
    return np.asarray(out)


def rts(
    t_s: Array, position_mm: Array, covariance_mm2: Array, model: BubbleModel
) -> tuple[Array, Array]:
    """filterpy's Kalman filter and RTS smoother on lab positions, no shake in the model.

    t_s (n,), position_mm (n, 3) with NaN where there is none, covariance_mm2 (n, 3, 3).
    Returns positions and velocities (n, 3).
    """
    from filterpy.kalman import KalmanFilter

    seen = np.asarray(np.isfinite(position_mm).all(1))
    first = position_mm[np.argmax(seen)]
    steps = discretise(ou_velocity(model.velocity_sigma_mm_s, model.velocity_tau_s), np.diff(t_s))
    filter_: Any = KalmanFilter(dim_x=9, dim_z=3)
    filter_.x = np.r_[first, np.zeros(6)][:, None]
    each = np.diag([model.start_sigma_mm**2, 0, 0]).astype(float)
    variance = model.mean_sigma_mm_s**2
    each[1:, 1:] = variance
    each[1, 1] += model.velocity_sigma_mm_s**2
    filter_.P = np.kron(each, np.eye(3))
    filter_.H = np.eye(3, 9)
    means, covariances, transitions, noises = [], [], [], []
    for i in range(len(t_s)):
        if i:
            transitions.append(_transition(steps, i - 1))
            noises.append(_noise(steps, i - 1))
            filter_.predict(F=transitions[-1], Q=noises[-1])
        filter_.update(position_mm[i] if seen[i] else None, R=covariance_mm2[i])
        means.append(filter_.x.copy())
        covariances.append(filter_.P.copy())
    last = np.eye(9), np.zeros((9, 9))
    smooth, *_ = filter_.rts_smoother(
        np.array(means), np.array(covariances), [last[0], *transitions], [last[1], *noises]
    )
    return smooth[:, :3, 0], smooth[:, 3:6, 0]


def _transition(steps: Any, i: int) -> Array:
    u = steps.index[i]
    one = np.eye(3)
    one[:2, :2], one[:2, 2] = steps.transition[u], steps.input[u][:, 0]
    return np.asarray(np.kron(one, np.eye(3)), np.float64)


def _noise(steps: Any, i: int) -> Array:
    one = np.zeros((3, 3))
    one[:2, :2] = steps.covariance[steps.index[i]]
    return np.asarray(np.kron(one, np.eye(3)), np.float64)
