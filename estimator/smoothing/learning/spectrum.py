"""Spectral lines that a model leaves unexplained: where learning starts to look."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.learning.lines_of_sight import Signal
from telerig.estimator.smoothing.learning.parameters import moving_processes, shake_processes
from telerig.estimator.smoothing.problem.problem import CARRIAGE, ShakeModel
from telerig.factors.state_space import Component

LOWEST_HZ = 1.5
_LEAST_PERIODS = 2.0
_SMEAR_RAD, _MOST_SMEAR_RAD = 0.35, 0.7
_ENOUGH = 500


@dataclass(frozen=True)
class Line:
    """A peak of the spectrum. excess : its height over the model."""

    frequency_hz: float
    rms_mm: float
    excess: float


def density(components: Iterable[Component], frequency_hz: Array) -> Array:
    """(n,) mm^2 / Hz, one-sided, of the sum of independent processes' positions."""
    s = 2j * np.pi * frequency_hz
    total = np.zeros(len(frequency_hz))
    for part in components:
        inverse = np.linalg.inv(s[:, None, None] * np.eye(part.size) - part.drift)
        gain = part.position @ inverse @ part.noise
        total += 2 * (np.abs(gain) ** 2).sum(-1)
    return total


def averaged(signal: Signal, factor: int) -> Signal:
    """Means over ``factor`` frames, which keep all of the noise and blur fast lines a little."""
    if factor < 2 or len(signal.t_s) < 8 * factor:
        return signal
    count = len(signal.t_s) // factor
    weight = signal.weight[: count * factor].reshape(count, factor, -1)
    value = signal.value_mm[: count * factor].reshape(count, factor, -1)
    total = weight.sum(1)
    mean = (weight * value).sum(1) / np.where(total > 0, total, 1.0)
    t = signal.t_s[: count * factor].reshape(count, factor).mean(1)
    # only whole blocks stand for the time of their middle
    whole = (weight > 0).all(1)
    first = np.minimum(signal.first // factor, count - 1)
    return replace(signal, t_s=t, value_mm=mean, weight=np.where(whole, total, 0.0), first=first)


def averaging_factor(t_s: Array, highest_hz: float) -> int:
    """How many frames may be averaged before a line of that frequency fades by 2 %.

    By 8 % while more than `_ENOUGH` frames are left.
    """
    step = float(np.median(np.diff(t_s)))
    little, more = (int(s / (np.pi * highest_hz * step)) for s in (_SMEAR_RAD, _MOST_SMEAR_RAD))
    return max(1, little, min(more, len(t_s) // _ENOUGH))


def averaging_loss(frequency_hz: float, factor: int, t_s: Array) -> float:
    """By how much a mean over ``factor`` frames shrinks a line's amplitude."""
    step = float(np.median(np.diff(t_s)))
    fine = np.sinc(frequency_hz * step)
    return float(np.sinc(frequency_hz * step * factor) / fine)


def unexplained(signal: Signal, model: ShakeModel, where: int | str, count: int = 3) -> list[Line]:
    """The highest peaks of a spectrum over the model's.

    where : CARRIAGE: the mean of all items and cameras; "bubble": bubbles less their mean (of one
    bubble: the same as CARRIAGE); a camera: its difference from the mean of the cameras.
    """
    frequency, power, expected = _spectra(signal, model, where)
    if not len(frequency):
        return []
    ratio = power / expected
    peak = np.r_[False, (ratio[1:-1] >= ratio[:-2]) & (ratio[1:-1] > ratio[2:]), False]
    lines = []
    step = frequency[1] - frequency[0]
    for i in np.flatnonzero(peak):
        near = slice(max(i - 2, 0), i + 3)
        area = float(np.clip(power[near] - expected[near], 0, None).sum() * step)
        lines.append(Line(float(frequency[i]), float(np.sqrt(max(area, 1e-8))), float(ratio[i])))
    return sorted(lines, key=lambda line: -line.excess)[:count]


def _spectra(signal: Signal, model: ShakeModel, where: int | str) -> tuple[Array, Array, Array]:
    """Frequencies, density found (Hann windows, mean over independent series), and expected."""
    from scipy.signal import periodogram

    t = signal.t_s
    step = float(np.median(np.diff(t)))
    grid = np.arange(t[0], t[-1] + step / 2, step)
    series, weights = _series(signal, where)
    if not len(series) or len(grid) < 16:
        return np.zeros(0), np.zeros(0), np.ones(0)
    total, noise, used = 0.0, 0.0, 0
    drift = np.vander((grid - grid.mean()) / (grid[-1] - grid[0]), 4)
    for values, weight in zip(series, weights):
        good = weight > 0
        if good.sum() < 16:
            continue
        even = np.interp(grid, t[good], values[good])
        even = even - drift @ np.linalg.lstsq(drift, even, rcond=None)[0]
        frequency, found = periodogram(even, 1 / step, "hann", detrend=False)
        total, used = total + found, used + 1
        noise += 2 * step * model.pixel_inflation**2 * float(np.mean(1 / weight[good]))
    if not used:
        return np.zeros(0), np.zeros(0), np.ones(0)
    keep = frequency >= max(LOWEST_HZ, _LEAST_PERIODS / (t[-1] - t[0]))
    frequency = frequency[keep]
    expected = noise / used + _expected(signal, model, where, frequency)
    return frequency, np.asarray(total)[keep] / used, expected


def _expected(signal: Signal, model: ShakeModel, where: int | str, frequency: Array) -> Array:
    movers = max(int(signal.moving.sum()), 1)
    shake, cameras = shake_processes(signal, model), len(signal.cameras)
    bubble = [p.component for p in moving_processes(signal, model)]
    common = [p.component for p in shake if p.camera == CARRIAGE]
    own = [p.component for p in shake if p.camera != CARRIAGE]
    if where == "bubble" and movers > 1:
        return density(bubble, frequency) * (1 - 1 / movers)
    if where in (CARRIAGE, "bubble"):
        mean = density(bubble, frequency) / movers + density(common, frequency)
        return np.asarray(mean + density(own, frequency) / cameras**2)
    mine = [p.component for p in shake if p.camera == where]
    return density(mine, frequency) + (density(own, frequency) - density(mine, frequency))


def _series(signal: Signal, where: int | str) -> tuple[list[Array], list[Array]]:
    """Independent series of one kind, (F,) each, and their weights (1 / variance)."""
    value, weight = signal.value_mm, signal.weight
    items = np.unique(signal.item)
    if where == CARRIAGE or (where == "bubble" and len(items) < 2):
        return [_mean(_level(signal), weight)[0]], [_mean(value, weight)[1]]
    if where == "bubble":
        every, _ = _mean(_level(signal), weight)
        parts = [_mean(value[:, signal.item == i], weight[:, signal.item == i]) for i in items]
        return [p[0] - every for p in parts], [p[1] for p in parts]
    mine = signal.camera == signal.cameras.index(int(where))
    if mine.all():
        return [], []
    here, rest = _mean(value[:, mine], weight[:, mine]), _mean(value[:, ~mine], weight[:, ~mine])
    both = np.where((here[1] > 0) & (rest[1] > 0), 1.0, 0.0)
    spread = 1 / np.maximum(here[1], 1e-12) + 1 / np.maximum(rest[1], 1e-12)
    return [here[0] - rest[0]], [both / spread]


def _level(signal: Signal) -> Array:
    """Values less each item's mean, so that items may come and go."""
    total = signal.weight.sum(0)
    mean = (signal.weight * signal.value_mm).sum(0) / np.where(total > 0, total, 1.0)
    return np.asarray(signal.value_mm - mean)


def _mean(value: Array, weight: Array) -> tuple[Array, Array]:
    total = weight.sum(1)
    return (weight * value).sum(1) / np.where(total > 0, total, 1.0), total
