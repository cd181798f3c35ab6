"""`telerig.simulate`: datasets with known truth, a calibration or a run with its calibration."""

from __future__ import annotations

import math
import tempfile
from os import PathLike
from pathlib import Path

import numpy as np

from telerig.errors import InputError, need_kind
from telerig.io.dataset.dataset import Dataset, load_dataset
from telerig.io.files.atomic import atomic_folder
from telerig.io.machine.room import check_room
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
    target fulfils, for more than the computer has room for, or for a folder that is not empty.
    """
    todo = "give numpy.random.default_rng(seed)"
    need_kind(rng, "bit_generator", "telerig.simulate, rng", todo)
    settings = any_preset(config) if isinstance(config, str) else config
    _check_room(settings, Path(tempfile.gettempdir() if out is None else out), images=images)
    final = _new_folder(out)
    with atomic_folder(final) as folder:
        if isinstance(settings, RunConfig):
            write_run_dataset(settings, folder, rng, images=images)
        else:
            write_calibration(settings, folder, rng, images=images)
    return load_dataset(final)


_FRAME_BYTES, _BUBBLE_BYTES, _MARK_BYTES = 6000, 600, 150
"""Memory for each camera in a frame, and for each bubble and mark that it sees there."""
_PATH_BYTES = 8 * 12
"""Memory for a bubble in a frame, in view or not: places and velocities, twice."""
_FRAME_DISK, _BUBBLE_DISK, _MARK_DISK, _VIEW_DISK = 100, 300, 30, 500
"""Bytes on the disk for each of these in tables, and for a camera in a view of the target. All are
a little less than what `rise`, `swarm` and `S1` take."""


def _check_room(settings: SimulationConfig | RunConfig, folder: Path, *, images: bool) -> None:
    """Raise InputError for a dataset that this computer has no room for."""
    run = settings if isinstance(settings, RunConfig) else None
    calibration = settings if isinstance(settings, SimulationConfig) else settings.calibration
    pixels = [math.prod(camera.image_size_px) for camera in calibration.cameras]
    views = calibration.views + (run.stage.axis_views if run else 0)
    depth = 1 + (calibration.bit_depth > 8)
    disk = views * sum(depth * size if images else _VIEW_DISK for size in pixels)
    memory = 0.0
    if run is not None:
        seen = run.frames * len(pixels)
        drawn = run.strip.dots if run.strip and images else 0
        marks = 0 if drawn else run.table.references
        rise = abs(1 - run.stage.follow) * sum(run.motion.rise_mm_s) / 2
        first = calibration.cameras[0]
        height_mm = first.image_size_px[1] / first.nominal_scale_px_per_mm
        every = run.bubbles * (1 + rise * run.frames / run.frame_rate_hz / height_mm)
        memory = seen * (_FRAME_BYTES + _BUBBLE_BYTES * run.bubbles + _MARK_BYTES * marks)
        memory += run.frames * _PATH_BYTES * every + len(pixels) * _MARK_BYTES * drawn
        disk += seen * (_FRAME_DISK + _BUBBLE_DISK * run.bubbles + _MARK_DISK * marks)
        if images:
            disk += run.frames * sum(pixels) * (1 + (run.image.bit_depth > 8))
    check_room(
        f"simulation {settings.name!r}", "ask for fewer frames, views, bubbles or marks",
        memory=memory, disk=disk, folder=folder,
    )  # fmt: skip


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
