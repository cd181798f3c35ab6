"""Normal equations of a calibration in blocks, and their damped solution.

Cameras couple with everything, but no view couples with a view and no dot with a dot. A step
eliminates dots and solves the Schur complement on cameras and views, or the other way round,
whichever is smaller (Triggs et al., Bundle Adjustment, 1999, section 6).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotrs

from telerig.errors import CalibrationError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NormalEquations:
    """J^T J and -J^T r in blocks, for S numbers of cameras, V views and N dots.

    Rows and columns in the graph's order: intrinsics, camera poses (S together), views, dots.

    shared : (S, S).  by_view : (S, 6 V).  views : (V, 6, 6).  dots : (3, 3, N).
    cross : (S + 6 V, 3, N) of cameras and views with dots, component by component.
    right : (S + 6 V + 3 N,).
    distance : (3 N,) row of the known distance, which couples two dots, or None; its share is in
    ``right`` but not in ``dots``.
    """

    cost: float
    shared: Array
    by_view: Array
    views: Array
    dots: Array
    cross: Array
    right: Array
    distance: Array | None

    @property
    def common(self) -> int:
        """S + 6 V."""
        return len(self.cross)

    def information(self) -> Array:
        """(S + 6 V + 3 N, ...) dense J^T J."""
        size, count = self.common, self.dots.shape[-1]
        out = np.zeros((len(self.right), len(self.right)))
        out[:size, :size] = self._common(self.shared, self.views)
        out[:size, size:] = self.cross.transpose(0, 2, 1).reshape(size, -1)
        out[size:, :size] = out[:size, size:].T
        at = size + 3 * np.arange(count)[:, None] + np.arange(3)
        out[at[:, :, None], at[:, None, :]] = np.moveaxis(self.dots, -1, 0)
        if self.distance is not None:
            out[size:, size:] += np.outer(self.distance, self.distance)
        return out

    def _common(self, shared: Array, views: Array) -> Array:
        s = len(shared)
        out = np.zeros((self.common, self.common))
        out[:s, :s], out[:s, s:], out[s:, :s] = shared, self.by_view, self.by_view.T
        at = s + 6 * np.arange(len(views))[:, None] + np.arange(6)
        out[at[:, :, None], at[:, None, :]] = views
        return out

    def step(self, damping: float) -> tuple[Array, float]:
        """(S + 6 V + 3 N,) damped step, and the decrease of the cost that it promises."""
        solve = self._solver(damping)
        if self.distance is None:
            step = solve(self.right)
        else:
            row = np.r_[np.zeros(self.common), self.distance]
            step, along = solve(np.stack([self.right, row], -1)).T
            step = step - along * (row @ step) / (1 + row @ along)
        return step, float(0.5 * step @ self.right)

    def _solver(self, damping: float) -> Callable[[Array], Array]:
        """Solves with the damped matrix, the distance left out."""
        size = self.common
        dots = self.dots.copy()
        dots[range(3), range(3)] *= 1 + damping
        whiten = _cholesky3(dots)
        whitened = _forward(whiten, self.cross)
        flat = whitened.reshape(size, -1)
        reduced = self._common(_damped(self.shared, damping), _damped(self.views, damping))
        reduced -= flat @ flat.T
        factor, failed = dpotrf(reduced.T, lower=1, overwrite_a=1, clean=0)
        if failed:
            raise CalibrationError(
                "the normal equations are not positive definite",
                todo="add views with other tilts, or fix the model with --model",
            )

        def solve(right: Array) -> Array:
            columns = right.reshape(len(right), -1)
            of_dots = columns[size:].reshape(-1, 3, columns.shape[1]).transpose(2, 1, 0)
            inner = _forward(whiten, of_dots).reshape(columns.shape[1], -1)
            first, _ = dpotrs(factor, columns[:size] - flat @ inner.T, lower=1)
            rest = (inner - first.T @ flat).reshape(of_dots.shape)
            second = _backward(whiten, rest).transpose(2, 1, 0).reshape(-1, columns.shape[1])
            return np.asarray(np.concatenate([first, second]).reshape(right.shape))

        return solve


def _damped(matrix: Array, damping: float) -> Array:
    """Marquardt's damping; what nothing touches (a view left out) stays where it is."""
    out = matrix.copy()
    i = np.arange(matrix.shape[-1])
    diagonal = matrix[..., i, i]
    out[..., i, i] = np.where(diagonal > 0, diagonal * (1 + damping), 1.0)
    return out


def _cholesky3(matrix: Array) -> list[Array]:
    """Lower factor of (3, 3, N), component by component; diagonal elements inverted."""
    a = 1 / np.sqrt(matrix[0, 0])
    b, c = matrix[1, 0] * a, matrix[2, 0] * a
    d = 1 / np.sqrt(matrix[1, 1] - b * b)
    e = (matrix[2, 1] - c * b) * d
    f = 1 / np.sqrt(matrix[2, 2] - c * c - e * e)
    return [a, b, c, d, e, f]


def _forward(factor: list[Array], right: Array) -> Array:
    """(..., 3, N) L^-1 right."""
    a, b, c, d, e, f = factor
    out = np.empty_like(right)
    np.multiply(right[..., 0, :], a, out=out[..., 0, :])
    out[..., 1, :] = (right[..., 1, :] - out[..., 0, :] * b) * d
    out[..., 2, :] = (right[..., 2, :] - out[..., 0, :] * c - out[..., 1, :] * e) * f
    return out


def _backward(factor: list[Array], right: Array) -> Array:
    """(..., 3, N) L^-T right."""
    a, b, c, d, e, f = factor
    out = np.empty_like(right)
    np.multiply(right[..., 2, :], f, out=out[..., 2, :])
    out[..., 1, :] = (right[..., 1, :] - out[..., 2, :] * e) * d
    out[..., 0, :] = (right[..., 0, :] - out[..., 1, :] * b - out[..., 2, :] * c) * a
    return out
