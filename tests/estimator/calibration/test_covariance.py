"""The joint covariance against GTSAM's own Marginals of the same graph."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from telerig.estimator.calibration.solver import robust_least_squares as graph
from telerig.estimator.calibration.solver.problem import (
    eccentricity_px,
    held_at_nominal,
    problem_from_dots,
)
from telerig.estimator.calibration.start import known_target
from telerig.io.simulation.presets import preset


def test_a_large_problem_is_advised_too(scene: Any, monkeypatch: Any) -> None:
    """The same advice with and without the covariance of all with all."""
    made = scene("paper", 4, views=8)
    whole = made.calibrate("radial").diagnostics["next_view"]
    monkeypatch.setattr("telerig.estimator.calibration.solver.covariance.FULL_COVARIANCE_UP_TO", 10)
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
    problem = replace(problem, solver="schur")
    start = known_target.stereo_states(problem, problem.nominal_mm)[0]
    cost = {}
    for model in ("tangential", "affine+tangential"):
        candidate = problem.with_model(model)
        state = graph.solve(candidate, held_at_nominal(candidate, start)).state
        candidate = replace(candidate, eccentricity_px=eccentricity_px(candidate, state))
        cost[model] = graph.solve(candidate, state).cost
    assert cost["affine+tangential"] < 100 < 0.01 * cost["tangential"]
