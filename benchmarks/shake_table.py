"""What is possible in each scenario of the smoother: exact posteriors, checked by runs.

Usage: python benchmarks/shake_table.py [--runs 50] [--seed 0] [--out FILE.md]
The estimator is tests/support/shake_reference.py, which shares no code with the product; the runs
come from the product's simulator of motions.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
from shake_cases import SCENARIOS, Runs, Scenario, generate, middle, naive, reference

Array = NDArray[np.float64]

COLUMNS = ("one", "five", "carriage", "arms", "references", "oracle")
DESIGN = {
    "S0": {"naive": "170/12", "one": "114/8.4", "five": "89/6.5", "arms": "60/4.4",
           "references": "60/4.4", "oracle": "59/4.4"},
    "S1": {"naive": "137/14.5", "one": "68/4.8", "five": "51/3.9", "carriage": "48/4.2",
           "arms": "15.8/2.23", "references": "14.3/2.23", "oracle": "12.8/2.23"},
    "S2": {"naive": "137/22", "one": "39/3.9", "five": "32/3.1", "carriage": "20/2.7",
           "arms": "14.7/2.23", "references": "13.9/2.23", "oracle": "12.8/2.23"},
    "S3": {"naive": "137/16.5", "one": "104/8.0", "five": "70/5.5", "carriage": "26/3.1",
           "arms": "15.1/2.23", "references": "14.1/2.23", "oracle": "12.8/2.23"},
    "S4": {"naive": "331/87", "one": "59/4.5", "five": "48/3.1", "arms": "20.9/1.35",
           "references": "10.1/1.37", "oracle": "2.9/1.33"},
    "S5": {"naive": "111/7.7", "one": "62/4.6", "five": "61/4.5", "arms": "59/4.4",
           "references": "59/4.4", "oracle": "59/4.4"},
    "S6": {"naive": "333/22", "one": "117/7.8", "five": "81/5.2", "arms": "24/2.23",
           "references": "19/2.23", "oracle": "12.8/2.23"},
    "8 Hz, 0.1 px": {"naive": "134/7.8", "rts": "134/7.5", "one": "67/4.5", "five": "49/3.5",
           "carriage": "46/3.9", "arms": "9.9/1.45", "references": "7.5/1.47",
           "oracle": "3.7/1.45"},
    "20 Hz, 0.1 px": {"naive": "125/17", "rts": "125/17", "one": "38/3.8", "five": "30/2.6",
           "carriage": "17/2.5", "arms": "8.1/1.45", "references": "6.7/1.49",
           "oracle": "3.7/1.45"},
    "20 Hz, 1.5 px": {"naive": "161/41", "rts": "116/15", "one": "45/4.1", "five": "42/3.7",
           "carriage": "33/3.3", "arms": "31.5/3.16", "references": "31.2/3.17",
           "oracle": "30.7/3.16"},
}  # fmt: skip


def scenarios() -> dict[str, Scenario]:
    """S0-S6, and the rows of the first table of the design that are none of them."""
    out = dict(SCENARIOS)
    for hz, noise in ((8.0, 0.1), (20.0, 0.1), (20.0, 1.5)):
        name = f"{hz:g} Hz, {noise:g} px"
        out[name] = replace(SCENARIOS["S2"], name=name, hz=hz, noise_px=noise)
    return out


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def consistency(error: Array, sigma: Array) -> tuple[float, float]:
    """Mean of (error / sigma)^2 over frames (F, S), and its distance from 1 in standard errors."""
    each = ((error / sigma[:, None]) ** 2).mean(0)
    return float(each.mean()), float((each.mean() - 1) / (each.std(ddof=1) / np.sqrt(len(each))))


def digits(text: str) -> list[tuple[float, float]]:
    """Numbers of 'position/velocity', with half a unit of their last digit."""
    halves = [0.5 * 10.0 ** -len(t.partition(".")[2]) for t in text.split("/")]
    return list(zip(map(float, text.split("/")), halves))


def distance(found: tuple[float, float], text: str) -> float:
    """The larger relative difference beyond the rounding of what is printed; 0 within it."""
    return max(
        max(abs(f - value) - half, 0.0) / value for f, (value, half) in zip(found, digits(text))
    )


def row(scenario: Scenario, runs: Runs) -> tuple[dict[str, tuple[float, float]], list[str]]:
    """Posterior sd (µm, mm/s) of each information set, and the lines of the check by runs."""
    inner = middle(scenario.frames)
    height, velocity = naive(runs)
    errors = height - runs.height[0], velocity - runs.velocity[0]
    found = {"naive": (1e3 * rms(errors[0][inner]), rms(errors[1][inner]))}
    checks = []
    for information in (*COLUMNS, "rts"):
        begin = time.perf_counter()
        fit = reference(scenario, information, runs)
        spent = time.perf_counter() - begin
        measured = []
        for what, truth in (("position", runs.height[0]), ("velocity", runs.velocity[0])):
            mean, sigma = fit.posterior.of(fit.row(what))
            measured.append((mean[inner] - truth[inner], sigma[inner]))
        (z, sz), (v, sv) = measured
        if information == "rts":
            found["rts"] = (1e3 * rms(z), rms(v))
            continue
        found[information] = (1e3 * rms(sz), rms(sv))
        nz, dz = consistency(z, sz)
        nv, dv = consistency(v, sv)
        checks.append(
            f"| {scenario.name} | {information} | {1e3 * rms(sz):.1f}/{rms(sv):.2f} | "
            f"{1e3 * rms(z):.1f}/{rms(v):.2f} | {nz:.2f} ({dz:+.1f}) | {nv:.2f} ({dv:+.1f}) |"
        )
        print(checks[-1], f"{spent:.1f} s", flush=True)
    return found, checks


def table(found: dict[str, dict[str, tuple[float, float]]]) -> Iterable[str]:
    columns = ("naive", "rts", *COLUMNS)
    yield "| | " + " | ".join(columns) + " | worst |"
    yield "|" + "---|" * (len(columns) + 2)
    for name, values in found.items():
        cells, worst = [], 0.0
        for column in columns:
            text = DESIGN[name].get(column)
            cell = "{:.1f}/{:.2f}".format(*values[column])
            if text is not None:
                cell += f" ({text})"
                if column in COLUMNS:
                    worst = max(worst, distance(values[column], text))
            cells.append(cell)
        yield f"| {name} | " + " | ".join(cells) + f" | {100 * worst:.1f} % |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    found, checks = {}, []
    for name, scenario in scenarios().items():
        found[name], lines = row(scenario, generate(scenario, options.runs, rng))
        checks += lines
    text = f"""# What is possible: exact posteriors of the scenarios

Standard deviations in the middle 80 % of a run, position µm / velocity mm/s, by the independent
reference (`tests/support/shake_reference.py`) with true hyper-parameters; in brackets the
table of the design. naive and rts (a smoother with the bubble's own priors and no shake) are RMS
errors over {options.runs} runs, so they scatter; the design does not say how its RTS was tuned.
"worst": the
largest difference of a posterior from the design's figure, beyond the rounding of that figure.

{chr(10).join(table(found))}

## The same over {options.runs} runs of an independent generator

The generator is `telerig.io.simulation.run.motion`. RMS error of position and velocity, the mean of
(error / sd)^2, and in brackets its distance from 1 in standard errors over the runs.

| | information | posterior | RMS error | position | velocity |
|---|---|---|---|---|---|
{chr(10).join(checks)}
"""
    print(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
