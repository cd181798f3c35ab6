"""Readings that lost bytes have changed and that still read like readings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

GAP_INTERVALS = 1.5
"""A step of more than so many usual ones is a gap."""
_SIDE = 8
_FAR = 5.0
"""Times the largest residual of its neighbours, from a parabola through them."""


def beside_gaps(t_s: Array, values: Sequence[Array]) -> Bools:
    """(N,) False for a reading next to a gap that lies far from what its neighbours foretell.

    Where bytes are lost two lines may become one that reads like a line: its stamp is right, its
    value is not, and the next reading is missing. Only readings beside a gap are looked at.
    """
    sound = np.ones(len(t_s), bool)
    step = np.diff(t_s)
    if step.size < 4 * _SIDE:
        return sound
    wide = np.flatnonzero(step > GAP_INTERVALS * np.median(step))
    suspects = np.unique(np.concatenate([wide, wide + 1]))
    plain = np.ones(len(t_s), bool)
    plain[suspects] = False
    for i in suspects:
        window = np.arange(max(i - 2 * _SIDE, 0), min(i + 2 * _SIDE + 1, len(t_s)))
        near = window[plain[window]]
        near = near[np.argsort(np.abs(t_s[near] - t_s[i]), kind="stable")[: 2 * _SIDE]]
        if len(near) > _SIDE:
            sound[i] = not any(_far(t_s[near] - t_s[i], v[near] - v[i]) for v in values)
    return sound


def _far(t_s: Array, value: Array) -> bool:
    """Whether 0 at 0 s does not go with these neighbours."""
    scale = float(np.max(np.abs(t_s)))
    powers = np.vander(t_s / scale, 3)
    found, *_ = np.linalg.lstsq(powers, value, rcond=None)
    residual = float(np.max(np.abs(powers @ found - value)))
    steps = np.diff(np.unique(value))
    resolution = float(np.min(steps)) if steps.size else 0.0
    return bool(abs(found[-1]) > _FAR * max(residual, resolution) + 1e-9)
