"""Chooses each camera's lens model by what the data support.

A rich model is fitted once, and the information criterion of `search` selects the best model that
it contains. The models between the simplest one and the selected one are then fitted, with one more
group of parameters at each step. Each step is kept only if it predicts left-out views at least as
well as the step before (cross-validation).

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
from functools import partial

import numpy as np
from scipy.special import chdtrc

from telerig.arrays import Array
from telerig.estimator.calibration.lens.search import (
    UNDETERMINED,
    Addition,
    Lens,
    Lenses,
    QuadraticCost,
    additions,
    possible,
    search,
    steps_to,
)
from telerig.estimator.calibration.solver.covariance import JointCovariance, joint_covariance
from telerig.estimator.calibration.solver.problem import (
    Problem,
    System,
    held_at_nominal,
    images_of,
    retracted,
)
from telerig.estimator.calibration.solver.robust_least_squares import Solution, linearisation, solve
from telerig.factors.calibration import State, pixels, whitened_error
from telerig.io.machine.parallel import ordered_map, quick_workers
from telerig.rig.lens_parameters import AUTO, GROUPS, INDEX, groups_of, joint_name, name_of, ordered

DOTS_FOR_WORKERS = 500
"""Number of measured dots below which no worker processes are used: four fits then take 0.1 s, and
starting processes for them 0.05 s."""
TOO_COSTLY = 10.0
"""A model is not cross-validated if its cost is more than this many times that of the rich
model."""
ROUNDS = 3
AGREEMENT = 2.0
"""If the chi-square of a fit differs by more than this from its quadratic prediction, the quadratic
is recomputed at the fit."""

_TILT = [INDEX["tilt_x"], INDEX["tilt_y"]]
_SHAPE = [INDEX["aspect"], INDEX["skew"]]
_SCALE = INDEX["scale_px_per_mm"]


@dataclass(frozen=True)
class FittedModel:
    """A fitted lens model of all cameras.

    lenses : for each camera the groups of parameters that are free.
    parameters : number of free intrinsics.
    cost : half the sum of squared whitened residuals, including those of the priors.
    rows : number of measured coordinates.
    rms_px : RMS residual per coordinate.
    per_view : (V,) for each of the V views the mean squared whitened residual when a fit without
        this view predicts it; NaN if too few views would remain for the fit, infinite if the model
        was not cross-validated.
    """

    lenses: Lenses
    parameters: int
    cost: float
    rows: int
    rms_px: float
    per_view: Array
    state: State

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name_of(lens) for lens in self.lenses)

    @property
    def left_out(self) -> float:
        """The mean of ``per_view``; infinite if no view could be left out."""
        seen = self.per_view[~np.isnan(self.per_view)]
        return float(seen.mean()) if len(seen) else float("inf")


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
    fit : None if the gain was predicted without a fit.
    undetermined : whether the views do not determine the added parameters.
    """

    camera: int
    added: tuple[str, ...]
    lenses: Lenses
    gain: float
    bic_gain: float
    taken: bool
    words: str
    fit: FittedModel | None
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
    words : reasons of the choice, for the user.
    """

    steps: tuple[Step, ...]
    chosen: FittedModel
    words: str


def choose(problem: Problem, rich: Solution, models: Sequence[str]) -> Choice:
    """Choose the lens model of each camera among all that the richest model contains.

    problem, rich : the problem with the richest model, and its solution.
    models : for each camera "auto", or the name of the lens model that the user gave.
    """
    whole = tuple(_lens_of(free) for free in problem.free)
    allowed = [possible(lens) if m == AUTO else [lens] for lens, m in zip(whole, models)]
    simplest = tuple(min(options, key=len) for options in allowed)
    quadratic = QuadraticCost.of(problem, rich)
    wanted = _determined(quadratic, allowed)
    for _ in range(ROUNDS):
        path = steps_to(quadratic, wanted, simplest)
        alternatives = _alternatives(quadratic, wanted, allowed)
        fits = _fits(problem, rich, [simplest, *(step[2] for step in path)], alternatives)
        fitted, others = fits[: len(path) + 1], fits[len(path) + 1 :]
        quadratic, better = _revised(problem, quadratic, fitted[-1], others, allowed)
        if better == wanted:
            break
        wanted = better
    steps = _without_worse_predictions(_taken(quadratic, path, fitted))
    chosen = [step.fit for step in steps if step.taken and step.fit is not None][-1]
    refused = [step for step in steps if not step.taken]
    steps += _not_taken(quadratic, chosen.lenses, allowed, refused)
    return Choice(tuple(steps), chosen, _words(problem, steps, chosen, others))


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


def _alternatives(
    quadratic: QuadraticCost, wanted: Lenses, allowed: list[list[Lens]]
) -> list[Lenses]:
    """Return more models to fit: the best without a tilt, and the richest without kappa."""
    out = []
    if any("tilt" in lens for lens in wanted):
        flat = [[lens for lens in options if "tilt" not in lens] or options for options in allowed]
        out.append(_determined(quadratic, flat))
    if any("kappa" in lens and len(options) > 1 for lens, options in zip(wanted, allowed)):
        richest = (max(options, key=len) for options in allowed)
        out.append(tuple(
            lens - {"kappa", "centre"} if len(options) > 1 else lens
            for lens, options in zip(richest, allowed)
        ))  # fmt: skip
    return out


def _fits(
    problem: Problem, rich: Solution, path: list[Lenses], alternatives: list[Lenses]
) -> list[FittedModel]:
    # a fork of a process that has used GTSAM can hang, because GTSAM's threads are not copied
    """Return fitted models of the path and the alternatives; only the path is cross-validated."""
    tasks = [(lenses, True) for lenses in path] + [(lenses, False) for lenses in alternatives]
    here = problem.solver == "gtsam" or len(problem.uv_px) < DOTS_FOR_WORKERS
    workers = 1 if here else quick_workers(len(tasks))
    return list(ordered_map(partial(_fit, problem, rich), tasks, workers))


def _fit(problem: Problem, rich: Solution, task: tuple[Lenses, bool]) -> FittedModel:
    lenses, predict = task
    problem = problem.with_model([name_of(lens) for lens in lenses])
    begin = model_start(problem, rich.state)
    solution = solve(problem, begin, max_iterations=40, relative=1e-7)
    obs = problem.observations()
    residual = pixels(solution.state, obs, problem.rho_mm) - obs.uv_px
    per_view = np.full(len(problem.views), np.inf)
    if predict and solution.cost < TOO_COSTLY * rich.cost:
        per_view = cross_validation_chi2(problem, solution.state)
    count = sum(len(free) for free in problem.free)
    rms = float(np.sqrt((residual**2).mean()))
    return FittedModel(lenses, count, solution.cost, residual.size, rms, per_view, solution.state)


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


def _revised(
    problem: Problem,
    quadratic: QuadraticCost,
    fit: FittedModel,
    others: list[FittedModel],
    allowed: list[list[Lens]],
) -> tuple[QuadraticCost, Lenses]:
    """Return the quadratic and the wanted model, or better ones.

    A better model is an alternative with lower cost, or the best of a new quadratic, which is
    computed where the predicted cost of the wanted model differs from the fitted one.
    """
    fitting = [o for o in others if all(x in options for x, options in zip(o.lenses, allowed))]
    best = min((fit, *fitting), key=lambda f: quadratic.cost_of_fit(f.lenses, f.cost))
    if best is not fit:
        return quadratic, best.lenses
    predicted = quadratic.least + quadratic.rise(fit.lenses)
    if any("tilt" in lens for lens in fit.lenses):
        return quadratic, fit.lenses
    if abs(2 * fit.cost / quadratic.variance - predicted) < AGREEMENT:
        return quadratic, fit.lenses
    there = solve(problem, fit.state, max_iterations=0)
    quadratic = QuadraticCost.of(problem, there)
    return quadratic, _determined(quadratic, allowed)


def _taken(quadratic: QuadraticCost, path: list[Addition], fits: list[FittedModel]) -> list[Step]:
    """Return the steps along the path of fitted models, all marked as taken."""
    out = [Step(-1, (), fits[0].lenses, float("nan"), float("nan"), True, "", fits[0])]
    for (camera, group, lenses), before, after in zip(path, fits, fits[1:]):
        gain = 2 * (before.cost - after.cost) / quadratic.variance
        bic_gain = gain - quadratic.penalty_of(Lens({group}))
        out.append(Step(camera, GROUPS[group], lenses, gain, bic_gain, True, "", after))
    return out


def _without_worse_predictions(steps: list[Step]) -> list[Step]:
    """Return the steps; those at the end that predict left-out views worse count as not taken."""
    last = len(steps) - 1
    while last > 0:
        before, after = (steps[k].fit for k in (last - 1, last))
        assert before is not None and after is not None
        if not after.left_out > before.left_out:
            break
        words = (
            "not added: with it, views that the fit leaves out are predicted "
            f"{after.left_out / before.left_out - 1:.1%} worse"
        )
        steps[last] = replace(steps[last], taken=False, words=words)
        last -= 1
    return steps


def _not_taken(
    quadratic: QuadraticCost, chosen: Lenses, allowed: list[list[Lens]], refused: list[Step]
) -> list[Step]:
    """Return what one more group would have gained, except for tilts and refused groups."""
    known = {(step.camera, step.added) for step in refused}
    out = []
    for camera, group, lenses in additions(chosen, allowed):
        if group == "tilt" or (camera, GROUPS[group]) in known:
            continue
        gain = max(quadratic.rise(chosen) - quadratic.rise(lenses), 0.0)
        bic_gain = gain - quadratic.penalty_of(Lens({group}))
        share = quadratic.sd_over_prior(lenses, camera, group)
        words = (
            "held at nominal: chi-square would fall by less than the penalty of "
            f"{gain - bic_gain:.1f}"
        )
        if share > UNDETERMINED:
            words = (
                "held at nominal: these views do not determine it (posterior standard deviation "
                f"{share:.0%} of the prior one)"
            )
        out.append(
            Step(camera, GROUPS[group], lenses, gain, bic_gain, False, words, None,
                 share > UNDETERMINED)
        )  # fmt: skip
    return out


def _words(
    problem: Problem, steps: list[Step], chosen: FittedModel, others: list[FittedModel]
) -> str:
    """Return the choice in sentences for the user."""
    cameras = [c.name for c in problem.cameras]
    name = joint_name(chosen.names, cameras)
    words = f"{name}: {_prediction_words(steps, chosen, cameras)}"
    without = [fit for fit in others if not any("kappa" in lens for lens in fit.lenses)]
    if any("kappa" in lens for lens in chosen.lenses) and without:
        words += (
            "; kappa = 0 is rejected: the scale changes with depth, and the best model without "
            f"it ({joint_name(without[-1].names, cameras)}) leaves {without[-1].rms_px:.3g} px RMS "
            f"instead of {chosen.rms_px:.3g} px"
        )
    for camera, lens, intrinsics in zip(cameras, chosen.lenses, chosen.state.intrinsics):
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


def _prediction_words(steps: list[Step], chosen: FittedModel, cameras: list[str]) -> str:
    """Say how all steps together, and the last one, changed the prediction of left-out views."""
    taken = [step for step in steps if step.taken]
    fits = [step.fit for step in taken if step.fit is not None]
    simpler = [fit for fit in fits[:-1] if np.isfinite(fit.left_out)]
    if not np.isfinite(chosen.left_out):
        return (
            "lowest information criterion; it was not cross-validated, because there are too few "
            "views"
        )
    if not simpler:
        return "in cross-validation no richer model predicts left-out views better"
    words = (
        "in cross-validation the mean square error of left-out views is "
        f"{simpler[0].left_out / chosen.left_out:.3g} times smaller than with the model "
        f"{joint_name(simpler[0].names, cameras)}"
    )
    if len(simpler) > 1:
        last = ", ".join(taken[-1].added)
        words += (
            f", and {simpler[-1].left_out / chosen.left_out:.4g} times smaller than without the "
            f"parameters that were added last ({last} of camera {cameras[taken[-1].camera]!r})"
        )
    return words


def _stretch_words(camera: str, intrinsics: Array) -> str:
    """Return a clause on the stretch of a camera's image that aspect ratio and skew describe."""
    aspect, skew = intrinsics[[INDEX["aspect"], INDEX["skew"]]]
    axes = np.linalg.svd(np.array([[1.0, skew], [0.0, aspect]]), compute_uv=False)
    return (
        f"the image of camera {camera!r} is stretched by {100 * (axes[0] / axes[1] - 1):.2g} %: "
        "either its pixels are not square, or its sensor is tilted behind a lens that is "
        "telecentric on both sides; images cannot distinguish the two"
    )


FOLDS = 4
DAMPING = 1e-6
POSE_STEPS = 3
"""Number of Gauss-Newton steps of a left-out view's pose, from its pose in the fit to all views."""


def pose_only(problem: Problem, state: State, steps: int = 15) -> State:
    """Return the state in which the pose of the target in every view fits best.

    All other parameters stay as they are. steps : largest number of Gauss-Newton steps.
    """
    system = System(problem)
    for _ in range(steps):
        normal = np.zeros((len(problem.views), 6, 6))
        right = np.zeros((len(problem.views), 6))
        for c, obs in enumerate(system.images):
            columns = system.columns(state, c)[-7:]
            for v, a, b in images_of(obs):
                flat = columns[..., a:b].reshape(7, -1)
                normal[v] += flat[:-1] @ flat[:-1].T
                right[v] -= flat[:-1] @ flat[-1]
        # a view that only one telecentric camera sees has an undetermined depth
        normal += (1e-9 + 1e-9 * np.trace(normal, axis1=-2, axis2=-1))[:, None, None] * np.eye(6)
        step = np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], np.float64)
        state = replace(state, rig_from_target=retracted(state.rig_from_target, step))
        if np.abs(step).max() < 1e-10:
            break
    return state


def cross_validation_chi2(problem: Problem, state: State, folds: int = FOLDS) -> Array:
    """Cross-validate a lens model: predict each of the V views by a fit that leaves it out.

    The views are left out in ``folds`` parts, one after the other. A fit without one part is one
    Gauss-Newton step from ``state``, the minimum with all views. Only the pose of the target is
    then fitted to each left-out view.

    Returns the mean squared whitened residual (V,) of each view; NaN if too few views would remain
    without its part.
    """
    views = np.arange(len(problem.views))
    out = np.full(len(views), np.nan)
    for fold in range(folds):
        left_out = views[fold::folds]
        if len(left_out) == 0 or len(views) - len(left_out) < 2:
            continue
        mine = np.isin(problem.view, left_out)
        system, linearised = linearisation(problem.subset(~mine))
        step, _ = linearised(state).step(DAMPING)
        trained = replace(system.moved(state, step), rig_from_target=state.rig_from_target)
        test = problem.subset(mine)
        fitted = pose_only(test, trained, steps=POSE_STEPS)
        obs = test.observations()
        squares = (whitened_error(fitted, obs, problem.rho_mm) ** 2).sum(-1)
        for v in left_out:
            if np.any(obs.view == v):
                out[v] = squares[obs.view == v].mean()
    return out


CONSIDERED_P_VALUE = 0.01
"""The uncertainty of a group of parameters that are held is considered in the covariance if freeing
the group improves the fit with a p-value below this."""
UNDAMPED = 1e-12


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
    equations = linearisation(wide)[1](solution.state)
    step, _ = equations.step(UNDAMPED)
    there = replace(solution, equations=equations)
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
