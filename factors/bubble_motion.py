"""How a bubble moves: the one statement that tracking, learning and smoothing use.

Over a run, along each axis: position = path + zigzags. The path's velocity is a constant mean U and
an Ornstein-Uhlenbeck process; a zigzag is a stochastic oscillator. Smoothing and learning lay these
processes out as states (`bubble_processes`).

From one frame to the next a tracker needs an acceleration to gate with, and has no run from which
a mean could be known. Along the rise its acceleration is an Ornstein-Uhlenbeck process (Singer,
IEEE Trans. Aerosp. Electron. Syst. 6:473, 1970); across it the velocity oscillates about a slow
drift (`rise_motion`, `lateral_motion`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from telerig.arrays import Array
from telerig.factors.state_space import Component, ou_velocity, resonance

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Zigzag:
    """A stochastic oscillation of the bubbles' paths; RMS along the rig's x, y, z, 0 for none.

    force_hz : low-pass cut-off of the force (two poles); None: white.
    """

    frequency_hz: float
    damping: float
    rms_mm: Triple
    force_hz: float | None = None


@dataclass(frozen=True)
class BubbleModel:
    """Priors of every bubble.

    velocity_sigma_mm_s, velocity_tau_s : Ornstein-Uhlenbeck velocity about a constant mean.
    start_sigma_mm, mean_sigma_mm_s : of the first position and the mean velocity, each axis.
    zigzags : oscillations besides.  wander_px, wander_tau_s : of the centroid in each image,
        0 for none.
    """

    velocity_sigma_mm_s: float = 10.0
    velocity_tau_s: float = 0.3
    start_sigma_mm: float = 100.0
    mean_sigma_mm_s: float = 300.0
    zigzags: tuple[Zigzag, ...] = ()
    wander_px: float = 0.0
    wander_tau_s: float = 0.1


@dataclass(frozen=True)
class Process:
    """One process along one direction, and the hyper-parameters that it is made from.

    stem : of the hyper-parameters' names, "bubble.zigzags.0".  learned : their last parts, with the
    arguments of ``make`` and values here.  camera : index of the arm that it moves, None: a bubble.
    """

    stem: str
    make: Callable[..., Component]
    learned: dict[str, tuple[str, float]]
    fixed: dict[str, float] = field(default_factory=dict)
    camera: int | None = None

    @property
    def component(self) -> Component:
        """The same object for the same numbers, where ``make`` remembers what it has made."""
        return self.make(**dict(self.learned.values()), **self.fixed)

    def moved(self, name: str, factor: float) -> Component:
        """With one hyper-parameter (its last part) times a factor."""
        values = {n: (a, factor * v if n == name else v) for n, (a, v) in self.learned.items()}
        return self.make(**dict(values.values()), **self.fixed)


_path = lru_cache(maxsize=512)(ou_velocity)
_resonance = lru_cache(maxsize=512)(resonance)


@lru_cache(maxsize=512)
def _path_about_its_mean(**values: float) -> Component:
    return ou_velocity(**values).without_input()


def bubble_processes(
    model: BubbleModel, direction: Array, *, bubbles: int = 1, mean_known: bool = False
) -> list[Process]:
    """The path, then the zigzags that move along a direction (3,), a unit vector in rig axes.

    bubbles : the mean of so many bubbles' positions is meant, whose deviations are independent.
    mean_known : the path is that about its mean velocity; else the mean is its input.
    """
    share = 1 / np.sqrt(bubbles)
    learned = {
        "velocity_sigma_mm_s": ("sigma_mm_s", float(share * model.velocity_sigma_mm_s)),
        "velocity_tau_s": ("tau_s", model.velocity_tau_s),
    }
    begin = {"start_sigma_mm": float(share * model.start_sigma_mm)}
    path = _path_about_its_mean if mean_known else _path
    parts = [Process("bubble", path, learned, begin)]
    for i, zigzag in enumerate(model.zigzags):
        rms = float(share * np.sqrt(np.sum(np.square(direction * zigzag.rms_mm))))
        if rms > 0:
            line = (zigzag.frequency_hz, zigzag.damping, zigzag.force_hz)
            parts.append(line_process(f"bubble.zigzags.{i}", rms, *line))
    return parts


def line_process(
    stem: str,
    rms_mm: float,
    frequency_hz: float,
    damping: float,
    force_hz: float | None,
    camera: int | None = None,
) -> Process:
    """A spectral line: a resonance of the rig, or a zigzag of bubbles."""
    values = {"rms_mm": rms_mm, "frequency_hz": frequency_hz, "damping": damping}
    if force_hz is not None:
        values["force_hz"] = force_hz
    return Process(stem, _resonance, {n: (n, v) for n, v in values.items()}, {}, camera)


def rise_motion(acceleration_mm_s2: float, acceleration_time_s: float) -> tuple[Array, Array]:
    """(4, 4) drift F and (4, 1) noise L along the rise: Singer's model; the last state is constant.

    States here and in `lateral_motion`: position, velocity, acceleration, drift velocity.
    acceleration_mm_s2 : RMS.
    """
    drift, noise = np.zeros((4, 4)), np.zeros((4, 1))
    drift[0, 1] = drift[1, 2] = 1.0
    drift[2, 2] = -1 / acceleration_time_s
    noise[2] = acceleration_mm_s2 * np.sqrt(2 / acceleration_time_s)
    return drift, noise


def lateral_motion(
    acceleration_mm_s2: float,
    frequency_hz: float,
    damping: float,
    drift_mm_s: float,
    drift_time_s: float,
) -> tuple[Array, Array]:
    """(4, 4) drift F and (4, 2) noise L across the rise.

    The velocity oscillates about a drift velocity of RMS drift_mm_s that forgets within
    drift_time_s.  acceleration_mm_s2 : RMS that the oscillation's noise alone would keep up.
    """
    omega = 2 * np.pi * frequency_hz
    rate = 2 * damping * omega
    drift, noise = np.zeros((4, 4)), np.zeros((4, 2))
    drift[0, 1] = drift[1, 2] = 1.0
    drift[2, 1:] = -(omega**2), -rate, omega**2
    drift[3, 3] = -1 / drift_time_s
    noise[2, 0] = acceleration_mm_s2 * np.sqrt(2 * rate)
    noise[3, 1] = drift_mm_s * np.sqrt(2 / drift_time_s)
    return drift, noise
