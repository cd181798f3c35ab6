"""Least squares with the factors of a solved graph and other right-hand sides.

With A the whitened factors, H = A (A^T A)^-1 A^T. For e ~ N(0, I) a right model leaves (I - H) e as
residuals, and (A^T A)^-1 A^T e is the error of its estimates: draws of both show what is to be
expected, correlation in time included.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.crowd import EliminatedCrowd, eliminated
from telerig.estimator.smoothing.graph.elimination import EliminatedGraph, starts_of
from telerig.estimator.smoothing.graph.layout import GraphLayout
from telerig.estimator.smoothing.graph.linear import all_factors
from telerig.estimator.smoothing.graph.solve import Solution, in_large_stack
from telerig.factors.linear_factors import LinearFactors, product, transposed_product

DRAWS = 16
_FEWEST_DRAWS, _DRAWN_ROWS = 2, 320_000
"""Of a long run with many bubbles fewer draws do: what is compared are means over all states."""
_REFINEMENTS = 1


@dataclass(frozen=True)
class WholeFit:
    """Hold all factors of a run, linearised at the solution, and the root of their information.

    starts : first column of each key.  first_row : of each group of factors, and their number.
    """

    graph: GraphLayout
    factors: list[LinearFactors]
    root: EliminatedGraph | EliminatedCrowd | None
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
        assert self.root is not None
        found = np.zeros((int(self.starts[-1]), right.shape[1]))
        rest = right
        for _ in range(1 + _REFINEMENTS):
            parts = [self.of_group(rest, i) for i in range(len(self.factors))]
            found += self.root.solved(transposed_product(self.factors, self.starts, parts))
            fitted = product(self.factors, self.starts, found)
            rest = right - np.concatenate([f.reshape(-1, f.shape[-1]) for f in fitted])
        return found, rest

    def increments(self, found: Array, family: int) -> Array:
        """Return the part (n, d, K) of increments (D, K) that belongs to a family of keys."""
        number, size = self.graph.counts()[family]
        first = self.starts[self.graph.base()[family]]
        return found[first : first + number * size].reshape(number, size, -1)


def whole_fit(solution: Solution) -> WholeFit:
    """Return the fit at a solution; one elimination more than it took."""
    graph = solution.graph
    samples = solution.sample_weights or None
    factors = all_factors(graph, solution.state, solution.weights, samples)
    done = in_large_stack(lambda: eliminated(graph, factors))
    first_row = np.r_[0, np.cumsum([f.rhs.size for f in factors])].astype(np.int64)
    return WholeFit(graph, factors, done, starts_of(graph), first_row)


def drawn(
    solution: Solution, draws: int | None = None, seed: int = 0
) -> tuple[WholeFit, Array, Array]:
    """Return the fit, errors (D, draws) of its estimates and residuals (rows, draws) that a right
    model leaves.

    draws : their number; None for `DRAWS`, or fewer for a run with many states.
    """
    fit = whole_fit(solution)
    draws = draws or int(np.clip(_DRAWN_ROWS // (fit.graph.rows or 1), _FEWEST_DRAWS, DRAWS))
    noise = np.random.default_rng(seed).standard_normal((fit.rows, draws))
    if fit.graph.rows < _DRAWN_ROWS // DRAWS:
        errors, left = fit.solved(noise)
    else:  # one after the other takes less memory
        each = [fit.solved(noise[:, k : k + 1]) for k in range(draws)]
        errors, left = (np.concatenate(parts, -1) for parts in zip(*each))
    return replace(fit, root=None), errors, left
