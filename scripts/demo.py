"""telerig demo: simulate a rig, calibrate, track, take out the shake, compare with the truth."""

from __future__ import annotations

import shlex
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from telerig.command_options import CalibrationOptions, TrackingOptions
from telerig.scripts import options
from telerig.scripts.console import EXIT_REJECTED, errors_in_words, progress, run_file, say
from telerig.short_text import counted

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.io.dataset.dataset import Dataset
    from telerig.io.simulation.config import RunConfig

MOST_RATIO = 2.0
"""Largest ratio of an error to its stated standard deviation with which the demo passes."""


@errors_in_words()
def demo(
    out: Annotated[Path, typer.Option(help="Folder to create; it must be new or empty.")] = Path(
        "telerig-demo"
    ),
    seed: Annotated[int, typer.Option(help="Seed of the simulated rig and its noise.", min=0)] = 0,
    quiet: options.Quiet = False,
) -> None:
    """Simulate a rig with images, calibrate it, track a bubble, remove the shake, compare.

    Writes the dataset and its reports into the folder.

    Exit code 0: all estimates agree with the truth. 1: an estimate differs from the truth by more
    than its own standard deviations allow.
    """
    import numpy as np

    from telerig.estimator.batch.work import calibrate_dataset
    from telerig.estimator.calibration.quality.comparison import difference_from_truth
    from telerig.io.simulation.calibration.scene import true_cameras
    from telerig.io.simulation.simulate import simulate

    say("simulating two telecentric cameras of 512 x 512 px: 12 views of a hand-held target,")
    say("and a bubble of 4-5 mm that zigzags upwards, followed by the vibrating rig")
    config = _config()
    data = simulate(config, rng=np.random.default_rng(seed), out=out)
    folder, again = data.results / "calibration", shlex.join(["telerig", "calibrate", str(out)])
    with progress(quiet) as stage:
        calibration = calibrate_dataset(out, folder, CalibrationOptions(), again=again, stage=stage)
    say(calibration.report())
    off = difference_from_truth(calibration, tuple(true_cameras(config.calibration).values()))
    calibrated = off.rms_um < MOST_RATIO * off.predicted_um
    say(
        f"\n{'PASSED' if calibrated else 'FAILED'}: the calibration's errors displace points in "
        f"space by {off.rms_um:.2f} µm RMS per axis; its covariance predicts "
        f"{off.predicted_um:.2f} µm\nreport: {folder / 'report.html'}\n"
    )
    tracked = track_and_compare(data, quiet)
    say("")
    smoothed = smooth_and_compare(data, calibration, quiet)
    if not (calibrated and tracked and smoothed):
        raise typer.Exit(EXIT_REJECTED)


def _config() -> RunConfig:
    """Return the run of the paper of 2004, with an accelerometer on each camera's arm and an
    encoder that is stated to be exact, as it is.
    """
    from telerig.io.simulation.presets import run_preset

    config = run_preset("rise")
    stage = replace(config.stage, accelerometers=("left", "right"), scale_sigma=0.0)
    return replace(config, stage=stage)


def track_and_compare(data: Dataset, quiet: bool) -> bool:
    """Track the only run of a simulated dataset, and print the errors.

    Returns whether the bubble was followed throughout.
    """
    import pandas as pd

    from telerig.estimator.batch.work import track_run
    from telerig.estimator.tracking.tracks import load_tracks, tracking_words
    from telerig.estimator.tracking.truth import score_tracks

    begun = time.perf_counter()
    (name,) = data.runs
    folder, path = data.results / name, data.runs[name].path
    again = shlex.join(["telerig", "track", str(path)])
    with progress(quiet) as stage:
        summary = track_run(path, folder, TrackingOptions(), again=again, stage=stage)
    say(tracking_words(summary, time.perf_counter() - begun))
    truth = pd.read_csv(data.path / "truth" / "runs" / name / "bubbles.csv")
    score = score_tracks(load_tracks(folder), truth, list(data.rig.cameras))
    passed = score.recall == 1 and score.precision == 1 and score.tracks == 1
    say(
        f"{score.right} of the bubble's {score.in_view} true positions found, {score.wrong} false "
        f"positions, {counted(score.tracks, 'track')}. RMS error in the images: "
        f"{score.corrected_px:.2f} px for the bubble's centre of volume, "
        f"{score.centre_px:.2f} px if the centre of its outline is taken for it"
    )
    say("PASSED: the bubble was followed throughout" if passed else "FAILED: see the report")
    say(f"report: {folder / 'report.html'}")
    return passed


def smooth_and_compare(data: Dataset, calibration: Calibration, quiet: bool) -> bool:
    """Smooth the run without and with the accelerometers, and print both errors and the verdict.

    Returns whether the bubble's path with accelerometers is within twice its stated deviation of
    the simulated truth and below 0.6 of the error of triangulation.
    """
    import pandas as pd

    from telerig.estimator.smoothing.results_folder import smooth_run
    from telerig.estimator.smoothing.terminal_summary import smoothing_words
    from telerig.estimator.smoothing.truth import motion_error
    from telerig.io.results.smoothing import SmoothingFile
    from telerig.io.results.verdict_words import conclusion_words

    (name,) = data.runs
    folder = data.results / name
    truth = pd.read_csv(data.path / "truth" / "runs" / name / "bubbles.csv")
    run = data.runs[name].load()
    rows = []
    for words, used, target in (
        ("encoder alone", replace(run, accelerometers=None), data.results / f"{name}-encoder"),
        ("encoder and accelerometers", run, folder),
    ):
        with progress(quiet) as stage:
            found = smooth_run(
                used, calibration, folder, target, report=used is run, stage=stage,
                inputs=[data.results / "calibration" / "calibration.json"],
            )  # fmt: skip
        say(f"{words}:\n{smoothing_words(found)}")
        rows.append((words, motion_error(found.trajectories, truth), found.verdict.get("verdict")))
    naive = motion_error(found.trajectories, truth, "naive_")
    say("")
    say("RMS error against the truth                 µm  (predicted)       mm/s  (predicted)")
    say(
        f"{'triangulate and add the encoder':38}{naive.position_um:8.1f}{naive.velocity_mm_s:24.2f}"
    )
    for words, error, verdict in rows:
        say(
            f"{words:38}{error.position_um:8.1f}{f'({error.predicted_um:.1f})':>13}"
            f"{error.velocity_mm_s:11.2f}{f'({error.predicted_mm_s:.2f})':>13}  {verdict}"
        )
    best = rows[-1][1]
    passed = best.position_um < 0.6 * naive.position_um and (
        best.position_um < MOST_RATIO * best.predicted_um
    )
    say(
        f"{'PASSED' if passed else 'FAILED'}: the path is off by {best.position_um:.1f} µm, "
        f"{best.position_um / best.predicted_um:.2f} times as much as predicted and "
        f"{best.position_um / naive.position_um:.2f} times as much as triangulated"
    )
    say(conclusion_words(SmoothingFile.model_validate(found.verdict)))
    say(f"report: {folder / 'report.html'}")
    return passed


if __name__ == "__main__":
    run_file(demo)
