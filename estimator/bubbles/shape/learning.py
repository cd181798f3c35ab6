"""Learns from a run how its bubbles deviate from spheroids, and their outlines from ellipses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.bubbles.shape.shapes import DEFAULT_SHAPES, Shapes, degree_variance
from telerig.estimator.bubbles.shape.sightings import Sightings
from telerig.estimator.bubbles.shape.spheroid import fit_spheroid, misfit, oblate, starts, unusual
from telerig.estimator.bubbles.shape.views import Views, grouped
from telerig.rig.camera import Camera

_DEFAULT_WEIGHT, _DEFAULT_TRIAXIAL_WEIGHT = 0.05, 1.0
"""In bodies, of `DEFAULT_SHAPES` in what a run tells."""
_LARGEST_SIGMA = 0.03  # one bubble's share in what a run tells
_LEAST_FOR_LEARNING, _MOST_FOR_LEARNING = 8, 4_000
_TRIM, _TRIMMED = 0.02, 0.873
"""Share of squares that is left out, and the mean of the others for normal errors."""


def learn_shapes(sightings: Sightings, seen: Ints, cameras: Sequence[Camera], up: Array) -> Shapes:
    """Learn from a run how its bubbles deviate from spheroids, and their outlines from ellipses.

    Empirical Bayes, with `DEFAULT_SHAPES` as a weak prior. The mean squares of the third and fourth
    harmonics minus their noise give ``third`` and ``fourth``. What no ellipsoid explains of the
    outlines' second moments shows the errors of outlines alone (``excess``); the remaining misfit
    of spheroids then gives ``triaxial`` (method of moments).

    seen, up : as for `fit_bodies`. At most 4,000 bodies are used, evenly spread.
    """
    some = np.linspace(0, len(seen) - 1, min(len(seen), _MOST_FOR_LEARNING)).astype(int)
    groups = []
    for rows, used in grouped(sightings, seen[some]):
        views = Views.of(sightings.take(seen[some][np.ix_(rows, used)]), [cameras[c] for c in used])
        groups.append(views.take(views.inside() & views.sightings.all_entire))
    third, fourth = (_learned_sigma([g.sightings for g in groups], degree) for degree in (3, 4))
    groups = [g for g in groups if len(g.noise)]
    count = sum(len(g.noise) for g in groups)
    known = replace(DEFAULT_SHAPES, third=third, fourth=fourth, bodies=count)
    if count < _LEAST_FOR_LEARNING:
        return known
    excess2 = _excess_variance(*map(np.concatenate, zip(*(g.misfit_squares() for g in groups))))
    excess = max(float(np.sqrt(excess2)), DEFAULT_SHAPES.excess)
    # a prolate body on its side would explain any t of an upright one
    parts = [_spheroid_squares(g, replace(known, excess=excess), up) for g in groups]
    variance = _excess_variance(*map(np.concatenate, zip(*parts)))
    default = _DEFAULT_TRIAXIAL_WEIGHT * DEFAULT_SHAPES.triaxial**2
    triaxial2 = (variance * count + default) / (count + _DEFAULT_TRIAXIAL_WEIGHT)
    return replace(known, excess=excess, triaxial=float(np.sqrt(max(triaxial2, 1e-6))))


def _learned_sigma(groups: Sequence[Sightings], degree: int) -> float:
    """Return the sd of the coefficients of one degree, from the whole outlines of each body."""
    default = getattr(DEFAULT_SHAPES, "third" if degree == 3 else "fourth")
    some = [g.take(g.whole.any(-1)) for g in groups]
    variance = [
        np.average(degree_variance(g, degree), axis=-1, weights=g.whole)
        for g in some if len(g.camera)
    ]  # fmt: skip
    every = np.minimum(np.concatenate([np.zeros(0), *variance]), _LARGEST_SIGMA**2)
    total = max(every.sum(), 0.0) + _DEFAULT_WEIGHT * default**2
    return float(np.sqrt(total / (len(every) + _DEFAULT_WEIGHT)))


def _excess_variance(squares: Array, expected: Array, gain: Array) -> float:
    """Return the s >= 0 for which squares (M,) have the means expected + gain s.

    Squares are weighted by the inverse of their variance. The largest 2 % are left out, because
    wrong groups and covered outlines cause them.
    """
    excess = 0.0
    for _ in range(20):
        total = expected + gain * excess
        kept = squares / total <= np.quantile(squares / total, 1 - _TRIM)
        weight = np.where(kept, gain / total**2, 0.0)
        mean = (weight * squares).sum() / _TRIMMED
        excess = max(float((mean - (weight * expected).sum()) / (weight * gain).sum()), 0.0)
    return excess


def _spheroid_squares(views: Views, shapes: Shapes, up: Array) -> tuple[Array, Array, Array]:
    """Return chi-squares (B,) of spheroids, their expectation, and its slope by the variance of
    t."""
    weight = views.precision(shapes.excess)
    fits = oblate([fit_spheroid(views, start, weight, 1e-5) for start in starts(views)])
    misfits = [misfit(views, f, weight) for f in fits]
    better = np.argmin([m[0] + unusual(f, up) for m, f in zip(misfits, fits)], 0)
    chi2, gain = (np.choose(better, [m[i] for m in misfits]) for i in range(2))
    return chi2, np.full(len(chi2), 3.0 * views.count - 4.0), gain
