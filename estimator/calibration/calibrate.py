"""`telerig.calibrate`: from a dataset to a calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.solver.problem import (
    DOTS_FREE,
    OUTLIER_SD,
    SOLVERS,
    checked_outlier_sd,
)
from telerig.rig.camera import Camera
from telerig.rig.lens_models import AUTO, Model, checked_model, models_by_camera

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.estimator.dots.dataset_dots import DatasetDots
    from telerig.io.dataset.dataset import Dataset
    from telerig.io.rig_file.description import RigDescription

Stage = Callable[[str, int, int], None]
"""Progress: (what, done, of)."""


MEDIA = ("air", "water")


@dataclass(frozen=True)
class CalibrationRun:
    """A calibration with the detections it came from; None when it came from dots.csv."""

    calibration: Calibration
    detected: DatasetDots | None


def checked_medium(medium: str) -> str:
    """Raises InputError for anything but "air" and "water"."""
    if medium not in MEDIA:
        raise InputError(f"unknown medium {medium!r}", todo=f"known: {', '.join(MEDIA)}")
    return medium


def check_options(
    *,
    model: Model = AUTO,
    solver: str = "auto",
    medium: str = "air",
    dots_free: str = "3d",
    outlier_sd: float = OUTLIER_SD,
    cameras: Sequence[str] = (),
    **_: object,
) -> None:
    """Check the options of `run_calibration` before any image is read.

    cameras : names of the rig's, where they are known already.
    Raises InputError or CalibrationError for an unknown word.
    """
    checked_medium(medium)
    checked_outlier_sd(outlier_sd)
    if cameras:
        models_by_camera(model, cameras)
    elif isinstance(model, str):
        checked_model(model)
    for what, word, known in (("solver", solver, SOLVERS), ("choice", dots_free, DOTS_FREE)):
        if word not in known:
            raise CalibrationError(f"unknown {what} {word!r}", todo=f"known: {', '.join(known)}")


def nominal_cameras(rig: RigDescription) -> tuple[Camera, ...]:
    """The cameras as `rig.toml` states them, all at the rig's origin."""
    return tuple(
        Camera.create(
            c.name, c.image_size_px, c.scale_px_per_mm,
            kappa_per_mm=c.telecentricity_per_mm or 0.0,
        )
        for c in rig.cameras.values()
    )  # fmt: skip


def calibrate(
    dataset: Dataset,
    *,
    model: Model = AUTO,
    solver: str = "auto",
    medium: str = "air",
    outlier_sd: float = OUTLIER_SD,
    seed: int = 0,
) -> Calibration:
    """Calibrate a rig from the images or the dots of a dataset.

    model : "auto" (chosen for each camera), the name of a lens model (none, radial, brown,
        kappa+radial, ...), or one by camera: {"left": "brown"}, "left=brown,right=auto".
    solver : "gtsam", "schur" (the same minimum, faster for many dots) or "auto".
    medium : "air" or "water", of the target; with `[walls]` in `rig.toml` runs are in water.
    outlier_sd : standard deviations from the model beyond which a dot is left out.
    seed : recorded with the result; the calibration itself draws no random numbers.

    Raises InputError, DetectionError or CalibrationError, each with what, where and what to do.
    """
    run = run_calibration(
        dataset, model=model, solver=solver, medium=medium, outlier_sd=outlier_sd, seed=seed
    )
    return run.calibration


def run_calibration(
    dataset: Dataset,
    *,
    model: Model = AUTO,
    solver: str = "auto",
    medium: str = "air",
    seed: int = 0,
    dots_free: str = "3d",
    outlier_sd: float = OUTLIER_SD,
    stage: Stage | None = None,
    pictures: bool = False,
    detected: DatasetDots | None = None,
) -> CalibrationRun:
    """Like `calibrate`, with progress, the choice of what dots may do, and the detections.

    pictures : draw what was found over each image, as `write_results` needs.
    detected : made before, by `detect` or `telerig.estimator.calibration.watch`; None detects now.
    """
    check_options(
        model=model, solver=solver, medium=medium, dots_free=dots_free, outlier_sd=outlier_sd,
        cameras=list(dataset.rig.cameras),
    )  # fmt: skip
    if detected is None:
        detected = detect(dataset, stage=stage, pictures=pictures)
    table = dataset.dots() if detected is None else detected.dots
    notes = [*dataset.notes, *(() if detected is None else detected.notes)]

    from telerig.estimator.calibration.refractive_windows import (
        behind_windows,
        stated_windows,
        window_notes,
    )

    rig, walls = dataset.rig, stated_windows(dataset.rig)
    calibration = solve_dots(
        dataset, table, model=model, solver=solver, medium=medium, dots_free=dots_free,
        outlier_sd=outlier_sd, stage=stage, notes=notes,
    )  # fmt: skip
    calibration = replace(calibration, stage=_stage(dataset, calibration, stage), medium=medium)
    if medium == "air":
        calibration = behind_windows(calibration, walls)
    words = window_notes(calibration, rig)
    calibration = replace(calibration, notes=(*calibration.notes, *words))
    return CalibrationRun(_with_measured(calibration, table, seed), detected)


def solve_dots(
    dataset: Dataset,
    table: pd.DataFrame,
    *,
    model: Model,
    solver: str,
    medium: str,
    dots_free: str,
    outlier_sd: float = OUTLIER_SD,
    stage: Stage | None = None,
    notes: Sequence[str] = (),
) -> Calibration:
    """The self-calibration of a table of dots, without the stage and walls that runs go through."""
    from telerig.estimator.calibration.refractive_windows import stated_windows, with_windows
    from telerig.estimator.calibration.self_calibration import self_calibrate

    rig = dataset.rig
    cameras = nominal_cameras(rig)
    return self_calibrate(
        table,
        with_windows(cameras, stated_windows(rig)) if medium == "water" else cameras,
        dataset.target,
        nominal_rotvec_deg=rig.rotvec_from_first_deg,
        model=model,
        dots_free=dots_free,
        solver=solver,
        outlier_sd=outlier_sd,
        progress=None if stage is None else lambda i, _: stage("solve", i, 0),
        notes=notes,
        name=rig.name,
    )


def detect(
    dataset: Dataset, *, stage: Stage | None = None, pictures: bool = False
) -> DatasetDots | None:
    """The dots of a dataset's images; None where it brings a table of dots instead.

    pictures : as for `run_calibration`.
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
    """Load what comes after the detection while other processes detect."""
    import gtsam  # noqa: F401


def _stage(dataset: Dataset, calibration: Calibration, stage: Stage | None) -> dict[str, Any]:
    """Travel axis and encoder scale from `stage_axis/`; empty without it, or a usable rig."""
    from telerig.estimator.calibration.stage.stage_axis import stage_axis_from

    if calibration.verdict["status"] == "REJECTED":
        return {}
    if stage is not None:
        stage("stage axis", 0, 0)
    found = stage_axis_from(dataset, calibration)
    return {} if found is None else found.as_dict()


def _with_measured(calibration: Calibration, table: pd.DataFrame, seed: int) -> Calibration:
    """Put the covariance and chi-square of the image fit beside the dots; record the seed."""
    columns = ["suu_px2", "suv_px2", "svv_px2", "chi2_dof"]
    measured = table.reindex(columns=["view", "camera", "dot", *columns]).copy()
    measured["view"] = measured["view"].astype(str)
    dots = calibration.dots.merge(measured, on=["view", "camera", "dot"], how="left")
    dots["chi2_dof"] = dots["chi2_dof"].astype(float)
    return replace(calibration, dots=dots, statistics={**calibration.statistics, "seed": seed})
