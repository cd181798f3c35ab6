"""Searches for the best lens model of each camera, from a single fit of a rich model.

Near the minimum of the rich model, with poses and dots eliminated, the cost is a quadratic form in
the lens parameters. A simpler model holds some coordinates of this form at nominal. Let d be their
offsets from nominal in the rich fit and C_dd their covariance. The least cost of the simpler model
is then higher by d^T C_dd^-1 d / 2 (Wald's statistic, exact for a linear problem). All models of
all cameras can therefore be compared by small linear systems, without a fit of each.

The criterion is the extended Bayesian information criterion (Chen and Chen, Biometrika 95:759,
2008).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np

from telerig.arrays import Array
from telerig.estimator.calibration.quality.residual_structure import residual_tests
from telerig.estimator.calibration.solver.covariance import JointCovariance, joint_covariance
from telerig.estimator.calibration.solver.gaussian import Estimate
from telerig.estimator.calibration.solver.problem import Problem, parameter_unit
from telerig.estimator.calibration.solver.system import Solution
from telerig.estimator.calibration.thresholds import GROUP_PENALTY
from telerig.factors.calibration import whitened_error
from telerig.rig.lens_parameters import GROUPS, INDEX, PLAIN_GROUPS, ordered

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
