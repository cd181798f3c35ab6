"""`stage_axis/` of a dataset: dots.csv, images, and what is wrong with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile
from discs import polygon_centroid
from finding_codes import codes, only

import telerig
from telerig.errors import InputError
from telerig.estimator.calibration.calibrate import _with_stage
from telerig.estimator.calibration.result.calibration import Calibration, calibration_from_cameras
from telerig.estimator.calibration.stage_axis import stage_axis_from
from telerig.io.dataset.dataset import Dataset
from telerig.io.results.findings import Code
from telerig.io.rig_file.description import StageDescription
from telerig.io.rig_file.rig_file import read_rig_toml, write_rig_toml
from telerig.io.simulation.calibration.scene import true_cameras, true_target
from telerig.io.simulation.calibration_files import view_image
from telerig.io.simulation.presets import run_preset
from telerig.rig.pose import Pose, rotation_from_rotvec

pytestmark = pytest.mark.usefixtures("without_advice", "undrawn")

AXIS = np.array([0.01, -1.0, 0.02]) / np.linalg.norm([0.01, -1.0, 0.02])
TURN = rotation_from_rotvec([0.1, -0.7, 0.05])
POSE = Pose(TURN, np.array([0.5, -1.0, 2.0]) - TURN @ [14.0, 7.0, 0.0])
ANGLE = np.linspace(0, 2 * np.pi, 400, endpoint=False)
CIRCLE = np.stack([np.cos(ANGLE), np.sin(ANGLE), 0 * ANGLE], -1)
STOPS = {"low": -5.0, "middle": 0.0, "high": 5.0, "top": 8.0}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    config = run_preset("rise", frames=3)
    config = replace(config, calibration=replace(config.calibration, views=2))
    telerig.simulate(config, rng=np.random.default_rng(1), out=tmp_path / "d", images=False)
    (tmp_path / "d" / "stage_axis").mkdir()
    rows = pd.DataFrame({"view": list(STOPS), "position_mm": list(STOPS.values())})
    rows.to_csv(tmp_path / "d" / "stage_axis" / "positions.csv", index=False)
    return tmp_path / "d"


def calibration(dataset: Dataset) -> Calibration:
    """True cameras and the nominal target."""
    cameras = list(true_cameras(run_preset("rise").calibration).values())
    ids = dataset.target.ids()
    return replace(
        calibration_from_cameras(cameras, name="truth"),
        dot_ids=ids,
        target_points_mm=dataset.target.nominal_mm(ids),
    )


def dots(dataset: Dataset) -> pd.DataFrame:
    parts = []
    for view, stop in STOPS.items():
        ids = dataset.target.ids()
        places, radius = dataset.target.nominal_mm(ids), dataset.target.diameter_mm(ids) / 2
        for camera in calibration(dataset).cameras:
            uv = np.array([
                polygon_centroid(camera.project(POSE.apply(p + r * CIRCLE) - AXIS * stop / 1.01))
                for p, r in zip(places, radius)
            ])  # fmt: skip
            parts.append(
                pd.DataFrame(
                    {"view": view, "camera": camera.name, "dot": ids,
                     "u_px": uv[:, 0], "v_px": uv[:, 1], "sigma_px": 0.02}
                )
            )  # fmt: skip
    return pd.concat(parts)


def test_dots_and_positions(folder: Path) -> None:
    dataset = telerig.load_dataset(folder)
    dots(dataset).to_csv(folder / "stage_axis" / "dots.csv", index=False)
    found = stage_axis_from(dataset, calibration(dataset))
    np.testing.assert_allclose(found.axis_rig, AXIS, atol=1e-9)
    assert found.scale == pytest.approx(0.01, abs=1e-9)
    assert "STAGE_AXIS_FAR" not in codes(found)


def test_images(folder: Path) -> None:
    """Rendered with noise: the dots are detected, and the scale found within its error."""
    rng = np.random.default_rng(2)
    dataset = telerig.load_dataset(folder)
    config = replace(run_preset("rise").calibration, print_factor=0.0)
    target = true_target(config, rng)
    known = calibration(dataset)
    for camera in known.cameras:
        (folder / "stage_axis" / camera.name).mkdir()
        for view, stop in STOPS.items():
            pose = Pose(POSE.rotation, POSE.translation_mm - AXIS * stop / 1.01)
            image = view_image(config, camera, target, pose, rng)
            tifffile.imwrite(folder / "stage_axis" / camera.name / f"{view}.tif", image)
    found = stage_axis_from(dataset, known)
    assert found.scale == pytest.approx(0.01, abs=max(4 * found.scale_sd, 1e-4))
    assert found.scale_sd < 3e-4
    np.testing.assert_allclose(found.axis_rig, AXIS, atol=1e-3)

    dark = folder / "stage_axis" / "left" / "top.tif"
    tifffile.imwrite(dark, np.zeros_like(image))
    found = stage_axis_from(dataset, known)
    left_out = only(found, Code.LEFT_OUT)
    assert (left_out.views, left_out.cameras) == (("stage_axis/top",), ("left",))
    tifffile.imwrite(dark.with_suffix(".tiff"), image)
    with pytest.raises(InputError, match=r"top\.tif and top\.tiff are the same view twice"):
        stage_axis_from(dataset, known)


def test_a_folder_of_no_camera_is_refused(folder: Path) -> None:
    """As in calibration/: the images in it would be missing without a word."""
    dataset = telerig.load_dataset(folder)
    dots(dataset).to_csv(folder / "stage_axis" / "dots.csv", index=False)
    (folder / "stage_axis" / "rigth").mkdir()
    (folder / "stage_axis" / "readme.txt").write_text("of Monday", encoding="utf-8")
    with pytest.raises(InputError, match=r"no camera 'rigth'(.|\n)*right"):
        stage_axis_from(dataset, calibration(dataset))
    (folder / "stage_axis" / "rigth").rmdir()
    found = stage_axis_from(dataset, calibration(dataset))
    (note,) = (f.text for f in found.findings if f.code is Code.NOTE)
    assert note.startswith("stage_axis/readme.txt is not used")


def test_a_stage_that_runs_the_other_way(folder: Path) -> None:
    rig = read_rig_toml(folder / "rig.toml")
    stage = StageDescription((0, 1, 0), (0, -1, 0), 0.001)
    write_rig_toml(replace(rig, stage=stage), folder / "rig.toml")
    dataset = telerig.load_dataset(folder)
    dots(dataset).to_csv(folder / "stage_axis" / "dots.csv", index=False)
    found = stage_axis_from(dataset, calibration(dataset))
    assert only(found, Code.STAGE_AXIS_FAR).numbers["angle_deg"] > 178


def test_no_folder_no_stage_axis(folder: Path) -> None:
    (folder / "stage_axis").rename(folder / "elsewhere")
    dataset = telerig.load_dataset(folder)
    known = calibration(dataset)
    assert _with_stage(dataset, known, None) is known


def test_what_is_missing(folder: Path) -> None:
    dataset = telerig.load_dataset(folder)
    with pytest.raises(InputError, match="neither images nor dots"):
        stage_axis_from(dataset, calibration(dataset))
    dots(dataset).to_csv(folder / "stage_axis" / "dots.csv", index=False)
    (folder / "stage_axis" / "left").mkdir()
    tifffile.imwrite(folder / "stage_axis" / "left" / "low.tif", np.zeros((512, 512), np.uint8))
    with pytest.raises(InputError, match="both images and dots"):
        stage_axis_from(dataset, calibration(dataset))
    (folder / "stage_axis" / "positions.csv").unlink()
    with pytest.raises(InputError, match=r"no positions\.csv"):
        stage_axis_from(dataset, calibration(dataset))


def test_dots_of_another_target(folder: Path) -> None:
    dataset = telerig.load_dataset(folder)
    known = calibration(dataset)
    table = dots(dataset)
    table.to_csv(folder / "stage_axis" / "dots.csv", index=False)
    with pytest.raises(InputError, match="dots has a number that is in the calibration"):
        stage_axis_from(dataset, replace(known, dot_ids=known.dot_ids + 1000))
