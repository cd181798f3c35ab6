"""Bubbles that cross, and swarms, as detections in space; independent of the tracker's model.

Each bubble rises at its own speed with an Ornstein-Uhlenbeck velocity (10 mm/s, 0.3 s), zigzags
by 2-5 mm at 5-8 Hz in a plane of its own, with 0.177 mm RMS at twice that frequency vertically.
The rig follows at 280 mm/s and shakes by 0.2 mm at 8-20 Hz, alike for all bubbles. Detections have
0.05-0.5 px of noise at 0.1 mm/px, one level an event; the vertical is seen by both cameras.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PX_MM = 0.1
RISE_MM_S = 280.0
UP = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True)
class Scene:
    """t_s, position_mm : (F,); points_mm, truth : per frame (M, 3) and (M,), -1 for clutter.

    covariance_mm2 : (3, 3) of every detection; crossing_s : when the two are closest, if they do.
    """

    t_s: Array
    position_mm: Array
    points_mm: list[Array]
    truth: list[NDArray[np.int64]]
    covariance_mm2: Array
    crossing_s: float = float("nan")


def ornstein_uhlenbeck(t_s: Array, sd: float, tau_s: float, rng: np.random.Generator) -> Array:
    """(F, 3) stationary, exact at any spacing."""
    out = np.empty((len(t_s), 3))
    out[0] = rng.normal(0, sd, 3)
    for i, dt in enumerate(np.diff(t_s)):
        keep = np.exp(-dt / tau_s)
        out[i + 1] = keep * out[i] + sd * np.sqrt(1 - keep**2) * rng.normal(size=3)
    return out


def path(t_s: Array, rng: np.random.Generator) -> Array:
    """(F, 3) of one bubble in the lab, from about the origin."""
    velocity = ornstein_uhlenbeck(t_s, 10.0, 0.3, rng) + UP * rng.normal(RISE_MM_S, 10.0)
    steps = (velocity[1:] + velocity[:-1]) / 2 * np.diff(t_s)[:, None]
    walk = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    amplitude, hz = rng.uniform(2, 5), rng.uniform(5, 8)
    angle, phase, phase2 = rng.uniform(0, 2 * np.pi, 3)
    sideways = np.array([np.cos(angle), 0.0, np.sin(angle)])
    zigzag = amplitude * np.sin(2 * np.pi * hz * t_s + phase)[:, None] * sideways
    second = 0.177 * np.sqrt(2) * np.sin(4 * np.pi * hz * t_s + phase2)[:, None] * UP
    return np.asarray(walk + zigzag + second)


def shake(t_s: Array, amplitude_mm: float, rng: np.random.Generator) -> Array:
    """(F, 3), one frequency, each axis with its own share and phase; the vertical in full."""
    share = np.array([rng.uniform(0, 1), 1.0, rng.uniform(0, 1)])
    phase = rng.uniform(0, 2 * np.pi, 3)
    hz = rng.uniform(8, 20)
    return np.asarray(amplitude_mm * share * np.sin(2 * np.pi * hz * t_s[:, None] + phase))


def noise(px: float) -> Array:
    return np.diag([1.0, 0.5, 1.0]) * (px * PX_MM) ** 2


def crossing(
    rng: np.random.Generator,
    rate_hz: float,
    *,
    blob_mm: float = 0.0,
    separation_mm: float = 0.3,
    shake_mm: float = 0.2,
    half_s: float = 0.15,
) -> Scene:
    """Two bubbles that pass within 0.1 mm and are separation_mm apart 10 ms later.

    blob_mm : closer than this they are one detection, half-way.
    """
    t_s = np.arange(-half_s, half_s, 1 / rate_hz) + rng.uniform(0, 1 / rate_hz)
    lab = close_pass(t_s, separation_mm, rng)
    px = float(np.exp(rng.uniform(np.log(0.05), np.log(0.5))))
    close = np.linalg.norm(lab[:, 1] - lab[:, 0], axis=1) < blob_mm
    return _seen(t_s, lab, close, px, shake_mm, rng)


def close_pass(t_s: Array, separation_mm: float, rng: np.random.Generator) -> Array:
    """(F, 2, 3) two bubbles that pass within 0.1 mm at time 0, so far apart 10 ms later."""
    fine = np.union1d(t_s, [0.0, 0.01])
    a, b = path(fine, rng), path(fine, rng)
    between = b - a
    at_0, at_10 = np.searchsorted(fine, [0.0, 0.01])
    want_0 = _direction(rng) * rng.uniform(0, 0.1)
    slope = (_direction(rng) * separation_mm - between[at_10] - want_0 + between[at_0]) / 0.01
    b = b - between[at_0] + want_0 + fine[:, None] * slope
    keep = np.isin(fine, t_s)
    return np.stack([a[keep], b[keep]], 1)


def _direction(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def _seen(
    t_s: Array, lab: Array, close: Array, px: float, shake_mm: float, rng: np.random.Generator
) -> Scene:
    position = RISE_MM_S * t_s
    covariance = noise(px)
    rig = lab - (position[:, None] * UP + shake(t_s, shake_mm, rng))[:, None]
    points, truth = [], []
    for i, both in enumerate(rig):
        here = both.mean(0, keepdims=True) if close[i] else both
        order = rng.permutation(len(here))
        points.append(here[order] + rng.multivariate_normal(np.zeros(3), covariance, len(here)))
        truth.append(np.array([-1]) if close[i] else order)
    read = position + rng.normal(0, 0.001, len(t_s))
    return Scene(t_s, read, points, truth, covariance, 0.0)


def swarm(
    rng: np.random.Generator,
    rate_hz: float,
    bubbles: int,
    *,
    seconds: float = 0.6,
    box_mm: float = 50.0,
    drop: float = 0.05,
    clutter: float = 0.05,
    life_s: float = 0.5,
) -> Scene:
    """About ``bubbles`` in the box at a time, coming and going; drop-outs and clutter."""
    t_s = np.arange(0, seconds, 1 / rate_hz)
    position = RISE_MM_S * t_s
    rocked = position[:, None] * UP + shake(t_s, 0.2, rng)
    covariance = noise(float(rng.uniform(0.1, 0.3)))
    frames: list[list[Array]] = [[] for _ in t_s]
    truth: list[list[int]] = [[] for _ in t_s]
    total = round(bubbles * (1 + seconds / life_s))
    for k in range(total):
        lab = path(t_s, rng)
        start = 0.0 if k < bubbles else rng.uniform(0, seconds)
        end = start + rng.exponential(life_s)
        place = rng.uniform(-box_mm / 2, box_mm / 2, 3)
        at_start = int(np.searchsorted(t_s, start))
        rig = lab - lab[min(at_start, len(t_s) - 1)] + place - (rocked - rocked[0])
        rig += position[min(at_start, len(t_s) - 1)] * UP
        for i in np.flatnonzero((t_s >= start) & (t_s < end)):
            if rng.random() >= drop:
                frames[i].append(rig[i] + rng.multivariate_normal(np.zeros(3), covariance))
                truth[i].append(k)
    return _shuffled(t_s, position, frames, truth, covariance, box_mm, clutter * bubbles, rng)


def _shuffled(
    t_s: Array,
    position: Array,
    frames: list[list[Array]],
    truth: list[list[int]],
    covariance: Array,
    box_mm: float,
    false_per_frame: float,
    rng: np.random.Generator,
) -> Scene:
    points, labels = [], []
    for found, who in zip(frames, truth):
        many = rng.poisson(false_per_frame)
        false = rng.uniform(-box_mm / 2, box_mm / 2, (many, 3))
        every = np.vstack([np.reshape(found, (-1, 3)), false])
        order = rng.permutation(len(every))
        points.append(every[order])
        labels.append(np.array([*who, *[-1] * many], np.int64)[order])
    return Scene(t_s, position, points, labels, covariance)
