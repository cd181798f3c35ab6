"""Tests how sensors are mounted and in which unit they and the encoder read.

The regression is that of the clocks (see ``alignment``). The coefficients that follow from the
stated mounting and unit are compared with those of all other mountings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.alignment import effective_size, filtered, whitening_filter

CLEAR_LOG_RATIO = 8.0
_SHIFTS = 24
_CHANCE = 1.5
_UPRIGHT_DEG = 30.0
_SDS = 5.0
_USUAL_GAIN = (0.5, 2.0)
_LEAST_SAMPLES = 60


@dataclass(frozen=True)
class Expected:
    """An acceleration that a sensor should measure, by images, encoder or other sensors.

    direction : (3,) unit vector in the rig frame.
    values : (n,) acceleration in mm/s^2 along it.
    known : (n,) whether it is known.
    whole : whether it is the sensor's complete acceleration along the direction, which then gives
        the sensor's gain. That of the stage or of another arm is not: beyond its resonance an arm
        moves in the opposite direction. It only tells which axes replace stated ones that gravity
        excludes.
    """

    direction: Array
    values: Array
    known: Bools
    whole: bool = True


@dataclass(frozen=True)
class Mounting:
    """The orientation of a sensor that fits best.

    axes : (3, 3) whose rows are unit vectors in the rig frame.
    clear : whether they fit clearly better than the stated axes.
    lead : log-likelihood ratio of these axes to the stated ones.
    gain, gain_sd : reading divided by true acceleration, and its standard deviation; NaN and
        infinity if the images show no acceleration.
    """

    axes: Array
    clear: bool
    lead: float
    gain: float
    gain_sd: float

    @property
    def wrong_gain(self) -> bool:
        """Whether the gain differs from 1 by clearly more than any usual scale error."""
        inverse, sd = 1 / self.gain, self.gain_sd / self.gain**2
        clear = inverse > _SDS * sd and abs(inverse - 1) > _SDS * sd
        return bool(clear and not _USUAL_GAIN[0] < self.gain < _USUAL_GAIN[1])


def signed_permutations() -> Array:
    """Return all signed permutations of three axes (48, 3, 3), the identity first."""
    out = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return np.array(out)


def mounting(
    axes: Array, at_rest: Array, up: Array, x: Array, known: Bools, expected: Sequence[Expected]
) -> Mounting:
    """Return the axes and the gain of a sensor that agree best with gravity and expected motion.

    All signed permutations of the stated axes are compared, by what is whole alone if the stated
    ones agree with gravity.

    axes : (3, 3) stated direction of each of the sensor's axes.
    at_rest : (3,) mean reading, which has to point along up (3,).
    x : (n, 3) readings on the time grid of the expected accelerations.
    known : (n,) whether there is a reading.
    expected : the accelerations that the sensor should measure.
    """
    turned = np.swapaxes(signed_permutations(), -1, -2) @ axes
    forces = np.einsum("pij,i->pj", turned, at_rest)
    size = np.linalg.norm(forces, axis=1)
    upright = forces @ up > np.cos(np.radians(_UPRIGHT_DEG)) * size
    if not upright.any() or not size.max() > 0:
        upright[:] = True
    candidates = turned[upright]
    stated = np.flatnonzero(np.abs(candidates - axes).max((1, 2)) < 1e-9)
    judging = [f for f in expected if f.whole or not len(stated)]
    parts = [p for f in judging if (p := _Part.of(f, x, known)) is not None]
    if not parts:
        found = axes if len(stated) else candidates[0]
        return Mounting(found, not len(stated), 0.0, float("nan"), float("inf"))
    score = _scores(candidates, parts, 0)
    changes = np.abs(candidates - axes).sum((1, 2))
    best = int(np.lexsort((changes, -score))[0])
    gain, gain_sd = _gain(candidates[best], parts)
    if not len(stated):
        return Mounting(candidates[best], True, float("inf"), gain, gain_sd)
    own = int(stated[0])
    length = len(parts[0].x)
    shifts = np.linspace(0.1, 0.9, _SHIFTS) * length
    both = candidates[[best, own]]
    chance = [float(np.ptp(_scores(both, parts, int(s)))) for s in shifts]
    lead = float(score[best] - score[own])
    clear = best != own and lead > max(CLEAR_LOG_RATIO, _CHANCE * max(chance))
    return Mounting(candidates[best], bool(clear), lead, gain, gain_sd)


@dataclass(frozen=True)
class _Part:
    direction: Array
    y: Array
    x: Array
    size: float
    whole: bool

    @classmethod
    def of(cls, expected: Expected, x: Array, known: Bools) -> _Part | None:
        both = expected.known & known
        if np.count_nonzero(both) < _LEAST_SAMPLES:
            return None
        y, x = expected.values - expected.values[both].mean(), x - x[both].mean(0)
        rest = y[both] - x[both] @ np.linalg.lstsq(x[both], y[both], rcond=None)[0]
        whole, used = filtered(np.column_stack([y, x]), both, whitening_filter(rest))
        if np.count_nonzero(used) < _LEAST_SAMPLES:
            return None
        y, x = whole[used, 0], whole[used, 1:]
        fit = x @ np.linalg.lstsq(x, y, rcond=None)[0]
        return cls(expected.direction, y, x, effective_size(y - fit, fit), expected.whole)


def _scores(candidates: Array, parts: Sequence[_Part], shift: int) -> Array:
    """Return each candidate's log-likelihood ratio (p,) with its best gain, readings shifted."""
    total = np.zeros(len(candidates))
    for p in parts:
        x = np.roll(p.x, shift, axis=0)
        force = np.einsum("pij,j->pi", candidates, p.direction) @ x.T
        gain = np.clip((force @ p.y) / np.maximum((force**2).sum(1), 1e-12), 0.0, None)
        rest = ((p.y - gain[:, None] * force) ** 2).sum(1)
        total -= 0.5 * p.size * np.log(np.maximum(rest, 1e-12) / max(float(p.y @ p.y), 1e-12))
    return total


def _gain(axes: Array, parts: Sequence[_Part]) -> tuple[float, float]:
    """Return reading over true acceleration and its sd, over the parts that are whole."""
    weight = total = 0.0
    for p in (p for p in parts if p.whole):
        force = p.x @ (axes @ p.direction)
        square = float(force @ force)
        if square <= 0:
            continue
        ratio = float(force @ p.y) / square
        variance = float(((p.y - ratio * force) ** 2).mean()) / square * len(p.y) / p.size
        weight += 1 / max(variance, 1e-12)
        total += ratio / max(variance, 1e-12)
    if not weight or not total > 0:
        return float("nan"), float("inf")
    inverse, sd = total / weight, float(weight**-0.5)
    return 1 / inverse, sd / inverse**2


def preference(y: Array, known: Bools, stated: Array, other: Array) -> float:
    """Return by how much the log-likelihood of a measurement rises if it is of another motion.

    The measurement is fitted by generalised least squares as a multiple, not negative, of the
    prediction for the stated motion and of that for the other one. 0 if there are too few samples.

    y : (n,) samples of the measurement.
    known : (n,) which samples to use.
    stated, other : (n,) predictions of the samples from the stated and from the other motion.
    """
    if np.count_nonzero(known) < _LEAST_SAMPLES:
        return 0.0
    both = np.column_stack([y, stated, other])
    both = both - both[known].mean(0)
    x = both[known, 1:]
    rest = both[known, 0] - x @ np.linalg.lstsq(x, both[known, 0], rcond=None)[0]
    whole, used = filtered(both, known, whitening_filter(rest))
    if np.count_nonzero(used) < _LEAST_SAMPLES:
        return 0.0
    target, squares = whole[used, 0], []
    for x in whole[used, 1:].T:
        gain = max(float(x @ target) / max(float(x @ x), 1e-12), 0.0)
        left = target - gain * x
        squares.append((max(float(left @ left), 1e-12), effective_size(left, x)))
    size = min(size for _, size in squares)
    return 0.5 * size * float(np.log(squares[0][0] / squares[1][0]))
