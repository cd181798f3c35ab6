"""Shake that no linear process makes: knocks that ring down, a hunting controller, stick-slip.

Each is the motion of modes under a force, with the accelerations that sensors on them feel.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from telerig.io.simulation.run.motion import Shake

Array = NDArray[np.float64]

NONLINEAR = ("ring-down", "limit cycle", "stick-slip")
COMMON_HZ, ARM_RATIO, DAMPING, FORCE_HZ = 18.0, 1.6, 0.03, 60.0
_FINE = 10


def nonlinear_shake(
    kind: str, t: Array, rms: Array, common: float, rng: Generator
) -> tuple[Shake, Shake]:
    """Shake common to two cameras and that of their arms, each (2, N, axes) at times t (N,).

    rms : (axes,) of a camera's whole offset.  common : share of the variance that is common.
    """
    parts = []
    for hz, copies, share in ((COMMON_HZ, 1, common), (COMMON_HZ * ARM_RATIO, 2, 1 - common)):
        paths = np.stack([[_driven(kind, t, hz, rng) for _ in rms] for _ in range(copies)])
        scale = np.sqrt((paths[..., 0] ** 2).mean(-1, keepdims=True))[..., None]
        paths = paths / scale * (rms * np.sqrt(share))[:, None, None]
        paths = np.broadcast_to(paths, (2, *paths.shape[1:])).transpose(3, 0, 2, 1)
        parts.append(Shake(*paths.reshape(3, 2, len(t), len(rms))))
    return parts[0], parts[1]


def _driven(kind: str, t: Array, hz: float, rng: Generator) -> Array:
    """(N, 3) displacement, velocity, acceleration of a mode under one sort of force."""
    if kind == "limit cycle":
        return _limit_cycle(t, 14.0, rng)
    n, h = len(t) * _FINE, (t[1] - t[0]) / _FINE
    force = np.zeros(n)
    if kind == "ring-down":
        for at in rng.uniform(0, t[-1], max(2, round(3 * t[-1]))).tolist() + [0.0]:
            i = int(at / h)
            force[i : i + round(0.004 / h)] += rng.choice([-1, 1]) * rng.uniform(0.5, 1.5)
    else:
        force = _stick_slip(n, h, rng)
    return _forced(force, h, hz)[::_FINE]


def _forced(force: Array, h: float, hz: float) -> Array:
    """A mode (damping 0.03) under a force that two poles at 60 Hz smooth; exact between steps."""
    from scipy.linalg import expm

    w, f = 2 * np.pi * hz, 2 * np.pi * FORCE_HZ
    drift = np.zeros((5, 5))
    drift[0, 1] = drift[1, 2] = drift[2, 3] = 1.0
    drift[1, :2] = -(w**2), -2 * DAMPING * w
    drift[3, 2:] = -(f**2), -2 * f, f**2
    phi = expm(drift * h)
    x, out = np.zeros(5), np.empty((len(force), 3))
    for i, u in enumerate(force):
        x[4] = u
        out[i] = x[0], x[1], drift[1] @ x
        x = phi @ x
    return out


def _stick_slip(steps: int, h: float, rng: Generator) -> Array:
    """Friction builds up while a guide sticks, and lets go at a level that varies."""
    force, load, level = np.empty(steps), 0.0, 1.0
    rate = rng.uniform(5, 8)
    for i in range(steps):
        load += rate * h
        if load > level:
            load, level = 0.0, rng.uniform(0.6, 1.4)
        force[i] = load
    return force - force.mean()


def _limit_cycle(t: Array, hz: float, rng: Generator) -> Array:
    """A hunting controller: constant amplitude, a third harmonic, a phase that drifts slowly."""
    w, slow = 2 * np.pi * hz, 2 * np.pi * rng.uniform(0.3, 0.6)
    start, turn = rng.uniform(0, 2 * np.pi, 2)
    phase = w * t + start + 0.5 * np.sin(slow * t + turn)
    rate = w + 0.5 * slow * np.cos(slow * t + turn)
    bend = -0.5 * slow**2 * np.sin(slow * t + turn)
    out = np.zeros((len(t), 3))
    for k, a in ((1, 1.0), (3, 0.1)):
        sine, cosine = np.sin(k * phase), np.cos(k * phase)
        slope = k * cosine * rate
        out += a * np.stack([sine, slope, k * cosine * bend - k**2 * sine * rate**2], -1)
    return out


def hunting_stage(t: Array, reach_mm: float, rng: Generator) -> tuple[Array, Array]:
    """Position and acceleration (N,) of a stage that hunts at 14 Hz, sticks and slips.

    reach_mm : amplitude of the limit cycle; friction moves the stage by a third of it.
    """
    cycle = reach_mm * _limit_cycle(t, 14.0, rng)
    step = float(t[1] - t[0])
    slip = _forced(_stick_slip(len(t), step, rng), step, 11.0)
    slip *= reach_mm / 3 / max(float(slip[:, 0].std()), 1e-12)
    both = cycle + slip
    return both[:, 0], both[:, 2]
