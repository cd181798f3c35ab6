"""How near is `telerig.smooth` to what is possible, is it honest, and what does it say?

Usage: python benchmarks/shake_scenarios.py [--seeds 4] [--only S2,S3,zigzag] [--information
    one,five,carriage,arms,references,oracle] [--models true,default] [--oblique] [--calibrated]
    [--seed 0] [--out FILE.md] [--csv FILE.csv] [--read FILE.csv ...]
Every seed counts. Runs come from `shake_scene`; posteriors to compare with from the independent
reference in tests/support/shake_reference.py.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from shake_calibration import calibrated
from shake_cases import generate, middle, reference
from shake_problem import true_model
from shake_scene import LATERAL, LATERAL_SHAKE, NONLINEAR, UP, Case, Run, cases, oblique, simulate

from telerig.errors import TelerigError
from telerig.estimator.smoothing.result import Smoothing
from telerig.estimator.smoothing.smooth import smooth

Array = NDArray[np.float64]

INFORMATION = ("one", "five", "carriage", "arms", "references", "oracle")


@dataclass(frozen=True)
class Record:
    """One smoothed run, all its bubbles, middle 80 %; vertical, µm and mm/s unless named otherwise.

    square, velocity_square : mean of (error / sd)^2.  nees : of the 3-D position, per dimension.
    position_3d, naive_3d : RMS of the vector.
    """

    case: str
    information: str
    model: str
    seed: int
    position: float
    velocity: float
    sigma: float
    velocity_sigma: float
    square: float
    velocity_square: float
    nees: float
    naive: float
    naive_velocity: float
    position_3d: float
    naive_3d: float
    verdict: str
    flags: str
    seconds: float
    fault: str = ""


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def measured(run: Run, result: Smoothing, what: tuple[str, str, int], seconds: float) -> Record:
    inner = middle(len(run.t_s))
    table = result.trajectories
    frame, bubble = table["frame"].to_numpy(), table["particle"].to_numpy()
    keep = (frame >= inner.start) & (frame < inner.stop)
    there = bubble[keep], frame[keep]

    def columns(pattern: str) -> Array:
        return table[[pattern.format(a) for a in "xyz"]].to_numpy(float)[keep]

    off = columns("{}_mm") - run.position_mm[there]
    fast = columns("v{}_mm_s") - run.velocity_mm_s[there]
    naive = columns("naive_{}_mm") - run.position_mm[there]
    naive_fast = columns("naive_v{}_mm_s") - run.velocity_mm_s[there]
    sigma, fast_sigma = columns("s{}_mm")[:, 1], columns("sv{}_mm_s")[:, 1]
    verdict = result.verdict
    return Record(
        run.case.name, *what,
        1e3 * rms(off @ UP), rms(fast @ UP), 1e3 * rms(sigma), rms(fast_sigma),
        float(np.mean((off @ UP / sigma) ** 2)), float(np.mean((fast @ UP / fast_sigma) ** 2)),
        nees(result, off, keep),
        1e3 * rms((naive @ UP)[np.isfinite(naive[:, 1])]),
        rms((naive_fast @ UP)[np.isfinite(naive_fast[:, 1])]),
        1e3 * rms(off) * np.sqrt(3), 1e3 * float(np.sqrt(np.nanmean(naive**2))) * np.sqrt(3),
        str(verdict.get("verdict", "")), " ".join(verdict.get("flags", ())), seconds,
    )  # fmt: skip


def nees(result: Smoothing, off: Array, keep: NDArray[np.bool_]) -> float:
    """Mean of e' C^-1 e / 3 over all bubbles and frames."""
    frame, found = result.solution.graph, result.solution.covariances
    assert found is not None
    row = frame.bubble.position
    covariance = row @ found.bubbles[keep] @ row.T
    return float(np.mean(np.einsum("fi,fij,fj->f", off, np.linalg.inv(covariance), off)) / 3)


def smoothed(run: Run, information: str, model: str, seed: int) -> Record:
    """One run; an error of the product is a record too."""
    inputs = run.inputs(information)
    tracks, calibration = inputs.pop("tracks"), inputs.pop("calibration")
    chosen: Any = model
    if model == "true":
        chosen = true_model(
            run.case.scenario, information, lateral=LATERAL, lateral_shake=LATERAL_SHAKE
        )
    begin = time.perf_counter()
    try:
        result = smooth(tracks, calibration, model=chosen, **inputs)
    except (TelerigError, np.linalg.LinAlgError) as error:
        spent = time.perf_counter() - begin
        none = [np.nan] * 11
        text = str(error).splitlines()[0]
        return Record(run.case.name, information, model, seed, *none, "", "", spent, text)
    spent = time.perf_counter() - begin
    return measured(run, result, (information, model, seed), spent)


def posteriors(case: Case, rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """The reference's sd (µm, mm/s) of each set of information."""
    inner = middle(case.scenario.frames)
    runs = generate(case.scenario, 1, rng)
    out = {}
    for information in INFORMATION:
        fit = reference(case.scenario, information, runs)
        (_, sz), (_, sv) = (fit.posterior.of(fit.row(w)) for w in ("position", "velocity"))
        out[information] = 1e3 * rms(sz[inner]), rms(sv[inner])
    return out


COLUMNS = (
    "case", "information", "model", "runs", "possible", "sd", "RMS", "RMS / possible",
    "(e/sd)^2", "NEES 3-D", "naive / RMS", "worst", "s", "verdicts",
)  # fmt: skip


def line(rows: pd.DataFrame, possible: tuple[float, float] | None) -> str:
    """One line of the table: position/velocity pairs."""
    first = rows.iloc[0]
    faults = rows["fault"].ne("").sum()
    good = rows[rows["fault"] == ""]
    cells = [first["case"], first["information"], first["model"], f"{len(rows)}"]
    if not len(good):
        return "| " + " | ".join([*cells, f"{faults} failed: {first['fault']}"]) + " |"
    position, velocity = rms(good["position"]), rms(good["velocity"])
    cells.append("" if possible is None else "{:.1f}/{:.2f}".format(*possible))
    cells.append(f"{rms(good['sigma']):.1f}/{rms(good['velocity_sigma']):.2f}")
    cells.append(f"{position:.1f}/{velocity:.2f}")
    ratio = "" if possible is None else f"{position / possible[0]:.2f}/{velocity / possible[1]:.2f}"
    cells.append(ratio)
    cells.append(f"{_uncertain(good['square'])}/{_uncertain(good['velocity_square'])}")
    cells.append(f"{good['nees'].mean():.2f}")
    cells.append(
        f"{rms(good['naive']) / position:.1f}/{rms(good['naive_velocity']) / velocity:.1f}"
    )
    cells.append(f"{(good['naive'] / good['position']).min():.1f}")
    cells.append(f"{good['seconds'].median():.1f}")
    said = (good["verdict"] + " " + good["flags"]).str.strip().value_counts()
    said_all = [f"{count} {text}" for text, count in said.items() if text]
    cells.append("; ".join(said_all) + (f"; {faults} FAILED" if faults else ""))
    return "| " + " | ".join(cells) + " |"


def _uncertain(values: pd.Series) -> str:
    """Mean, and in brackets how many standard errors it is from 1."""
    mean = values.mean()
    if len(values) < 3:
        return f"{mean:.2f}"
    return f"{mean:.2f} ({(mean - 1) / (values.std() / np.sqrt(len(values))):+.1f})"


def confusion(table: pd.DataFrame) -> Iterable[str]:
    """Verdicts of the runs, by case and information."""
    said = table[table["verdict"] != ""]
    if said.empty:
        return
    words = sorted(set(said["verdict"]) | {f for t in said["flags"] for f in t.split()})
    yield "| model | case | information | " + " | ".join(words) + " |"
    yield "|" + "---|" * (3 + len(words))
    for keys, rows in said.groupby(["model", "case", "information"], sort=False):
        both = [{v, *f.split()} for v, f in zip(rows["verdict"], rows["flags"])]
        counts = [sum(w in b for b in both) for w in words]
        yield "| " + " | ".join([*map(str, keys), *map(str, counts)]) + " |"


def wanted(case: Case, information: str, model: str) -> bool:
    """Nonlinear motion has no true hyper-parameters, a rig without shake needs no defaults."""
    if model == "true":
        return not case.nonlinear
    return information != "oracle"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0, help="the first")
    parser.add_argument("--only", default=",".join(cases()))
    parser.add_argument("--information", default="one,five,carriage,arms,references,oracle")
    parser.add_argument("--models", default="true,default")
    parser.add_argument("--oblique", action="store_true", help="40 degrees, kappa not 0")
    parser.add_argument("--calibrated", action="store_true", help="a noisy calibration each seed")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--csv", type=Path, help="one line a run")
    parser.add_argument("--read", type=Path, nargs="+", help="tables of --csv instead of runs")
    return parser.parse_args()


def report(table: pd.DataFrame, possible: Mapping[str, Any], options: argparse.Namespace) -> str:
    head = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    lines = []
    for keys, rows in table.groupby(["model", "case", "information"], sort=False):
        _, case, information = keys
        lines.append(line(rows, possible.get(case, {}).get(information)))
    rig = (
        "40 degrees between the cameras, kappa = 2e-4 / mm"
        if options.oblique
        else "90 degrees between the cameras"
    )
    if options.calibrated:
        rig += ", each seed with a calibration of its own from dots with 0.3 px of noise"
    return f"""# Smoothing the scenarios

{rig}; vertical axis, middle 80 %, position µm / velocity mm/s.
possible: the independent reference's posterior sd, true hyper-parameters. sd, RMS: of
`telerig.smooth`. (e/sd)^2: mean, in brackets its distance from 1 in standard errors over the
seeds. NEES 3-D: of the position, per dimension. naive / RMS: how much better than triangulating
and adding the encoder; worst: the position's ratio in the worst seed. s: median seconds a run,
on one core of a machine busy with other work. True: hyper-parameters with which the data were
made; default: nothing told. Nonlinear: {", ".join(NONLINEAR)}.

{chr(10).join([*head, *lines])}

## Verdicts

{chr(10).join(confusion(table)) or "None: no verdicts available."}
"""


def run_all(options: argparse.Namespace) -> pd.DataFrame:
    """Records of every case, seed, model and set of information asked for."""
    table: list[dict[str, Any]] = []
    for name in options.only.split(","):
        case = oblique(cases()[name]) if options.oblique else cases()[name]
        for seed in range(options.seed, options.seed + options.seeds):
            rng = np.random.default_rng([seed, hash_of(name)])
            rig = None
            if options.calibrated:
                rig = calibrated(case.angle_deg, case.kappa_per_mm, rng)
            run = simulate(case, rng, rig)
            for model in options.models.split(","):
                for information in options.information.split(","):
                    if wanted(case, information, model):
                        record = smoothed(run, information, model, seed)
                        table.append(asdict(record))
                        print(_brief(record), flush=True)
        if options.csv:
            pd.DataFrame(table).to_csv(options.csv, index=False)
    return pd.DataFrame(table)


def main() -> None:
    options = arguments()
    if options.read:
        words = dict.fromkeys(("model", "verdict", "flags", "fault"), str)
        parts = [
            pd.read_csv(path, dtype=words, keep_default_na=False, na_values=["nan"])
            for path in options.read
        ]
        table = pd.concat(parts, ignore_index=True)
    else:
        table = run_all(options)
    linear = [name for name in dict.fromkeys(table["case"]) if not cases()[name].nonlinear]
    possible = {name: posteriors(cases()[name], np.random.default_rng(0)) for name in linear}
    text = report(table, possible, options)
    print(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


def hash_of(name: str) -> int:
    """The same in every process."""
    return int.from_bytes(name.encode()[:8], "little")


def _brief(r: Record) -> str:
    return (
        f"{r.case:12} {r.information:10} {r.model:8} {r.seed:3} {r.position:7.1f}/{r.velocity:5.2f}"
        f" sd {r.sigma:6.1f}/{r.velocity_sigma:5.2f} nees {r.nees:5.2f} naive {r.naive:5.0f}"
        f" {r.seconds:5.1f} s {r.verdict} {r.flags} {r.fault}"
    )


if __name__ == "__main__":
    main()
