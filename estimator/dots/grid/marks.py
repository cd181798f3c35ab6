"""Which places of a lattice carry a mark, as bounded log-likelihoods rather than decisions.

One mark that is missed, or one dot that only looks like a mark, must make a numbering less likely
but not impossible. So the log-likelihood ratio of each place is bounded on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.dots.grid.lattice import Lattice
from telerig.rig.target import Target

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

LOG_MISSED_MARK = -4.0
"""A mark that is seen as a plain dot."""
LOG_FALSE_MARK = -7.5
"""A plain dot that is seen as a mark."""
LOG_UNSEEN_MARK = -2.0
"""A mark where the image shows no lattice place, or the dot of a mark is lost."""
LOG_FILLED_GAP = -5.0
"""A dot (dirt, say) at the place of a mark of the style "missing"."""
LOG_UNSURE_GAP = -0.7
"""A mark of the style "missing" at an empty place that has too few dots round it to be a gap."""


@dataclass(frozen=True)
class MarkEvidence:
    """Evidence for marks at the places of a lattice.

    gain : (H, W) log-likelihood ratio of mark to plain dot; place (i, j) is gain[i + 1, j + 1].
    seen : (K, 2) places that look like marks.
    """

    gain: Array
    seen: Ints

    def at(self, places: Ints) -> Array:
        """(...,) log-likelihood ratio at (..., 2) places; marks outside the lattice are unseen."""
        shifted = places + 1
        inside = np.all((shifted >= 0) & (shifted < self.gain.shape), axis=-1)
        clipped = np.clip(shifted, 0, np.array(self.gain.shape) - 1)
        return np.where(inside, self.gain[clipped[..., 0], clipped[..., 1]], LOG_UNSEEN_MARK)

    def is_seen(self, places: Ints) -> Bools:
        """(...,) whether each of the (..., 2) places looks like a mark."""
        if not len(self.seen):
            return np.zeros(places.shape[:-1], bool)
        return np.asarray(np.any(np.all(places[..., None, :] == self.seen, axis=-1), axis=-1))


def relative_diameter(lattice: Lattice) -> Array:
    """(n,) diameter of each dot in units of the lattice's own pitch, relative to the median dot."""
    size = np.linalg.det(lattice.shape) ** 0.25
    return np.asarray(size / np.median(size))


def mark_likeness(lattice: Lattice, rings: Bools, target: Target) -> Array:
    """(n,) probability that each dot looks like a mark of the target's style (not "missing").

    rings : (n,) whether the image shows a ring.
    """
    if target.mark_style == "ring":
        return rings.astype(float)
    size = np.log(relative_diameter(lattice))
    step = np.log(
        (target.mark_diameter_mm or 1.5 * target.dot_diameter_mm) / target.dot_diameter_mm
    )
    spread = 1.5 * 1.4826 * float(np.median(np.abs(size)))
    sigma = float(np.clip(spread, 0.05, max(abs(step) / 4, 0.05)))
    odds = (size - step / 2) * step / sigma**2
    return np.asarray(1 / (1 + np.exp(-np.clip(odds, -30, 30))))


def mark_evidence(lattice: Lattice, rings: Bools, target: Target) -> MarkEvidence:
    """Evidence at all places of the lattice and of a border one place wide.

    rings : (n,) whether the image shows a ring.
    """
    shape = lattice.places.max(0) + 3
    occupied = np.zeros(shape, bool)
    occupied[tuple((lattice.places + 1).T)] = True
    gain = np.full(shape, LOG_UNSEEN_MARK)
    if target.mark_style == "missing":
        gaps = _gaps(occupied, target.bounded)
        lost = max(0.5, gaps.sum() - len(target.marks)) / occupied.sum()
        gain[_count_around(occupied) >= 4] = LOG_UNSURE_GAP
        gain[occupied] = LOG_FILLED_GAP
        gain[gaps] = -np.clip(np.log(lost), -5.0, -1.5)
        return MarkEvidence(gain, np.argwhere(gaps) - 1)
    like = mark_likeness(lattice, rings, target)
    gain[tuple((lattice.places + 1).T)] = mark_gain(like)
    return MarkEvidence(gain, lattice.places[like > 0.4])


def mark_gain(likeness: Array) -> Array:
    """(n,) log-likelihood ratio of mark to plain dot, from the likeness of `mark_likeness` (n,)."""
    missed, false = np.exp(LOG_MISSED_MARK), np.exp(LOG_FALSE_MARK)
    as_mark = np.log(likeness * (1 - missed) + (1 - likeness) * missed)
    as_plain = np.log(likeness * false + (1 - likeness) * (1 - false))
    return np.asarray(as_mark - as_plain)


def _gaps(occupied: Bools, bounded: bool) -> Bools:
    """Empty places among dots; the border of a bounded grid needs dots on its inner side only."""
    around = _count_around(occupied)
    if not bounded:
        return np.asarray(~occupied & (around >= 6))
    inside = np.zeros(occupied.shape, bool)
    inside[1:-1, 1:-1] = True
    enough = np.maximum(3, 0.6 * _count_around(inside))
    return np.asarray(~occupied & inside & (around >= enough))


def _count_around(places: Bools) -> Ints:
    """(H, W) how many of the eight neighbours are set."""
    from scipy.ndimage import convolve

    ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
    return np.asarray(convolve(places.astype(np.int64), ring, mode="constant"))
