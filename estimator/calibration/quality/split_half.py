"""Split-half check: is the calibration as repeatable as its covariance says?

Every second view calibrates the rig anew, and so do the others; the two rigs are compared over the
working volume like two calibrations of one rig. The covariance does not know of errors that the
views share (a wrong lens model), but they act differently in two halves with other tilts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import CalibrationError
from telerig.estimator.calibration.quality.comparison import (
    UNLIKELY,
    FieldDifference,
    Rig,
    chance_words,
    field_difference,
)
from telerig.estimator.calibration.solver.covariance import joint_covariance
from telerig.estimator.calibration.solver.problem import Problem, cameras_from_state
from telerig.estimator.calibration.solver.robust_least_squares import LEAST_DOTS, solve
from telerig.estimator.calibration.start.known_target import overlap_tree
from telerig.factors.calibration import State
from telerig.short_text import number

LEAST_VIEWS = 4
"""Least number of views in each half; fewer do not determine a rig."""
_SCALE = 1e-7


def split_half_check(problem: Problem, state: State, widening: float = 1.0) -> dict[str, Any]:
    """Calibrate from each half of the views and compare the two rigs.

    state : the solution with all views. widening : factor by which the stated standard deviations
    are larger than those of ``problem``, because of a pattern in the residuals.
    Returns the content of `Calibration.diagnostics`, entry "halves": "words" and, if the check was
    possible, the number of views of each half, the RMS difference of points and its prediction (µm
    per axis), the p-value, "agree", and the differences at a grid of points.
    Both halves use the same size of the target, so the check says nothing about this size: the
    known distance of two dots, or else the estimated distance of two dots far apart, is taken as
    exact in both.
    """
    if len(problem.cameras) < 2:
        return {"words": "one camera: the split-half check compares points in space and needs two"}
    used = _in_turn(problem)
    parts = [used[0::2], used[1::2]]
    if min(len(p) for p in parts) < LEAST_VIEWS:
        return {
            "words": f"{len(used)} views are too few for the split-half check: it needs "
            f"{2 * LEAST_VIEWS} or more"
        }
    problem = replace(problem, scale=problem.scale or _size(problem, state, parts))
    try:
        first, second = (_rig(problem, state, views) for views in parts)
    except CalibrationError as error:
        return {
            "words": "the split-half check was not possible, because one half of the views does "
            f"not determine the rig: {error.what}"
        }
    field = field_difference(first, second)
    return {
        "views": [len(p) for p in parts],
        "rms_um": field.rms_um,
        "predicted_um": field.predicted_um,
        "p_value": field.p_value,
        "agree": bool(field.p_value >= UNLIKELY),
        "words": _words(field, [len(p) for p in parts], widening),
        "points_mm": np.round(field.points_mm, 4).tolist(),
        "shift_um": np.round(1e3 * field.shift_mm, 4).tolist(),
        "sd_um": np.round(1e3 * field.sd_mm, 4).tolist(),
    }


def _size(
    problem: Problem, state: State, parts: list[NDArray[np.int64]]
) -> tuple[tuple[int, int], float, float] | None:
    """Return two dots far apart that both halves see, their estimated distance (mm), and 0 for
    its standard deviation (mm); None if the halves share fewer than two dots."""
    weighed = problem.kept
    one, other = (problem.dot[weighed & np.isin(problem.view, views)] for views in parts)
    both = np.intersect1d(one, other)
    if len(both) < 2:
        return None
    points = state.dots_mm[both]
    first = int(np.argmax(np.linalg.norm(points - points.mean(0), axis=-1)))
    distance = np.linalg.norm(points - points[first], axis=-1)
    second = int(np.argmax(distance))
    return (int(both[first]), int(both[second])), float(distance[second]), 0.0


def _rig(problem: Problem, state: State, views: NDArray[np.int64]) -> Rig:
    half = problem.subset(np.isin(problem.view, views) & problem.kept)
    overlap_tree(half, _images(half))
    if half.scale is not None:
        pair, distance, _ = half.scale
        half = replace(half, scale=(pair, distance, _SCALE * distance))
    solution = solve(half, state, max_iterations=30, relative=1e-7)
    names, covariance = joint_covariance(half, solution).rig_block()
    cameras = cameras_from_state(half, solution.state)
    if not np.isfinite(covariance).all():
        raise CalibrationError(
            f"nothing determines {names[int(np.argmax(~np.isfinite(covariance)))]}"
        )
    return Rig(cameras, half.free, covariance)


def _in_turn(problem: Problem) -> NDArray[np.int64]:
    """Return the used views in the order in which the halves take turns.

    With three or more cameras, views that the same cameras see stand together.
    """
    used = np.unique(problem.view[problem.kept])
    if len(problem.cameras) == 2:
        return used
    images = _images(problem)
    kind = {int(v): tuple(c for w, c in sorted(images) if w == v) for v in used}
    return np.array(sorted(kind, key=lambda v: (kind[v], v)), np.int64)


def _images(problem: Problem) -> set[tuple[int, int]]:
    """Return (view, camera) of each image with enough dots to determine the target's pose."""
    kept = problem.kept
    images, counts = np.unique(
        np.stack([problem.view[kept], problem.camera[kept]], 1), axis=0, return_counts=True
    )
    return {(int(v), int(c)) for v, c in images[counts >= LEAST_DOTS]}


def _words(field: FieldDifference, views: list[int], widening: float) -> str:
    ratio = field.rms_um / max(field.predicted_um, 1e-12)
    apart, expected = (number(um, 2) for um in (field.rms_um, field.predicted_um))
    words = (
        f"of two calibrations, one from {views[0]} and one from the other {views[1]} views, points "
        f"triangulated from the same pixels differ by {apart} µm RMS per axis; their covariances "
        f"predict {expected} µm"
    )
    if field.p_value >= UNLIKELY:
        return words + f" (ratio {ratio:.2f}), so the stated covariance can be believed"
    stated = "every stated standard deviation is too small by about this ratio"
    if widening > 1:
        stated = (
            f"every stated standard deviation is {widening:.2g} times larger than predicted here, "
            "because of the pattern in the residuals"
        )
    return (
        words + f" (ratio {ratio:.2f}; {chance_words(field.p_value)}): the two halves "
        "disagree, so an effect that the model does not contain acts on the images; "
        f"{stated}. Look for a pattern in residuals.csv, and try --model auto"
    )
