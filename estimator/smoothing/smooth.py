"""`telerig.smooth`: the motion of the bubbles, separated from the shake of the rig."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import pair_of_run
from telerig.estimator.sensors.findings import accepted_codes
from telerig.estimator.smoothing.graph.solve import Options, Progress, Solution, solve
from telerig.estimator.smoothing.graph.stage_travel import travel_of
from telerig.estimator.smoothing.learning.default_priors import adapted, default_model
from telerig.estimator.smoothing.learning.learn import learn
from telerig.estimator.smoothing.learning.likelihood import (
    with_hyperparameter_uncertainty,
)
from telerig.estimator.smoothing.problem.problem import (
    Observations,
    ShakeModel,
    SmoothingProblem,
)
from telerig.estimator.smoothing.problem.tables import (
    Tracked,
    accelerometers_of,
    bubbles_of,
    calibration_share,
    read_tracks,
    references_of,
    stage_of,
    thinned,
)
from telerig.estimator.smoothing.refined_pose import (
    Refinement,
    change_words,
    for_learning,
    refined_change,
    refinement_of,
    with_wander,
)
from telerig.estimator.smoothing.result import Smoothing, summary_of, trajectories
from telerig.estimator.smoothing.result import shake as shake_table
from telerig.estimator.smoothing.verdict.judge import judge
from telerig.rig.units import STANDARD_GRAVITY_M_S2

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.estimator.rig_drift import DriftPrior
    from telerig.io.rig_file.description import StageDescription

Learn = Callable[[SmoothingProblem], ShakeModel]

_COARSE_STEP_S = 2e-3
_ENCODER_SIGMA_MM = 0.005
_LEAST_LEARNED_S = 0.2
"""Shortest time of a bubble for which shake is learned. In less time a slow shake shows no period,
and learning would find no shake.
"""


def smooth(
    tracks: Any,
    calibration: Calibration,
    *,
    stage: Any = None,
    accelerometers: Any = None,
    references: Any = None,
    model: ShakeModel | Learn | str = "auto",
    rig: Any = None,
    t_s: ArrayLike | None = None,
    options: Options | None = None,
    progress: Progress | None = None,
    refine_rig: bool | DriftPrior = False,
    accept: Iterable[str] = (),
) -> Smoothing:
    """Smooth a run: estimate every bubble's motion in the laboratory frame and every camera's
    shake.

    tracks : `Tracks`, or a table with the columns of tracks.csv; None to estimate only the shake.
    calibration : calibration of the cameras.
    stage : a table with the columns t_s and position_mm; or the `RunData` of the run, whose other
        records are then used as well where nothing else is given; None without an encoder.
    accelerometers : a table with the columns t_s, sensor, ax_m_s2, ay_m_s2, az_m_s2, whose sensors
        ``rig`` describes; or a mapping of the sensor's name to {t_s (N,), a_m_s2 (N, 3),
        mounted_on, axes, noise_density_ug_sqrt_hz}; None for none.
    references : a table of marks fixed to the tank with the columns frame, camera, mark, u_px, v_px
        and possibly sigma_px; None to take those of ``tracks``, if it has any.
    model : "auto" (default hyper-parameters for the available measurements; modes are learned if
        only images are available), "default", a `ShakeModel`, or a function that returns one for a
        `SmoothingProblem`.
    rig : the description in rig.toml. It gives the travel axis if the calibration has none, how
        well the encoder's scale is known, and the sensors. None if there is no description.
    t_s : (F,) times of the frames; None to take those of the tracks.
    options : settings of the solver; None for the defaults.
    progress : function that is called with the name of the step and the share (0 to 1) that is
        done.
    refine_rig : whether to estimate also how the cameras have moved relative to each other since
        the calibration (``summary["rig_change"]``); a `DriftPrior` states how far they may have
        moved.
    accept : codes of faults that are used as they are, where they would be refused (the error
        names its code).

    Raises InputError for tables that cannot be used together, `SensorError` for a sensor that
    contradicts the others.
    """
    accepted = accepted_codes(accept)
    table = getattr(tracks, "table", tracks)
    calibration = pair_of_run(calibration, _cameras_of(table, calibration, stage, rig))
    refinement = refinement_of(table, calibration, refine_rig)
    problem, tracked, encoder_sigma = problem_of(
        tracks, calibration, stage=stage, accelerometers=accelerometers,
        references=references, rig=rig, t_s=t_s,
        drift=None if refinement is None else refinement.drift,
    )  # fmt: skip
    options = options or Options()
    chosen = _chosen(problem, model, encoder_sigma, refinement)
    if isinstance(model, ShakeModel):
        solution = solve(problem, chosen, options, progress)
    else:
        solution = _adapted_solution(problem, chosen, options, progress)
        chosen = solution.graph.model
        if chosen.learned:
            solution = with_hyperparameter_uncertainty(solution)
    verdict = judge(problem, chosen, solution)
    summary = summary_of(solution)
    summary["accepted"] = sorted(accepted)
    change = refined_change(solution, calibration)
    if change is not None:
        words = change_words(change, problem.cameras[0].name)
        summary["rig_change"] = {**change.as_dict(), "words": words}
    return Smoothing(
        trajectories(solution, None if tracked is None else tracked.table),
        shake_table(solution),
        verdict,
        summary,
        chosen,
        solution,
    )


def _cameras_of(table: Any, calibration: Calibration, stage: Any, rig: Any) -> list[str]:
    """Names of the cameras whose pixels a table of tracks has; without one, those of the run."""
    known = [camera.name for camera in calibration.cameras]
    if table is not None:
        return [name for name in known if f"{name}_u_px" in table]
    of_rig = getattr(rig or getattr(stage, "rig", None), "tracking_cameras", known[:2])
    return list(getattr(stage, "cameras", of_rig))


def _chosen(
    problem: SmoothingProblem,
    model: ShakeModel | Learn | str,
    encoder_sigma_mm: float,
    refinement: Refinement | None,
) -> ShakeModel:
    if refinement is None or isinstance(model, ShakeModel):
        return choose_model(problem, model, encoder_sigma_mm)
    chosen = choose_model(for_learning(problem, refinement), model, encoder_sigma_mm)
    return with_wander(chosen, refinement)


def problem_of(
    tracks: Any,
    calibration: Calibration,
    *,
    stage: Any = None,
    accelerometers: Any = None,
    references: Any = None,
    rig: Any = None,
    t_s: ArrayLike | None = None,
    drift: Array | None = None,
) -> tuple[SmoothingProblem, Tracked | None, float]:
    """Return the smoothing problem of these tables, the tracks that were read, and the standard
    deviation of the encoder in mm.

    The arguments are those of `smooth`. The tracks are None if none were given.

    drift : (6, 6) prior covariance of a movement of the second camera since the calibration
        (rotation in rad, translation in mm); None if it has not moved.
    """
    if hasattr(stage, "frame_count"):
        run = stage
        stage, rig, t_s = run.stage, run.rig if rig is None else rig, run.t_s
        accelerometers = run.accelerometers if accelerometers is None else accelerometers
        references = run.references if references is None else references
    if references is None:
        references = getattr(tracks, "references", None)
    cameras = calibration.cameras
    frame_times = None if t_s is None else np.asarray(t_s, float)
    tracked = None if tracks is None else read_tracks(tracks, cameras, frame_times)
    times = frame_times if tracked is None else tracked.t_s
    if times is None:
        raise InputError(
            "without tracks nothing says when the frames are taken",
            where="smooth",
            todo="give t_s, the times at which offsets are wanted",
        )
    described = None if rig is None else rig.stage
    up, encoder_sigma, gravity = _stage_geometry(described)
    travel = travel_of(calibration.stage, described)
    axis = travel.axis
    record = stage_of(stage, times)
    if record is not None and travel.scale:
        record = replace(record, position_mm=record.position_mm / (1 + travel.scale))
    positions = np.zeros(len(times))
    if record is not None:
        positions = np.interp(times, record.t_s, record.position_mm)
    marks, seen = references_of(references, cameras, times, positions, axis)
    bubbles = () if tracked is None else bubbles_of(tracked, positions, axis)
    share = None
    if tracked is not None:
        points = tracked.table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
        some = points[np.linspace(0, len(points) - 1, min(len(points), 200)).astype(int)]
        noise = np.median(np.sqrt(tracked.observations.covariance_px2[:, 0, 0]))
        share = calibration_share(calibration, some, float(noise), drift)
    problem = SmoothingProblem(
        cameras, times, axis, up, bubbles,
        Observations.none() if tracked is None else tracked.observations,
        record, accelerometers_of(accelerometers, rig, cameras, times), marks, seen, share,
        travel, gravity,
    )  # fmt: skip
    return problem, tracked, encoder_sigma


def _stage_geometry(described: StageDescription | None) -> tuple[Array, float, float]:
    """Return the unit vector (3,) that points upwards in the rig frame, the standard deviation of
    the encoder in mm, and gravity in m/s^2.

    described : the stage in rig.toml; None for the defaults, where upwards is upwards in the
        images.
    """
    if described is None:
        return np.array([0.0, -1.0, 0.0]), _ENCODER_SIGMA_MM, STANDARD_GRAVITY_M_S2
    up = np.asarray(described.up, float)
    up = up / np.linalg.norm(up)
    return up, float(described.position_sigma_mm), float(described.gravity_m_s2)


def choose_model(
    problem: SmoothingProblem, model: ShakeModel | Learn | str, encoder_sigma_mm: float
) -> ShakeModel:
    """Return the hyper-parameters: the given, the default or the learned ones.

    model : as for `smooth`.  encoder_sigma_mm : standard deviation of one encoder reading.

    Raises InputError for an unknown word.
    """
    if isinstance(model, ShakeModel):
        return model
    if callable(model):
        return model(problem)
    if model not in ("auto", "default"):
        raise InputError(
            f"model is {model!r}", where="smooth", todo='give "auto", "default" or a ShakeModel'
        )
    default = default_model(problem, encoder_sigma_mm)
    if model == "auto" and not problem.measures_shake and _longest_s(problem) >= _LEAST_LEARNED_S:
        return learn(problem, default)
    return default


def _longest_s(problem: SmoothingProblem) -> float:
    """Return the longest time from a bubble's first to its last frame; 0 without bubbles."""
    t = problem.t_s
    return max((float(t[b.last] - t[b.first]) for b in problem.bubbles), default=0.0)


def _adapted_solution(
    problem: SmoothingProblem, model: ShakeModel, options: Options, progress: Progress | None
) -> Solution:
    """Return the solution whose noise, RMS and delays have been set from a first solution, which
    uses few samples of the sensors.
    """
    sensors = problem.accelerometers
    coarse = replace(problem, accelerometers=thinned(sensors, _COARSE_STEP_S))
    first = solve(coarse, model, options, progress)
    better = adapted(first)
    if better is None and not sensors:
        return first
    return solve(problem, better or model, options, progress, start=first)
