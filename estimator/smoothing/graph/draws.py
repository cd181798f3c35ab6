"""Draws of a fit: the errors of its estimates, and the residuals that a right model leaves.

With A the whitened factors, H = A (A^T A)^-1 A^T. For e ~ N(0, I) a right model leaves (I - H) e as
residuals, and (A^T A)^-1 A^T e is the error of its estimates: draws of both show what is to be
expected, correlation in time included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from telerig.arrays import Array
from telerig.estimator.smoothing.graph.crowd import EliminatedCrowd
from telerig.estimator.smoothing.graph.elimination import EliminatedGraph, starts_of
from telerig.estimator.smoothing.graph.layout import GraphLayout
from telerig.estimator.smoothing.graph.linear import ENCODER, MARKS, PIXELS
from telerig.estimator.smoothing.problem.problem import Observations
from telerig.factors.linear_factors import LinearFactors, product, transposed_product

DRAWS = 16
_FEWEST_DRAWS, _DRAWN_ROWS, _ROWS_AT_ONCE = 2, 200_000, 100_000
"""Of a long run with many bubbles fewer draws do: what is compared are means over all states. Few
states times draws at once take little memory."""
_REFINEMENTS = 1


@dataclass(frozen=True)
class Draws:
    """Hold K random draws of errors and residuals, as they are if the model is right.

    errors : (D, K) errors of all D variables, in the order of their keys.
    pixels, marks : (M, 2, K) and (R, 2, K) whitened residuals of the bubbles' and the marks'
        pixels, multiplied by the square roots of their weights.
    encoder : (E, K) whitened residuals of the encoder's readings.
    """

    errors: Array
    pixels: Array
    marks: Array
    encoder: Array

    def of_family(self, graph: GraphLayout, family: str) -> Array:
        """Return the errors (n, d, K) of the n keys of one of `Families`, each of d numbers, in K
        draws."""
        mine = self.errors[getattr(graph.columns(), family)]
        return np.asarray(mine.reshape(*getattr(graph.counts(), family), mine.shape[1]))


def draws_of(
    graph: GraphLayout, factors: Sequence[LinearFactors], root: EliminatedGraph | EliminatedCrowd,
    draws: int | None = None,
) -> Draws:  # fmt: skip
    """Return draws for the factors of a graph and the root of their information; always the same.

    draws : their number; None for `DRAWS`, or fewer for a graph with many states.
    """
    rows = graph.rows or 1
    draws = draws or int(np.clip(_DRAWN_ROWS // rows, _FEWEST_DRAWS, DRAWS))
    at_once = max(1, _ROWS_AT_ONCE // rows)
    rng, parts = np.random.default_rng(0), list[Draws]()
    for done in range(0, draws, at_once):
        parts.append(_drawn(graph, factors, root, min(at_once, draws - done), rng))
    each = zip(*((p.errors, p.pixels, p.marks, p.encoder) for p in parts))
    return Draws(*(np.concatenate(some, -1) for some in each))


def _drawn(
    graph: GraphLayout, factors: Sequence[LinearFactors], root: EliminatedGraph | EliminatedCrowd,
    count: int, rng: Generator,
) -> Draws:  # fmt: skip
    """Draw errors and residuals; the root is refined, since A^T A alone has too few digits."""
    noise = [rng.standard_normal((*f.rhs.shape, count)) for f in factors]
    starts = starts_of(graph)
    errors, left = np.zeros((int(starts[-1]), count)), noise
    for _ in range(1 + _REFINEMENTS):
        errors += root.solved(transposed_product(factors, starts, left))
        fitted = product(factors, starts, errors)
        left = [np.subtract(whole, part, out=part) for whole, part in zip(noise, fitted)]
    pixels, marks, readings = (
        [rest for linear, rest in zip(factors, left) if linear.kind == kind]
        for kind in (PIXELS, MARKS, ENCODER)
    )
    return Draws(
        errors, _by_camera(graph.problem.observations, pixels),
        _by_camera(graph.problem.references, marks),
        np.concatenate([np.zeros((0, count)), *(rest[:, 0] for rest in readings)]),
    )  # fmt: skip


def _by_camera(obs: Observations, parts: Sequence[Array]) -> Array:
    """Merge the residuals of each camera into those of all pixels (M, 2, K)."""
    if not parts:
        return np.zeros((0, 2, 0))
    out = np.empty((len(obs), *parts[0].shape[1:]))
    for camera, part in zip(np.unique(obs.camera), parts, strict=True):
        out[obs.camera == camera] = part
    return out
