"""telerig calibrate: from target images or dots to a stereo calibration with its covariance."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from telerig.errors import InputError
from telerig.scripts.console import (
    EXIT_REJECTED,
    checked_source,
    errors_in_words,
    progress,
    say,
    stopped_by_signals,
)

if TYPE_CHECKING:
    from telerig.estimator.calibration.calibrate import CalibrationRun
    from telerig.estimator.calibration.quality.comparison import RigComparison
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.estimator.dots.dataset_dots import DatasetDots
    from telerig.io.dataset.dataset import Dataset


def calibrate(
    dataset: Annotated[Path, typer.Argument(help="Dataset folder with rig.toml and calibration/.")],
    out: Annotated[
        Path | None, typer.Option(help="Results folder [DATASET/results/calibration].")
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            help="auto, or a lens model: none, radial, k1+k2, tangential, brown, prism, kappa, "
            "affine, tilt, or some joined by +; left=brown,right=auto for each camera its own."
        ),
    ] = "auto",
    solver: Annotated[str, typer.Option(help="auto, gtsam or schur.")] = "auto",
    dots: Annotated[
        str, typer.Option(help="What dots may do: 3d, plane (stay in the plane), nominal (held).")
    ] = "3d",
    outlier_sd: Annotated[
        float,
        typer.Option(help="Leave out dots more standard deviations off than this, 3 at least."),
    ] = 4.5,
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
    watch: Annotated[
        bool,
        typer.Option(
            "--watch",
            help="Solve again as images arrive, say how to hold the target next, and "
            "end when another view is not worth it (or at Ctrl-C).",
        ),
    ] = False,
    until_um: Annotated[
        float | None,
        typer.Option(help="With --watch: enough when points in space are as good as this.", min=0),
    ] = None,
    poll: Annotated[
        float, typer.Option(help="With --watch: seconds between looks at the folder.", min=0.02)
    ] = 1.0,
    seed: Annotated[int, typer.Option(help="Recorded; the calibration draws nothing.")] = 0,
    report: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    quiet: Annotated[bool, typer.Option(help="Print only the summary.")] = False,
) -> None:
    """Calibrate the rig from views of the target.

    Finds and numbers the dots, calibrates both cameras, their pose, every target pose and the
    dots' own positions together, and writes calibration.json, covariance.npz, dots.csv,
    residuals.csv, run.json and report.html.

    With --watch it looks into calibration/<camera>/ for new images until another view would bring
    less than 5 %, or until Ctrl-C; the results are written then, once.

    Exit code 0: calibrated. 1: calibrated, but the verdict is REJECTED. 2: the input cannot be
    used, with what, where and what to do. 130: interrupted.
    """
    with errors_in_words():
        from telerig.estimator.calibration.calibrate import check_options
        from telerig.estimator.calibration.results_folder import report_beside, write_results

        begun = time.perf_counter()
        options: dict[str, Any] = {"model": model, "solver": solver, "dots": dots, "medium": medium,
                   "outlier_sd": outlier_sd,
                   "compare": None if compare is None else str(compare), "from": source,
                   "seed": seed}  # fmt: skip
        chosen: dict[str, Any] = {
            "model": model, "solver": solver, "medium": medium, "seed": seed, "dots_free": dots,
            "outlier_sd": outlier_sd,
        }  # fmt: skip
        check_options(**chosen)
        with report_beside(report) as write_report:
            earlier = None if compare is None else _earlier(compare, dataset)
            if watch:
                data, run = _watched(dataset, source, until_um, poll, chosen)
                options |= {"watch": True, "until_um": until_um}
            else:
                begin = None if write_report is None else write_report.begin
                data, run = _at_once(dataset, source, until_um, quiet, chosen, begin)
            folder = out or data.results / "calibration"
            seconds = {"calibrate": time.perf_counter() - begun}
            change = None if earlier is None else _change(earlier, run.calibration)
            write_results(
                data, run, folder, command="calibrate", options=options, seconds=seconds,
                change=change, report=write_report,
            )  # fmt: skip
        say(run.calibration.report())
        if change is not None:
            say(f"since {compare}: {change.words()}")
        say(f"written: {folder}" + ("/report.html" if report else ""))
        if run.calibration.verdict["status"] == "REJECTED":
            raise typer.Exit(EXIT_REJECTED)


def _at_once(
    dataset: Path,
    source: str | None,
    until_um: float | None,
    quiet: bool,
    chosen: dict[str, Any],
    found: Callable[[DatasetDots], object] | None,
) -> tuple[Dataset, CalibrationRun]:
    """The dataset as it lies there, and its calibration. found : called when dots are detected."""
    from telerig.estimator.calibration.calibrate import check_options, detect, run_calibration
    from telerig.io.dataset.dataset import load_dataset

    if until_um is not None:
        raise InputError("--until-um goes with --watch", todo="add --watch, or leave it")
    data = load_dataset(dataset, source=checked_source(source))
    check_options(**chosen, cameras=list(data.rig.cameras))
    with progress(quiet) as stage:
        detected = detect(data, stage=stage, pictures=True)
        if detected is not None and found is not None:
            found(detected)
        return data, run_calibration(data, **chosen, stage=stage, detected=detected)


def _earlier(path: Path, dataset: Path) -> Calibration:
    """The calibration to compare with, checked to be of this rig before anything is solved."""
    from telerig.estimator.calibration.quality.comparison import check_same_rig
    from telerig.estimator.calibration.result.calibration import load_calibration
    from telerig.io.dataset.dataset import load_dataset

    kept = path / "results" / "calibration"
    earlier = load_calibration(kept if (kept / "calibration.json").is_file() else path)
    rig = load_dataset(dataset, need_views=False).rig
    check_same_rig(earlier.cameras, tuple(rig.cameras.values()))
    return earlier


def _change(earlier: Calibration, now: Calibration) -> RigComparison:
    from telerig.estimator.calibration.quality.comparison import compare_calibrations

    return compare_calibrations(earlier, now)


def _watched(
    dataset: Path, source: str | None, until_um: float | None, poll: float, chosen: dict[str, Any]
) -> tuple[Dataset, CalibrationRun]:
    """The images that arrived, and their calibration."""
    from telerig.estimator.calibration.watch import watch
    from telerig.io.dataset.dataset import load_dataset

    if source == "dots":
        raise InputError("--watch waits for images", todo="leave out --from dots")
    data = load_dataset(dataset, need_views=False)
    say(f"watching {data.path / 'calibration'}; Ctrl-C writes the results and ends")
    with stopped_by_signals() as stop:
        return watch(data, stop=stop, tell=say, interval_s=poll, until_um=until_um, **chosen)


if __name__ == "__main__":
    typer.run(calibrate)
