"""The folder `stage_axis/` of a dataset: positions.csv beside dots.csv or images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.estimator.calibration.stage.stage_axis import StageAxis, stage_axis_of
from telerig.io.dataset.dataset import Dataset, View
from telerig.io.dataset.tables import read_dots_csv
from telerig.io.files.csv_table import Column, read_table
from telerig.io.images.read import list_images, natural

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.calibration.result.calibration import Calibration

Array = NDArray[np.float64]

FOLDER = "stage_axis"
_POSITIONS = "positions.csv"
_CONTRADICTION_DEG = 10.0


def stage_axis_from(dataset: Dataset, calibration: Calibration) -> StageAxis | None:
    """The stage as `stage_axis/` shows it; None when the dataset has no such folder.

    Raises InputError for a folder without positions.csv, with neither or both of images and
    dots.csv, and what `stage_axis_of` raises. Words tell when rig.toml states another direction.
    """
    folder = dataset.path / FOLDER
    if not folder.is_dir():
        return None
    positions = _positions(folder)
    described = dataset.rig.stage
    found = stage_axis_of(
        calibration,
        _dots(dataset, folder),
        positions,
        position_sigma_mm=0.001 if described is None else described.position_sigma_mm,
    )
    if described is None:
        return found
    return replace(found, words=(*found.words, *_against(found.axis_rig, described.axis)))


def _positions(folder: Path) -> pd.DataFrame:
    file = folder / _POSITIONS
    if not file.is_file():
        raise InputError(
            f"there is no {_POSITIONS}", where=str(folder), todo="write view,position_mm"
        )
    return read_table(file, [Column("view", "text"), Column("position_mm")])


def _dots(dataset: Dataset, folder: Path) -> pd.DataFrame:
    table = folder / "dots.csv"
    views = _image_views(dataset, folder)
    if table.is_file() == bool(views):
        what = "both images and dots.csv" if views else "neither images nor dots.csv"
        raise InputError(
            f"holds {what}",
            where=str(folder),
            todo=f"keep one of them: {FOLDER}/<camera>/<view>.tif or {FOLDER}/dots.csv",
        )
    if not views:
        return read_dots_csv(table, dataset.rig)
    from telerig.estimator.dots.dataset_dots import detect_dataset

    return detect_dataset(replace(dataset, views=views, source="images", table=None)).dots


def _image_views(dataset: Dataset, folder: Path) -> tuple[View, ...]:
    paths: dict[str, dict[str, Path]] = {}
    for camera in dataset.rig.cameras:
        for file in list_images(folder / camera) if (folder / camera).is_dir() else ():
            paths.setdefault(file.stem, {})[camera] = file
    return tuple(View(name, paths[name]) for name in sorted(paths, key=natural))


def _against(axis: Array, stated: tuple[float, float, float]) -> list[str]:
    angle = float(np.degrees(np.arccos(np.clip(axis @ np.asarray(stated), -1, 1))))
    if angle < _CONTRADICTION_DEG:
        return []
    direction = ", ".join(f"{v:.3f}" for v in axis)
    return [
        f"rig.toml states a travel direction {angle:.0f} deg away from the measured one: "
        + ("turn its sign" if angle > 180 - _CONTRADICTION_DEG else f"write ({direction})")
    ]
