"""A strip's dots erased from bubble images, so that they become neither bubbles nor background."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.marks.following import Follower, Mark
from telerig.estimator.marks.strip_dots import DotLook
from telerig.estimator.marks.tank_view import TankView

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

_RING_PX = 4
_TOUCHED = 0.85
_LARGEST = 1.6
_PAD_PX = 2.0


@dataclass(frozen=True)
class StripInImages:
    """Where one camera sees the strip's dots, whether whole or not, measured or not.

    places_mm : (K, 2) lab; epochs : (K,). shift_mm : (F, 2) of each frame. position_mm : (F,).
    epoch_starts : first frame of each epoch; a dot's place is valid in its own epoch.
    line_mm : least and greatest place across the travel. diameter_mm : of a dot.
    """

    view: TankView
    look: DotLook
    places_mm: Array
    epochs: NDArray[np.int64]
    epoch_starts: NDArray[np.int64]
    shift_mm: Array
    position_mm: Array
    line_mm: tuple[float, float]
    diameter_mm: float

    @staticmethod
    def of(
        follower: Follower, look: DotLook, kept: list[Mark], position_mm: Array
    ) -> StripInImages:
        """kept : at least one mark."""
        marks = [*kept, *follower.brief(kept)]
        across = [float(m.place_mm[1]) for m in kept]
        shift, starts = follower.shift_mm.copy(), [*follower.epoch_starts, len(position_mm)]
        for first, last in pairwise(starts):
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
            (min(across), max(across)),
            follower.diameter_mm,
        )

    def centres_px(self, frame: int) -> Array:
        """(n, 2) of the dots that reach into a frame."""
        epoch = int(np.searchsorted(self.epoch_starts, frame, side="right")) - 1
        places = self.places_mm[self.epochs == epoch] + self.shift_mm[frame]
        margin = self.look.a_px + 3 * self.look.blur_px
        return self.view.in_image(places, float(self.position_mm[frame]), margin)[1]

    def erased(self, image: NDArray[Any], frame: int) -> NDArray[Any]:
        """A copy with the screen's level in place of the dots. Dots that something dark touches
        stay."""
        centres = self.centres_px(frame)
        if not len(centres):
            return image
        out = image.copy()
        radius = self.look.a_px + 2.5 * self.look.blur_px + _PAD_PX
        for centre in centres:
            _erase(out, centre, radius)
        return out

    def are_dots(self, frame: int, bubbles: pd.DataFrame) -> NDArray[np.bool_]:
        """(n,) which rows of a table of detections are dots of the strip.

        They are told by their place and size; those that the border cuts, by the strip's line.
        """
        uv = bubbles[["u_px", "v_px"]].to_numpy(float)
        size, centres = bubbles["d_eq_px"].to_numpy(float), self.centres_px(frame)
        if not len(uv):
            return np.zeros(0, bool)
        small = size < _LARGEST * 2 * self.look.a_px
        apart = np.linalg.norm(uv[:, None] - centres, axis=-1)
        near = apart.min(1, initial=np.inf) < self.look.a_px + _PAD_PX
        across = self.view.lab_mm(uv, float(self.position_mm[frame])) - self.shift_mm[frame]
        low, high = self.line_mm[0] - self.diameter_mm / 2, self.line_mm[1] + self.diameter_mm / 2
        in_line = (across[:, 1] > low) & (across[:, 1] < high)
        cut = bubbles["flags"].astype(str).str.contains("border").to_numpy(bool)
        return np.asarray(small & (near | (cut & in_line)))


def _erase(image: NDArray[Any], centre: Array, radius: float) -> None:
    """Replace the dot, in place, by a plane through the ring round it if the ring is free."""
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
