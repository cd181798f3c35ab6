"""Chooses each camera's lens model by what the data support.

A rich model is fitted once, and the information criterion of `search` selects the best model that
it contains; the others are not fitted.

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
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from telerig.arrays import Array
from telerig.estimator.calibration.lens.search import (
    Lens,
    Lenses,
    QuadraticCost,
    additions,
    possible,
    search,
    steps_to,
)
from telerig.estimator.calibration.solver.covariance import JointCovariance, joint_covariance
from telerig.estimator.calibration.solver.problem import Problem, held_at_nominal
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.estimator.calibration.solver.system import Solution, System
from telerig.estimator.calibration.thresholds import CONSIDERED_P_VALUE, UNDETERMINED
from telerig.factors.calibration import State
from telerig.rig.lens_parameters import AUTO, GROUPS, INDEX, groups_of, joint_name, name_of, ordered
from telerig.short_text import number

_TILT = [INDEX["tilt_x"], INDEX["tilt_y"]]
_SHAPE = [INDEX["aspect"], INDEX["skew"]]
_SCALE = INDEX["scale_px_per_mm"]


@dataclass(frozen=True)
class Step:
    """One step of the model choice: a group of parameters that was added to one camera's model, or
    that was considered and not added.

    camera, added : index of the camera and names of the added parameters; -1 and () for the first
        step, the simplest model.
    lenses : the model of all cameras with these parameters.
    gain : decrease of chi-square, in units of the residuals' variance.
    bic_gain : the same minus the penalty of the information criterion.
    taken : whether the group was added.
    words : why not.
    undetermined : whether the views do not determine the added parameters.
    """

    camera: int
    added: tuple[str, ...]
    lenses: Lenses
    gain: float
    bic_gain: float
    taken: bool
    words: str = ""
    undetermined: bool = False

    @property
    def p_value(self) -> float:
        """The probability of so large a gain if the true values of the added parameters are zero.

        It is NaN for the first step, which adds none.
        """
        return float(chdtrc(len(self.added), self.gain)) if self.added else float("nan")


@dataclass(frozen=True)
class Choice:
    """The chosen lens model.

    steps : those that led to the model, then those that were not taken.
    lenses : for each camera the groups of parameters that are free.
    start : a state near the minimum of the chosen model.
    words : reasons of the choice, for the user.
    """

    steps: tuple[Step, ...]
    lenses: Lenses
    start: State
    words: str

    @property
    def names(self) -> tuple[str, ...]:
        """Return the name of the lens model of each camera."""
        return tuple(name_of(lens) for lens in self.lenses)


def choose(problem: Problem, rich: Solution, models: Sequence[str]) -> Choice:
    """Choose the lens model of each camera among all that the richest model contains.

    problem, rich : the problem with the richest model, and its solution.
    models : for each camera "auto", or the name of the lens model that the user gave.
    """
    whole = tuple(_lens_of(free) for free in problem.free)
    allowed = [possible(lens) if m == AUTO else [lens] for lens, m in zip(whole, models)]
    simplest = tuple(min(options, key=len) for options in allowed)
    quadratic = QuadraticCost.of(problem, rich)
    chosen = _determined(quadratic, allowed)
    start = rich.state
    if any("tilt" in lens for lens in chosen):
        chosen, start = _tilted_or_flat(problem, rich, quadratic, chosen, allowed)
    steps = [Step(-1, (), simplest, np.nan, np.nan, True)]
    for camera, group, lenses in steps_to(quadratic, chosen, simplest):
        steps.append(_step(quadratic, steps[-1].lenses, camera, group, lenses))
    steps += _not_taken(quadratic, chosen, allowed)
    auto = [model == AUTO for model in models]
    words = _words(problem, quadratic, steps, auto, rich.state)
    return Choice(tuple(steps), chosen, start, words)


def _lens_of(free: Sequence[str]) -> Lens:
    return Lens(g for g, parameters in GROUPS.items() if set(parameters) <= set(free))


def _determined(quadratic: QuadraticCost, allowed: list[list[Lens]]) -> Lenses:
    """Return the best model among those whose parameters the views all determine."""
    allowed = list(allowed)
    while True:
        found = search(quadratic, allowed)
        undetermined = [
            (c, group) for c, lens in enumerate(found) for group in ordered(lens)
            if len(allowed[c]) > 1 and group != "centre"
            and quadratic.sd_over_prior(found, c, group) > UNDETERMINED
        ]  # fmt: skip
        if not undetermined:
            return found
        for c, group in undetermined:
            allowed[c] = [lens for lens in allowed[c] if group not in lens]


def _tilted_or_flat(
    problem: Problem,
    rich: Solution,
    quadratic: QuadraticCost,
    tilted_lenses: Lenses,
    allowed: list[list[Lens]],
) -> tuple[Lenses, State]:
    """Return the better one of a model with a tilt and the best model without, both fitted.

    The quadratic form contains a tilt to first order only. The form about the fit with the tilt
    says which of the other groups are needed beside it.
    """
    flat = [[lens for lens in options if "tilt" not in lens] or options for options in allowed]
    fits = []
    for lenses in (tilted_lenses, _determined(quadratic, flat)):
        model = problem.with_model([name_of(lens) for lens in lenses])
        fit = solve(model, model_start(model, rich.state), max_iterations=40, relative=1e-7)
        fits.append((quadratic.cost_of_fit(lenses, fit.cost), lenses, model, fit))
    _, lenses, model, fit = min(fits, key=lambda fit: fit[0])
    if lenses == tilted_lenses:
        parts = [
            [part for part in options if lens & {"tilt"} <= part <= lens]
            for lens, options in zip(lenses, allowed)
        ]
        about_fit = QuadraticCost.of(model, fit)
        lenses = search(replace(about_fit, group_penalty=quadratic.group_penalty), parts)
    return lenses, fit.state


def model_start(problem: Problem, state: State) -> State:
    """Return a start for the problem's own lens model, from the state that another model gave.

    A tilt of the sensor stretches the image in second order, so a solver cannot leave a tilt of
    zero. The start is therefore the tilt that stretches the image in the same way as the best
    aspect ratio and skew.
    """
    start = held_at_nominal(problem, state)
    if not any("tilt_x" in free for free in problem.free):
        return start
    shapes = tuple(
        (*(p for p in free if p not in GROUPS["tilt"]), *GROUPS["affine"])
        if "tilt_x" in free else free
        for free in problem.free
    )  # fmt: skip
    affine = replace(problem, free=shapes)
    fitted = solve(affine, held_at_nominal(affine, state), max_iterations=20, relative=1e-5).state
    cameras = [c for c, free in enumerate(problem.free) if "tilt_x" in free]
    return held_at_nominal(problem, tilted(fitted, cameras))


def tilted(state: State, cameras: Sequence[int]) -> State:
    """Return the state in which an equivalent tilt replaces aspect and skew of some cameras.

    The tilt is that of a lens that is telecentric on both sides: by `telerig.rig.projection` it
    stretches the image by sqrt(1 + q^2) along q. The sign of q is arbitrary.
    """
    intrinsics = state.intrinsics.copy()
    for camera in cameras:
        k = intrinsics[camera]
        aspect, skew = k[_SHAPE]
        _, stretch, axes = np.linalg.svd(np.array([[1.0, skew], [0.0, aspect]]))
        k[_TILT] = np.sqrt(max((stretch[0] / stretch[1]) ** 2 - 1, 1e-6)) * axes[0]
        k[_SCALE] *= stretch[1]
        k[_SHAPE] = [1.0, 0.0]
    return replace(state, intrinsics=intrinsics)


def _step(
    quadratic: QuadraticCost, before: Lenses, camera: int, group: str, lenses: Lenses
) -> Step:
    """Return the step that adds one group of parameters to the model ``before``."""
    gain = max(quadratic.rise(before) - quadratic.rise(lenses), 0.0)
    price = quadratic.penalty_of(lenses[camera]) - quadratic.penalty_of(before[camera])
    return Step(camera, GROUPS[group], lenses, gain, gain - price, True)


def _not_taken(quadratic: QuadraticCost, chosen: Lenses, allowed: list[list[Lens]]) -> list[Step]:
    """Return what one more group would gain, except for tilts."""
    out = []
    for camera, group, lenses in additions(chosen, allowed):
        if group == "tilt":
            continue
        step = _step(quadratic, chosen, camera, group, lenses)
        share = quadratic.sd_over_prior(lenses, camera, group)
        words = (
            "held at nominal: chi-square would fall by less than the penalty of "
            f"{step.gain - step.bic_gain:.1f}"
        )
        if share > UNDETERMINED:
            words = (
                "held at nominal: these views do not determine it (posterior standard deviation "
                f"{share:.0%} of the prior one)"
            )
        out.append(replace(step, taken=False, words=words, undetermined=share > UNDETERMINED))
    return out


def _words(
    problem: Problem, quadratic: QuadraticCost, steps: list[Step], auto: list[bool], rich: State
) -> str:
    """Return the choice in sentences for the user."""
    cameras = [c.name for c in problem.cameras]
    added = [step for step in steps[1:] if step.taken]
    chosen = [step for step in steps if step.taken][-1].lenses
    words = f"{joint_name([name_of(lens) for lens in chosen], cameras)}: "
    if added:
        last = f"{', '.join(added[-1].added)} of camera {cameras[added[-1].camera]!r}"
        words += (
            f"lowest information criterion; chi-square is {number(sum(s.gain for s in added))} "
            "smaller than with the model "
            f"{joint_name([name_of(x) for x in steps[0].lenses], cameras)}"
        )
        if len(added) > 1:
            words += f", {number(added[-1].gain)} of it by the parameters added last ({last})"
    else:
        words += "no further parameter lowers chi-square by more than its penalty"
    if any("kappa" in lens and free for lens, free in zip(chosen, auto)):
        whole = map(_lens_of, problem.free)
        without = tuple(x - {"kappa", "centre"} if free else x for x, free in zip(whole, auto))
        words += (
            "; kappa = 0 is rejected: the scale changes with depth, and chi-square would be at "
            f"least {number(quadratic.rise(without))} larger without it"
        )
    for camera, lens, intrinsics in zip(cameras, chosen, rich.intrinsics):
        if "affine" in lens:
            words += f"; {_stretch_words(camera, intrinsics)}"
    undetermined = [
        f"{', '.join(step.added)} of camera {cameras[step.camera]!r}"
        for step in steps if step.undetermined
    ]  # fmt: skip
    return words + (
        f"; held at nominal because these views do not determine it: {', '.join(undetermined)}"
        if undetermined else ""
    )  # fmt: skip


def _stretch_words(camera: str, intrinsics: Array) -> str:
    """Return a clause on the stretch of a camera's image that aspect ratio and skew describe."""
    aspect, skew = intrinsics[[INDEX["aspect"], INDEX["skew"]]]
    axes = np.linalg.svd(np.array([[1.0, skew], [0.0, aspect]]), compute_uv=False)
    return (
        f"the image of camera {camera!r} is stretched by {100 * (axes[0] / axes[1] - 1):.2g} %: "
        "either its pixels are not square, or its sensor is tilted behind a lens that is "
        "telecentric on both sides; images cannot distinguish the two"
    )


def considered_groups(choice: Choice | None, cameras: int) -> tuple[Lens, ...]:
    """Return for each camera the groups of lens parameters (names as in `GROUPS`) that are
    considered: they are held at nominal, but the covariance includes their uncertainty.

    A group is considered if the model of another camera frees it (the lenses are of the same kind),
    or if freeing it would improve the fit by more than chance (`CONSIDERED_P_VALUE`). Groups that
    the views do not determine are not considered, because their weak priors would dominate the
    covariance.

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
    """Return the groups of these parameters, and "affine" for a tilt, which also stretches."""
    groups = _groups(parameters)
    return groups | {"affine"} if "tilt" in groups else groups


def considered_covariance(
    problem: Problem,
    solution: Solution,
    joint: JointCovariance,
    models: Sequence[str],
    groups: Sequence[Lens],
) -> tuple[tuple[tuple[str, ...], ...], JointCovariance]:
    """Return the covariance of the free and the considered parameters, and their names by camera.

    joint : covariance of the solution, without considered parameters.
    models : for each camera the name of its lens model.
    groups : for each camera the considered groups.
    """
    if not any(groups):
        return problem.free, joint
    names = [name_of({*groups_of(model), *more}) for model, more in zip(models, groups)]
    wide = problem.with_model(names)
    there = replace(solution, gaussian=System(wide).gaussian(solution.state))
    step, _ = there.gaussian.step()
    # the leverage stays that of the simpler fit, because the residuals do
    found = joint_covariance(wide, there, leverage=joint.leverage)
    return wide.free, found.widened(step)


def considered_words(groups: Sequence[Lens], cameras: Sequence[str]) -> str:
    """Return a clause on the considered parameters, for the end of `Choice.words`; "" for none.

    groups : for each camera the considered groups. cameras : their names.
    """
    parts = [
        f"{', '.join(p for g in ordered(more) for p in GROUPS[g])} of camera {camera!r}"
        for camera, more in zip(cameras, groups) if more
    ]  # fmt: skip
    if not parts:
        return ""
    return (
        f"; held at nominal, because the fit improves by less than the penalty: "
        f"{' and '.join(parts)}. The data do not exclude other values, so every stated "
        "uncertainty contains their effect"
    )
