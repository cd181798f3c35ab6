"""A strip's dots taken out of bubble images, so that they are neither bubbles nor background."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.frontend.reference_following import Follower, Mark
from telerig.estimator.frontend.reference_view import TankView
from telerig.estimator.frontend.references import DotLook

Array = NDArray[np.float64]

_RING_PX = 4
_TOUCHED = 0.85
_LARGEST = 1.6
_PAD_PX = 2.0


@dataclass(frozen=True)
class StripInImages:
    """Where one camera sees the dots, whole or not, measured or not.

    places_mm : (K, 2) lab; epochs : (K,). shift_mm : (F, 2) of each frame. position_mm : (F,).
    epoch_starts : first frame of each epoch; a dot's place holds for its own.
    """

    view: TankView
    look: DotLook
    places_mm: Array
    epochs: NDArray[np.int64]
    epoch_starts: NDArray[np.int64]
    shift_mm: Array
    position_mm: Array

    @staticmethod
    def of(follower: Follower, look: DotLook, marks: list[Mark], position_mm: Array) -> StripInImages:
        shift, starts = follower.shift_mm.copy(), [*follower.epoch_starts, len(position_mm)]
        for first, last in zip(starts[:-1], starts[1:]):
            part = shift[first:last]
            known = np.flatnonzero(np.isfinite(part[:, 0]))
            for axis in (0, 1) if known.size else ():
                part[:, axis] = np.interp(np.arange(len(part)), known, part[known, axis])
        return StripInImages(
            follower.view,
            look,
            np.array([m.place_mm for m in marks]).reshape(-1, 2),
            np.array([m.epoch for m in marks], np.int64),
            np.array(follower.epoch_starts, np.int64),
            np.nan_to_num(shift),
            position_mm,
        )

    def centres_px(self, frame: int) -> Array:
        """(n, 2) of the dots that reach into a frame."""
        epoch = int(np.searchsorted(self.epoch_starts, frame, side="right")) - 1
        places = self.places_mm[self.epochs == epoch] + self.shift_mm[frame]
        margin = self.look.a_px + 3 * self.look.blur_px
        return self.view.in_image(places, float(self.position_mm[frame]), margin)[1]

    def erased(self, image: NDArray[Any], frame: int) -> NDArray[Any]:
        """A copy with the screen's level in place of the dots, but for dots that something
        dark touches."""
        centres = self.centres_px(frame)
        if not len(centres):
            return image
        out = image.copy()
        radius = self.look.a_px + 2.5 * self.look.blur_px + _PAD_PX
        for centre in centres:
            _erase(out, centre, radius)
        return out

    def are_dots(self, frame: int, uv_px: Array, diameter_px: Array) -> NDArray[np.bool_]:
        """(n,) which bubbles, by their centres (n, 2) and diameters, are dots of the strip."""
        centres = self.centres_px(frame)
        if not len(centres) or not len(uv_px):
            return np.zeros(len(uv_px), bool)
        near = np.linalg.norm(uv_px[:, None] - centres, axis=-1).min(1)
        reach = self.look.a_px + _PAD_PX
        return np.asarray((near < reach) & (diameter_px < _LARGEST * 2 * self.look.a_px))


def _erase(image: NDArray[Any], centre: Array, radius: float) -> None:
    """In place: a plane through the ring about the dot; nothing where the ring is not free."""
    reach = radius + _RING_PX
    low = np.maximum(np.floor(centre - reach).astype(int), 0)
    high = np.minimum(np.ceil(centre + reach).astype(int) + 1, image.shape[::-1])
    if np.any(high <= low):
        return
    window = image[low[1] : high[1], low[0] : high[0]]
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]].astype(float) - centre[::-1, None, None]
    distance = np.hypot(u, v)
    ring, disc = (distance > radius) & (distance <= reach), distance <= radius
    if np.count_nonzero(ring) < 10 or not disc.any():
        return
    grey = window[ring].astype(float)
    if np.quantile(grey, 0.05) < _TOUCHED * np.median(grey):
        return
    terms = np.column_stack([np.ones(grey.size), u[ring], v[ring]])
    plane, *_ = np.linalg.lstsq(terms, grey, rcond=None)
    level = plane[0] + plane[1] * u[disc] + plane[2] * v[disc]
    window[disc] = np.rint(level) if image.dtype.kind in "ui" else level
