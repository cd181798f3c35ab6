"""The chosen model holds considered parameters at nominal, but the covariance includes their
effect.

A group of parameters that is not worth freeing is not therefore zero. Some groups act like
parameters that are free: the stretch of one camera's image, for instance, acts like that of the
other camera's. If such a group is ignored, the stated covariance can be many times smaller than the
true error: a stretch of 3 standard deviations shifts triangulated points by 30 of their stated
ones. Such a group is *considered* (a term of Schmidt-Kalman filtering). The estimate remains that
of the simpler model, and its mean squared error is computed with the group's value unknown.

Let C be the covariance of the model that frees the group, and v the Gauss-Newton step from the
simpler model's estimate to the minimum of that model. If only the data inform about the group, then
E[(estimate - truth)^2] = C + v v^T. This includes the group's own rows, which are held at nominal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from telerig.estimator.calibration.solver.covariance import JointCovariance, joint_covariance
from telerig.estimator.calibration.solver.levenberg_marquardt import Solution, linearisation
from telerig.estimator.calibration.solver.problem import Problem
from telerig.rig.lens_models import GROUPS, groups_of, name_of, ordered

if TYPE_CHECKING:
    from telerig.estimator.calibration.lens.choice import Choice

Lens = frozenset[str]

CONSIDERED_P_VALUE = 0.01
"""A group is considered if the improvement of the fit when it is freed has a p-value below this,
even if the improvement is too small to free the group in the model."""
UNDAMPED = 1e-12


def considered_groups(choice: Choice | None, cameras: int) -> tuple[Lens, ...]:
    """Return for each camera the considered groups of lens parameters (names as in `GROUPS`).

    A considered group is held at its nominal value in the fit, but the covariance of the result
    includes its uncertainty. A group that the lens model of a camera does not free is considered if
    the model of another camera frees it (the lenses are of the same kind, so its value is probably
    small but not zero here), or if the improvement of the fit when it is freed is unlikely to be
    chance (p-value below `CONSIDERED_P_VALUE`). A group that the views do not determine is not
    considered, because its weak prior would then dominate the covariance.

    choice : the steps by which the lens models were chosen; None if they were not chosen
        automatically. No group is then considered.
    cameras : number of cameras.
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
    """Return the groups of these parameters, and "affine" for a tilt, which also stretches the
    image.
    """
    groups = _groups(parameters)
    return groups | {"affine"} if "tilt" in groups else groups


def considered_covariance(
    problem: Problem,
    solution: Solution,
    joint: JointCovariance,
    models: Sequence[str],
    groups: Sequence[Lens],
) -> tuple[tuple[tuple[str, ...], ...], JointCovariance]:
    """Return for each camera the parameters in the covariance, and the covariance.

    The parameters are the free ones and the considered ones.

    joint : covariance of the solution.
    models : name of each camera's model.
    groups : for each camera the considered groups.
    """
    if not any(groups):
        return problem.free, joint
    names = [name_of({*groups_of(model), *more}) for model, more in zip(models, groups)]
    wide = problem.with_model(names)
    equations = linearisation(wide)[1](solution.state)
    step, _ = equations.step(UNDAMPED)
    there = replace(solution, equations=equations)
    # the leverage stays that of the simpler fit, because the residuals do
    found = joint_covariance(wide, there, leverage=joint.leverage)
    return wide.free, found.widened(step)


def considered_words(groups: Sequence[Lens], cameras: Sequence[str]) -> str:
    """Return a clause on the considered parameters, for the end of the choice's words; "" if none
    are.
    """
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
