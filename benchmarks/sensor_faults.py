"""Can a sensor mislead `telerig.smooth`? Faults of accelerometers, encoder and clocks.

Usage: python benchmarks/sensor_faults.py faults [--scenarios S1,stick-slip] [--faults clock,gap]
    [--configurations one,five,marks] [--clocks unknown,frames] [--seeds 1] [--seed 900]
    [--checks only|first] [--csv FILE.csv] [--out FILE.md] [--read FILE.csv ...]
    python benchmarks/sensor_faults.py alarms [--seeds 10] [--frames 300] ...
        false alarms of undisturbed runs
    python benchmarks/sensor_faults.py checks [--seeds 10] [--frames 120,300,600] [--around 0.05,10]
        false alarms of the checks before the solution, which are quick
    python benchmarks/sensor_faults.py offsets [--seeds 10] ... errors of recovered clock offsets
--checks only ends before the solution, which is quick: a fault is mended where the checks give the
problem of the undisturbed run, and else open; --checks first solves those that are open. --faults
takes names and groups. Loggers record 10 s before and after the frames. The classes of the outcomes
are described in `sensor_fault_judging`, the faults in `sensor_fault_kinds`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from sensor_fault_checks import checked, mended_by_checks
from sensor_fault_judging import LARGER, PASSED, Class, Score, judged, score
from sensor_fault_kinds import ARMS, CONFIGURATIONS, FAULTS, Fault, copied, inputs_of
from shake_scenarios import hash_of, posteriors
from shake_scene import Run, cases, simulate

import telerig
from telerig.errors import TelerigError
from telerig.estimator.smoothing.problem.problem import SmoothingProblem
from telerig.estimator.smoothing.smooth import problem_of, with_sensors_aligned

AROUND_S = 10.0
SCENARIOS = ("S1", "S2", "S3", "S6", "stick-slip")
MOST_MASKED = 1e-3
SHARES = {"marks": 0.9, "five": 0.75, "one": 0.5}
ALIGNED, SAMPLED = ("clock", "unit", "axes"), ("one spike", "spikes", "frozen", "gap")


@lru_cache(maxsize=2)
def run_of(scenario: str, seed: int, frames: int = 0, around_s: float = AROUND_S) -> Run:
    """The run of a seed, with loggers that record before and after it; 0 for all frames."""
    case = replace(cases()[scenario], around_s=around_s)
    if frames:
        case = replace(case, scenario=replace(case.scenario, frames=frames))
    return simulate(case, np.random.default_rng([seed, hash_of(scenario), 19]))


@lru_cache(maxsize=64)
def undisturbed(scenario: str, seed: int, configuration: str) -> Score:
    """The score without a fault; the clocks are those of the frames."""
    run = run_of(scenario, seed)
    return score(run, telerig.smooth(**inputs_of(run, configuration, "frames")).trajectories)


@lru_cache(maxsize=4)
def undisturbed_problem(
    scenario: str, seed: int, configuration: str, clock: str
) -> SmoothingProblem:
    return checked(inputs_of(run_of(scenario, seed), configuration, clock))


def cell(
    fault: Fault, scenario: str, seed: int, configuration: str, clock: str, checks: str
) -> dict[str, Any]:
    """One line of the CSV."""
    run = run_of(scenario, seed)
    inputs = copied(inputs_of(run, configuration, clock))
    fault.change(inputs, np.random.default_rng([seed, hash_of(fault.name)]))
    total_um, out = np.nan, None
    if checks:
        like = undisturbed_problem(scenario, seed, configuration, clock)
        out = mended_by_checks(copied(inputs), like)
    if out is None or (checks == "first" and out.kind == Class.OPEN):
        clean = undisturbed(scenario, seed, configuration)
        out, total_um = judged(run, inputs, fault, configuration, clean), clean.total_um
    return {
        "fault": fault.name, "group": fault.group, "scenario": scenario,
        "configuration": configuration, "clock": clock, "seed": seed, "class": str(out.kind),
        "verdict": out.verdict, "error_um": out.error_um, "undisturbed_um": total_um,
        "ratio": out.ratio, "sd_ratio": out.sd_ratio, "nees": out.nees,
        **{f"ratio_{a}": v for a, v in zip("xyz", out.axis_ratio)},
        **{f"nees_{a}": v for a, v in zip("xyz", out.axis_nees)},
        "left_out": " ".join(out.left_out), "codes": " ".join(out.codes),
        "fixes": " ".join(out.fixes), "said": out.said, "seconds": out.seconds,
        "offsets": _offsets(out.summary),
    }  # fmt: skip


def _offsets(summary: Any) -> str:
    sensors = summary.get("accelerometers", {})
    shown = ("offset_s", "offset_sd_s", "delay_s", "sdelay_s", "drift_ppm", "confirmed")
    return "; ".join(
        f"{name} " + " ".join(f"{k}={_short(e[k])}" for k in shown if k in e)
        for name, e in sensors.items()
    )


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def chosen_faults(words: str) -> list[Fault]:
    if not words:
        return list(FAULTS.values())
    wanted = words.split(",")
    unknown = set(wanted) - set(FAULTS) - {f.group for f in FAULTS.values()}
    if unknown:
        raise SystemExit(f"unknown faults {sorted(unknown)}; known are {sorted(FAULTS)}")
    return [f for f in FAULTS.values() if f.name in wanted or f.group in wanted]


def each(options: argparse.Namespace) -> Iterable[tuple[str, int, str]]:
    """Scenarios, seeds and configurations; the cache of the runs asks for this order."""
    for scenario in options.scenarios.split(","):
        for seed in range(options.seed, options.seed + options.seeds):
            for configuration in options.configurations.split(","):
                yield scenario, seed, configuration


def written(rows: list[dict[str, Any]], options: argparse.Namespace) -> pd.DataFrame:
    table = pd.DataFrame(rows)
    if options.csv:
        table.to_csv(options.csv, index=False)
    return table


def faults(options: argparse.Namespace) -> pd.DataFrame:
    """Every fault; where it is none of a clock also with clocks that are said to be the frames'."""
    rows: list[dict[str, Any]] = []
    for scenario, seed, configuration in each(options):
        for fault in chosen_faults(options.faults):
            for clock in options.clocks.split(","):
                if clock == "frames" and fault.group == "clock":
                    continue
                rows.append(cell(fault, scenario, seed, configuration, clock, options.checks))
                print(_brief(rows[-1]), flush=True)
        written(rows, options)
    return written(rows, options)


def _brief(r: dict[str, Any]) -> str:
    place = f"{r['scenario']} {r['configuration']} {r['clock']} {r['seed']}"
    numbers = (
        f"ratio {r['ratio']:.2f} (sd {r['sd_ratio']:.2f}) NEES {r['nees']:.2f} {r['seconds']:.1f} s"
    )
    text = " ".join(str(r["said"]).split())[:160]
    return f"{r['class']:<13} {r['fault']:<20} {place:<26} {r['verdict']:<40} {numbers} {text}"


def fault_report(table: pd.DataFrame) -> str:
    """Counts of classes per fault and configuration, and the shares that the issue asks for."""
    names = [c for c in CONFIGURATIONS if c in set(table["configuration"])]
    lines = [
        "| fault | | " + " | ".join(names) + " | worst ratio | worst NEES |",
        "|" + "---|" * (len(names) + 4),
    ]
    for name, rows in table.groupby("fault", sort=False):
        cells = []
        for configuration in names:
            counts = rows[rows["configuration"] == configuration]["class"].value_counts()
            order = [str(k) for k in Class if str(k) in counts]
            cells.append(", ".join(f"{counts[k]} {k}" for k in order))
        fault = FAULTS[str(name)]
        worst = [f"{rows[k].max():.3g}" if rows[k].notna().any() else "" for k in ("ratio", "nees")]
        lines.append("| " + " | ".join([str(name), fault.words, *cells, *worst]) + " |")
    passed = table["class"].isin([str(k) for k in PASSED])
    bad = table["class"].isin([str(Class.WRONG), str(Class.BARE)])
    shares = [f"{len(table)} cells, {int(passed.sum())} passed, {int(bad.sum())} wrong or bare."]
    for configuration in names:
        mine = table[table["configuration"] == configuration]
        for label, some, needed in (
            ("clock, unit and axes", mine["group"].isin(ALIGNED), SHARES[configuration]),
            ("spikes, gap and frozen", mine["fault"].isin(SAMPLED), 0.95),
        ):
            if some.any():
                mended = mine[some]["class"] == str(Class.MENDED)
                allowed = mended | (mine[some]["ratio"] <= LARGER * mine[some].get("sd_ratio", 1.0))
                shares.append(
                    f"{configuration}, {label}: {mended.mean():.0%} mended ({needed:.0%} asked); "
                    f"{allowed.mean():.0%} with those as good as what is left allows."
                )
    scenarios = ", ".join(table["scenario"].unique())
    seeds = f"{table['seed'].min()}-{table['seed'].max()}"
    return f"""# Faults of sensors and clocks

Scenarios {scenarios}; seeds {seeds}; clocks {", ".join(table["clock"].unique())}; both arms have
accelerometers that record {AROUND_S:g} s before and after the frames. Made with
`python benchmarks/sensor_faults.py faults`. The error is the RMS distance of the smoothed path from
the truth over the middle 80 %, all axes; the ratio is to the same run without the fault.

- mended: the error is at most 1.2 times the undisturbed, if need be after the corrections that
  refusals propose;
- owned up: refused, a sensor left out, or not RESOLVED; the cause is named, NEES at most 2;
- hidden: the data cannot show the fault, and `usable_for` says so;
- wider: RESOLVED, with a larger error inside honest standard deviations; as good as what is left
  allows is an error at most 1.2 times the undisturbed, times the ratio of the standard deviations;
- unnamed, overconfident: as "owned up", but without the cause, or with NEES above 2;
- wrong: RESOLVED, as a whole or on an axis, with a larger error and NEES above 2;
- bare: an exception that is no `TelerigError`.

{chr(10).join(shares)}

{chr(10).join(lines)}
"""


def alarms(options: argparse.Namespace) -> pd.DataFrame:
    """Undisturbed runs: what was refused, left out, masked or contradicted."""
    rows: list[dict[str, Any]] = []
    lengths = [int(n) for n in (options.frames or "0").split(",")]
    for scenario, seed, configuration in each(options):
        for frames, clock in product(lengths, options.clocks.split(",")):
            run = run_of(scenario, seed, frames)
            row: dict[str, Any] = {
                "scenario": scenario, "configuration": configuration, "clock": clock, "seed": seed,
                "frames": frames,
            }  # fmt: skip
            begin = time.perf_counter()
            inputs = inputs_of(run, configuration, clock)
            try:
                result = telerig.smooth(**inputs)
            except TelerigError as error:
                row |= {"alarm": f"refused {error.code}", "said": str(error)}
            else:
                found, sensors = score(run, result.trajectories), result.summary["accelerometers"]
                kinds = [
                    f"left out {name}"
                    for name in ARMS
                    if "delay_s" not in sensors.get(name, {}) or not sensors[name].get("used", True)
                ]
                masked = sum(e.get("masked_samples") or 0 for e in sensors.values())
                inside = len(ARMS) * (run.t_s[-1] - run.t_s[0]) * 2000
                kinds += ["masked"] * int(masked > MOST_MASKED * inside)
                verdict = str(result.verdict["verdict"])
                kinds += ["contradicted"] * (verdict == "CONTRADICTED")
                row |= {
                    "alarm": "; ".join(kinds), "verdict": verdict, "masked": masked,
                    "vertical_um": found.error_um[1], "error_um": found.total_um,
                    "nees": found.total_nees,
                    "said": " | ".join(map(str, result.summary.get("warnings", ()))),
                    "offsets": _offsets(result.summary),
                }  # fmt: skip
            rows.append(row | {"seconds": time.perf_counter() - begin})
            print({k: v for k, v in rows[-1].items() if k != "said"}, flush=True)
        written(rows, options)
    return written(rows, options)


def alarm_report(table: pd.DataFrame) -> str:
    lines = [
        "| scenario | configuration | clock | frames | runs | alarms | vertical µm | possible "
        "| ratio | NEES |",
        "|" + "---|" * 10,
    ]
    possible = {
        name: posteriors(cases()[name], np.random.default_rng(0))["arms"][0]
        for name in table["scenario"].unique()
        if not cases()[name].nonlinear
    }
    columns = ["scenario", "configuration", "clock", "frames"]
    for keys, rows in table.groupby(columns, sort=False):
        scenario, configuration, _, frames = keys
        found = float(np.sqrt(np.nanmean(rows["vertical_um"] ** 2)))
        whole = configuration == "one" and not frames
        best = possible.get(str(scenario)) if whole else None
        beside = ["", ""] if best is None else [f"{best:.1f}", f"{found / best:.2f}"]
        said = rows["alarm"].fillna("")
        cells = [*map(str, keys), f"{len(rows)}", f"{int((said != '').sum())}", f"{found:.1f}"]
        lines.append("| " + " | ".join([*cells, *beside, f"{rows['nees'].mean():.2f}"]) + " |")
    said = table["alarm"].fillna("")
    kinds = said[said != ""].value_counts()
    return f"""# False alarms of undisturbed runs

{len(table)} runs, {(said != "").mean():.1%} with an alarm: a refusal, a sensor left out, more than
0.1 % of the samples masked, or CONTRADICTED. possible: the posterior of an independent reference
with arm accelerometers and one bubble, which knows the hyper-parameters.

{chr(10).join(lines)}

{chr(10).join(f"- {count} x {kind}" for kind, count in kinds.items())}
"""


def checks(options: argparse.Namespace) -> pd.DataFrame:
    """Undisturbed runs, also short ones: what is refused or left out before the solution."""
    rows: list[dict[str, Any]] = []
    lengths = [int(n) for n in (options.frames or "120,300,0").split(",")]
    margins = [float(s) for s in options.around.split(",")]
    for scenario, seed, configuration in each(options):
        for frames, around_s in product(lengths, margins):
            run = run_of(scenario, seed, frames, around_s)
            for clock in options.clocks.split(","):
                begin = time.perf_counter()
                rows.append(
                    {"scenario": scenario, "configuration": configuration, "clock": clock,
                     "seed": seed, "frames": frames, "around_s": around_s}
                    | _checked(inputs_of(run, configuration, clock))
                    | {"seconds": time.perf_counter() - begin}
                )  # fmt: skip
                print(rows[-1], flush=True)
        written(rows, options)
    return written(rows, options)


def _checked(inputs: dict[str, Any]) -> dict[str, Any]:
    given = {k: v for k, v in inputs.items() if k not in ("tracks", "calibration")}
    try:
        problem, _, _, known = problem_of(inputs["tracks"], inputs["calibration"], **given)
        placed, found = with_sensors_aligned(problem, known)
    except TelerigError as error:
        return {"alarm": f"refused {error.code}", "said": str(error)}
    codes = sorted({str(f.code) for f in found if f.code is not None})
    sensors = {s.name: s for s in placed.accelerometers}
    out = [f"left out {name}" for name in ARMS if name not in sensors]
    masked = sum(int((~s.kept).sum()) for s in sensors.values() if s.kept is not None)
    given_samples = sum(len(s.t_s) for s in sensors.values())
    kinds = [*codes, *["masked"] * int(masked > MOST_MASKED * given_samples)]
    return {
        "alarm": "; ".join(kinds), "left_out": "; ".join(out),
        "confirmed": sum(s.confirmed for s in sensors.values()),
        "said": " | ".join(f.warning for f in found),
    }  # fmt: skip


def check_report(table: pd.DataFrame) -> str:
    table = table.fillna("")
    lines = ["| scenario | configuration | clock | frames | runs | alarms | a sensor left out |",
             "|" + "---|" * 7]  # fmt: skip
    columns = ["scenario", "configuration", "clock", "frames"]
    for keys, rows in table.groupby(columns, sort=False):
        counts = [len(rows), (rows["alarm"] != "").sum(), (rows["left_out"] != "").sum()]
        lines.append("| " + " | ".join([*map(str, keys), *map(str, counts)]) + " |")
    kinds = table["alarm"][table["alarm"] != ""].value_counts()
    share = (table["alarm"] != "").mean()
    return f"""# False alarms of the checks before the solution

{len(table)} undisturbed runs, {share:.2%} with an alarm: a refusal, or more than 0.1 % of the
samples masked. Sensors whose clock is unknown and not confirmed are left out; that is no alarm.

{chr(10).join(lines)}

{chr(10).join(f"- {count} x {kind}" for kind, count in kinds.items())}
"""


def offsets(options: argparse.Namespace) -> pd.DataFrame:
    """Clocks that are off by up to the length of the record, the same for both arms, as they are
    found before the solution."""
    rows: list[dict[str, Any]] = []
    for scenario, seed, configuration in each(options):
        run = run_of(scenario, seed)
        rng = np.random.default_rng([seed, hash_of(configuration), 5])
        span = 2 * AROUND_S + run.t_s[-1]
        true = float(rng.choice([-1, 1]) * span * 10 ** rng.uniform(-3, 0))
        inputs = copied(inputs_of(run, configuration, "unknown"))
        for sensor in inputs["accelerometers"].values():
            sensor["t_s"] = sensor["t_s"] + true
        row = {"scenario": scenario, "configuration": configuration, "seed": seed, "true_s": true}
        try:
            sensors = {s.name: s for s in checked(inputs).accelerometers}
        except TelerigError as error:
            rows.append(row | {"sensor": "", "said": str(error)})
        else:
            for name in ARMS:
                found = sensors.get(name)
                sure = found is not None and bool(found.confirmed)
                off = np.nan if found is None else found.offset_s - true
                sd = np.nan if found is None else found.offset_sd_s or np.nan
                rows.append(
                    row
                    | {"sensor": name, "confirmed": sure, "off_ms": 1e3 * off, "sd_ms": 1e3 * sd}
                )
        print(rows[-1], flush=True)
        written(rows, options)
    return written(rows, options)


def offset_report(table: pd.DataFrame) -> str:
    lines = [
        "| scenario | configuration | sensors | confirmed | RMS ms | worst ms | mean (off / sd)^2 "
        "| within 0.2 ms | 1 ms |",
        "|" + "---|" * 9,
    ]
    for keys, rows in table.groupby(["scenario", "configuration"], sort=False):
        sure = rows[rows["confirmed"].fillna(False).astype(bool)]
        off = sure["off_ms"].abs()
        cells = [*map(str, keys), f"{len(rows)}", f"{len(sure)}"]
        if len(sure):
            cells += [f"{np.sqrt((off**2).mean()):.3f}", f"{off.max():.3f}"]
            cells += [f"{((off / sure['sd_ms']) ** 2).mean():.2f}"]
            cells += [f"{(off <= limit).mean():.0%}" for limit in (0.2, 1.0)]
        lines.append("| " + " | ".join([*cells, *[""] * (9 - len(cells))]) + " |")
    return "# Recovered clock offsets\n\n" + "\n".join(lines) + "\n"


MODES = {
    "faults": (faults, fault_report),
    "alarms": (alarms, alarm_report),
    "checks": (checks, check_report),
    "offsets": (offsets, offset_report),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mode", choices=list(MODES))
    parser.add_argument("--scenarios", default=",".join(SCENARIOS))
    parser.add_argument("--faults", default="", help="names or groups; all by default")
    parser.add_argument("--configurations", default=",".join(CONFIGURATIONS))
    parser.add_argument("--clocks", default="unknown,frames")
    parser.add_argument(
        "--checks",
        choices=("", "only", "first"),
        default="",
        help="end before the solution, or solve what the checks leave open",
    )
    parser.add_argument("--frames", default="", help="numbers of frames; 0: all of them")
    parser.add_argument("--around", default="0.05,10", help="seconds of record around the frames")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--seed", type=int, default=900, help="the first")
    parser.add_argument("--csv", type=Path, help="one line a run")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--read", type=Path, nargs="+", help="tables of --csv instead of runs")
    options = parser.parse_args()
    make, report = MODES[options.mode]
    if options.read:
        parts = [pd.read_csv(path, keep_default_na=False, na_values=["", "nan"])
                 for path in options.read]  # fmt: skip
        table = pd.concat(parts, ignore_index=True)
    else:
        table = make(options)
    text = report(table)
    print(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
