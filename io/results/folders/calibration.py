"""What a calibration's results folder holds, read and checked for its report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array, Ints
from telerig.errors import InputError
from telerig.io.files.csv_table import read_table, rows_of
from telerig.io.results.calibration import (
    CalibrationFile,
    ComparisonFile,
    read_joint_covariance,
    read_uncertainty,
)
from telerig.io.results.findings import Status
from telerig.io.results.manifest import reading
from telerig.io.results.record import RunFile
from telerig.io.tables.calibration import DOTS, RESIDUALS
from telerig.io.tables.table import PIXEL_COVARIANCE
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

KEPT_WEIGHT = 0.5
"""A dot counts as kept above this weight."""


_FILES = (
    "calibration.json", "residuals.csv", "dots.csv", "covariance.npz", "run.json",
    "uncertainty.npz", "comparison.json",
)  # fmt: skip


@dataclass(frozen=True)
class CalibrationResults:
    """A results folder in memory; what optional files are missing is in ``absent``.

    views : rig_from_target by view.
    row_column : (N, 2) of the dots, NaN where no residual names it.
    residuals : with ``kept`` and ``length_px``, and ``whitened_u``, ``whitened_v`` when dots.csv
        states covariances.
    component : place in ``joint``, the whole covariance, by name.
    overlays : picture by (camera, view).
    uncertainty : arrays, or empty.
    """

    file: CalibrationFile
    cameras: tuple[Camera, ...]
    views: Mapping[str, Pose]
    row_column: Array
    residuals: pd.DataFrame
    component: Mapping[str, int]
    joint: Array
    run: Mapping[str, Any]
    overlays: Mapping[tuple[str, str], Path]
    uncertainty: Mapping[str, Array]
    comparison: ComparisonFile
    absent: tuple[str, ...]

    @property
    def content(self) -> Mapping[str, Any]:
        """calibration.json as it stands."""
        return self.file.content()

    @property
    def dot_ids(self) -> Ints:
        """(N,)."""
        return self.file.target.dots

    @property
    def points_mm(self) -> Array:
        """(N, 3) in the target's frame."""
        return self.file.target.points_mm

    @property
    def statistics(self) -> Mapping[str, Any]:
        """Return ``statistics`` of calibration.json."""
        return self.file.statistics

    @property
    def target_covariance(self) -> Array | None:
        """(3, N, N) of the dots' coordinates x, y, z, in mm²; None where it is not known."""
        index = np.array(
            [[self.component.get(f"dot {dot}.{axis}_mm", -1) for dot in self.dot_ids]
             for axis in "xyz"]
        )  # fmt: skip
        if index.size == 0 or index.min() < 0:
            return None
        return np.array([self.joint[np.ix_(of, of)] for of in index])

    @property
    def camera_names(self) -> list[str]:
        """Return the names of the cameras, in the rig's order."""
        return [camera.name for camera in self.cameras]


def read_calibration_results(folder: Path) -> CalibrationResults:
    """Read a calibration's results folder: calibration.json, residuals.csv, and what else is there.

    Raises InputError for what is missing, cannot be read or does not fit together.
    """
    with reading(folder, _FILES):
        return _read_calibration_results(folder)


def _read_calibration_results(folder: Path) -> CalibrationResults:
    file = CalibrationFile.read(folder / "calibration.json")
    cameras = file.rig_cameras(windows=file.medium == "water")
    views = {name: pose.pose() for name, pose in file.views.items()}
    residuals = _residuals(folder, cameras, views, file)
    names, joint = read_joint_covariance(folder / "covariance.npz")
    component = {name: i for i, name in enumerate(names)}
    run = RunFile.read_if_there(folder / "run.json")
    comparison = ComparisonFile.read_if_there(folder / "comparison.json")
    overlays = _overlays(folder / "overlays", cameras, views)
    words = {
        "dots.csv with covariances (residuals are shown in px only)": "whitened_u" in residuals,
        "covariance.npz (no standard deviations of the target's shape)": bool(joint.size),
        "run.json (no versions, no options)": bool(run.content()),
        "overlays/ (no pictures of the dots that were found)": bool(overlays),
    }
    absent = tuple(text for text, present in words.items() if not present)
    return CalibrationResults(
        file,
        cameras,
        views,
        _row_column(residuals, file.target.dots),
        residuals,
        component,
        joint,
        run.content(),
        overlays,
        read_uncertainty(folder / "uncertainty.npz"),
        comparison,
        absent,
    )


def _residuals(
    folder: Path, cameras: tuple[Camera, ...], views: Mapping[str, Pose], file: CalibrationFile
) -> pd.DataFrame:
    place = folder / "residuals.csv"
    if not place.is_file() and file.verdict.status == Status.IMPORTED:
        raise InputError(
            "was imported, so it has no dots and residuals of which a report could be made",
            where=str(folder / "calibration.json"),
            todo="use it as it is, or calibrate (`telerig calibrate`) for a report",
        )
    if not place.is_file():
        raise InputError(
            "the residuals are missing, a report cannot be made without them",
            where=str(place),
            todo=CalibrationFile.AGAIN,
        )
    table = read_table(place, RESIDUALS.of(), extra=True)
    for column, known in (("camera", [c.name for c in cameras]), ("view", list(views))):
        strange = ~table[column].isin(known).to_numpy()
        name = table[column][strange].iloc[0] if strange.any() else ""
        what = f"calibration.json has no {column} {name!r}"
        todo = "the files are of two calibrations; " + CalibrationFile.AGAIN
        rows_of(table, place).refuse(strange, column, what, todo)
    table = table.reset_index(drop=True)
    table["kept"] = table["weight"] > KEPT_WEIGHT
    table["length_px"] = np.hypot(table["du_px"], table["dv_px"])
    floor = file.statistics.get("noise_floor_px") or 0.0
    return _with_whitened(table, folder / "dots.csv", float(floor))


def _with_whitened(table: pd.DataFrame, file: Path, floor_px: float) -> pd.DataFrame:
    """Return residuals in units of the dots' own covariance, the common noise floor added to it."""
    if not file.is_file():
        return table
    names = list(PIXEL_COVARIANCE)
    dots = DOTS.read(file)
    if not set(names) <= set(dots.columns):
        return table
    keys = ["view", "camera", "dot"]
    merged = table.merge(dots[keys + names].drop_duplicates(keys), on=keys, how="left")
    uu, uv, vv = (merged[name].to_numpy() for name in names)
    uu, vv = uu + floor_px**2, vv + floor_px**2
    if not np.all((uu > 0) & (uu * vv > uv**2)):
        return table
    du, dv = merged["du_px"].to_numpy(), merged["dv_px"].to_numpy()
    across = np.sqrt(vv - uv**2 / uu)
    return table.assign(whitened_u=du / np.sqrt(uu), whitened_v=(dv - uv / uu * du) / across)


def _overlays(
    folder: Path, cameras: tuple[Camera, ...], views: Mapping[str, Pose]
) -> dict[tuple[str, str], Path]:
    found = {(c.name, view): folder / c.name / f"{view}.jpg" for view in views for c in cameras}
    return {key: file for key, file in found.items() if file.is_file()}


def _row_column(residuals: pd.DataFrame, dot_ids: Ints) -> Array:
    known = residuals.drop_duplicates("dot").set_index("dot")[["row", "column"]]
    return known.reindex(dot_ids).to_numpy(float)
