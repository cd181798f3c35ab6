"""Robust weights of the pixels: what does not fit is left out, gently."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

OUTLIER_SIGMAS = 4.0
_SUSPICIOUS_SIGMAS = 5.0
_LEAST_KEPT = 0.7


class Truncation:
    """Truncated least squares by graduated non-convexity (Yang et al., RA-L 5:1127, 2020).

    Nothing is touched as long as no residual is suspicious.
    """

    def __init__(self, wanted: bool) -> None:
        self.wanted, self.control = wanted, 0.0

    def update(
        self, weights: tuple[Array, Array], residuals: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], bool]:
        """New weights, and whether they have changed."""
        squares = [(r**2).sum(-1) for r in residuals]
        largest = max((float(s.max(initial=0.0)) for s in squares), default=0.0)
        bound = OUTLIER_SIGMAS**2
        if not self.wanted or (self.control == 0 and largest < _SUSPICIOUS_SIGMAS**2):
            return weights, False
        if self.control == 0:
            self.control = bound / max(2 * largest - bound, bound)
        else:
            self.control *= 4
        fresh = tuple(_truncated(s, bound, self.control) for s in squares)
        if self.control > 1 and any(len(w) and w.mean() < _LEAST_KEPT for w in fresh):
            # so many cannot be outliers: it is the motion that the priors do not allow
            self.wanted = False
            fresh = tuple(np.ones_like(w) for w in weights)
        change = max(float(np.abs(a - b).max(initial=0.0)) for a, b in zip(fresh, weights))
        return (fresh[0], fresh[1]), change > 1e-3


def _truncated(squares: Array, bound: float, control: float) -> Array:
    """(M,) weights; control grows from near 0 (convex) to infinity (truncated)."""
    low, high = control / (control + 1) * bound, (control + 1) / control * bound
    if control > 1e3:
        return (squares <= bound).astype(float)
    between = np.sqrt(bound * control * (control + 1) / np.maximum(squares, 1e-12)) - control
    return np.where(squares <= low, 1.0, np.where(squares >= high, 0.0, np.clip(between, 0, 1)))
