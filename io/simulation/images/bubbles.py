"""Backlit images of bubbles, by geometry alone: exact coverage of fine cells, then the optics.

Each silhouette is cut exactly against a grid of sub-pixel cells in a window of its own, filled
with the bubble's transmission (dark rim, bright heart), blurred by its own Gaussian, smeared
along its motion and integrated over the pixels. Overlapping bubbles multiply.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array, Float32, Ints
from telerig.io.images.outline_raster import cell_coverage, overlap, pixel_weights, refined
from telerig.io.simulation.images.backlight import Screen, Specks
from telerig.io.simulation.images.bodies import outline_moments

CELLS = 4
"""Fine cells per pixel and direction."""

_REACH = 4.5
_HEART_REACH = 3.2
_RING_REACH = 4.0
_STILL_PX = 0.02


@dataclass(frozen=True)
class Look:
    """Describe how a bubble looks against the light.

    rim, heart, ring are transmissions, 0 (dark) to 1; all lengths are relative to the radius.

    rim : transmission of the dark part.
    heart : transmission of the bright middle; if it equals rim, there is no bright middle. It falls
        to half at heart_radius, with the exponent heart_sharpness (2.5 as in real images; from 20
        on the middle is a disc with a sharp edge).
    heart_offset : (2,) place of the bright middle.
    ring : transmission of a faint ring at ring_radius, of the width ring_width; it is up to twice
        as bright at the bottom and fades towards the top.
    """

    rim: float = 0.1
    heart: float = 0.9
    heart_radius: float = 0.33
    heart_sharpness: float = 2.5
    heart_offset: tuple[float, float] = (0.0, 0.0)
    ring: float = 0.04
    ring_radius: float = 0.69
    ring_width: float = 0.05

    def transmission(self, du: Array, dv: Array, axes: Array) -> Float32:
        """Return the transmission (len(dv), len(du)) at offsets du, dv in px from the centroid.

        axes : (2, 2) in px, the matrix that maps the unit circle to the ellipse that has the same
        second moments as the silhouette.
        """
        inverse = np.linalg.inv(axes)
        metric = inverse.T @ inverse
        out = np.full((len(dv), len(du)), self.rim, np.float32)
        if self.heart > self.rim:
            shift = axes @ self.heart_offset
            square = _square(du - shift[0], dv - shift[1], metric / self.heart_radius**2)
            inner = square < _HEART_REACH**2
            fall = np.exp(-np.log(2.0) * square[inner] ** (self.heart_sharpness / 2))
            out[inner] += (self.heart - self.rim) * fall
        if self.ring > 0:
            square = _square(du, dv, metric)
            low, high = self.ring_radius + _RING_REACH * self.ring_width * np.array([-1, 1])
            near = (square > max(low, 0.0) ** 2) & (square < high**2)
            off = (np.sqrt(square[near]) - self.ring_radius) / self.ring_width
            below = np.broadcast_to(dv[:, None], near.shape)[near] / np.hypot(*np.diag(axes))
            out[near] += self.ring * (1 + np.tanh(3 * below)) * np.exp(-(off**2) / 2)
        return out


def _square(du: Array, dv: Array, metric: Array) -> Float32:
    """Return (len(dv), len(du)) squared length of the offsets in a metric (2, 2)."""
    u, v, m = du.astype(np.float32), dv.astype(np.float32)[:, None], metric.astype(np.float32)
    return np.asarray(np.maximum((m[0, 0] * u + 2 * m[0, 1] * v) * u + m[1, 1] * v * v, 0))


@dataclass(frozen=True)
class Silhouette:
    """A bubble as a camera sees it.

    outline_px : (N, 2).
    blur_px : standard deviation of the blur.
    smear_px : motion during the exposure.
    """

    outline_px: Array
    look: Look
    blur_px: float
    smear_px: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Patch:
    """Hold the light that bubbles absorb in a rectangular part of an image.

    row, column : position of the part's first pixel in the image.
    absorption : (M, N) share of the light that is absorbed in each of its pixels, 0 to 1.
    """

    row: int
    column: int
    absorption: Float32


def absorption_patch(bubble: Silhouette) -> Patch:
    """Return the share of light that one bubble absorbs, in the part of the image it can reach."""
    outline = bubble.outline_px
    first = np.floor(outline.min(0) + 0.5).astype(int)
    count = np.floor(outline.max(0) + 0.5).astype(int) - first + 1
    edges = max(512, 16 * int(count.max()))
    fine_outline = (refined(outline, edges) - first + 0.5) * CELLS
    fine_outline = np.clip(fine_outline, 0.0, count * CELLS)
    covered = cell_coverage(fine_outline, (int(count[1]) * CELLS, int(count[0]) * CELLS))
    fine = covered.astype(np.float32) * (1 - _inside(bubble, first, count))
    smear = np.asarray(bubble.smear_px, float)
    length = float(np.linalg.norm(smear))
    pad = int(np.ceil(_REACH * bubble.blur_px + length / 2)) + 1
    nodes, weights = _exposure(length, bubble.blur_px)
    total = np.zeros(count[::-1] + 2 * pad, np.float32)
    for node, weight in zip(nodes, weights):
        by_u, by_v = (
            pixel_weights(int(n), CELLS, pad, bubble.blur_px, float(node * shift), np.float32)
            for n, shift in zip(count, smear)
        )
        total += np.float32(weight) * (by_v @ fine @ by_u.T)
    return Patch(int(first[1]) - pad, int(first[0]) - pad, total)


def _inside(bubble: Silhouette, first: Ints, count: Ints) -> Float32:
    """Return (cells_v, cells_u) transmission behind the outline, at the fine cells' centres."""
    _, centre, second = outline_moments(bubble.outline_px)
    values, vectors = np.linalg.eigh(second)
    axes = vectors * 2 * np.sqrt(values) @ vectors.T
    u, v = (start + (np.arange(n * CELLS) + 0.5) / CELLS - 0.5 for start, n in zip(first, count))
    return bubble.look.transmission(u - centre[0], v - centre[1], axes)


def _exposure(length_px: float, blur_px: float) -> tuple[Array, Array]:
    """Return Gauss-Legendre moments of the exposure (-1/2..1/2) and weights."""
    if length_px < _STILL_PX:
        return np.zeros(1), np.ones(1)
    nodes, weights = np.polynomial.legendre.leggauss(2 + int(2 * length_px / max(blur_px, 0.3)))
    return nodes / 2, weights / 2


def transmission(size_px: tuple[int, int], bubbles: Sequence[Silhouette]) -> Float32:
    """Return (height, width) share of the light that all bubbles together let through."""
    width, height = size_px
    out = np.ones((height, width), np.float32)
    for bubble in bubbles:
        reach = _REACH * bubble.blur_px + 2
        if np.any(bubble.outline_px.max(0) < -reach) or np.any(
            bubble.outline_px.min(0) > np.array(size_px) - 1 + reach
        ):
            continue
        patch = absorption_patch(bubble)
        inside, taken = overlap(out.shape, patch.absorption.shape, patch.row, patch.column)
        out[inside] *= 1 - patch.absorption[taken]
    return out


def render_bubbles(
    size_px: tuple[int, int],
    bubbles: Sequence[Silhouette],
    screen: Screen,
    *,
    screen_shift_px: Array,
    window_dirt: Specks | None = None,
    lens_dirt: Specks | None = None,
    lab_shift_px: Array | None = None,
    gain: float = 1.0,
) -> Float32:
    """Return the grey levels (height, width) without noise, as fractions of full scale.

    screen_shift_px, lab_shift_px : (2,) how far the screen and the tank's windows have moved in the
    image since stage position 0.
    """
    image = screen.image(size_px, np.asarray(screen_shift_px, float))
    image *= transmission(size_px, bubbles)
    if window_dirt is not None and lab_shift_px is not None:
        window_dirt.darken(image, lab_shift_px)
    if lens_dirt is not None:
        lens_dirt.darken(image, np.zeros(2))
    image *= np.float32(gain)
    return image
