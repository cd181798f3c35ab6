"""How pixels, and samples of accelerometers, that do not fit lose their weight between passes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.smoothing.graph.linear import SampleWeights
from telerig.factors.robust_loss import truncation_weights
from telerig.statistics import robust_sd

_OUTLIER_SIGMAS, _SUSPICIOUS_SIGMAS, _FALSE_ALARMS = 4.0, 5.0, 0.05
_LEAST_KEPT = 0.7
"""Share of the pixels; if more do not fit, it is the motion that the priors do not allow."""
_SAMPLE_OUTLIER, _SAMPLE_SUSPICIOUS, _BACK = 12.0, 20.0, 0.9
"""Residuals of samples, in units of their own standard deviation (docs/decisions/028)."""
_PEAK_SAMPLES, _DISPUTED = 8, 3
_LEAST_SAMPLES_KEPT = 0.95
_MOST_ROUNDS, _LEAST_SCALE = 5, 1e-9


class Truncation:
    """Truncated least squares by graduated non-convexity (Yang et al., RA-L 5:1127, 2020).

    Nothing is touched as long as no residual is suspicious: larger than those of normal noise are,
    but for one in twenty runs, however many pixels these have.
    """

    def __init__(self, wanted: bool) -> None:
        self.wanted, self.control = wanted, 0.0

    def update(
        self, weights: tuple[Array, Array], residuals: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], bool]:
        """Return the new weights, and whether they have changed.

        weights : (M,) and (R,), of the bubbles' and the marks' pixels.
        residuals : (M, 2) and (R, 2), whitened.
        """
        squares = [(r**2).sum(-1) for r in residuals]
        largest = max((float(s.max(initial=0.0)) for s in squares), default=0.0)
        bound, count = _OUTLIER_SIGMAS**2, sum(map(len, squares))
        # of two components the square exceeds s with probability exp(-s / 2)
        suspicious = max(_SUSPICIOUS_SIGMAS**2, 2 * np.log(max(count, 1) / _FALSE_ALARMS))
        if not self.wanted or (self.control == 0 and largest < suspicious):
            return weights, False
        if self.control == 0:
            self.control = bound / max(2 * largest - bound, bound)
        else:
            self.control *= 4
        fresh = tuple(truncation_weights(s, bound, self.control) for s in squares)
        if self.control > 1 and any(len(w) and w.mean() < _LEAST_KEPT for w in fresh):
            # so many cannot be outliers: it is the motion that the priors do not allow
            self.wanted = False
            fresh = tuple(np.ones_like(w) for w in weights)
        change = max(float(np.abs(a - b).max(initial=0.0)) for a, b in zip(fresh, weights))
        return (fresh[0], fresh[1]), change > 1e-3

    def decided(
        self, weights: tuple[Array, Array], residuals: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """Return weights of 0 and 1 where the passes have ended before those of `update` are."""
        if not self.wanted or self.control == 0:
            return weights
        bubbles, marks = ((r**2).sum(-1) < _OUTLIER_SIGMAS**2 for r in residuals)
        return bubbles.astype(float), marks.astype(float)


class SampleRejection:
    """Rejects single samples of accelerometers that the other measurements contradict.

    The fit follows most of each sample's noise, and a wrong sample moves its neighbours' residuals,
    too. So limits are in units of the residuals' own standard deviation s, and in each pass only
    the samples whose residuals are local maxima lose their weight. One that is not used has a
    standard deviation of 1 / s instead, and is taken back if it fits. Nothing is touched as long
    as no residual is suspicious. Where several samples near each other go, two sensors contradict
    each other, and the other one may be wrong: then none is used.

    t_s : times (N,) of each sensor's samples.
    rounds : number of passes in which weights have changed.
    """

    def __init__(self, wanted: bool, t_s: Sequence[Array]) -> None:
        self.wanted, self.t_s, self.rounds = wanted, t_s, 0
        self.usable: dict[int, Bools] = {}
        self.motion: set[int] = set()
        self.disputed_s: list[tuple[float, float]] = []

    def update(
        self, weights: SampleWeights, residuals: tuple[Array, ...]
    ) -> tuple[SampleWeights, bool]:
        """Return the new weights, and whether they have changed.

        residuals : (N, k) of each sensor, whitened.
        """
        if not self.wanted or self.rounds >= _MOST_ROUNDS:
            return weights, False
        fresh = tuple(self._of(i, w, r) for i, (w, r) in enumerate(zip(weights, residuals)))
        if len(fresh) > 1:
            self._dispute(fresh)
            fresh = tuple(map(self._without_disputed, fresh, self.t_s))
        changed = any(a is not b for a, b in zip(fresh, weights))
        self.rounds += changed
        return fresh, changed

    def _of(self, sensor: int, weight: Array | None, residual: Array) -> Array | None:
        """Return the weights of one sensor, the same object if they are unchanged."""
        from scipy.ndimage import maximum_filter1d

        size = np.sqrt((residual**2).sum(-1))
        scale = max(float(robust_sd(residual)), _LEAST_SCALE)
        used = np.ones(len(size), bool) if weight is None else weight > 0.5
        if sensor not in self.usable:
            if sensor in self.motion or not np.any(size[used] > _SAMPLE_SUSPICIOUS * scale):
                return weight
            self.usable[sensor] = used
        usable = self.usable[sensor]
        peak = size == maximum_filter1d(np.where(used, size, 0.0), 2 * _PEAK_SAMPLES + 1)
        out = used & peak & (size > _SAMPLE_OUTLIER * scale)
        back = usable & ~used & (size < _BACK * _SAMPLE_OUTLIER / min(scale, 1.0))
        fresh = (used & ~out) | back
        if fresh.sum() < _LEAST_SAMPLES_KEPT * usable.sum():
            # so many cannot be wrong: it is the motion that the priors do not allow
            del self.usable[sensor]
            self.motion.add(sensor)
            fresh = usable
        return weight if np.array_equal(fresh, used) else fresh.astype(float)

    def _dispute(self, weights: SampleWeights) -> None:
        """Note the times at which a sensor has lost several samples near each other."""
        for sensor, usable in self.usable.items():
            weight, t_s = weights[sensor], self.t_s[sensor]
            if weight is None:
                continue
            lost = np.flatnonzero(usable & (weight < 0.5) & ~self._disputed(t_s))
            near = 4 * _PEAK_SAMPLES
            for run in np.split(lost, np.flatnonzero(np.diff(lost) > near) + 1):
                if len(run) >= _DISPUTED:
                    ends = np.clip(run[[0, -1]] + [-_PEAK_SAMPLES, _PEAK_SAMPLES], 0, len(t_s) - 1)
                    self.disputed_s.append((float(t_s[ends[0]]), float(t_s[ends[1]])))

    def _disputed(self, t_s: Array) -> Bools:
        out = np.zeros(len(t_s), bool)
        for begin, end in self.disputed_s:
            out |= (t_s >= begin) & (t_s <= end)
        return out

    def _without_disputed(self, weight: Array | None, t_s: Array) -> Array | None:
        out = self._disputed(t_s)
        if not np.any(out if weight is None else out & (weight > 0.5)):
            return weight
        return np.where(out, 0.0, 1.0 if weight is None else weight)
