"""Tests how sensors are mounted.

The regression is that of the clocks (see ``alignment``). Every mounting, the stated one or another,
is a hypothesis about its coefficients; axes and exchanged records are compared by likelihood.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.accelerations import of_positions, of_readings
from telerig.estimator.sensors.alignment import (
    LEAST_SAMPLES,
    beyond_chance,
    effective_size,
    filtered,
    whitening_filter,
)
from telerig.estimator.sensors.findings import Finding
from telerig.estimator.sensors.given import Sensor
from telerig.estimator.sensors.gravity import Gravity, axes_remedy, signed_permutations
from telerig.estimator.sensors.image_motion import frame_grid

_SHIFTS = 24
LEAST_BESIDE = 2.0
"""Least log-likelihood ratio by the images of axes that other sensors, too, find clearly better."""


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


def mounting(
    axes: Array, gravity: Gravity, up: Array, x: Array, known: Bools, expected: Sequence[Expected]
) -> Mounting:
    """Return the axes of a sensor that agree best with gravity and expected motion.

    All signed permutations of the stated axes are compared, by what is whole alone if the stated
    ones agree with gravity. Those that fit it better, be it by little, are clearly better if the
    rest says so: a short record of one bubble hardly shows axes, and two sensors that disagree do
    not tell which of them is wrong.

    axes : (3, 3) stated direction of each of the sensor's axes.
    gravity : reading at rest, which has to point along up (3,).
    x : (n, 3) readings on the time grid of the expected accelerations.
    known : (n,) whether there is a reading.
    expected : the accelerations that the sensor should measure.
    """
    turned = np.swapaxes(signed_permutations(), -1, -2) @ axes
    upright = gravity.allows(turned, up)
    if not upright.any():
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


def check_motion(
    sensor: Sensor, t_s: Array, position_mm: Array, axis: Array, up: Array
) -> list[Finding]:
    """Return a warning if other axes than stated fit the carriage's acceleration clearly better.

    Gravity has to allow the stated axes; it tells all but the horizontal ones.

    t_s, position_mm : (E,) of the encoder. axis, up : (3,) of the travel, and against gravity.
    """
    grid = frame_grid(t_s, 0.0, None)
    if sensor.clock != "frames" or sensor.unused_axes or grid.count < 8 * grid.knots:
        return []
    carriage, frames = of_positions(grid, t_s, position_mm[:, None]), grid.at_frame
    felt = of_readings(grid, sensor.t_s, 1e3 * sensor.reading_m_s2)
    if felt.grid.count < 2:
        return []
    expected = Expected(axis, carriage.values[frames, 0], carriage.known[frames])
    gravity = Gravity.of(sensor.reading_m_s2)
    found = mounting(sensor.axes, gravity, up, *felt.at(grid.t_s[frames]), [expected])
    if not found.clear:
        return []
    words = "with its axes as stated, it does not feel the acceleration that the encoder shows"
    return [Finding(words, sensor.where, axes_remedy(sensor.name, found.axes)[0])]


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
        if np.count_nonzero(known) < LEAST_SAMPLES:
            return None
        y, x = values - values[known].mean(), x - x[known].mean(0)
        rest = y[known] - x[known] @ np.linalg.lstsq(x[known], y[known], rcond=None)[0]
        whole, used = filtered(np.column_stack([y, x]), known, whitening_filter(rest))
        if np.count_nonzero(used) < LEAST_SAMPLES:
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
