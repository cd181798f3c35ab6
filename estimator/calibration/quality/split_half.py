"""Split-half check: is the calibration as repeatable as its covariance says?

Every second view calibrates the rig anew, and so do the others, each by one Gauss-Newton step from
the calibration of all views. The two rigs are compared over the working volume like two
calibrations of one rig. The covariance does not know of errors that the
views share (a wrong lens model), but they act differently in two halves with other tilts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import CalibrationError
from telerig.estimator.calibration.quality.comparison import (
    Rig,
    field_difference,
)
from telerig.estimator.calibration.solver.problem import Problem, cameras_from_state
from telerig.estimator.calibration.solver.system import System
from telerig.estimator.calibration.start.known_target import overlap_tree
from telerig.estimator.calibration.thresholds import LEAST_DOTS, LEAST_VIEWS
from telerig.factors.calibration import State
from telerig.io.results.findings import Code, Finding

_SCALE = 1e-7


def split_half_check(
    problem: Problem, state: State, widening: float = 1.0
) -> tuple[dict[str, Any], list[Finding]]:
    """Calibrate from each half of the views and compare the two rigs.

    state : the solution with all views. widening : factor by which the stated standard deviations
    are larger than those of ``problem``, because of a pattern in the residuals.
    Returns the content of `Calibration.diagnostics`, entry "halves", and the finding. The entry is
    empty if the check was not possible; else it has the number of views of each half, the RMS
    difference of points and its prediction (µm per axis), the p-value, and the differences at a
    grid of points.
    Both halves use the same size of the target, so the check says nothing about this size: the
    known distance of two dots, or else the estimated distance of two dots far apart, is taken as
    exact in both.
    """
    if len(problem.cameras) < 2:
        return _not_compared("it compares points in space, which one camera does not see")
    used = _in_turn(problem)
    parts = [used[0::2], used[1::2]]
    if min(len(p) for p in parts) < LEAST_VIEWS:
        return _not_compared(f"{len(used)} views are too few, it needs {2 * LEAST_VIEWS} or more")
    problem = replace(problem, scale=problem.scale or _size(problem, state, parts))
    try:
        first, second = (_rig(problem, state, views) for views in parts)
    except CalibrationError as error:
        return _not_compared(f"one half of the views does not determine the rig: {error.what}")
    field = field_difference(first, second)
    compared = {
        "rms_um": field.rms_um, "predicted_um": field.predicted_um, "p_value": field.p_value
    }  # fmt: skip
    ratio = field.rms_um / max(field.predicted_um, 1e-12)
    numbers = {
        "first": len(parts[0]),
        "second": len(parts[1]),
        "ratio": ratio,
        "widening": widening,
    }
    agree = field.p_value >= Code.HALVES_DISAGREE.limit
    code = Code.HALVES_AGREE if agree else Code.HALVES_DISAGREE
    return compared | {
        "views": [len(p) for p in parts],
        "points_mm": np.round(field.points_mm, 4).tolist(),
        "shift_um": np.round(1e3 * field.shift_mm, 4).tolist(),
        "sd_um": np.round(1e3 * field.sd_mm, 4).tolist(),
    }, [code.found(compared | numbers)]


def _not_compared(why: str) -> tuple[dict[str, Any], list[Finding]]:
    return {}, [Code.HALVES_NOT_COMPARED.found(text=why)]


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
    system = System(half)
    gaussian = system.gaussian(state)
    step, _ = gaussian.step()
    covariance = gaussian.marginal(np.arange(gaussian.rig))
    return Rig(cameras_from_state(half, system.moved(state, step)), half.free, covariance)


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
