"""The pose between the cameras as a variable of the smoothing graph, and what the run makes of it.

The graph carries the calibration's uncertainty in unit directions. To refine the rig, the prior
of a movement is added to it in the directions that the ray gaps determine. Images, shake and
bubbles are then solved together with it, and its posterior is read back. The wander of the bubbles'
centres belongs to the model, else it would count as a movement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.estimator.rig_drift import (
    LEAST_PAIRS,
    DriftPrior,
    RigChange,
    drift_covariance,
    drift_posterior,
    moved_pose,
    rig_change,
    rig_change_from,
)
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.problem.problem import ShakeModel, SmoothingProblem

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration


_LEAST_WANDER_PX = 5e-3


@dataclass(frozen=True)
class Refinement:
    """What is needed to estimate a movement of the second camera together with the smoothing.

    drift : (6, 6) prior covariance of the movement.
    tangent : (6,) the movement that the ray misses alone give.
    wander_px, wander_s : RMS and correlation time of the wander of outlines' centres in an image.
    """

    drift: Array
    tangent: Array
    wander_px: float
    wander_s: float


def refinement_of(
    tracks: Any, calibration: Calibration, wanted: bool | DriftPrior
) -> Refinement | None:
    """Return what `Refinement` holds for a run; None if it is not wanted.

    Raises InputError for runs of more or fewer than two cameras, or with too few pairs.
    """
    if not wanted:
        return None
    if len(calibration.cameras) > 2:
        raise InputError(
            f"the run has {len(calibration.cameras)} cameras, and a rig of two can be refined",
            where="refine_rig",
            todo="calibrate again; or track and smooth it with two cameras, [tracking] cameras in "
            "rig.toml, of which one has moved",
        )
    prior = wanted if isinstance(wanted, DriftPrior) else DriftPrior()
    found = None if tracks is None else rig_change(tracks, calibration, prior)
    if found is None:
        raise InputError(
            f"the rig cannot be refined from fewer than {LEAST_PAIRS} pairs of two cameras",
            where="refine_rig",
            todo="smooth without --refine-rig",
        )
    change, noise = found
    scale = float(np.mean([c["scale_px_per_mm"] for c in calibration.cameras]))
    drift = drift_covariance((calibration.cameras[0], calibration.cameras[1]), prior)
    wander = noise.wander_mm * scale / np.sqrt(2)
    return Refinement(drift, change.tangent, wander, noise.wander_s)


def for_learning(problem: SmoothingProblem, refinement: Refinement) -> SmoothingProblem:
    """Return the problem with cameras moved as the ray misses show.

    It is used for learning, which holds the cameras fixed.
    """
    first, second = problem.cameras
    pose = moved_pose(second.camera_from_rig.inverse(), refinement.tangent).inverse()
    return replace(problem, cameras=(first, replace(second, camera_from_rig=pose)))


def with_wander(model: ShakeModel, refinement: Refinement) -> ShakeModel:
    """Return the model with the wander of the outlines' centres, unless it has one already."""
    if model.bubble.wander_px > 0 or refinement.wander_px < _LEAST_WANDER_PX:
        return model
    px, tau_s = refinement.wander_px, refinement.wander_s
    return replace(model, bubble=replace(model.bubble, wander_px=px, wander_tau_s=tau_s))


def refined_change(solution: Solution, calibration: Calibration) -> RigChange | None:
    """Return the posterior of the second camera's movement; None if it was not estimated."""
    problem, found = solution.graph.problem, solution.covariances
    share = problem.calibration
    if share is None or share.drift is None or found is None:
        return None
    root = share.root
    rig = root @ solution.state.calibration
    unaffected = share.covariance - root @ root.T
    covariance = unaffected + root @ found.calibration @ root.T
    before = share.covariance.copy()
    before[-6:, -6:] -= share.drift
    tangent, own = drift_posterior(rig, covariance, before, share.drift)
    pair = (problem.cameras[0], problem.cameras[1])
    place = np.concatenate([b.guess_mm for b in problem.bubbles]).mean(0)
    positions = np.concatenate([problem.encoder_mm[b.first : b.last + 1] for b in problem.bubbles])
    place = place - positions.mean() * problem.axis
    pose = moved_pose(calibration.cameras[1].camera_from_rig.inverse(), rig[-6:])
    return rig_change_from(
        pair, tangent, own, share.drift, place, len(problem.observations) // 2, pose
    )


def change_words(change: RigChange, first: str) -> str:
    """Return a sentence on the movement, for smoothing.json and the terminal.

    first : name of the first camera.
    """
    if not change.moved:
        return (
            f"no movement of camera {change.camera!r} against {first!r} since the calibration "
            f"beyond chance ({change.size_words()})"
        )
    return (
        f"camera {change.camera!r} has moved against {first!r} since the calibration, "
        f"{change.size_words()}; the trajectories are corrected for it"
    )
