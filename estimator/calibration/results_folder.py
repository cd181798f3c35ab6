"""Write the results folder of a calibration: data first, pictures, then the report."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.estimator.calibration.calibrate import CalibrationRun
from telerig.io.files.atomic import atomic_folder, plain, write_json_atomic
from telerig.io.machine.parallel import Assistant, assistant
from telerig.io.results.calibration import ComparisonFile
from telerig.io.results.record import run_record

if TYPE_CHECKING:
    from telerig.estimator.calibration.quality.comparison import RigComparison
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.estimator.dots.dataset_dots import DatasetDots
    from telerig.io.dataset.dataset import Dataset
    from telerig.io.report.page.figures import Picture


def input_files(dataset: Dataset) -> list[Path]:
    """The files that a calibration reads."""
    beside = dataset.path / "stage_axis"
    files = [dataset.path / "rig.toml", *sorted(p for p in beside.rglob("*") if p.is_file())]
    if dataset.source == "dots":
        return [*files, dataset.path / "calibration" / "dots.csv"]
    return files + [path for view in dataset.views for path in view.image_paths.values()]


def write_report(folder: Path, dot: list[Picture] | None = None) -> Path:
    """The report of a results folder, whose path is returned.

    dot : the pictures of its dot_example.npz, where they are drawn already.
    """
    from telerig.io.report.calibration.report import write_calibration_report

    return write_calibration_report(folder, dot=dot)


class ReportBeside:
    """`write_report` by an assistant, which draws what it can while the dots are solved for."""

    def __init__(self, call: Assistant) -> None:
        self._call = call
        self._dot: Callable[[], list[Picture] | None] = lambda: None

    def begin(self, detected: DatasetDots) -> None:
        """Draw what needs no calibration."""
        self._dot = self._call.begin(_draw_dot, detected.example)

    def __call__(self, folder: Path) -> Path:
        return self._call(write_report, folder, self._dot())


@contextmanager
def report_beside(wanted: bool) -> Iterator[ReportBeside | None]:
    """A process that loads the report's libraries while this one detects and calibrates.

    None where no report is wanted.
    """
    if not wanted:
        yield None
        return
    import pandas  # noqa: F401 - both processes need it, and its import takes 0.2 s

    with assistant(_prepare_report) as call:
        yield ReportBeside(call)


def _draw_dot(example: Mapping[str, Any]) -> list[Picture]:
    from telerig.io.report.calibration.dot_fit import dot_pictures

    return dot_pictures(example)


def _prepare_report() -> None:
    import telerig.io.report.calibration.report  # noqa: F401
    from telerig.io.report.page.page import prepare_page

    prepare_page("template_calibration.html")


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
) -> Path:
    """Fill ``folder`` with what docs/files.md lists; returns the report's path.

    change : since an earlier calibration, for comparison.json.
    report : writes the report of a folder; None leaves it out.
    Files appear together at the end, so an interrupted command leaves the old ones.
    """
    record = run_record(command, dataset.path, input_files(dataset), options, seconds)
    with atomic_folder(folder) as staged:
        run.calibration.save(staged)
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
    """Covariances over the working volume, as docs/files.md lists them."""
    from telerig.estimator.calibration.quality.uncertainty_map import uncertainty_map

    found = uncertainty_map(calibration)
    with path.open("wb") as stream:
        np.savez_compressed(
            stream, allow_pickle=False, points_mm=found.points_mm, sigma_px=found.sigma_px,
            calibration_mm2=found.calibration_mm2, measurement_mm2=found.measurement_mm2,
        )  # fmt: skip


def write_detections(detected: DatasetDots, folder: Path) -> None:
    """rejected.csv, and where they were made overlays/<camera>/<view>.jpg and dot_example.npz."""
    from telerig.io.files.csv_table import write_table

    write_table(detected.rejected, folder / "rejected.csv")
    for image in (i for i in detected.images if i.overlay):
        target = folder / "overlays" / image.camera / f"{image.view}.jpg"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(image.overlay)
    if detected.example:  # for the picture of the 2004 paper's figure 2
        with (folder / "dot_example.npz").open("wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, **detected.example)
