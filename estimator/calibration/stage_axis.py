"""Travel axis and encoder scale from views of one static target at several stage positions.

The folder `stage_axis/` of a dataset holds positions.csv, and either dots.csv or images. When the
encoder reads s, the dot X of the target at rest is at R X + t - w s - e in the rig. Here R and t
are the pose of the target at reading 0, w = axis / (1 + scale) is the travel per unit of reading,
and e is the error of the carriage's position in that view.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array, Ints
from telerig.errors import CalibrationError, InputError, suggestion
from telerig.estimator.calibration.thresholds import LEAST_TRAVEL_MM
from telerig.factors.robust_loss import next_limit, travel_weights
from telerig.io.dataset.dataset import Dataset, View, files_by_view
from telerig.io.dataset.tables import read_dots_csv
from telerig.io.files.csv_table import read_table
from telerig.io.images.read import natural
from telerig.io.results.findings import Code, Finding
from telerig.io.tables.calibration import POSITIONS
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, across, hat, nearest_rotation, rotation_from_rotvec
from telerig.rig.triangulation import rig_jacobian, triangulate_any
from telerig.statistics import robust_sd

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.calibration.result.calibration import Calibration


_COVARIANCE = ["suu_px2", "suv_px2", "svv_px2"]
FOLDER = "stage_axis"
_POSITIONS = "positions.csv"


@dataclass(frozen=True)
class StageAxis:
    """The calibrated stage.

    axis_rig : (3,) unit vector of travel in rig axes, in the direction of increasing readings.
    basis : (3, 2) two orthonormal vectors perpendicular to the axis.
    covariance : (2, 2) of the axis's direction along these vectors, in rad^2.
    scale, scale_sd : scale error of the encoder (reading = (1 + scale) travel), and its standard
        deviation.
    joint_covariance : (3, 3) of the two components of the direction and the scale.
    rig_from_target : pose of the target at reading 0.
    chi2_dof : chi-square per degree of freedom of the dots; 1 is expected.
    position_sigma_mm, wander_sigma_mm : standard deviations of the carriage's position along and
        across the axis: the given ones, or the observed ones if these are significantly larger.
    findings : what was found.
    """

    axis_rig: Array
    basis: Array
    covariance: Array
    scale: float
    scale_sd: float
    joint_covariance: Array
    rig_from_target: Pose
    chi2_dof: float
    position_sigma_mm: float
    wander_sigma_mm: float
    findings: tuple[Finding, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the contents as plain numbers for calibration.json."""
        return {
            "axis": self.axis_rig.tolist(),
            "basis": self.basis.tolist(),
            "axis_covariance_rad2": self.covariance.tolist(),
            "encoder_scale": self.scale,
            "encoder_scale_sd": self.scale_sd,
            "joint_covariance": self.joint_covariance.tolist(),
            "rig_from_target": {
                "rotation": self.rig_from_target.rotation.tolist(),
                "translation_mm": self.rig_from_target.translation_mm.tolist(),
            },
            "chi2_dof": self.chi2_dof,
            "position_sigma_mm": self.position_sigma_mm,
            "wander_sigma_mm": self.wander_sigma_mm,
        }


def stage_axis_from(dataset: Dataset, calibration: Calibration) -> StageAxis | None:
    """Measure the stage's axis from the folder `stage_axis/` of a dataset; None if there is none.

    If rig.toml states another direction of travel, ``findings`` of the result say so. Raises
    InputError if the folder has no positions.csv, or both or neither of images and dots.csv, and
    the errors of `stage_axis_of`.
    """
    folder = dataset.path / FOLDER
    if not folder.is_dir():
        return None
    positions = _positions(folder)
    described, read = dataset.rig.stage, list[Finding]()
    found = stage_axis_of(
        calibration,
        _measured(dataset, folder, read),
        positions,
        position_sigma_mm=0.001 if described is None else described.position_sigma_mm,
    )
    far = [] if described is None else _far_axis(found.axis_rig, described.axis)
    return replace(found, findings=(*found.findings, *read, *far))


def _positions(folder: Path) -> pd.DataFrame:
    file = folder / _POSITIONS
    if not file.is_file():
        raise InputError(
            f"there is no {_POSITIONS}", where=str(folder), todo="write view,position_mm"
        )
    return read_table(file, POSITIONS.of())


def _measured(dataset: Dataset, folder: Path, read: list[Finding]) -> pd.DataFrame:
    """Return the table of measured dots, from dots.csv or from the images in the folder.

    Findings about what is not used are appended to ``read``.
    """
    table, notes = folder / "dots.csv", list[str]()
    views = _image_views(dataset, folder, notes)
    read += [Code.NOTE.found(text=note) for note in notes]
    if table.is_file() == bool(views):
        what = "both images and dots.csv" if views else "neither images nor dots.csv"
        raise InputError(
            f"holds {what}",
            where=str(folder),
            todo=f"keep only one of the two: {FOLDER}/<camera>/<view>.tif or {FOLDER}/dots.csv",
        )
    if not views:
        return read_dots_csv(table, dataset.rig)
    from telerig.estimator.dots.dataset_dots import detect_dataset

    found = detect_dataset(replace(dataset, views=views, source="images", table=None))
    read += [
        finding.model_copy(update={"views": tuple(f"{FOLDER}/{view}" for view in finding.views)})
        for finding in found.findings
    ]
    return found.dots


def _image_views(dataset: Dataset, folder: Path, notes: list[str]) -> tuple[View, ...]:
    paths: dict[str, dict[str, Path]] = {}
    for camera in dataset.rig.cameras:
        if (folder / camera).is_dir():
            for view, file in files_by_view(folder / camera, notes).items():
                paths.setdefault(view, {})[camera] = file
    return tuple(View(name, paths[name]) for name in sorted(paths, key=natural))


def _far_axis(axis: Array, stated: tuple[float, float, float]) -> list[Finding]:
    """Return a finding if rig.toml states a direction that differs from the measured one."""
    angle = float(np.degrees(np.arccos(np.clip(axis @ np.asarray(stated), -1, 1))))
    if angle < Code.STAGE_AXIS_FAR.limit:
        return []
    return [Code.STAGE_AXIS_FAR.found(angle_deg=angle, **dict(zip("xyz", axis.tolist())))]


def stage_axis_of(
    calibration: Calibration,
    table: pd.DataFrame,
    positions_mm: Mapping[str, float] | pd.DataFrame,
    *,
    position_sigma_mm: float = 0.001,
    wander_sigma_mm: float = 0.0,
) -> StageAxis:
    """Measure the axis of travel and the encoder's scale from views at several stage positions.

    The covariance of the result includes the errors of the cameras' calibration.

    table : measured dots of a target at rest, with the columns of dots.csv: view, camera, dot,
        u_px, v_px and either suu_px2, suv_px2, svv_px2 or sigma_px.
    positions_mm : the encoder reading of each view, a mapping or a table with the columns view and
        position_mm.
    position_sigma_mm, wander_sigma_mm : as in `StageAxis`.

    Raises InputError for views without a position and for unknown cameras, and CalibrationError for
    fewer than two positions, less than 1 mm between them, or a single camera.
    """
    dots, findings = _dots(calibration, table, positions_mm)
    cameras = calibration.cameras
    state = start(cameras, dots)
    sigma = (position_sigma_mm, wander_sigma_mm)
    state, weights, system = fit(cameras, calibration.free, dots, state, sigma)
    observed = _observed_sigma(state, weights, system, sigma)
    if observed != sigma:
        findings += _scatters(sigma, observed)
        sigma = observed
        state, weights, system = fit(cameras, calibration.free, dots, state, sigma)
    findings += _suspects(dots, weights, system)
    return _result(calibration, dots, state, weights, system, sigma, findings)


def _dots(
    calibration: Calibration, table: pd.DataFrame, positions_mm: Mapping[str, float] | pd.DataFrame
) -> tuple[Dots, list[Finding]]:
    """Return the dots that the calibration knows, and findings on those that it does not."""
    readings = _readings(positions_mm)
    names = [c.name for c in calibration.cameras]
    _check_names(table, "view", list(readings), "has no position")
    _check_names(table, "camera", names, "is not in the calibration")
    index = {int(d): i for i, d in enumerate(calibration.dot_ids)}
    known = table["dot"].isin(index).to_numpy()
    unknown = int((~known).sum())
    findings = [Code.UNKNOWN_DOTS.found(count=unknown)] if unknown else []
    if unknown and not known.any():
        raise InputError(
            f"none of the {unknown} dots has a number that is in the calibration",
            where=FOLDER,
            todo="number the dots as in the calibration, and show the same target",
        )
    rows = table[known]
    views = tuple(sorted(set(rows["view"].astype(str)), key=lambda v: readings[v]))
    unseen = [v for v in readings if v not in views]
    findings += [Code.UNSEEN_POSITIONS.found(views=unseen)] if unseen else []
    reading = np.array([readings[v] for v in views])
    _check_enough(reading, set(rows["camera"]))
    number = {v: i for i, v in enumerate(views)}
    place = np.array([index[int(d)] for d in rows["dot"]], np.int64)
    found = Dots(
        views,
        reading,
        np.array([number[str(v)] for v in rows["view"]], np.int64),
        np.array([names.index(c) for c in rows["camera"]], np.int64),
        calibration.target_points_mm[place],
        rows[["u_px", "v_px"]].to_numpy(float),
        np.asarray(np.linalg.inv(_covariance(rows, calibration)), np.float64),
    )
    return found, findings


def _readings(positions_mm: Mapping[str, float] | pd.DataFrame) -> dict[str, float]:
    """Return the encoder reading of each view. Raises InputError for two, or not finite ones."""
    if isinstance(positions_mm, Mapping):
        out = {str(view): float(position) for view, position in positions_mm.items()}
    else:
        views = positions_mm["view"].astype(str)
        if views.duplicated().any():
            raise InputError(
                f"view {views[views.duplicated()].iloc[0]!r} has two positions",
                where=f"{FOLDER}/{_POSITIONS}",
                todo="keep one of the rows",
            )
        out = dict(zip(views, positions_mm["position_mm"].astype(float)))
    bad = [view for view, position in out.items() if not np.isfinite(position)]
    if bad:
        raise InputError(
            f"the encoder position of view {bad[0]!r} is missing or not a finite number",
            where=FOLDER,
            todo=f"give its position in mm, or remove the view from {_POSITIONS}",
        )
    return out


def _check_names(table: pd.DataFrame, column: str, known: list[str], fault: str) -> None:
    strange = sorted(set(table[column].astype(str)) - set(known))
    if strange:
        raise InputError(
            f"{column} {strange[0]!r} {fault}", where=FOLDER, todo=suggestion(strange[0], known)
        )


def _check_enough(reading_mm: Array, seen_by: set[str]) -> None:
    if len(seen_by) < 2:
        raise CalibrationError(
            "only one camera has dots, and it cannot see travel along its own viewing direction",
            where=FOLDER,
            todo="show the target to two cameras",
        )
    span = float(np.ptp(reading_mm))
    if span < LEAST_TRAVEL_MM:
        raise CalibrationError(
            f"{len(reading_mm)} view(s) whose readings span {span:.3g} mm are not enough to "
            "measure the travel",
            where=FOLDER,
            todo="take views at three or more positions, as far apart as the image allows",
        )


def _covariance(rows: pd.DataFrame, calibration: Calibration) -> Array:
    """Return the pixels' covariances (M, 2, 2), from the columns or the calibration's scatter."""
    if all(c in rows for c in _COVARIANCE):
        uu, uv, vv = rows[_COVARIANCE].to_numpy(float).T
    else:
        scatter = float(calibration.statistics.get("scatter_px", 0.02))
        sigma = rows["sigma_px"].to_numpy(float) if "sigma_px" in rows else scatter
        uu = vv = np.broadcast_to(np.square(sigma), (len(rows),))
        uv = np.zeros(len(rows))
    return np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2)


def _observed_sigma(
    state: State, weights: Weights, system: StageEquations, sigma_mm: tuple[float, float]
) -> tuple[float, float]:
    """Return the carriage's standard deviations, as observed if significantly larger than given.

    A straight line uses up two of the views' positions in each direction.
    """
    from scipy.stats import chi2

    kept = weights.views > Code.WRONG_READING.limit
    spare = int(kept.sum()) - 2
    if spare < 1:
        return sigma_mm
    axis = state.slope / np.linalg.norm(state.slope)
    basis = across(axis)
    out, limit = [], Code.READINGS_SCATTER.limit
    for directions, given in ((axis[:, None], sigma_mm[0]), (basis, sigma_mm[1])):
        shift = system.shift_mm[kept] @ directions
        own = np.einsum("ia,vij,ja->va", directions, system.shift_covariance[kept], directions)
        dof = spare * directions.shape[1]
        score = float((shift**2 / (own + given**2)).sum())
        excess = float((shift**2).sum() / dof - own.mean())
        out.append(np.sqrt(excess) if score > chi2.isf(limit, dof) and excess > 0 else given)
    return float(max(out[0], sigma_mm[0])), float(max(out[1], sigma_mm[1]))


def _scatters(given: tuple[float, float], observed: tuple[float, float]) -> list[Finding]:
    codes = (Code.READINGS_SCATTER, Code.CARRIAGE_WANDERS)
    return [
        code.found(found_um=1000 * new, stated_um=1000 * old)
        for code, old, new in zip(codes, given, observed)
        if new > old
    ]


def _suspects(dots: Dots, weights: Weights, system: StageEquations) -> list[Finding]:
    """Return findings on readings and dots of almost no weight, and on only two positions."""
    found = []
    for v in np.flatnonzero(weights.views < Code.WRONG_READING.limit).tolist():
        error = float(np.linalg.norm(system.shift_mm[v]))
        reading = float(dots.reading_mm[v])
        wrong = Code.WRONG_READING.found(views=dots.views[v], reading_mm=reading, error_mm=error)
        found.append(wrong)
    odd = int((weights.dots < Code.STAGE_OUTLIERS.limit).sum())
    if odd:
        found.append(Code.STAGE_OUTLIERS.found(count=odd, dots=len(weights.dots)))
    if len(dots.views) == 2:
        found.append(Code.TWO_POSITIONS.found())
    return found


def _result(
    calibration: Calibration,
    dots: Dots,
    state: State,
    weights: Weights,
    system: StageEquations,
    sigma_mm: tuple[float, float],
    findings: list[Finding],
) -> StageAxis:
    """Return the stage with its covariance, which includes that of the cameras' calibration."""
    kept = weights.dots > Code.STAGE_OUTLIERS.limit
    spare = 2 * int(kept.sum()) - 3 * len(dots.views) - 3
    chi2_dof = float(system.dot_score[kept].sum() / spare) if spare > 0 else 1.0
    inverse = np.linalg.inv(system.normal)
    by_rig = -inverse @ system.by_rig
    full = max(chi2_dof, 1.0) * inverse + by_rig @ calibration.covariance @ by_rig.T
    travel_per_reading = float(np.linalg.norm(state.slope))
    axis = state.slope / travel_per_reading
    basis = across(axis)
    turn = np.vstack([basis.T / travel_per_reading, -axis / travel_per_reading**2])
    joint = turn @ full[6:, 6:] @ turn.T
    return StageAxis(
        axis,
        basis,
        joint[:2, :2],
        1 / travel_per_reading - 1,
        float(np.sqrt(joint[2, 2])),
        joint,
        state.rig_from_target,
        chi2_dof,
        *sigma_mm,
        (_summary(dots, axis, travel_per_reading, joint), *findings),
    )


def _summary(dots: Dots, axis: Array, travel_per_reading: float, joint: Array) -> Finding:
    return Code.STAGE.found(
        **dict(zip("xyz", axis.tolist())),
        sd_deg=float(np.degrees(np.sqrt(np.linalg.eigvalsh(joint[:2, :2])[-1]))),
        positions=len(dots.views),
        range_mm=float(np.ptp(dots.reading_mm)),
        scale_ppm=1e6 * (1 / travel_per_reading - 1),
        scale_sd_ppm=float(1e6 * np.sqrt(joint[2, 2])),
    )


_STEPS = 60
_REWEIGHTED = 25
_SUSPECT = 3.5


@dataclass(frozen=True)
class Dots:
    """M measured dots of one target in V views.

    reading_mm : (V,) encoder reading of each view.
    view, camera : (M,) indices.
    place_mm : (M, 3) position of each dot in the target frame.
    uv_px : (M, 2) measured pixels.
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
    """The unknowns of the fit.

    rig_from_target : pose of the target at reading 0.
    slope : (3,) travel in rig axes per mm of the encoder's reading.
    """

    rig_from_target: Pose
    slope: Array


@dataclass(frozen=True)
class Weights:
    """Robust weights from 0 to 1 of the dots (M,) and of the views' encoder readings (V,)."""

    dots: Array
    views: Array


@dataclass(frozen=True)
class StageEquations:
    """The normal equations of the 9 unknowns (6 of the pose, 3 of the slope).

    The errors of the carriage's position in each of the V views have been eliminated.

    normal, right : (9, 9) matrix and (9,) right-hand side.
    by_rig : (9, P) coupling with the P parameters of the cameras.
    shift_mm, shift_covariance : (V, 3) deviation of each view from the straight line in mm, and
        (V, 3, 3) its covariance in mm^2.
    dot_score : (M,) squared residual of each of the M dots, divided by its variance, if each
        view may deviate freely.
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

    free : for each camera the names of its free intrinsics. sigma_mm : standard deviations of the
    carriage's position along and across the axis. A dot or an encoder reading that is farther than
    3.5 standard deviations from the fit loses weight (`travel_weights`).
    Returns the fitted state, the weights and the equations at this state. Raises CalibrationError
    if the fit does not converge.
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
        limit = next_limit(limit, highest, _SUSPECT)
        fresh = weights
        if turn < _REWEIGHTED:
            fresh = Weights(*(travel_weights(score, limit) for score in scores))
        moved = np.ptp(fresh.dots - weights.dots) + np.ptp(fresh.views - weights.views)
        weights = fresh
        system = linearised(cameras, free, dots, state, sigma_mm, weights)
        if limit == _SUSPECT and moved < 1e-3 and np.abs(step).max() < 1e-7:
            return state, weights, system
    raise CalibrationError(
        "the fit of a straight stage axis to the views of the target does not converge",
        where="stage_axis",
        todo="check that the target stood still while the stage moved, and that the positions in "
        "positions.csv are those of these views",
    )


def _scores(system: StageEquations, state: State, sigma_mm: float) -> tuple[Array, Array]:
    """Return squared distances of the dots (M,) and of the readings (V,), in standard deviations.

    If readings scatter by more than twice the stated value, the observed scatter replaces it.
    """
    axis = state.slope / np.linalg.norm(state.slope)
    own = np.einsum("i,vij,j->v", axis, system.shift_covariance, axis)
    off = system.shift_mm @ axis
    spread = float(robust_sd(off))
    stated = float(np.sqrt(np.median(own) + sigma_mm**2))
    variance = own + sigma_mm**2 if spread < 2 * stated else own + spread**2
    return system.dot_score, off**2 / variance


def linearised(
    cameras: tuple[Camera, ...],
    free: tuple[tuple[str, ...], ...],
    dots: Dots,
    state: State,
    sigma_mm: tuple[float, float],
    weights: Weights,
) -> StageEquations:
    """Return the normal equations at a state, with the carriage's error of each view eliminated.

    free, sigma_mm : as for `fit`.
    """
    residual, by_point, by_state, by_rig = derivatives(cameras, free, dots, state)
    weighted = np.linalg.cholesky(dots.information).swapaxes(-1, -2)
    value = np.einsum("mij,mj->mi", weighted, residual)
    by_point = weighted @ by_point
    seen, pull = np.zeros((len(dots.views), 3, 3)), np.zeros((len(dots.views), 3))
    root = np.sqrt(weights.dots)[:, None, None]
    white, right = root * by_point, root[..., 0] * value
    np.add.at(seen, dots.view, white.swapaxes(-1, -2) @ white)
    np.add.at(pull, dots.view, np.einsum("mki,mk->mi", white, right))
    spread = np.asarray(np.linalg.pinv(seen, rcond=1e-9, hermitian=True), np.float64)
    shift = np.einsum("vij,vj->vi", spread, pull)
    # the carriage's error is in units of its standard deviation, because that may be zero
    unit = np.tile(_across(state.slope), (len(dots.views), 1, 1))
    unit[..., 0] *= sigma_mm[0] / np.sqrt(weights.views)[:, None]
    unit[..., 1:] *= sigma_mm[1]
    kept = root * weighted @ np.concatenate([by_state, by_rig], -1)
    cross = np.zeros((len(dots.views), kept.shape[-1], 3))
    np.add.at(cross, dots.view, kept.swapaxes(-1, -2) @ white)
    cross, blocks = cross @ unit, np.eye(3) + unit.swapaxes(-1, -2) @ seen @ unit
    gain = np.linalg.solve(blocks, cross.swapaxes(-1, -2))
    flat = kept.reshape(-1, kept.shape[-1])
    normal = flat.T @ flat - np.einsum("vki,vil->kl", cross, gain)
    own = np.einsum("vij,vi->vj", unit, pull)
    moment = flat.T @ right.ravel() - np.einsum("vik,vi->k", gain, own)
    off = value - np.einsum("mki,mi->mk", by_point, shift[dots.view])
    score = (off**2).sum(-1)
    return StageEquations(normal[:9, :9], moment[:9], normal[:9, 9:], shift, spread, score)


def _across(slope: Array) -> Array:
    """Return the direction of travel and two perpendicular unit vectors, as columns (3, 3)."""
    basis, _ = np.linalg.qr(np.column_stack([slope, np.eye(3)]))
    return np.asarray(basis)


def derivatives(
    cameras: tuple[Camera, ...], free: tuple[tuple[str, ...], ...], dots: Dots, state: State
) -> tuple[Array, Array, Array, Array]:
    """Return the residuals of M dots, and the derivatives of the predicted pixels.

    Returns the residuals (M, 2) in px, measured minus predicted, and the derivatives (M, 2, 3) with
    respect to the dot's position in the rig frame, (M, 2, 9) with respect to the state, and
    (M, 2, P) with respect to the cameras' P parameters.
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

    The dots are triangulated. The travel (mm along the rig's axes for each mm of the encoder) is a
    median over pairs of views, and the target is fitted to the median position of each dot. Raises
    CalibrationError if no dot is seen by two cameras at once at two positions of the stage.
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
    """Return the travel (3,) per unit of reading, the median over pairs of views (Theil-Sen)."""
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
            "no dot is seen by two cameras at once at two or more positions of the stage",
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
