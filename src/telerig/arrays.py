"""These types name arrays by what they hold. The docstring of each function that takes or returns
an array states its shape; `as_points` and `as_pixels` check what a user gives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.errors import InputError

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Ints = NDArray[np.int64]


class Rows:
    """Structure of arrays: the base of a dataclass whose fields have one row for each item.

    A field may be such a structure itself.
    """

    def __len__(self) -> int:
        return len(getattr(self, next(iter(cast(Any, self).__dataclass_fields__))))

    def take(self, rows: Any) -> Self:
        """Return some rows, in the shape of ``rows``: (B, n) indices give arrays (B, n, ...)."""
        values = [getattr(self, name) for name in cast(Any, self).__dataclass_fields__]
        if isinstance(rows, np.ndarray):  # taking is quicker than indexing, places than a mask
            rows = np.flatnonzero(rows) if rows.dtype == bool else rows
            taken = [v.take(rows) if isinstance(v, Rows) else v.take(rows, 0) for v in values]
        else:
            taken = [v.take(rows) if isinstance(v, Rows) else v[rows] for v in values]
        return cast(Self, cast(Any, type(self))(*taken))

    @classmethod
    def concat(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of several structures one after the other."""
        names = cast(Any, cls).__dataclass_fields__
        columns = ([getattr(part, name) for part in parts] for name in names)
        joined = (
            type(c[0]).concat(c) if isinstance(c[0], Rows) else np.concatenate(c) for c in columns
        )
        return cast(Self, cast(Any, cls)(*joined))


def as_points(points_mm: ArrayLike, where: str) -> Array:
    """Return points as floats (..., 3). Raises InputError for another shape or no numbers."""
    return _numbers(points_mm, 3, where, "points x, y, z in mm")


def as_pixels(uv_px: ArrayLike, where: str) -> Array:
    """Return pixels as floats (..., 2). Raises InputError for another shape or no numbers."""
    return _numbers(uv_px, 2, where, "pixels u, v")


def _numbers(values: ArrayLike, size: int, where: str, what: str) -> Array:
    todo = f"give {what} with the shape (..., {size}), for example (N, {size})"
    try:
        found = np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"there is no array of numbers: {error}", where=where, todo=todo) from None
    if found.shape[-1:] != (size,):
        raise InputError(f"an array has the shape {found.shape}", where=where, todo=todo)
    return found
