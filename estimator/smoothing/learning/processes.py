"""The stochastic processes that a signal's measurements are sums of, by hyper-parameter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from telerig.estimator.smoothing.learning.lines_of_sight import Signal
from telerig.estimator.smoothing.learning.parameters import FORCE
from telerig.estimator.smoothing.problem.problem import CARRIAGE, RigMode, ShakeModel, Zigzag
from telerig.factors.state_space import (
    Component,
    broad_band,
    ou_velocity,
    resonance,
    slow_ou,
)

Make = Callable[..., Component]

_cached = lru_cache(maxsize=512)
_resonance = _cached(resonance)
_broad_band, _slow_ou = _cached(broad_band), _cached(slow_ou)


@_cached
def _ou_velocity(**values: float) -> Component:
    """The mean velocity is a constant of the signal, no input of the states."""
    return ou_velocity(**values).without_input()


@dataclass(frozen=True)
class Process:
    """One process along a signal's direction, and what it is made from.

    stem : of the hyper-parameters' names, "modes.0".  learned : their last parts with the arguments
    of ``make`` and values here.  camera : the arm that it moves, CARRIAGE: all, None: a bubble.
    """

    stem: str
    make: Make
    learned: dict[str, tuple[str, float]]
    fixed: dict[str, float] = field(default_factory=dict)
    camera: int | None = None

    @property
    def names(self) -> dict[str, str]:
        """The hyper-parameters' names, with their last parts."""
        return {FORCE if n == "force_hz" else f"{self.stem}.{n}": n for n in self.learned}

    @property
    def component(self) -> Component:
        """The same object for the same numbers."""
        return self.make(**dict(self.learned.values()), **self.fixed)

    def moved(self, name: str, factor: float) -> Component:
        """With one hyper-parameter (its last part) times a factor."""
        values = {n: (a, factor * v if n == name else v) for n, (a, v) in self.learned.items()}
        return self.make(**dict(values.values()), **self.fixed)


def shake_processes(signal: Signal, model: ShakeModel) -> list[Process]:
    """The shake's, along the signal's direction."""
    out: list[Process] = []
    if not signal.shaken:
        return out
    for i, mode in enumerate(model.modes):
        rms = _along(signal, mode.rms_mm, mode.camera)
        if rms > 0:
            out.append(Process(f"modes.{i}", _resonance, _line(mode, rms), camera=mode.camera))
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


def _line(line: RigMode | Zigzag, rms_mm: float) -> dict[str, tuple[str, float]]:
    values = {"rms_mm": rms_mm, "frequency_hz": line.frequency_hz, "damping": line.damping}
    if line.force_hz is not None:
        values["force_hz"] = line.force_hz
    return {name: (name, value) for name, value in values.items()}


def _along(signal: Signal, rms_mm: tuple[float, float, float], camera: int) -> float:
    if camera != CARRIAGE and camera not in signal.cameras:
        return 0.0
    return float(np.sqrt(np.sum(np.square(signal.direction * rms_mm))))


def bubble_processes(signal: Signal, model: ShakeModel) -> list[Process]:
    """Of one bubble, along the signal's direction; none where nothing moves."""
    if not signal.moving.any():
        return []
    bubble, share = model.bubble, 1 / np.sqrt(signal.pooled)
    learned = {
        "velocity_sigma_mm_s": ("sigma_mm_s", float(share * bubble.velocity_sigma_mm_s)),
        "velocity_tau_s": ("tau_s", bubble.velocity_tau_s),
    }
    begin = {"start_sigma_mm": float(share * bubble.start_sigma_mm)}
    parts = [Process("bubble", _ou_velocity, learned, begin)]
    for i, z in enumerate(bubble.zigzags):
        rms = float(share * np.sqrt(np.sum(np.square(signal.direction * z.rms_mm))))
        if rms > 0:
            parts.append(Process(f"bubble.zigzags.{i}", _resonance, _line(z, rms)))
    return parts


def processes(signal: Signal, model: ShakeModel) -> list[Component]:
    """Of the shake, then of one bubble. Processes that two models share are the same object."""
    found = shake_processes(signal, model) + bubble_processes(signal, model)
    return [p.component for p in found]


def depends_on(signal: Signal, model: ShakeModel, names: Sequence[str]) -> bool:
    """Whether the signal's evidence depends on any of these hyper-parameters."""
    found = shake_processes(signal, model) + bubble_processes(signal, model)
    known = {name for p in found for name in p.names}
    return "pixel_inflation" in names or not known.isdisjoint(names)
