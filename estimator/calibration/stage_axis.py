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
from scipy.special import chdtri

from telerig.arrays import Array, Ints
from telerig.errors import CalibrationError, InputError, suggestion
from telerig.estimator.calibration.solver.gaussian import Gaussian
from telerig.estimator.calibration.solver.problem import (
    Problem,
    eccentricity_px,
    nominal_state,
    problem_from_dots,
)
from telerig.estimator.calibration.solver.system import System, retracted
from telerig.estimator.calibration.start.known_target import plate_sides
from telerig.estimator.calibration.start.symmetric_target import numbered_as_calibrated
from telerig.estimator.calibration.thresholds import LEAST_TRAVEL_MM
from telerig.factors.calibration import State, whitened_error
from telerig.factors.robust_loss import next_limit, travel_weights
from telerig.io.dataset.dataset import Dataset, image_views
from telerig.io.dataset.tables import read_dots_csv
from telerig.io.files.csv_table import read_table
from telerig.io.results.findings import Code, Finding
from telerig.io.tables.calibration import POSITIONS
from telerig.rig.pose import Pose, across
from telerig.rig.target import Target
from telerig.rig.triangulation import triangulate_any
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


def stage_axis_from(dataset: Dataset, calibration: Calibration) -> StageAxis:
    """Measure the stage's axis from the folder `stage_axis/` of a dataset.

    If rig.toml states another direction of travel, ``findings`` of the result say so. Raises
    InputError if the folder has no positions.csv, or both or neither of images and dots.csv, and
    the errors of `stage_axis_of`.
    """
    folder = dataset.path / FOLDER
    positions = _positions(folder)
    described, read = dataset.rig.stage, list[Finding]()
    found = stage_axis_of(
        calibration,
        dataset.target,
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
    views = image_views(folder, dataset.rig, notes, tables=("dots.csv", _POSITIONS))
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


def _far_axis(axis: Array, stated: tuple[float, float, float]) -> list[Finding]:
    """Return a finding if rig.toml states a direction that differs from the measured one."""
    angle = float(np.degrees(np.arccos(np.clip(axis @ np.asarray(stated), -1, 1))))
    if angle < Code.STAGE_AXIS_FAR.limit:
        return []
    return [Code.STAGE_AXIS_FAR.found(angle_deg=angle, **dict(zip("xyz", axis.tolist())))]


def stage_axis_of(
    calibration: Calibration,
    target: Target,
    table: pd.DataFrame,
    positions_mm: Mapping[str, float] | pd.DataFrame,
    *,
    position_sigma_mm: float = 0.001,
    wander_sigma_mm: float = 0.0,
) -> StageAxis:
    """Measure the axis of travel and the encoder's scale from views at several stage positions.

    The covariance of the result includes the errors of the cameras' calibration.

    target : whose dots the calibration knows; their diameters correct the measured centres.
    table : measured dots of the target at rest, with the columns of dots.csv: view, camera, dot,
        u_px, v_px and either suu_px2, suv_px2, svv_px2 or sigma_px.
    positions_mm : the encoder reading of each view, a mapping or a table with the columns view and
        position_mm.
    position_sigma_mm, wander_sigma_mm : as in `StageAxis`.

    Raises InputError for views without a position and for unknown cameras, and CalibrationError for
    fewer than two positions, less than 1 mm between them, or a single camera.
    """
    stops, findings = _stops(calibration, target, table, positions_mm)
    sigma = (position_sigma_mm, wander_sigma_mm)
    stops, travel, weights, system = _on_best_side(stops, sigma)
    observed = _observed_sigma(travel, weights, system, sigma)
    if observed != sigma:
        findings += _scatters(sigma, observed)
        sigma = observed
        travel, weights, system = fit(stops, travel, sigma)
    findings += _suspects(stops, weights, system)
    return _result(calibration, stops, travel, weights, system, sigma, findings)


def _on_best_side(
    stops: Stops, sigma_mm: tuple[float, float]
) -> tuple[Stops, Travel, Weights, StageEquations]:
    """Return the fit, of a two-sided plate that with the side of the dots that fits better.

    sigma_mm : as for `fit`.
    """
    found, errors = [], []
    for problem in plate_sides(stops.problem):
        side = replace(stops, problem=problem)
        try:
            travel = start(side)
            eccentric = eccentricity_px(problem, side.state(travel))
            side = replace(side, problem=replace(problem, eccentricity_px=eccentric))
            found.append((side, *fit(side, travel, sigma_mm)))
        except CalibrationError as error:
            errors.append(error)
    if not found:
        raise errors[0]
    return min(found, key=lambda one: np.minimum(one[-1].dot_score, _SUSPECT**2).sum())


def _stops(
    calibration: Calibration,
    target: Target,
    table: pd.DataFrame,
    positions_mm: Mapping[str, float] | pd.DataFrame,
) -> tuple[Stops, list[Finding]]:
    """Return the dots that the calibration knows, and findings on those that it does not."""
    readings = _readings(positions_mm)
    names = [c.name for c in calibration.cameras]
    _check_names(table, "view", list(readings), "has no position")
    _check_names(table, "camera", names, "is not in the calibration")
    if target.bounded and target.symmetry_order() > 1:
        table = _numbered_alike(calibration, target, table)
    known = table["dot"].isin(calibration.dot_ids).to_numpy()
    unknown = int((~known).sum())
    findings = [Code.UNKNOWN_DOTS.found(count=unknown)] if unknown else []
    if unknown and not known.any():
        raise InputError(
            f"none of the {unknown} dots has a number that is in the calibration",
            where=FOLDER,
            todo="number the dots as in the calibration, and show the same target",
        )
    rows = _with_covariance(table[known], calibration)
    held = replace(target, scale_dots=None)
    problem = replace(problem_from_dots(rows, calibration.cameras, held), free=calibration.free)
    unseen = [v for v in readings if v not in problem.views]
    findings += [Code.UNSEEN_POSITIONS.found(views=unseen)] if unseen else []
    reading = np.array([readings[v] for v in problem.views])
    _check_enough(reading, set(rows["camera"]))
    index = {int(d): i for i, d in enumerate(calibration.dot_ids)}
    place = calibration.target_points_mm[[index[int(d)] for d in problem.dot_ids]]
    return Stops(problem, replace(nominal_state(problem), dots_mm=place), reading), findings


def _numbered_alike(calibration: Calibration, target: Target, table: pd.DataFrame) -> pd.DataFrame:
    """Return the table of a target without marks with the numbers of the calibration's dots."""
    names = [c.name for c in calibration.cameras]
    ids, uv_px = table["dot"].to_numpy(np.int64), table[["u_px", "v_px"]].to_numpy(float)
    sound = target.known_id(ids) & np.isfinite(uv_px).all(1)
    _, view = np.unique(table["view"].astype(str), return_inverse=True)
    camera = np.array([names.index(name) for name in table["camera"].astype(str)], np.int64)
    places = dict(zip(calibration.dot_ids.tolist(), calibration.target_points_mm))
    dot = ids.copy()
    dot[sound] = numbered_as_calibrated(
        view[sound], camera[sound], ids[sound], uv_px[sound], calibration.cameras, target, places
    )
    return table.assign(dot=dot)


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


def _with_covariance(rows: pd.DataFrame, calibration: Calibration) -> pd.DataFrame:
    """Return the table with the pixels' covariances, by default the calibration's scatter."""
    if all(c in rows for c in _COVARIANCE):
        return rows
    scatter = float(calibration.statistics.get("scatter_px", 0.02))
    variance = rows.get("sigma_px", scatter) ** 2
    return rows.assign(suu_px2=variance, suv_px2=0.0, svv_px2=variance)


def _observed_sigma(
    travel: Travel, weights: Weights, system: StageEquations, sigma_mm: tuple[float, float]
) -> tuple[float, float]:
    """Return the carriage's standard deviations, as observed if significantly larger than given.

    A straight line uses up two of the views' positions in each direction.
    """
    kept = weights.views > Code.WRONG_READING.limit
    spare = int(kept.sum()) - 2
    if spare < 1:
        return sigma_mm
    axis = travel.slope / np.linalg.norm(travel.slope)
    basis = across(axis)
    out, limit = [], Code.READINGS_SCATTER.limit
    for directions, given in ((axis[:, None], sigma_mm[0]), (basis, sigma_mm[1])):
        shift = system.shift_mm[kept] @ directions
        own = np.einsum("ia,vij,ja->va", directions, system.shift_covariance[kept], directions)
        dof = spare * directions.shape[1]
        score = float((shift**2 / (own + given**2)).sum())
        excess = float((shift**2).sum() / dof - own.mean())
        out.append(np.sqrt(excess) if score > chdtri(dof, limit) and excess > 0 else given)
    return float(max(out[0], sigma_mm[0])), float(max(out[1], sigma_mm[1]))


def _scatters(given: tuple[float, float], observed: tuple[float, float]) -> list[Finding]:
    codes = (Code.READINGS_SCATTER, Code.CARRIAGE_WANDERS)
    return [
        code.found(found_um=1000 * new, stated_um=1000 * old)
        for code, old, new in zip(codes, given, observed)
        if new > old
    ]


def _suspects(stops: Stops, weights: Weights, system: StageEquations) -> list[Finding]:
    """Return findings on readings and dots of almost no weight, and on only two positions."""
    found = []
    for v in np.flatnonzero(weights.views < Code.WRONG_READING.limit).tolist():
        error = float(np.linalg.norm(system.shift_mm[v]))
        reading, view = float(stops.reading_mm[v]), stops.problem.views[v]
        found.append(Code.WRONG_READING.found(views=view, reading_mm=reading, error_mm=error))
    odd = int((weights.dots < Code.STAGE_OUTLIERS.limit).sum())
    if odd:
        found.append(Code.STAGE_OUTLIERS.found(count=odd, dots=len(weights.dots)))
    if len(stops.reading_mm) == 2:
        found.append(Code.TWO_POSITIONS.found())
    return found


def _result(
    calibration: Calibration,
    stops: Stops,
    travel: Travel,
    weights: Weights,
    system: StageEquations,
    sigma_mm: tuple[float, float],
    findings: list[Finding],
) -> StageAxis:
    """Return the stage with its covariance, which includes that of the cameras' calibration."""
    kept = weights.dots > Code.STAGE_OUTLIERS.limit
    spare = 2 * int(kept.sum()) - 3 * len(stops.reading_mm) - 3
    chi2_dof = float(system.dot_score[kept].sum() / spare) if spare > 0 else 1.0
    own = system.given_cameras().marginal(np.arange(6, 9))
    by_rig = system.gaussian.moved_by(np.arange(system.rig))[6:9]
    full = max(chi2_dof, 1.0) * own + by_rig @ calibration.covariance @ by_rig.T
    travel_per_reading = float(np.linalg.norm(travel.slope))
    axis = travel.slope / travel_per_reading
    basis = across(axis)
    turn = np.vstack([basis.T / travel_per_reading, -axis / travel_per_reading**2])
    joint = turn @ full @ turn.T
    return StageAxis(
        axis,
        basis,
        joint[:2, :2],
        1 / travel_per_reading - 1,
        float(np.sqrt(joint[2, 2])),
        joint,
        Pose(travel.rig_from_target[:3, :3], travel.rig_from_target[:3, 3]),
        chi2_dof,
        *sigma_mm,
        (_summary(stops, axis, travel_per_reading, joint), *findings),
    )


def _summary(stops: Stops, axis: Array, travel_per_reading: float, joint: Array) -> Finding:
    return Code.STAGE.found(
        **dict(zip("xyz", axis.tolist())),
        sd_deg=float(np.degrees(np.sqrt(np.linalg.eigvalsh(joint[:2, :2])[-1]))),
        positions=len(stops.reading_mm),
        range_mm=float(np.ptp(stops.reading_mm)),
        scale_ppm=1e6 * (1 / travel_per_reading - 1),
        scale_sd_ppm=float(1e6 * np.sqrt(joint[2, 2])),
    )


_SUSPECT = 3.5


@dataclass(frozen=True)
class Travel:
    """The unknowns of the fit.

    rig_from_target : (4, 4) pose of the target at reading 0.
    slope : (3,) travel in rig axes per mm of the encoder's reading.
    """

    rig_from_target: Array
    slope: Array

    def moved(self, step: Array) -> Travel:
        """Return the travel after a step (9,): of the pose's tangent, and of the slope."""
        return Travel(retracted(self.rig_from_target, step[:6]), self.slope + step[6:])


@dataclass(frozen=True)
class Stops:
    """Views of one target at V positions of the stage.

    problem : the measured dots, with the calibrated cameras.
    known : the cameras, and the dots' places in the target's frame, which are those of the
        calibration.
    reading_mm : (V,) encoder reading of each view.
    """

    problem: Problem
    known: State
    reading_mm: Array

    def state(self, travel: Travel, shift_mm: Array | float = 0.0) -> State:
        """Return the state in which the views are displaced from the travel by (V, 3)."""
        poses = np.tile(travel.rig_from_target, (len(self.reading_mm), 1, 1))
        poses[:, :3, 3] += shift_mm - self.reading_mm[:, None] * travel.slope
        return replace(self.known, rig_from_target=poses)


@dataclass(frozen=True)
class Weights:
    """Robust weights from 0 to 1 of the dots (M,) and of the views' encoder readings (V,)."""

    dots: Array
    views: Array


@dataclass(frozen=True)
class StageEquations:
    """The equations at one `Travel`.

    gaussian : of the P parameters of the cameras, the 9 of the travel, and the carriage's errors in
        each view (3 each), in standard deviations.
    rig : P.
    shift_mm, shift_covariance : (V, 3) deviation of each view from the straight line in mm, and
        (V, 3, 3) its covariance in mm^2.
    dot_score : (M,) squared residual of each of the M dots, divided by its variance, if each
        view may deviate freely.
    """

    gaussian: Gaussian
    rig: int
    shift_mm: Array
    shift_covariance: Array
    dot_score: Array

    def given_cameras(self) -> Gaussian:
        """Return the Gaussian of the travel and the carriage's errors, with the cameras held."""
        return self.gaussian.hold(np.arange(self.rig))


def fit(
    stops: Stops,
    travel: Travel,
    sigma_mm: tuple[float, float],
    *,
    steps: int = 60,
    reweighted: int = 25,
) -> tuple[Travel, Weights, StageEquations]:
    """Fit the travel to the dots by robust Gauss-Newton steps from a start.

    sigma_mm : standard deviations of the carriage's position along and across the axis. A dot or an
    encoder reading that is farther than 3.5 standard deviations from the fit loses weight
    (`travel_weights`).
    steps : largest number of steps. reweighted : after so many the weights stay.
    Returns the fitted travel, the weights and the equations there. Raises CalibrationError if the
    fit does not converge.
    """
    weights = Weights(np.ones(len(stops.problem.view)), np.ones(len(stops.reading_mm)))
    system = linearised(stops, travel, sigma_mm, weights)
    limit = np.inf
    for turn in range(steps):
        step = system.given_cameras().step()[0][:9]
        travel = travel.moved(step)
        scores = _scores(system, travel, sigma_mm[0])
        highest = float(np.sqrt(max(s.max() for s in scores)))
        limit = next_limit(limit, highest, _SUSPECT)
        fresh = weights
        if turn < reweighted:
            fresh = Weights(*(travel_weights(score, limit) for score in scores))
        moved = np.ptp(fresh.dots - weights.dots) + np.ptp(fresh.views - weights.views)
        weights = fresh
        system = linearised(stops, travel, sigma_mm, weights)
        if limit == _SUSPECT and moved < 1e-3 and np.abs(step).max() < 1e-7:
            return travel, weights, system
    raise CalibrationError(
        "the fit of a straight stage axis to the views of the target does not converge",
        where="stage_axis",
        todo="check that the target stood still while the stage moved, and that the positions in "
        "positions.csv are those of these views",
    )


def _scores(system: StageEquations, travel: Travel, sigma_mm: float) -> tuple[Array, Array]:
    """Return squared distances of the dots (M,) and of the readings (V,), in standard deviations.

    If readings scatter by more than twice the stated value, the observed scatter replaces it.
    """
    axis = travel.slope / np.linalg.norm(travel.slope)
    own = np.einsum("i,vij,j->v", axis, system.shift_covariance, axis)
    off = system.shift_mm @ axis
    spread = float(robust_sd(off))
    stated = float(np.sqrt(np.median(own) + sigma_mm**2))
    variance = own + sigma_mm**2 if spread < 2 * stated else own + spread**2
    return system.dot_score, off**2 / variance


def linearised(
    stops: Stops, travel: Travel, sigma_mm: tuple[float, float], weights: Weights
) -> StageEquations:
    """Return the equations at a travel. sigma_mm : as for `fit`."""
    problem, state = replace(stops.problem, weight=weights.dots), stops.state(travel)
    system, views = System(problem), len(stops.reading_mm)
    rig, turn = system.views_at, travel.rig_from_target[:3, :3]
    # the pose of each view by the common rotation, and by its own place in rig axes
    by_place = np.eye(system.dots_at, rig + 3 + 3 * views)
    poses = by_place[rig:].reshape(views, 2, 3, -1)
    poses[:] = 0.0
    poses[:, 0, :, rig : rig + 3] = np.eye(3)
    at = rig + 3 + np.arange(3 * views).reshape(-1, 3)
    for pose, columns in zip(poses, at):
        pose[1, :, columns] = turn
    held = np.arange(system.dots_at, system.size)
    placed = system.gaussian(state).hold(held).in_terms_of(by_place)
    seen = placed.common[at[:, :, None], at[:, None]]
    spread = np.asarray(np.linalg.pinv(seen, rcond=1e-9, hermitian=True), np.float64)
    shift = np.einsum("vij,vj->vi", spread, placed.right[at])
    # the places by the target's position, the slope, and the carriage's error, which is in units of
    # its standard deviation, because that may be zero
    unit = np.tile(_across(travel.slope), (views, 1, 1))
    unit[..., 0] *= sigma_mm[0] / np.sqrt(weights.views)[:, None]
    unit[..., 1:] *= sigma_mm[1]
    by_travel = np.eye(rig + 3 + 3 * views, rig + 9 + 3 * views)
    places = by_travel[rig + 3 :].reshape(views, 3, -1)
    places[:] = 0.0
    places[..., rig + 3 : rig + 6] = turn
    places[..., rig + 6 : rig + 9] = -stops.reading_mm[:, None, None] * np.eye(3)
    for place, columns, error in zip(places, at + 6, unit):
        place[:, columns] = error
    errors = np.eye(by_travel.shape[1])[rig + 9 :]
    gaussian = placed.in_terms_of(by_travel).add_rows(errors, np.zeros(len(errors)))
    deviating = stops.state(travel, shift)
    off = whitened_error(deviating, problem.unweighted(), problem.rho_mm)
    return StageEquations(gaussian, rig, shift, spread, (off**2).sum(-1))


def _across(slope: Array) -> Array:
    """Return the direction of travel and two perpendicular unit vectors, as columns (3, 3)."""
    basis, _ = np.linalg.qr(np.column_stack([slope, np.eye(3)]))
    return np.asarray(basis)


def start(stops: Stops) -> Travel:
    """Return a travel in closed form from which `fit` can start.

    The dots are triangulated. The travel (mm along the rig's axes for each mm of the encoder) is a
    median over pairs of views, and the target is fitted to the median position of each dot. Raises
    CalibrationError if no dot is seen by two cameras at once at two positions of the stage.
    """
    problem, count = stops.problem, len(stops.known.dots_mm)
    found, point = np.unique(problem.view * count + problem.dot, return_inverse=True)
    pixels = np.full((len(problem.cameras), len(found), 2), np.nan)
    pixels[problem.camera, point] = problem.uv_px
    several = np.isfinite(pixels[..., 0]).sum(0) > 1
    view, dot = np.divmod(found[several], count)
    points = triangulate_any(problem.cameras, list(pixels[:, several]), 0.02).points_mm
    reading = stops.reading_mm[view]
    slope = _median_slope(reading, dot, points)
    at_zero = points + slope * reading[:, None]
    seen = np.unique(dot)
    middle = np.array([np.median(at_zero[dot == one], axis=0) for one in seen])
    return Travel(Pose.aligning(stops.known.dots_mm[seen], middle).matrix, slope)


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
