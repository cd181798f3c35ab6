"""The Gaussian of a least-squares problem about a state: information matrix and right side.

    cost(x) = cost - right' x + x' H x / 2,      H = [K  E]        D = W W^T,  F = E W^-T,
                                                     [E' D],       S = K - F F^T

H has common parameters, which may all be coupled, and many small blocks D that are coupled only to
the common ones: in a calibration, cameras and views, and the dots. The blocks are eliminated, W is
the Cholesky factor of D, and S the Schur complement (Triggs et al., Bundle Adjustment, 1999,
section 6). GTSAM eliminates a factor graph whose variables are the common parameters and groups of
blocks. Large problems are eliminated by NumPy; the result has the same form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs
from scipy.special import chdtrc

from telerig.arrays import Array, Bools, Ints
from telerig.errors import CalibrationError

OF_GROUP = 60
"""Approximate number of scalars that form one variable of GTSAM's graph (docs/decisions/020)."""


def undetermined() -> CalibrationError:
    """Return the error for measurements that do not determine all parameters."""
    return CalibrationError(
        "the measurements do not determine all parameters of the calibration",
        todo="add views with other tilts, or choose a simpler lens model with --model",
    )


@dataclass(frozen=True)
class Gaussian:
    """Information about D = K + n B parameters: K common ones, and B blocks of n.

    common : (K, K) K.
    cross : (K, n, B) E.
    blocks : (B, n, n) D.
    right : (D,).
    cost : half the sum of squared residuals at the state.
    rig : the first of the common parameters are coupled to all others; from this number on they are
        poses of views (6 each), which are not coupled to each other.
    distance : indices of two blocks (dots) whose distance is known, and its derivative (n,) with
        respect to the first, whitened; None without.
    by_gtsam : whether GTSAM eliminates.
    turned : indices (3,) of components of a translation, and the axes (3, 3, in columns) along
        which they are counted here. What the Gaussian returns is along the usual axes.
    """

    common: Array
    cross: Array
    blocks: Array
    right: Array
    cost: float
    rig: int
    distance: tuple[tuple[int, int], Array] | None
    by_gtsam: bool
    turned: Sequence[tuple[Ints, Array]] = ()

    @cached_property
    def diagonal(self) -> Array:
        """The diagonal (D,) of the information matrix."""
        out = np.concatenate([np.diag(self.common), np.diagonal(self.blocks, 0, 1, 2).ravel()])
        if self.distance is not None:
            out[self.of_blocks[list(self.distance[0])]] += self.distance[1] ** 2
        return out

    @property
    def untouched(self) -> Bools:
        """Whether no measurement and no prior depends on a parameter (D,)."""
        return self.diagonal <= 0

    @property
    def of_blocks(self) -> Ints:
        """The indices (B, n) of the blocks' parameters."""
        return np.arange(len(self.common), len(self.right)).reshape(self.blocks.shape[:2])

    def step(self, damping: float = 0.0) -> tuple[Array, float]:
        """Return the step (D,) to the minimum with Marquardt's damping, and the predicted gain.

        The gain is the decrease of the cost that the linear model predicts. Raises CalibrationError
        if the measurements do not determine all parameters.
        """
        step = self.eliminated(damping).solve(self.right)
        gain = float(0.5 * step @ self.right)
        for at, axes in self.turned:
            step[at] = axes @ step[at]
        return step, gain

    def hold(self, index: Ints) -> Gaussian:
        """Return the Gaussian of the other parameters, while those with an index keep their values.

        index : of common parameters, of the parameters of all blocks, or of both.
        """
        stay = np.setdiff1d(np.arange(len(self.right)), index)
        common = stay[stay < len(self.common)]
        has_blocks = len(stay) > len(common)
        cross = self.cross[common] if has_blocks else self.cross[common][..., :0]
        return replace(
            self, common=self.common[np.ix_(common, common)], cross=cross,
            blocks=self.blocks if has_blocks else self.blocks[:0], right=self.right[stay],
            rig=int(np.searchsorted(common, self.rig)),
            distance=self.distance if has_blocks else None,
            by_gtsam=self.by_gtsam and has_blocks,
            turned=[(np.searchsorted(common, at), axes) for at, axes in self.turned],
        )  # fmt: skip

    def moved_by(self, index: Ints) -> Array:
        """Return how far (D - n, n) the minimum moves with n common parameters that are held."""
        stay = np.setdiff1d(np.arange(len(self.common)), index)
        across = self.cross[index].transpose(2, 1, 0).reshape(-1, len(index))
        coupling = np.concatenate([self.common[np.ix_(stay, index)], across])
        held = self.hold(index)
        moved = -held.eliminated().solve(coupling)
        for at, axes in held.turned:
            moved[at] = axes @ moved[at]
        return moved

    def in_terms_of(self, matrix: Array) -> Gaussian:
        """Return the Gaussian of parameters y (m,), if those here, without blocks, are matrix y."""
        matrix = matrix.copy()
        for at, axes in self.turned:
            matrix[at] = axes.T @ matrix[at]
        return replace(
            self, common=matrix.T @ self.common @ matrix, right=matrix.T @ self.right,
            cross=np.zeros((matrix.shape[1], *self.cross.shape[1:])), rig=matrix.shape[1],
            turned=(),
        )  # fmt: skip

    def add_rows(self, rows: Array, residual: Array) -> Gaussian:
        """Return the Gaussian with further residuals (r,), whose derivatives by the common
        parameters are rows (r, K)."""
        right = self.right.copy()
        right[: len(self.common)] -= rows.T @ residual
        cost = self.cost + 0.5 * float(residual @ residual)
        return replace(self, common=self.common + rows.T @ rows, right=right, cost=cost)

    def marginal(self, index: Ints) -> Array:
        """Return the covariance (n, n) of n parameters, whatever the others are.

        Raises CalibrationError as `step` does.
        """
        unit = np.zeros((len(self.right), len(index)))
        unit[index, np.arange(len(index))] = 1.0
        return self.eliminated().solve(unit)[index]

    def covariance(self, *, whole: bool) -> tuple[Array, Array, Array, Array | None]:
        """Return the blocks (K, K), (K, B, n) and (B, n, n) of the inverse, and all of it.

        An untouched parameter has the variance 1. whole : whether the full inverse (D, D) is
        computed, too; else it is None. Raises CalibrationError as `step` does.
        """
        found, at, size = self.eliminated(), self.of_blocks, len(self.common)
        every = None
        if whole or found.root.shape[1] != self.cross.shape[1]:
            every = found.inverse()
            common, cross = every[:size, :size], every[:size, size:].reshape(size, *at.shape)
            blocks = every[at[:, :, None], at[:, None]]
        else:
            common, cross, blocks = found.inverse_blocks(size)
        for place, axes in self.turned:
            common[:, place] = common[:, place] @ axes.T
            common[place] = axes @ common[place]
            cross[place] = np.tensordot(axes, cross[place], 1)
            if every is not None:
                every[size:, place] = cross[place].reshape(3, -1).T
        return common, cross, blocks, every

    def eliminated(self, damping: float = 0.0) -> Eliminated:
        """Return the Gaussian with its blocks eliminated, or its views if that leaves less.

        Two blocks whose distance is known are kept. Raises CalibrationError as `step` does.
        """
        size, (_, n, count) = len(self.common), self.cross.shape
        views = np.arange(self.rig, size).reshape(-1, 6)
        if views.size <= n * count:
            first, stay = size, np.array([] if self.distance is None else self.distance[0], int)
            rest = np.setdiff1d(np.arange(count), stay)
            away, blocks = self.of_blocks[rest], self.blocks[rest]
        else:
            first, stay = self.rig or 6, np.arange(count)  # something is kept
            away = views = np.arange(first, size).reshape(-1, 6)
            blocks = self.common[views[:, :, None], views[:, None]]
        kept = np.concatenate([np.arange(first), self.of_blocks[stay].ravel()])
        coupling = np.zeros((len(kept), *away.shape[::-1]))
        if first == size:
            coupling[:first] = self.cross[..., rest]
        else:
            coupling[:first] = self.common[:first, views].swapaxes(1, 2)
            of_views = self.cross[first:].reshape(*views.shape, n, count)
            coupling[first:] = of_views.transpose(3, 2, 1, 0).reshape(-1, *away.shape[::-1])
        matrix = np.zeros((len(kept),) * 2)
        matrix[:first, :first] = self.common[:first, :first]
        across = self.cross[:first][..., stay].swapaxes(1, 2).reshape(first, n * len(stay))
        matrix[:first, first:], matrix[first:, :first] = across, across.T
        own = first + np.arange(n * len(stay)).reshape(-1, n)
        matrix[own[:, :, None], own[:, None]] = self.blocks[stay]
        if self.distance is not None:
            pair, slope = self.distance
            row = np.concatenate([slope, -slope])
            at = own[[int(np.flatnonzero(stay == dot)[0]) for dot in pair]].ravel()
            matrix[np.ix_(at, at)] += np.outer(row, row)
        more = np.where(self.untouched, 1.0, damping * self.diagonal)
        matrix[np.diag_indices(len(kept))] += more[kept]
        blocks[:, range(blocks.shape[1]), range(blocks.shape[1])] += more[away]
        if self.by_gtsam and (found := _by_gtsam(matrix, coupling, blocks)) is not None:
            return Eliminated(kept, away, *found)
        return Eliminated(kept, away, *_by_arrays(matrix, coupling, blocks))


_RANK = 1e-6
"""Directions whose variance is smaller than this share of the largest one are left out of a test,
because second-order effects of the others are larger there."""
_EXACT = 1e-9
"""Largest value (mm or rad) of a quantity without uncertainty that counts as rounding."""


@dataclass(frozen=True)
class Estimate:
    """Some numbers with a Gaussian error: their values (n,) and covariance (n, n)."""

    value: Array
    covariance: Array

    @property
    def sd(self) -> Array:
        """The standard deviations (n,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def predict(self, rows: Array) -> Estimate:
        """Return the linear functions rows (m, n) of the numbers."""
        return Estimate(rows @ self.value, rows @ self.covariance @ rows.T)

    def hold(self, index: Sequence[int]) -> Estimate:
        """Return all numbers if those with an index are exactly zero."""
        across = self.covariance[index]
        gain = np.linalg.solve(self.covariance[np.ix_(index, index)], across).T
        return Estimate(
            self.value - gain @ self.value[index], self.covariance - gain @ across
        )  # fmt: skip

    def chi_square(self, index: Sequence[int]) -> float:
        """Return Wald's statistic of the hypothesis that the numbers with an index are zero."""
        value = self.value[index]
        return float(value @ np.linalg.solve(self.covariance[np.ix_(index, index)], value))

    def p_value(self) -> float:
        """Return the probability of numbers as large as these if all are zero.

        Directions with (almost) no variance do not count. Without any variance, numbers beyond
        rounding have the probability 0.
        """
        if not np.any(self.covariance):
            return float(np.all(np.abs(self.value) < _EXACT))
        variance, directions = np.linalg.eigh(self.covariance)
        seen = variance > _RANK * variance[-1]
        along = (self.value @ directions)[seen]
        return float(chdtrc(int(seen.sum()), float(np.sum(along**2 / variance[seen]))))

    def saved_by(self, rows: Array, onto: Array) -> Array:
        """Return by how much further measurements lower the summed variance of onto^T x.

        rows : (..., r, n) whitened derivatives of r measurements. onto : (n, R).
        With A the rows and C the covariance, it is the trace of
        onto^T C A^T (1 + A C A^T)^-1 A C onto.
        """
        through = rows @ self.covariance
        both = through @ rows.mT + np.eye(rows.shape[-2])
        seen = through @ onto
        return np.asarray(np.sum(seen * np.linalg.solve(both, seen), axis=(-1, -2)))


def _by_gtsam(matrix: Array, coupling: Array, blocks: Array) -> tuple[Array, Array, Array] | None:
    """Return `Eliminated.root`, ``coupling`` and ``factor`` from GTSAM's Bayes net.

    The graph has one factor for each group of blocks, with the common parameters. Columns are
    scaled to unit length, because GTSAM refuses pivots of very different size. Returns None where
    it still does: one camera alone sees a view, whose depth only a weak prior determines.
    """
    import gtsam

    size, n, count = coupling.shape
    own = 1 / np.sqrt(np.diag(matrix))
    scale = 1 / np.sqrt(np.diagonal(blocks, 0, 1, 2))
    scaled = blocks * scale[:, :, None] * scale[:, None]
    across = (coupling * own[:, None, None] * scale.T).transpose(2, 1, 0)
    groups = np.array_split(np.arange(count), max(1, round(n * count / OF_GROUP)))
    graph, order = gtsam.GaussianFactorGraph(), gtsam.Ordering()
    common, nothing = matrix * own[:, None] * own, np.zeros(size)
    for key, some in enumerate(groups, 1):
        each, width = np.arange(len(some)), n * len(some)
        own_blocks = np.zeros((len(some), n, len(some), n))
        own_blocks[each, :, each] = scaled[some]
        square, coupled = own_blocks.reshape(width, width), across[some].reshape(width, size)
        zero = np.zeros(width)
        graph.add(gtsam.HessianFactor(key, 0, square, coupled, zero, common, nothing, 0.0))
        order.push_back(key)
        common = np.zeros_like(matrix)  # it is in the first factor
    order.push_back(0)
    try:
        net = graph.eliminateSequential(order)
    except RuntimeError:
        return None
    root, whitened = np.empty_like(blocks), np.empty_like(coupling)
    for i, some in enumerate(groups):
        conditional, each = net.at(i), np.arange(len(some))
        root[some] = conditional.R().reshape(len(some), n, len(some), n)[each, :, each]
        whitened[..., some] = conditional.S().T.reshape(size, len(some), n).swapaxes(1, 2)
    root = np.linalg.inv(root).swapaxes(1, 2) * scale[:, None]
    whitened /= own[:, None, None]
    factor = np.asfortranarray((net.at(len(groups)).R() / own).T)
    return root, whitened.reshape(size, -1), factor


def _by_arrays(matrix: Array, coupling: Array, blocks: Array) -> tuple[Array, Array, Array]:
    """Return `Eliminated.root`, ``coupling`` and ``factor``; ``matrix`` is overwritten.

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
    flat = whitened.reshape(len(matrix), blocks[..., 0].size)
    # the transpose of a C-ordered array is in Fortran order; the matrix is symmetric
    schur = matrix.T
    if flat.size:  # BLAS refuses arrays without elements
        schur = dsyrk(-1.0, flat.T, 1.0, schur, trans=1, lower=1, overwrite_c=1)
    factor, failed = dpotrf(schur, lower=1, overwrite_a=1, clean=0)
    if failed:
        raise undetermined()
    return root, flat, factor


@dataclass(frozen=True)
class Eliminated:
    """A factorised Gaussian with m kept parameters and B eliminated blocks of n each.

    The letters W, F, S, K, E and D are those of the equations at the top of this module.

    kept, away : indices (m,) and (B, n) of the kept and of the eliminated parameters.
    root : (B, n, n) inverse of W.
    coupling : (m, n B) F, with columns sorted by component and then by block.
    factor : lower Cholesky factor of S, in Fortran order.
    """

    kept: Ints
    away: Ints
    root: Array
    coupling: Array
    factor: Array

    def solve(self, right: Array) -> Array:
        """Return the solution (D, ...) for right-hand sides (D, ...) of all D parameters."""
        inner = np.einsum("bij,bj...->ib...", self.root, right[self.away])
        flat = inner.reshape(-1, *right.shape[1:])
        first, _ = dpotrs(self.factor, right[self.kept] - self.coupling @ flat, lower=1)
        inner = (flat - self.coupling.T @ first).reshape(inner.shape)
        out = np.empty_like(right)
        out[self.kept] = first
        out[self.away] = np.einsum("bij,ib...->bj...", self.root, inner)
        return out

    def inverse_kept(self) -> Array:
        """Return the block (m, m) of the inverse that belongs to the kept parameters."""
        lower = np.tril(dpotri(self.factor, lower=1)[0])
        return np.asarray(lower + np.tril(lower, -1).T)

    def _through(self) -> tuple[Array, Array]:
        """Return T (m, B, n) = chol(S)^-1 F W^-1, and the inverse (m, n B) of kept with eliminated.

        The inverse of the eliminated parameters is D^-1 + T^T T.
        """
        half = dtrsm(1.0, self.factor, self.coupling, lower=1).reshape(
            len(self.kept), -1, len(self.root)
        )
        through = np.asarray(np.einsum("kib,bij->kbj", half, self.root, optimize=True))
        flat = through.reshape(len(through), -1)
        return through, -dtrsm(1.0, self.factor, flat, lower=1, trans_a=1)

    def inverse(self) -> Array:
        """Return the full inverse (D, D) for all D parameters."""
        through, across = self._through()
        flat, through = self.away.ravel(), through.reshape(len(through), -1)
        out = np.zeros((len(self.kept) + len(flat),) * 2)
        out[np.ix_(self.kept, self.kept)] = self.inverse_kept()
        out[np.ix_(self.kept, flat)] = across
        out[np.ix_(flat, self.kept)] = across.T
        out[np.ix_(flat, flat)] = through.T @ through
        own = np.swapaxes(self.root, 1, 2) @ self.root
        out[self.away[:, :, None], self.away[:, None]] += own
        return out

    def inverse_blocks(self, size: int) -> tuple[Array, Array, Array]:
        """Return the blocks of `Gaussian.covariance` if the blocks were eliminated.

        size : number of common parameters.
        """
        (through, across), inverse = self._through(), self.inverse_kept()
        n = self.root.shape[1]
        stay, mine = (self.kept[size::n] - size) // n, (self.away[:, 0] - size) // n
        count = len(stay) + len(mine)
        cross, blocks = np.empty((size, count, n)), np.empty((count, n, n))
        cross[:, mine] = across[:size].reshape(size, -1, n)
        cross[:, stay] = inverse[:size, size:].reshape(size, -1, n)
        blocks[mine] = np.einsum("kbi,kbj->bij", through, through)
        blocks[mine] += np.swapaxes(self.root, 1, 2) @ self.root
        at = size + np.arange(n * len(stay)).reshape(-1, n)
        blocks[stay] = inverse[at[:, :, None], at[:, None]]
        return inverse[:size, :size], cross, blocks
