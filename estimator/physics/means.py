"""Means of a property of a bubble's body over its frames, and their standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from telerig.arrays import Array


@dataclass(frozen=True)
class Lasting:
    """What a run tells of errors that all frames of a bubble have.

    share : how much of the variance is left in a mean of what neither the outlines' own noise nor
        known second-order terms cause (`LastingShare`); 1 if it is not known.
    scale : relative standard deviation of lengths by the calibration, 0 if it is not known.
    """

    share: float = 1.0
    scale: float = 0.0

    @staticmethod
    def of(shapes: Mapping[str, float] | None) -> Lasting:
        """Return it from ``shapes`` of tracking.json or ``bodies`` of smoothing.json."""
        known = shapes or {}
        return Lasting(known.get("lasting_share", 1.0), known.get("scale_sd", 0.0))


SD = {"d_eq_mm": "sd_eq_mm", "aspect": "s_aspect", "tilt_deg": "s_tilt_deg"}
"""Columns of the standard deviations."""
_PARTS = {"d_eq_mm": "eq_mm", "aspect": "aspect"}


def mean_of_body(rows: pd.DataFrame, name: str, lasting: Lasting) -> tuple[float, float]:
    """Return the mean over a bubble's frames of a property of its body, and its standard deviation.

    It is the error of the mean over these frames, during which the property itself may change.

    rows : rows of bubbles.csv or tracks.csv of one bubble.
    name : one of `SD`.

    The outlines' own noise averages out over the frames, as independent errors do. What is fixed
    (the effect of modes on the rims, second-order terms of the unseen shape) does not, nor does
    the calibration's error of lengths. Of the rest a share is left, which the run tells. Where the
    parts are not known, and of the tilt, all of the stated variance counts as fixed.
    """
    value, sd = rows[name].to_numpy(float), rows[SD[name]].to_numpy(float)
    good = np.isfinite(value) & np.isfinite(sd)
    if not good.any():
        return float("nan"), float("nan")
    mean, count = float(value[good].mean()), int(good.sum())
    variance = sd[good] ** 2
    noise, fixed = (_part(rows, prefix, name)[good] ** 2 for prefix in ("noise", "fixed"))
    known = np.isfinite(noise) & np.isfinite(fixed)
    noise, fixed = np.where(known, noise, 0.0), np.where(known, fixed, variance)
    rest = np.maximum(variance - noise - fixed, 0.0).mean()
    total = noise.mean() / count + fixed.mean() + max(lasting.share, 1 / count) * rest
    if name.endswith("_mm"):
        total += (lasting.scale * mean) ** 2
    return mean, float(np.sqrt(total))


def _part(rows: pd.DataFrame, prefix: str, name: str) -> Array:
    column = f"{prefix}_{_PARTS.get(name)}"
    return rows[column].to_numpy(float) if column in rows else np.full(len(rows), np.nan)
