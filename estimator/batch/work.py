"""The work of a job, for a command of its own and in a batch: results written into a folder."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from telerig.command_options import CalibrationOptions, SmoothingOptions, TrackingOptions
from telerig.errors import InputError
from telerig.estimator.batch.cluster import dask_executor
from telerig.io.dataset.dataset import load_dataset
from telerig.io.dataset.run import RunData, load_run, recordings, run_folder
from telerig.io.results.inputs import fingerprints
from telerig.io.results.manifest import check_place
from telerig.live import publish
from telerig.progress import Progress

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.estimator.smoothing.result import Smoothing


def default_folder(run: Path) -> Path:
    """Return the results folder of a run: results/NAME in its dataset, or results/ inside the run.

    The latter is for a run that belongs to no dataset.
    """
    place = run.resolve()
    if place.parent.name == "runs":
        return place.parent.parent / "results" / place.name
    return place / "results"


def load_tracked_run(run: Path, calibration: Calibration) -> RunData:
    """Return a run whose bubbles have been tracked.

    It does not matter whether a run with both has images or detections.
    """
    found = (run / "detections.csv").is_file()
    return load_with(run, calibration, "detections" if found else None)


def load_with(
    run: Path, calibration: Calibration, source: Literal["images", "detections"] | None
) -> RunData:
    """Return a run. One whose folder belongs to no dataset has the cameras of the calibration."""
    if (run.resolve().parent.parent / "rig.toml").is_file():
        return load_run(run, source=source)
    sizes = {c.name: c.image_size_px for c in calibration.cameras}
    return load_run(run, source=source, image_sizes_px=sizes)


def calibrate_dataset(
    dataset: Path,
    folder: Path,
    options: CalibrationOptions,
    *,
    again: str,
    report: bool = True,
    stage: Progress | None = None,
) -> Calibration:
    """Calibrate a dataset and write the results; again : the command line that does the same."""
    from telerig.estimator.calibration.calibrate import run_calibration
    from telerig.estimator.calibration.results_folder import sources, write_report, write_results

    begun = time.perf_counter()
    data = load_dataset(dataset, source=options.source)
    used = fingerprints(folder, sources(data))
    check_place(folder, "calibrate", used)
    run = run_calibration(data, **options.keywords, stage=stage, pictures=True)
    write_results(
        data, run, folder, command="calibrate", options=options.record(),
        seconds={"calibrate": time.perf_counter() - begun},
        report=write_report if report else None, used=used, again=again,
    )  # fmt: skip
    return run.calibration


def track_run(
    run: Path,
    folder: Path,
    options: TrackingOptions,
    calibration: Sequence[Path] | None = None,
    *,
    again: str,
    report: bool = True,
    stage: Progress | None = None,
) -> dict[str, Any]:
    """Track a run and write the results; returns the content of tracking.json.

    calibration : files of the calibration; None for that of the dataset. again : the command line
    that makes the folder again.
    """
    from telerig.estimator.calibration.result.calibration import calibration_for, of_run
    from telerig.estimator.tracking.results_folder import write_tracking
    from telerig.estimator.tracking.track import TrackOptions

    if options.cluster is not None:
        run, folder = run.resolve(), folder.resolve()
    calibrated, files = calibration_for(run, calibration)
    place = run_folder(run)
    if folder.resolve() in (place, *recordings(place).values()):
        raise InputError(
            "holds the recording, whose files and detections.csv results must not replace",
            where=str(folder),
            todo="choose another --out",
        )
    count = options.first_frames
    record = {"command": "track", "options": options.record(), "inputs": files, "again": again}
    cluster = options.cluster
    with nullcontext() if cluster is None else dask_executor(cluster, "--cluster") as executor:
        if stage is not None:
            stage("reading the run", 0.0, 1)
        data = load_with(run, calibrated, options.source)
        if data.detections is not None:
            _refuse_detection_options(run, options)
        publish("recording", path=data.path, rig=of_run(calibrated, data.cameras).cameras)
        summary = write_tracking(
            data if count is None else data.first(count), calibrated, folder,
            options=TrackOptions(options.min_diameter_px, options.min_contrast),
            record=record, report=report, stage=stage, executor=executor,
        )  # fmt: skip
    publish("results", folder=folder.resolve())
    return summary


def _refuse_detection_options(run: Path, options: TrackingOptions) -> None:
    """Raise InputError for an option of the detection where the bubbles are given."""
    for name in ("min_diameter_px", "min_contrast"):
        value = getattr(options, name)
        if value != getattr(TrackingOptions, name):
            flag = TrackingOptions.settings()[name].flags[0]
            raise InputError(
                f"{flag} {value:g} has no effect, the bubbles are given",
                where=str(run / "detections.csv"),
                todo="leave it out, or detect the bubbles in images: --from images",
            )


def smooth_run(
    run: Path,
    folder: Path,
    options: SmoothingOptions,
    calibration: Sequence[Path] | None = None,
    *,
    tracks: Path,
    again: str,
    report: bool = True,
    stage: Progress | None = None,
) -> Smoothing:
    """Smooth a tracked run and write the results.

    tracks : tracks.csv, or the folder that holds it. calibration : files of the calibration; None
    for that of the dataset. again : the command line that makes the results again.
    """
    from telerig.estimator.calibration.result.calibration import calibration_for, of_run
    from telerig.estimator.smoothing import results_folder

    calibrated, files = calibration_for(run, calibration)
    if stage is not None:
        stage("reading the run", 0.0, 1)
    data = load_tracked_run(run, calibrated)
    publish("recording", path=data.path, rig=of_run(calibrated, data.cameras).cameras)
    found = results_folder.smooth_run(
        data, calibrated, tracks, folder, options, inputs=files, report=report, stage=stage,
        again=again,
    )  # fmt: skip
    own = tracks if tracks.is_dir() else tracks.parent
    publish("results", folder=folder.resolve(), tracked=own.resolve(), recording=data.path)
    return found
