"""The stochastic processes that a signal's measurements are sums of, by hyper-parameter."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from telerig.estimator.smoothing.learning.lines_of_sight import Signal
from telerig.estimator.smoothing.learning.parameters import FORCE
from telerig.estimator.smoothing.problem.problem import CARRIAGE, ShakeModel
from telerig.factors.bubble_motion import Process, bubble_processes, line_process
from telerig.factors.state_space import Component, broad_band, slow_ou

_broad_band, _slow_ou = lru_cache(maxsize=512)(broad_band), lru_cache(maxsize=512)(slow_ou)


def names_of_process(process: Process) -> dict[str, str]:
    """The hyper-parameters' names, with their last parts."""
    return {FORCE if n == "force_hz" else f"{process.stem}.{n}": n for n in process.learned}


def shake_processes(signal: Signal, model: ShakeModel) -> list[Process]:
    """The shake's, along the signal's direction."""
    out: list[Process] = []
    if not signal.shaken:
        return out
    for i, mode in enumerate(model.modes):
        rms = _along(signal, mode.rms_mm, mode.camera)
        if rms > 0:
            line = (mode.frequency_hz, mode.damping, mode.force_hz)
            out.append(line_process(f"modes.{i}", rms, *line, camera=mode.camera))
    for i, band in enumerate(model.broad_bands):
        rms = _along(signal, band.rms_mm, band.camera)
        if rms > 0:
            learned = {"rms_mm": ("rms_mm", rms)}
            fixed = {"low_hz": band.low_hz, "high_hz": band.high_hz}
            out.append(Process(f"broad_bands.{i}", _broad_band, learned, fixed, band.camera))
            if band.slow_rms_mm > 0:
                slow = {"rms": band.slow_rms_mm, "tau_s": band.slow_tau_s}
                out.append(Process("", _slow_ou, {}, slow, band.camera))
    return out


def _along(signal: Signal, rms_mm: tuple[float, float, float], camera: int) -> float:
    if camera != CARRIAGE and camera not in signal.cameras:
        return 0.0
    return float(np.sqrt(np.sum(np.square(signal.direction * rms_mm))))


def moving_processes(signal: Signal, model: ShakeModel) -> list[Process]:
    """Of one bubble, along the signal's direction; none where nothing moves.

    The mean velocity is a constant of the signal, no input of the states.
    """
    if not signal.moving.any():
        return []
    return bubble_processes(model.bubble, signal.direction, bubbles=signal.pooled, mean_known=True)


def processes(signal: Signal, model: ShakeModel) -> list[Component]:
    """Of the shake, then of one bubble. Processes that two models share are the same object."""
    found = shake_processes(signal, model) + moving_processes(signal, model)
    return [p.component for p in found]


def depends_on(signal: Signal, model: ShakeModel, names: Sequence[str]) -> bool:
    """Whether the signal's evidence depends on any of these hyper-parameters."""
    found = shake_processes(signal, model) + moving_processes(signal, model)
    known = {name for p in found for name in names_of_process(p)}
    return "pixel_inflation" in names or not known.isdisjoint(names)
