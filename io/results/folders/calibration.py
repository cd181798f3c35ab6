"""What a calibration's results folder holds, read and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import pandas as pd

from telerig.arrays import Array, Ints
from telerig.errors import InputError
from telerig.io.files.csv_table import read_table, rows_of
from telerig.io.files.names import absent
from telerig.io.results.calibration import (
    CalibrationFile,
    ComparisonFile,
    covariance_file,
    read_joint_covariance,
    read_uncertainty,
)
from telerig.io.results.findings import Status
from telerig.io.results.manifest import reading
from telerig.io.results.record import RunFile
from telerig.io.tables.calibration import DOTS, REJECTED, RESIDUALS
from telerig.io.tables.table import EDGE_COVARIANCE, PIXEL_COVARIANCE, covariance_of_image
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

KEPT_WEIGHT = 0.5
"""A dot counts as kept above this weight."""


@dataclass(frozen=True)
class CalibrationResults:
    """The results folder of a calibration; each file is read and checked when it is asked for.

    name : of its calibration.json.
    Reading raises InputError for what is missing, cannot be read or does not fit together.
    """

    folder: Path
    name: str = "calibration.json"

    FILES: ClassVar[tuple[str, ...]] = (
        "calibration.json", "residuals.csv", "dots.csv", "covariance.npz", "run.json",
        "uncertainty.npz", "comparison.json",
    )  # fmt: skip

    @classmethod
    def at(cls, place: Path) -> Self:
        """Return the results in a folder or of a dataset, or those whose calibration.json is given.

        Raises InputError where nothing is there.
        """
        if not place.exists():
            raise absent(place, "calibration", f"run `{CalibrationFile.MAKE}` first")
        own = place / "results" / "calibration"
        if not (place / cls.name).is_file() and (own / cls.name).is_file():
            return cls(own)
        return cls(place) if place.is_dir() else cls(place.parent, place.name)

    @property
    def path(self) -> Path:
        """Return the path of calibration.json."""
        return self.folder / self.name

    @cached_property
    def file(self) -> CalibrationFile:
        """calibration.json."""
        return CalibrationFile.read(self.path)

    @property
    def content(self) -> Mapping[str, Any]:
        """calibration.json as it stands."""
        return self.file.content()

    @cached_property
    def rig(self) -> tuple[Camera, ...]:
        """The cameras, which look through their refractive windows into the water."""
        return self.file.rig_cameras(windows=True)

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras as they saw the target: without windows if it was in air."""
        return self.file.rig_cameras(windows=self.file.medium == "water")

    @property
    def camera_names(self) -> list[str]:
        """Return the names of the cameras, in the rig's order."""
        return [*self.file.cameras]

    @cached_property
    def views(self) -> Mapping[str, Pose]:
        """rig_from_target by view."""
        return {name: pose.pose() for name, pose in self.file.views.items()}

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

    @cached_property
    def joint(self) -> tuple[tuple[str, ...], Array]:
        """Names and covariance (P, P) of all P parameters, from `covariance_file`; empty without
        it.

        It has to contain the covariance of the rig that calibration.json states. A calibration of
        another name that has no file of its own takes a covariance.npz that does.
        """
        place = covariance_file(self.path)
        own = place.is_file() or self.name == CalibrationResults.name
        place = place if own else self.folder / "covariance.npz"
        names, joint = read_joint_covariance(place)
        rig = None if self.file.covariance is None else self.file.covariance.matrix
        if names and rig is not None:
            block = joint[: len(rig), : len(rig)]
            if block.shape != rig.shape or not np.allclose(block, rig, rtol=1e-9, atol=0):
                if not own:
                    return (), np.zeros((0, 0))
                raise InputError(
                    "this covariance belongs to another calibration than the calibration.json "
                    "beside it",
                    where=str(place),
                    todo="copy both files together, or delete covariance.npz",
                )
        return names, joint

    @cached_property
    def target_covariance(self) -> Array | None:
        """(3, N, N) of the dots' coordinates x, y, z, in mm²; None where it is not known."""
        names, joint = self.joint
        place = {name: i for i, name in enumerate(names)}
        index = np.array(
            [[place.get(f"dot {dot}.{axis}_mm", -1) for dot in self.dot_ids] for axis in "xyz"]
        )
        if index.size == 0 or index.min() < 0:
            return None
        return np.array([joint[np.ix_(of, of)] for of in index])

    def has(self, name: str) -> bool:
        """Return whether the folder has a table of this calibration, which is calibration.json."""
        return self.name == CalibrationResults.name and (self.folder / name).is_file()

    def table(self, name: str) -> pd.DataFrame:
        """Return "dots.csv" or "residuals.csv" as it stands. Raises InputError if it is not there,
        or if calibration.json has been replaced since it was read."""
        place = self.folder / name
        if not self.has(name):
            alone = self.name != CalibrationResults.name
            what = f"is not of {self.name}, which was saved alone" if alone else "does not exist"
            raise InputError(what, where=str(place), todo=CalibrationFile.AGAIN)
        with reading(self.folder, (self.name, name)):
            if CalibrationFile.read(self.path).statistics != self.statistics:
                raise InputError(
                    "this calibration has been replaced since it was loaded",
                    where=str(self.path),
                    todo="load it again",
                )
            return (DOTS if name == "dots.csv" else RESIDUALS).read(place)

    @cached_property
    def residuals(self) -> pd.DataFrame:
        """residuals.csv with further columns.

        ``kept`` (bool) says whether the dot counts, ``length_px`` is the length of the residual.
        Where dots.csv states covariances, ``whitened_u`` and ``whitened_v`` are the residual in
        units of its standard deviation.
        """
        place = self.folder / "residuals.csv"
        if not place.is_file():
            imported = self.file.verdict.status == Status.IMPORTED
            raise InputError(
                "was imported, so it has no dots and residuals of which a report could be made"
                if imported
                else "the residuals are missing, a report cannot be made without them",
                where=str(self.path if imported else place),
                todo="use it as it is, or calibrate (`telerig calibrate`) for a report"
                if imported
                else CalibrationFile.AGAIN,
            )
        table = read_table(place, RESIDUALS.of(), extra=True)
        for column, known in (("camera", self.camera_names), ("view", list(self.views))):
            strange = ~table[column].isin(known).to_numpy()
            name = table[column][strange].iloc[0] if strange.any() else ""
            what = f"calibration.json has no {column} {name!r}"
            todo = "the files are of two calibrations; " + CalibrationFile.AGAIN
            rows_of(table, place).refuse(strange, column, what, todo)
        table = table.reset_index(drop=True)
        table["kept"] = table["weight"] > KEPT_WEIGHT
        table["length_px"] = np.hypot(table["du_px"], table["dv_px"])
        floor = self.statistics.get("noise_floor_px") or 0.0
        return _with_whitened(table, self.folder / "dots.csv", float(floor))

    @cached_property
    def row_column(self) -> Array:
        """(N, 2) of the dots, NaN where no residual names it."""
        known = self.residuals.drop_duplicates("dot").set_index("dot")[["row", "column"]]
        return known.reindex(self.dot_ids).to_numpy(float)

    @cached_property
    def rejected(self) -> pd.DataFrame:
        """rejected.csv; without rows where it is not there."""
        return REJECTED.read(self.folder / "rejected.csv", optional=True)

    @cached_property
    def run(self) -> Mapping[str, Any]:
        """run.json."""
        return RunFile.read_if_there(self.folder / "run.json").content()

    @cached_property
    def uncertainty(self) -> Mapping[str, Array]:
        """Arrays of uncertainty.npz; empty without it."""
        return read_uncertainty(self.folder / "uncertainty.npz")

    @cached_property
    def comparison(self) -> ComparisonFile:
        """comparison.json."""
        return ComparisonFile.read_if_there(self.folder / "comparison.json")

    @cached_property
    def overlays(self) -> Mapping[tuple[str, str], Path]:
        """Picture by (camera, view)."""
        named = {
            (camera, view): self.folder / "overlays" / camera / f"{view}.jpg"
            for view in self.views
            for camera in self.camera_names
        }
        return {key: file for key, file in named.items() if file.is_file()}

    @property
    def absent(self) -> tuple[str, ...]:
        """What optional files are missing, in words."""
        there = {
            "dots.csv with covariances (residuals are shown in px only)":
                "whitened_u" in self.residuals,
            "covariance.npz (no standard deviations of the target's shape)": bool(self.joint[0]),
            "run.json (no versions, no options)": bool(self.run),
            "overlays/ (no pictures of the dots that were found)": bool(self.overlays),
        }  # fmt: skip
        return tuple(text for text, present in there.items() if not present)


def read_calibration_results(folder: Path) -> CalibrationResults:
    """Read a calibration's results folder for a page or the viewer.

    calibration.json and residuals.csv are needed; what else is there is used. Raises InputError for
    what is missing, cannot be read or does not fit together.
    """
    results = CalibrationResults(folder)
    with reading(folder, CalibrationResults.FILES):
        _ = results.cameras, results.views, results.row_column, results.joint, results.run
        _ = results.uncertainty, results.comparison
    return results


def _with_whitened(table: pd.DataFrame, file: Path, floor_px: float) -> pd.DataFrame:
    """Return residuals in units of the dots' own covariance, the common noise floor added to it."""
    if not file.is_file():
        return table
    names = list(PIXEL_COVARIANCE)
    dots = DOTS.read(file)
    if not set(names) <= set(dots.columns):
        return table
    keys = ["view", "camera", "dot"]
    kept = [name for name in (*names, *EDGE_COVARIANCE) if name in dots]
    merged = table.merge(dots[keys + kept].drop_duplicates(keys), on=keys, how="left")
    uu, uv, vv = covariance_of_image(merged).T
    uu, vv = uu + floor_px**2, vv + floor_px**2
    if not np.all((uu > 0) & (uu * vv > uv**2)):
        return table
    du, dv = merged["du_px"].to_numpy(), merged["dv_px"].to_numpy()
    across = np.sqrt(vv - uv**2 / uu)
    return table.assign(whitened_u=du / np.sqrt(uu), whitened_v=(dv - uv / uu * du) / across)
