"""Checks that each view is one placement of the target, seen by all cameras at the same time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import gammaincinv

from telerig.arrays import Array
from telerig.errors import CalibrationError, TelerigError
from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.estimator.calibration.start.known_target import stereo_states

LEAST_DOTS = 4
COPY_CHANCE = 1e-9
"""Probability of taking two images with independent noise for copies of one image."""
WINDOW = 3
"""Number of consecutive views that are solved together to find the offset of a camera's images."""
FARTHEST = 2
"""Largest offset, in views, that is tried."""
MOST_WINDOWS = 12
FAR_BETTER = 0.02
"""An offset counts as the right one if the cost falls to less than this share."""


def refuse_copies(problem: Problem) -> None:
    """Raise CalibrationError if two images have the same noise, so that one is a copy.

    The sum of squared differences, in units of this noise, is chi-square distributed for
    independent images, and about zero for a copy.
    """
    count = len(problem.dot_ids)
    images, rows = np.unique(
        np.stack([problem.camera, problem.view], axis=1), axis=0, return_inverse=True
    )
    uv = np.full((len(images), count, 2), np.nan)
    variance = np.full((len(images), count), np.nan)
    uv[rows, problem.dot] = problem.uv_px
    variance[rows, problem.dot] = np.trace(problem.covariance_px2, axis1=1, axis2=2) / 2
    for i in range(len(images) - 1):
        squares = ((uv[i + 1 :] - uv[i]) ** 2).sum(-1) / (variance[i + 1 :] + variance[i])
        common = np.isfinite(squares).sum(-1)
        total = np.nansum(squares, axis=-1)
        copies = (common >= LEAST_DOTS) & (total < 2 * gammaincinv(common, COPY_CHANCE))
        if copies.any():
            (a, v), (b, w) = images[i], images[i + 1 + int(np.argmax(copies))]
            names = [
                f"camera {problem.cameras[c].name!r} view {problem.views[k]!r}"
                for c, k in ((a, v), (b, w))
            ]
            raise CalibrationError(
                f"{names[0]} and {names[1]} are copies of one image: even their noise is the same. "
                "Counted twice, they would make the calibration seem better than it is",
                todo="remove the copy; if the two should differ, look for the mistake in copying",
            )


def wrong_pairs(problem: Problem, dots_mm: Array) -> str:
    """Return a sentence if images of one camera belong to other views than their names say.

    Otherwise it is "". This happens if a camera missed a trigger or if its first image was lost.
    Groups of a few consecutive views are solved with one camera's images from up to `FARTHEST`
    views later or earlier, and the sentence is returned if such images fit far better.

    dots_mm : (N, 3) positions of the target's dots.
    """
    count = len(problem.views)
    if count < WINDOW:
        return ""
    starts = np.unique(np.linspace(0, count - WINDOW, MOST_WINDOWS).round().astype(int))
    for c in range(1, len(problem.cameras)):
        offsets = [0, *(s * n for n in range(1, FARTHEST + 1) for s in (1, -1))]
        costs = np.array([[_cost(problem, dots_mm, c, v, s) for s in offsets] for v in starts])
        best = costs.argmin(1)
        clear = (best > 0) & (costs.min(1) < FAR_BETTER * costs[:, 0])
        if not clear.any():
            continue
        chosen = int(np.bincount(best[clear]).argmax())
        first = int(starts[clear & (best == chosen)][0])
        camera, offset = problem.cameras[c].name, offsets[chosen]
        own_view, right_view = problem.views[first], problem.views[first + offset]
        side = "later" if offset > 0 else "earlier"
        return (
            f"from view {own_view!r} on, the images of camera {camera!r} are named wrongly: its "
            f"image {right_view!r}, {abs(offset)} {side} in the order, shows view {own_view!r}. An "
            "image of one camera was probably lost or added"
        )
    return ""


def _cost(problem: Problem, dots_mm: Array, camera: int, first: int, offset: int) -> float:
    """Return the cost of `WINDOW` views with one camera's images ``offset`` later, or infinity."""
    last = first + WINDOW
    if not 0 <= first + offset <= len(problem.views) - WINDOW:
        return float(np.inf)
    view = problem.view - np.where(problem.camera == camera, offset, 0) - first
    part = problem.subset((view >= 0) & (view < WINDOW))
    part = replace(
        part,
        view=view[(view >= 0) & (view < WINDOW)],
        views=problem.views[first:last],
        plate_shift=problem.plate_shift[first:last],
    ).with_model("none")
    try:
        starts = stereo_states(part, dots_mm)
        return min(solve(part, s, max_iterations=8, relative=1e-2).cost for s in starts)
    except TelerigError:
        return float(np.inf)
