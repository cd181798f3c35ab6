"""`telerig.calibrate`: from a dataset to a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from telerig.errors import CalibrationError, InputError, need_kind
from telerig.estimator.calibration.solver.problem import DOTS_FREE, checked_outlier_sd
from telerig.estimator.calibration.thresholds import OUTLIER_SD
from telerig.io.results.findings import Code, Finding
from telerig.io.tables.table import EDGE_COVARIANCE, PIXEL, PIXEL_COVARIANCE
from telerig.progress import Progress, showing_progress
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import AUTO, Model, checked_model, models_by_camera

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.estimator.dots.dataset_dots import DatasetDots
    from telerig.io.dataset.dataset import Dataset
    from telerig.io.rig_file.description import RigDescription

MEDIA = ("air", "water")


@dataclass(frozen=True)
class CalibrationRun:
    """A calibration, and the dots that were detected for it.

    detected : None if the dots were read from `dots.csv`.
    """

    calibration: Calibration
    detected: DatasetDots | None


def checked_medium(medium: str) -> str:
    """Return ``medium`` unchanged. Raises InputError for anything but "air" and "water"."""
    if medium not in MEDIA:
        raise InputError(f"unknown medium {medium!r}", todo=f"known: {', '.join(MEDIA)}")
    return medium


def check_options(
    *,
    model: Model = AUTO,
    medium: str = "air",
    dots_free: str = "3d",
    outlier_sd: float = OUTLIER_SD,
    cameras: Sequence[str] = (),
    **_: object,
) -> None:
    """Check the options of `run_calibration` before any image is read.

    cameras : names of the rig's cameras; empty if they are not known yet. Raises InputError or
    CalibrationError for a value that is not allowed.
    """
    checked_medium(medium)
    checked_outlier_sd(outlier_sd)
    if cameras:
        models_by_camera(model, cameras)
    elif isinstance(model, str):
        checked_model(model)
    if dots_free not in DOTS_FREE:
        raise CalibrationError(
            f"unknown choice {dots_free!r}", todo=f"known: {', '.join(DOTS_FREE)}"
        )


def nominal_cameras(rig: RigDescription) -> tuple[Camera, ...]:
    """Return the cameras with the intrinsics of `rig.toml`.

    The poses are not known yet: all cameras have that of the first one, the identity.
    """
    return tuple(
        Camera.create(
            c.name, c.image_size_px, c.scale_px_per_mm,
            kappa_per_mm=c.telecentricity_per_mm or 0.0,
        )
        for c in rig.cameras.values()
    )  # fmt: skip


@showing_progress
def calibrate(
    dataset: Dataset,
    *,
    model: Model = AUTO,
    medium: str = "air",
    dots_free: str = "3d",
    outlier_sd: float = OUTLIER_SD,
    progress: Progress | bool = False,
) -> Calibration:
    """Calibrate a rig from the images or the dots of a dataset; no file is written.

    model : "auto" (chosen for each camera), the name of a lens model (none, radial, brown,
        kappa+radial, ...), or one for each camera: {"left": "brown"}, "left=brown,right=auto".
    medium : "air" or "water", in which the target is. If `rig.toml` has `[walls]` (refractive
        windows), the runs are in water in both cases.
    dots_free : how far the target's dots may move from their nominal positions: "3d" (in all
        directions), "plane" (only in the target's plane) or "nominal" (not at all).
    outlier_sd : a dot that is further from the model than this is left out, in standard deviations.
    progress : True to show a progress bar; or a function that is called with the name of the step,
        the number done and the total, 0 if it is not known.

    Returns the calibration.
    Raises InputError, DetectionError or CalibrationError; each says what happened, where, and what
    to do.
    """
    need_kind(dataset, "rig", "telerig.calibrate", "give what telerig.load_dataset returns")
    run = run_calibration(
        dataset, model=model, medium=medium, dots_free=dots_free, outlier_sd=outlier_sd,
        stage=None if isinstance(progress, bool) else progress,
    )  # fmt: skip
    return run.calibration


def run_calibration(
    dataset: Dataset,
    *,
    model: Model = AUTO,
    medium: str = "air",
    dots_free: str = "3d",
    outlier_sd: float = OUTLIER_SD,
    stage: Progress | None = None,
    pictures: bool = False,
    detected: DatasetDots | None = None,
) -> CalibrationRun:
    """Calibrate like `calibrate`, with further options, and return the detected dots as well.

    dataset, model, medium, dots_free, outlier_sd : as for `calibrate`.
    stage : function that is called with the name of the step, the number done and the
        total; None for none.
    pictures : whether to draw the detections over each image, as `write_results` needs.
    detected : dots that `detect` or `telerig.estimator.calibration.watch` found before; None
        detects them now.

    Raises the same errors as `calibrate`.
    """
    check_options(
        model=model, medium=medium, dots_free=dots_free, outlier_sd=outlier_sd,
        cameras=list(dataset.rig.cameras),
    )  # fmt: skip
    if detected is None:
        detected = detect(dataset, stage=stage, pictures=pictures)
    table = dataset.dots() if detected is None else detected.dots
    read = [Code.NOTE.found(text=note) for note in dataset.notes]
    read += () if detected is None else detected.findings
    calibration = solve_dots(
        dataset, table, model=model, medium=medium, dots_free=dots_free, outlier_sd=outlier_sd,
        stage=stage, findings=read,
    )  # fmt: skip
    calibration = replace(_with_stage(dataset, calibration, stage), medium=medium)
    if dataset.rig.walls or medium == "water":
        from telerig.estimator.calibration.refractive_windows import behind_windows, window_findings

        if medium == "air":
            calibration = behind_windows(calibration, dataset.rig.windows)
        calibration = _with_findings(calibration, window_findings(calibration, dataset.rig))
    return CalibrationRun(_with_measured(calibration, table), detected)


def solve_dots(
    dataset: Dataset,
    table: pd.DataFrame,
    *,
    model: Model,
    medium: str,
    dots_free: str,
    outlier_sd: float = OUTLIER_SD,
    stage: Progress | None = None,
    findings: Sequence[Finding] = (),
) -> Calibration:
    """Calibrate the rig from a table of dots, without measuring the stage's axis.

    table : the measured dots, with the columns of dots.csv. model, medium, dots_free, outlier_sd,
    stage : as for `run_calibration`.
    findings : what was found while the dots were read.

    The refractive windows of rig.toml are part of the model only if ``medium`` is "water". If it is
    "air", the caller adds them for the runs in water.
    """
    from telerig.estimator.calibration.self_calibration import self_calibrate

    rig = dataset.rig
    windows = rig.windows if medium == "water" else {}
    cameras = tuple(replace(c, wall=windows.get(c.name)) for c in nominal_cameras(rig))
    return self_calibrate(
        table,
        cameras,
        dataset.target,
        nominal_rotvec_deg=rig.rotvec_from_first_deg,
        model=model,
        dots_free=dots_free,
        outlier_sd=outlier_sd,
        progress=None if stage is None else lambda i, _: stage("solve", i, 0),
        findings=findings,
        name=rig.name,
    )


def detect(
    dataset: Dataset, *, stage: Progress | None = None, pictures: bool = False
) -> DatasetDots | None:
    """Detect the dots in all images of a dataset.

    stage : as for `run_calibration`. pictures : whether to draw the detections over each image.
    Returns None if the dataset holds a table of dots instead of images.
    """
    if dataset.source != "images":
        return None
    from telerig.estimator.dots.dataset_dots import detect_dataset

    return detect_dataset(
        dataset,
        progress=None if stage is None else lambda i, n: stage("images", i, n),
        overlays=pictures,
        meanwhile=_load_libraries,
    )


def _load_libraries() -> None:
    """Load what the fit and the page need while other processes detect."""
    import gtsam  # noqa: F401
    import matplotlib.figure  # noqa: F401


def _with_stage(dataset: Dataset, calibration: Calibration, stage: Progress | None) -> Calibration:
    """Return the calibration with the travel axis and encoder scale of the folder `stage_axis/`.

    It stays as it is if there is no such folder or if the calibration was rejected.
    """
    from telerig.estimator.calibration.stage_axis import FOLDER, stage_axis_from

    if not (dataset.path / FOLDER).is_dir() or calibration.verdict["status"] == "REJECTED":
        return calibration
    if stage is not None:
        stage("stage axis", 0, 0)
    found = stage_axis_from(dataset, calibration)
    return _with_findings(replace(calibration, stage=found.as_dict()), found.findings)


def _with_findings(calibration: Calibration, more: Sequence[Finding]) -> Calibration:
    return replace(calibration, findings=(*(calibration.findings or ()), *more))


def _with_measured(calibration: Calibration, table: pd.DataFrame) -> Calibration:
    """Put the covariance and chi-square of the image fit beside the dots.

    A dot is found again by its pixel, because that of a symmetric target may have got a new number.
    """
    same, columns = ["view", "camera", *PIXEL], [*PIXEL_COVARIANCE, *EDGE_COVARIANCE, "chi2_dof"]
    measured = table.reindex(columns=[*same, *columns]).copy()
    measured["view"] = measured["view"].astype(str)
    dots = calibration.dots.merge(measured.drop_duplicates(same), on=same, how="left")
    dots["chi2_dof"] = dots["chi2_dof"].astype(float)
    tables = {"dots.csv": dots, "residuals.csv": calibration.residuals}
    return replace(calibration, tables=tables)
