"""The placements of a target's grid on a lattice, ranked by their log-likelihood in the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.errors import DetectionError, InputError
from telerig.estimator.dots.grid.lattice import Lattice
from telerig.estimator.dots.grid.marks import MarkEvidence
from telerig.rig.target import QUARTER_TURNS, Target

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LOG_DOT_OUTSIDE = -6.0
"""Log-likelihood of a dot on the lattice where the target has none."""
MARGIN = 4.0
"""Placements within this log-likelihood of the best are taken as equally good."""
MAX_TIED = 64

_MIN_ASPECT_SIGMA = 0.03


@dataclass(frozen=True)
class Placements:
    """K placements of the grid on a lattice, best first: (column, row) = turn @ place - shift.

    turn : (K, 2, 2), det -1 where the image is mirrored; shift : (K, 2); score : (K,)
    log-likelihoods.
    """

    turn: Ints
    shift: Ints
    score: Array

    def columns_rows(self, places: Ints) -> Ints:
        """(K, n, 2) column and row on the target, for each of the K placements.

        places : (n, 2) indices of dots in the lattice of the image.
        """
        turned = np.einsum("kab,nb->kna", self.turn, places)
        return np.asarray(turned - self.shift[:, None])

    def places(self, columns_rows: Ints) -> Ints:
        """(K, m, 2) places of (m, 2) columns and rows: the inverse of `columns_rows`."""
        shifted = columns_rows + self.shift[:, None]
        return np.asarray(np.einsum("kba,knb->kna", self.turn, shifted))

    def take(self, which: Ints) -> Placements:
        return Placements(self.turn[which], self.shift[which], self.score[which])


def rank_placements(lattice: Lattice, evidence: MarkEvidence, target: Target) -> Placements:
    """All placements within `MARGIN` of the best, best first (unmirrored before mirrored).

    Mirrored images are considered where the target's marks tell them apart.

    Raises DetectionError when the image shows none of the marks that an unbounded grid needs,
    InputError when an unbounded grid has no marks.
    """
    hands = (1, -1) if target.mirror_images_differ() else (1,)
    turns = [turn * np.array([[hand], [1]]) for hand in hands for turn in QUARTER_TURNS]
    aspect = _aspect_score(lattice, target)
    parts = []
    for turn in turns:
        shifts, score = _shifts(lattice, evidence, target, turn)
        score = score + aspect[int(turn[0, 0] == 0)]
        parts.append((np.broadcast_to(turn, (len(shifts), 2, 2)), shifts, score))
    every = Placements(*(np.concatenate(p) for p in zip(*parts)))
    if not len(every.score):
        raise DetectionError(
            f"none of the target's {len(target.marks)} marks was found",
            todo="an unbounded grid is numbered from its marks: keep them in view, and check "
            "[target] marks, mark_style and mark_diameter_mm in rig.toml",
        )
    order = np.argsort(-np.round(every.score, 6), kind="stable")
    return every.take(order[every.score[order] >= every.score[order[0]] - MARGIN])


def _aspect_score(lattice: Lattice, target: Target) -> tuple[float, float]:
    """Log-likelihoods, from the dots' shapes, that the lattice's first axis is x and is y."""
    logs = 0.5 * np.log(lattice.shape[:, 1, 1] / lattice.shape[:, 0, 0])
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))
    sigma = max(_MIN_ASPECT_SIGMA, 1.25 * spread / np.sqrt(len(logs)))
    nominal = float(np.log(target.pitch_mm[0] / target.pitch_mm[1]))
    along = [max(-0.5 * ((middle - s * nominal) / sigma) ** 2, -100.0) for s in (1, -1)]
    return along[0], along[1]


def _shifts(
    lattice: Lattice, evidence: MarkEvidence, target: Target, turn: Ints
) -> tuple[Ints, Array]:
    if target.bounded:
        shifts, score = _bounded_shifts(lattice.places @ turn.T, target)
    elif target.marks:
        seen = evidence.seen @ turn.T
        shifts = np.unique((seen[:, None] - target.marks_column_row()).reshape(-1, 2), axis=0)
        score = np.zeros(len(shifts))
    else:
        raise InputError(
            "an unbounded grid without marks has no origin",
            where="[target]",
            todo="state marks, or extent = 'bounded'",
        )
    if target.marks:
        score = score + evidence.at((target.marks_column_row() + shifts[:, None]) @ turn).sum(1)
    return shifts, score


def _bounded_shifts(turned: Ints, target: Target) -> tuple[Ints, Array]:
    """(S, 2) shifts that keep most dots within rows x columns, and their log-likelihoods (S,)."""
    size = np.array([target.columns, target.rows])
    low = turned.min(0) - size + 1
    span = turned.max(0) - low + size
    count = np.zeros(span + 1, np.int64)
    count[tuple((turned - low + 1).T)] = 1
    total = count.cumsum(0).cumsum(1)
    c, r = size
    inside = total[c:, r:] - total[:-c, r:] - total[c:, :-r] + total[:-c, :-r]
    outside = len(turned) - inside
    near = np.argwhere(outside <= outside.min() + 8)
    return near + low, LOG_DOT_OUTSIDE * outside[tuple(near.T)]


def related_by_symmetry(placements: Placements, target: Target) -> bool:
    """Whether the placements differ only by rotations that leave the target unchanged."""
    hands = np.linalg.det(placements.turn)
    if np.any(hands != hands[0]):
        return False
    marks = target.marks_column_row()
    corners = np.array([[0, 0], [target.columns - 1, target.rows - 1]])
    seen = placements.places(np.concatenate([marks, corners]))[0]
    moved = placements.columns_rows(seen)
    if target.bounded and np.any(np.sort(moved[:, len(marks) :], axis=1) != corners):
        return False
    wanted = {*map(tuple, marks.tolist())}
    return all({*map(tuple, one[: len(marks)].tolist())} == wanted for one in moved)
