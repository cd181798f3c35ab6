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

from telerig.estimator.tracking.filter.types import TrackerSettings

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
    if not settings.acceleration_state:
        return 6
    return 12 if settings.zigzag_hz > 0 else 9


def _along(settings: TrackerSettings) -> tuple[Array, Array]:
    """Dynamics along the rise, per state, and the spectral density of the noise on each."""
    order, driven = state_size(settings) // 3, 2 if settings.acceleration_state else 1
    dynamics, density = np.zeros((order, order)), np.zeros((order, order))
    dynamics[range(driven), range(1, driven + 1)] = 1.0
    dynamics[1, 1] = -1 / settings.velocity_time_s
    tau, variance = settings.acceleration_time_s, settings.rise_acceleration_mm_s2**2
    if driven == 2:
        dynamics[2, 2] = -1 / tau
    density[driven, driven] = variance * (2 / tau if driven == 2 else 2 * tau)
    return dynamics, density


def _across(settings: TrackerSettings) -> tuple[Array, Array]:
    """The same across the rise, where the velocity swings about a drift that wanders slowly."""
    dynamics, density = _along(settings)
    ratio = settings.lateral_acceleration_mm_s2 / settings.rise_acceleration_mm_s2
    if len(dynamics) < 4:
        return dynamics, density * ratio**2
    turn = 2 * np.pi * settings.zigzag_hz
    rate = 2 * settings.zigzag_damping * turn
    dynamics[1, 1] = 0.0
    dynamics[2, 1:] = -(turn**2), -rate, turn**2
    dynamics[3, 3] = -1 / settings.drift_time_s
    density[2, 2] = 2 * rate * settings.lateral_acceleration_mm_s2**2
    density[3, 3] = 2 / settings.drift_time_s * settings.drift_sd_mm_s**2
    return dynamics, density


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
    along = np.outer(up, up)
    full, noise = np.zeros((n, n)), np.zeros((n, n))
    drift = np.zeros(n)
    parts = ((_along(settings), along), (_across(settings), np.eye(3) - along))
    for (dynamics, density), direction in parts:
        matrix, spread = van_loan(dynamics, density, dt_s)
        full += np.kron(matrix, direction)
        noise += np.kron(spread, direction)
    if in_lab and np.isfinite(settings.velocity_time_s):
        mean = np.zeros(n)
        mean[3:6] = settings.rise_mm_s * np.array(up)
        drift = mean - full @ mean
        drift[:3] += dt_s * mean[3:6]
    return Transition(full, noise, drift, _common_noise(settings, dt_s, n, encoder))


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
        out[6:9, 6:9] = settings.lateral_acceleration_mm_s2**2 * np.eye(3)
    if len(out) == 12:
        out[9:, 9:] = settings.drift_sd_mm_s**2 * np.eye(3)
    return out
