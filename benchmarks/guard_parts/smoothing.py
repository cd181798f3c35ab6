"""S1 to S6, shortened, with nothing told of rig and bubbles: with marks, with arms, with neither.

The error of the vertical position is over the posterior standard deviation of an independent
reference that knows all hyper-parameters (`shake_reference`); NEES and standard deviations are of
all three axes. All of the middle 80 % of the frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shake_cases import generate, middle, reference
from shake_scenarios import hash_of
from shake_scene import Case, Run, cases, simulate

import telerig
from guard_parts.inputs import digest
from guard_parts.metrics import Metric, error, nees, stated_sd, word

Array = NDArray[np.float64]

FRAMES = {"S1": 300, "S2": 300, "S3": 300, "S4": 400, "S5": 150, "S6": 300}
INFORMATION = {"marks": "references", "arms": "arms", "none": "one"}


def case_of(scenario: str) -> Case:
    case = cases()[scenario]
    return replace(case, scenario=replace(case.scenario, frames=FRAMES[scenario]))


@cache
def run_of(scenario: str, seed: int = 0) -> Run:
    return simulate(case_of(scenario), np.random.default_rng([seed, hash_of(scenario)]))


def smoothed(inputs: dict[str, Any]) -> Any:
    given = dict(inputs)
    return telerig.smooth(given.pop("tracks"), given.pop("calibration"), **given)


def errors(run: Run, table: Any) -> tuple[Array, Array]:
    """Errors and standard deviations (N, 3) in mm of the frames in the middle."""
    inner = middle(len(run.t_s))
    frame, bubble = table["frame"].to_numpy(), table["particle"].to_numpy().astype(int)
    keep = (frame >= inner.start) & (frame < inner.stop)
    off = table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)[keep]
    sd = table[["sx_mm", "sy_mm", "sz_mm"]].to_numpy(float)[keep]
    return off - run.position_mm[bubble[keep], frame[keep]], sd


def verdict_words(verdict: Any) -> str:
    """The verdict with those of x, y, z."""
    axes = " ".join(str(verdict.get("axes", {}).get(a, {}).get("verdict", "")) for a in "xyz")
    return f"{verdict['verdict']!s} ({axes})"


def metrics_of(run: Run, result: Any) -> list[Metric]:
    off, sd = errors(run, result.trajectories)
    return [
        error("3-D error", 1e3 * float(np.sqrt((off**2).sum(1).mean())), "µm"),
        stated_sd(sd, "µm", scale=1e3),
        nees((off / sd) ** 2),
        word("verdict", verdict_words(result.verdict)),
    ]


@cache
def possible_um(scenario: str, information: str) -> float:
    """The reference's posterior standard deviation of the height."""
    scene = case_of(scenario).scenario
    fit = reference(scene, information, generate(scene, 1, np.random.default_rng(0)))
    _, sd = fit.posterior.of(fit.row("position"))
    return 1e3 * float(np.sqrt((sd[middle(scene.frames)] ** 2).mean()))


def task(scenario: str, kind: str) -> list[Metric]:
    information = INFORMATION[kind]
    run = run_of(scenario)
    inputs = run.inputs(information)
    result = smoothed(inputs)
    off, _ = errors(run, result.trajectories)
    vertical = 1e3 * float(np.sqrt((off[:, 1] ** 2).mean()))
    return [
        error("vertical error over possible", vertical / possible_um(scenario, information), "1"),
        *metrics_of(run, result),
        word("inputs", digest(inputs["tracks"], inputs["stage"], run.position_mm)),
    ]


TASKS: dict[str, Callable[[], list[Metric]]] = {
    f"{scenario} {kind}": partial(task, scenario, kind)
    for scenario in FRAMES
    for kind in INFORMATION
}
