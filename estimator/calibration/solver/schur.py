"""Symmetric positive systems of which one side is block diagonal, solved through the other side.

    [K  E ] [k]   [a]         D = W W^T, F = E W^-T, S = K - F F^T
    [E' D ] [d] = [b]

`Reduced` holds W, F and the Cholesky factor of S, from which come solutions and what is asked for
of the inverse: all of it, or one side and the diagonal blocks of the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from telerig.errors import CalibrationError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class Whiten(Protocol):
    """W^-1 or W^-T on vectors (..., E), or on the numbers of some of the blocks alone."""

    def __call__(self, right: Array, some: Ints | slice = ...) -> Array: ...


@dataclass(frozen=True)
class Blocks:
    """The block-diagonal side D = W W^T, its E numbers in any order.

    forward : W^-1.  backward : W^-T.  places : (B, n) where the numbers of each block stand.
    matrix : (B, n, n), D itself.
    """

    forward: Whiten
    backward: Whiten
    places: Ints
    matrix: Array


@dataclass(frozen=True)
class Group:
    """Some of the blocks, and the rows of E that are not zero there."""

    blocks: Ints
    rows: Ints


@dataclass(frozen=True)
class Piece:
    """F where it is not zero: rows, columns, and the matrix there."""

    rows: Ints | slice
    columns: Ints | slice
    matrix: Array


@dataclass(frozen=True)
class Reduced:
    """kept, eliminated : where the numbers of either side stand in the whole vector.

    pieces : F.  factor : lower Cholesky factor of S, in Fortran's order.
    """

    kept: Ints
    eliminated: Ints
    pieces: list[Piece]
    factor: Array
    blocks: Blocks

    @staticmethod
    def of(
        kept: Ints, eliminated: Ints, matrix: Array, coupling: Array, blocks: Blocks,
        groups: Sequence[Group] = (),
    ) -> Reduced:  # fmt: skip
        """matrix : (K, K), which is overwritten.  coupling : (K, E); groups : where it is not zero.

        Raises CalibrationError when the whole is not positive definite to working precision.
        """
        every = slice(None)
        if groups:
            pieces = [_piece(coupling, blocks, group) for group in groups]
            for piece in pieces:
                share = piece.matrix @ piece.matrix.T
                matrix[np.ix_(np.asarray(piece.rows), np.asarray(piece.rows))] -= share
            schur = matrix.T
        else:
            pieces = [Piece(every, every, blocks.forward(coupling))]
            whitened = pieces[0].matrix.T
            # a C-ordered array is its transpose in Fortran's order, here of a symmetric matrix
            schur = dsyrk(-1.0, whitened, 1.0, matrix.T, trans=1, lower=1, overwrite_c=1)
        factor, failed = dpotrf(schur, lower=1, overwrite_a=1, clean=0)
        if failed:
            raise CalibrationError(
                "the measurements leave a direction of the calibration undetermined",
                todo="add views with other tilts, or fix the model with --model",
            )
        return Reduced(kept, eliminated, pieces, factor, blocks)

    def solve(self, right: Array) -> Array:
        """right : (D,) or (D, k)."""
        # few vectors, each along memory: a product of its own for each reads the matrix fastest
        rows = right.reshape(len(right), -1).T.copy()
        inner = self.blocks.forward(np.take(rows, self.eliminated, axis=1))
        of_kept = np.take(rows, self.kept, axis=1)
        for piece in self.pieces:
            of_kept[:, piece.rows] -= _each(piece.matrix, inner[:, piece.columns])
        solved, _ = dpotrs(self.factor, of_kept.T, lower=1, overwrite_b=1)
        first = solved.T
        for piece in self.pieces:
            inner[:, piece.columns] -= _each(piece.matrix.T, first[:, piece.rows])
        rows[:, self.kept] = first
        rows[:, self.eliminated] = self.blocks.backward(inner)
        return np.ascontiguousarray(rows.T).reshape(right.shape)

    def inverse_kept(self) -> Array:
        """(K, K) block of the inverse."""
        inverse, _ = dpotri(self.factor, lower=1)
        lower = np.tril(inverse)
        return np.asarray(lower + np.tril(lower, -1).T)

    def _through(self) -> Array:
        """(K, E) chol(S)^-1 F W^-1: D^-1 plus its square is the eliminated side's inverse."""
        whitened = np.zeros((len(self.kept), len(self.eliminated)))
        for piece in self.pieces:
            part = np.zeros((len(self.kept), piece.matrix.shape[1]))
            part[piece.rows] = piece.matrix
            whitened[:, piece.columns] = part
        half = dtrsm(1.0, self.factor, whitened, lower=1)
        return self.blocks.backward(np.ascontiguousarray(half))

    def inverse_cross(self) -> Array:
        """(K, E) block of the inverse."""
        return np.asarray(-dtrsm(1.0, self.factor, self._through(), lower=1, trans_a=1))

    def inverse_blocks(self) -> Array:
        """(B, n, n) diagonal blocks of the inverse, of the eliminated side."""
        out = np.linalg.inv(self.blocks.matrix)
        places = self.blocks.places
        through = self._through()
        parts = [through[:, at] for at in places.T]
        square = np.array([[np.einsum("kb,kb->b", a, b) for b in parts] for a in parts])
        return np.asarray(out + np.moveaxis(square, -1, 0))

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


def _each(matrix: Array, vectors: Array) -> Array:
    """(k, rows) the matrix times each of (k, columns)."""
    return np.asarray((matrix @ vectors[..., None])[..., 0])


def _piece(coupling: Array, blocks: Blocks, group: Group) -> Piece:
    columns = blocks.places[group.blocks].T.ravel()
    matrix = blocks.forward(coupling[np.ix_(group.rows, columns)], group.blocks)
    return Piece(group.rows, columns, matrix)


@dataclass(frozen=True)
class Posterior:
    """The inverse of J^T J, or what was asked of it; C = intrinsics, camera poses and views.

    common : (C, C).  cross : (C, N, 3) with each dot.  dots : (N, 3, 3).
    whole : (C + 3 N, C + 3 N) or None.
    untouched : (C + 3 N,) what no measurement or prior reaches; its variance here is 1.
    """

    common: Array
    cross: Array
    dots: Array
    whole: Array | None
    untouched: NDArray[np.bool_]

    @staticmethod
    def of(whole: Array, common: int, untouched: NDArray[np.bool_]) -> Posterior:
        """From all of the inverse."""
        at = common + np.arange(len(whole) - common).reshape(-1, 3)
        cross = whole[:common, common:].reshape(common, -1, 3)
        return Posterior(
            whole[:common, :common], cross, whole[at[:, :, None], at[:, None, :]], whole, untouched
        )
