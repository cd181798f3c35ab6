"""Arrays of linear factors of one shape, and of covariances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Linear:
    """M factors of one shape.

    keys : one (M,) each.  blocks : (M, rows, columns) each.  rhs : (M, rows).
    log_det : (M,) of the whiteners.  weight : (M,) 0..1 of a robust fit, already in the rest.
    """

    keys: tuple[ArrayLike, ...]
    blocks: tuple[Array, ...]
    rhs: Array
    log_det: Array
    weight: Array | None = None

    def squared(self, increments: Callable[[ArrayLike, int], Array]) -> float:
        """Sum of squares at increments, which are given for keys (M,) of some size."""
        error = -self.rhs
        for key, block in zip(self.keys, self.blocks):
            if block.shape[-1]:
                step = increments(key, block.shape[-1])
                error = error + np.einsum("...ij,...j->...i", block, step)
        return float((error**2).sum())

    def log_norm(self) -> float:
        """log of the factors' normalisation, residuals apart."""
        share = np.ones(len(self.rhs)) if self.weight is None else self.weight
        each = self.log_det - self.rhs.shape[1] * 0.5 * np.log(2 * np.pi)
        return float((share * each).sum())


@dataclass(frozen=True)
class Blocks:
    """Covariances of increments, in their bases.

    own : of each family of keys, (n, d, d); the shake's at the frames.
    cross : (rows, Ds, Db) of the shake with each bubble at the same frame.
    """

    own: list[Array]
    cross: Array
