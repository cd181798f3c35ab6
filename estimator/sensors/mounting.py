"""Tests how sensors are mounted.

The regression is that of the clocks (see ``alignment``). Every mounting, the stated one or another,
is a hypothesis about its coefficients; axes and exchanged records are compared by likelihood.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import permutations, product

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.alignment import (
    beyond_chance,
    effective_size,
    filtered,
    whitening_filter,
)

_SHIFTS = 24
_UPRIGHT_DEG = 30.0
LEAST_BESIDE = 2.0
"""Least log-likelihood ratio by the images of axes that other sensors, too, find clearly better."""
_LEAST_SAMPLES = 60


@dataclass(frozen=True)
class Expected:
    """An acceleration that a sensor should measure, by images, encoder or other sensors.

    direction : (3,) unit vector in the rig frame.
    values : (n,) acceleration in mm/s^2 along it.
    known : (n,) whether it is known.
    whole : whether it is the sensor's complete acceleration along the direction. For an arm that of
        the stage or of another arm is not, nor for the stage that of an arm: beyond its resonance
        an arm moves in the opposite direction. By itself it only tells which axes replace stated
        ones that gravity excludes.
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
    """

    axes: Array
    clear: bool
    lead: float


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
    """Return the axes of a sensor that agree best with gravity and expected motion.

    All signed permutations of the stated axes are compared, by what is whole alone if the stated
    ones agree with gravity. Those that fit it better, be it by little, are clearly better if the
    rest says so: a short record of one bubble hardly shows axes, and two sensors that disagree do
    not tell which of them is wrong.

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
    fits = [(f, r) for f in expected if (r := Regression.of(f.values, f.known & known, x))]
    judging = [(f, r) for f, r in fits if f.whole or not len(stated)]
    if not judging:
        found = axes if len(stated) else candidates[0]
        return Mounting(found, not len(stated), 0.0)
    score = _scores(judging, candidates)
    changes = np.abs(candidates - axes).sum((1, 2))
    best = int(np.lexsort((changes, -score))[0])
    if not len(stated):
        return Mounting(candidates[best], True, float("inf"))
    own = int(stated[0])
    lead, both = float(score[best] - score[own]), candidates[[best, own]]
    rest = [(f, r) for f, r in fits if not f.whole]
    clear = lead > 0 and is_clear(partial(_scores, judging, both))
    clear |= lead > LEAST_BESIDE and is_clear(partial(_scores, rest, both))
    return Mounting(candidates[best], clear, lead)


def _scores(fits: Sequence[tuple[Expected, Regression]], axes: Array, shift: float = 0.0) -> Array:
    """Return the log-likelihood ratio (h,) of each of h axes (h, 3, 3) to none."""
    each = [r.log_ratios(axes @ f.direction, shift) for f, r in fits]
    return np.asarray(np.sum(each, axis=0)) if each else np.zeros(len(axes))


def is_clear(log_ratios: Callable[[float], Array]) -> bool:
    """Return whether the first of two hypotheses is better than the second by more than chance.

    log_ratios : function from a shift of the readings, as a share of the record, to the
        log-likelihood ratios (2,) of both. How they differ at any shift but 0 is due to chance.
    """
    first, second = log_ratios(0.0)
    chance = max(float(np.ptp(log_ratios(s))) for s in np.linspace(0.1, 0.9, _SHIFTS))
    return beyond_chance(float(first - second), chance)


@dataclass(frozen=True)
class Regression:
    """Hold a measured acceleration and what explains it, both made white, without means.

    y, x : (n,), (n, k) of n samples.
    size : effective number of independent samples.
    """

    y: Array
    x: Array
    size: float

    @classmethod
    def of(cls, values: Array, known: Bools, x: Array) -> Regression | None:
        """Return the regression of values (N,) on x (N, k) by generalised least squares; None if
        too few of them are known (N,)."""
        if np.count_nonzero(known) < _LEAST_SAMPLES:
            return None
        y, x = values - values[known].mean(), x - x[known].mean(0)
        rest = y[known] - x[known] @ np.linalg.lstsq(x[known], y[known], rcond=None)[0]
        whole, used = filtered(np.column_stack([y, x]), known, whitening_filter(rest))
        if np.count_nonzero(used) < _LEAST_SAMPLES:
            return None
        y, x = whole[used, 0], whole[used, 1:]
        fit = x @ np.linalg.lstsq(x, y, rcond=None)[0]
        return cls(y, x, effective_size(y - fit, fit))

    def log_ratios(self, hypotheses: Array, shift: float = 0.0) -> Array:
        """Return the log-likelihood ratio (h,) of each hypothesis to none.

        hypotheses : (h, k) the measured acceleration is a multiple, not negative, of x times them.
        shift : by this share of the samples x is shifted.
        """
        shifted = np.roll(self.x, int(shift * len(self.x)), axis=0)
        predicted = hypotheses @ shifted.T
        gain = np.clip((predicted @ self.y) / np.maximum((predicted**2).sum(1), 1e-12), 0.0, None)
        rest = ((self.y - gain[:, None] * predicted) ** 2).sum(1)
        total = max(float(self.y @ self.y), 1e-12)
        return np.asarray(-0.5 * self.size * np.log(np.maximum(rest, 1e-12) / total))
