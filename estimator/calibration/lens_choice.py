"""Chooses each camera's lens model by what the data support.

A rich model is fitted once. Near its minimum, with poses and dots eliminated, the cost is a
quadratic form in the lens parameters. A simpler model holds some coordinates of this form at
nominal. Let d be their offsets from nominal in the rich fit and C_dd their covariance. The least
cost of the simpler model is then higher by d^T C_dd^-1 d / 2 (Wald's statistic, exact for a linear
problem). All models of all cameras can therefore be compared by small linear systems, without a fit
of each. The criterion is the extended Bayesian information criterion (Chen and Chen, Biometrika
95:759, 2008).

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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
from scipy.special import chdtrc

from telerig.arrays import Array
from telerig.estimator.calibration.quality.residual_structure import residual_tests
from telerig.estimator.calibration.solver.covariance import JointCovariance, joint_covariance
from telerig.estimator.calibration.solver.gaussian import Estimate
from telerig.estimator.calibration.solver.problem import Problem, held_at_nominal, parameter_unit
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.estimator.calibration.solver.system import Solution, System
from telerig.estimator.calibration.thresholds import (
    CONSIDERED_P_VALUE,
    GROUP_PENALTY,
    UNDETERMINED,
)
from telerig.factors.calibration import State, whitened_error
from telerig.rig.lens_parameters import (
    AUTO,
    GROUPS,
    INDEX,
    PLAIN_GROUPS,
    groups_of,
    joint_name,
    name_of,
    ordered,
)
from telerig.short_text import number

_TILT = [INDEX["tilt_x"], INDEX["tilt_y"]]
_SHAPE = [INDEX["aspect"], INDEX["skew"]]
_SCALE = INDEX["scale_px_per_mm"]

Lens = frozenset[str]
"""The parameter groups of one camera's lens model."""
Lenses = tuple[Lens, ...]
Addition = tuple[int, str, Lenses]
"""A camera, a group of parameters, and the model to which this group has been added for this
camera.
"""

_HOMOGRAPHY = (("p1", "s3"), ("p2", "s1"))
"""The homography of a tilted sensor is, to first order, p1 = -s3 and p2 = -s1, so these sums
vanish.
"""
NOISE_DOF = 20.0
"""The stated noise counts as this many degrees of freedom when the variance of the residuals is
estimated."""


@dataclass(frozen=True)
class QuadraticCost:
    """The chi-square of all lens models, approximated by a quadratic form about the minimum of the
    richest one.

    Its K coordinates are the free intrinsics of all cameras, in units of `parameter_unit`, and two
    sums of intrinsics for each camera, which describe the homography of a tilted sensor.

    names : (camera, parameter) of each coordinate.
    minimum : the K coordinates of the minimum, relative to nominal, and their covariance.
    prior : (K,) standard deviations of the priors.
    least : chi-square at the minimum.
    variance : variance of the residuals relative to the stated noise, by which every chi-square
        here is divided.
    penalty : penalty of each free parameter.
    group_penalty : further penalty of each group.
    stretch_factor : factor of the penalty of aspect and skew beside a free image centre, see
        `_design_effect`.
    """

    names: tuple[tuple[int, str], ...]
    minimum: Estimate
    prior: Array
    least: float
    variance: float
    penalty: float
    group_penalty: float
    stretch_factor: float = 1.0

    @staticmethod
    def of(problem: Problem, solution: Solution) -> QuadraticCost:
        """Return the quadratic form from a fit of the rich model, or a state near its minimum."""
        names = [(c, p) for c, free in enumerate(problem.free) for p in free]
        joint = joint_covariance(problem, solution, whole=False)
        step, still = solution.gaussian.step()
        size = len(names)
        unit = np.concatenate(
            [parameter_unit(k)[problem.free_indices(c)] for c, k in enumerate(problem.cameras)]
        )
        prior = np.concatenate(
            [problem.prior_sigma(c)[problem.free_indices(c)] for c in range(len(problem.cameras))]
        )
        nominal = [problem.cameras[c].intrinsics[INDEX[p]] for c, p in names]
        there = [solution.state.intrinsics[c, INDEX[p]] for c, p in names]
        minimum = Estimate(np.array(there) - nominal + step[:size], joint.matrix[:size, :size])
        more = [
            ((c, f"{a}+{b}"), names.index((c, a)), names.index((c, b)))
            for c in range(len(problem.cameras))
            for a, b in _HOMOGRAPHY
            if (c, a) in names and (c, b) in names
        ]
        extend = np.diag(1 / unit)
        extend = np.concatenate([extend, np.zeros((len(more), size))])
        for row, (_, a, b) in enumerate(more, size):
            extend[row, [a, b]] = 1 / unit[[a, b]]
        groups = sum(1 for c in range(len(problem.cameras)) for g in PLAIN_GROUPS
                     if (c, GROUPS[g][0]) in names)  # fmt: skip
        variance = _variance(problem, solution, joint)
        perspective = any(parameter == "centre_u_px" for _, parameter in names)
        rows = 2 * int(np.sum(problem.kept))
        return QuadraticCost(
            (*names, *(m[0] for m in more)), minimum.predict(extend),
            np.r_[prior / unit, np.ones(len(more))],
            2 * (solution.cost - still) / variance, variance,
            float(np.log(rows)), float(GROUP_PENALTY * np.log(max(groups, 1))),
            _design_effect(problem, solution, joint) if perspective else 1.0,
        )  # fmt: skip

    def rise(self, lenses: Lenses) -> float:
        """Return by how much chi-square of a model exceeds that of the richest one."""
        return self.minimum.chi_square(self._held(lenses)) / self.variance

    def cost(self, lenses: Lenses) -> float:
        """Return the information criterion of a model, up to a constant.

        It is the rise of chi-square plus the penalties.
        """
        return self.rise(lenses) + sum(self.penalty_of(lens) for lens in lenses)

    def cost_of_fit(self, lenses: Lenses, fitted_cost: float) -> float:
        """Return the information criterion of a model that was fitted, comparable with `cost`.

        fitted_cost : half the sum of squared whitened residuals.
        """
        penalties = sum(self.penalty_of(lens) for lens in lenses)
        return 2 * fitted_cost / self.variance - self.least + penalties

    def penalty_of(self, lens: Lens) -> float:
        """Return the penalty of one camera's model.

        A tilt counts as two groups, because it stretches the image and acts as a homography.
        """
        own = lens - {"centre"}
        groups = own | {"affine"} if "tilt" in own else own
        price = self.penalty * sum(len(GROUPS[g]) for g in own) + self.group_penalty * len(groups)
        if {"centre", "affine"} <= lens:
            price += (self.stretch_factor - 1) * self.penalty_of(Lens({"affine"}))
        return price

    def sd_over_prior(self, lenses: Lenses, camera: int, group: str) -> float:
        """Return how well the views determine a group of parameters of one camera.

        It is the largest ratio of posterior to prior standard deviation among the parameters.
        """
        mine = [i for i, n in enumerate(self.names) if n[0] == camera and n[1] in GROUPS[group]]
        share = self.minimum.hold(self._held(lenses)).sd / self.prior
        return float(share[mine].max()) if mine else 0.0

    def _held(self, lenses: Lenses) -> list[int]:
        return [
            i for i, (camera, parameter) in enumerate(self.names)
            if parameter in _held_by(lenses[camera])
        ]  # fmt: skip


@cache
def _held_by(lens: Lens) -> frozenset[str]:
    """Return the coordinates of the quadratic form that a lens model holds at nominal."""
    free = {p for g in lens for p in GROUPS[g]}
    held = {p for g in (*PLAIN_GROUPS, "centre") for p in GROUPS[g]} - free
    if "tilt" in lens:
        held -= {p for g in ("affine", "p", "s") for p in GROUPS[g]}
        if "p" not in lens:
            held |= {f"{a}+{b}" for a, b in _HOMOGRAPHY}
    return frozenset(held)


def _variance(problem: Problem, solution: Solution, joint: JointCovariance) -> float:
    """Return the variance of the residuals relative to the stated noise.

    It is chi-square of the images over its expectation (docs/theory.md); the stated noise adds
    `NOISE_DOF` degrees of freedom.
    """
    error = whitened_error(solution.state, problem.observations(), problem.rho_mm)
    dof = max(joint.effective_dof, 0.0)
    return float(((error**2).sum() + NOISE_DOF) / (dof + NOISE_DOF))


def _design_effect(problem: Problem, solution: Solution, joint: JointCovariance) -> float:
    """Return how much more power the residuals have in a parameter of the lens than in a dot.

    It is 1 unless they have a pattern: an error of the lens that no model has is smooth. Both
    cameras take it for a stretch of the target beside their perspective (docs/decisions/014).
    """
    error = whitened_error(solution.state, problem.observations(), problem.rho_mm)
    return float(residual_tests(problem, error, joint.leverage)[0]["widening"] ** 2)


def possible(rich: Lens) -> list[Lens]:
    """Return every lens model whose groups the richest model contains.

    k2 is free only together with k1. A tilt replaces aspect and skew, and excludes s, because both
    could describe the same homography. If the richest model frees the image centre, all models free
    the centre and kappa.
    """
    always = rich & {"centre", "kappa"} if "centre" in rich else Lens()
    richest = rich | {"tilt"} if {"affine", "p", "s"} <= rich else rich
    return sorted(_between(always, richest), key=ordered)


def search(quadratic: QuadraticCost, allowed: Sequence[Sequence[Lens]]) -> Lenses:
    """Return the lens models of all cameras with the lowest `QuadraticCost.cost`.

    allowed : for each camera the lens models to choose from. The model of one camera after the
    other is optimised until none changes, once from the richest and once from the simplest models;
    the better result is returned.
    """
    ends = []
    for start in (max, min):
        now = tuple(start(options, key=len) for options in allowed)
        for _ in range(10):
            before = now
            for c, options in enumerate(allowed):
                now = min(((*now[:c], lens, *now[c + 1 :]) for lens in options), key=quadratic.cost)
            if now == before:
                break
        ends.append(now)
    return min(ends, key=quadratic.cost)


def additions(lenses: Lenses, allowed: Sequence[Sequence[Lens]]) -> Iterator[Addition]:
    """Yield each way to add one group of parameters to the lens model of one camera.

    Each is (index of the camera, the group, the lens models of all cameras with it). allowed : the
    permitted models of each camera.
    """
    for c, options in enumerate(allowed):
        for lens in options:
            more = lens - lenses[c]
            if lenses[c] < lens and len(more) == 1:
                yield c, min(more), (*lenses[:c], lens, *lenses[c + 1 :])


def steps_to(quadratic: QuadraticCost, chosen: Lenses, least: Lenses) -> list[Addition]:
    """Return the additions that lead from the simplest model ``least`` to ``chosen``.

    Each adds the group that lowers the cost most.
    """
    within = [list(_between(low, high)) for low, high in zip(least, chosen)]
    now = least
    out: list[Addition] = []
    while now != chosen:
        step = min(additions(now, within), key=lambda s: quadratic.cost(s[2]))
        now = step[2]
        out.append(step)
    return out


def _between(low: Lens, high: Lens) -> Iterator[Lens]:
    """Yield every lens model that contains ``low`` and is contained in ``high``."""
    more = ordered(high - low)
    for picks in product((False, True), repeat=len(more)):
        lens = low | {g for g, pick in zip(more, picks) if pick}
        tilted_twice = "tilt" in lens and lens & {"affine", "s"}
        if not tilted_twice and ("k2" not in lens or "k1" in lens):
            yield Lens(lens)


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
