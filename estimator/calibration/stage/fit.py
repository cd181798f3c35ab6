"""Fits the travel axis to images of a static target that the stage carries the cameras past, by
Gauss-Newton steps.

A dot X of the target is at rest in the laboratory. When the encoder reads s, it is at R X + t - w s
- e in the rig. Here R and t are the pose of the target at reading 0, w = axis / (1 + scale) is the
travel per unit of reading, and e is the error of the carriage's position in that view.
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
    """Holds M measured dots of one target in V views.

    views : names of the views.
    reading_mm : (V,) encoder reading of each view.
    view, camera : (M,) indices of each dot's view and camera.
    place_mm : (M, 3) position of the dot in the target frame.
    uv_px : (M, 2).
    information : (M, 2, 2) inverse covariances of the pixels (1/px^2).
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
    """Holds the estimated motion of the target in the rig.

    rig_from_target : pose of the target at reading 0.
    slope : (3,) w, the travel per unit of reading.
    """

    rig_from_target: Pose
    slope: Array


@dataclass(frozen=True)
class Weights:
    """Holds robust weights from 0 to 1 of the dots (M,) and of the views' encoder readings (V,)."""

    dots: Array
    views: Array


@dataclass(frozen=True)
class StageEquations:
    """Holds the normal equations of the 9 unknowns (pose 6, slope 3), after the carriage's errors
    were eliminated.

    normal, right : (9, 9) and (9,) the matrix and the right-hand side.
    by_rig : (9, P) block that couples the unknowns with the P parameters of the cameras.
    shift_mm, shift_covariance : (V, 3) and (V, 3, 3), displacement of each view from the straight
        line.
    dot_score : (M,) squared residuals in standard deviations, if each view is shifted freely.
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
) -> tuple[State, Weights, StageEquations]:
    """Fit the state to the dots by robust Gauss-Newton steps from a start.

    free : for each camera the names of its free intrinsics.
    sigma_mm : standard deviations of the carriage's position along and across the axis.

    A dot or a reading at z > 3.5 standard deviations gets the weight (3.5 / z)^4. The limit begins
    above the largest z and is halved in every iteration, so that the largest outliers lose their
    weight first (graduated non-convexity).

    Raises CalibrationError if the fit does not converge.
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


def _scores(system: StageEquations, state: State, sigma_mm: float) -> tuple[Array, Array]:
    """Return the squared distances of the dots (M,) and of the readings (V,), in standard
    deviations.

    If the readings scatter by more than twice the stated standard deviation, the observed scatter
    is used instead of it.
    """
    axis = state.slope / np.linalg.norm(state.slope)
    own = np.einsum("i,vij,j->v", axis, system.shift_covariance, axis)
    off = system.shift_mm @ axis
    spread = float(robust_sd(off))
    stated = float(np.sqrt(np.median(own) + sigma_mm**2))
    variance = own + sigma_mm**2 if spread < 2 * stated else own + spread**2
    return system.dot_score, off**2 / variance


def _reweighted(scores: tuple[Array, Array], limit: float) -> Weights:
    """Return the weights (limit / z)^4 for distances z beyond ``limit`` standard deviations,
    otherwise 1."""
    cut = [np.minimum(1.0, limit**4 / np.maximum(score, 1.0) ** 2) for score in scores]
    return Weights(cut[0], cut[1])


def linearised(
    cameras: tuple[Camera, ...],
    free: tuple[tuple[str, ...], ...],
    dots: Dots,
    state: State,
    sigma_mm: tuple[float, float],
    weights: Weights,
) -> StageEquations:
    """Return the normal equations at a state. GTSAM eliminates the carriage's error of each
    view."""
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
        # the carriage's error is in units of its standard deviation, because that may be zero
        by_error = by_point[mine] @ (across * [along, beside, beside])
        white = [whitener[mine] @ part for part in (by_error, by_state[mine], by_rig[mine])]
        rows = 2 * int(mine.sum())
        value = (whitener[mine] @ residual[mine][:, :, None]).reshape(1, rows)
        blocks = [part.reshape(1, rows, part.shape[-1]) for part in white]
        add_linear_factors(graph, (_FIRST_ERROR + v, _STATE, _RIG), blocks, value)
        add_linear_factors(graph, (_FIRST_ERROR + v,), (np.eye(3)[None],), np.zeros((1, 3)))
        order.push_back(_FIRST_ERROR + v)
        seen = np.einsum("mki,mkl,mlj->ij", by_point[mine], information[mine], by_point[mine])
        gradient = np.einsum("mki,mkl,ml->i", by_point[mine], information[mine], residual[mine])
        spread[v] = np.linalg.pinv(seen, rcond=1e-9)
        shift[v] = spread[v] @ gradient
    _, left = graph.eliminatePartialSequential(order)
    kept = gtsam.Ordering()
    for key in (_STATE, _RIG) if by_rig.shape[-1] else (_STATE,):
        kept.push_back(key)
    normal, right = left.hessian(kept)
    off = residual - np.einsum("mki,mi->mk", by_point, shift[dots.view])
    score = np.einsum("mi,mij,mj->m", off, dots.information, off)
    return StageEquations(normal[:9, :9], right[:9], normal[:9, 9:], shift, spread, score)


def _across(slope: Array) -> Array:
    """Return unit vectors as columns (3, 3): the direction of travel and two perpendicular to
    it."""
    basis, _ = np.linalg.qr(np.column_stack([slope, np.eye(3)]))
    return np.asarray(basis)


def derivatives(
    cameras: tuple[Camera, ...], free: tuple[tuple[str, ...], ...], dots: Dots, state: State
) -> tuple[Array, Array, Array, Array]:
    """Return the residuals (M, 2), measured minus predicted, and the derivatives of the prediction.

    The derivatives are (M, 2, 3) with respect to the rig point, (M, 2, 9) with respect to the
    state, and (M, 2, P) with respect to the P parameters of the cameras.
    """
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
    """Return a state in closed form from which `fit` can start.

    The dots of each view are triangulated, the slope is a median over pairs of views, and the
    target is fitted to the median position of each dot. Raises CalibrationError if no dot is seen
    by two cameras at two positions.
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
    """Return the travel per unit of reading (3,) as the median over pairs of views of a dot
    (Theil-Sen)."""
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
    """Return rig_from_target by a least-squares fit to the median position of each dot (Kabsch)."""
    _, first = np.unique(dot, return_index=True)
    nominal = place[first]
    middle = np.array([np.median(points[dot == d], axis=0) for d in dot[first]])
    a, b = nominal.mean(0), middle.mean(0)
    rotation = nearest_rotation((middle - b).T @ (nominal - a))
    return Pose(rotation, b - rotation @ a)
