"""`telerig.simulate`: datasets with known truth, a calibration or a run with its calibration."""

from __future__ import annotations

import tempfile
from os import PathLike
from pathlib import Path

import numpy as np

from telerig.errors import InputError
from telerig.io.dataset.dataset import Dataset, load_dataset
from telerig.io.files.atomic import atomic_folder
from telerig.io.simulation.calibration_files import write_calibration
from telerig.io.simulation.config import RunConfig, SimulationConfig
from telerig.io.simulation.presets import any_preset
from telerig.io.simulation.run_files import write_run_dataset


def simulate(
    config: str | SimulationConfig | RunConfig,
    *,
    rng: np.random.Generator,
    out: str | PathLike[str] | None = None,
    images: bool = True,
) -> Dataset:
    """Write a dataset with known truth and load it: a calibration, or a run with its calibration.

    config : the name of a preset, or a configuration (`telerig.io.simulation.presets`).
    rng : random generator; the same seed gives the same files. With and without images, the rig,
        the target, the poses and the bubbles are the same.
    out : a new or empty folder; None makes a temporary one, which the caller may delete.
    images : whether TIFF images are rendered; otherwise dots.csv and detections.csv are written,
        with the true centres plus noise.

    Returns the dataset. Raises InputError for an unknown preset, for conditions that no pose of the
    target fulfils, or for a folder that is not empty.
    """
    settings = any_preset(config) if isinstance(config, str) else config
    final = _new_folder(out)
    with atomic_folder(final) as folder:
        if isinstance(settings, RunConfig):
            write_run_dataset(settings, folder, rng, images=images)
        else:
            write_calibration(settings, folder, rng, images=images)
    return load_dataset(final)


def _new_folder(out: str | PathLike[str] | None) -> Path:
    if out is None:
        return Path(tempfile.mkdtemp(prefix="telerig-"))
    folder = Path(out)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "exists and is not empty: a simulated dataset is written into a new or empty folder",
            where=str(folder),
            todo="choose another folder with --out, or delete this one first",
        )
    return folder
