"""OpenLPT's camera files against OpenCV's projection and against the formula written out."""

from __future__ import annotations

import shlex
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from finding_codes import codes
from numpy.typing import NDArray
from places import REAL
from typer.testing import CliRunner

import telerig
from telerig.errors import CalibrationError, InputError
from telerig.estimator.batch.work import load_with
from telerig.estimator.calibration.result.calibration import (
    calibration_for,
    calibration_from_cameras,
    load_calibration,
)
from telerig.io.exchange.importing.openlpt import read_openlpt_cameras
from telerig.io.results.manifest import read_manifest
from telerig.scripts.main import app

Array = NDArray[np.float64]

PAIR = REAL / "bubble_pair"
RIGHT_ANGLE = [
    np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
]


def rows(matrix: Array) -> str:
    return "\n".join(",".join(repr(float(v)) for v in row) for row in np.atleast_2d(matrix))


def text(
    rotation: Array,
    translation: Array,
    *,
    focal: tuple[float, float] = (20000.0, 20000.0),
    distortion: tuple[float, ...] = (0.0,) * 5,
    size: str = "800,1280",
) -> str:
    camera = np.array([[focal[0], 0, 640.0], [0, focal[1], 400.0], [0, 0, 1]])
    back = np.linalg.inv(rotation)
    rotvec = cv2.Rodrigues(rotation)[0].reshape(1, 3)
    parts = [
        ("Camera Model: (PINHOLE/POLYNOMIAL)", "PINHOLE"),
        ("Camera Calibration Error: ", "None"), ("Pose Calibration Error: ", "None"),
        ("Image Size: (n_row,n_col)", size), ("Camera Matrix: ", rows(camera)),
        ("Distortion Coefficients: ", rows(np.array([distortion]))),
        ("Rotation Vector: ", rows(rotvec)), ("Rotation Matrix: ", rows(rotation)),
        ("Inverse of Rotation Matrix: ", rows(back)),
        ("Translation Vector: ", rows(translation)),
        ("Inverse of Translation Vector: ", rows(-back @ translation)),
    ]  # fmt: skip
    return "".join(f"# {title}\n{values}\n" for title, values in parts)


def turned(rotvec: list[float], base: Array) -> Array:
    return np.asarray(cv2.Rodrigues(np.array(rotvec))[0] @ base)


def write_pair(
    folder: Path, distortion: tuple[float, ...] = (0.0,) * 5, sign: float = 1.0
) -> tuple[list[Path], list[tuple[Array, Array]]]:
    poses = [
        (turned([0.02, -0.03, 0.05], RIGHT_ANGLE[0]), np.array([0.5, -0.3, 500.0])),
        (turned([-0.04, 0.01, 0.02], RIGHT_ANGLE[1]), np.array([-0.7, 0.2, 450.0])),
    ]
    paths = [folder / "cam1.txt", folder / "cam2.txt"]
    for path, pose in zip(paths, poses):
        path.write_text(text(*pose, focal=(20000.0, sign * 20010.0), distortion=distortion))
    return paths, poses


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.3, 0.8, 0.002, -0.003, 1.5)])
def test_pixels_are_those_of_opencv(
    tmp_path: Path, sign: float, distortion: tuple[float, ...]
) -> None:
    paths, poses = write_pair(tmp_path, distortion, sign)
    cameras, rig_from_world, _ = read_openlpt_cameras(paths)
    world = np.random.default_rng(0).uniform(-12, 12, (200, 3))
    for camera, (rotation, translation) in zip(cameras, poses):
        k = np.array([[20000.0, 0, 640], [0, sign * 20010.0, 400], [0, 0, 1]])
        expected = cv2.projectPoints(
            world, cv2.Rodrigues(rotation)[0], translation, k, np.array(distortion)
        )[0].reshape(-1, 2)
        seen = camera.project(rig_from_world.apply(world))
        np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_cameras_are_right_handed_and_meet_at_the_rigs_origin(tmp_path: Path, sign: float) -> None:
    (first, second), rig_from_world, _ = read_openlpt_cameras(write_pair(tmp_path, sign=sign)[0])
    assert np.linalg.det(rig_from_world.rotation) == pytest.approx(sign)
    for camera in (first, second):
        assert np.linalg.det(camera.camera_from_rig.rotation) == pytest.approx(1)
        assert camera["scale_px_per_mm"] > 0 and camera["aspect"] > 0
        focal = camera["scale_px_per_mm"] / camera["kappa_per_mm"]
        assert focal == pytest.approx(20000.0, rel=1e-12)
    np.testing.assert_array_equal(first.camera_from_rig.rotation, np.eye(3))
    np.testing.assert_array_equal(first.camera_from_rig.translation_mm, 0)
    axis = second.rig_from_camera.rotation[:, 2]
    nearest = second.rig_from_camera.translation_mm
    assert nearest[2] == pytest.approx(0, abs=1e-9), "the axes' common perpendicular is at z = 0"
    assert nearest @ axis == pytest.approx(0, abs=1e-9)


def test_one_camera_alone(tmp_path: Path) -> None:
    paths, _ = write_pair(tmp_path)
    (camera,), rig_from_world, _ = read_openlpt_cameras(paths[:1], names=["top"])
    assert camera.name == "top" and camera.image_size_px == (1280, 800)
    assert camera["kappa_per_mm"] == pytest.approx(1 / 500, rel=1e-3)
    assert rig_from_world.apply(np.zeros((1, 3)))[0, 2] == pytest.approx(0, abs=1e-9)


def test_the_command_gives_names_and_keeps_how_to_make_the_folder_again(tmp_path: Path) -> None:
    paths, _ = write_pair(tmp_path)
    out = tmp_path / "imported"
    words = ["openlpt", *map(str, paths), "--out", str(out)]
    done = CliRunner().invoke(app, ["import", *words, "--names", "top, side"])
    assert done.exit_code == 0, done.output
    assert [c.name for c in telerig.load_calibration(out).cameras] == ["top", "side"]
    assert "[cameras.side]" in (out / "nominal.toml").read_text()
    made = read_manifest(out)
    assert made is not None
    assert made.sections["calibrate"].again == shlex.join(["telerig", "import", *words])
    few = CliRunner().invoke(app, ["import", *words, "--names", "top"])
    assert few.exit_code == 2 and "give 2 names" in few.output


def test_a_rotation_with_shear_is_kept_to_the_last_digit(tmp_path: Path) -> None:
    paths, poses = write_pair(tmp_path)
    rotation = poses[0][0] + np.random.default_rng(1).normal(0, 5e-4, (3, 3))
    paths[0].write_text(text(rotation, poses[0][1]))
    cameras, rig_from_world, _ = read_openlpt_cameras(paths)
    world = np.random.default_rng(0).uniform(-12, 12, (50, 3))
    homogeneous = (world @ rotation.T + poses[0][1]) @ np.diag([20000.0, 20000.0, 1])
    expected = homogeneous[:, :2] / homogeneous[:, 2:] + [640, 400]
    np.testing.assert_allclose(cameras[0].project(rig_from_world.apply(world)), expected, atol=1e-9)


@pytest.mark.skipif(not PAIR.is_dir(), reason="the real pair is not here")
def test_real_files_reproject_the_list_as_openlpt_does() -> None:
    cameras, rig_from_world, _ = read_openlpt_cameras([PAIR / "cam1.txt", PAIR / "cam2.txt"])
    world = pd.read_csv(PAIR / "bb3d_list.csv")[["WorldX", "WorldY", "WorldZ"]].to_numpy()
    for camera, name in zip(cameras, ("cam1.txt", "cam2.txt")):
        lines = (PAIR / name).read_text().splitlines()

        def block(first: int, count: int, lines: list[str] = lines) -> Array:
            return np.array([[float(v) for v in line.split(",")] for line in lines[first:][:count]])

        k, r, t = block(9, 3), block(17, 3), block(25, 1)[0]
        homogeneous = (world @ r.T + t) @ k.T
        seen = camera.project(rig_from_world.apply(world))
        np.testing.assert_allclose(seen, homogeneous[:, :2] / homogeneous[:, 2:], rtol=0, atol=1e-9)
    assert cameras[0]["scale_px_per_mm"] == pytest.approx(44.3, abs=0.1)
    assert cameras[1]["kappa_per_mm"] == pytest.approx(1 / 1176.4, rel=1e-3)


BAD = {
    "polynomial": (("PINHOLE\n", "POLYNOMIAL\n"), "POLYNOMIAL"),
    "a number that is none": (("20000.0,0.0,640.0", "20000.0,zero,640.0"), "cam1.txt:10"),
    "no image size": (("800,1280", "0,1280"), "image size"),
    "skewed camera matrix": (("0.0,20000.0,400.0", "0.5,20000.0,400.0"), "camera matrix"),
    "short": (("# Translation Vector: ", "# x\n# "), "translation"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_files_are_refused(tmp_path: Path, what: str) -> None:
    (old, new), word = BAD[what]
    good = text(RIGHT_ANGLE[0], np.array([0.0, 0, 500]))
    if what == "short":
        changed = good[: good.index("# Translation Vector")]
    else:
        changed = good.replace(old, new)
    assert changed != good
    path = tmp_path / "cam1.txt"
    path.write_text(changed)
    with pytest.raises(InputError, match=word):
        read_openlpt_cameras([path])


def test_what_cannot_be_expressed_is_refused(tmp_path: Path) -> None:
    paths, (_, two) = write_pair(tmp_path)
    paths[1].write_text(text(*two, distortion=(0.1, 0, 0, 0, 0, 0.01, 0, 0)))
    with pytest.raises(InputError, match="no exact counterpart"):
        read_openlpt_cameras(paths)
    paths[1].write_text(text(two[0] + 1e-3, two[1], distortion=(0.1, 0, 0, 0, 0)))
    with pytest.raises(InputError, match="shear"):
        read_openlpt_cameras(paths)
    paths[1].write_text(text(*two, focal=(20000.0, -20000.0)))
    with pytest.raises(InputError, match="mirrored"):
        read_openlpt_cameras(paths)
    paths[1].write_text(text(two[0], np.array([0.0, 0, -450])))
    with pytest.raises(InputError, match="behind"):
        read_openlpt_cameras(paths)
    paths[1].write_text(text(np.diag([1.0, 1, 0.5]), two[1]))
    with pytest.raises(InputError, match="is not a rotation"):
        read_openlpt_cameras(paths)
    with pytest.raises(InputError, match="does not exist"):
        read_openlpt_cameras([tmp_path / "nowhere.txt"])
    with pytest.raises(InputError, match="no camera files"):
        read_openlpt_cameras([])
    with pytest.raises(InputError, match="names"):
        read_openlpt_cameras([paths[0], paths[0]])


def test_imported_cameras_triangulate_and_survive_a_file(tmp_path: Path) -> None:
    cameras, *_ = read_openlpt_cameras(write_pair(tmp_path)[0])
    calibration = calibration_from_cameras(cameras, name="pair", sigma_px=0.2, notes=["cam1.txt"])
    points = np.random.default_rng(0).uniform(-10, 10, (7, 3))
    calibration.save(tmp_path / "out")
    for each in (calibration, load_calibration(tmp_path / "out")):
        pixels = each.project(0, points), each.project(1, points)
        found = each.triangulate(*pixels)
        np.testing.assert_allclose(found.points_mm, points, atol=1e-9)
        own = each.triangulate(*pixels, sigma_px=0.2, include_calibration=False)
        np.testing.assert_allclose(found.covariance_mm2, own.covariance_mm2, rtol=1e-12)
        assert codes(each) == ["NO_UNCERTAINTY", "NOTE"] and each.notes == ("cam1.txt",)
        np.testing.assert_array_equal(each.project_covariance(1, points), 0)


def test_imported_cameras_must_form_a_rig(tmp_path: Path) -> None:
    cameras, *_ = read_openlpt_cameras(write_pair(tmp_path)[0])
    with pytest.raises(CalibrationError, match="rig frame"):
        calibration_from_cameras(cameras[::-1])
    with pytest.raises(CalibrationError, match="named"):
        calibration_from_cameras([])
    with pytest.raises(CalibrationError, match="sigma_px"):
        calibration_from_cameras(cameras, sigma_px=0.0)


def test_tracking_takes_the_files_of_all_cameras(tmp_path: Path) -> None:
    """A run outside a dataset has the cameras of the calibration that have images."""
    files = []
    for i, angle in enumerate((0.0, 0.7, 1.4)):
        rotation = cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
        files.append(tmp_path / f"cam{i}.txt")
        files[-1].write_text(text(rotation, np.array([0.0, 0.0, 1000.0])), encoding="utf-8")
    run = tmp_path / "recorded"
    for name in ("cam0", "cam2"):
        (run / name).mkdir(parents=True)
        for k in range(2):
            cv2.imwrite(str(run / name / f"{k}.png"), np.zeros((800, 1280), np.uint8))
    (run / "run.toml").write_text("frame_rate_hz = 500.0")
    calibration, used = calibration_for(run, files)
    assert [camera.name for camera in calibration.cameras] == ["cam0", "cam1", "cam2"]
    assert used == files
    assert load_with(run, calibration, None).cameras == ("cam0", "cam2")
    with pytest.raises(InputError, match="OpenLPT camera files"):
        calibration_for(run, [*files, tmp_path / "calibration.json"])
