"""Gauss-Newton on the pixels of a static target that the stage carries the cameras past.

A dot X of the target, at rest in the lab, stands at R X + t - w s - e in the rig when the encoder
reads s: w = axis / (1 + scale) is the travel per unit of reading, e the carriage's error there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array, Ints
from telerig.errors import CalibrationError
from telerig.estimator.calibration.solver.covariance import rig_jacobian
from telerig.factors.linear_factors import add_linear_factors
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, hat, nearest_rotation, rotation_from_rotvec
from telerig.rig.triangulation import triangulate_any
from telerig.statistics import robust_sd

LEAST_TRAVEL_MM = 1.0
_STEPS = 60
_REWEIGHTED = 25
_SUSPECT = 3.5
_STATE, _RIG, _FIRST_ERROR = 0, 1, 2


@dataclass(frozen=True)
class Dots:
    """view, camera (M,) indices; place_mm (M, 3) in the target's frame; uv_px (M, 2).

    information : (M, 2, 2) inverse covariances.  views : names; reading_mm : (V,).
    """

    views: tuple[str, ...]
    reading_mm: Array
    view: Ints
    camera: Ints
    place_mm: Array
    uv_px: Array
    information: Array


@dataclass(frozen=True)
class State:
    """rig_from_target at reading 0; slope : (3,) w, travel per unit of reading."""

    rig_from_target: Pose
    slope: Array


@dataclass(frozen=True)
class Weights:
    """Robust weights of dots (M,) and of the views' readings (V,)."""

    dots: Array
    views: Array


@dataclass(frozen=True)
class Linear:
    """Normal equations of (pose 6, slope 3) with the carriage's errors eliminated.

    by_rig : (9, P) cross term with the calibration's rig block.
    shift_mm, shift_covariance : (V, 3), (V, 3, 3) each view's own displacement off the line.
    dot_score : (M,) squared residuals in sd, each view freely shifted.
    """

    normal: Array
    right: Array
    by_rig: Array
    shift_mm: Array
    shift_covariance: Array
    dot_score: Array


def fit(
    cameras: tuple[Camera, ...],
    free: tuple[tuple[str, ...], ...],
    dots: Dots,
    state: State,
    sigma_mm: tuple[float, float],
) -> tuple[State, Weights, Linear]:
    """Robust Gauss-Newton from a start. sigma_mm : of the carriage along and across the axis.

    Dots and readings beyond 3.5 sd keep the weight (3.5 / z)^4; the limit halves from iteration
    to iteration, so that the largest outliers are removed first (graduated non-convexity).
    Raises CalibrationError when it does not converge.
    """
    weights = Weights(np.ones(len(dots.view)), np.ones(len(dots.views)))
    system = linearised(cameras, free, dots, state, sigma_mm, weights)
    limit = np.inf
    for turn in range(_STEPS):
        step = np.asarray(np.linalg.solve(system.normal, system.right), np.float64)
        state = State(
            state.rig_from_target @ Pose(rotation_from_rotvec(step[:3]), step[3:6]),
            state.slope + step[6:],
        )
        scores = _scores(system, state, sigma_mm[0])
        highest = float(np.sqrt(max(s.max() for s in scores)))
        limit = max(_SUSPECT, min(limit, highest) / 2)
        fresh = _reweighted(scores, limit) if turn < _REWEIGHTED else weights
        moved = np.ptp(fresh.dots - weights.dots) + np.ptp(fresh.views - weights.views)
        weights = fresh
        system = linearised(cameras, free, dots, state, sigma_mm, weights)
        if limit == _SUSPECT and moved < 1e-3 and np.abs(step).max() < 1e-7:
            return state, weights, system
    raise CalibrationError(
        "the fit of one straight travel to the views of the target does not converge",
        where="stage_axis",
        todo="check that the target stood still and that positions.csv belongs to the views",
    )


def _scores(system: Linear, state: State, sigma_mm: float) -> tuple[Array, Array]:
    """Squared distances in sd of dots (M,) and of the views' readings (V,).

    Readings that scatter by more than twice what is stated are measured by their own scatter.
    """
    axis = state.slope / np.linalg.norm(state.slope)
    own = np.einsum("i,vij,j->v", axis, system.shift_covariance, axis)
    off = system.shift_mm @ axis
    spread = float(robust_sd(off))
    stated = float(np.sqrt(np.median(own) + sigma_mm**2))
    variance = own + sigma_mm**2 if spread < 2 * stated else own + spread**2
    return system.dot_score, off**2 / variance


def _reweighted(scores: tuple[Array, Array], limit: float) -> Weights:
    """(limit / z)^4 beyond ``limit`` standard deviations."""
    cut = [np.minimum(1.0, limit**4 / np.maximum(score, 1.0) ** 2) for score in scores]
    return Weights(cut[0], cut[1])


def linearised(
    cameras: tuple[Camera, ...],
    free: tuple[tuple[str, ...], ...],
    dots: Dots,
    state: State,
    sigma_mm: tuple[float, float],
    weights: Weights,
) -> Linear:
    """Linear system at a state; GTSAM eliminates the carriage's error e of each view."""
    import gtsam

    residual, by_point, by_state, by_rig = derivatives(cameras, free, dots, state)
    information = dots.information * weights.dots[:, None, None]
    whitener = np.swapaxes(np.linalg.cholesky(dots.information), -1, -2)
    whitener = whitener * np.sqrt(weights.dots)[:, None, None]
    across = _across(state.slope)
    count = len(dots.views)
    shift, spread = np.zeros((count, 3)), np.zeros((count, 3, 3))
    graph, order = gtsam.GaussianFactorGraph(), gtsam.Ordering()
    for v in range(count):
        mine = dots.view == v
        along, beside = sigma_mm[0] / np.sqrt(weights.views[v]), sigma_mm[1]
        # the carriage's error in units of its sd, which may be zero
        by_error = by_point[mine] @ (across * [along, beside, beside])
        white = [whitener[mine] @ part for part in (by_error, by_state[mine], by_rig[mine])]
        rows = 2 * int(mine.sum())
        value = (whitener[mine] @ residual[mine][:, :, None]).reshape(1, rows)
        blocks = [part.reshape(1, rows, part.shape[-1]) for part in white]
        add_linear_factors(graph, (_FIRST_ERROR + v, _STATE, _RIG), blocks, value)
        add_linear_factors(graph, (_FIRST_ERROR + v,), (np.eye(3)[None],), np.zeros((1, 3)))
        order.push_back(_FIRST_ERROR + v)
        seen = np.einsum("mki,mkl,mlj->ij", by_point[mine], information[mine], by_point[mine])
        felt = np.einsum("mki,mkl,ml->i", by_point[mine], information[mine], residual[mine])
        spread[v] = np.linalg.pinv(seen, rcond=1e-9)
        shift[v] = spread[v] @ felt
    _, left = graph.eliminatePartialSequential(order)
    kept = gtsam.Ordering()
    for key in (_STATE, _RIG) if by_rig.shape[-1] else (_STATE,):
        kept.push_back(key)
    normal, right = left.hessian(kept)
    off = residual - np.einsum("mki,mi->mk", by_point, shift[dots.view])
    score = np.einsum("mi,mij,mj->m", off, dots.information, off)
    return Linear(normal[:9, :9], right[:9], normal[:9, 9:], shift, spread, score)


def _across(slope: Array) -> Array:
    """(3, 3) unit vectors as columns: the travel's direction and two across it."""
    basis, _ = np.linalg.qr(np.column_stack([slope, np.eye(3)]))
    return np.asarray(basis)


def derivatives(
    cameras: tuple[Camera, ...], free: tuple[tuple[str, ...], ...], dots: Dots, state: State
) -> tuple[Array, Array, Array, Array]:
    """(M, 2) measured - predicted; (M, 2, 3) by rig point, (M, 2, 9) by state, (M, 2, P) by rig."""
    pose = state.rig_from_target
    points = pose.apply(dots.place_mm) - dots.reading_mm[dots.view, None] * state.slope
    whole = rig_jacobian(cameras, free, points)
    residual, by_point = np.empty((len(points), 2)), np.empty((len(points), 2, 3))
    by_rig = np.empty((len(points), 2, whole.shape[-1]))
    for c, camera in enumerate(cameras):
        mine = dots.camera == c
        in_camera = camera.camera_from_rig.apply(points[mine])
        uv, by_camera_point, _ = camera.pixel_jacobians(in_camera, ())
        residual[mine] = dots.uv_px[mine] - uv
        by_point[mine] = by_camera_point @ camera.camera_from_rig.rotation
        by_rig[mine] = whole[mine, 2 * c : 2 * c + 2]
    by_move = by_point @ pose.rotation
    by_turn = -by_move @ hat(dots.place_mm)
    by_slope = -dots.reading_mm[dots.view, None, None] * by_point
    return residual, by_point, np.concatenate([by_turn, by_move, by_slope], -1), by_rig


def start(cameras: tuple[Camera, ...], dots: Dots) -> State:
    """Closed form: dots triangulated view by view, median slopes, the target fitted to medians.

    Raises CalibrationError when no dot is seen by two cameras at two positions.
    """
    ids = np.unique(dots.place_mm, axis=0, return_inverse=True)[1].reshape(-1)
    keys = dots.view * (ids.max() + 1) + ids
    _, first, point = np.unique(keys, return_index=True, return_inverse=True)
    pixels = np.full((len(cameras), len(first), 2), np.nan)
    pixels[dots.camera, point] = dots.uv_px
    several = np.isfinite(pixels[..., 0]).sum(0) > 1
    one = first[several]
    points = triangulate_any(cameras, list(pixels[:, several]), 0.02).points_mm
    reading = dots.reading_mm[dots.view[one]]
    slope = _median_slope(reading, ids[one], points)
    at_zero = points + slope * reading[:, None]
    return State(_fitted_pose(ids[one], dots.place_mm[one], at_zero), slope)


def _median_slope(reading: Array, dot: Ints, points: Array) -> Array:
    """(3,) travel per reading: median over pairs of views of one dot (Theil and Sen)."""
    slopes = [np.zeros((0, 3))]
    for one in np.unique(dot):
        members = np.flatnonzero(dot == one)
        a, b = members[np.array(np.triu_indices(len(members), 1))]
        far = np.abs(reading[b] - reading[a]) >= LEAST_TRAVEL_MM / 2
        a, b = a[far], b[far]
        slopes.append((points[a] - points[b]) / (reading[b] - reading[a])[:, None])
    every = np.concatenate(slopes)
    if not len(every):
        raise CalibrationError(
            "no dot is seen by two cameras at two positions",
            where="stage_axis",
            todo="keep the target in the images of two cameras while the stage travels",
        )
    return np.asarray(np.median(every, axis=0))


def _fitted_pose(dot: Ints, place: Array, points: Array) -> Pose:
    """rig_from_target of least squares over the median place of each dot (Kabsch)."""
    _, first = np.unique(dot, return_index=True)
    nominal = place[first]
    middle = np.array([np.median(points[dot == d], axis=0) for d in dot[first]])
    a, b = nominal.mean(0), middle.mean(0)
    rotation = nearest_rotation((middle - b).T @ (nominal - a))
    return Pose(rotation, b - rotation @ a)
