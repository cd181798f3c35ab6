"""The flat target: the nominal positions of its dots, and the numbers (ids) of dots.

The dot in row r and column c is nominally at (c * pitch_x, r * pitch_y, 0); z = x cross y.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.arrays import Array, Ints
from telerig.errors import DetectionError

Layout = Literal["grid", "points"]
Polarity = Literal["white_on_black", "black_on_white"]
MarkStyle = Literal["large", "ring", "missing"]
Extent = Literal["bounded", "unbounded"]

_HALF = 4096
"""The rows and columns of an unbounded grid lie within +-4095 of the origin mark."""
QUARTER_TURNS: tuple[Ints, ...] = tuple(
    np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), k) for k in range(4)
)
"""The rotations of (column, row) by 0, 90, 180 and 270 degrees."""


@dataclass(frozen=True)
class Target:
    """The nominal geometry of the target, as `[target]` in `rig.toml` states it.

    layout : "grid", or "points" for dots at listed positions points_mm (N, 2).
    rows, columns : size of the grid, or of the block in which ``scale_dots`` are counted.
    pitch_mm : (pitch_x, pitch_y), the distances between neighbouring columns and rows.
    marks : (row, column) of each mark; (0, dot) for the layout "points".
    print_sigma_mm, flatness_sigma_mm : standard deviations of a dot's true position from the
        nominal one, in the plane and perpendicular to it.
    scale_dots : ids of two dots whose distance ``scale_distance_mm`` +- ``scale_sigma_mm`` is
        known; None if the nominal pitch sets the scale.
    two_sided : whether the plate may be seen from behind, through ``plate_thickness_mm`` of a
        material with refractive index ``plate_index``.
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
        """Whether the ids of all dots are known in advance."""
        return self.layout == "points" or self.extent == "bounded"

    def ids(self) -> Ints:
        """Return the ids (N,) of all dots of a bounded target, without marks that lack a dot."""
        if self.layout == "points":
            return np.arange(len(self._points()))
        every = np.arange(self.rows * self.columns)
        if self.mark_style == "missing" and self.marks:
            every = every[~np.isin(every, self.id_from_row_column(*np.transpose(self.marks)))]
        return every

    def id_from_row_column(self, row: ArrayLike, column: ArrayLike) -> Ints:
        """Return the ids (...) of the dots in rows and columns (...), which may be negative."""
        r, c = np.asarray(row, np.int64), np.asarray(column, np.int64)
        if self.layout == "points":
            return c.copy()
        if self.bounded:
            return np.asarray(r * self.columns + c)
        return np.asarray((r + _HALF) * (2 * _HALF) + (c + _HALF))

    def row_column_from_id(self, dot: ArrayLike) -> tuple[Ints, Ints]:
        """Return rows (...) and columns (...) of dot ids; (0, dot) for the layout "points"."""
        d = np.asarray(dot, np.int64)
        if self.layout == "points":
            return np.zeros_like(d), d.copy()
        if self.bounded:
            return d // self.columns, d % self.columns
        return d // (2 * _HALF) - _HALF, d % (2 * _HALF) - _HALF

    def known_id(self, dot: ArrayLike) -> NDArray[np.bool_]:
        """Return (...) whether the target can have a dot with each id."""
        d = np.asarray(dot, np.int64)
        if self.bounded:
            return np.isin(d, self.ids())
        return (d >= 0) & (d < (2 * _HALF) ** 2)

    def nominal_mm(self, dot: ArrayLike) -> Array:
        """Return the nominal positions (..., 3) of the dots with these ids, in the target frame."""
        row, column = self.row_column_from_id(dot)
        if self.layout == "points":
            xy = self._points()[column]
        else:
            xy = np.stack([column * self.pitch_mm[0], row * self.pitch_mm[1]], -1)
        return np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], -1).astype(float)

    def is_mark(self, dot: ArrayLike) -> NDArray[np.bool_]:
        """Return (...) whether each dot id belongs to a mark."""
        if not self.marks:
            return np.zeros(np.shape(dot), bool)
        return np.isin(np.asarray(dot), self.id_from_row_column(*np.transpose(self.marks)))

    def diameter_mm(self, dot: ArrayLike) -> Array:
        """Return the nominal outer diameter (...) of each dot."""
        mark = self.mark_diameter_mm if self.mark_diameter_mm else self.dot_diameter_mm
        return np.where(self.is_mark(dot), mark, self.dot_diameter_mm).astype(float)

    def symmetry_order(self) -> int:
        """Return how many rotations about z leave the target unchanged; that by 0 degrees counts.

        Of a grid, rotations by multiples of 90 degrees are tried (on an unbounded grid a rotation
        may be combined with a shift). Of listed points, a full turn in 6, 4, 3 and 2 equal parts is
        tried in this order.
        """
        if self.layout == "points":
            return len(self.turns())
        return sum(self._unchanged_by(turn) for turn in QUARTER_TURNS)

    def turns(self) -> list[Ints]:
        """Return how the rotations about z that leave a bounded target unchanged exchange its dots.

        For each rotation, in the order of their angles and beginning with 0 degrees, an array (N,)
        gives for each of the N dots the id of the dot that takes its place.
        """
        if self.layout == "points":
            for order in (6, 4, 3, 2):
                angles = 2 * np.pi * np.arange(order) / order
                moved = [self._moved(np.exp(1j * angle)) for angle in angles]
                if all(len(ids) for ids in moved):
                    return moved
            return [self.ids()]
        order = self.symmetry_order()
        grid = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        return [np.rot90(grid, k * (4 // order)).ravel() for k in range(order)]

    def mirror_images_differ(self) -> bool:
        """Return whether marks or listed points tell the target from its mirror image."""
        if self.layout == "points":
            place = self._complex_points()
            far = int(np.argmax(np.abs(place))) if len(place) else 0
            alike = place[np.isclose(np.abs(place), np.abs(place[far]), rtol=0.02)]
            axes = place[far] * alike / np.abs(place[far] * alike)
            return not any(len(self._moved(axis, mirrored=True)) for axis in axes)
        mirrored = (turn * np.array([[-1], [1]]) for turn in QUARTER_TURNS)
        return bool(self.marks) and not any(self._unchanged_by(turn) for turn in mirrored)

    def marks_column_row(self) -> Ints:
        """Return the column and row (K, 2) of each of the K marks."""
        return np.array(self.marks, np.int64).reshape(-1, 2)[:, ::-1]

    def _unchanged_by(self, turn: Ints) -> bool:
        """Return whether a rotation or reflection (2, 2) of (column, row) keeps the marks."""
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

    def _complex_points(self) -> NDArray[np.complex128]:
        """Return the listed points (N,) about their mean, x + iy."""
        points = self._points()
        return np.asarray((points - points.mean(0)) @ [1, 1j])

    def _moved(self, turn: complex, *, mirrored: bool = False) -> Ints:
        """Return the ids (N,) of the listed points at the rotated (and before it mirrored) places
        of all points; none if a point has no other one there, or a mark no mark.
        """
        from scipy.spatial import cKDTree

        place = self._complex_points()
        moved = turn * (np.conj(place) if mirrored else place)
        miss, at = cKDTree(np.stack([place.real, place.imag], -1)).query(
            np.stack([moved.real, moved.imag], -1)
        )
        marked = self.is_mark(self.ids())
        kept = np.all(miss < self.dot_diameter_mm / 4) and np.array_equal(marked[at], marked)
        return np.asarray(at, np.int64) if kept else np.zeros(0, np.int64)

    def _points(self) -> Array:
        return np.zeros((0, 2)) if self.points_mm is None else np.asarray(self.points_mm, float)


def check_handedness(handedness_by_image: Mapping[tuple[str, str], int], two_sided: bool) -> None:
    """Raise DetectionError if only some of the images show the target mirrored.

    handedness_by_image : for each (view, camera) +1, -1 for a mirrored image, 0 for unknown.
    two_sided : whether the plate may be seen from both sides; nothing is raised then.
    """
    signs = {image: hand for image, hand in handedness_by_image.items() if hand}
    if two_sided or len(set(signs.values())) < 2:
        return
    first = next(iter(signs.values()))
    usual = first if sum(hand == first for hand in signs.values()) * 2 >= len(signs) else -first
    odd = [image for image, hand in signs.items() if hand != usual]
    todo = (
        "if a camera or an export flips the image, undo this; if the plate is transparent and "
        "seen from behind, set two_sided = true, plate_thickness_mm and plate_index in rig.toml "
        "[target]"
    )
    whole = _mirrored_camera(signs, odd)
    if whole:
        raise DetectionError(
            f"every image of camera '{whole[0]}' is mirrored against camera '{whole[1]}'",
            todo=todo,
        )
    names = ", ".join(f"camera '{camera}' view '{view}'" for view, camera in odd)
    plural = "s" if len(odd) > 1 else ""
    raise DetectionError(f"mirrored image{plural} ({len(odd)} of {len(signs)}): {names}", todo=todo)


def _mirrored_camera(
    signs: Mapping[tuple[str, str], int], odd: list[tuple[str, str]]
) -> tuple[str, str] | None:
    """Return (mirrored, other) if the odd images are all images of one camera, and only those."""
    odd_cameras = {camera for _, camera in odd}
    others = [camera for _, camera in signs if camera not in odd_cameras]
    every = sum(camera in odd_cameras for _, camera in signs) == len(odd)
    if len(odd_cameras) == 1 and others and every and len(odd) > 1:
        return odd_cameras.pop(), others[0]
    return None
