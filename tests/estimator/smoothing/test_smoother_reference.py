"""The smoothing graph equals an independent Kalman smoother, for every set of information."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shake_cases import (
    SCENARIOS,
    SERVO,
    Reference,
    Runs,
    Scenario,
    generate,
    parts_of,
    reference,
)
from shake_problem import UP, problem, true_model
from shake_reference import Part, carriage, reading

from telerig.estimator.smoothing.graph.solve import Options, Solution, solve
from telerig.estimator.smoothing.problem.problem import CarriageModel

SETS = ("one", "five", "references", "oracle", "arms", "carriage")
SENSED = ("arms", "carriage")
FORCE = CarriageModel("force", acceleration_rms_mm_s2=20.0, corner_hz=40.0, servo=SERVO)
MEAN_MM, RELATIVE = 1e-6, 1e-6


def with_carriage(scenario: Scenario, information: str, bubbles: int) -> dict[str, Part]:
    """The reference's parts with the carriage of the product's model in place of the servo."""
    parts = parts_of(scenario, information, bubbles)
    if information not in SENSED:
        return parts | {"servo": reading(10.0)}
    return parts | {"carriage": carriage(20.0, 40.0)}


def compared(fit: Reference, found: Solution, run: int) -> dict[str, tuple[float, float]]:
    """Largest difference of means (mm, mm/s) and relative one of standard deviations."""
    assert found.covariances is not None
    bubble, shake = found.graph.bubble, found.graph.shake
    out = {}
    states = found.state.bubbles[: len(found.graph.problem.t_s)]
    blocks = found.covariances.bubbles[: len(states)]
    for what, row in (("position", UP @ bubble.position), ("velocity", UP @ bubble.velocity)):
        out[what] = _apart(fit, fit.row(what), states @ row, _sigma(row, blocks), run)
    if "common" not in fit.model.parts:
        return out
    at_frames = found.graph.shake_at_frames(found.state.shake)
    for j in range(2):
        row = UP @ shake.offset[j]
        sigma = _sigma(row, found.covariances.shake)
        out[f"offset {j}"] = _apart(fit, fit.offset_row(j), at_frames @ row, sigma, run)
    return out


def _sigma(row: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("d,fde,e->f", row, covariance, row))


def _apart(
    fit: Reference, row: np.ndarray, mean: np.ndarray, sigma: np.ndarray, run: int
) -> tuple[float, float]:
    exact, exact_sigma = fit.posterior.of(row)
    return float(np.abs(mean - exact[:, run]).max()), float(np.abs(sigma / exact_sigma - 1).max())


def solved(scenario: Scenario, information: str, runs: Runs, run: int) -> Solution:
    model = true_model(scenario, information, carriage=FORCE if information in SENSED else None)
    return solve(problem(scenario, information, runs, run), model, Options(robust=False))


@pytest.mark.parametrize(
    ("name", "information"), [*(("S2", each) for each in SETS), ("S4", "one"), ("S4", "arms")]
)
def test_means_and_covariances_equal_the_reference(name: str, information: str) -> None:
    scenario = replace(SCENARIOS[name], frames=40)
    # marks live for 0.3 s: they change within the run
    if information == "references":
        scenario = replace(scenario, frames=160)
    runs = generate(scenario, 2, np.random.default_rng(5))
    fit = reference(scenario, information, runs, parts=with_carriage)
    apart = compared(fit, solved(scenario, information, runs, 1), 1)
    for what, (mean, sigma) in apart.items():
        # a standard deviation's relative error is half of a variance's
        assert mean < MEAN_MM * (10 if what == "velocity" else 1), (what, mean)
        assert sigma < RELATIVE / 2, (what, sigma)
