"""Write the results folder of a calibration: data first, pictures, then the report."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.estimator.calibration.calibrate import CalibrationRun
from telerig.io.files.atomic import plain, write_json_atomic
from telerig.io.results.calibration import ComparisonFile
from telerig.io.results.inputs import Input, Source, fingerprints
from telerig.io.results.manifest import replaced_results
from telerig.io.results.record import run_record

if TYPE_CHECKING:
    from telerig.estimator.calibration.quality.comparison import RigComparison
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.estimator.dots.dataset_dots import DatasetDots
    from telerig.io.dataset.dataset import Dataset


_RIG_TABLES = ("cameras", "stereo", "target", "stage", "walls")
"""The tables of rig.toml on which a calibration depends."""


def sources(dataset: Dataset) -> list[Path | Source]:
    """Return the inputs whose change makes the calibration of a dataset out of date."""
    views, stops = dataset.path / "calibration", dataset.path / "stage_axis"
    cameras = tuple(dataset.rig.cameras)
    from_table = dataset.source == "dots"
    return [
        Source(dataset.path / "rig.toml", tables=_RIG_TABLES),
        views / "dots.csv" if from_table else Source(views, cameras=cameras),
        stops / "positions.csv",
        stops / "dots.csv",
        Source(stops, cameras=cameras),
    ]


def write_report(folder: Path) -> Path:
    """Write the HTML report of a results folder, and return its path."""
    from telerig.io.report.calibration.report import write_calibration_report

    return write_calibration_report(folder)


def write_results(
    dataset: Dataset,
    run: CalibrationRun,
    folder: Path,
    *,
    command: str,
    options: Mapping[str, Any],
    seconds: Mapping[str, float],
    change: RigComparison | None = None,
    report: Callable[[Path], object] | None = write_report,
    used: Mapping[str, Input] | None = None,
    again: str = "",
) -> Path:
    """Write the results folder of a calibration, and return the path of its report, if any.

    All files (`docs/files.md`) appear together at the end, so that an interrupted command leaves
    the old files unchanged.

    command, options, seconds : content of `run.json`.
    change : content of `comparison.json`; None writes no such file.
    report : function that writes the report of a folder; None for no report.
    used : fingerprints of `sources` from before the dataset was read.
    again : the command line that makes the folder again; "" for `telerig calibrate` of the dataset.
    """
    record = run_record(command, options, seconds)
    again = again or f"telerig calibrate {shlex.quote(str(dataset.path))}"
    inputs = fingerprints(folder, sources(dataset)) if used is None else used
    with replaced_results(folder, "calibrate", again=again, inputs=inputs) as staged:
        run.calibration.write_files(staged)
        write_json_atomic(staged / "run.json", record)
        if change is not None:
            compared = {"earlier": options.get("compare"), **change.as_dict()}
            file = staged / "comparison.json"
            ComparisonFile.of(plain(compared), file).write(file)
        if len(run.calibration.cameras) > 1:
            write_uncertainty(run.calibration, staged / "uncertainty.npz")
        if run.detected is not None:
            write_detections(run.detected, staged)
        if report is not None:
            report(staged)
    return folder / "report.html"


def write_uncertainty(calibration: Calibration, path: Path) -> None:
    """Write covariances of points over the working volume to a NumPy file (.npz).

    It holds points_mm (N, 3), calibration_mm2 and measurement_mm2 (N, 3, 3), and sigma_px.
    """
    from telerig.estimator.calibration.quality.uncertainty_map import uncertainty_map

    found = uncertainty_map(calibration)
    with path.open("wb") as stream:
        np.savez_compressed(
            stream, allow_pickle=False, points_mm=found.points_mm, sigma_px=found.sigma_px,
            calibration_mm2=found.calibration_mm2, measurement_mm2=found.measurement_mm2,
        )  # fmt: skip


def write_detections(detected: DatasetDots, folder: Path) -> None:
    """Write `rejected.csv` and, if they were made, overlays into a folder."""
    from telerig.io.files.csv_table import write_table

    write_table(detected.rejected, folder / "rejected.csv")
    for image in (i for i in detected.images if i.overlay):
        target = folder / "overlays" / image.camera / f"{image.view}.jpg"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(image.overlay)
