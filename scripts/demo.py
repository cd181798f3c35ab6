"""telerig demo: simulate a rig, calibrate it from images, compare with the truth."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from telerig.scripts.console import EXIT_REJECTED, errors_in_words, progress, say


def demo(
    out: Annotated[Path, typer.Option(help="Folder to create; must be new or empty.")] = Path(
        "telerig-demo"
    ),
    seed: Annotated[int, typer.Option(help="Seed of the simulated rig and its noise.")] = 0,
    quiet: Annotated[bool, typer.Option(help="No progress.")] = False,
) -> None:
    """Simulate a rig with images, calibrate from them, and print estimate against truth.

    Writes the dataset and its report into the folder; exit code 1 when the estimate disagrees
    with the truth by more than its own standard deviations allow.
    """
    with errors_in_words():
        import numpy as np

        from telerig.estimator.calibrate import run_calibration
        from telerig.estimator.calibration_results import write_results
        from telerig.estimator.truth import compare_with_truth
        from telerig.io.simulation import simulate

        say("simulating 12 views of a hand-held target, two telecentric cameras of 512 x 512 px")
        begun = time.perf_counter()
        data = simulate("paper", rng=np.random.default_rng(seed), out=out)
        simulated = time.perf_counter()
        with progress(quiet) as stage:
            run = run_calibration(data, seed=seed, stage=stage)
        seconds = {
            "simulate": simulated - begun,
            "calibrate": time.perf_counter() - simulated,
        }
        folder = data.results / "calibration"
        path = write_results(
            data, run, folder, command="demo", options={"seed": seed}, seconds=seconds
        )
        say(run.calibration.report())
        comparison = compare_with_truth(run.calibration, data.truth or {})
        say("")
        say(comparison.table)
        say(comparison.verdict)
        say(f"report: {path}")
        if not comparison.passed:
            raise typer.Exit(EXIT_REJECTED)


if __name__ == "__main__":
    typer.run(demo)
