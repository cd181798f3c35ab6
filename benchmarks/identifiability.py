"""What does the verdict say, and what do learned modes cost? Nothing is told to the smoother.

Usage: python benchmarks/identifiability.py [--seeds 2] [--only S1,S5] [--information
    one,five,carriage,arms,references] [--seed 0] [--truth] [--out FILE.md]
With --truth the hyper-parameters that the runs are made with are told, to compare seed by seed.
Every seed counts. Runs as in shake_scenarios.py; vertical axis, middle 80 %.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from shake_problem import true_model
from shake_scene import LATERAL, LATERAL_SHAKE, cases, simulate

from telerig.estimator.smoothing.smooth import smooth

Array = NDArray[np.float64]

FIVE_UM = {"S0": 89.0, "S1": 51.0, "S2": 32.0, "S3": 70.0, "S4": 48.0, "S5": 61.0, "S6": 81.0}
"""Design table: sd of the height with five bubbles and true hyper-parameters."""
WANTED = {
    **{(s, "one"): {"UNRESOLVED", "LABEL_AMBIGUOUS"} for s in ("S1", "S3", "S6")},
    ("S5", "one"): {"SHAKE_BELOW_NOISE"},
    **{(s, "references"): {"RESOLVED"} for s in ("S1", "S2", "S3", "S4", "S6")},
}


@dataclass(frozen=True)
class Outcome:
    """rms_um of the heights of all bubbles, sigma_um the smoother's own, q and flags vertical."""

    case: str
    information: str
    seed: int
    verdict: str
    flags: tuple[str, ...]
    vertical: str
    q: float
    rms_um: float
    sigma_um: float
    seconds: float

    @property
    def ok(self) -> bool | None:
        wanted = WANTED.get((self.case, self.information))
        return None if wanted is None else wanted <= {self.verdict, *self.flags}


def outcome(name: str, information: str, seed: int, truth: bool = False) -> Outcome:
    run = simulate(cases()[name], np.random.default_rng([seed, int(name[1])]))
    inputs = run.inputs(information)
    if truth:
        inputs["model"] = true_model(
            run.case.scenario, information, lateral=LATERAL, lateral_shake=LATERAL_SHAKE
        )
    begin = time.process_time()
    result = smooth(inputs.pop("tracks"), inputs.pop("calibration"), **inputs)
    spent = time.process_time() - begin
    table = result.trajectories
    frame, bubble = table["frame"].to_numpy(), table["particle"].to_numpy()
    edge = len(run.t_s) // 10
    inner = (frame >= edge) & (frame < len(run.t_s) - edge)
    off = (table["y_mm"].to_numpy() - run.position_mm[bubble, frame, 1])[inner]
    y = result.verdict["axes"]["y"]
    return Outcome(
        name, information, seed, result.verdict["verdict"], tuple(result.verdict["flags"]),
        y["verdict"], y["q"], 1e3 * float(np.sqrt(np.mean(off**2))),
        1e3 * float(np.sqrt(np.mean(table["sy_mm"].to_numpy()[inner] ** 2))), spent,
    )  # fmt: skip


WORDS = ("RESOLVED", "PARTIAL", "UNRESOLVED", "LABEL_AMBIGUOUS", "SHAKE_BELOW_NOISE")


def report(found: list[Outcome]) -> Iterable[str]:
    """The confusion table: a row for each scenario and information set."""
    columns = ["case", "information", "runs", "as it must be", *WORDS, "q, vertical", "RMS µm"]
    columns += ["sd µm", "RMS / table", "CPU s"]
    yield "| " + " | ".join(columns) + " |\n|" + "---|" * len(columns) + "\n"
    for case, information in dict.fromkeys((o.case, o.information) for o in found):
        rows = [o for o in found if (o.case, o.information) == (case, information)]
        said = [word for o in rows for word in (o.verdict, *o.flags)]
        good = [o.ok for o in rows if o.ok is not None]
        rms = float(np.sqrt(np.mean([o.rms_um**2 for o in rows])))
        sd = float(np.sqrt(np.mean([o.sigma_um**2 for o in rows])))
        cells = [
            case, information, str(len(rows)), f"{sum(good)} of {len(good)}" if good else "",
            *(str(said.count(word) or "") for word in WORDS),
            f"{min(o.q for o in rows):.2f}-{max(o.q for o in rows):.2f}", f"{rms:.1f}", f"{sd:.1f}",
            f"{rms / FIVE_UM[case]:.2f}" if information == "five" else "",
            f"{np.mean([o.seconds for o in rows]):.1f}",
        ]  # fmt: skip
        yield "| " + " | ".join(cells) + " |\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="S0,S1,S2,S3,S4,S5,S6")
    parser.add_argument("--information", default="one,five,carriage,arms,references")
    parser.add_argument("--truth", action="store_true")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    found = []
    for name in options.only.split(","):
        for information in options.information.split(","):
            for seed in range(options.seed, options.seed + options.seeds):
                found.append(outcome(name, information, seed, options.truth))
                print(found[-1], file=sys.stderr, flush=True)
    told = "true hyper-parameters" if options.truth else "nothing told"
    text = f"Verdicts; {told}; {options.seeds} seeds from {options.seed}.\n\n"
    text += "".join(report(found))
    print(text)
    if options.out:
        options.out.write_text(text)


if __name__ == "__main__":
    main()
