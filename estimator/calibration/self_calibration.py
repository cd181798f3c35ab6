"""Self-calibration from a table of dots: start, lens models, robust fit, covariance, verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array
from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.lens_choice import (
    Choice,
    choose,
    considered_covariance,
    considered_groups,
    considered_words,
    model_start,
)
from telerig.estimator.calibration.next_view import next_view
from telerig.estimator.calibration.quality import checks
from telerig.estimator.calibration.quality.comparison import split_half_check
from telerig.estimator.calibration.quality.residual_structure import residual_tests
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.result_from_fit import (
    Fit,
    calibration_from_fit,
    misfits,
    telecentricity,
)
from telerig.estimator.calibration.solver.covariance import JointCovariance, joint_covariance
from telerig.estimator.calibration.solver.print_stretch import (
    stretch_error,
    stretched_to_distance,
    with_print_stretch,
)
from telerig.estimator.calibration.solver.problem import (
    HELD_MM,
    Problem,
    checked_outlier_sd,
    eccentricity_px,
    held_at_nominal,
    problem_from_dots,
)
from telerig.estimator.calibration.solver.robust_least_squares import (
    Progress,
    RobustFit,
    robust_solve,
    solve,
)
from telerig.estimator.calibration.solver.system import Solution, System
from telerig.estimator.calibration.start import (
    known_target,
    mirror_ambiguity,
    symmetric_target,
)
from telerig.estimator.calibration.start.unknown_target import dots_from_images
from telerig.estimator.calibration.thresholds import OUTLIER_SD, STRONG_PERSPECTIVE, SURE_SD
from telerig.factors.calibration import State, whitened_error
from telerig.io.results.findings import LENS_FAILS, Code, Finding
from telerig.io.rig_file.description import MOST_CAMERAS
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import (
    AUTO,
    INDEX,
    Model,
    groups_of,
    joint_name,
    models_by_camera,
    name_of,
    rich_groups,
)
from telerig.rig.target import Target
from telerig.short_text import counted


def self_calibrate(
    dots: pd.DataFrame,
    cameras: Sequence[Camera],
    target: Target,
    *,
    nominal_rotvec_deg: Mapping[str, Sequence[float]] | Sequence[float] | None = None,
    model: Model = AUTO,
    dots_free: str = "3d",
    outlier_sd: float = OUTLIER_SD,
    progress: Progress | None = None,
    findings: Sequence[Finding] = (),
    name: str = "",
) -> Calibration:
    """Calibrate one to four cameras from measured dots.

    Not every camera has to see every view, but shared views must connect all cameras.

    dots : table with the columns view, camera, dot, u_px, v_px, suu_px2, suv_px2, svv_px2.
    cameras : nominal cameras; the first one defines the rig frame.
    target : the nominal target.
    nominal_rotvec_deg : nominal rotation vectors <camera>_from_<first> in degrees by the camera's
        name, or that of the second camera alone; they resolve the mirror ambiguity.
    model : a name of `telerig.rig.lens_parameters`, or "auto"; one for all cameras, or by camera.
    dots_free : how the dots may differ from their nominal positions: "3d" (in all directions, as
        far as the target's stated standard deviations allow), "plane" (only within the plane of the
        target) or "nominal" (not at all).
    outlier_sd : number of standard deviations from the model beyond which a dot is left out.
    findings : what was found while the dots were read; it is added to the result.
    name : name of the rig.

    Raises CalibrationError if the views cannot determine a calibration; the error says what to do.
    """
    if not 1 <= len(cameras) <= MOST_CAMERAS:
        todo = f"give one to {MOST_CAMERAS} cameras"
        raise InputError(counted(len(cameras), "camera"), todo=todo)
    models = models_by_camera(model, [c.name for c in cameras])
    nominal = _nominal(nominal_rotvec_deg, cameras)
    problem = hold_dots(problem_from_dots(dots, cameras, target), dots_free)
    problem = replace(problem, outlier_sd=checked_outlier_sd(outlier_sd))
    checks.refuse_copies(problem)
    unknown = dots_unknown(problem)
    start_dots = dots_from_images(problem) if unknown else problem.nominal_mm
    pre = checks.pre_check(problem, start_dots, unknown_dots=unknown)
    distance = checks.about_distance(problem, held=dots_free == "nominal")
    known = [*findings, *pre.findings, *distance]
    if target.symmetry_order() > 1:
        problem, turned = symmetric_target.number_consistently(problem, nominal)
        known += turned
        start_dots = problem.nominal_mm
    checks.refuse_wrong_pairs(problem)
    problem = stretched_to_distance(problem)
    return _solved(problem, start_dots, nominal, models, pre, known, name, progress)


def _solved(
    problem: Problem,
    start_dots: Array,
    nominal: mirror_ambiguity.Nominal,
    models: tuple[str, ...],
    pre: checks.PreCheck,
    known: Sequence[Finding],
    name: str,
    progress: Progress | None,
) -> Calibration:
    """Solve a problem whose views belong together: start, fit, covariance, checks.

    known : the findings of before.
    """
    problem, start = best_start(problem, start_dots, nominal)
    mirror = mirror_ambiguity.choose_start(start, problem, nominal)
    start = mirror_ambiguity.with_tilt_signs(problem, mirror.state)
    problem = _with_origin(problem, start)
    cameras = problem.cameras
    fit = _fit(problem, start, models, progress)
    if len(cameras) > 1 and mirror.decided_by != mirror_ambiguity.BY_PLATE:
        fit, mirror = _on_the_right_side(fit, nominal)
    final, solution = with_print_stretch(fit.robust.problem, fit.robust.solution)
    fit = replace(fit, robust=replace(fit.robust, problem=final, solution=solution))
    considered = considered_groups(fit.choice, len(cameras))
    added = considered_words(considered, [c.name for c in cameras])
    other_cost = mirror_ambiguity.mirrored_cost(final, solution.state, solution.cost)
    fit = replace(
        fit, mirror=mirror, mirrored_cost=other_cost, tilts_deg=pre.tilts_deg,
        model_words=fit.model_words + added,
    )  # fmt: skip
    own = joint_covariance(final, solution)
    whitened = whitened_error(solution.state, final.observations(), final.rho_mm)
    structure, unlike_noise = residual_tests(final, whitened, own.leverage)
    noisier, there, shared = _with_wider_noise(final, solution, own, structure["widening"])
    free, joint = considered_covariance(noisier, there, shared, fit.models, considered)
    joint = joint.widened(stretch_error(noisier, replace(there, gaussian=joint.gaussian)))
    found = calibration_from_fit(fit, joint, free, nominal_rotvec_deg=nominal, name=name)
    halves, compared = split_half_check(final, solution.state, structure["widening"])
    advice = next_view(replace(noisier, free=free), solution.state, joint)
    misfit = [*misfits(fit, found.statistics), *unlike_noise, *compared]
    misfit = _explained(misfit, problem, fit, progress)
    findings = (
        *known,
        *misfit,
        *checks.loose_offsets(problem, start),
        *checks.scales_beside_nominal(final, solution.state),
        *mirror_ambiguity.far_rotations(solution.state, final, nominal),
        *checks.parallel_axes(solution.state),
        *checks.weak_parameters(final, own),
    )
    checked = {
        "halves": halves,
        "structure": structure,
        "next_view": {} if advice is None else advice.as_dict(),
    }
    scale_change = telecentricity(noisier, there, fit.models)
    return replace(
        found, findings=findings, diagnostics={**found.diagnostics, **checked},
        statistics={**found.statistics, "telecentricity": scale_change},
    )  # fmt: skip


def _explained(
    findings: list[Finding], problem: Problem, fit: Fit, progress: Progress | None
) -> list[Finding]:
    """Return the findings; the first of `LENS_FAILS` names a lens model that fits better.

    It names none if the model was chosen automatically, or if the best one frees no more.
    """
    first = next((k for k, finding in enumerate(findings) if finding.code in LENS_FAILS), None)
    if first is None:
        return findings
    better, auto = list[str](), (AUTO,) * len(problem.cameras)
    if fit.choice is None:
        _, best = choose_model(problem, fit.robust.solution.state, auto, progress)
        if any(set(groups_of(b)) - set(groups_of(m)) for b, m in zip(best.names, fit.models)):
            better = [joint_name(best.names, [c.name for c in problem.cameras])]
    numbers = {**findings[first].numbers, "better_models": float(len(better))}
    named = findings[first].model_copy(update={"names": tuple(better), "numbers": numbers})
    return [*findings[:first], named, *findings[first + 1 :]]


def _with_wider_noise(
    problem: Problem, solution: Solution, own: JointCovariance, widening: float
) -> tuple[Problem, Solution, JointCovariance]:
    """Return the problem with wider noise of the dots, its equations there, and the covariance.

    What priors and known distances determine stays as certain as they are.
    """
    if widening <= 1:
        return problem, solution, own
    noisier = replace(problem, covariance_px2=problem.covariance_px2 * widening**2)
    there = replace(solution, gaussian=System(noisier).gaussian(solution.state))
    return noisier, there, joint_covariance(noisier, there, leverage=own.leverage)


def _with_origin(problem: Problem, start: State) -> Problem:
    """Return the problem with its `origin_camera` by the start's rotations.

    If perspective axes are nearly parallel, the start's scales are held, too.
    """
    if len(problem.cameras) < 2:
        return problem
    turns = np.swapaxes(start.rig_from_camera[:, :3, :3], -1, -2)
    problem = replace(problem, origin_camera=known_target.origin_camera(turns))
    if not mirror_ambiguity.perspective_sign(start, problem):
        return problem
    if checks.axes_angle_deg(start) > Code.NEAR_PARALLEL.limit:
        return problem
    scale = INDEX["scale_px_per_mm"]
    cameras = []
    for camera, found in zip(problem.cameras, start.intrinsics):
        intrinsics = camera.intrinsics.copy()
        intrinsics[scale] = found[scale]
        cameras.append(replace(camera, intrinsics=intrinsics))
    return replace(problem, cameras=tuple(cameras), hold_scales=True)


def _nominal(
    given: Mapping[str, Sequence[float]] | Sequence[float] | None, cameras: Sequence[Camera]
) -> dict[int, Array]:
    """Return the given nominal rotation vectors (degrees) by the camera's index."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        return {1: np.asarray(given, float)} if len(cameras) > 1 else {}
    names = [c.name for c in cameras]
    unknown = sorted(set(given) - set(names[1:]))
    if unknown:
        raise InputError(
            f"nominal rotations are given for {', '.join(unknown)}: a rotation is needed for each "
            "camera of the rig except the first one, to which the rotations refer",
            todo="give nominal rotations for: "
            f"{', '.join(names[1:]) or 'no camera, because there is only one'}",
        )
    return {names.index(n): np.asarray(r, float) for n, r in given.items()}


def dots_unknown(problem: Problem) -> bool:
    """Return whether the dots' nominal positions are too inexact to start the calibration from.

    This is so if ``print_sigma_mm`` of the target, the standard deviation of the positions, is more
    than a tenth of the dots' mean spacing. The positions are then estimated from the views.
    """
    spread = np.ptp(problem.nominal_mm[:, :2], axis=0).max()
    spacing = spread / max(1.0, np.sqrt(len(problem.dot_ids)))
    return bool(problem.target.print_sigma_mm > 0.1 * spacing)


def hold_dots(problem: Problem, dots_free: str) -> Problem:
    """Return the problem with priors on the dots' positions according to ``dots_free``.

    dots_free : as for `self_calibrate`. Raises CalibrationError for another value.
    """
    sigma = problem.dot_sigma_mm.copy()
    if dots_free not in ("3d", "plane", "nominal"):
        raise CalibrationError(
            f"dots_free is {dots_free!r}", todo="give one of: 3d, plane or nominal"
        )
    if dots_free in ("plane", "nominal"):
        sigma[:, 2] = HELD_MM
    if dots_free == "nominal":
        sigma[:] = HELD_MM
    return replace(problem, dot_sigma_mm=sigma)


def best_start(
    problem: Problem, dots_mm: Array, nominal: mirror_ambiguity.Nominal | None = None
) -> tuple[Problem, State]:
    """Return a start for the calibration: of several closed-form states the one that fits best.

    Each is improved by a few iterations before the costs are compared, without dots that are far
    from all others of their image. The problem is returned, too, because which side of a two-sided
    plate carries the dots is decided by the same costs.

    dots_mm : (N, 3) positions of the target's dots. nominal : nominal rotation vectors in degrees
    by the camera's index; they decide between states that fit equally well (see
    `mirror_ambiguity.consistent_start`).
    """
    near = known_target.without_wrong_dots(problem, dots_mm)
    if len(problem.cameras) == 1:
        return problem, known_target.stereo_states(near, dots_mm)[0]
    options = []
    for side in known_target.plate_sides(near):
        starts = known_target.stereo_states(side, dots_mm)
        if np.any(side.plate_shift):  # refraction distinguishes mirrored solutions
            starts += [mirror_ambiguity.mirrored_state(start) for start in starts]
        fits = [_rough_fit(side, start) for start in starts]
        options.append((min(fit.cost for fit in fits), side, fits))
    _, side, fits = min(options, key=lambda option: option[0])
    states, costs = [fit.state for fit in fits], [fit.cost for fit in fits]
    start = mirror_ambiguity.consistent_start(states, costs, side, nominal or {})
    return replace(side, weight=problem.weight), start


def _rough_fit(problem: Problem, start: State) -> Solution:
    perspective = np.any(start.intrinsics[:, INDEX["kappa_per_mm"]] != 0)
    candidate = _with_origin(problem.with_model("kappa" if perspective else "none"), start)
    return solve(candidate, start, max_iterations=15, relative=1e-4)


def _fit(
    problem: Problem,
    start: State,
    models: tuple[str, ...],
    progress: Progress | None,
) -> Fit:
    """Fit a rich model robustly, choose the lens model, and fit that to convergence."""
    choice = None
    weighed = problem
    words = f"{joint_name(models, [c.name for c in problem.cameras])}: as given"
    if AUTO in models:
        first, choice = choose_model(problem, start, models, progress)
        weighed = first.problem
        models, start, words = choice.names, choice.start, choice.words
        if any("centre" in name for name in models):
            words += (
                "; because the perspective is strong, the image centre (where the optical axis "
                "meets the image) is free, too, which makes the angle between the cameras less "
                "certain"
            )
    final = problem.with_model(models)
    if choice is None:
        begin = robust_solve(final, model_start(final, start)).solution.state
    else:  # without the outliers that are known by now
        sound = replace(final, weight=weighed.weight, covariance_px2=weighed.covariance_px2)
        begin = solve(sound, held_at_nominal(final, start), max_iterations=15, relative=1e-5).state
    final = replace(final, eccentricity_px=eccentricity_px(final, begin))
    robust = robust_solve(final, begin, progress=progress)
    return Fit(robust, models, words, choice)


def choose_model(
    problem: Problem,
    start: State,
    models: tuple[str, ...],
    progress: Progress | None = None,
) -> tuple[RobustFit, Choice]:
    """Fit the richest lens model, and choose the lens model that each camera needs.

    models : for each camera "auto", or the name of the lens model that the user gave.
    Returns the robust fit of the richest model, and the choice.
    """
    first = _rich(problem, start, models, progress)
    return first, choose(first.problem, first.solution, models)


def _rich(
    problem: Problem, start: State, models: tuple[str, ...], progress: Progress | None
) -> RobustFit:
    """Fit the richest model robustly, so that no lens error is taken for outliers or noise."""
    mono = len(problem.cameras) == 1
    auto = np.array([m == AUTO for m in models])
    plain = name_of(rich_groups(mono=mono, strong=False))
    whole = problem.with_model([plain if m == AUTO else m for m in models])
    first = robust_solve(whole, model_start(whole, start), progress=progress)
    strong = auto & _strong(first)
    if mono or not strong.any():
        return first
    perspective = name_of(rich_groups(mono=mono, strong=True))
    names = [perspective if s else plain if m == AUTO else m for s, m in zip(strong, models)]
    whole = problem.with_model(names)
    return robust_solve(whole, model_start(whole, first.solution.state), progress=progress)


def _strong(fit: RobustFit) -> NDArray[np.bool_]:
    """Return (C,) whether a camera's perspective is too strong for a telecentric lens."""
    problem, kappa = fit.problem, INDEX["kappa_per_mm"]
    strength = np.abs(fit.solution.state.intrinsics[:, kappa]) * np.array(problem.rho_mm)
    out = np.asarray(strength > STRONG_PERSPECTIVE)
    if not out.any():
        return out
    rig = np.arange(sum(map(len, problem.free)))
    variance = iter(np.diag(fit.solution.gaussian.marginal(rig)))
    for c, camera in enumerate(problem.cameras):
        for parameter in problem.free_indices(c):
            sd = np.sqrt(next(variance))
            if parameter == kappa:
                out[c] &= strength[c] > SURE_SD * sd * camera.rho_mm
    return out


def _on_the_right_side(
    fit: Fit, nominal: mirror_ambiguity.Nominal
) -> tuple[Fit, mirror_ambiguity.MirrorChoice]:
    """Decide the mirror ambiguity again: the final fit may show the sign of kappa."""
    problem, solution = fit.robust.problem, fit.robust.solution
    mirror = mirror_ambiguity.choose_solution(solution.state, problem, nominal)
    if mirror.state is not solution.state:
        fit = replace(fit, robust=replace(fit.robust, solution=solve(problem, mirror.state)))
    return fit, mirror
