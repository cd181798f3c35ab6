"""The joint covariance against GTSAM's own Marginals of the same graph."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from telerig.estimator.calibration.self_calibration import best_start
from telerig.estimator.calibration.solver import robust_least_squares as graph
from telerig.estimator.calibration.solver.covariance import joint_covariance
from telerig.estimator.calibration.solver.nonlinear_graph import nonlinear_graph
from telerig.estimator.calibration.solver.problem import (
    Problem,
    eccentricity_px,
    held_at_nominal,
    parameter_unit,
    problem_from_dots,
)
from telerig.estimator.calibration.start import known_target
from telerig.io.simulation.presets import preset


def by_marginals(problem: Problem, state: Any) -> Any:
    """Covariance of all variables, in the order and units of `JointCovariance`."""
    factors, values, keys = nonlinear_graph(problem, state)
    marginals = gtsam.Marginals(factors, values)
    ordered = [k for c, k in enumerate(keys.intrinsics) if problem.free[c]]
    ordered += [*keys.camera[1:], *keys.view, *keys.dots]
    joint = marginals.jointMarginalCovariance(ordered)
    blocks = [[joint.at(a, b) for b in ordered] for a in ordered]
    unit = np.ones(sum(b.shape[1] for b in blocks[0]))
    lens = [parameter_unit(c)[problem.free_indices(i)] for i, c in enumerate(problem.cameras)]
    unit[: sum(map(len, lens))] = np.concatenate(lens)
    return np.block(blocks) * unit[:, None] * unit


@pytest.mark.parametrize(
    ("preset", "model", "solver"),
    [
        ("scheimpflug", "affine+radial", "gtsam"),
        ("two_sided", "radial", "numpy"),
    ],
)
def test_it_is_that_of_gtsams_marginals(preset: str, model: str, solver: str, scene: Any) -> None:
    """To 1e-6 of the standard deviations, element by element."""
    made = scene(preset, 2, views=8)
    problem = problem_from_dots(made.dots, made.cameras, made.target)
    problem, _ = best_start(problem, problem.nominal_mm)
    problem = problem.with_model(model)
    start = known_target.stereo_states(problem, problem.nominal_mm)[0]
    problem = replace(problem, solver=solver)
    solution = graph.solve(problem, held_at_nominal(problem, start))
    ours = joint_covariance(problem, solution)
    theirs = by_marginals(problem, solution.state)
    sd = np.sqrt(np.diag(theirs))
    assert ours.matrix.shape == theirs.shape == (len(ours.names),) * 2
    assert np.abs((ours.matrix - theirs) / np.outer(sd, sd)).max() < 1e-6


def test_a_large_problem_is_advised_too(scene: Any, monkeypatch: Any) -> None:
    """The same advice with and without the covariance of all with all."""
    made = scene("paper", 4, views=8)
    whole = made.calibrate("radial").diagnostics["next_view"]
    monkeypatch.setattr("telerig.estimator.calibration.solver.covariance.MANY_PARAMETERS", 10)
    part = made.calibrate("radial").diagnostics["next_view"]
    assert part["before_um"] == pytest.approx(whole["before_um"], rel=1e-9)
    assert part["after_um"] == pytest.approx(whole["after_um"], rel=1e-3)


def test_a_decentred_lens_with_tangential_distortion_stretches_its_image(scene: Any) -> None:
    """About a centre that is held elsewhere, p1 is p1, a shift, and an affine map without a scale.

    Without aspect and skew the fit is off by more than dense targets can tell.
    """
    settings = preset("paper", sigma_px=0.0)
    lenses = tuple(
        replace(c, centre_offset_px=(4.2, -5.0), parameters={"k1": 4e-3, "p1": 6e-4})
        for c in settings.cameras
    )
    made = scene(replace(settings, cameras=lenses), 6)
    problem = problem_from_dots(made.dots, made.cameras, made.target)
    problem = replace(problem, solver="numpy")
    start = known_target.stereo_states(problem, problem.nominal_mm)[0]
    cost = {}
    for model in ("tangential", "affine+tangential"):
        candidate = problem.with_model(model)
        state = graph.solve(candidate, held_at_nominal(candidate, start)).state
        candidate = replace(candidate, eccentricity_px=eccentricity_px(candidate, state))
        cost[model] = graph.solve(candidate, state).cost
    assert cost["affine+tangential"] < 100 < 0.01 * cost["tangential"]
