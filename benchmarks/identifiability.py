"""What does the verdict say, is it true, and what do learned modes cost?

Usage: python benchmarks/identifiability.py [--seeds 3] [--only S1,S5] [--information
    one,five,carriage,arms,references] [--models auto,default,true] [--seed 0] [--out FILE.md]
    [--csv FILE.csv] [--read FILE.csv ...]
auto and default: nothing is told to the smoother; true: the hyper-parameters that the runs are made
with. Every seed counts. Runs as in shake_scenarios.py; middle 80 %.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from shake_cases import middle
from shake_problem import true_model
from shake_scenarios import hash_of, rms
from shake_scene import LATERAL, LATERAL_SHAKE, cases, simulate

from telerig.estimator.smoothing.smooth import smooth

Array = NDArray[np.float64]

LARGEST_NEES, LARGEST_SHARE = 1.5, 0.3
"""What a RESOLVED axis may have: NEES, mean over the seeds, and RMS error of the shake's estimate
over the shake."""
WANTED = {"one": "UNRESOLVED", "arms": "RESOLVED", "references": "RESOLVED"}
"""Verdicts that runs of S1-S6 must have."""


@dataclass(frozen=True)
class Outcome:
    """One axis of a smoothed run, all its bubbles; µm.

    run : verdict and flags of the run. below : whether the shake is said to be below the noise.
    nees : mean of (error / stated sd)^2. error, stated : of positions.
    shake, left : RMS of the true offsets of the cameras that see the axis, and of their errors.
    """

    case: str
    information: str
    model: str
    seed: int
    run: str
    axis: str
    verdict: str
    below: bool
    q: float
    eta: float
    nees: float
    error: float
    stated: float
    shake: float
    left: float
    seconds: float


def outcomes(name: str, information: str, model: str, seed: int) -> Iterator[Outcome]:
    run = simulate(cases()[name], np.random.default_rng([seed, hash_of(name)]))
    inputs = run.inputs(information)
    chosen: Any = model
    if model == "true":
        chosen = true_model(
            run.case.scenario, information, lateral=LATERAL, lateral_shake=LATERAL_SHAKE
        )
    begin = time.process_time()
    result = smooth(inputs.pop("tracks"), inputs.pop("calibration"), model=chosen, **inputs)
    spent = time.process_time() - begin
    table, inner = result.trajectories, middle(len(run.t_s))
    table = table[table["frame"].between(inner.start, inner.stop - 1)]
    there = table["particle"].to_numpy(), table["frame"].to_numpy()
    said = " ".join([result.verdict["verdict"], *result.verdict["flags"]])
    for i, axis in enumerate("xyz"):
        judged = result.verdict["axes"][axis]
        off = table[f"{axis}_mm"].to_numpy() - run.position_mm[*there, i]
        sd = table[f"s{axis}_mm"].to_numpy()
        seeing = [j for j, depth in ((0, 2), (1, 0)) if depth != i]
        names = [f"{('left', 'right')[j]}_{axis}_mm" for j in seeing]
        true = run.offset_mm[seeing][:, inner, i].T
        yield Outcome(
            name, information, model, seed, said, axis, judged["verdict"],
            "SHAKE_BELOW_NOISE" in judged["flags"], judged["q"],
            np.nan if judged["eta"] is None else judged["eta"], float(np.mean((off / sd) ** 2)),
            1e3 * rms(off), 1e3 * rms(sd), 1e3 * rms(true),
            1e3 * rms(result.shake[names].to_numpy()[inner] - true), spent,
        )  # fmt: skip


COLUMNS = (
    "case", "information", "model", "axes", "verdicts", "q", "eta", "NEES",
    "error / sd µm", "error / shake", "left of the shake", "CPU s",
)  # fmt: skip


def grouped(table: pd.DataFrame) -> dict[Any, pd.DataFrame]:
    """The rows of each scenario, information, model, and axis along or across the vertical."""
    table = table.assign(axes=np.where(table["axis"] == "y", "y", "x, z"))
    return dict(iter(table.groupby(["case", "information", "model", "axes"], sort=False)))


def said(rows: pd.DataFrame) -> str:
    words = rows["verdict"] + np.where(rows["below"], " (below the noise)", "")
    return "; ".join(f"{n} {word}" for word, n in words.value_counts().items())


def report(table: pd.DataFrame) -> Iterator[str]:
    yield "| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS) + "\n"
    for key, rows in grouped(table).items():
        error, stated, shake = (rms(rows[name]) for name in ("error", "stated", "shake"))
        cells = [
            *map(str, key), said(rows),
            f"{rows['q'].min():.2f}-{rows['q'].max():.2f}", _range(rows["eta"]),
            f"{rows['nees'].mean():.2f}", f"{error:.0f} / {stated:.0f}", f"{error / shake:.2f}",
            f"{rms(rows['left']) / shake:.2f}", f"{rows['seconds'].mean():.0f}",
        ]  # fmt: skip
        yield "| " + " | ".join(cells) + " |\n"


def _range(values: pd.Series) -> str:
    return "" if values.isna().all() else f"{values.min():.3f}-{values.max():.3f}"


def faults(table: pd.DataFrame) -> Iterable[str]:
    """What a verdict must not be, by case, information, model and axis."""
    judged = table[table["case"] != "S0"]
    for information, verdict in WANTED.items():
        mine = judged[(judged["information"] == information) & (judged["model"] != "true")]
        wrong = mine[~mine["run"].str.startswith((verdict, "CONTRADICTED"))]
        for _, one in wrong.drop_duplicates(["case", "model", "seed"]).iterrows():
            yield f"- {one['case']} {information} {one['model']} seed {one['seed']}: {one['run']}\n"
    resolved = table[table["verdict"] == "RESOLVED"]
    for key, rows in resolved.groupby(["case", "information", "model", "axis"], sort=False):
        nees, share = rows["nees"].mean(), rms(rows["left"]) / rms(rows["shake"])
        if nees > LARGEST_NEES or (share > LARGEST_SHARE and not rows["below"].all()):
            what = f"RESOLVED in {len(rows)}, NEES {nees:.2f}, {share:.2f} of the shake is left"
            yield f"- {' '.join(map(str, key))}: {what}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="S0,S1,S2,S3,S4,S5,S6")
    parser.add_argument("--information", default="one,five,carriage,arms,references")
    parser.add_argument("--models", default="auto")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--csv", type=Path, help="a row for each axis of each run")
    parser.add_argument("--read", type=Path, nargs="+", help="tables of --csv instead of runs")
    options = parser.parse_args()
    found: list[Outcome] = []
    if not options.read:
        for name in options.only.split(","):
            for information in options.information.split(","):
                for model in options.models.split(","):
                    for seed in range(options.seed, options.seed + options.seeds):
                        found += outcomes(name, information, model, seed)
                        print(*found[-3:], sep="\n", file=sys.stderr, flush=True)
            if options.csv:
                pd.DataFrame(map(asdict, found)).to_csv(options.csv, index=False)
    table = pd.concat([pd.read_csv(f) for f in options.read]) if options.read else None
    table = pd.DataFrame(map(asdict, found)) if table is None else table
    text = f"""# Verdicts, and whether they are true

Printed by `benchmarks/identifiability.py`: {table["seed"].nunique()} seeds from
{table["seed"].min()}; y is the vertical; middle 80 %. NEES: mean of (error / stated sd)^2 of the
positions along the axis. Left of the shake: RMS error of the estimated offsets of the cameras over
the RMS of the true ones; error / shake: that of the positions, the pixels' noise included.

{"".join(report(table))}
Against what must be (one bubble UNRESOLVED and sensors RESOLVED in S1-S6; of a RESOLVED axis a
NEES, mean over the seeds, up to {LARGEST_NEES:g} and at most {LARGEST_SHARE:g} of the shake left,
unless it is below the noise):
{"".join(faults(table)) or "nothing."}
"""
    print(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
