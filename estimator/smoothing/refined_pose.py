"""The pose between the cameras as a variable of the smoothing graph, and what the run makes of it.

The graph carries the calibration's uncertainty in unit directions. To refine the rig, the prior
of a movement is added to it in the directions that the ray gaps determine. Images, shake and
bubbles are then solved together with it, and its posterior is read back. The wander of the bubbles'
centres belongs to the model, else it would count as a movement.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.estimator.rig_drift.change import RigChange, rig_change_from
from telerig.estimator.rig_drift.estimate import LEAST_PAIRS, PairCollector, culprit
from telerig.estimator.rig_drift.movement import (
    POSE,
    DriftPrior,
    Movement,
    drift_posterior,
    moved_pose,
    with_drift,
)
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.problem.problem import ShakeModel, SmoothingProblem

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.calibration.result.calibration import Calibration


_LEAST_WANDER_PX = 5e-3


@dataclass(frozen=True)
class Refinement:
    """What is needed to estimate a movement of a camera together with the smoothing.

    movement : which camera moves, with the prior of its movement.
    tangent : (6,) the movement that the ray misses alone give.
    wander_px, wander_s : RMS and correlation time of the wander of outlines' centres in an image.
    """

    movement: Movement
    tangent: Array
    wander_px: float
    wander_s: float


def refinement_of(
    tables: Iterable[pd.DataFrame], calibration: Calibration, wanted: bool | DriftPrior
) -> Refinement | None:
    """Return what `Refinement` holds for a run; None if it is not wanted.

    tables : the tracks, or parts of them in the order of time.

    Of more than two cameras it is the one that the ray misses of all its pairs accuse, or that of
    the pair which contradicts the calibration most. Raises InputError if several have moved, or
    with too few pairs.
    """
    if not wanted:
        return None
    cameras = calibration.cameras
    prior = wanted if isinstance(wanted, DriftPrior) else DriftPrior()
    pairs = PairCollector(calibration)
    for table in tables:
        pairs.add(table)
    changes = pairs.changes(prior)
    if not changes:
        raise InputError(
            f"the rig cannot be refined from fewer than {LEAST_PAIRS} pairs of two cameras",
            where="refine_rig",
            todo="smooth without --refine-rig",
        )
    alone = culprit(changes, len(cameras))
    accused = [pair for pair, (change, _) in changes.items() if change.moved]
    if alone is None and len(accused) > 1:
        raise InputError(
            f"{len(accused)} of {len(changes)} pairs of cameras have moved against each other, "
            "which the movement of one camera does not explain",
            where="refine_rig",
            todo="calibrate again, and track the run with that calibration",
        )
    pair = min(
        (p for p in changes if alone is None or alone in p), key=lambda p: changes[p][0].chance
    )
    moved = pair[1] if alone is None else alone
    movement = Movement.of(cameras, moved, sum(pair) - moved, prior)
    change, noise = changes[pair]
    tangent = change.tangent
    if moved != pair[1]:  # the other camera's movement, seen from this one
        other, own = (c.camera_from_rig for c in movement.pair(cameras))
        tangent = -(own @ other.inverse()).adjoint() @ tangent
    scale = float(np.mean([c["scale_px_per_mm"] for c in cameras]))
    wander = noise.wander_mm * scale / np.sqrt(2)
    return Refinement(movement, tangent, wander, noise.wander_s)


def for_learning(problem: SmoothingProblem, refinement: Refinement) -> SmoothingProblem:
    """Return the problem with cameras moved as the ray misses show.

    It is used for learning, which holds the cameras fixed.
    """
    moved = refinement.movement.applied(problem.cameras, refinement.tangent)
    return replace(problem, cameras=moved)


def with_wander(model: ShakeModel, refinement: Refinement) -> ShakeModel:
    """Return the model with the wander of the outlines' centres, unless it has one already."""
    if model.bubble.wander_px > 0 or refinement.wander_px < _LEAST_WANDER_PX:
        return model
    px, tau_s = refinement.wander_px, refinement.wander_s
    return replace(model, bubble=replace(model.bubble, wander_px=px, wander_tau_s=tau_s))


def refined_change(solution: Solution, calibration: Calibration) -> RigChange | None:
    """Return the posterior of a camera's movement; None if it was not estimated."""
    problem, found = solution.graph.problem, solution.covariances
    share = problem.calibration
    if share is None or share.drift is None or found is None:
        return None
    root = share.root
    rig = root @ solution.state.calibration
    unaffected = share.covariance - root @ root.T
    covariance = unaffected + root @ found.calibration @ root.T
    movement = share.drift
    before = with_drift(share.covariance, replace(movement, covariance=-movement.covariance))
    tangent, own = drift_posterior(rig, covariance, before, movement)
    place = np.concatenate([b.guess_mm for b in problem.bubbles]).mean(0)
    positions = np.concatenate([problem.encoder_mm[b.first : b.last + 1] for b in problem.bubbles])
    place = place - positions.mean() * problem.axis
    at = len(rig) + POSE * (movement.moved - len(problem.cameras))
    step = rig[at : at + POSE] if movement.moved else tangent
    moved = calibration.cameras[movement.moved]
    return rig_change_from(
        movement.pair(problem.cameras), tangent, own, movement.covariance, place,
        len(problem.observations) // len(problem.cameras),
        moved_pose(moved.camera_from_rig.inverse(), step),
    )  # fmt: skip


def change_words(change: RigChange) -> str:
    """Return a sentence on the movement, for smoothing.json and the terminal."""
    if not change.moved:
        return (
            f"no movement of camera {change.camera!r} against {change.against!r} since the "
            f"calibration beyond chance ({change.size_words()})"
        )
    return (
        f"camera {change.camera!r} has moved against {change.against!r} since the calibration, "
        f"{change.size_words()}; the trajectories are corrected for it"
    )
