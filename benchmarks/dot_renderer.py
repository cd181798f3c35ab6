"""Brute-force pictures of tilted discs, to judge the dot measurement by.

Shares no code and no formula with it: discs are painted on a grid of sub-pixels, lit, blurred by
a sampled Gaussian, averaged over the square pixel, soiled with noise and rounded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """Equal discs in a plane seen by a parallel projection.

    ``centres_px`` (N, 2); ``image_from_disc`` (2, 2) maps the unit disc to an ellipse in pixels;
    ``light_per_px`` (2,) relative change of the light per pixel, 1 at the image's middle.
    """

    width: int
    height: int
    centres_px: Array
    image_from_disc: Array
    blur_px: float
    dot_level: float
    ground_level: float
    light_per_px: tuple[float, float] = (0.0, 0.0)
    subpixels: int = 16

    def light(self, u_px: Array, v_px: Array) -> Array:
        along_u = self.light_per_px[0] * (u_px - (self.width - 1) / 2)
        along_v = self.light_per_px[1] * (v_px - (self.height - 1) / 2)
        return 1.0 + along_u + along_v


def tilted_disc(radius_px: float, tilt_rad: float, axis_rad: float) -> Array:
    """(2, 2) image_from_disc of a disc tilted about an axis in the image plane."""
    c, s = np.cos(axis_rad), np.sin(axis_rad)
    turn = np.array([[c, -s], [s, c]])
    return radius_px * turn @ np.diag([1.0, np.cos(tilt_rad)]) @ turn.T


def render(scene: Scene) -> Array:
    """Noise-free image (height, width) in grey levels."""
    v, u = np.mgrid[: scene.height, : scene.width].astype(float)
    image = scene.ground_level * scene.light(u, v)
    for centre in scene.centres_px:
        add_disc(image, scene, centre)
    return image


def add_disc(image: Array, scene: Scene, centre: Array) -> None:
    """Add the light of one disc to an image, in place."""
    half = np.linalg.norm(scene.image_from_disc, axis=1) + 6.0 * scene.blur_px + 2.0
    low = np.maximum(np.floor(centre - half).astype(int), 0)
    high = np.minimum(np.ceil(centre + half).astype(int) + 1, [scene.width, scene.height])
    k = scene.subpixels
    # The canvas is wider than the patch so that blur never meets its border.
    u, v = ((np.arange((high[i] - low[i]) * k) + 0.5) / k - 0.5 + low[i] for i in range(2))
    uu, vv = np.meshgrid(u, v)
    painted = _disc(uu - centre[0], vv - centre[1], scene.image_from_disc, k)
    painted *= scene.light(uu, vv) * (scene.dot_level - scene.ground_level)
    for axis in (0, 1):
        painted = gaussian_filter1d(
            painted, scene.blur_px * k, axis=axis, mode="nearest", truncate=5.5
        )
        size = painted.shape[axis] // k
        split = (size, k, -1) if axis == 0 else (painted.shape[0], size, k)
        painted = painted.reshape(split).mean(axis=1 if axis == 0 else 2)
    image[low[1] : high[1], low[0] : high[0]] += painted


def _disc(du: Array, dv: Array, image_from_disc: Array, subpixels: int) -> Array:
    """Share of each sub-pixel inside the ellipse: its boundary is straight at that scale."""
    inverse = np.linalg.inv(image_from_disc)
    p, q = inverse[0, 0] * du + inverse[0, 1] * dv, inverse[1, 0] * du + inverse[1, 1] * dv
    squared = p * p + q * q
    slope = 2.0 * np.hypot(
        inverse[0, 0] * p + inverse[1, 0] * q, inverse[0, 1] * p + inverse[1, 1] * q
    )
    inside = 0.5 - (squared - 1.0) / np.maximum(slope, 1e-9) * subpixels
    return np.clip(inside, 0.0, 1.0)


def picture(
    clean: Array, noise_sigma: float, bits: int, rng: np.random.Generator
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """A camera's picture of a noise-free image: Gaussian noise, then rounding to 8 or 16 bits."""
    noisy = np.rint(clean + noise_sigma * rng.standard_normal(clean.shape))
    if bits == 8:
        return np.clip(noisy, 0, 255).astype(np.uint8)
    return np.clip(noisy, 0, 65535).astype(np.uint16)


def centre_bound_px(scene: Scene, noise_sigma: float) -> Array:
    """(2,) Cramer-Rao bound of the first disc's centre (u, v), by differences of renderings.

    Unknown with it: the ellipse's shape (3), blur, and both grey levels; the light is known.
    """
    base = replace(scene, centres_px=scene.centres_px[:1])
    h = 0.02
    changes: list[Array] = []
    for i in range(2):
        shift = np.eye(2)[i] * h
        changes.append(
            _difference(base, centres_px=(base.centres_px - shift, base.centres_px + shift))
        )
    for stretch in ([[1, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 1]]):
        step = np.array(stretch) * h
        pair = (base.image_from_disc - step, base.image_from_disc + step)
        changes.append(_difference(base, image_from_disc=pair))
    changes.append(_difference(base, blur_px=(base.blur_px - h, base.blur_px + h)))
    changes.append(_difference(base, dot_level=(base.dot_level - 1, base.dot_level + 1)))
    changes.append(_difference(base, ground_level=(base.ground_level - 1, base.ground_level + 1)))
    jacobian = np.array([c.ravel() for c in changes]) / noise_sigma
    scale = np.linalg.norm(jacobian, axis=1)
    jacobian /= scale[:, None]
    covariance = np.linalg.inv(jacobian @ jacobian.T)
    return np.sqrt(np.diag(covariance)[:2]) / scale[:2] * np.array([2 * h, 2 * h])


def _difference(scene: Scene, **pair: tuple[object, object]) -> Array:
    """Rendering with the second value minus the one with the first (not divided by the step)."""
    ((name, (low, high)),) = pair.items()
    return render(replace(scene, **{name: high})) - render(replace(scene, **{name: low}))
