"""The flat target of dots: its nominal geometry and the numbering of its dots.

Dot (row r, column c) is nominally at (c * pitch_x, r * pitch_y, 0); z = x cross y.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.arrays import Array, Ints

Layout = Literal["grid", "points"]
Polarity = Literal["white_on_black", "black_on_white"]
MarkStyle = Literal["large", "ring", "missing"]
Extent = Literal["bounded", "unbounded"]

_HALF = 4096
"""Rows and columns of an unbounded grid lie within +-4095 of the origin mark."""
QUARTER_TURNS: tuple[Ints, ...] = tuple(
    np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), k) for k in range(4)
)
"""Rotations of (column, row) by multiples of 90 degrees."""


@dataclass(frozen=True)
class Target:
    """Nominal geometry of the target, as `[target]` in `rig.toml` states it.

    layout : "grid" or "points".
    rows, columns : of the grid; on an unbounded grid the block in which ``scale_dots`` counts.
    pitch_mm : (pitch_x, pitch_y).
    points_mm : (N, 2) of the layout "points", else (0, 2).
    marks : (row, column) of each mark; of the layout "points", (0, dot).
    print_sigma_mm, flatness_sigma_mm : how far a dot may be from its nominal place, in the plane
        and out of it.
    scale_dots : two dot ids whose distance ``scale_distance_mm`` +- ``scale_sigma_mm`` is known;
        None when the nominal pitch itself sets the scale.
    two_sided : the plate is transparent and may be seen from behind, through
        ``plate_thickness_mm`` of material with refractive index ``plate_index``.
    """

    layout: Layout = "grid"
    rows: int = 0
    columns: int = 0
    pitch_mm: tuple[float, float] = (1.0, 1.0)
    points_mm: Array | None = None
    dot_diameter_mm: float = 1.0
    polarity: Polarity = "white_on_black"
    marks: tuple[tuple[int, int], ...] = ()
    mark_style: MarkStyle = "large"
    mark_diameter_mm: float | None = None
    extent: Extent = "bounded"
    print_sigma_mm: float = 0.02
    flatness_sigma_mm: float = 0.02
    scale_dots: tuple[int, int] | None = None
    scale_distance_mm: float | None = None
    scale_sigma_mm: float = 0.001
    two_sided: bool = False
    plate_thickness_mm: float = 0.0
    plate_index: float = 1.5

    @property
    def bounded(self) -> bool:
        """True when every dot of the target is known by its id beforehand."""
        return self.layout == "points" or self.extent == "bounded"

    def ids(self) -> Ints:
        """(N,) ids of all dots of a bounded target, missing marks left out."""
        if self.layout == "points":
            return np.arange(len(self._points()))
        every = np.arange(self.rows * self.columns)
        if self.mark_style == "missing" and self.marks:
            every = every[~np.isin(every, self.id_from_row_column(*np.transpose(self.marks)))]
        return every

    def id_from_row_column(self, row: ArrayLike, column: ArrayLike) -> Ints:
        """(...,) ids; any integer rows and columns on an unbounded grid."""
        r, c = np.asarray(row, np.int64), np.asarray(column, np.int64)
        if self.layout == "points":
            return c.copy()
        if self.bounded:
            return np.asarray(r * self.columns + c)
        return np.asarray((r + _HALF) * (2 * _HALF) + (c + _HALF))

    def row_column_from_id(self, dot: ArrayLike) -> tuple[Ints, Ints]:
        """The inverse of `id_from_row_column`; (0, dot) for the layout "points"."""
        d = np.asarray(dot, np.int64)
        if self.layout == "points":
            return np.zeros_like(d), d.copy()
        if self.bounded:
            return d // self.columns, d % self.columns
        return d // (2 * _HALF) - _HALF, d % (2 * _HALF) - _HALF

    def known_id(self, dot: ArrayLike) -> NDArray[np.bool_]:
        """(...,) whether the target can have a dot of this id."""
        d = np.asarray(dot, np.int64)
        if self.bounded:
            return np.isin(d, self.ids())
        return (d >= 0) & (d < (2 * _HALF) ** 2)

    def nominal_mm(self, dot: ArrayLike) -> Array:
        """(..., 3) nominal place of each dot id, in the target's frame."""
        row, column = self.row_column_from_id(dot)
        if self.layout == "points":
            xy = self._points()[column]
        else:
            xy = np.stack([column * self.pitch_mm[0], row * self.pitch_mm[1]], -1)
        return np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], -1).astype(float)

    def is_mark(self, dot: ArrayLike) -> NDArray[np.bool_]:
        """(...,) whether each dot id is a mark."""
        if not self.marks:
            return np.zeros(np.shape(dot), bool)
        return np.isin(np.asarray(dot), self.id_from_row_column(*np.transpose(self.marks)))

    def diameter_mm(self, dot: ArrayLike) -> Array:
        """(...,) nominal outer diameter of each dot."""
        mark = self.mark_diameter_mm if self.mark_diameter_mm else self.dot_diameter_mm
        return np.where(self.is_mark(dot), mark, self.dot_diameter_mm).astype(float)

    def symmetry_order(self) -> int:
        """How many rotations by multiples of 90 degrees leave the nominal target unchanged.

        On an unbounded grid a rotation may be combined with a shift. It is 1 for the layout
        "points".
        """
        if self.layout == "points":
            return 1
        return sum(self._unchanged_by(turn) for turn in QUARTER_TURNS)

    def mirror_images_differ(self) -> bool:
        """Whether the marks of a grid tell it from its mirror image."""
        mirrored = (turn * np.array([[-1], [1]]) for turn in QUARTER_TURNS)
        return bool(self.marks) and not any(self._unchanged_by(turn) for turn in mirrored)

    def marks_column_row(self) -> Ints:
        """(M, 2) column and row of each mark."""
        return np.array(self.marks, np.int64).reshape(-1, 2)[:, ::-1]

    def _unchanged_by(self, turn: Ints) -> bool:
        """turn : (2, 2) rotation of (column, row), with or without a reflection."""
        marks, swapped = self.marks_column_row(), turn[0, 0] == 0
        if swapped and not np.isclose(*self.pitch_mm):
            return False
        if swapped and self.bounded and self.rows != self.columns:
            return False
        if not len(marks):
            return True
        moved = marks @ turn.T
        if self.bounded:
            low = np.minimum(np.array([self.columns - 1, self.rows - 1]) @ turn.T, 0)
        else:
            low = moved.min(0) - marks.min(0)
        return {*map(tuple, (moved - low).tolist())} == {*map(tuple, marks.tolist())}

    def _points(self) -> Array:
        return np.zeros((0, 2)) if self.points_mm is None else np.asarray(self.points_mm, float)
