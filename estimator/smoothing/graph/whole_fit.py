"""Least squares with the factors of a solved graph and other right-hand sides.

With A the whitened factors, H = A (A^T A)^-1 A^T. For e ~ N(0, I) a right model leaves (I - H) e as
residuals, and (A^T A)^-1 A^T e is the error of its estimates: draws of both show what is to be
expected, correlation in time included.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtrtrs

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.elimination import Clique, eliminate
from telerig.estimator.smoothing.graph.layout import GraphLayout
from telerig.estimator.smoothing.graph.linear import all_factors
from telerig.estimator.smoothing.graph.solve import Solution, in_large_stack
from telerig.factors.linear_factors import LinearFactors

DRAWS = 16
_REFINEMENTS = 1


@dataclass(frozen=True)
class WholeFit:
    """Hold all factors of a run, linearised at the solution, and the root of their information.

    starts : first column of each key.  first_row : of each group of factors, and their number.
    """

    graph: GraphLayout
    factors: list[LinearFactors]
    cliques: list[Clique]
    starts: Ints
    first_row: Ints

    @property
    def rows(self) -> int:
        """Number of whitened residuals."""
        return int(self.first_row[-1])

    def of_group(self, values: Array, group: int) -> Array:
        """Return the part (M, rows, K) of values (all rows, K) that belongs to a group."""
        part = values[self.first_row[group] : self.first_row[group + 1]]
        return part.reshape(*self.factors[group].rhs.shape, -1)

    def solved(self, right: Array) -> tuple[Array, Array]:
        """Return the least-squares increments (D, K) and residuals (rows, K) of right-hand sides.

        The root is refined, because A^T A alone has too few digits.
        """
        found = np.zeros((int(self.starts[-1]), right.shape[1]))
        rest = right
        for _ in range(1 + _REFINEMENTS):
            found += self._by_root(self._transposed(rest))
            rest = right - self._applied(found)
        return found, rest

    def increments(self, found: Array, family: int) -> Array:
        """Return the part (n, d, K) of increments (D, K) that belongs to a family of keys."""
        number, size = self.graph.counts()[family]
        first = self.starts[self.graph.base()[family]]
        return found[first : first + number * size].reshape(number, size, -1)

    def _columns(self, key: object, block: Array, count: int) -> Ints:
        first = self.starts[np.broadcast_to(np.asarray(key, np.int64), (count,))]
        return np.asarray(first[:, None] + np.arange(block.shape[-1]))

    def _applied(self, found: Array) -> Array:
        out = np.zeros((self.rows, found.shape[1]))
        for group, linear in enumerate(self.factors):
            mine = self.of_group(out, group)
            for key, block in zip(linear.keys, linear.blocks):
                if block.shape[-1]:
                    mine += block @ found[self._columns(key, block, len(linear.rhs))]
        return out

    def _transposed(self, values: Array) -> Array:
        count, width = int(self.starts[-1]), values.shape[1]
        out = np.zeros(count * width)
        for group, linear in enumerate(self.factors):
            mine = self.of_group(values, group)
            for key, block in zip(linear.keys, linear.blocks):
                if block.shape[-1] and len(mine):
                    column = self._columns(key, block, len(mine))
                    place = column[..., None] * width + np.arange(width)
                    share = np.swapaxes(block, -1, -2) @ mine
                    out += np.bincount(place.ravel(), share.ravel(), len(out))
        return out.reshape(count, width)

    def _by_root(self, side: Array) -> Array:
        at = [(self._places(c.fronts), self._places(c.separator)) for c in self.cliques]
        for clique, (own, above) in zip(self.cliques, at):
            side[own] = dtrtrs(clique.root, side[own], trans=1)[0]
            side[above] -= clique.right.T @ side[own]
        for clique, (own, above) in zip(reversed(self.cliques), reversed(at)):
            side[own] = dtrtrs(clique.root, side[own] - clique.right @ side[above])[0]
        return side

    def _places(self, keys: list[int]) -> Ints:
        parts = [np.arange(self.starts[k], self.starts[k + 1]) for k in keys]
        return np.concatenate([np.zeros(0, np.int64), *parts])


def whole_fit(solution: Solution) -> WholeFit:
    """Return the fit at a solution; one elimination more than it took."""
    graph = solution.graph
    samples = solution.sample_weights or None
    factors = all_factors(graph, solution.state, solution.weights, samples)
    only_frames = len(graph.nodes.t_s) == len(graph.problem.t_s)
    quick = only_frames and not graph.model.broad_bands
    done = in_large_stack(lambda: eliminate(graph, factors, cholesky=quick))
    sizes = [d for n, d in graph.counts() for _ in range(n)]
    starts = np.r_[0, np.cumsum(sizes)].astype(np.int64)
    first_row = np.r_[0, np.cumsum([f.rhs.size for f in factors])].astype(np.int64)
    return WholeFit(graph, factors, done.cliques, starts, first_row)


def drawn(solution: Solution, draws: int = DRAWS, seed: int = 0) -> tuple[WholeFit, Array, Array]:
    """Return the fit, errors (D, draws) of its estimates and residuals (rows, draws) that a right
    model leaves."""
    fit = whole_fit(solution)
    noise = np.random.default_rng(seed).standard_normal((fit.rows, draws))
    return (fit, *fit.solved(noise))
