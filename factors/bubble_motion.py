"""Models how a bubble moves. Tracking, learning and smoothing all use the models of this module.

Over a run, the position along each axis is a path plus zigzags. The velocity of the path is a
constant mean U plus an Ornstein-Uhlenbeck process; a zigzag is a stochastic oscillator. Smoothing
and learning represent these processes by states (`bubble_processes`). White noise drives both, so
that their acceleration has no finite variance. In the smoothing of a run their sum passes a
low-pass (`inertial_bubble_path`), whose time is learned (`INERTIA_S`).

A tracker works from one frame to the next. It needs an acceleration to set its gates, and it has no
run from which a mean velocity could be known. Along the direction of rise the acceleration is
therefore an Ornstein-Uhlenbeck process (Singer, IEEE Trans. Aerosp. Electron. Syst. 6:473, 1970).
Across the rise the velocity oscillates about a slow drift (`rise_motion`, `lateral_motion`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from telerig.arrays import Array
from telerig.factors.state_space import Component, inertial_path, ou_velocity, resonance

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Zigzag:
    """Describes a stochastic oscillation of the bubbles' paths.

    rms_mm : RMS displacement along the rig's x, y and z axes; 0 for no oscillation along an axis.
    damping : damping ratio.
    force_hz : cut-off frequency of the two-pole low-pass filter of the driving force; None if the
        force is white noise.
    """

    frequency_hz: float
    damping: float
    rms_mm: Triple
    force_hz: float | None = None


@dataclass(frozen=True)
class Inertia:
    """Describes the first-order low-pass filter through which forces move a bubble.

    time_s : time constant of the filter along the rig's x, y and z axes.
    forces : intensity of the path's forces along these axes, divided by the model's.
    swings : damping of the zigzags along these axes, divided by the model's; they keep their RMS.
    noise : standard deviation of the pixels' white noise along the rise and across it, divided by
        the stated one.
    unseen : variances of the velocity (mm^2/s^2) along the axes that a shorter low-pass, which the
        run does not exclude, would add.
    cancelled : variances of velocity (mm^2/s^2) and acceleration (mm^2/s^4) by which errors along
        the path are smaller than independent errors along the axes would make them.
    """

    time_s: Triple
    forces: Triple = (1.0, 1.0, 1.0)
    swings: Triple = (1.0, 1.0, 1.0)
    noise: tuple[float, float] = (1.0, 1.0)
    unseen: Triple = (0.0, 0.0, 0.0)
    cancelled: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class BubbleModel:
    """Describes the prior distribution of the motion of every bubble.

    velocity_sigma_mm_s, velocity_tau_s : standard deviation and correlation time of the velocity
        about its constant mean (Ornstein-Uhlenbeck process).
    start_sigma_mm, mean_sigma_mm_s : standard deviations of the first position and of the mean
        velocity, along each axis.
    zigzags : oscillations that are added to the path.
    wander_px, wander_tau_s : RMS and correlation time of the centroid's error in each image; 0 px
        for none.
    inertia : low-pass through which the forces of path and zigzags move a bubble, so that its
        acceleration is a state; None for forces without one. `telerig.smooth` learns it from the
        run where it is None.
    """

    velocity_sigma_mm_s: float = 10.0
    velocity_tau_s: float = 0.3
    start_sigma_mm: float = 100.0
    mean_sigma_mm_s: float = 300.0
    zigzags: tuple[Zigzag, ...] = ()
    wander_px: float = 0.0
    wander_tau_s: float = 0.1
    inertia: Inertia | None = None


@dataclass(frozen=True)
class Prior:
    """Describes the log-normal prior of a positive number within bounds.

    step : change of the number's logarithm that the optimiser takes as 1.
    """

    low: float
    high: float
    median: float
    log_sigma: float
    step: float

    def log_density(self, value: float) -> float:
        """Return the log density up to a constant."""
        return float(-0.5 * (np.log(value / self.median) / self.log_sigma) ** 2)

    def log_gradient(self, value: float) -> float:
        """Return the derivative of the log density by the number's logarithm."""
        return float(-np.log(value / self.median) / self.log_sigma**2)


BUBBLE_PRIORS = {
    "bubble.zigzags.*.frequency_hz": Prior(1.0, 60.0, 8.0, 1.0, 0.02),
    "bubble.zigzags.*.damping": Prior(0.003, 0.5, 0.04, 0.8, 0.4),
    "bubble.zigzags.*.rms_mm": Prior(1e-3, 20.0, 0.3, 2.0, 0.2),
    "bubble.velocity_sigma_mm_s": Prior(0.5, 200.0, 10.0, 0.5, 0.2),
    "bubble.velocity_tau_s": Prior(0.02, 5.0, 0.3, 0.5, 0.3),
}
"""Priors of the hyper-parameters of `BubbleModel` that are learned from a run, by pattern of the
name."""


INERTIA_S = Prior(0.0005, 0.05, 0.002, 1.0, 0.7)
"""Prior of the time of an `Inertia`. The median is short: it gives a bubble more acceleration than
most have, where a run does not show how much."""

FORCES = Prior(0.02, 10.0, 1.0, 1.0, 0.7)
"""Prior of the intensity of the forces on a bubble's path, over that of the model."""

SWINGS = Prior(0.02, 4.0, 1.0, 1.0, 0.7)
"""Prior of the damping of a bubble's zigzags, over the model's 0.04: how much of a regular swing is
forced anew says nothing of how the path wanders. More than four times is no swing, and would stand
for shake where only one bubble shows both."""

NOISE = Prior(0.03, 2.0, 1.0, 0.5, 0.3)
"""Prior of the white noise of a bubble's pixels over the stated one, which contains what changes
slowly, too: the effect of an unknown shape on the centre."""


def learned_names(model: BubbleModel) -> list[str]:
    """Return the names of all hyper-parameters that `BUBBLE_PRIORS` covers, in a fixed order."""
    of_zigzags = [name for name in BUBBLE_PRIORS if "*" in name]
    found = [name.replace("*", str(i)) for i in range(len(model.zigzags)) for name in of_zigzags]
    return [*found, *(name for name in BUBBLE_PRIORS if "*" not in name)]


@dataclass(frozen=True)
class Process:
    """Describes one stochastic process along one direction, with the hyper-parameters that define
    it.

    stem : common first part of the hyper-parameters' names, for instance "bubble.zigzags.0".
    make : function that returns the process as a `Component`.
    learned : for each learned hyper-parameter the last part of its name, mapped to the argument of
        ``make`` and its value.
    fixed : the other arguments of ``make``.
    camera : index of the camera whose arm the process moves; None if it moves a bubble.
    """

    stem: str
    make: Callable[..., Component]
    learned: dict[str, tuple[str, float]]
    fixed: dict[str, float] = field(default_factory=dict)
    camera: int | None = None

    @property
    def component(self) -> Component:
        """The process as a `Component`; equal hyper-parameters give the same object if ``make`` is
        cached."""
        return self.make(**dict(self.learned.values()), **self.fixed)

    def moved(self, name: str, factor: float) -> Component:
        """Return the process after one hyper-parameter has been multiplied by a factor.

        name : the last part of the hyper-parameter's name.
        """
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
    """Return the processes that move a bubble along a direction: the path, then the zigzags.

    The states of the path begin with position and velocity.

    direction : (3,) unit vector in rig axes.
    bubbles : number of bubbles whose mean position is described. Their deviations are independent,
        so the RMS values are divided by its square root.
    mean_known : if True, the path is taken about its mean velocity; otherwise the mean velocity is
        an input of the process.
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


def inertial_bubble_path(model: BubbleModel, direction: Array, inertia: Inertia) -> Component:
    """Return a bubble's motion along a direction (3,): its path and zigzags after the low-pass.

    The first states of the process are position, velocity and acceleration.
    """
    share = np.square(direction)
    time_s, forces, swing = (
        float(share @ each) for each in (inertia.time_s, inertia.forces, inertia.swings)
    )
    sigma = model.velocity_sigma_mm_s * float(np.sqrt(forces))
    zigzags = tuple(replace(z, damping=z.damping * swing) for z in model.zigzags)
    swings = bubble_processes(replace(model, zigzags=zigzags), direction)[1:]
    return inertial_path(
        sigma, model.velocity_tau_s, time_s, [p.component for p in swings],
        start_sigma_mm=model.start_sigma_mm,
    )  # fmt: skip


def line_process(
    stem: str,
    rms_mm: float,
    frequency_hz: float,
    damping: float,
    force_hz: float | None,
    camera: int | None = None,
) -> Process:
    """Return the process of a spectral line, which is a resonance of the rig or a zigzag of
    bubbles.

    Arguments are as in `Process` and `state_space.resonance`.
    """
    values = {"rms_mm": rms_mm, "frequency_hz": frequency_hz, "damping": damping}
    if force_hz is not None:
        values["force_hz"] = force_hz
    return Process(stem, _resonance, {n: (n, v) for n, v in values.items()}, {}, camera)


def rise_motion(acceleration_mm_s2: float, acceleration_time_s: float) -> tuple[Array, Array]:
    """Return the drift F (4, 4) and the noise L (4, 1) of a bubble's motion along the direction of
    rise.

    This is Singer's model. The states here and in `lateral_motion` are position, velocity,
    acceleration and drift velocity; the last one stays constant here.

    acceleration_mm_s2 : RMS acceleration.
    acceleration_time_s : correlation time of the acceleration.
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
    """Return the drift F (4, 4) and the noise L (4, 2) of a bubble's motion across the rise.

    The velocity oscillates about a drift velocity, whose RMS is ``drift_mm_s`` and whose
    correlation time is ``drift_time_s``.

    acceleration_mm_s2 : RMS acceleration that the oscillation's noise alone would maintain.
    damping : damping ratio of the oscillation.
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
