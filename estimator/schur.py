"""Symmetric positive systems of which one side is block diagonal, solved through the other side.

    [K  E ] [k]   [a]         D = W W^T, F = E W^-T, S = K - F F^T
    [E' D ] [d] = [b]

`Reduced` holds W, F and the Cholesky factor of S, from which come solutions and what is asked for
of the inverse: all of it, or one side and the diagonal blocks of the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from telerig.errors import CalibrationError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Blocks:
    """The block-diagonal side D = W W^T, its E numbers in any order.

    forward, backward : W^-1 and W^-T on vectors (..., E).  places : (B, n) where the numbers of
    each block stand.  matrix : (B, n, n), D itself.
    """

    forward: Callable[[Array], Array]
    backward: Callable[[Array], Array]
    places: Ints
    matrix: Array


@dataclass(frozen=True)
class Reduced:
    """kept, eliminated : where the numbers of either side stand in the whole vector.

    whitened : (K, E) F.  factor : lower Cholesky factor of S, in Fortran's order.
    """

    kept: Ints
    eliminated: Ints
    whitened: Array
    factor: Array
    blocks: Blocks

    @staticmethod
    def of(kept: Ints, eliminated: Ints, matrix: Array, coupling: Array, blocks: Blocks) -> Reduced:
        """matrix : (K, K), which is overwritten.  coupling : (K, E).

        Raises CalibrationError when the whole is not positive definite to working precision.
        """
        whitened = blocks.forward(coupling)
        # a C-ordered array is its transpose in Fortran's order, here that of a symmetric matrix
        schur = dsyrk(-1.0, whitened.T, 1.0, matrix.T, trans=1, lower=1, overwrite_c=1)
        factor, failed = dpotrf(schur, lower=1, overwrite_a=1, clean=0)
        if failed:
            raise CalibrationError(
                "the measurements leave a direction of the calibration undetermined",
                todo="add views with other tilts, or fix the model with --model",
            )
        return Reduced(kept, eliminated, whitened, factor, blocks)

    def solve(self, right: Array) -> Array:
        """right : (D,) or (D, k)."""
        columns = right.reshape(len(right), -1)
        inner = self.blocks.forward(columns[self.eliminated].T)
        first, _ = dpotrs(self.factor, columns[self.kept] - self.whitened @ inner.T, lower=1)
        out = np.empty_like(columns)
        out[self.kept] = first
        out[self.eliminated] = self.blocks.backward(inner - first.T @ self.whitened).T
        return out.reshape(right.shape)

    def inverse_kept(self) -> Array:
        """(K, K) block of the inverse."""
        inverse, _ = dpotri(self.factor, lower=1)
        lower = np.tril(inverse)
        return np.asarray(lower + np.tril(lower, -1).T)

    def _through(self) -> Array:
        """(K, E) chol(S)^-1 F W^-1: D^-1 plus its square is the eliminated side's inverse."""
        half = dtrsm(1.0, self.factor, self.whitened, lower=1)
        return self.blocks.backward(np.ascontiguousarray(half))

    def inverse_blocks(self) -> Array:
        """(B, n, n) diagonal blocks of the inverse, of the eliminated side."""
        through = self._through()
        parts = [through[:, places] for places in self.blocks.places.T]
        square = np.array([[np.einsum("kb,kb->b", a, b) for b in parts] for a in parts])
        return np.asarray(np.linalg.inv(self.blocks.matrix) + np.moveaxis(square, -1, 0))

    def inverse(self) -> Array:
        """(D, D) all of the inverse."""
        through = self._through()
        across = -dtrsm(1.0, self.factor, through, lower=1, trans_a=1)
        own = through.T @ through
        places = self.blocks.places
        own[places[:, :, None], places[:, None, :]] += np.linalg.inv(self.blocks.matrix)
        out = np.empty((len(self.kept) + len(self.eliminated),) * 2)
        out[np.ix_(self.kept, self.kept)] = self.inverse_kept()
        out[np.ix_(self.kept, self.eliminated)] = across
        out[np.ix_(self.eliminated, self.kept)] = across.T
        out[np.ix_(self.eliminated, self.eliminated)] = own
        return out


@dataclass(frozen=True)
class Posterior:
    """The inverse of J^T J, or what was asked of it; C = intrinsics, camera poses and views.

    common : (C, C).  dots : (N, 3, 3).  whole : (C + 3 N, C + 3 N) or None.
    distance_variance : of the known distance, whitened; 0 where there is none.
    untouched : (C + 3 N,) what no measurement or prior reaches; its variance here is 1.
    """

    common: Array
    dots: Array
    whole: Array | None
    distance_variance: float
    untouched: NDArray[np.bool_]

    @staticmethod
    def of(
        whole: Array, common: int, distance: Array | None, untouched: NDArray[np.bool_]
    ) -> Posterior:
        """From all of the inverse; distance : (C + 3 N,) its row."""
        at = common + np.arange(len(whole) - common).reshape(-1, 3)
        dots = whole[at[:, :, None], at[:, None, :]]
        variance = 0.0 if distance is None else float(distance @ whole @ distance)
        return Posterior(whole[:common, :common], dots, whole, variance, untouched)
