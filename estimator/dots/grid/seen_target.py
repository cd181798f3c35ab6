"""What the images tell of the target: its grid, its marks, and the lines of `rig.toml` that fit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools, Ints
from telerig.errors import DetectionError
from telerig.estimator.dots.grid.lattice import (
    Cell,
    Lattice,
    grow_lattice,
    next_places,
    shape_matrix,
)
from telerig.estimator.dots.grid.numbering import gaps, relative_diameter
from telerig.estimator.dots.thresholds import MOST_DOTS, SAME_CELL
from telerig.rig.target import QUARTER_TURNS, MarkStyle, Target
from telerig.statistics import robust_sd

_RATIOS = (1.0, 1.5, 2.0)
"""Ratios of the pitches of a grid that is looked for; one that is 30 % off is found, too."""
_OBLIQUE = 0.25
"""Cosine of the angle between rows and columns above which a grid is no rectangular one."""
_POINTS = 'Describe such a plate by the places of its dots: layout = "points", points_mm = ...'
_LARGER = 1.12
_LARGER_SD = 6.0
_MOST_MARKS = 12
_MOST_GAPS = 4

Places = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class SeenTarget:
    """What one or several images show of a target with a grid of dots.

    rows, columns : size of the part of the grid that is seen.
    whole : whether the grid ends inside the image on all sides.
    marks : (row, column) of each mark, counted from one corner of the seen part. Which corner is
        not known: all four quarter turns are possible.
    mark_diameter, pitch : diameter of the marks and pitch (x, y), both in units of the diameter of
        a dot and corrected for foreshortening.
    diameter_px : diameter of a dot in px.
    """

    rows: int
    columns: int
    whole: bool
    marks: Places
    mark_style: MarkStyle | None
    mark_diameter: float
    pitch: tuple[float, float]
    diameter_px: float

    def turned(self, quarter: int) -> SeenTarget:
        """Return the same target with rows and columns counted after ``quarter`` quarter turns."""
        odd = quarter % 2 == 1
        size = (self.rows, self.columns)[:: -1 if odd else 1]
        corners = np.array([[0, 0], [self.columns - 1, self.rows - 1]]) @ QUARTER_TURNS[quarter].T
        marks = np.array(self.marks, int).reshape(-1, 2)[:, ::-1] @ QUARTER_TURNS[quarter].T
        placed = _as_places((marks - corners.min(axis=0))[:, ::-1])
        pitch = (self.pitch[1], self.pitch[0]) if odd else self.pitch
        return replace(self, rows=size[0], columns=size[1], marks=placed, pitch=pitch)

    def counted(self, like: Places = ()) -> SeenTarget:
        """Return the same target, turned by quarter turns into a standard orientation.

        like : (row, column) of marks; the orientation with most marks at these places is chosen.
        Without ``like``, the result has at least as many columns as rows, and the marks come as
        early as possible in the order of rows. If the grid is seen only in part, rows and columns
        of its marks are counted from the first mark.
        """
        every = [self.turned(quarter) for quarter in range(4)]
        if not self.whole:
            every = [replace(one, marks=_from_first(one.marks)) for one in every]
        wide = every if like else [one for one in every if one.columns >= one.rows]
        return min(wide, key=lambda one: (-len({*one.marks} & {*like}), one.marks, -one.columns))

    def lines(self) -> list[str]:
        """Return the lines of rig.toml, table [target], that contain no lengths."""
        found = [f"rows = {self.rows}", f"columns = {self.columns}"]
        if self.marks:
            marks = ", ".join(f"[{row}, {column}]" for row, column in self.marks)
            found += [f"marks = [{marks}]", f'mark_style = "{self.mark_style}"']
        return [*found, f'extent = "{"bounded" if self.whole else "unbounded"}"']


@dataclass(frozen=True)
class SeenPoints:
    """What an image shows of a target with a hexagonal grid of dots, or with staggered rows.

    kind : "a hexagonal grid" or "a grid of staggered rows".
    points : (N, 2) places of the dots, row by row, in units of the distance of neighbours.
    whole : whether the image would show all dots next to these if there were any.
    marks : positions of the marks in ``points``.
    mark_style, mark_diameter, pitch, diameter_px : see `SeenTarget`.
    """

    kind: str
    points: Array
    whole: bool
    marks: tuple[int, ...]
    mark_style: MarkStyle | None
    mark_diameter: float
    pitch: tuple[float, float]
    diameter_px: float

    def lines(self, pitch_mm: float) -> list[str]:
        """Return the lines of rig.toml, table [target], that tell where the dots are."""
        places = ", ".join(f"[{x:.4f}, {y:.4f}]" for x, y in pitch_mm * self.points)
        found = ['layout = "points"', f"points_mm = [{places}]"]
        if self.marks:
            marks = ", ".join(f"[0, {mark}]" for mark in self.marks)
            found += [f"marks = [{marks}]", f'mark_style = "{self.mark_style}"']
        return found


def _as_places(marks: Ints) -> Places:
    return tuple(sorted((int(row), int(column)) for row, column in marks))


def _from_first(marks: Places) -> Places:
    return tuple((row - marks[0][0], column - marks[0][1]) for row, column in marks)


def seen_target(dots: pd.DataFrame, image_shape: tuple[int, ...]) -> SeenTarget:
    """Describe the grid of dots that an image shows. Raises DetectionError if there is no grid.

    dots : what `locate_dots` returns. image_shape : (rows, columns) of the image.
    """
    points, lattice = _best_lattice(dots)
    _refuse_oblique(lattice)
    places = lattice.places
    occupied = np.zeros(places.max(axis=0) + 3, bool)
    occupied[tuple((places + 1).T)] = True
    radius_px = float(np.median(dots["a_px"]))
    whole = not len(next_places(lattice, points, image_shape, radius_px)[1])
    rings, large, size = _unusual(dots, lattice)
    style, which = _marks(places, rings, large, np.argwhere(gaps(occupied, whole)) - 1)
    diagonal = np.median(np.diagonal(lattice.shape, axis1=1, axis2=2), axis=0)
    diameter = 2.0 * np.sqrt(diagonal)
    plain_dots = ~(rings | large) if style != "missing" else np.ones(len(places), bool)
    columns, rows = places.max(axis=0) + 1
    return SeenTarget(
        int(rows),
        int(columns),
        whole,
        _as_places(which[:, ::-1]),
        style,
        float(np.median(size[large])) if style == "large" else float("nan"),
        (float(1.0 / diameter[0]), float(1.0 / diameter[1])),
        2.0 * float(np.median(dots["a_px"].to_numpy()[lattice.index[plain_dots]])),
    )


def seen_points(dots: pd.DataFrame, image_shape: tuple[int, ...]) -> SeenPoints | None:
    """Describe the hexagonal or staggered grid of dots that an image shows; None if it is another.

    The arguments and the error are those of `seen_target`.
    """
    points, lattice = _best_lattice(dots)
    whole = not len(next_places(lattice, points, image_shape, float(dots["a_px"].median()))[1])
    shape = np.median(lattice.shape, axis=0)
    cosine = -float(shape[0, 1] / np.sqrt(shape[0, 0] * shape[1, 1]))
    diameter = 2.0 * np.sqrt((1.0 - cosine**2) * np.diagonal(shape))
    if max(diameter) > (1 + SAME_CELL) * min(diameter):
        return None
    if abs(abs(cosine) - 0.5) < SAME_CELL:
        kind = "a hexagonal grid"
        steps = np.array([[1.0, 0.0], [np.copysign(0.5, cosine), np.sqrt(0.75)]])
    elif abs(cosine) < SAME_CELL and whole and _staggered(lattice.places):
        kind = "a grid of staggered rows"
        steps = np.sqrt(0.5) * np.array([[1.0, 1.0], [-1.0, 1.0]])
    else:
        return None
    places = lattice.places @ steps
    order = np.lexsort(np.round(places, 6).T)
    rings, large, size = _unusual(dots, lattice)
    style, which = _marks(np.arange(len(places)), rings, large, np.zeros(0, np.int64))
    marked = np.isin(order, which) if style else np.zeros(len(order), np.bool_)
    pitch = float(1.0 / np.mean(diameter))
    return SeenPoints(
        kind,
        (places - places.min(axis=0))[order],
        whole,
        tuple(np.flatnonzero(marked).tolist()),
        style,
        float(np.median(size[large])) if style == "large" else float("nan"),
        (pitch, pitch),
        2.0 * float(np.median(dots["a_px"].to_numpy()[lattice.index[order[~marked]]])),
    )


def _staggered(places: Ints) -> bool:
    """Whether places (N, 2) on a square lattice fill a rectangle along its diagonals instead."""
    diagonal = np.stack([places.sum(axis=1), places[:, 1] - places[:, 0]], -1)
    own, theirs = (np.prod(np.ptp(some, axis=0) + 1) for some in (places, diagonal))
    return bool(len(places) < MOST_DOTS * own and len(places) > MOST_DOTS * theirs / 2)


def _unusual(dots: pd.DataFrame, lattice: Lattice) -> tuple[Bools, Bools, Array]:
    """Return (n,) which dots of a lattice are rings, which are large, and their relative size."""
    rings = dots["ring"].to_numpy(bool)[lattice.index]
    size = relative_diameter(lattice)
    plain = size[~rings] if np.any(~rings) else size
    large = size > max(_LARGER, 1.0 + _LARGER_SD * float(robust_sd(plain - np.median(plain))))
    return rings, large, size


def _best_lattice(dots: pd.DataFrame) -> tuple[Array, Lattice]:
    """Return the dots' places (N, 2) in px, and the grid with the most dots among those with a
    usual ratio of the pitches."""
    points = dots[["u_px", "v_px"]].to_numpy(float)
    shapes = shape_matrix(*dots[["a_px", "b_px", "angle_rad"]].to_numpy(float).T)
    found: list[Lattice] = []
    failure: DetectionError | None = None
    for ratio in _RATIOS:
        try:
            found.append(grow_lattice(points, shapes, cell=Cell(ratio, 0.0)))
        except DetectionError as error:
            failure = failure or error
            continue
        if len(found[-1].index) > MOST_DOTS * len(points):
            break
    if not found:
        assert failure is not None
        raise failure
    best = max(found, key=lambda lattice: len(lattice.index))
    if len(best.index) < MOST_DOTS * len(points):
        raise DetectionError(
            f"only {len(best.index)} of {len(points)} dots are on one grid: are rows staggered, or "
            f"dots on two levels? {_POINTS}"
        )
    return points, best


def _refuse_oblique(lattice: Lattice) -> None:
    """Raise DetectionError if round dots show that rows and columns do not cross at 90 degrees."""
    shape = np.median(lattice.shape, axis=0)
    cosine = abs(float(shape[0, 1])) / np.sqrt(shape[0, 0] * shape[1, 1])
    if cosine > _OBLIQUE:
        raise DetectionError(
            f"the rows of dots cross at {np.rad2deg(np.arccos(cosine)):.0f} degrees, not at 90. "
            f"{_POINTS}"
        )


def _marks(places: Ints, rings: Bools, large: Bools, empty: Ints) -> tuple[MarkStyle | None, Ints]:
    """Return the style of the marks, and their places (K, 2)."""
    most = min(_MOST_MARKS, len(places) // 4)
    if 0 < np.count_nonzero(rings) <= most:
        return "ring", places[rings]
    if 0 < np.count_nonzero(large) <= most:
        return "large", places[large]
    if 0 < len(empty) <= _MOST_GAPS:
        return "missing", empty
    return None, np.zeros((0, 2), np.int64)


def agreed_target(seen: Sequence[SeenTarget]) -> SeenTarget:
    """Return the description of the target with which most images agree.

    seen : the description by each image. The grid counts as bounded if at least a third of the
    images show it as a whole, or if no image shows marks. The marks of an unbounded grid are those
    of the images that show most marks; among these the most frequent set is taken.
    """
    whole = [one for one in seen if one.whole]
    bounded = 3 * len(whole) >= len(seen) or not any(one.marks for one in seen)
    counted = [
        replace(one, whole=bounded).counted() for one in (whole if bounded else seen) or seen
    ]
    if not bounded:
        rows, columns = (max(getattr(o, n) for o in counted) for n in ("rows", "columns"))
        counted = [replace(one, rows=rows, columns=columns) for one in counted]
    keys = [(one.rows, one.columns, one.marks, one.mark_style) for one in counted]
    votes = Counter(keys)
    best = max(votes, key=lambda key: (0 if bounded else len(key[2]), votes[key], key[0] * key[1]))
    chosen = [one for one, key in zip(counted, keys) if key == best]
    middle = np.median([(*one.pitch, one.diameter_px, one.mark_diameter) for one in chosen], axis=0)
    return replace(
        chosen[0], pitch=(float(middle[0]), float(middle[1])),
        diameter_px=float(middle[2]), mark_diameter=float(middle[3]),
    )  # fmt: skip


def agreed_points(seen: Sequence[SeenPoints]) -> SeenPoints:
    """Return the description that most images share, of those that show the plate as a whole."""
    some = [one for one in seen if one.whole] or list(seen)
    votes = Counter((one.kind, len(one.points), len(one.marks)) for one in some)
    count = {id(one): votes[one.kind, len(one.points), len(one.marks)] for one in some}
    return max(some, key=lambda one: (count[id(one)], len(one.points)))


def contradiction(seen: SeenTarget, target: Target) -> str:
    """Return a sentence if an image contradicts the target that `rig.toml` states; otherwise "".

    Its marks and its size are compared. seen : what the image shows. target : what rig.toml states.
    """
    words, lines = [], []
    stated = _as_places(target.marks_column_row()[:, ::-1])
    counted = seen.counted(like=stated)
    if seen.marks and not _fits(seen, target):
        kind = {"ring": "ring marks", "large": "large dots", "missing": "empty places"}
        style = kind[seen.mark_style or "large"]
        theirs = f"{target.mark_style} marks at {_words(stated)}" if stated else "no marks"
        frame = "of the grid" if seen.whole else "counted from the first mark"
        words.append(
            f"the image shows {len(seen.marks)} {style} at (row, column) {_words(counted.marks)} "
            f"{frame}; rig.toml says {theirs}"
        )
        lines = counted.lines()
    elif (
        seen.whole
        and target.bounded
        and sorted((seen.rows, seen.columns)) != sorted((target.rows, target.columns))
    ):
        words.append(
            f"the image shows a whole grid of {counted.rows} rows and {counted.columns} columns; "
            f"rig.toml says {target.rows} and {target.columns}"
        )
        lines = counted.lines()
    if not words:
        return ""
    return f"{words[0]}. Lines of [target] that fit this image: {'; '.join(lines)}"


def _words(marks: Places) -> str:
    return ", ".join(f"({row}, {column})" for row, column in marks)


def _fits(seen: SeenTarget, target: Target) -> bool:
    """Whether some way to count the grid has all seen marks at marks of the target."""
    if seen.mark_style != target.mark_style or not target.marks:
        return False
    stated = {(int(r), int(c)) for c, r in target.marks_column_row()}
    for quarter in range(4):
        for hand in (1, -1):
            one = seen.turned(quarter)
            marks = np.array(one.marks) * (1, hand)
            if any({*map(tuple, (marks - marks[0] + mark).tolist())} <= stated for mark in stated):
                return True
    return False
