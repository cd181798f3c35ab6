"""How bubbles move between two frames: exact discretisation for any interval.

State of a bubble: position, velocity and optionally acceleration, three components each, in the
rig frame; the velocity is that of the bubble in the lab as long as an encoder tells the stage's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from telerig.estimator.track_types import TrackerSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Transition:
    """Over one interval: x -> matrix @ x + drift, plus noise (both (n, n), drift (n,)).

    common_noise : (n, n), what moves all bubbles alike: shake, and the stage without an encoder.
    """

    matrix: Array
    noise: Array
    drift: Array
    common_noise: Array


def van_loan(dynamics: Array, diffusion: Array, dt_s: float) -> tuple[Array, Array]:
    """(n, n) transition and noise of dx = A x dt + dw, E[dw dw'] = D dt, over dt.

    C. F. Van Loan, IEEE Trans. Automatic Control 23:395 (1978).
    """
    n = len(dynamics)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -dynamics, diffusion, dynamics.T
    exponential = expm(block * dt_s)
    matrix = exponential[n:, n:].T
    return matrix, matrix @ exponential[:n, n:]


def state_size(settings: TrackerSettings) -> int:
    return 9 if settings.acceleration_state else 6


def _one_axis(settings: TrackerSettings) -> Array:
    """Dynamics of one axis, per state."""
    order = state_size(settings) // 3
    dynamics = np.diag(np.ones(order - 1), 1)
    dynamics[1, 1] = -1 / settings.velocity_time_s
    if order == 3:
        dynamics[2, 2] = -1 / settings.acceleration_time_s
    return dynamics


def _intensity(settings: TrackerSettings, up: Array) -> Array:
    """(3, 3) spectral density of the white noise that drives the last state."""
    along = np.outer(up, up)
    variance = settings.rise_acceleration_mm_s2**2 * along
    variance = variance + settings.lateral_acceleration_mm_s2**2 * (np.eye(3) - along)
    tau = settings.acceleration_time_s
    return np.asarray(variance * (2 / tau if settings.acceleration_state else 2 * tau))


@lru_cache(maxsize=256)
def transition(
    settings: TrackerSettings,
    up: tuple[float, float, float],
    dt_s: float,
    encoder: bool,
    in_lab: bool,
) -> Transition:
    """The step of every bubble over ``dt_s``; up is the unit vector of the rise.

    encoder : it told the stage's motion; in_lab : velocities are the lab's, not the rig's.
    """
    n = state_size(settings)
    dynamics = _one_axis(settings)
    unit = np.zeros_like(dynamics)
    unit[-1, -1] = 1.0
    matrix, noise = van_loan(dynamics, unit, dt_s)
    mean = np.zeros(n)
    if in_lab:
        mean[3:6] = settings.rise_mm_s * np.array(up)
    full = np.asarray(np.kron(matrix, np.eye(3)), float)
    drift = np.zeros(n)
    if np.isfinite(settings.velocity_time_s):
        relax = np.kron(matrix[:, 1], np.ones(3)) * np.tile(mean[3:6], n // 3)
        drift = mean - relax
        drift[:3] += dt_s * mean[3:6]
    return Transition(
        full,
        np.asarray(np.kron(noise, _intensity(settings, np.array(up))), float),
        drift,
        _common_noise(settings, dt_s, n, encoder),
    )


def _common_noise(settings: TrackerSettings, dt_s: float, n: int, encoder: bool) -> Array:
    """Shake: steps of an Ornstein-Uhlenbeck offset; unknown stage: constant acceleration."""
    out = np.zeros((n, n))
    forgotten = -np.expm1(-dt_s / settings.shake_time_s)
    out[:3, :3] = 2 * settings.shake_sd_mm**2 * forgotten * np.eye(3)
    if not encoder:
        speed = settings.stage_acceleration_mm_s2 * dt_s
        gain = np.kron(np.array([dt_s / 2, 1.0]), np.eye(3)).reshape(3, 6).T * speed
        out[:6, :6] += gain @ gain.T
    return out


def birth_covariance(settings: TrackerSettings, measured: Array, encoder: bool) -> Array:
    """(n, n) of a new track at a measured point of covariance (3, 3)."""
    out = np.zeros((state_size(settings),) * 2)
    out[:3, :3] = measured
    speed = settings.birth_speed_sd_mm_s
    if not encoder:
        speed = settings.birth_speed_sd_no_encoder_mm_s
    out[3:6, 3:6] = speed**2 * np.eye(3)
    if settings.acceleration_state:
        out[6:, 6:] = settings.lateral_acceleration_mm_s2**2 * np.eye(3)
    return out
