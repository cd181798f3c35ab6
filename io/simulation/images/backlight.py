"""What a backlit camera sees without bubbles: an uneven screen, dirt on windows and on the lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from telerig.arrays import Array, Float32

_WAVES = 14
_SPECK_REACH = 3.5


@dataclass(frozen=True)
class Screen:
    """Describe a smooth bright field that is known everywhere, so that it can move in the image.

    level : grey level at the image's middle as a fraction of full scale.
    gradient : (2,) relative change over half the image's diagonal, along u and v.
    vignetting : relative loss in the corners.
    waves_per_px : (waves, 2) angular wave numbers of the texture in rad/px.
    amplitude, phase_rad : (waves,) relative amplitude and phase in rad of each wave.
    """

    level: float
    gradient: tuple[float, float]
    vignetting: float
    waves_per_px: Array
    amplitude: Array
    phase_rad: Array

    def image(self, size_px: tuple[int, int], shift_px: Array) -> Float32:
        """Return the image (height, width) with texture and gradient moved by shift_px (2,).

        Each plane wave is a product of two, so the image is one product of narrow matrices.
        """
        width, height = size_px
        u, v = np.arange(width) - shift_px[0], np.arange(height) - shift_px[1]
        half = np.hypot(width, height) / 2
        across = np.outer(self.waves_per_px[:, 0], u)
        down = np.outer(self.waves_per_px[:, 1], v) + self.phase_rad[:, None]
        slope_u = self.gradient[0] * np.tanh((u - (width - 1) / 2) / half)
        slope_v = self.gradient[1] * np.tanh((v - (height - 1) / 2) / half)
        by_row = [
            *(self.amplitude[:, None] * np.cos(down)),
            *(-self.amplitude[:, None] * np.sin(down)),
        ]
        by_row += [np.ones(height), 1 + slope_v]
        by_column = [*np.cos(across), *np.sin(across), slope_u, np.ones(width)]
        field = _single(by_row).T @ _single(by_column)
        dark_u = self.vignetting * ((np.arange(width) - (width - 1) / 2) / half) ** 2
        dark_v = 1 - self.vignetting * ((np.arange(height) - (height - 1) / 2) / half) ** 2
        return np.asarray(field * (self.level * (dark_v[:, None] - dark_u)).astype(np.float32))


def random_screen(
    rng: Generator,
    *,
    level: float,
    gradient: float,
    vignetting: float,
    texture: float,
    wavelength_px: tuple[float, float] = (60.0, 600.0),
) -> Screen:
    """Draw a screen with waves (RMS ``texture``, relative) and a gradient in random directions."""
    angle = rng.uniform(0, 2 * np.pi, _WAVES)
    length = _log_uniform(rng, wavelength_px, _WAVES)
    waves = 2 * np.pi / length[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    amplitude = np.abs(rng.standard_normal(_WAVES)) * length
    amplitude *= texture * np.sqrt(2) / np.linalg.norm(amplitude)
    tilt = rng.uniform(0, 2 * np.pi)
    slope = (float(gradient * np.cos(tilt)), float(gradient * np.sin(tilt)))
    return Screen(level, slope, vignetting, waves, amplitude, rng.uniform(0, 2 * np.pi, _WAVES))


@dataclass(frozen=True)
class Specks:
    """Specks of dirt, which absorb light with a Gaussian profile.

    uv_px : (specks, 2) places.
    sigma_px : (specks,) standard deviation of the profile.
    depth : (specks,) share of light that is absorbed in the middle.
    """

    uv_px: Array
    sigma_px: Array
    depth: Array

    def darken(self, image: Float32, shift_px: Array) -> None:
        """Multiply ``image`` in place by the transmission of the specks, moved by shift_px."""
        height, width = image.shape
        reach = np.ceil(_SPECK_REACH * self.sigma_px)
        places = self.uv_px + shift_px
        size = np.array([width, height])
        near = np.all((places > -reach[:, None]) & (places < size - 1 + reach[:, None]), -1)
        for place, sigma, depth, far in zip(
            places[near], self.sigma_px[near], self.depth[near], reach[near]
        ):
            left, top = np.maximum(np.floor(place - far), 0).astype(int)
            right, bottom = np.minimum(np.ceil(place + far) + 1, size).astype(int)
            du = np.exp(-((np.arange(left, right) - place[0]) ** 2) / (2 * sigma**2))
            dv = np.exp(-((np.arange(top, bottom) - place[1]) ** 2) / (2 * sigma**2))
            image[top:bottom, left:right] *= (1 - depth * dv[:, None] * du).astype(np.float32)


def random_specks(
    rng: Generator,
    count: int,
    low_px: Array,
    high_px: Array,
    *,
    sigma_px: tuple[float, float],
    depth: tuple[float, float],
) -> Specks:
    """Return ``count`` random specks in the rectangle between two corners.

    low_px, high_px : (2,) the corners. sigma_px, depth : ranges of the specks' sizes and depths.
    """
    places = rng.uniform(low_px, high_px, (count, 2))
    sigma = _log_uniform(rng, sigma_px, count)
    return Specks(places, sigma, rng.uniform(*depth, count))


def _log_uniform(rng: Generator, low_high: tuple[float, float], count: int) -> Array:
    low, high = low_high
    return np.asarray(low * (high / low) ** rng.random(count))


def _single(rows: list[Array]) -> Float32:
    return np.asarray(rows, dtype=np.float32)
