"""Priors for users who have given none, from what was measured."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.graph.stage_travel import default_scale_sigma
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    BroadBand,
    CarriageModel,
    RigMode,
    ShakeModel,
    SmoothingProblem,
    Stage,
)
from telerig.factors.bubble_motion import BubbleModel, Zigzag

SHAKE_RMS_MM = 0.2
DELAY_SIGMA_S = 0.002
_ZIGZAG_HZ = (3.0, 12.0)
_ZIGZAG_GUESS_HZ = 6.5
_ZIGZAG_RMS_MM = 0.5
_ZIGZAG_DAMPING = 0.04
_HARMONIC_RMS_MM = 0.15
_INTERPOLATION_SHARE = 0.3
_CLEAR = 0.2
_SHAKE_HZ = (4.0, 60.0)
STRONG_MM_S2 = 5000.0
"""Shake whose accelerations are larger gets a steeper tail; see docs/decisions/010."""
DEFAULT_FLOOR = 0.12
"""Of the band. A mode of damping z has 4 z / (pi f) RMS^2 per Hz below it; this is z = 0.05."""


def default_model(problem: SmoothingProblem, encoder_sigma_mm: float = 0.005) -> ShakeModel:
    """With marks or arm sensors a broad prior of the shake; else a guess at its modes."""
    bands: tuple[BroadBand, ...] = ()
    modes: tuple[RigMode, ...] = ()
    cameras = range(len(problem.cameras))
    if problem.measures_shake:
        bands = tuple(_band(j) for j in cameras)
    elif problem.accelerometers:
        bands = (_band(CARRIAGE), *(replace(_band(j), rms_mm=(0.07,) * 3) for j in cameras))
    else:
        modes = (RigMode(12.0, 0.2, (0.1,) * 3, force_hz=None),)
        modes += tuple(RigMode(19.0, 0.2, (0.05,) * 3, j, None) for j in cameras)
    return ShakeModel(
        bubble=default_bubble(problem),
        modes=modes,
        broad_bands=bands,
        carriage=default_carriage(problem, encoder_sigma_mm),
        encoder_sigma_mm=encoder_sigma_mm,
        encoder_scale_sigma=_scale_sigma(problem),
        accelerometer_delay_sigma_s=DELAY_SIGMA_S if problem.accelerometers else 0.0,
        name="default",
    )


def _scale_sigma(problem: SmoothingProblem) -> float:
    """The encoder's scale is estimated where there are marks, and held without."""
    marked = len(problem.references) > 0 and problem.stage is not None
    return default_scale_sigma(problem.travel) if marked else 0.0


def _band(camera: int) -> BroadBand:
    return BroadBand((SHAKE_RMS_MM,) * 3, camera, floor=DEFAULT_FLOOR)


def rescaled(model: ShakeModel, rms_mm: Array, frequency_hz: float) -> ShakeModel:
    """The broad-band priors with the RMS and the dominant frequency that were found.

    rms_mm : (C, 3) of each camera's offset (posterior mean and variance), the expectation step
    of expectation maximisation. What is common to the cameras keeps its share.
    """
    own = [b for b in model.broad_bands if b.camera != CARRIAGE]
    common = [b for b in model.broad_bands if b.camera == CARRIAGE]
    before = np.zeros_like(rms_mm)
    for band in common:
        before += np.square(band.rms_mm)
    for band in own:
        before[band.camera] += np.square(band.rms_mm)
    factor = rms_mm / np.sqrt(np.where(before > 0, before, 1.0))
    factor = np.clip(factor, 0.05, 20.0)
    by_camera = {CARRIAGE: factor.mean(0), **dict(enumerate(factor))}
    frequency = float(np.clip(frequency_hz, *_SHAKE_HZ))
    strong = float(rms_mm.max()) * (2 * np.pi * frequency) ** 2 > STRONG_MM_S2
    shape: dict[str, Any] = {"low_hz": frequency, "high_hz": max(60.0, 1.25 * frequency)}
    if strong:
        shape = {"low_hz": frequency, "high_hz": max(60.0, 2.0 * frequency), "tail": 3}
    bands = [
        replace(b, rms_mm=_triple(b.rms_mm * by_camera[b.camera]), **shape)
        for b in model.broad_bands
    ]
    return replace(model, broad_bands=tuple(bands))


def default_bubble(problem: SmoothingProblem) -> BubbleModel:
    """Zigzag at the frequency that the tracks show, with its second harmonic upwards."""
    frequency, rms = zigzag(problem) or (_ZIGZAG_GUESS_HZ, _ZIGZAG_RMS_MM)
    across, up = 1 - np.abs(problem.up), np.abs(problem.up)
    return BubbleModel(
        zigzags=(
            Zigzag(frequency, _ZIGZAG_DAMPING, _triple(rms * across)),
            Zigzag(2 * frequency, _ZIGZAG_DAMPING, _triple(_HARMONIC_RMS_MM * up)),
        )
    )


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(v) if v > 1e-6 else 0.0 for v in values)
    return x, y, z


def zigzag(problem: SmoothingProblem) -> tuple[float, float] | None:
    """Frequency (Hz) and RMS (mm) of the bubbles' swing across the vertical; None without tracks.

    Lomb-Scargle periodogram of each track, drift removed.
    """
    from scipy.signal import lombscargle

    trials = np.arange(_ZIGZAG_HZ[0], _ZIGZAG_HZ[1], 0.25)
    power, total, samples = np.zeros(len(trials)), 0.0, 0
    for bubble in problem.bubbles[:20]:
        t = problem.t_s[bubble.first : bubble.last + 1]
        if len(bubble) < 12 or t[-1] - t[0] < 1.5 / _ZIGZAG_HZ[0]:
            continue
        across = bubble.guess_mm - (bubble.guess_mm @ problem.up)[:, None] * problem.up
        x = (t - t.mean()) / (t[-1] - t[0])
        drift = np.stack([np.ones_like(x), x, x**2], -1)
        rest = across - drift @ np.linalg.lstsq(drift, across, rcond=None)[0]
        power += sum(2 * lombscargle(t, column, 2 * np.pi * trials) for column in rest.T)
        total, samples = total + (rest**2).sum(), samples + 2 * len(t)
    if not samples:
        return None
    rms = float(np.sqrt(total / samples))
    clear = power.max() > _CLEAR * total and rms > _ZIGZAG_RMS_MM / 2
    frequency = float(trials[power.argmax()]) if clear else _ZIGZAG_GUESS_HZ
    return frequency, max(rms, _ZIGZAG_RMS_MM)


def default_carriage(problem: SmoothingProblem, encoder_sigma_mm: float) -> CarriageModel:
    """Readings as they are; with sensors or a slow encoder a model of the motion in between."""
    stage = problem.stage
    if stage is None:
        return CarriageModel()
    wanted = bool(problem.accelerometers) or not _dense(stage, problem.t_s, encoder_sigma_mm)
    if not wanted:
        return CarriageModel()
    rms = acceleration_rms(stage)
    return CarriageModel("force", acceleration_rms_mm_s2=max(1.5 * rms, 100.0))


def _dense(stage: Stage, t_s: Array, sigma_mm: float) -> bool:
    """Whether a straight line between two readings misses less than their noise."""
    if len(stage.t_s) < 3:
        return False
    step = float(np.median(np.diff(stage.t_s)))
    bend = acceleration_rms(stage) * step**2 / 8
    return bend < _INTERPOLATION_SHARE * max(sigma_mm, 1e-4)


def acceleration_rms(stage: Stage) -> float:
    """mm/s^2, of parabolas through windows of about 20 ms."""
    step = float(np.median(np.diff(stage.t_s)))
    window = int(np.clip(round(0.02 / step) // 2 * 2 + 1, 5, len(stage.t_s) // 2 * 2 - 1))
    if window < 5:
        return 1000.0
    x = (np.arange(window) - window // 2) * step
    parabola = np.linalg.pinv(np.stack([np.ones(window), x, x**2], -1))[2] * 2
    bend = np.convolve(stage.position_mm, parabola[::-1], mode="valid")
    return float(np.sqrt(np.mean(bend**2)))
