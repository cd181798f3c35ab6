"""Is anything left in the residuals? Tests of their places in the image and of neighbours.

Residuals of a right model are independent, with mean zero everywhere.
Each is first brought to unit variance with the share of noise that the fit absorbs (the hat
matrix). The correlations that the fit causes make the tests slightly conservative.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtrc, ndtr

from telerig.arrays import Array, Ints
from telerig.estimator.calibration.solver.problem import Problem
from telerig.io.results.findings import Code, Finding

CELLS = 4
LEAST_IN_CELL = 5
_LEAST_DOTS = 3


@dataclass(frozen=True)
class ResidualTest:
    """The result of one test of a camera's residuals.

    code : of the finding if the test objects.
    size : size of the effect: for PATTERN the RMS of the mean residuals in parts of the image, in
        standard deviations of a residual; for NEIGHBOURS a correlation.
    p_value : probability that chance alone gives an effect at least as large.
    numbers : of the finding.
    """

    code: Code
    camera: str
    size: float
    p_value: float
    numbers: dict[str, float]


def residual_tests(
    problem: Problem, whitened: Array, leverage: Array
) -> tuple[dict[str, Any], list[Finding]]:
    """Test whether the residuals of a calibration have any structure left.

    whitened : (M, 2) whitened residuals in the order of ``problem.observations()``. leverage : (M,
    2, 2) covariance of each whitened prediction, the share of the noise that the fit absorbs.
    Returns the content of `Calibration.diagnostics`, entry "structure", and the findings. The entry
    has "tests" (`ResidualTest`) and "widening" (of the standard deviations, see `_regions`; 1
    without a pattern in the image).
    """
    obs = problem.observations()
    standardised = standardised_residuals(whitened, leverage)
    tests: list[ResidualTest] = []
    for c, camera in enumerate(problem.cameras):
        mine = obs.camera == c
        if mine.sum() < 2 * LEAST_IN_CELL:
            continue
        values, uv = standardised[mine], obs.uv_px[mine]
        free = len(problem.free[c])
        tests.append(_regions(camera.name, values, uv, camera.image_size_px, free))
        tests.append(_neighbours(camera.name, values, uv, obs.view[mine]))
    objecting = [t for t in tests if t.p_value < t.code.limit / len(problem.cameras)]
    widening = max((t.numbers.get("widening", 1.0) for t in objecting), default=1.0)
    findings = [
        t.code.found(t.numbers | {"widening": widening}, cameras=t.camera) for t in objecting
    ]
    rows = [
        {"code": t.code.name, "camera": t.camera, "size": t.size, "p_value": t.p_value}
        for t in tests
    ]
    return {"tests": rows, "widening": widening}, findings or [Code.NO_STRUCTURE.found()]


def standardised_residuals(whitened: Array, leverage: Array) -> Array:
    """Return residuals (M, 2) of unit variance.

    They are the whitened residuals multiplied by (identity - leverage)^(-1/2). A component of which
    the fit absorbs more than 98 % is set to 0.

    whitened, leverage : as for `residual_tests`.
    """
    left = np.eye(2) - leverage
    values, vectors = np.linalg.eigh(0.5 * (left + np.swapaxes(left, -1, -2)))
    scale = np.where(values > 0.02, 1 / np.sqrt(np.maximum(values, 0.02)), 0.0)
    return np.asarray(np.einsum("mij,mj,mkj,mk->mi", vectors, scale, vectors, whitened))


def _regions(
    camera: str, values: Array, uv_px: Array, size_px: tuple[int, int], parameters: int
) -> ResidualTest:
    """Test whether residuals (M, 2) point the same way in a part of the image (lens model).

    The square of "widening" is the design effect (Kish, Survey Sampling, 1965): the variance of the
    means over the cells, over that of independent residuals. A smooth error of the lens model that
    has as much power in the degrees of freedom that the lens ``parameters`` absorb shifts these by
    so much more than independent errors of the dots would.
    """
    cell = np.clip((uv_px + 0.5) / np.array(size_px) * CELLS, 0, CELLS - 1).astype(int)
    index = cell[:, 1] * CELLS + cell[:, 0]
    count = np.bincount(index, minlength=CELLS**2)
    sums = np.stack([np.bincount(index, v, minlength=CELLS**2) for v in values.T], -1)
    full = count >= LEAST_IN_CELL
    if not full.any():
        return ResidualTest(Code.PATTERN, camera, 0.0, 1.0, {})
    mean = sums[full] / count[full, None]
    squares = float((count[full, None] * mean**2).sum())
    p = float(chdtrc(2 * full.sum(), squares))
    effect = squares / max(2 * int(full.sum()) - parameters, 1)
    lengths = np.hypot(*mean.T)
    worst = np.flatnonzero(full)[int(lengths.argmax())]
    row, column = divmod(int(worst), CELLS)
    size = float(np.sqrt((mean**2).mean()))
    numbers = {
        "row": row + 1, "column": column + 1, "cells": CELLS, "largest_sd": float(lengths.max()),
        "widening": max(float(np.sqrt(effect)), 1.0),
    }  # fmt: skip
    return ResidualTest(Code.PATTERN, camera, size, p, numbers)


def _neighbours(camera: str, values: Array, uv_px: Array, view: Ints) -> ResidualTest:
    """Do residuals of neighbours correlate more than those of any two dots of that image?"""
    from scipy.spatial import cKDTree

    near, expected, spread = [], [], []
    for v in np.unique(view):
        rows = np.flatnonzero(view == v)
        if len(rows) < _LEAST_DOTS:
            continue
        r = values[rows]
        n = len(rows)
        _, other = cKDTree(uv_px[rows]).query(uv_px[rows], k=2)
        nearest = np.asarray(other)[:, 1]
        products = (r * r[nearest]).sum(-1)
        squares = (r**2).sum(-1)
        near.append(products.mean())
        expected.append(((r.sum(0) ** 2).sum() - squares.sum()) / (n * (n - 1)))
        spread.append(2.0 * 1.5 / n)  # unit variances; mutual neighbours count twice
    if not near:
        return ResidualTest(Code.NEIGHBOURS, camera, 0.0, 1.0, {})
    excess = float(np.mean(np.subtract(near, expected)))
    sd = float(np.sqrt(np.sum(spread)) / len(spread))
    p = float(ndtr(-excess / sd))
    return ResidualTest(Code.NEIGHBOURS, camera, excess / 2, p, {"correlation": excess / 2})
