"""How many nonlinear problems a calibration solves: everything else is a step from a solution."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import telerig
from telerig.estimator.calibration.solver import robust_least_squares
from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.solver.system import System

MOST = 6
"""Two rough fits for two rotations between the cameras, the fit of the rich model and, without its
outliers, that of the chosen one with the discs' eccentricity; one more for outliers. The mirror
image, the halves, the lens models and the next view are solved by none."""


@pytest.mark.parametrize("name", ["paper", "unbounded"])
def test_a_calibration_solves_few_problems(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    solved: list[Problem] = []

    def counted(problem: Problem) -> System:
        solved.append(problem)
        return System(problem)

    monkeypatch.setattr(robust_least_squares, "System", counted)
    data = telerig.simulate(name, rng=np.random.default_rng(1), out=tmp_path / "data", images=False)
    telerig.calibrate(telerig.load_dataset(data.path))
    assert 4 <= len(solved) <= MOST
