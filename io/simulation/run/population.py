"""The bubbles of a simulated run: sizes, proportions, surface modes and looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from telerig.arrays import Array
from telerig.io.simulation.config import BubbleConfig, Range
from telerig.io.simulation.images.bodies import MODES
from telerig.io.simulation.images.bubbles import Look

_SURFACE_TENSION_N_M = 0.072
_DENSITY_KG_M3 = 998.0


@dataclass(frozen=True)
class Population:
    """What stays the same of each of B bubbles.

    d_eq_mm : (B,); semi_axes_mm : (B, 3), proportions, the third along the path.
    modes_static, modes_swing : (B, 21) relative; swing_hz, swing_rad : (B, 21).
    spin_hz, spin_rad : (B,).
    """

    d_eq_mm: Array
    semi_axes_mm: Array
    modes_static: Array
    modes_swing: Array
    swing_hz: Array
    swing_rad: Array
    spin_hz: Array
    spin_rad: Array
    looks: tuple[Look, ...]


def lamb_frequency_hz(degree: int, d_eq_mm: float) -> float:
    """Frequency at which surface tension swings a bubble's mode in water (Lamb, sec. 275)."""
    radius = d_eq_mm / 2000
    n = degree
    square = (n - 1) * (n + 1) * (n + 2) * _SURFACE_TENSION_N_M / (_DENSITY_KG_M3 * radius**3)
    return float(np.sqrt(square) / (2 * np.pi))


def random_population(config: BubbleConfig, count: int, rng: Generator) -> Population:
    """Draw ``count`` bubbles."""
    d_eq = rng.uniform(*config.d_eq_mm, count)
    aspect = rng.uniform(*config.aspect, count)
    uneven = rng.uniform(-config.triaxial, config.triaxial, count)
    axes = np.stack([1 + uneven / 2, 1 - uneven / 2, 1 / aspect], -1)
    degrees = np.array([degree for degree, _ in MODES])
    static = rng.uniform(-1, 1, (count, len(MODES)))
    swing = rng.uniform(-1, 1, (count, len(MODES)))
    for modes, amplitude in (
        (static, config.modes_static),
        (swing, config.modes_oscillating),
    ):
        modes *= np.array([amplitude.get(int(degree), 0.0) for degree in degrees])
    hertz = [[config.tone * lamb_frequency_hz(int(n), d) for n in degrees] for d in d_eq]
    phase = rng.uniform(0, 2 * np.pi, (count, len(MODES)))
    spin = rng.uniform(*config.spin_hz, count)
    turn = rng.uniform(0, 2 * np.pi, count)
    looks = tuple(_look(config, rng) for _ in range(count))
    swing_hz = np.reshape(hertz, (count, len(MODES)))
    return Population(d_eq, axes, static, swing, swing_hz, phase, spin, turn, looks)


def _look(config: BubbleConfig, rng: Generator) -> Look:
    def drawn(low_high: Range) -> float:
        return float(rng.uniform(*low_high))

    offset = config.heart_offset * rng.standard_normal(2)
    return Look(
        rim=drawn(config.rim),
        heart=drawn(config.heart),
        heart_radius=drawn(config.heart_radius),
        heart_sharpness=config.heart_sharpness,
        heart_offset=(float(offset[0]), float(offset[1])),
        ring=config.ring * float(rng.uniform(0.4, 1.4)),
    )
