"""These types name arrays by what they hold. The docstring of each function that takes or returns
an array states its shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Ints = NDArray[np.int64]


class Rows:
    """Structure of arrays: the base of a dataclass whose fields have one row for each item.

    A field may be such a structure itself.
    """

    def take(self, rows: Any) -> Self:
        """Return some rows, in the shape of ``rows``: (B, n) indices give arrays (B, n, ...)."""
        values = (getattr(self, f.name) for f in fields(cast(Any, self)))
        taken = (v.take(rows) if isinstance(v, Rows) else v[rows] for v in values)
        return cast(Self, cast(Any, type(self))(*taken))

    @classmethod
    def concat(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of several structures one after the other."""
        columns = ([getattr(part, f.name) for part in parts] for f in fields(cast(Any, cls)))
        joined = (
            type(c[0]).concat(c) if isinstance(c[0], Rows) else np.concatenate(c) for c in columns
        )
        return cast(Self, cast(Any, cls)(*joined))
