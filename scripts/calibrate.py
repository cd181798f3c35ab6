"""telerig calibrate: from target images or dots to a stereo calibration with its covariance."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from telerig.scripts.console import EXIT_REJECTED, checked_source, errors_in_words, progress, say

if TYPE_CHECKING:
    from telerig.estimator.calibration import Calibration
    from telerig.estimator.compare_calibrations import RigComparison


def calibrate(
    dataset: Annotated[Path, typer.Argument(help="Dataset folder with rig.toml and calibration/.")],
    out: Annotated[
        Path | None, typer.Option(help="Results folder [DATASET/results/calibration].")
    ] = None,
    model: Annotated[
        str, typer.Option(help="auto, or a lens model: none, radial, tangential, kappa, ...")
    ] = "auto",
    solver: Annotated[str, typer.Option(help="auto, gtsam or schur.")] = "auto",
    dots: Annotated[
        str, typer.Option(help="What dots may do: 3d, plane (stay in the plane), nominal (held).")
    ] = "3d",
    medium: Annotated[
        str,
        typer.Option(help="air or water: where the target was. With [walls], runs are in water."),
    ] = "air",
    compare: Annotated[
        Path | None,
        typer.Option(help="An earlier calibration of this rig: says what moved since then."),
    ] = None,
    source: Annotated[
        str | None, typer.Option("--from", help="images or dots, when the dataset has both.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Recorded; the calibration draws nothing.")] = 0,
    report: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    quiet: Annotated[bool, typer.Option(help="Print only the summary.")] = False,
) -> None:
    """Calibrate the rig from views of the target.

    Finds and numbers the dots, calibrates both cameras, their pose, every target pose and the
    dots' own positions together, and writes calibration.json, covariance.npz, dots.csv,
    residuals.csv, run.json and report.html.

    Exit code 0: calibrated. 1: calibrated, but the verdict is REJECTED. 2: the input cannot be
    used, with what, where and what to do. 130: interrupted.
    """
    with errors_in_words():
        from telerig.estimator.calibrate import run_calibration
        from telerig.estimator.calibration_results import write_results
        from telerig.io.dataset import load_dataset

        begun = time.perf_counter()
        earlier = None if compare is None else _loaded(compare)
        data = load_dataset(dataset, source=checked_source(source))
        options = {"model": model, "solver": solver, "dots": dots, "medium": medium,
                   "compare": None if compare is None else str(compare), "from": source,
                   "seed": seed}  # fmt: skip
        folder = out or data.results / "calibration"
        with progress(quiet) as stage:
            run = run_calibration(
                data, model=model, solver=solver, medium=medium, seed=seed, dots_free=dots,
                stage=stage, pictures=True,
            )  # fmt: skip
        seconds = {"calibrate": time.perf_counter() - begun}
        change = None if earlier is None else _change(earlier, run.calibration)
        write_results(
            data, run, folder, command="calibrate", options=options, seconds=seconds,
            change=change, report=report,
        )  # fmt: skip
        say(run.calibration.report())
        if change is not None:
            say(f"since {compare}: {change.words()}")
        say(f"written: {folder}" + ("/report.html" if report else ""))
        if run.calibration.verdict["status"] == "REJECTED":
            raise typer.Exit(EXIT_REJECTED)


def _loaded(path: Path) -> Calibration:
    from telerig.estimator.calibration import load_calibration

    return load_calibration(path)


def _change(earlier: Calibration, now: Calibration) -> RigComparison:
    from telerig.estimator.compare_calibrations import compare_calibrations

    return compare_calibrations(earlier, now)


if __name__ == "__main__":
    typer.run(calibrate)
