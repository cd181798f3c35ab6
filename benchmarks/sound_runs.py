"""False alarms: sound short runs of six kinds of rig, none of which may be refused or contradicted.

Usage: python benchmarks/sound_runs.py [--runs 60] [--seed 0] [--only hunting,...]
    [--out sound_runs.jsonl] [--again] [--checks]
Every run is drawn from its number: the kind of rig in turn, frames, bubbles, sensors and what their
clocks are stated to be. A run adds a line to --out; those that are there are not run again, so that
an interrupted study goes on. --again runs those that were alarms, and writes no line. --checks ends
before the solution, which finds what is refused but no contradiction, in some 2 s a run; whole runs
take some 5 s. The end lists every alarm with its code and numbers.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from sensor_fault_judging import score
from sensor_fault_kinds import inputs_of
from shake_cases import RISE_MM_S, SAMPLE_HZ, Scenario
from shake_forces import hunting_stage
from shake_scene import Case, Motions, Run, random_shake, simulate, started_and_stopped

import telerig
from telerig.errors import TelerigError
from telerig.estimator.sensors.findings import settled
from telerig.estimator.smoothing.smooth import problem_of, with_sensors_aligned
from telerig.io.simulation.run.motion import Shake

Array = NDArray[np.float64]

KINDS = ("hunting", "still", "pump", "slow", "fast", "ordinary")
BUBBLES, OF_BUBBLES = (1, 5, 40), (0.55, 0.4, 0.05)
SENSORS, OF_SENSORS = ("arms", "arms and marks", "carriage", "marks"), (0.5, 0.2, 0.15, 0.15)
ARMS_HZ = ((9.0, 27.0), (9.0, 33.0))
"""Resonances of both arms of the rig whose servo hunts."""


@dataclass(frozen=True)
class Drawn:
    """A run of a number: its kind, its tables, and what is given of them."""

    number: int
    kind: str
    sensors: str
    clock: str
    run: Run

    @property
    def inputs(self) -> dict[str, Any]:
        """Arguments of `telerig.smooth`."""
        inputs = inputs_of(self.run, "marks" if "marks" in self.sensors else "five", self.clock)
        inputs["tracks"] = self.run.tracks
        if self.sensors == "marks":
            inputs["accelerometers"] = None
        if self.sensors == "carriage":
            inputs["accelerometers"] = self.run.inputs("carriage")["accelerometers"]
        return inputs


def drawn(number: int, kinds: tuple[str, ...] = KINDS) -> Drawn:
    """The run of a number; the same on every machine."""
    rng = np.random.default_rng([number, 16])
    kind = kinds[number % len(kinds)]
    rate = {"slow": 20.0, "fast": 2000.0}.get(kind, float(rng.choice([200.0, 500.0, 1000.0])))
    frames = int(rng.integers(200, 501)) if kind != "slow" else int(rng.integers(100, 301))
    hz = float(np.exp(rng.uniform(*np.log((2.0, 8.0) if kind == "slow" else (6.0, 40.0)))))
    reach = 0.002 if kind == "still" else float(np.exp(rng.uniform(*np.log((0.05, 0.5)))))
    noise = float(rng.choice([0.1, 0.5, 1.0]))
    bubbles = int(rng.choice(BUBBLES, p=OF_BUBBLES))
    around_s = float(rng.choice([0.0, 2.0]))
    sensors, clock = str(rng.choice(SENSORS, p=OF_SENSORS)), str(rng.choice(["frames", "unknown"]))
    case = Case(Scenario(kind, rate, hz, reach, noise, frames), around_s=around_s, bubbles=bubbles)
    motions: dict[str, Callable[[Array, Generator], Motions]] = {
        "hunting": partial(hunting, case), "still": partial(still, case),
        "pump": partial(pumped, case),
    }  # fmt: skip
    run = simulate(case, rng, motion=motions.get(kind))
    return Drawn(number, kind, sensors, clock, run)


def _travel(case: Case, t: Array) -> tuple[Array, Array]:
    if case.around_s > 0:
        return started_and_stopped(t, case.around_s)
    return RISE_MM_S * t, np.zeros_like(t)


def hunting(case: Case, t: Array, rng: Generator) -> Motions:
    """A stage that hunts at 14 Hz and sticks and slips, and arms that answer to it alone."""
    place, push = _travel(case, t)
    own, push_own = hunting_stage(t, case.scenario.amplitude_mm, rng)
    push = push + push_own
    arms = np.stack([[answering(t, push, hz, rng) for hz in each] for each in ARMS_HZ]).sum(1)
    lean = np.array([[0.3, -1.0, 0.2], [-0.2, -1.0, 0.3]])  # up is -y
    moved = arms[..., None, :] * lean[:, None, :, None]
    arm = Shake(*moved.transpose(3, 0, 1, 2))
    return place + own, push, Shake(*np.zeros((3, *arm.offset_mm.shape))), arm


def answering(t: Array, push: Array, hz: float, rng: Generator) -> Array:
    """(N, 3) displacement, velocity, acceleration of a mode relative to a base that is pushed.

    push : (N,) acceleration of the base, mm/s^2. The mode takes a share of it.
    """
    from scipy.signal import cont2discrete, dlsim

    w, damping = 2 * np.pi * hz, rng.uniform(0.02, 0.05)
    share = rng.uniform(0.4, 0.7)
    drift = np.array([[0.0, 1.0], [-(w**2), -2 * damping * w]])
    force = np.array([[0.0], [-share]])
    system = cont2discrete((drift, force, np.eye(2), np.zeros((2, 1))), 1 / SAMPLE_HZ, "foh")
    lead = push[: round(2 * SAMPLE_HZ)][::-1]  # the mode has been shaken before
    _, states, _ = dlsim(system, np.concatenate([lead, push]))
    states = states[len(lead) :]
    return np.column_stack([states, states @ drift[1] - share * push])


def still(case: Case, t: Array, rng: Generator) -> Motions:
    """A stage without an error, and a shake of 2 µm."""
    common, own = random_shake(case, t - t[0], rng)
    return *_travel(case, t), common, own


def pumped(case: Case, t: Array, rng: Generator) -> Motions:
    """A pump at a fixed frequency with a harmonic, which both cameras and the stage follow."""
    hz, reach = float(rng.uniform(11, 49)), case.scenario.amplitude_mm / np.sqrt(2)
    place, push = _travel(case, t)
    parts = np.zeros((3, 3, len(t), 3))  # stage, both arms
    for k, size in ((1, 1.0), (2, 0.3)):
        w = 2 * np.pi * hz * k
        angle = w * t[:, None] + rng.uniform(0, 2 * np.pi, (3, 1, 3))
        share = size * reach * rng.uniform(0.2, 1.0, (3, 1, 3))
        parts += np.stack([share * np.sin(angle), share * w * np.cos(angle),
                           -share * w**2 * np.sin(angle)])  # fmt: skip
    stage = 0.2 * parts[:, 0, :, 1]
    arm = Shake(*parts[:, 1:])
    return place + stage[0], push + stage[2], Shake(*np.zeros((3, *arm.offset_mm.shape))), arm


def judged(one: Drawn, checks: bool = False) -> dict[str, Any]:
    """What was said of a run, and how far its paths are off. checks : not solved."""
    scenario = one.run.case.scenario
    record: dict[str, Any] = {
        "number": one.number, "kind": one.kind, "sensors": one.sensors, "clock": one.clock,
        "frames": scenario.frames, "rate_hz": scenario.rate_hz, "hz": round(scenario.hz, 2),
        "amplitude_mm": round(scenario.amplitude_mm, 4), "noise_px": scenario.noise_px,
        "bubbles": one.run.case.bubbles, "around_s": one.run.case.around_s,
    }  # fmt: skip
    begun = time.process_time()
    try:
        if checks:
            problem, _, _, findings = problem_of(**one.inputs)
            settled(with_sensors_aligned(problem, findings)[1], frozenset())
            return record | {"alarms": [], "cpu_s": round(time.process_time() - begun, 2)}
        result = telerig.smooth(**one.inputs)
    except TelerigError as error:
        found = getattr(error, "findings", ())
        record["alarms"] = [f"{f.code}: {f.where}: {f.words}" for f in found] or [str(error)]
    except Exception as error:  # noqa: BLE001 - a bare exception is what is looked for
        record["alarms"] = [f"bare {type(error).__name__}: {error}"]
    else:
        found = result.verdict.get("contradictions", ())
        record["alarms"] = [
            f"CONTRADICTED: {c['source']} {c.get('axis') or ''} {c['test']} {c['statistic']:.2f} "
            f"against {', '.join(c.get('against') or ())}"
            for c in found
        ]
        of = score(one.run, result.trajectories)
        record |= {
            "verdict": result.verdict["verdict"], "error_um": of.error_um.round(1).tolist(),
            "nees": of.nees.round(2).tolist(), "warnings": result.summary["warnings"],
        }  # fmt: skip
    record["cpu_s"] = round(time.process_time() - begun, 2)
    return record


def records(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The records of all runs; those that are not in the file are run."""
    wanted = options.only.split(",")
    done = {}
    if options.out.exists():
        lines = options.out.read_text(encoding="utf-8").splitlines()
        done = {record["number"]: record for record in map(json.loads, lines)}
    for number in range(options.seed, options.seed + options.runs):
        if KINDS[number % len(KINDS)] not in wanted:
            continue
        old = done.get(number)
        if old is not None and not (options.again and old["alarms"]):
            yield old
            continue
        if old is None and options.again:
            continue
        record = judged(drawn(number), options.checks)
        if not options.again:
            with options.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record) + "\n")
        yield record


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(KINDS))
    parser.add_argument("--out", type=Path, default=Path("sound_runs.jsonl"))
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--checks", action="store_true")
    options = parser.parse_args()
    count, alarms, seconds = dict.fromkeys(KINDS, 0), [], 0.0
    for record in records(options):
        count[record["kind"]] += 1
        seconds += record["cpu_s"]
        if record["alarms"]:
            alarms.append(record)
            what = {k: v for k, v in record.items() if k not in ("alarms", "warnings")}
            print(f"{what}\n    " + "\n    ".join(record["alarms"]), flush=True)
    total = sum(count.values())
    rates = {k: f"{sum(r['kind'] == k for r in alarms)} of {n}" for k, n in count.items()}
    print(
        f"alarms in {len(alarms)} of {total} runs, {seconds / max(total, 1):.1f} s a run: {rates}"
    )


if __name__ == "__main__":
    main()
