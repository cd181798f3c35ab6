"""Every way to lay a target's grid onto a lattice, scored by what the image shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.errors import DetectionError, InputError
from telerig.estimator.dots.grid.lattice import Lattice
from telerig.estimator.dots.grid.marks import MarkEvidence
from telerig.rig.target import Target

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LOG_DOT_OUTSIDE = -6.0
"""A dot on the lattice where the target has none."""
MARGIN = 4.0
"""Candidates within this log-likelihood of the best are equally good."""
MAX_TIED = 64

_MIN_ASPECT_SIGMA = 0.03
_TURN = np.array([[0, -1], [1, 0]])
_TURNS = [np.linalg.matrix_power(_TURN, k) for k in range(4)]


@dataclass(frozen=True)
class Candidates:
    """K ways to number a lattice, best first: (column, row) = turn @ place - shift.

    turn : (K, 2, 2), det -1 where the image is mirrored; shift : (K, 2); score : (K,) nats.
    """

    turn: Ints
    shift: Ints
    score: Array

    def columns_rows(self, places: Ints) -> Ints:
        """(K, n, 2) column and row of (n, 2) places under each candidate."""
        turned = np.einsum("kab,nb->kna", self.turn, places)
        return np.asarray(turned - self.shift[:, None])

    def places(self, columns_rows: Ints) -> Ints:
        """(K, m, 2) places of (m, 2) columns and rows: the inverse."""
        shifted = columns_rows + self.shift[:, None]
        return np.asarray(np.einsum("kba,knb->kna", self.turn, shifted))

    def take(self, which: Ints) -> Candidates:
        return Candidates(self.turn[which], self.shift[which], self.score[which])


def mark_points(target: Target) -> Ints:
    """(M, 2) column and row of each mark."""
    return np.array(target.marks, np.int64).reshape(-1, 2)[:, ::-1]


def rank_candidates(
    lattice: Lattice, evidence: MarkEvidence, target: Target, handedness: tuple[int, ...]
) -> Candidates:
    """All candidates within `MARGIN` of the best, best first (unmirrored before mirrored).

    Raises DetectionError when nothing fits or too many fit, InputError when an unbounded grid has
    no marks.
    """
    turns = [t * [[h], [1]] if h < 0 else t for h in sorted(handedness)[::-1] for t in _TURNS]
    aspect = _aspect_score(lattice, target)
    parts = []
    for turn in turns:
        shifts, score = _shifts(lattice, evidence, target, turn)
        score = score + aspect[int(turn[0, 0] == 0)]
        parts.append((np.broadcast_to(turn, (len(shifts), 2, 2)), shifts, score))
    every = Candidates(*(np.concatenate(p) for p in zip(*parts)))
    _check_marks_seen(len(every.score), evidence, target)
    order = np.argsort(-np.round(every.score, 6), kind="stable")
    return every.take(order[every.score[order] >= every.score[order[0]] - MARGIN])


def _check_marks_seen(count: int, evidence: MarkEvidence, target: Target) -> None:
    if count:
        return
    raise DetectionError(
        f"none of the target's {len(target.marks)} marks was found",
        todo="an unbounded grid is numbered from its marks: keep them in view, and check "
        "[target] marks, mark_style and mark_diameter_mm",
    )


def _aspect_score(lattice: Lattice, target: Target) -> tuple[float, float]:
    """Log-likelihood that the first lattice axis runs along x, and along y, by the dots' shapes."""
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
        shifts = np.unique((seen[:, None] - mark_points(target)).reshape(-1, 2), axis=0)
        score = np.zeros(len(shifts))
    else:
        raise InputError(
            "an unbounded grid without marks has no origin",
            where="[target]",
            todo="state marks, or extent = 'bounded'",
        )
    if target.marks:
        score = score + evidence.at((mark_points(target) + shifts[:, None]) @ turn).sum(1)
    return shifts, score


def _bounded_shifts(turned: Ints, target: Target) -> tuple[Ints, Array]:
    """Shifts that keep most dots within rows x columns, and the cost of those left outside."""
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


def mirror_images_differ(target: Target) -> bool:
    """Whether the target's marks tell it from its mirror image."""
    return bool(target.marks) and not any(
        _unchanged_by(target, turn * [[-1], [1]]) for turn in _TURNS
    )


def _unchanged_by(target: Target, turn: Ints) -> bool:
    marks = mark_points(target)
    if turn[0, 0] == 0 and not np.isclose(*target.pitch_mm):
        return False
    if target.bounded:
        if turn[0, 0] == 0 and target.rows != target.columns:
            return False
        centre2 = np.array([target.columns - 1, target.rows - 1])
        moved2 = (2 * marks - centre2) @ turn.T + centre2
    else:
        moved2 = 2 * (marks @ turn.T)
        moved2 = moved2 + 2 * (marks.min(0) - (marks @ turn.T).min(0))
    return _as_set(moved2) == _as_set(2 * marks)


def related_by_symmetry(candidates: Candidates, target: Target) -> bool:
    """Whether the candidates differ only by rotations that leave the target unchanged."""
    marks = mark_points(target)
    corners = np.array([[0, 0], [target.columns - 1, target.rows - 1]])
    fixed = _as_set(marks)
    seen = candidates.take(np.array([0])).places(np.concatenate([marks, corners]))[0]
    moved = candidates.columns_rows(seen)
    if np.any(np.linalg.det(candidates.turn) != np.linalg.det(candidates.turn[0])):
        return False
    for one in moved:
        ends = np.sort(one[len(marks) :], axis=0)
        if target.bounded and not np.array_equal(ends, corners):
            return False
        if _as_set(one[: len(marks)]) != fixed:
            return False
    return True


def _as_set(points: Ints) -> set[tuple[int, ...]]:
    return {tuple(p) for p in points.tolist()}
