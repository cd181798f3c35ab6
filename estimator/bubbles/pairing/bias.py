"""The systematic part of the gaps: a constant, or smooth in space where pairs left out agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.bubbles.pairing.types import PairModel

Array = NDArray[np.float64]

TERMS = (1, 4, 10)
PAIRS_PER_TERM = 3.0
BETTER = 0.95
AS_MANY = 0.95
_PRIOR_SD_PX = (10.0, 2.0, 1.0)
_PRIOR_SCATTER_PX, _PRIOR_PAIRS, _SMALLEST_PX = 0.3, 2.0, 0.02


def fit_bias(
    model: PairModel,
    points_mm: Array,
    gap_px: Array,
    variance_px2: Array,
    doubt: Array,
    weight: Array,
    terms: int,
) -> PairModel:
    """Bias, its covariance and the scatter from likely pairs; all arrays have one row per pair.

    terms : 1, 4 or 10, see `PairModel`.  weight : probability of the pair.
    Tails are tempered as of Student's t with 8 degrees.
    """
    if weight.sum() < 0.5:
        return model
    reach = np.maximum(3 * np.sqrt(np.average((points_mm - model.origin_mm) ** 2, 0, weight)), 1e-3)
    model = replace(model, reach_mm=np.maximum(reach / 1.5, 0.1 * reach.max()))
    constant = _fit(model, points_mm, gap_px, variance_px2, doubt, weight, 1)
    best = constant
    if terms > 1:
        best = _fit(model, points_mm, gap_px, variance_px2, doubt, weight, terms)
    raw, middle = constant.rms_px[0], constant.rms_px[2]
    mean = (float(constant.bias_px[0]), float(np.sqrt(constant.bias_covariance_px2[0, 0])))
    return replace(best, mean_gap_px=mean, rms_px=(raw, middle, best.rms_px[2], best.rms_px[3]))


def better(trial: PairModel, best: PairModel) -> bool:
    """Whether a richer bias predicts pairs left out of it better, with no fewer pairs."""
    fewer = trial.pairs < AS_MANY * best.pairs
    return not fewer and trial.rms_px[3] < BETTER * best.rms_px[3]


def _fit(
    model: PairModel,
    points_mm: Array,
    gap_px: Array,
    variance_px2: Array,
    doubt: Array,
    weight: Array,
    terms: int,
) -> PairModel:
    basis = model.basis(points_mm, terms)
    prior = (
        np.array([_PRIOR_SD_PX[0]] + [_PRIOR_SD_PX[1]] * 3 + [_PRIOR_SD_PX[2]] * 6)[:terms] ** -2
    )
    scatter = model.scatter_px
    bias = np.zeros(terms)
    bias[0] = model.bias_px[0]
    residual = gap_px - basis @ bias
    covariance: Array = np.zeros((terms, terms))
    tempered = influence = weight
    for _ in range(8):
        own = variance_px2 + (scatter * doubt) ** 2
        tempered = weight * 9 / (8 + residual**2 / own)
        influence = tempered / own
        covariance = np.asarray(np.linalg.inv((basis.T * influence) @ basis + np.diag(prior)))
        bias = covariance @ (basis.T @ (influence * gap_px))
        residual = gap_px - basis @ bias
        lost = np.einsum("ni,ij,nj->n", basis, covariance, basis)
        excess = (tempered * (residual**2 + lost - variance_px2) / doubt**2).sum()
        prior_squares = _PRIOR_PAIRS * _PRIOR_SCATTER_PX**2
        free = weight.sum() + _PRIOR_PAIRS
        scatter = float(np.sqrt(max((excess + prior_squares) / free, _SMALLEST_PX**2)))
    leverage = np.minimum(influence * np.einsum("ni,ij,nj->n", basis, covariance, basis), 0.95)
    rms = [
        float(np.sqrt(np.average(r**2, weights=tempered)))
        for r in (gap_px, residual, residual / (1 - leverage))
    ]
    return replace(
        model, bias_px=bias, bias_covariance_px2=covariance, scatter_px=scatter,
        rms_px=(rms[0], rms[1], rms[1], rms[2]),
    )  # fmt: skip
