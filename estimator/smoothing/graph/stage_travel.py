"""How well the stage's travel is known, and the uncertainty that it adds to places in the lab.

Images and sensors on the stage see what moves past them, so an error of the encoder's scale or of
the travel axis moves bubbles and carriage together and leaves no trace in any residual. Such
constants are not estimated: their covariance is added to that of the places (a consider, or
Schmidt, parameter). Marks fixed to the tank show the scale; it is a variable of the graph then.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from telerig.arrays import Array
from telerig.estimator.sensors.response import FAR_SDS
from telerig.estimator.smoothing.graph.layout import points_in_rig
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.problem.problem import Travel
from telerig.rig.camera import Camera
from telerig.rig.pose import across

SCALE_SIGMA = 1e-3
"""Of an encoder without a stated scale: lead screws, belts, thermal growth."""


def travel_of(calibrated: Mapping[str, Any], described: Any) -> Travel:
    """Return what is known about the stage's travel.

    calibrated : the part ``stage`` of calibration.json; it is used if it is not empty.
    described : the stage in rig.toml; None if it is not described. The axis is then assumed to be
        upwards in the images.
    """
    if calibrated:
        return Travel(
            np.asarray(calibrated["axis"], float),
            np.asarray(calibrated["basis"], float),
            float(calibrated["encoder_scale"]),
            np.asarray(calibrated["joint_covariance"], float),
            "stage_axis",
        )
    axis, stated = np.array([0.0, -1.0, 0.0]), None
    if described is not None:
        axis, stated = np.asarray(described.axis, float), described.scale_sigma
    axis = axis / np.linalg.norm(axis)
    basis = across(axis)
    sigma = SCALE_SIGMA if stated is None else stated
    source: Literal["rig.toml", "assumed"] = "assumed" if stated is None else "rig.toml"
    return Travel(axis, basis, 0.0, np.diag([0.0, 0.0, sigma**2]), source)


def default_scale_sigma(travel: Travel | None) -> float:
    """Return the prior standard deviation of the encoder's scale error.

    It is not wider if marks are used to estimate the scale, because marks at unknown depths, seen
    through a lens that is not exactly telecentric, hardly determine it. See `wider_scale_sigma`.
    """
    return SCALE_SIGMA if travel is None else float(np.sqrt(travel.covariance[2, 2]))


def wider_scale_sigma(solution: Solution) -> float | None:
    """Return a wider prior standard deviation of the encoder's scale, or None if the prior can
    stay.

    It is wider if the run determines a scale far outside an assumed prior. It is then twice the
    estimate, because the narrow prior has drawn the estimate towards 0.
    """
    prior, travel = solution.graph.model.encoder_scale_sigma, solution.graph.problem.travel
    assumed = travel is None or travel.source == "assumed"
    if not solution.graph.encoder_size or not assumed:
        return None
    off = abs(solution.state.encoder_scale(solution.graph))
    return 2 * off if off > FAR_SDS * prior else None


def disputed_scale(solution: Solution) -> float:
    """Return the scale error that marks show and that is far outside what is assumed; else 0.

    The encoder may be off so much, or the magnifications: nothing tells which, so that the
    error is as uncertain as it is large.
    """
    travel = solution.graph.problem.travel
    off = abs(solution.state.encoder_scale(solution.graph))
    assumed = travel is not None and travel.source == "assumed"
    return off if assumed and off > FAR_SDS * default_scale_sigma(travel) else 0.0


def scale_warnings(solution: Solution) -> list[str]:
    """Return a warning if marks and encoder disagree on how far the stage moves."""
    off = disputed_scale(solution)
    if not off:
        return []
    return [
        f"the marks move {100 * off:.2g} % {'less' if total_scale(solution) > 0 else 'more'} than "
        "the encoder reads: its scale or the magnifications are wrong, and all heights and mean "
        "velocities are as uncertain. State scale_sigma in rig.toml [stage] if the encoder may be "
        "off so much, or calibrate again"
    ]


def offset_sigma(solution: Solution) -> Array:
    """Return the standard deviation (3,) in mm of an offset that all places of a run share.

    It is the way that the stage moves in the uncertain delay of its encoder, and half of that by
    which a camera has moved on from one half of the run to the other: where it was calibrated,
    before or after a bump, is not known. The bubbles' motion about their means is free of it.
    """
    graph = solution.graph
    problem, half = graph.problem, len(graph.problem.t_s) // 2
    offsets, moved = graph.offsets(solution.state.shake), np.zeros(3)
    if half:
        moved = np.abs(offsets[half:].mean(0) - offsets[:half].mean(0)).max(0) / 2
    if problem.stage is None:
        return np.asarray(moved)
    _, speed = carriage(solution)
    way = problem.stage.delay_sigma_s * float(np.sqrt(np.mean(speed**2)))
    return np.asarray(np.hypot(np.abs(problem.axis) * way, moved))


def considered_variance(solution: Solution) -> tuple[Array, Array]:
    """Return variances of the bubbles that the uncertain encoder scale and travel axis cause.

    A scale in dispute may be that of the magnifications: then bubbles are as far off in the images.

    Returns (rows, 3) in mm^2 for positions and (rows, 3) in mm^2/s^2 for velocities.
    """
    graph = solution.graph
    at, axis = graph.frame_of_row, graph.problem.axis
    places, speeds = carriage(solution)
    place, speed = _variance(solution, places[at]), _variance(solution, speeds[at])
    off = disputed_scale(solution)
    if off:
        middle = _middle(graph.problem.cameras)
        place += (off * (points_in_rig(graph, solution.state) - middle)) ** 2
        speed += (off * (solution.velocities_mm_s - speeds[at, None] * axis)) ** 2
    return place, speed


def _middle(cameras: Sequence[Camera]) -> Array:
    """Return the rig point (3,) that is nearest to the middle of all images."""
    rows = np.concatenate([camera.camera_from_rig.rotation[:2] for camera in cameras])
    centres = [c.unproject((np.array(c.image_size_px, float)[None] - 1) / 2)[0] for c in cameras]
    seen = rows * np.repeat(np.concatenate(centres), 2, axis=0)
    return np.asarray(np.linalg.lstsq(rows, seen.sum(1), rcond=None)[0])


def carriage(solution: Solution) -> tuple[Array, Array]:
    """Return the carriage's position (F,) in mm and velocity (F,) in mm/s along the travel axis.

    The estimated scale error of the encoder is corrected.
    """
    graph, t = solution.graph, solution.graph.problem.t_s
    readings = graph.shake_at_frames(solution.state.shake) @ graph.shake.position
    position = readings / (1 + solution.state.encoder_scale(graph))
    return position, np.asarray(np.gradient(position, t))


def carriage_sigma(solution: Solution, states_sigma: Array) -> Array:
    """Return the standard deviation (F,) in mm of the carriage's position.

    states_sigma : (F,) that of the states, in units of the encoder's reading. The uncertainty of
    the scale is added.
    """
    position, _ = carriage(solution)
    return np.asarray(np.hypot(states_sigma, position * scale_sigma(solution)))


def scale_sigma(solution: Solution) -> float:
    """Return the posterior standard deviation of the encoder's scale error.

    If the scale is no variable of the graph, it is the standard deviation that was known before.
    """
    graph, found = solution.graph, solution.covariances
    if graph.encoder_size:
        own = 0.0 if found is None else float(np.sqrt(found.encoder[0, 0]))
        return float(np.hypot(own, disputed_scale(solution)))
    travel = graph.problem.travel
    return 0.0 if travel is None else float(np.sqrt(travel.covariance[2, 2]))


def total_scale(solution: Solution) -> float:
    """Return the relative scale error of the encoder, (reading - travel) / travel.

    It includes the calibrated scale and the correction that the run adds.
    """
    travel = solution.graph.problem.travel
    before = 0.0 if travel is None else travel.scale
    return float((1 + before) * (1 + solution.state.encoder_scale(solution.graph)) - 1)


def considered(solution: Solution, travel: Travel) -> Array:
    """Return the covariance (3, 3) of the travel axis' two tilts and of the encoder's scale.

    If the scale is a variable of the graph, its part is what `disputed_scale` adds.
    """
    keep = np.array([1.0, 1.0, float(solution.graph.model.encoder_scale_sigma == 0)])
    out = travel.covariance * np.outer(keep, keep)
    out[2, 2] += disputed_scale(solution) ** 2
    return np.asarray(out)


def _variance(solution: Solution, along: Array) -> Array:
    """Return the variances (n, 3) of ``axis * along`` (n,)."""
    travel, stage = solution.graph.problem.travel, solution.graph.problem.stage
    if travel is None or stage is None:
        return np.zeros((len(along), 3))
    turn = np.column_stack([travel.basis, -travel.axis])
    each = np.diagonal(turn @ considered(solution, travel) @ turn.T)
    return np.asarray(along[:, None] ** 2 * each)
