"""How much better "a measurement shows a predicted bubble" explains both than "each by itself".

A measurement is a point in space, of several cameras or of one (a point of unknown depth). The
evidence is the density of the innovation and the ratio of the sizes. Groups take the tracks into
account by it, tracks their measurements, and smoothed tracks what was missed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from telerig.arrays import Array, Bools, Ints, Rows

GATE_PROBABILITY = 0.9999
"""Probability that the measurement of a predicted bubble lies inside the gate."""

DETECTION_PROBABILITY = 0.95
"""Probability that a bubble that is there is detected."""

SIZE_SD = 0.05
"""Relative standard deviation of the diameter of one body from frame to frame."""

_SIZE_CAP = 4.5
"""Largest penalty (log-likelihood ratio) of a wrong size: outlines may be cut or merged."""

_SIZE_SPAN_MM = 5.0
"""Range of diameters of bubbles that nothing predicts."""

_LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Prediction(Rows):
    """Hold where K tracks are expected in a frame.

    ids : (K,) numbers of the tracks.
    points_mm, covariance_mm2 : (K, 3) expected positions in the rig frame (mm) and their (K, 3, 3)
        covariances (mm^2).
    d_eq_mm : (K,) equivalent diameters of the bubbles (mm).
    """

    ids: Ints
    points_mm: Array
    covariance_mm2: Array
    d_eq_mm: Array


@dataclass(frozen=True)
class Evidence(Rows):
    """Hold E pairings of predicted bubbles with measurements, all inside the gate.

    row, column : (E,) index of the prediction and index of the measurement.
    innovation_mm : (E, 3) measured minus predicted position, without the shift common to all
        bubbles.
    covariance_mm2 : (E, 3, 3) covariance of the innovation.
    information : (E, 3, 3) inverse of the covariance, in 1/mm^2.
    constant : (E,) log-likelihood (density per mm^3) without the part that depends on the distance.
    """

    row: Ints
    column: Ints
    innovation_mm: Array
    covariance_mm2: Array
    information: Array
    constant: Array

    def distance2(self, shift_mm: Array) -> Array:
        """Return the squared Mahalanobis distances (E,) without the common shift (3,)."""
        left = self.innovation_mm - shift_mm
        return np.asarray(np.einsum("ei,eij,ej->e", left, self.information, left))

    def scores(self, shift_mm: Array) -> Array:
        """Return the log-likelihoods (E,) without the common shift (3,)."""
        return self.constant - self.distance2(shift_mm) / 2


def gate2(dimensions: int) -> float:
    """Return the largest squared Mahalanobis distance inside the gate."""
    return float(chdtri(dimensions, 1 - GATE_PROBABILITY))


_GATE2 = gate2(3)


def evidence(
    predicted: Prediction,
    points_mm: Array,
    covariance_mm2: Array,
    d_eq_mm: Array,
    *,
    allowed: Bools | bool = True,
    certain: Bools | bool = False,
    shift_mm: Array | float = 0.0,
    unsure_mm2: Array | float = 0.0,
    size_sd: float = SIZE_SD,
) -> Evidence:
    """Return the pairings of K predicted bubbles with M measurements that lie inside the gate.

    points_mm, covariance_mm2, d_eq_mm : (M, 3), (M, 3, 3), (M,) measured; NaN for unknown sizes.
    allowed : (K, M) which pairings may be made.
    certain : (M,) measurements that are paired at any distance.
    shift_mm, unsure_mm2 : (3,), (3, 3) the shift that all bubbles share, for the gate alone.
    size_sd : relative standard deviation of the diameters.
    """
    from telerig.estimator.bubbles.pairing import kernels

    many = len(points_mm)
    floats = (
        predicted.points_mm + shift_mm, predicted.covariance_mm2,
        np.broadcast_to(unsure_mm2, (3, 3)), points_mm, covariance_mm2,
    )  # fmt: skip
    expected, spread, unsure, points, noise = (np.ascontiguousarray(v, float) for v in floats)
    row, column, innovation, covariance, information, log_det = kernels.inside_gate(
        expected, spread, unsure, points, noise,
        np.ascontiguousarray(np.broadcast_to(allowed, (len(predicted.ids), many)), bool),
        np.ascontiguousarray(np.broadcast_to(certain, many), bool), _GATE2,
    )  # fmt: skip
    constant = -1.5 * _LOG_2PI - log_det / 2
    constant += _size_ratio(predicted.d_eq_mm[row], d_eq_mm[column], size_sd)
    return Evidence(row, column, innovation + shift_mm, covariance, information, constant)


def _size_ratio(expected_mm: Array, measured_mm: Array, relative_sd: float) -> Array:
    """Return the log-likelihood ratio of sizes against a uniform density; 0 if unknown."""
    sd = relative_sd * expected_mm
    off = np.minimum(((measured_mm - expected_mm) / sd) ** 2 / 2, _SIZE_CAP)
    score = np.log(_SIZE_SPAN_MM / sd) - _LOG_2PI / 2 - off
    return np.where(np.isfinite(score), score, 0.0)
