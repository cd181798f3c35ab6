"""How marks in the tank move through the images for each mm that the encoder reads.

One regression of the marks' displacement in each camera on the encoder's shows three things: the
encoder's sign, unit and scale; whether the marks move along the stated travel axis; and whether
all cameras see them move equally far, as they do unless a magnification has changed since the
calibration. The standard errors are those of the jackknife over stretches of the run (Efron, The
Jackknife, SIAM, 1982), because shake moves all marks alike and is correlated in time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.sensors.image_motion import LEAST_SEEN, directions
from telerig.estimator.sensors.response import FALSE_ALARMS
from telerig.estimator.smoothing.problem.problem import Observations, SmoothingProblem

_STRETCHES = 12
LEAST_TRAVEL_MM = 0.3
"""Marks and encoder that move less (RMS) are not compared."""


LENS_SIGMA = 1e-3
"""Standard deviation of a magnification's change since the calibration: warmth, a touched lens."""


@dataclass(frozen=True)
class Judged:
    """Numbers (k,) with their standard errors (k,), and how far chance may take them in these."""

    value: Array
    sd: Array
    reach: float

    @property
    def first(self) -> tuple[float, float]:
        """The first number and its standard error."""
        return float(self.value[0]), float(self.sd[0])

    def excludes(self, value: float) -> bool:
        """Return whether a value of the first number is excluded at the rate of false alarms."""
        return bool(abs(self.first[0] - value) > self.reach * self.sd[0])

    def beyond(self, size: float) -> bool:
        """Return whether any number is clearly not 0, and larger than a size."""
        off = np.abs(self.value)
        return bool(np.any((off > self.reach * self.sd) & (off > size)))


@dataclass(frozen=True)
class MarkMotion:
    """Sums over B stretches of the run of the regression in C cameras along two directions.

    square : (B, C) of the encoder's displacement in mm^2.
    product : (B, C, 2) of the marks' displacement, along `directions`, with it; 0 without marks.
    rows : (C, 2, 3) directions in which the cameras see motion.
    axis : (3,) stated travel axis.
    """

    square: Array
    product: Array
    rows: Array
    axis: Array

    @classmethod
    def of(cls, problem: SmoothingProblem) -> MarkMotion | None:
        """Return the regression; None without marks or encoder, or if neither moves."""
        seen, cameras = problem.read(problem.references), problem.cameras
        if not len(seen) or problem.stage is None or not np.ptp(problem.encoder_mm) > 0:
            return None
        rows = np.stack([directions(camera) for camera in cameras])
        part = _stretch_of(seen)
        square = np.zeros((_STRETCHES, len(cameras)))
        product = np.zeros((_STRETCHES, len(cameras), 2))
        rest = 0.0
        for c, camera in enumerate(cameras):
            mine = seen.camera == c
            if not mine.any():
                continue
            place = camera.unproject(seen.uv_px[mine])[0] @ rows[c].T
            each = np.column_stack([problem.encoder_mm[seen.frame[mine]], place])
            index = np.unique(seen.item[mine], return_inverse=True)[1]
            size = np.bincount(index)
            each -= np.stack([np.bincount(index, v) / size for v in each.T], -1)[index]
            np.add.at(square[:, c], part[mine], each[:, 0] ** 2)
            np.add.at(product[:, c], part[mine], each[:, :1] * each[:, 1:])
            rest += float((each[:, 1:] ** 2).sum())
        if max(float(square.sum()), rest) < LEAST_TRAVEL_MM**2 * len(seen) or not square.any():
            return None
        used = square.sum(1) > 0
        return cls(square[used], product[used], rows, problem.axis)

    def _judged(self, of: Callable[[Array, Array], Array]) -> Judged:
        """Return numbers (k,) of the sums of all stretches, which ``of`` makes of (C,), (C, 2)."""
        from scipy.stats import t

        square, product, count = self.square.sum(0), self.product.sum(0), len(self.square)
        value = np.asarray(of(square, product))
        if count < 3:
            return Judged(value, np.full(len(value), np.inf), np.inf)
        without = np.array(
            [of(square - s, product - p) for s, p in zip(self.square, self.product, strict=True)]
        )
        spread = np.sqrt((count - 1) * np.mean((without - without.mean(0)) ** 2, axis=0))
        return Judged(value, spread, float(t.isf(FALSE_ALARMS / 2, count - 1)))

    @property
    def along(self) -> Array:
        """The travel axis (C, 2) in each camera; 0 in cameras that hardly see it or no marks."""
        along = self.rows @ self.axis
        used = ((along**2).sum(-1) > LEAST_SEEN) & (self.square.sum(0) > 0)
        return np.asarray(along * used[:, None])

    def gain(self) -> Judged:
        """Return the true travel for each mm that the encoder reads, all cameras together."""
        along = self.along

        def of(square: Array, product: Array) -> Array:
            whole = float(square @ (along**2).sum(-1))
            return np.array([-float((along * product).sum()) / whole]) if whole else np.zeros(1)

        return self._judged(of)

    def ratio(self, first: int, second: int) -> Judged | None:
        """Return how far marks move in the second of two cameras over that in the first one."""
        along = self.along[[first, second]]
        if not (along**2).sum(-1).all():
            return None

        def of(square: Array, product: Array) -> Array:
            moved = (along * product[[first, second]]).sum(-1) / square[[first, second]]
            a, b = moved / (along**2).sum(-1)
            return np.array([b / a])

        return self._judged(of)

    def tilt(self, basis: Array) -> Judged | None:
        """Return the travel axis' tilts (2,) in rad along a basis (3, 2) across the stated one.

        None unless the cameras together see all directions.
        """
        if np.linalg.matrix_rank(self.rows[self.square.sum(0) > 0].reshape(-1, 3), 1e-3) < 3:
            return None

        def of(square: Array, product: Array) -> Array:
            weight = np.repeat(square, 2)
            rows = self.rows.reshape(-1, 3)
            normal = (rows * weight[:, None]).T @ rows
            axis = np.linalg.solve(normal, -rows.T @ product.ravel())
            return np.asarray(basis.T @ axis / (axis @ self.axis))

        return self._judged(of)


def _stretch_of(seen: Observations) -> Ints:
    """Return for each pixel (R,) the stretch of the run to which its mark belongs.

    A mark is never cut, for the shake's trends in its parts would count alike in all stretches.
    """
    size = np.bincount(seen.item)
    middle = np.bincount(seen.item, seen.frame) / np.maximum(size, 1)
    low, high = middle[size > 0].min(), middle[size > 0].max()
    part = (middle - low) / max(high - low, 1.0) * (_STRETCHES - 1e-9)
    return np.asarray(part.astype(np.int64)[seen.item])
