"""Considered parameters: held at nominal by the chosen model, but open in the covariance.

A group of parameters that is not worth freeing is not therefore zero. Where it acts like what is
free (a stretch of one camera's image beside that of the other's), leaving it out makes the
covariance many times smaller than the error: a stretch of three standard deviations bends space by
thirty. Such a group is *considered* (Schmidt and Kalman's word): the estimate stays that of the
simpler model, and its mean squared error is counted with the group's value open.

With C the covariance of the model that has the group, v the Gauss-Newton step to its minimum, and
nothing known of the value but what the data say, E[(estimate - truth)^2] = C + v v^T; the group's
own rows, held at nominal, are part of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from telerig.estimator.calibration.solver.covariance import JointCovariance, joint_covariance
from telerig.estimator.calibration.solver.levenberg_marquardt import Solution, linearisation
from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.solver.system import slots
from telerig.rig.lens_models import GROUPS, groups_of, name_of, ordered

if TYPE_CHECKING:
    from telerig.estimator.calibration.lens.choice import Choice

Lens = frozenset[str]

CONSIDERED_P_VALUE = 0.01
"""Of the gain, below which a group is considered though freeing it is not worth its penalty."""
UNDAMPED = 1e-12


def considered_groups(choice: Choice | None, cameras: int) -> tuple[Lens, ...]:
    """Per camera the groups that are left out and may matter.

    Those that another camera of the rig needs (its lens is of the same kind, so that here the group
    is small rather than absent), and those whose gain is hardly chance. Not those that the views do
    not determine: of these the weak priors would be all that is known.
    """
    out: list[set[str]] = [set() for _ in range(cameras)]
    steps = choice.steps if choice is not None else ()
    taken = {(step.camera, g) for step in steps if step.taken for g in _acts_like(step.added)}
    for step in steps:
        if step.taken or step.undetermined:
            continue
        elsewhere = {group for camera, group in taken if camera != step.camera}
        groups = _groups(step.added)
        if groups & elsewhere or step.p_value < CONSIDERED_P_VALUE:
            out[step.camera] |= groups
    return tuple(Lens(groups) for groups in out)


def _groups(parameters: tuple[str, ...]) -> Lens:
    return Lens(g for g, names in GROUPS.items() if names == parameters)


def _acts_like(parameters: tuple[str, ...]) -> Lens:
    """A tilted sensor stretches the image."""
    groups = _groups(parameters)
    return groups | {"affine"} if "tilt" in groups else groups


def considered_covariance(
    problem: Problem,
    solution: Solution,
    joint: JointCovariance,
    models: Sequence[str],
    groups: Sequence[Lens],
) -> tuple[tuple[tuple[str, ...], ...], JointCovariance]:
    """Per camera what the covariance speaks of besides what is free, and the covariance.

    joint : of the solution.  models : of the solution, per camera.  groups : considered besides,
    per camera.
    """
    if not any(groups):
        return problem.free, joint
    names = [name_of({*groups_of(model), *more}) for model, more in zip(models, groups)]
    wide = problem.with_model(names)
    equations = linearisation(wide)[1](solution.state)
    step, _ = equations.step(UNDAMPED)
    there = replace(solution, equations=equations, slots=slots(wide))
    # the residuals are those of the simpler fit
    found = joint_covariance(wide, there, leverage=joint.leverage)
    return wide.free, found.widened(step)


def considered_words(groups: Sequence[Lens], cameras: Sequence[str]) -> str:
    """Appended to the words of the choice; empty where nothing is considered."""
    parts = [
        f"{', '.join(p for g in ordered(more) for p in GROUPS[g])} of camera {camera!r}"
        for camera, more in zip(cameras, groups) if more
    ]  # fmt: skip
    if not parts:
        return ""
    return (
        f"; {' and '.join(parts)}: held at nominal because freeing it is not worth its "
        "penalty, but the data do not exclude it, so every stated uncertainty contains its effect"
    )
