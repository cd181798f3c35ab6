"""The cameras that a run was tracked with, from the files of its results."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from telerig.arrays import Array, Ints
from telerig.io.report.run.tracking.results import TrackResults
from telerig.io.results.calibration import CalibrationFile
from telerig.io.results.tracking import POINT, SILHOUETTES
from telerig.rig.camera import Camera
from telerig.rig.triangulation import midpoint

_AGREE_MM, _NEAR_MM = 1e-4, 0.02


def run_cameras(folder: Path, results: TrackResults) -> tuple[tuple[Camera, Camera] | None, str]:
    """The two cameras, or None and the reason in words.

    calibration.json is looked for in the run's results folder and in `calibration/` beside it.
    It counts only if the rays of the pixels in tracks.csv meet where that table says, so another
    calibration is not taken for the run's.
    Raises InputError for a calibration.json that cannot be read.
    """
    places = (folder, folder.resolve().parent / "calibration")
    file = next(
        (p / "calibration.json" for p in places if (p / "calibration.json").is_file()), None
    )
    if file is None:
        return None, "calibration.json is neither in this folder nor in calibration/ beside it"
    stated = CalibrationFile.read(file)
    known = {camera.name: camera for camera in stated.rig_cameras(behind_walls=True)}
    if len(results.cameras) != 2 or not set(results.cameras) <= set(known):
        return None, f"calibration.json beside it has cameras {', '.join(known)}, not the run's"
    cameras = (known[results.cameras[0]], known[results.cameras[1]])
    return (cameras, "") if _agree(results, cameras) else (
        None, "calibration.json beside it is not the one that the run was tracked with"
    )  # fmt: skip


def pair_pixels(results: TrackResults, rows: Ints) -> list[Array]:
    """Per camera (N, 2), the outlines' centres."""
    return [results.tracks[[f"{c}_u_px", f"{c}_v_px"]].to_numpy(float)[rows]
            for c in results.cameras]  # fmt: skip


def paired_rows(results: TrackResults) -> Ints:
    """Rows of tracks.csv that both cameras measured."""
    every = np.arange(len(results.tracks))
    good = np.isfinite(results.tracks["ray_miss_mm"].to_numpy(float))
    for uv in pair_pixels(results, every):
        good &= np.isfinite(uv).all(1)
    return np.flatnonzero(good)


def _agree(results: TrackResults, cameras: tuple[Camera, Camera]) -> bool:
    """Whether the rays miss each other as tracks.csv says, and meet where it says."""
    rows = paired_rows(results)
    if not len(rows):
        return True
    rays = [camera.unproject(uv) for camera, uv in zip(cameras, pair_pixels(results, rows))]
    middle, miss = midpoint(*rays[0], *rays[1])
    stated = results.tracks["ray_miss_mm"].to_numpy(float)[rows]
    names = SILHOUETTES if set(SILHOUETTES) <= set(results.tracks) else POINT
    away = np.linalg.norm(middle - results.tracks[list(names)].to_numpy(float)[rows], axis=1)
    if np.median(np.abs(miss - stated)) > _AGREE_MM:
        return False
    return bool(np.nanmedian(away) < _NEAR_MM + np.median(np.abs(stated)))
