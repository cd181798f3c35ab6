"""What a calibration's results folder holds, read and checked for its report."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.io.files.csv_table import Column, read_table
from telerig.io.report.page.results_files import check_kind, read_object
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.projection import intrinsics_from
from telerig.rig.windows import Wall

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

SCHEMA = 1
KEPT_WEIGHT = 0.5
"""A dot counts as kept above this weight."""
_AGAIN = "calibrate again (`telerig calibrate`), or name the right results folder"
_UNCERTAINTY = ("points_mm", "calibration_mm2", "measurement_mm2", "sigma_px")
_DOT_EXAMPLE = ("patch", "model", "u0", "v0", "u_px", "v_px", "a_px", "b_px", "angle_rad", "noise")


@dataclass(frozen=True)
class CalibrationResults:
    """A results folder in memory.

    content : calibration.json as it stands.
    views : view name -> rig_from_target.
    dot_ids : (N,); points_mm : (N, 3) in the target's frame; row_column : (N, 2), NaN where no
        residual names the dot.
    residuals : residuals.csv with ``kept`` and ``length_px`` added, and ``whitened_u``,
        ``whitened_v`` when dots.csv states every dot's covariance.
    component : name of a component -> its place in ``joint``, the whole covariance.
    overlays : (camera, view) -> picture.
    dot_example, uncertainty : arrays of dot_example.npz and uncertainty.npz, or empty.
    comparison : comparison.json with an earlier calibration, or empty.
    absent : what optional files are missing, in words.
    """

    content: Mapping[str, Any]
    cameras: tuple[Camera, ...]
    views: Mapping[str, Pose]
    dot_ids: NDArray[np.int64]
    points_mm: Array
    row_column: Array
    residuals: pd.DataFrame
    component: Mapping[str, int]
    joint: Array
    run: Mapping[str, Any]
    overlays: Mapping[tuple[str, str], Path]
    dot_example: Mapping[str, Array]
    uncertainty: Mapping[str, Array]
    comparison: Mapping[str, Any]
    absent: tuple[str, ...]

    @property
    def statistics(self) -> Mapping[str, Any]:
        return dict(self.content.get("statistics") or {})

    @property
    def camera_names(self) -> list[str]:
        return [camera.name for camera in self.cameras]


def read_results(folder: Path) -> CalibrationResults:
    """Read a calibration's results folder.

    calibration.json and residuals.csv are needed; dots.csv, covariance.npz, run.json,
    uncertainty.npz, comparison.json, overlays/<camera>/<view>.jpg and dot_example.npz are used
    when they are there.
    Raises InputError for what is missing, cannot be read or does not fit together.
    """
    content = _content(folder / "calibration.json")
    try:
        in_water = content.get("medium") == "water"
        cameras = _cameras(content, behind_walls=in_water)
        views = {name: _pose(p) for name, p in content["views"].items()}
        dot_ids = np.array(content["target"]["dots"], np.int64)
        points = np.array(content["target"]["points_mm"], float).reshape(len(dot_ids), 3)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise _broken(folder / "calibration.json", f"lacks or garbles {error}") from error
    residuals = _residuals(folder, cameras, views, content)
    component, joint = _covariance(folder / "covariance.npz")
    example = _dot_example(folder / "dot_example.npz")
    run, comparison = (_optional(folder / name) for name in ("run.json", "comparison.json"))
    overlays = _overlays(folder / "overlays", cameras, views)
    absent = _absent(residuals, joint, run, overlays, example)
    rows = _row_column(residuals, dot_ids)
    return CalibrationResults(
        content, cameras, views, dot_ids, points, rows, residuals, component, joint, run,
        overlays, example, _uncertainty(folder / "uncertainty.npz"), comparison, absent,
    )  # fmt: skip


def read_cameras(file: Path) -> tuple[Camera, ...]:
    """The cameras of a calibration.json, behind the walls through which runs are taken.

    Raises InputError when it cannot be read.
    """
    try:
        return _cameras(_content(file), behind_walls=True)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise _broken(file, f"lacks or garbles {error}") from error


def _broken(file: Path, what: str) -> InputError:
    return InputError(what, where=str(file), todo=_AGAIN)


def _content(file: Path) -> Mapping[str, Any]:
    if not file.is_file():
        raise InputError(
            "no calibration here", where=str(file), todo="run `telerig calibrate DATASET` first"
        )
    content = read_object(file, _AGAIN)
    check_kind(content, file, "calibration", SCHEMA, _AGAIN)
    if not isinstance(content.get("verdict"), dict) or "status" not in content["verdict"]:
        raise _broken(file, "has no verdict")
    return content


def _cameras(content: Mapping[str, Any], *, behind_walls: bool) -> tuple[Camera, ...]:
    stated = content.get("walls", {}) if behind_walls else {}
    walls = {name: Wall.from_dict(data) for name, data in stated.items()}
    return tuple(_camera(name, c, walls.get(name)) for name, c in content["cameras"].items())


def _camera(name: str, content: Mapping[str, Any], wall: Wall | None = None) -> Camera:
    width, height = (int(n) for n in content["image_size_px"])
    intrinsics = intrinsics_from(content["parameters"])
    pose = _pose(content["camera_from_rig"])
    return Camera(name, (width, height), float(content["rho_mm"]), intrinsics, pose, wall)


def _pose(content: Mapping[str, Any]) -> Pose:
    rotation = np.array(content["rotation"], float).reshape(3, 3)
    return Pose(rotation, np.array(content["translation_mm"], float).reshape(3))


def _residuals(
    folder: Path, cameras: tuple[Camera, ...], views: Mapping[str, Pose], content: Mapping[str, Any]
) -> pd.DataFrame:
    columns = [
        *(Column(name, "text") for name in ("view", "camera")),
        *(Column(name, "whole") for name in ("dot", "row", "column")),
        *(Column(name) for name in ("u_px", "v_px", "du_px", "dv_px", "weight")),
        Column("reason", "text", blank=True),
    ]
    file = folder / "residuals.csv"
    if not file.is_file():
        raise _broken(file, "the residuals are missing, a report cannot be made without them")
    table = read_table(file, columns, extra=True)
    for column, known in (("camera", [c.name for c in cameras]), ("view", list(views))):
        strange = table[column][~table[column].isin(known)]
        if len(strange):
            raise InputError(
                f"calibration.json has no {column} {strange.iloc[0]!r}",
                where=f"{file} row {strange.index[0]}",
                todo="the files are of two calibrations; " + _AGAIN,
            )
    table = table.reset_index(drop=True)
    table["kept"] = table["weight"] > KEPT_WEIGHT
    table["length_px"] = np.hypot(table["du_px"], table["dv_px"])
    floor = (content.get("statistics") or {}).get("noise_floor_px") or 0.0
    return _with_whitened(table, folder / "dots.csv", float(floor))


def _with_whitened(table: pd.DataFrame, file: Path, floor_px: float) -> pd.DataFrame:
    """Residuals in units of the dots' own covariance, the common noise floor added to it."""
    if not file.is_file():
        return table
    names = ["suu_px2", "suv_px2", "svv_px2"]
    text = [Column(name, "text") for name in ("view", "camera")]
    columns = [*text, Column("dot", "whole"), *(Column(n, required=False) for n in names)]
    dots = read_table(file, columns, extra=True)
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


def _covariance(file: Path) -> tuple[dict[str, int], Array]:
    if not file.is_file():
        return {}, np.zeros((0, 0))
    archive = _arrays(file, ("names", "covariance"))
    names, joint = archive["names"].tolist(), archive["covariance"]
    if joint.shape != (len(names), len(names)):
        raise _broken(file, f"{len(names)} names, but a covariance of shape {joint.shape}")
    return {str(name): i for i, name in enumerate(names)}, joint


def _arrays(file: Path, names: tuple[str, ...]) -> dict[str, Any]:
    try:
        with np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in names}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise _broken(file, f"cannot be read: {error}") from error
    except KeyError as error:
        raise _broken(file, f"lacks an array: {error.args[0]}") from error


def _dot_example(file: Path) -> dict[str, Array]:
    if not file.is_file():
        return {}
    arrays = {name: np.asarray(a, float) for name, a in _arrays(file, _DOT_EXAMPLE).items()}
    patch, model = arrays["patch"], arrays["model"]
    if patch.ndim != 2 or patch.shape != model.shape or min(patch.shape) < 3:
        raise _broken(file, f"patch {patch.shape} and model {model.shape} are no pair of images")
    return arrays


def _optional(file: Path) -> Mapping[str, Any]:
    return read_object(file, _AGAIN) if file.is_file() else {}


def _uncertainty(file: Path) -> dict[str, Array]:
    if not file.is_file():
        return {}
    arrays = {name: np.asarray(a, float) for name, a in _arrays(file, _UNCERTAINTY).items()}
    count = len(np.atleast_1d(arrays["points_mm"]))
    shapes = [(count, 3), (count, 3, 3), (count, 3, 3), ()]
    if [arrays[name].shape for name in _UNCERTAINTY] != shapes or count < 1:
        raise _broken(file, "its arrays do not fit together")
    return arrays


def _overlays(
    folder: Path, cameras: tuple[Camera, ...], views: Mapping[str, Pose]
) -> dict[tuple[str, str], Path]:
    found = {(c.name, view): folder / c.name / f"{view}.jpg" for view in views for c in cameras}
    return {key: file for key, file in found.items() if file.is_file()}


def _row_column(residuals: pd.DataFrame, dot_ids: NDArray[np.int64]) -> Array:
    known = residuals.drop_duplicates("dot").set_index("dot")[["row", "column"]]
    return known.reindex(dot_ids).to_numpy(float)


def _absent(
    residuals: pd.DataFrame, joint: Array, run: object, overlays: object, example: object
) -> tuple[str, ...]:
    words = {
        "dots.csv with covariances (residuals are shown in px only)": "whitened_u" in residuals,
        "covariance.npz (no standard deviations of the target's shape)": bool(joint.size),
        "run.json (no versions, no hashes of what went in)": bool(run),
        "overlays/ (no pictures of the dots that were found)": bool(overlays),
        "dot_example.npz (no picture of a dot and its fit)": bool(example),
    }
    return tuple(text for text, present in words.items() if not present)
