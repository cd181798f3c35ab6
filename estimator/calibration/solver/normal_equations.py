"""Normal equations of a calibration in blocks, and their damped solution.

Cameras couple with everything, but no view couples with a view and no dot with a dot. A step
eliminates dots and solves the Schur complement on cameras and views, or the other way round,
whichever is smaller (Triggs et al., Bundle Adjustment, 1999, section 6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.solver.schur import Blocks, Group, Posterior, Reduced

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class NormalEquations:
    """J^T J and -J^T r in blocks, for S numbers of cameras, V views and N dots.

    Rows and columns in the graph's order: intrinsics, camera poses (S together), views, dots.

    shared : (S, S).  by_view : (S, 6 V).  views : (V, 6, 6).  dots : (3, 3, N).
    cross : (S + 6 V, 3, N) of cameras and views with dots, component by component.
    right : (S + 6 V + 3 N,).
    distance : (3 N,) row of the known distance, which couples two dots, or None; its share is in
    ``right`` but not in ``dots``.
    groups : dots seen by the same few views, with their rows of ``cross``; none where most views
    see most dots.
    """

    cost: float
    shared: Array
    by_view: Array
    views: Array
    dots: Array
    cross: Array
    right: Array
    distance: Array | None
    groups: tuple[Group, ...] = ()

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
        views_left = 6 * len(self.views) <= 3 * self.dots.shape[-1]
        reduced = self.without_dots(damping) if views_left else self.without_views(damping)
        if self.distance is None:
            step = reduced.solve(self.right)
        else:
            row = self.distance_row()
            step, along = reduced.solve(np.stack([self.right, row], -1)).T
            step = step - along * (row @ step) / (1 + row @ along)
        return step, float(0.5 * step @ self.right)

    def distance_row(self) -> Array:
        """(S + 6 V + 3 N,) of the known distance."""
        assert self.distance is not None
        return np.concatenate([np.zeros(self.common), self.distance])

    def posterior(self, whole: bool) -> Posterior:
        """The inverse of J^T J from the factorisation that a step uses.

        whole : all of it, dots with dots too.
        """
        untouched = np.concatenate([
            np.diag(self.shared) <= 0, np.diagonal(self.views, 0, 1, 2).ravel() <= 0,
            np.zeros(self.dots[0].size, bool),
        ])  # fmt: skip
        reduced = self.without_dots()
        row = None if self.distance is None else self.distance_row()
        along, denominator = np.zeros(len(self.right)), 1.0
        if row is not None:
            along = reduced.solve(row)
            denominator = 1 + float(row @ along)
        if whole:
            inverse = reduced.inverse()
            inverse -= np.outer(along, along) / denominator
            return Posterior.of(inverse, self.common, untouched)
        of_common, of_dots = along[: self.common], along[self.common :].reshape(-1, 3)
        common = reduced.inverse_kept() - np.outer(of_common, of_common) / denominator
        dots = reduced.inverse_blocks() - of_dots[:, :, None] * of_dots[:, None] / denominator
        cross = reduced.inverse_cross().reshape(self.common, 3, -1).swapaxes(1, 2)
        cross = cross - of_common[:, None, None] * of_dots / denominator
        return Posterior(common, cross, dots, None, untouched)

    def without_dots(self, damping: float = 0.0) -> Reduced:
        """The damped system with the dots eliminated, the distance left out."""
        size, count = self.common, self.dots.shape[-1]
        dots = self.dots.copy()
        dots[range(3), range(3)] *= 1 + damping
        whiten = _cholesky3(dots)

        def forward(right: Array, some: Ints | slice = slice(None)) -> Array:
            planes = right.reshape(*right.shape[:-1], 3, -1)
            return _forward([w[some] for w in whiten], planes).reshape(right.shape)

        def backward(right: Array, some: Ints | slice = slice(None)) -> Array:
            planes = right.reshape(*right.shape[:-1], 3, -1)
            return _backward([w[some] for w in whiten], planes).reshape(right.shape)

        matrix = self._common(_damped(self.shared, damping), _damped(self.views, damping))
        places = np.arange(count)[:, None] + count * np.arange(3)
        blocks = Blocks(forward, backward, places, dots.transpose(2, 0, 1))
        coupling = self.cross.reshape(size, -1)
        kept = np.arange(size)
        return Reduced.of(kept, self._dot_places(), matrix, coupling, blocks, self.groups)

    def _dot_places(self) -> Ints:
        """Where the dots' numbers stand in the graph's order, component by component."""
        return self.common + (np.arange(3)[:, None] + 3 * np.arange(self.dots.shape[-1])).ravel()

    def without_views(self, damping: float = 0.0) -> Reduced:
        """The damped system with the views eliminated, the distance left out."""
        s, count, views = len(self.shared), self.dots.shape[-1], len(self.views)
        matrix = np.zeros((s + 3 * count, s + 3 * count))
        matrix[:s, :s] = _damped(self.shared, damping)
        matrix[:s, s:] = self.cross[:s].reshape(s, -1)
        matrix[s:, :s] = matrix[:s, s:].T
        dots = self.dots.copy()
        dots[range(3), range(3)] *= 1 + damping
        at = np.arange(count)
        matrix[s:, s:].reshape(3, count, 3, count)[:, at, :, at] = dots.transpose(2, 0, 1)
        of_views = _damped(self.views, damping)
        inverse = np.linalg.inv(np.linalg.cholesky(of_views))

        def forward(right: Array, some: Ints | slice = slice(None)) -> Array:
            columns = right.reshape(-1, right.shape[-1] // 6, 6).transpose(1, 2, 0)
            return (inverse[some] @ columns).transpose(2, 0, 1).reshape(right.shape)

        def backward(right: Array, some: Ints | slice = slice(None)) -> Array:
            columns = right.reshape(-1, right.shape[-1] // 6, 6).transpose(1, 2, 0)
            back = np.swapaxes(inverse[some], -1, -2)
            return (back @ columns).transpose(2, 0, 1).reshape(right.shape)

        coupling = np.concatenate([self.by_view, self.cross[s:].reshape(6 * views, -1).T])
        kept = np.concatenate([np.arange(s), self._dot_places()])
        places = np.arange(6 * views).reshape(views, 6)
        blocks = Blocks(forward, backward, places, of_views)
        return Reduced.of(kept, np.arange(s, self.common), matrix, coupling, blocks)


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
