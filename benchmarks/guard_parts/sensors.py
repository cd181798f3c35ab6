"""Faults of sensors, encoder and clock, and sound rigs: what is said, and what becomes of the path.

A fault is one of `sensor_fault_kinds`. Corrections that an error of `telerig.smooth` proposes are
applied, as a user would; the error is over that of the same run without the fault.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from sensor_fault_judging import Score, judged, score
from sensor_fault_kinds import ARMS, FAULTS, copied, inputs_of
from shake_scenarios import hash_of
from shake_scene import Run, cases, simulate
from sound_runs import drawn

import telerig
from guard_parts.inputs import digest
from guard_parts.metrics import Metric, error, nees, word
from guard_parts.smoothing import verdict_words
from telerig.errors import TelerigError

FRAMES, AROUND_S = 300, 10.0
PLANTED = {
    "in g": "S1",
    "sign turned": "S2",
    "x and y swapped": "S1",
    "arms swapped": "S3",
    "clock 60 ms": "S6",
    "gap": "S2",
    "frozen": "S3",
    "encoder scale": "S1",
}
SOUND = (("S1", "frames"), ("S2", "unknown"), ("S3", "frames"), ("S6", "unknown"),
         ("stick-slip", "frames"), ("ring-down", "unknown"))  # fmt: skip
CARRIAGE = (("servo hunts", 5250), ("pump", 5048))
"""Numbers of `sound_runs` whose only accelerometer is on the carriage."""


@cache
def run_of(scenario: str, seed: int) -> Run:
    """With loggers that record before and after the frames."""
    case = replace(cases()[scenario], around_s=AROUND_S)
    case = replace(case, scenario=replace(case.scenario, frames=FRAMES))
    return simulate(case, np.random.default_rng([seed, hash_of(scenario), 35]))


@cache
def undisturbed(scenario: str) -> tuple[Any, Score]:
    run = run_of(scenario, 0)
    result = telerig.smooth(**inputs_of(run, "one", "frames"))
    return result, score(run, result.trajectories)


def planted(name: str, scenario: str) -> list[Metric]:
    fault, run = FAULTS[name], run_of(scenario, 0)
    inputs = copied(inputs_of(run, "one", "unknown" if fault.group == "clock" else "frames"))
    fault.change(inputs, np.random.default_rng(hash_of(name)))
    found = judged(run, inputs, fault, "one", undisturbed(scenario)[1])
    out = [
        word("outcome", str(found.kind)),
        word("verdict", found.verdict),
        word("codes", " ".join(found.codes)),
        word("inputs", digest(inputs["tracks"], inputs["stage"])),
    ]
    if np.isfinite(found.ratio):
        out += [error("error over the sound run's", found.ratio, "1"), nees([found.nees])]
    return out


def sound(scenario: str, clock: str) -> list[Metric]:
    """No alarm: nothing refused, no sensor left out, no contradiction."""
    run = run_of(scenario, 1)
    inputs = inputs_of(run, "one", clock)
    result = telerig.smooth(**inputs)
    found, sensors = score(run, result.trajectories), result.summary["accelerometers"]
    used = {n for n, entry in sensors.items() if "delay_s" in entry and entry.get("used", True)}
    left_out = [f"left out {name}" for name in ARMS if name not in used]
    said = [*left_out, *(str(c["source"]) for c in result.verdict.get("contradictions", ()))]
    return [
        word("alarms", ", ".join(said) or "none"),
        word("verdict", verdict_words(result.verdict)),
        error("3-D error", found.total_um, "µm"),
        nees([found.total_nees]),
        word("inputs", digest(inputs["tracks"], inputs["stage"])),
    ]


def carriage_alone(number: int) -> list[Metric]:
    """No alarm either where the arms have no sensor, and standard deviations that hold."""
    one = drawn(number)
    try:
        result = telerig.smooth(**one.inputs)
    except TelerigError as refusal:
        return [word("alarms", f"refused: {refusal}")]
    found = score(one.run, result.trajectories)
    said = [str(c["source"]) for c in result.verdict.get("contradictions", ())]
    return [
        word("alarms", ", ".join(said) or "none"),
        word("verdict", verdict_words(result.verdict)),
        error("3-D error", found.total_um, "µm"),
        nees([found.total_nees]),
        nees([found.nees[1]], "NEES along the travel"),
        word("inputs", digest(one.run.tracks, one.run.stage)),
    ]


TASKS: dict[str, Callable[[], list[Metric]]] = {
    **{f"fault: {name}": partial(planted, name, where) for name, where in PLANTED.items()},
    **{f"sound: {where}, clock {clock}": partial(sound, where, clock) for where, clock in SOUND},
    **{f"sensor on the carriage, {name}": partial(carriage_alone, n) for name, n in CARRIAGE},
}
