"""From a finished fit to a `Calibration`: numbers and tables, and whether the model fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.estimator.calibration.lens_choice import Choice, Step
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.solver.covariance import JointCovariance
from telerig.estimator.calibration.solver.gaussian import Estimate
from telerig.estimator.calibration.solver.problem import Problem, cameras_from_state
from telerig.estimator.calibration.solver.robust_least_squares import (
    RobustFit,
    lost_views,
    pixel_residuals,
    squared_distance,
)
from telerig.estimator.calibration.solver.system import Solution, System
from telerig.estimator.calibration.start.mirror_ambiguity import MirrorChoice, Nominal
from telerig.estimator.calibration.thresholds import SURE_SD, UNEXPLAINED
from telerig.factors.calibration import State, pixels
from telerig.io.results.findings import Code, Finding
from telerig.rig.lens_parameters import GROUPS, INDEX, groups_of, joint_name, name_of
from telerig.rig.pose import Pose, rotvec_from_rotation
from telerig.rig.triangulation import aligned_covariance, triangulate_any

GAUGE = (
    "rig frame = first camera's frame, its origin where {axes} come closest; image "
    "centres held at the middle of the image unless the model frees them; target frame tied to "
    "the nominal dot positions by the dots' priors"
)
GAUGE_OF_SCALES = (
    "rig frame = first camera's frame; the optical axes are nearly parallel, so the depth of each "
    "camera's origin is where its scale is the stated one; target frame tied to the nominal dot "
    "positions by the dots' priors"
)


@dataclass(frozen=True)
class Fit:
    """A finished self-calibration of C cameras.

    models : name of each camera's lens model.
    model_words : a phrase on how they were chosen.
    choice : the choice of the models; None if the user gave them.
    mirror : the solution of the mirror ambiguity that was kept.
    mirrored_cost : cost of the other.
    tilts_deg : by (view, camera) the angle between the target's normal and the optical axis.
    """

    robust: RobustFit
    models: tuple[str, ...]
    model_words: str
    choice: Choice | None
    mirror: MirrorChoice | None = None
    mirrored_cost: float = np.nan
    tilts_deg: dict[tuple[int, int], float] = field(default_factory=dict)

    @property
    def model(self) -> str:
        """Return the models of all cameras as one name."""
        return joint_name(self.models, [c.name for c in self.robust.problem.cameras])


def calibration_from_fit(
    fit: Fit,
    joint: JointCovariance,
    free: tuple[tuple[str, ...], ...],
    *,
    nominal_rotvec_deg: Nominal,
    name: str,
) -> Calibration:
    """Make the public `Calibration` from a finished fit, in which the mirror ambiguity is resolved.

    joint : covariance of all parameters.
    free : for each camera the names of the intrinsics that the covariance contains.
    nominal_rotvec_deg : nominal rotation vectors by the camera's index.
    name : name of the rig.
    """
    problem, state = fit.robust.problem, fit.robust.solution.state
    cameras = cameras_from_state(problem, state)
    rig_names, rig_covariance = joint.rig_block()
    residuals = residual_table(problem, state)
    statistics = _statistics(fit, joint, residuals) | _geometry(fit, joint)
    calibration = Calibration(
        cameras=cameras,
        dot_ids=problem.dot_ids,
        target_points_mm=state.dots_mm,
        target_poses={
            view: Pose(m[:3, :3], m[:3, 3]) for view, m in zip(problem.views, state.rig_from_target)
        },
        covariance=rig_covariance,
        covariance_names=rig_names,
        free=free,
        name=name,
        statistics=statistics,
        twin=_mirror(fit, nominal_rotvec_deg),
        model=_model(fit),
        diagnostics={
            "gauge": _gauge(problem),
            "dots_hull_px": _hulls(residuals),
            "tilts_deg": {
                f"{problem.views[v]}/{problem.cameras[c].name}": t
                for (v, c), t in fit.tilts_deg.items()
            },
        },
        joint_names=joint.names,
        joint_covariance=joint.matrix,
        tables={"dots.csv": dot_table(problem), "residuals.csv": residuals},
    )
    statistics |= _space(calibration, problem, state)
    return calibration


def _hulls(residuals: pd.DataFrame) -> dict[str, tuple[tuple[float, float], ...]]:
    """Return for each camera the corners (n, 2) of the convex hull of its used dots, in px."""
    import cv2

    used = residuals[residuals["weight"] > 0]
    corners = {
        str(name): cv2.convexHull(mine[["u_px", "v_px"]].to_numpy(np.float32))[:, 0].tolist()
        for name, mine in used.groupby("camera", sort=False)
    }
    return {name: tuple((u, v) for u, v in found) for name, found in corners.items()}


def _gauge(problem: Problem) -> str:
    if problem.scales_held:
        return GAUGE_OF_SCALES
    axes = "the two optical axes" if len(problem.cameras) <= 2 else "the first two optical axes"
    if problem.origin_camera > 1:
        first, other = (problem.cameras[c].name for c in (0, problem.origin_camera))
        axes = f"the optical axes of cameras {first!r} and {other!r}"
    return GAUGE.format(axes=axes)


def dot_table(problem: Problem) -> pd.DataFrame:
    """Return the table of the measured dots (for `dots.csv`), a row per dot and image."""
    ids = problem.dot_ids[problem.dot]
    row, column = problem.target.row_column_from_id(ids)
    return pd.DataFrame(
        {
            "view": np.array(problem.views)[problem.view],
            "camera": np.array([c.name for c in problem.cameras])[problem.camera],
            "dot": ids, "row": row, "column": column,
            "u_px": problem.uv_px[:, 0], "v_px": problem.uv_px[:, 1],
        }
    )  # fmt: skip


def residual_table(problem: Problem, state: State) -> pd.DataFrame:
    """Return the content of `residuals.csv`: `dot_table` with residuals, weights and reasons.

    Residuals are measured minus predicted centres of the dots' images. The reason says why a
    weight is less than 1.
    """
    residual = -pixel_residuals(problem, state)
    distance = np.sqrt(squared_distance(residual, problem.covariance_px2))
    table = dot_table(problem)
    table["du_px"], table["dv_px"] = residual[:, 0], residual[:, 1]
    table["weight"] = problem.weight
    lost = np.isin(problem.view, lost_views(problem, problem.weight))
    table["reason"] = [
        "" if w >= 1 else _reason(d, bool(alone), problem.outlier_sd)
        for w, d, alone in zip(problem.weight, distance, lost)
    ]
    return table


def _reason(distance: float, lost_view: bool, limit: float) -> str:
    if lost_view:
        return (
            "the dots of this view that agree with the model are too few, or in one row, to place "
            "the target"
        )
    return f"{distance:.1f} standard deviations from the model (limit {limit:g})"


def misfits(fit: Fit, statistics: Mapping[str, Any]) -> list[Finding]:
    """Return findings on how far the model describes the images as a whole, and each image."""
    found = []
    scatter = {name: statistics[name] for name in ("scatter_px", "image_noise_px")}
    floor, chi2 = statistics["noise_floor_px"], statistics["chi2_dof"]
    if floor > Code.MODEL_FAILS.limit:
        found.append(Code.MODEL_FAILS.found(text=fit.model, **scatter))
    elif floor > Code.SYSTEMATIC.limit * scatter["image_noise_px"]:
        found.append(Code.SYSTEMATIC.found(text=fit.model, **scatter))
    if (share := statistics["share_kept"]) < Code.FEW_KEPT.limit:
        found.append(Code.FEW_KEPT.found(share=share))
    spread = SURE_SD * np.sqrt(2 / max(statistics["degrees_of_freedom"], 1))
    if abs(chi2 - 1) > max(Code.CHI_SQUARE.limit, spread):
        found.append(Code.CHI_SQUARE.found(chi2_dof=chi2))
    problem = fit.robust.problem
    measured, kept = np.zeros((2, len(problem.views), len(problem.cameras)))
    np.add.at(measured, (problem.view, problem.camera), 1)
    np.add.at(kept, (problem.view, problem.camera), problem.kept)
    odd = kept < Code.ODD_VIEW.limit * measured
    for view in np.flatnonzero(odd.any(1)):
        cameras, numbers = np.flatnonzero(odd[view]), (kept[view], measured[view])
        few, dots = (float(n[cameras].sum()) for n in numbers)
        names = [problem.cameras[c].name for c in cameras]
        found.append(
            Code.ODD_VIEW.found(views=problem.views[view], cameras=names, kept=few, dots=dots)
        )
    return found


def _statistics(fit: Fit, joint: JointCovariance, residuals: pd.DataFrame) -> dict[str, Any]:
    problem = fit.robust.problem
    kept = problem.kept
    values = residuals[["du_px", "dv_px"]].to_numpy()
    squares = (problem.weight * squared_distance(values, problem.covariance_px2))[kept].sum()
    out: dict[str, Any] = {
        "views": len(problem.views),
        "dots_measured": len(kept),
        "dots_kept": int(kept.sum()),
        "share_kept": float(kept.mean()),
        "rms_px": _rms(values[kept]),
        "rms_all_px": _rms(values),
        "chi2_dof": float(squares / joint.effective_dof),
        "degrees_of_freedom": joint.effective_dof,
        "cost": fit.robust.solution.cost,
        "iterations": fit.robust.solution.iterations,
        "noise_floor_px": fit.robust.floor_px,
        "scatter_px": _scatter(problem.covariance_px2),
        "image_noise_px": _scatter(problem.covariance_px2 - fit.robust.floor_px**2 * np.eye(2)),
    }
    for c, camera in enumerate(problem.cameras):
        mine = kept & (problem.camera == c)
        out[f"rms_{camera.name}_px"] = _rms(values[mine])
    return out


def _scatter(covariance: Array) -> float:
    return float(np.sqrt(np.median(np.trace(covariance, axis1=-2, axis2=-1)) / 2))


def _rms(values: Array) -> float:
    """Return the RMS of all values, NaN if there are none."""
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")


def _geometry(fit: Fit, joint: JointCovariance) -> dict[str, Any]:
    problem, state = fit.robust.problem, fit.robust.solution.state
    out = _target_shape(problem, state, joint)
    if len(problem.cameras) < 2:
        return out
    out |= _from_first(fit, joint, 1)
    if len(problem.cameras) > 2:
        out["from_first"] = {
            problem.cameras[c].name: _from_first(fit, joint, c)
            for c in range(1, len(problem.cameras))
        }
    kappas = state.intrinsics[:, INDEX["kappa_per_mm"]]
    if all(abs(k) > 1e-9 for k in kappas):
        centres = [
            (m @ np.array([0, 0, -1 / k, 1]))[:3] for m, k in zip(state.rig_from_camera, kappas)
        ]
        out["perspective_centres_distance_mm"] = float(np.linalg.norm(centres[1] - centres[0]))
    return out


def _from_first(fit: Fit, joint: JointCovariance, camera: int) -> dict[str, Any]:
    """Return a camera's rotation relative to the first, and the angle between the optical axes."""
    turn = fit.robust.solution.state.rig_from_camera[camera, :3, :3].T
    rotvec = rotvec_from_rotation(turn)
    angle = float(np.arccos(np.clip(turn[2, 2], -1, 1)))
    names, covariance = joint.rig_block()
    name = fit.robust.problem.cameras[camera].name
    index = [names.index(f"{name}.{p}") for p in ("rx_rad", "ry_rad")]
    # the first axis in this camera's coordinates; a turn about its x, y tips its axis
    slope = np.array([-turn[1, 2], turn[0, 2]]) / max(np.sin(angle), 1e-12)
    sd = float(np.sqrt(slope @ covariance[np.ix_(index, index)] @ slope))
    systematic = float(slope @ _centres_held(fit, names, covariance)[index])
    return {
        "inter_camera_rotvec_deg": np.degrees(rotvec).tolist(),
        "axes_angle_deg": float(np.degrees(angle)),
        "axes_angle_formal_sd_deg": float(np.degrees(sd)),
        "axes_angle_sd_deg": float(np.degrees(np.hypot(sd, systematic))),
    }


def _centres_held(fit: Fit, names: Sequence[str], covariance: Array) -> Array:
    """Return by how much the rig's parameters (P,) change, to first order, if free image centres
    are held in the middle of the images; 0 if the model fits.

    With strong perspective, an error of the distortion model moves both angle and centres.
    names, covariance : of the P parameters.
    """
    problem, value = fit.robust.problem, np.zeros(len(names))
    noise = _scatter(problem.covariance_px2 - fit.robust.floor_px**2 * np.eye(2))
    found = fit.robust.solution.state.intrinsics
    for c, camera in enumerate(problem.cameras):
        for parameter in GROUPS["centre"]:
            if (name := f"{camera.name}.{parameter}") in names:
                value[names.index(name)] = found[c, INDEX[parameter]] - camera[parameter]
    if fit.robust.floor_px <= UNEXPLAINED * noise or not value.any():
        return np.zeros(len(names))
    return Estimate(value, covariance).hold(np.flatnonzero(value).tolist()).value


def _target_shape(problem: Problem, state: State, joint: JointCovariance) -> dict[str, Any]:
    """Return how the printed target differs from the nominal one, as entries of the statistics."""
    dots, nominal = state.dots_mm, problem.nominal_mm
    design = np.c_[nominal[:, :2], np.ones(len(dots))]
    affine, *_ = np.linalg.lstsq(design, dots, rcond=None)
    leftover = dots - design @ affine
    rank = min(len(dots) - 3, len(dots))
    factor = np.sqrt(len(dots) / max(rank, 1))
    sd = np.sqrt(np.diagonal(joint.dots, 0, 1, 2))
    stretch = np.linalg.svd(affine[:2, :2], compute_uv=False)
    return {
        "target_rms_from_nominal_mm": float(np.sqrt(((dots - nominal)[:, :2] ** 2).mean())),
        "target_in_plane_rms_mm": float(factor * np.sqrt((leftover[:, :2] ** 2).mean())),
        "target_out_of_plane_rms_mm": float(factor * leftover[:, 2].std()),
        "target_stretch": [float(s) for s in stretch],
        "target_point_sd_mm": [float(s) for s in np.median(sd, 0)],
    }


def _space(calibration: Calibration, problem: Problem, state: State) -> dict[str, Any]:
    """Return residuals in space and predicted uncertainty of points (µm), less rigid motion."""
    if len(problem.cameras) < 2:
        return {}
    seen, truth = _seen_in_space(problem, state)
    if len(truth) == 0:
        return {}
    cameras, sigma = calibration.cameras, calibration.statistics["scatter_px"]
    found = triangulate_any(cameras, list(seen), sigma)
    some = found.points_mm[:: max(1, len(truth) // 200)]
    shared = aligned_covariance(cameras, calibration.free, calibration.covariance, some)
    measurement = np.trace(found.covariance_mm2, axis1=-2, axis2=-1).mean() / 3
    from_calibration = np.trace(shared) / len(shared)
    error = found.points_mm - truth
    return {
        "space_rms_um": float(1e3 * np.sqrt((error**2).mean())),
        "space_sd_um": float(1e3 * np.sqrt(measurement + from_calibration)),
        "space_sd_measurement_um": float(1e3 * np.sqrt(measurement)),
        "space_sd_calibration_um": float(1e3 * np.sqrt(from_calibration)),
        "ray_miss_rms_um": float(1e3 * np.sqrt(np.nanmean(found.ray_miss_mm**2))),
    }


def _seen_in_space(problem: Problem, state: State) -> tuple[Array, Array]:
    """Return pixels (C, K, 2), NaN if unseen, and points (K, 3) of dots that two cameras see.

    The pixels of dots that are seen through the plate of the target are those without it.
    """
    key = problem.view * len(problem.dot_ids) + problem.dot
    kept = problem.kept
    found, row = np.unique(key[kept], return_inverse=True)
    observed = problem.observations()
    bare = replace(observed, plate_shift=np.zeros_like(observed.plate_shift))
    by_plate = pixels(state, observed, problem.rho_mm) - pixels(state, bare, problem.rho_mm)
    seen = np.full((len(problem.cameras), len(found), 2), np.nan)
    seen[problem.camera[kept], row] = observed.uv_px - by_plate
    several = np.isfinite(seen[..., 0]).sum(0) > 1
    view, dot = np.divmod(found[several], len(problem.dot_ids))
    poses = state.rig_from_target[view]
    points = np.einsum("kij,kj->ki", poses[:, :3, :3], state.dots_mm[dot]) + poses[:, :3, 3]
    return seen[:, several], points


def _mirror(fit: Fit, nominal_rotvec_deg: Nominal) -> dict[str, Any]:
    """Return the entry "twin" of `calibration.json`; with 3 cameras rotations are by name."""
    assert fit.mirror is not None
    cameras = fit.robust.problem.cameras
    stated: Any = {cameras[c].name: list(rotvec) for c, rotvec in nominal_rotvec_deg.items()}
    if len(cameras) <= 2:
        stated = next(iter(stated.values()), None)
    return {
        "cost": fit.robust.solution.cost,
        "other_cost": fit.mirrored_cost,
        "decided_by": fit.mirror.decided_by,
        "words": fit.mirror.words,
        "nominal_rotvec_deg": stated or None,
    }


def _model(fit: Fit) -> dict[str, Any]:
    """Return the entry "model" of `calibration.json`: the models and each step of their choice."""
    cameras = [c.name for c in fit.robust.problem.cameras]
    steps = fit.choice.steps if fit.choice is not None else ()
    return {
        "name": fit.model,
        "by_camera": dict(zip(cameras, fit.models)),
        "words": fit.model_words,
        "ladder": [_step(step, cameras) for step in steps],
    }


def _step(step: Step, cameras: list[str]) -> dict[str, Any]:
    """Return one step of the choice as a row; values that were not computed are None."""
    return {
        "model": joint_name([name_of(lens) for lens in step.lenses], cameras),
        "camera": cameras[step.camera] if step.camera >= 0 else "",
        "added": list(step.added),
        "taken": step.taken,
        "chi2_gain": _finite(step.gain),
        "bic_gain": _finite(step.bic_gain),
        "p_value": _finite(step.p_value),
        "words": step.words,
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def telecentricity(
    problem: Problem, solution: Solution, models: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Return for each camera's name by how much its scale changes with the depth of the views.

    Where a model holds kappa, it is freed here for one Gauss-Newton step.
    Entries: "change_per_mm" at the mean depth of the dots, and "sd_per_mm"; "depth_mm", the range
    of the dots' depths; "perspective", the slope of a ray at the image's corner.
    """
    at_kappa = INDEX["kappa_per_mm"]
    wide = problem.with_model([name_of({*groups_of(model), "kappa"}) for model in models])
    gaussian = System(wide).gaussian(solution.state)
    step, _ = gaussian.step()
    variance = np.diag(gaussian.marginal(np.arange(gaussian.rig)))
    state = solution.state
    poses = state.rig_from_target[problem.view]
    points = np.einsum("kij,kj->ki", poses[:, :3, :3], state.dots_mm[problem.dot]) + poses[:, :3, 3]
    out: dict[str, dict[str, float]] = {}
    at = 0
    for c, camera in enumerate(problem.cameras):
        free = wide.free_indices(c).tolist()
        place = at + free.index(at_kappa)
        at += len(free)
        kappa = state.intrinsics[c, at_kappa] + step[place]
        camera_from_rig = np.linalg.inv(state.rig_from_camera[c])
        seen = problem.kept & (problem.camera == c)
        depth = points[seen] @ camera_from_rig[2, :3] + camera_from_rig[2, 3]
        nearer = 1.0 + kappa * float(depth.mean()) if len(depth) else 1.0
        change = float(kappa / nearer)
        out[camera.name] = {
            "change_per_mm": change,
            "sd_per_mm": float(np.sqrt(max(variance[place], 0.0)) / nearer**2),
            "depth_mm": float(np.ptp(depth)) if len(depth) else 0.0,
            "perspective": abs(change) * camera.rho_mm,
        }
    return out
