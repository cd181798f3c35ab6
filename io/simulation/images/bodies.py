"""Bubbles as solid bodies: an ellipsoid with surface modes, its volume and its exact silhouettes.

A body is the image, under rotation and the three semi-axes, of a unit sphere whose radius is
1 + sum c_k Y_k(s), Y_k the real spherical harmonics of degrees 2 to 4 with greatest value 1. Seen
along a direction d, the sphere's points of one polar angle about d stay on that angle, so the
silhouette is one maximum per angle, exact for parallel rays. Nothing here knows how a detector
describes an outline.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.rig.camera import Camera

MODES = tuple((degree, order) for degree in (2, 3, 4) for order in range(-degree, degree + 1))
"""(degree, order) of each coefficient; negative orders are the sine ones."""

_SAMPLES = 12
_SEARCH = 49
_NEWTON = 4


@dataclass(frozen=True)
class Bodies:
    """Deformed ellipsoids, with coordinates either in the rig or in the laboratory frame.

    origin_mm : (..., 3) centre of the ellipsoid that was deformed by the modes. It is not the
        centre of volume.
    rotation : (..., 3, 3) frame_from_body
    semi_axes_mm : (..., 3) along the body's axes.
    modes : (..., 21) relative amplitudes in the order of `MODES`.
    """

    origin_mm: Array
    rotation: Array
    semi_axes_mm: Array
    modes: Array

    @property
    def shape_mm(self) -> Array:
        """(..., 3, 3) symmetric shape matrix of the ellipsoid, before its modes."""
        return np.asarray(
            (self.rotation * self.semi_axes_mm[..., None, :]) @ np.swapaxes(self.rotation, -1, -2)
        )

    def moved(self, by_mm: ArrayLike) -> Bodies:
        """Return the bodies displaced by (..., 3) mm."""
        return Bodies(
            self.origin_mm + np.asarray(by_mm), self.rotation, self.semi_axes_mm, self.modes
        )


def bodies_about(
    centre_mm: ArrayLike,
    rotation: ArrayLike,
    semi_axes_mm: ArrayLike,
    modes: ArrayLike,
    *,
    d_eq_mm: ArrayLike | None = None,
) -> Bodies:
    """Return bodies with these centres of volume (..., 3), scaled to diameters (...) if given."""
    centre, turn = np.asarray(centre_mm, float), np.asarray(rotation, float)
    axes, amplitudes = np.asarray(semi_axes_mm, float), np.asarray(modes, float)
    volume, offset = _sphere_moments(amplitudes)
    if d_eq_mm is not None:
        wanted = np.pi / 6 * np.asarray(d_eq_mm, float) ** 3
        axes = axes * np.cbrt(wanted / (volume * np.prod(axes, -1)))[..., None]
    origin = centre - np.einsum("...ij,...j->...i", turn, axes * offset)
    return Bodies(origin, turn, axes, amplitudes)


def volume_mm3(bodies: Bodies) -> Array:
    """Return the volumes (...) in mm^3; the quadrature is exact."""
    return np.asarray(_sphere_moments(bodies.modes)[0] * np.prod(bodies.semi_axes_mm, -1))


def d_eq_mm(bodies: Bodies) -> Array:
    """Return the equivalent diameters (...) in mm."""
    return np.asarray(np.cbrt(6 / np.pi * volume_mm3(bodies)))


def volume_centre_mm(bodies: Bodies) -> Array:
    """Return the exact centres of volume (..., 3) in mm."""
    offset = bodies.semi_axes_mm * _sphere_moments(bodies.modes)[1]
    turned = np.einsum("...ij,...j->...i", bodies.rotation, offset)
    return np.asarray(bodies.origin_mm + turned)


def surface_modes(directions: Array) -> Array:
    """Return real spherical harmonics (..., 21) at unit vectors (..., 3), ordered as `MODES`."""
    x, y, z = np.moveaxis(directions, -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    xy, minus = 2 * x * y, xx - yy
    sine3, cosine3 = y * (3 * xx - yy), x * (xx - 3 * yy)
    first3 = (5 * zz - 1) * np.sqrt(15 / 4) * 3 / 8
    first4 = z * (7 * zz - 3) / 1.0560344332612137
    second4 = (7 * zz - 1) * 7 / 9
    root27, root256 = z * np.sqrt(27 / 4), z * 16 / np.sqrt(27)
    return np.stack(
        [xy, 2 * y * z, (3 * zz - 1) / 2, 2 * x * z, minus]
        + [sine3, xy * root27, y * first3, z * (5 * zz - 3) / 2, x * first3]
        + [minus * root27, cosine3]
        + [2 * xy * minus, sine3 * root256, xy * second4, y * first4]
        + [(35 * zz * zz - 30 * zz + 3) / 8, x * first4, minus * second4, cosine3 * root256]
        + [minus * minus - xy * xy],
        -1,
    )


def outline_px(bodies: Bodies, camera: Camera, count: int = 128) -> Array:
    """Return the outlines (..., count, 2) in px of bodies in the rig frame.

    The points are evenly spaced in a smooth parameter. The points of the rim are found for the
    direction of the ray through the body's origin and are projected one by one. This is exact for
    kappa = 0; otherwise the error is at most size * (kappa size)^2 / 8.
    """
    shape = bodies.origin_mm.shape[:-1]
    uv = camera.project(bodies.origin_mm.reshape(-1, 3))
    ray = camera.unproject(uv)[1].reshape(*shape, 3)
    return camera.project(rim_mm(bodies, ray, count).reshape(-1, 3)).reshape(*shape, count, 2)


def rim_mm(bodies: Bodies, direction: ArrayLike, count: int = 128) -> Array:
    """Return points (..., count, 3) in mm of the outline seen along ``direction`` (..., 3)."""
    axes = _viewing_axes(bodies, np.asarray(direction, float))
    angle = np.arange(count) * 2 * np.pi / count
    across = axes[..., None, 0, :] * np.cos(angle)[:, None] + axes[..., None, 1, :] * np.sin(
        angle
    ).reshape(-1, 1)
    away = axes[..., None, 2, :]
    if np.any(bodies.modes):
        turn = _outermost(across, away, bodies.modes)[..., None]
        across = across * np.cos(turn) + away * np.sin(turn)
    radius = 1 + np.einsum("...nk,...k->...n", surface_modes(across), bodies.modes)
    local = bodies.semi_axes_mm[..., None, :] * across * radius[..., None]
    turned = local @ np.swapaxes(bodies.rotation, -1, -2)
    return np.asarray(bodies.origin_mm[..., None, :] + turned)


def outline_moments(outline_px: ArrayLike) -> tuple[Array, Array, Array]:
    """Return area (...), centroid (..., 2) and central second moments per area (..., 2, 2) of
    outlines.

    They are contour integrals with spectral derivatives, exact to rounding for closed outlines
    (..., N, 2) whose points are even in a smooth parameter.
    """
    points = np.asarray(outline_px, float)
    middle = points.mean(-2, keepdims=True)
    u, v = np.moveaxis(points - middle, -1, 0)
    du, dv = _slope(u), _slope(v)
    area = np.sum(u * dv - v * du, -1) / 2
    centre = np.stack([np.sum(u * u * dv, -1), -np.sum(v * v * du, -1)], -1) / 2 / area[..., None]
    uu, vv = np.sum(u**3 * dv, -1) / 3, -np.sum(v**3 * du, -1) / 3
    uv = np.sum(u * u * v * dv, -1) / 2
    second = np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2) / area[..., None, None]
    second -= centre[..., :, None] * centre[..., None, :]
    return np.abs(area), middle[..., 0, :] + centre, second


def _slope(values: Array) -> Array:
    """Return the derivative of periodic samples (..., N) by the sample's number."""
    count = values.shape[-1]
    wave = np.fft.rfftfreq(count, 1 / count) * 2j * np.pi / count
    if count % 2 == 0:
        wave[-1] = 0
    return np.fft.irfft(np.fft.rfft(values) * wave, count)


def _viewing_axes(bodies: Bodies, direction: Array) -> Array:
    """Return (..., 3, 3) rows: two across and one along the direction, in the undeformed sphere."""
    away = np.einsum("...ji,...j->...i", bodies.rotation, direction) / bodies.semi_axes_mm
    away = away / np.linalg.norm(away, axis=-1, keepdims=True)
    least = np.eye(3)[np.argmin(np.abs(away), -1)]
    right = np.cross(least, away)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(away, right), away], -2)


def _outermost(across: Array, away: Array, modes: Array) -> Array:
    """Return (..., N) angle out of the viewing plane at which each meridian reaches farthest out.

    cos(psi) (1 + f) is a trigonometric polynomial of degree 5, known from 12 samples.
    """
    psi = np.arange(_SAMPLES) * 2 * np.pi / _SAMPLES
    cosine, sine = np.cos(psi)[:, None], np.sin(psi)[:, None]
    s = across[..., None, :] * cosine + away[..., None, :] * sine
    reach = np.einsum("...npk,...k->...np", surface_modes(s), modes)
    reach = (1 + reach) * np.cos(psi)
    coefficients = np.fft.rfft(reach)[..., :6] * 2 / _SAMPLES
    real, imaginary = coefficients.real, -coefficients.imag
    real[..., 0] /= 2
    k = np.arange(6)
    grid = np.linspace(-np.pi / 2, np.pi / 2, _SEARCH)
    on_grid = real @ np.cos(k[:, None] * grid) + imaginary @ np.sin(k[:, None] * grid)
    best = grid[np.argmax(on_grid, -1)]
    for _ in range(_NEWTON):
        c, s_ = np.cos(best[..., None] * k), np.sin(best[..., None] * k)
        slope = np.sum(k * (imaginary * c - real * s_), -1)
        bend = -np.sum(k * k * (real * c + imaginary * s_), -1)
        best = best - np.where(bend < 0, slope / np.minimum(bend, -1e-12), 0.0)
    return np.asarray(best)


@lru_cache(maxsize=1)
def _quadrature() -> tuple[Array, Array, Array]:
    """Return the directions (Q, 3), weights (Q,) and modes (Q, 21), exact to degree 23."""
    z, weight = np.polynomial.legendre.leggauss(12)
    turn = (np.arange(24) + 0.5) * 2 * np.pi / 24
    level = np.sqrt(1 - z**2)[:, None]
    s = np.stack([level * np.cos(turn), level * np.sin(turn), z[:, None] + 0 * turn], -1)
    weights = np.repeat(weight, 24) * 2 * np.pi / 24
    return s.reshape(-1, 3), weights, surface_modes(s.reshape(-1, 3))


def _sphere_moments(modes: Array) -> tuple[Array, Array]:
    """Return the volume (...) and centre of volume (..., 3) of the deformed unit sphere."""
    s, weights, harmonics = _quadrature()
    radius = 1 + modes @ harmonics.T
    volume = radius**3 @ weights / 3
    return np.asarray(volume), (radius**4 * weights) @ s / 4 / volume[..., None]
