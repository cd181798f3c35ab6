"""Solves the normal equations of a large calibration through the Schur complement.

    [K  E ] [k]   [a]
    [E' D ] [d] = [b]       D = W W^T,  F = E W^-T,  S = K - F F^T

The unknowns are k, which are kept, and d, which are eliminated; W is the Cholesky factor of D and
S the Schur complement. No view is coupled to another view and no dot to another dot, so D is block
diagonal if d are the dots, or the views if that leaves fewer unknowns (Triggs et al., Bundle
Adjustment, 1999, section 6). The two dots of a known distance are coupled and are kept. The blocks
are the ones that GTSAM gets (`telerig.factors.calibration.image_columns`). They are summed over a
few thousand dots at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from telerig.arrays import Array, Ints
from telerig.errors import CalibrationError
from telerig.estimator.calibration.solver.problem import System, images_of
from telerig.factors.calibration import State, dot_columns

CHUNK = 4000
"""Approximate number of measured dots that are evaluated at once. With fewer, the function calls
take more time; with more, the arrays do not fit into the processor's cache."""


def undetermined() -> CalibrationError:
    """Return the error for measurements that do not determine all parameters."""
    return CalibrationError(
        "the measurements do not determine all parameters of the calibration",
        todo="add views with other tilts, or choose a simpler lens model with --model",
    )


@dataclass(frozen=True)
class Posterior:
    """The covariance of K parameters of cameras and views and of N dots: the inverse of J^T J.

    common : (K, K) of cameras and views.
    cross : (K, N, 3) of cameras and views with each dot.
    dots : (N, 3, 3) of each dot.
    whole : (K + 3 N, K + 3 N) of all parameters, or None if it was not asked for.
    untouched : (K + 3 N,) whether no measurement depends on the parameter; its variance is 1 here.
    """

    common: Array
    cross: Array
    dots: Array
    whole: Array | None
    untouched: NDArray[np.bool_]

    @staticmethod
    def of(whole: Array, common: int, untouched: NDArray[np.bool_]) -> Posterior:
        """Return the parts of a full covariance.

        whole : (K + 3 N, K + 3 N).
        common : the number K.
        untouched : as in the class.
        """
        at = common + np.arange(len(whole) - common).reshape(-1, 3)
        cross = whole[:common, common:].reshape(common, -1, 3)
        return Posterior(
            whole[:common, :common], cross, whole[at[:, :, None], at[:, None, :]], whole, untouched
        )


class NormalEquations:
    """J^T J and -J^T r in blocks, for K parameters of cameras and views and N dots.

    common : (K, K).
    dots : (3, 3, N).
    cross : (K, 3, N).
    right : (K + 3 N,) -J^T r.
    cost : half the sum of squared residuals.
    """

    def __init__(self, system: System, state: State) -> None:
        self.system = system
        first, size = system.dots_at, system.size
        count = (size - first) // 3
        self.common, self.cross = np.zeros((first, first)), np.zeros((first, 3, count))
        self.dots, self.right = np.zeros((3, 3, count)), np.zeros(size)
        self.of_dots = self.right[first:].reshape(count, 3)
        self.squared = 0.0
        for camera in range(len(system.images)):
            self._add_images(state, camera)
        priors = system.priors(state)
        self.cost = 0.5 * (self.squared + priors.squared)
        for places, (value, jacobian) in zip(system.camera_places, priors.cameras):
            self._add(places, jacobian, value)
        for at, value, jacobian in zip(self._views(), *priors.views):
            self._add(at, jacobian, value)
        value, weight = priors.dots
        self.dots[range(3), range(3)] += weight.T**2
        self.of_dots -= weight * value
        self.distance = priors.distance
        if self.distance is not None:
            pair, off, by_first = self.distance
            self.of_dots[list(pair)] -= off * np.array([by_first, -by_first])
        diagonals = np.diag(self.common), np.diagonal(self.dots).ravel()
        self.untouched = np.concatenate(diagonals) <= 0

    def _views(self) -> Ints:
        """Return the indices (V, 6) of the parameters of each of the V views."""
        return np.arange(self.system.views_at, self.system.dots_at).reshape(-1, 6)

    def _add(self, at: Ints, jacobian: Array, value: Array) -> None:
        """Add a residual whose derivatives belong to the parameters ``at``."""
        self.common[np.ix_(at, at)] += jacobian.T @ jacobian
        self.right[at] -= jacobian.T @ value

    def _add_images(self, state: State, camera: int) -> None:
        """Add the contributions of all images of one camera to the blocks."""
        system = self.system
        obs, own, views = system.images[camera], system.camera_places[camera], self._views()
        size, width, first = len(own), len(own) + 7, system.views_at
        gram, of_camera = (
            np.zeros((len(views), width, width)),
            np.zeros((size, *self.dots.shape[1:])),
        )
        by_view = self.cross[first:].reshape(len(views), 6, 3, -1)
        for images in _in_chunks(images_of(obs)):
            start = images[0][1]
            columns = system.columns(state, camera, slice(start, images[-1][2]))
            by_dot = np.empty((width, 3, columns.shape[-1]))
            for j, dot_column in enumerate(dot_columns(columns)):
                np.multiply(columns[:, 0], dot_column[0], out=by_dot[:, j])
                by_dot[:, j] += columns[:, 1] * dot_column[1]
            for view, a, b in images:
                flat = columns[..., a - start : b - start].reshape(width, -1)
                np.matmul(flat, flat.T, out=gram[view])
                dot, block = obs.dot[a:b], by_dot[..., a - start : b - start]
                # NumPy adds to a slice in place; an index array would cost two copies
                some = slice(dot[0], dot[-1] + 1) if dot[-1] - dot[0] + 1 == b - a else dot
                by_view[view][..., some] += block[size:-1]
                of_camera[..., some] += block[:size]
                self.dots[..., some] += block[-4:-1]
                self.of_dots[some] -= block[-1].T
        self.cross[own] += of_camera
        self.common[np.ix_(own, own)] += gram[:, :size, :size].sum(0)
        self.common[views[:, :, None], views[:, None]] += gram[:, size:-1, size:-1]
        across = gram[:, :size, size:-1].swapaxes(0, 1).reshape(size, -1)
        self.common[own, first:] += across
        self.common[first:, own] += across.T
        self.right[own] -= gram[:, :size, -1].sum(0)
        self.right[views] -= gram[:, size:-1, -1]
        self.squared += float(gram[:, -1, -1].sum())

    def step(self, damping: float) -> tuple[Array, float]:
        """Return a Levenberg-Marquardt step (K + 3 N,), and the predicted gain.

        The gain is the decrease of the cost that the linear model predicts. Raises CalibrationError
        if the measurements do not determine all parameters.
        """
        step = self._schur_complement(damping).solve(self.right)
        return step, float(0.5 * step @ self.right)

    def posterior(self, whole: bool) -> Posterior:
        """Return the inverse of J^T J; ``whole`` says whether the full matrix is computed, too.

        Raises CalibrationError if J^T J is singular.
        """
        reduced, size = self._schur_complement(0.0), len(self.common)
        if whole:
            return Posterior.of(reduced.inverse(), size, self.untouched)
        common, cross, dots = reduced.inverse_blocks(size)
        return Posterior(common, cross, dots, None, self.untouched)

    def information(self) -> Array:
        """Return J^T J as a dense matrix (K + 3 N, K + 3 N)."""
        kept, eliminated, matrix, coupling, blocks = self._kept_and_eliminated(0.0)
        out = np.zeros((len(self.right),) * 2)
        out[np.ix_(kept, kept)] = matrix
        flat = eliminated.ravel()
        out[np.ix_(kept, flat)] = coupling.transpose(0, 2, 1).reshape(len(kept), -1)
        out[np.ix_(flat, kept)] = out[np.ix_(kept, flat)].T
        out[eliminated[:, :, None], eliminated[:, None]] = blocks
        out[self.untouched, self.untouched] = 0.0
        return out

    def _schur_complement(self, damping: float) -> SchurComplement:
        return SchurComplement.of(*self._kept_and_eliminated(damping))

    def _kept_and_eliminated(self, damping: float) -> tuple[Ints, Ints, Array, Array, Array]:
        """Return kept (m,) and eliminated (B, n) parameters, and the damped blocks K, E and D.

        K is (m, m), E (m, n, B) and D (B, n, n).
        """
        size, count = len(self.common), self.dots.shape[-1]
        common = _damped(self.common, damping)
        dots = _damped(self.dots.transpose(2, 0, 1), damping)
        place = size + np.arange(3 * count).reshape(count, 3)
        views = self._views()
        if views.size <= 3 * count:
            pair = [] if self.distance is None else list(self.distance[0])
            rest = np.setdiff1d(np.arange(count), pair)
            kept = np.concatenate([np.arange(size), place[pair].ravel()]).astype(int)
            matrix = np.zeros((len(kept),) * 2)
            matrix[:size, :size] = common
            across = self.cross[..., pair].transpose(0, 2, 1).reshape(size, -1)
            matrix[:size, size:], matrix[size:, :size] = across, across.T
            matrix[size:, size:] = self._of_dots(dots, np.array(pair, int), damping)
            coupling = np.zeros((len(kept), 3, len(rest)))
            coupling[:size] = self.cross[..., rest]
            return kept, place[rest], matrix, coupling, dots[rest]
        shared = self.system.views_at
        kept = np.concatenate([np.arange(shared), place.ravel()])
        matrix = np.zeros((len(kept),) * 2)
        matrix[:shared, :shared] = common[:shared, :shared]
        across = self.cross[:shared].transpose(0, 2, 1).reshape(shared, -1)
        matrix[:shared, shared:], matrix[shared:, :shared] = across, across.T
        matrix[shared:, shared:] = self._of_dots(dots, np.arange(count), damping)
        of_views = self.cross[shared:].reshape(len(views), 6, 3, count).transpose(3, 2, 1, 0)
        coupling = np.concatenate(
            [
                self.common[:shared, shared:].reshape(shared, -1, 6).swapaxes(1, 2),
                of_views.reshape(3 * count, 6, len(views)),
            ]
        )
        return kept, views, matrix, coupling, common[views[:, :, None], views[:, None]]

    def _of_dots(self, dots: Array, some: Ints, damping: float) -> Array:
        """Return the damped information (3 n, 3 n) of n dots, with that of the known distance."""
        out = np.zeros((len(some), 3, len(some), 3))
        each = np.arange(len(some))
        out[each, :, each] = dots[some]
        if self.distance is not None:
            pair, _, by_first = self.distance
            row = np.zeros((len(some), 3))
            row[np.searchsorted(some, pair) if len(some) > 2 else [0, 1]] = by_first, -by_first
            square = np.outer(row, row)
            return out.reshape(square.shape) + square + damping * np.diag(np.diag(square))
        return out.reshape(3 * len(some), 3 * len(some))


@dataclass(frozen=True)
class SchurComplement:
    """The factorised Schur complement, with m kept parameters and B eliminated blocks of n each.

    The letters W, F, S, K, E and D are those of the equations at the top of this module.

    kept, eliminated : indices (m,) and (B, n) of the parameters.
    root : (B, n, n) inverse of W.
    coupling : (m, n B) F, with columns sorted by component and then by block.
    factor : lower Cholesky factor of S, in Fortran order.
    """

    kept: Ints
    eliminated: Ints
    root: Array
    coupling: Array
    factor: Array

    @staticmethod
    def of(
        kept: Ints, eliminated: Ints, matrix: Array, coupling: Array, blocks: Array
    ) -> SchurComplement:
        """Return the factorisation of the normal equations.

        matrix : (m, m) K, which is overwritten.
        coupling : (m, n, B) E.
        blocks : (B, n, n) D.

        Raises CalibrationError if a block or the Schur complement is not positive definite.
        """
        try:
            root = np.linalg.inv(np.linalg.cholesky(blocks))
        except np.linalg.LinAlgError as error:
            raise undetermined() from error
        whitened = np.empty_like(coupling)
        for i in range(root.shape[1]):
            np.multiply(coupling[:, 0], root[:, i, 0], out=whitened[:, i])
            for j in range(1, i + 1):
                whitened[:, i] += coupling[:, j] * root[:, i, j]
        flat = whitened.reshape(len(kept), -1)
        # the transpose of a C-ordered array is in Fortran order; the matrix is symmetric
        schur = dsyrk(-1.0, flat.T, 1.0, matrix.T, trans=1, lower=1, overwrite_c=1)
        factor, failed = dpotrf(schur, lower=1, overwrite_a=1, clean=0)
        if failed:
            raise undetermined()
        return SchurComplement(kept, eliminated, root, flat, factor)

    def solve(self, right: Array) -> Array:
        """Return the solution (D,) for a right-hand side (D,) of all D parameters."""
        inner = np.einsum("bij,bj->ib", self.root, right[self.eliminated])
        of_kept = right[self.kept] - self.coupling @ inner.ravel()
        first, _ = dpotrs(self.factor, of_kept, lower=1)
        inner -= (first @ self.coupling).reshape(inner.shape)
        out = np.empty_like(right)
        out[self.kept] = first
        out[self.eliminated] = np.einsum("bij,ib->bj", self.root, inner)
        return out

    def _inverse_kept(self) -> Array:
        """Return the block (m, m) of the inverse that belongs to the kept parameters."""
        lower = np.tril(dpotri(self.factor, lower=1)[0])
        return np.asarray(lower + np.tril(lower, -1).T)

    def _whitened_coupling(self) -> Array:
        """Return T (m, B, n) = chol(S)^-1 F W^-1; the eliminated inverse is D^-1 + T^T T."""
        half = dtrsm(1.0, self.factor, self.coupling, lower=1).reshape(
            len(self.kept), -1, len(self.root)
        )
        return np.asarray(np.einsum("kib,bij->kbj", half, self.root, optimize=True))

    def inverse(self) -> Array:
        """Return the full inverse (D, D) for all D parameters."""
        through = self._whitened_coupling().reshape(len(self.kept), -1)
        flat, across = (
            self.eliminated.ravel(),
            -dtrsm(1.0, self.factor, through, lower=1, trans_a=1),
        )
        out = np.zeros((len(self.kept) + len(flat),) * 2)
        out[np.ix_(self.kept, self.kept)] = self._inverse_kept()
        out[np.ix_(self.kept, flat)] = across
        out[np.ix_(flat, self.kept)] = across.T
        out[np.ix_(flat, flat)] = through.T @ through
        own = np.swapaxes(self.root, 1, 2) @ self.root
        out[self.eliminated[:, :, None], self.eliminated[:, None]] += own
        return out

    def inverse_blocks(self, size: int) -> tuple[Array, Array, Array]:
        """Return the blocks (K, K), (K, N, 3) and (N, 3, 3) of the inverse, as in `Posterior`.

        They are computed directly if dots are eliminated, otherwise from the full inverse.
        """
        if self.root.shape[1] != 3:
            found = Posterior.of(self.inverse(), size, np.zeros(0, bool))
            return found.common, found.cross, found.dots
        through, inverse = self._whitened_coupling(), self._inverse_kept()
        count = (len(self.kept) - size) // 3 + len(self.eliminated)
        cross, dots = np.empty((size, count, 3)), np.empty((count, 3, 3))
        flat = through.reshape(len(through), -1)
        across = -dtrsm(1.0, self.factor, flat, lower=1, trans_a=1).reshape(through.shape)
        mine, stay = (self.eliminated[:, 0] - size) // 3, (self.kept[size::3] - size) // 3
        cross[:, mine], cross[:, stay] = across[:size], inverse[:size, size:].reshape(size, -1, 3)
        dots[mine] = np.einsum("kbi,kbj->bij", through, through)
        dots[mine] += np.swapaxes(self.root, 1, 2) @ self.root
        at = size + np.arange(3 * len(stay)).reshape(-1, 3)
        dots[stay] = inverse[at[:, :, None], at[:, None]]
        return inverse[:size, :size], cross, dots


def _in_chunks(images: Sequence[tuple[int, int, int]]) -> list[Sequence[tuple[int, int, int]]]:
    """Return the images (view, first row, last row + 1) in chunks of about `CHUNK` measurements."""
    ends = [end for _, _, end in images]
    parts = max(1, round(max(ends, default=0) / CHUNK))
    cuts = np.unique(np.searchsorted(ends, np.linspace(0, max(ends, default=0), parts + 1)[1:]) + 1)
    return [images[a:b] for a, b in pairwise([0, *cuts.tolist()])] if images else []


def _damped(matrix: Array, damping: float) -> Array:
    """Return matrices (..., n, n) with Marquardt's damping; untouched parameters stay in place."""
    out = matrix.copy()
    i = np.arange(matrix.shape[-1])
    diagonal = matrix[..., i, i]
    out[..., i, i] = np.where(diagonal > 0, diagonal * (1 + damping), 1.0)
    return out
