"""Means of a property of a bubble's body over its frames, and their standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.estimator.bubbles.shape.shapes import DEFAULT_SHAPES
from telerig.estimator.bubbles.shape.spheroid import UNSEEN_SQUARE


@dataclass(frozen=True)
class Lasting:
    """What a run tells of errors that all frames of a bubble have.

    share : how much of the variance is left in a mean of what neither the outlines' own noise nor
        known second-order terms cause (`LastingShare`); 1 if it is not known.
    square : how much of the variance of the square of the unseen shape is left.
    scale : relative standard deviation of lengths by the calibration, 0 if it is not known.
    triaxial : standard deviation of the numbers t that describe the unseen shape.
    """

    share: float = 1.0
    square: float = 0.5
    scale: float = 0.0
    triaxial: float = DEFAULT_SHAPES.triaxial

    @staticmethod
    def of(shapes: Mapping[str, float] | None) -> Lasting:
        """Return it from ``shapes`` of tracking.json or ``bodies`` of smoothing.json."""
        known = shapes or {}
        names = ("lasting_share", "lasting_square", "scale_sd", "triaxial")
        given = zip(fields(Lasting), names, strict=True)
        return Lasting(**{f.name: known[name] for f, name in given if name in known})


SD = {"d_eq_mm": "sd_eq_mm", "aspect": "s_aspect", "tilt_deg": "s_tilt_deg"}
"""Columns of the standard deviations."""
_PARTS = {"d_eq_mm": "eq_mm", "aspect": "aspect"}
_SQUARE = dict(zip(_PARTS, UNSEEN_SQUARE, strict=True))


def mean_of_body(rows: pd.DataFrame, name: str, lasting: Lasting) -> tuple[float, float]:
    """Return the mean over a bubble's frames of a property of its body, and its standard deviation.

    It is the error of the mean over these frames, during which the property itself may change.

    rows : rows of bubbles.csv or tracks.csv of one bubble.
    name : one of `SD`.

    The outlines' own noise averages out over the frames, as independent errors do. The effect of
    modes on the rims does not, nor does the calibration's error of lengths. Of what the unseen
    shape does a share is left, another one of its square, and the run tells both. Where the parts
    are not known, and of the tilt, all of the stated variance is left.
    """
    value, sd = rows[name].to_numpy(float), rows[SD[name]].to_numpy(float)
    good = np.isfinite(value) & np.isfinite(sd)
    if not good.any():
        return float("nan"), float("nan")
    mean, count = float(value[good].mean()), int(good.sum())
    noise, rims, square, rest = parts_of_body(rows, name)[:, good].mean(-1).tolist()
    total = noise / count + rims + lasting.square * square
    total += max(lasting.share, 1 / count) * rest
    if name.endswith("_mm"):
        total += (lasting.scale * mean) ** 2
    return mean, float(np.sqrt(total))


def parts_of_body(rows: pd.DataFrame, name: str) -> Array:
    """Return the parts (4, N) of the variances of a property of a body in N frames.

    They come from the outlines' noise, from modes on the rims, from the square of the unseen shape,
    and from all else, which is the unseen shape to first order above all. Where the parts are not
    known, and of the tilt, the second one is all of the variance.
    """
    variance = rows[SD[name]].to_numpy(float) ** 2
    none = np.zeros_like(variance)
    if name not in _PARTS or not {"fixed_aspect", "noise_aspect"} <= set(rows):
        return np.stack([none, variance, none, none])
    noise, fixed = (rows[f"{p}_{_PARTS[name]}"].to_numpy(float) ** 2 for p in ("noise", "fixed"))
    # of a log aspect ratio it is the only fixed part
    unseen = (rows["fixed_aspect"] / rows["aspect"]).to_numpy(float)
    square = (_SQUARE[name] * unseen * rows[name].to_numpy(float)) ** 2
    rims = np.maximum(fixed - square, 0.0)
    parts = np.stack([noise, rims, 2 * square, np.maximum(variance - noise - rims - 2 * square, 0)])
    return np.where(np.isfinite(parts).all(0), parts, [none, variance, none, none])
