"""One dot as image patch and fitted model, for the figure in the report."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array
from telerig.estimator.dots.fit.blurred_ellipse import (
    PIXEL_VARIANCE_PX2,
    coverage_on_grid,
    shape_from_axes,
)
from telerig.estimator.dots.locate import measure_dots

REACH = 1.7
"""Half-width of the patch in semi-major axes, besides five pixels."""


def dot_example(
    image: NDArray[Any], u_px: float, v_px: float, a_px: float, *, polarity: Any
) -> dict[str, Array] | None:
    """The dot nearest to (u_px, v_px) with its luminance model; None when it is not found again.

    Returns patch and model (h, w) in grey levels, u0 and v0 (pixel of the patch's corner), the
    ellipse (u_px, v_px, a_px, b_px, angle_rad) and the grey noise.
    """
    half = int(np.ceil(REACH * a_px + 5))
    v0, u0 = max(0, round(v_px) - half), max(0, round(u_px) - half)
    patch = image[v0 : round(v_px) + half + 1, u0 : round(u_px) + half + 1].astype(float)
    found = measure_dots(patch, polarity=polarity).dots
    if not len(found):
        return None
    distance = np.hypot(found["u_px"] + u0 - u_px, found["v_px"] + v0 - v_px)
    dot = found.iloc[int(np.argmin(distance))]
    sigma = float(np.sqrt(dot["blur_px"] ** 2 + PIXEL_VARIANCE_PX2))
    shape = shape_from_axes(dot["a_px"], dot["b_px"], dot["angle_rad"])
    columns, rows = (np.arange(n, dtype=float) for n in patch.shape[::-1])
    u, v = np.meshgrid(columns, rows)
    centre = (dot["u_px"], dot["v_px"])
    covered, _ = coverage_on_grid(columns, rows, centre, shape, sigma)
    model = _with_levels(patch, covered, u - dot["u_px"], v - dot["v_px"])
    numbers = {n: np.array(dot[n]) for n in ("a_px", "b_px", "angle_rad", "noise")}
    place = {
        "u0": np.array(float(u0)), "v0": np.array(float(v0)),
        "u_px": np.array(dot["u_px"] + u0), "v_px": np.array(dot["v_px"] + v0),
    }  # fmt: skip
    return {"patch": patch, "model": model, **place, **numbers}


def _with_levels(patch: Array, covered: Array, du: Array, dv: Array) -> Array:
    """Least-squares grey levels and gradients, background and contrast, at a known coverage."""
    one = np.ones_like(du)
    terms = [one, du, dv, covered, covered * du, covered * dv]
    design = np.stack([t.ravel() for t in terms], -1)
    levels, *_ = np.linalg.lstsq(design, patch.ravel(), rcond=None)
    return np.asarray((design @ levels).reshape(patch.shape))
