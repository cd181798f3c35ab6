"""Runs of the scenarios as tables, with their truth: `benchmarks/shake_scene.py` for the tests."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

from numpy.random import default_rng
from shake_problem import true_model
from shake_scene import LATERAL, LATERAL_SHAKE, Run, cases, simulate

from telerig.estimator.smoothing.problem.problem import ShakeModel


@cache
def run_of(scenario: str, seed: int, frames: int | None = None, **changes: Any) -> Run:
    """A run of a scenario whose case, or number of frames, is changed."""
    case = replace(cases()[scenario], **changes)
    if frames is not None:
        case = replace(case, scenario=replace(case.scenario, frames=frames))
    name = int.from_bytes(scenario.encode()[:8], "little")
    return simulate(case, default_rng([seed, name, 19]))


def true_model_of(run: Run, information: str) -> ShakeModel:
    """The hyper-parameters with which it was made."""
    return true_model(run.case.scenario, information, lateral=LATERAL, lateral_shake=LATERAL_SHAKE)
