"""Finds spectral lines that a model leaves unexplained, and decides between rig and bubbles.

With one bubble the likelihood is the same for both owners; several bubbles, marks or accelerometers
make the owner identifiable. Half of the variance of an ambiguous line is given to each owner, so
that the posterior covariance contains both explanations.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.learning.likelihood import Fit, evidence, maximise
from telerig.estimator.smoothing.learning.lines_of_sight import Signal
from telerig.estimator.smoothing.learning.parameters import (
    moving_processes,
    prior_of,
    shake_processes,
)
from telerig.estimator.smoothing.problem.problem import CARRIAGE, RigMode, ShakeModel
from telerig.factors.bubble_motion import Zigzag
from telerig.factors.state_space import Component

LOWEST_HZ = 1.5
_LEAST_PERIODS = 2.0
_SMEAR_RAD, _MOST_SMEAR_RAD = 0.35, 0.7
_ENOUGH = 500


@dataclass(frozen=True)
class Line:
    """A spectral peak.

    excess : ratio of the observed to the expected density at the peak.
    """

    frequency_hz: float
    rms_mm: float
    excess: float


def density(components: Iterable[Component], frequency_hz: Array) -> Array:
    """Return the one-sided spectral density (n,) in mm^2/Hz of the sum of independent processes."""
    s = 2j * np.pi * frequency_hz
    total = np.zeros(len(frequency_hz))
    for part in components:
        inverse = np.linalg.inv(s[:, None, None] * np.eye(part.size) - part.drift)
        gain = part.position @ inverse @ part.noise
        total += 2 * (np.abs(gain) ** 2).sum(-1)
    return total


def averaged(signal: Signal, factor: int) -> Signal:
    """Return the signal averaged over blocks of ``factor`` frames."""
    if factor < 2 or len(signal.t_s) < 8 * factor:
        return signal
    count = len(signal.t_s) // factor
    weight = signal.weight[: count * factor].reshape(count, factor, -1)
    given = signal.value_mm[: count * factor]
    total = weight.sum(1)
    share = weight / np.where(total > 0, total, 1.0)[:, None]
    value = given.reshape(count, factor, weight.shape[-1], -1)
    mean = np.einsum("cfp,cfpr->cpr", share, value).reshape(count, *given.shape[1:])
    t = signal.t_s[: count * factor].reshape(count, factor).mean(1)
    # only whole blocks stand for the time of their middle
    whole = (weight > 0).all(1)
    first = np.minimum(signal.first // factor, count - 1)
    return replace(signal, t_s=t, value_mm=mean, weight=np.where(whole, total, 0.0), first=first)


def averaging_factor(t_s: Array, highest_hz: float) -> int:
    """Return the largest number of frames over which a signal may be averaged in blocks.

    The amplitude of a spectral line at ``highest_hz`` then falls by at most 2 %, or by at most 8 %
    if more than 500 blocks are left.
    """
    step = float(np.median(np.diff(t_s)))
    little, more = (int(s / (np.pi * highest_hz * step)) for s in (_SMEAR_RAD, _MOST_SMEAR_RAD))
    return max(1, little, min(more, len(t_s) // _ENOUGH))


def averaging_loss(frequency_hz: float, factor: int, t_s: Array) -> float:
    """Return the amplitude ratio of a line after averaging over ``factor`` frames."""
    step = float(np.median(np.diff(t_s)))
    fine = np.sinc(frequency_hz * step)
    return float(np.sinc(frequency_hz * step * factor) / fine)


def unexplained(signal: Signal, model: ShakeModel, where: int | str, count: int = 3) -> list[Line]:
    """Return the peaks of the spectrum that exceed the model's spectrum most.

    where : the owner that is searched for. CARRIAGE uses the mean over items and cameras; "bubble"
        each bubble minus the mean (with one bubble as CARRIAGE); a camera its difference from the
        others.
    count : the number of peaks.
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
    """Return frequencies (F,), and observed (Hann windows) and expected densities (F,)."""
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
    """Return series (F,) for one owner, and their weights (1 / variance)."""
    if signal.value_mm.ndim == 3:
        pieces = np.moveaxis(signal.value_mm, -1, 0)
        each = [_series(replace(signal, value_mm=piece), where) for piece in pieces]
        return [v for values, _ in each for v in values], [w for _, ws in each for w in ws]
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
    """Return the values minus the mean of each item."""
    total = signal.weight.sum(0)
    mean = (signal.weight * signal.value_mm).sum(0) / np.where(total > 0, total, 1.0)
    return np.asarray(signal.value_mm - mean)


def _mean(value: Array, weight: Array) -> tuple[Array, Array]:
    total = weight.sum(1)
    return (weight * value).sum(1) / np.where(total > 0, total, 1.0), total


L = TypeVar("L", RigMode, Zigzag)

AMBIGUOUS_LOG_RATIO = 5.0
HARMONIC_LOG_RATIO = 7.0
_SAME_HZ = 0.02
_HARMONIC = 0.12
_REFIT_LOG_RATIO = 40.0
_ZIGZAG_MM = 0.3
_ZIGZAG_HZ = (3.0, 12.0)
_SHARES = np.linspace(0.0, 1.0, 6)
_NEAR_HZ, _ELSEWHERE_HZ = 0.1, 0.25
_MORE = 3
_LEAST_SHARE = 0.1


@dataclass(frozen=True)
class Attribution:
    """The owner of a spectral line.

    owner : "rig" or "bubble".
    index : of the line among the model's modes or zigzags.
    log_likelihood_ratio : to the other owner, with the lines refitted.
    log_prior_ratio : from prior knowledge; positive for a zigzag's second harmonic.
    """

    owner: str
    index: int
    frequency_hz: float
    rms_mm: float
    log_likelihood_ratio: float
    log_prior_ratio: float = 0.0

    @property
    def ambiguous(self) -> bool:
        return self.log_likelihood_ratio + self.log_prior_ratio < AMBIGUOUS_LOG_RATIO


def attributions(
    signals: Sequence[Signal], model: ShakeModel, pattern: Sequence[float], up: Array
) -> list[Attribution]:
    """Return the owners of the lines that could be a common mode of the rig or the bubbles'.

    pattern : (3,) axes of the rig along which lines are tested.
    up : (3,) unit vector against gravity.
    """
    if not any(c.moving.any() for c in signals):
        return []
    at = evidence(signals, model)
    out = []
    for i, mode in enumerate(model.modes):
        if _lies_in(mode.rms_mm, pattern) and _is_common(mode, signals):
            cost = _cost(signals, model, moved_to_bubble(model, i), at)
            label = Attribution("rig", i, mode.frequency_hz, max(mode.rms_mm), cost)
            out.append(label)
    differential = any(m.camera != CARRIAGE for m in model.modes)
    for i, line in enumerate(model.bubble.zigzags):
        if _lies_in(line.rms_mm, pattern):
            cost = _cost(signals, model, moved_to_rig(model, i), at)
            prior = _own_motion_log_ratio(model, i, differential, up)
            out.append(Attribution("bubble", i, line.frequency_hz, max(line.rms_mm), cost, prior))
    return out


def _is_common(mode: RigMode, signals: Sequence[Signal]) -> bool:
    """Return whether a mode moves all cameras of the signals alike, as a bubble's motion does."""
    if mode.camera == CARRIAGE:
        return True
    return all(c.cameras == (mode.camera,) for c in signals if mode.camera in c.cameras)


def _lies_in(rms_mm: Sequence[float], pattern: Sequence[float]) -> bool:
    rms, inside = np.asarray(rms_mm), np.asarray(pattern) > 0.7
    return bool(rms[inside].max(initial=0.0) > rms[~inside].max(initial=0.0))


def _cost(signals: Sequence[Signal], model: ShakeModel, other: ShakeModel, at: float) -> float:
    """Return the loss of log-likelihood in another model, lines refitted if that may matter."""
    loss = at - evidence(signals, other)
    if AMBIGUOUS_LOG_RATIO / 2 < loss < _REFIT_LOG_RATIO:
        loss = min(loss, at - maximise(signals, other, _line_names(other), steps=8).log_evidence)
    return float(loss)


def _line_names(model: ShakeModel) -> list[str]:
    stems = [f"modes.{i}" for i in range(len(model.modes))]
    stems += [f"bubble.zigzags.{i}" for i in range(len(model.bubble.zigzags))]
    return [f"{s}.{f}" for s in stems for f in ("frequency_hz", "rms_mm")]


def _own_motion_log_ratio(model: ShakeModel, index: int, differential: bool, up: Array) -> float:
    """Return the prior log ratio for the bubbles: wide swings and their second harmonic are theirs.

    If there is differential shake, a common mode is likely as well, and the harmonic gets no bonus.
    """
    line = model.bubble.zigzags[index]
    swings = [z for z in model.bubble.zigzags if is_zigzag(z, up)]
    if line in swings:
        return float("inf")
    second = any(abs(line.frequency_hz / (2 * z.frequency_hz) - 1) < _HARMONIC for z in swings)
    return HARMONIC_LOG_RATIO if second and not differential else 0.0


def is_zigzag(line: Zigzag, up: Array) -> bool:
    """Return whether a line is a wide lateral swing, as in the path of a rising bubble."""
    rms, upright = np.asarray(line.rms_mm), np.abs(up)
    across = float(np.linalg.norm(rms * (1 - upright)))
    wide = across > _ZIGZAG_MM and across > float(np.linalg.norm(rms * upright))
    return wide and _ZIGZAG_HZ[0] < line.frequency_hz < _ZIGZAG_HZ[1]


def moved_to_bubble(model: ShakeModel, index: int, share: float = 1.0) -> ShakeModel:
    """Return the model with a share of a mode's variance moved to the bubbles."""
    mode = model.modes[index]
    rms = _scaled(mode.rms_mm, np.sqrt(share))
    added = Zigzag(mode.frequency_hz, mode.damping, rms, mode.force_hz)
    modes = _with_rest(model.modes, index, share)
    zigzags = _joined(model.bubble.zigzags, added)
    return replace(model, modes=modes, bubble=replace(model.bubble, zigzags=zigzags))


def moved_to_rig(model: ShakeModel, index: int, share: float = 1.0) -> ShakeModel:
    """Return the model with a share of a bubble line's variance moved to a mode of the rig."""
    line = model.bubble.zigzags[index]
    rms = _scaled(line.rms_mm, np.sqrt(share))
    added = RigMode(line.frequency_hz, line.damping, rms, force_hz=line.force_hz)
    bubble = replace(model.bubble, zigzags=_with_rest(model.bubble.zigzags, index, share))
    return replace(model, modes=(*model.modes, added), bubble=bubble)


def _with_rest(lines: tuple[L, ...], index: int, share: float) -> tuple[L, ...]:
    """Return the lines with one line's variance reduced by a share; without it for 1."""
    line = lines[index]
    rest: tuple[L, ...] = ()
    if share < 1:
        rest = (replace(line, rms_mm=_scaled(line.rms_mm, np.sqrt(1 - share))),)
    return lines[:index] + rest + lines[index + 1 :]


def _joined(lines: tuple[Zigzag, ...], added: Zigzag) -> tuple[Zigzag, ...]:
    """Return the lines with another one added; variances of equal lines add up."""
    for i, line in enumerate(lines):
        near = abs(line.frequency_hz / added.frequency_hz - 1) < _SAME_HZ
        near &= line.force_hz == added.force_hz
        if near and np.isclose(line.damping, added.damping, rtol=_SAME_HZ):
            x, y, z = np.hypot(line.rms_mm, added.rms_mm).tolist()
            return (*lines[:i], replace(line, rms_mm=(x, y, z)), *lines[i + 1 :])
    return (*lines, added)


def _scaled(rms_mm: Sequence[float], factor: float) -> tuple[float, float, float]:
    x, y, z = (float(factor * r) for r in rms_mm)
    return x, y, z


def with_split_lines(model: ShakeModel, found: Sequence[Attribution]) -> ShakeModel:
    """Return the model in which rig and bubbles share each ambiguous line's variance equally."""
    for label in sorted(found, key=lambda one: -one.index):
        if label.ambiguous and label.owner == "bubble":
            model = moved_to_rig(model, label.index, 0.5)
    for label in found:
        if label.ambiguous and label.owner == "rig":
            model = moved_to_bubble(model, label.index, 0.5)
    return model


def with_hidden_modes(
    signals: Sequence[Signal], model: ShakeModel, pattern: Sequence[float], up: Array
) -> ShakeModel:
    """Return the model with hidden modes: modes of the rig at the frequency of a bubbles' line.

    The differences of n bubbles determine the bubbles' line. A mode of the same frequency adds to
    the bubbles' mean, which contains 1/n of the line's variance anyway. The RMS of the mode is the
    root mean square of its posterior; its prior is flat up to the RMS of the line, and lower where
    the rig's main mode is seen at another frequency. Zigzags are never attributed to the rig.
    """
    own = [m for m in model.modes if _lies_in(m.rms_mm, pattern) and not _is_half(m, model)]
    for index, line in enumerate(model.bubble.zigzags):
        common = [m.frequency_hz for m in model.modes if m.camera == CARRIAGE]
        seen = any(abs(f / line.frequency_hz - 1) < _NEAR_HZ for f in common)
        if seen or not _lies_in(line.rms_mm, pattern) or is_zigzag(line, up):
            continue
        rig = RigMode(line.frequency_hz, line.damping, line.rms_mm, force_hz=line.force_hz)
        fits = [_with_hidden_mode(signals, model, index, rig, s) for s in _SHARES]
        found = np.array([fit.log_posterior for fit in fits])
        weight = np.exp(found - found.max()) * hidden_mode_weights(line, own)
        share = float(np.sqrt(np.sum(weight * _SHARES**2) / weight.sum()))
        if share > _LEAST_SHARE:
            model = _with_hidden_mode(signals, model, index, rig, share).model
    return model


def _with_hidden_mode(
    signals: Sequence[Signal], model: ShakeModel, index: int, rig: RigMode, share: float
) -> Fit:
    """Fit the model with a hidden mode of a share of the line's RMS; the bubbles' line is refitted.

    The line was too wide, because it had to explain the mean of the bubbles as well.
    """
    stem = f"bubble.zigzags.{index}"
    names = [f"{stem}.{last}" for last in ("frequency_hz", "damping", "rms_mm")]
    if share > 0:
        mode = replace(rig, rms_mm=_scaled(rig.rms_mm, share))
        model = replace(model, modes=(*model.modes, mode))
    return maximise(signals, model, names, steps=6)


def _is_half(mode: RigMode, model: ShakeModel) -> bool:
    """Return whether a mode is the rig's half of an ambiguous line."""
    return any(z.frequency_hz == mode.frequency_hz for z in model.bubble.zigzags)


def hidden_mode_weights(line: Zigzag, own: Sequence[RigMode]) -> Array:
    """Return prior weights (n,) of how much of a zigzag's spectral line is a mode of the rig.

    A mode of the rig at the frequency of the bubbles' zigzag is hidden by it. The n cases are that
    it has the fractions `_SHARES` of the line's RMS; the first one is 0, no hidden mode.

    line : the zigzag.
    own : modes of the rig.

    The weights are equal if the carriage has no mode at another frequency. Otherwise a hidden mode
    that is weaker than the strongest of those would lie at the line's frequency by chance. Its
    weight is the probability that one of `_MORE` modes does, and what is left of the weight goes to
    the first case.
    """
    away = [max(m.rms_mm) for m in own if m.camera == CARRIAGE and _is_elsewhere(m, line)]
    strongest = max(away, default=0.0)
    if not strongest:
        return np.ones(len(_SHARES))
    arms = max((max(m.rms_mm) for m in own if m.camera != CARRIAGE), default=np.inf)
    missing = 1 - min(strongest / arms, 1.0) ** 4
    each = 2 * _NEAR_HZ * prior_of("modes.*.frequency_hz").density(line.frequency_hz)
    chance = 1 - (1 - each) ** _MORE
    size = np.minimum(_SHARES * max(line.rms_mm) / strongest, 1.0)
    weight = chance + (1 - chance) * missing * size**2
    weight[0] = len(weight) - weight[1:].sum()
    return np.asarray(weight)


def _is_elsewhere(mode: RigMode, line: Zigzag) -> bool:
    return abs(mode.frequency_hz / line.frequency_hz - 1) >= _ELSEWHERE_HZ
