"""Imported cameras against OpenCV's projection and OpenPTV's formulas written out."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.exchange.importing.opencv import read_opencv_cameras
from telerig.io.exchange.importing.openptv import Sensor, read_openptv_cameras, read_ptv_par
from telerig.io.exchange.importing.pinhole import nominal_toml
from telerig.io.rig_file.rig_file import read_rig_toml

Array = NDArray[np.float64]

# ------------------------------------------------------------------------------------- OpenCV

MATRICES = [
    np.array([[9000.0, 0, 650], [0, 9010.0, 395], [0, 0, 1]]),
    np.array([[8800.0, 0, 630], [0, 8790.0, 410], [0, 0, 1]]),
]
ROTATION = cv2.Rodrigues(np.array([0.02, -1.2, 0.03]))[0]
TRANSLATION = np.array([420.0, 5.0, 280.0])
BROWN = np.array([-0.2, 0.5, 0.001, -0.002, 0.3])
PRISM = np.array([-0.2, 0.5, 0.001, -0.002, 0.3, 0, 0, 0, 0.004, -0.1, 0.003, 0.2])


def points_between() -> Array:
    """About the place where the axes of both cameras pass."""
    return np.random.default_rng(1).uniform(-15, 15, (100, 3)) + [0, 0, 450]


def write(path: Path, **content: Array | int) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in content.items():
        storage.write(name, value)
    storage.release()
    return path


@pytest.mark.parametrize("bent", [np.zeros(5), BROWN[:4], BROWN, PRISM])
@pytest.mark.parametrize("ending", [".yml", ".xml", ".json"])
def test_opencv_stereo_pixels_are_those_of_project_points(
    tmp_path: Path, bent: Array, ending: str
) -> None:
    size = {"image_width": 1280, "image_height": 800}
    intrinsics = write(
        tmp_path / f"intrinsics{ending}", M1=MATRICES[0], D1=bent, M2=MATRICES[1], D2=bent, **size
    )
    extrinsics = write(tmp_path / f"extrinsics{ending}", R=ROTATION, T=TRANSLATION)
    cameras, rig_from_world, _ = read_opencv_cameras([intrinsics, extrinsics])
    points = points_between()
    poses = [(np.zeros(3), np.zeros(3)), (cv2.Rodrigues(ROTATION)[0], TRANSLATION)]
    for camera, matrix, (turn, shift) in zip(cameras, MATRICES, poses):
        expected = cv2.projectPoints(points, turn, shift, matrix, bent)[0].reshape(-1, 2)
        seen = camera.project(rig_from_world.apply(points))
        np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-8)
        assert camera.image_size_px == (1280, 800)
    assert calibration_from_cameras(cameras, name="OpenCV").cameras[1].name == "right"


def test_opencv_one_file_for_each_camera_units_and_rotation_vector(tmp_path: Path) -> None:
    files = [
        write(tmp_path / f"{i}.yml", camera_matrix=m, distortion_coefficients=BROWN)
        for i, m in enumerate(MATRICES)
    ]
    files.append(write(tmp_path / "pair.yml", R=cv2.Rodrigues(ROTATION)[0], T=TRANSLATION / 1000))
    (_, right), rig_from_world, _ = read_opencv_cameras(
        files, image_size_px=(1280, 800), unit_mm=1000, names=("a", "b")
    )
    points = points_between()
    expected = cv2.projectPoints(points, ROTATION, TRANSLATION, MATRICES[1], BROWN)[0]
    seen = right.project(rig_from_world.apply(points))
    np.testing.assert_allclose(seen, expected.reshape(-1, 2), rtol=0, atol=1e-8)
    assert right.name == "b"


def test_opencv_says_what_is_missing(tmp_path: Path) -> None:
    both = {"M1": MATRICES[0], "M2": MATRICES[1], "T": TRANSLATION}
    with pytest.raises(InputError, match="no matrix with one of the names R, rotation_matrix"):
        read_opencv_cameras([write(tmp_path / "a.yml", **both)])
    path = write(tmp_path / "b.yml", **both, R=ROTATION)
    with pytest.raises(InputError, match="image size"):
        read_opencv_cameras([path])
    rational = np.r_[BROWN, 0.1, 0, 0]
    path = write(tmp_path / "c.yml", **both, R=ROTATION, D1=rational)
    with pytest.raises(InputError, match="k4 k5 k6"):
        read_opencv_cameras([path], image_size_px=(1280, 800))
    (tmp_path / "d.yml").write_text("%YAML:1.0\n---\nM1: [1, 2\n")
    with pytest.raises(InputError):
        read_opencv_cameras([tmp_path / "d.yml"])
    with pytest.raises(InputError, match="does not exist"):
        read_opencv_cameras([tmp_path / "none.yml"])


def test_opencv_cameras_of_two_sizes_in_a_file_each(tmp_path: Path) -> None:
    sizes = [(1280, 800), (1024, 1024)]
    files = [
        write(tmp_path / f"{i}.yml", camera_matrix=m, distortion_coefficients=BROWN,
              image_width=size[0], image_height=size[1])
        for i, (m, size) in enumerate(zip(MATRICES, sizes))
    ]  # fmt: skip
    files.append(write(tmp_path / "pair.yml", R=ROTATION, T=TRANSLATION))
    cameras, _, notes = read_opencv_cameras(files)
    assert [camera.image_size_px for camera in cameras] == sizes and notes == ()


def test_opencv_distortion_under_other_names_is_not_left_out_in_silence(tmp_path: Path) -> None:
    both = {"cameraMatrix1": MATRICES[0], "cameraMatrix2": MATRICES[1], "R": ROTATION,
            "T": TRANSLATION, "image_width": 1280, "image_height": 800}  # fmt: skip
    named = write(tmp_path / "a.yml", dist_coeffs1=BROWN, dist_coeffs2=BROWN, **both)
    cameras, _, notes = read_opencv_cameras([named])
    assert all(camera["k1"] for camera in cameras) and notes == ()
    strange = write(tmp_path / "b.yml", D1=BROWN, bent2=BROWN, **both)
    (left, right), _, (note,) = read_opencv_cameras([strange])
    assert left["k1"] and not right["k1"]
    assert note.startswith("camera 2: there is no D2 or") and "bent2" in note


# ------------------------------------------------------------------------------------ OpenPTV

SENSOR = Sensor((1280, 1024), (0.012, 0.0125))
ANGLES = [(0.004, -0.006, 0.02), (-0.02, 1.56, 0.04)]
POSITIONS = [(2.0, 1.0, 480.0), (470.0, -3.0, 4.0)]


def openptv_pixel(
    point: Array, position: tuple[float, ...], angles: tuple[float, ...], inner: tuple[float, ...],
    added: tuple[float, ...],
) -> tuple[float, float]:  # fmt: skip
    """rotation_matrix, flat_image_coord, flat_to_dist and metric_to_pixel of liboptv, no walls."""
    so, co = math.sin(angles[0]), math.cos(angles[0])
    sp, cp = math.sin(angles[1]), math.cos(angles[1])
    sk, ck = math.sin(angles[2]), math.cos(angles[2])
    dm = [
        [cp * ck, -cp * sk, sp],
        [co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp],
        [so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp],
    ]
    d = [point[i] - position[i] for i in range(3)]
    x, y, z = (sum(dm[i][j] * d[i] for i in range(3)) for j in range(3))
    xh, yh, distance = inner
    k1, k2, k3, p1, p2, scx, she = added
    a, b = -distance * x / z + xh, -distance * y / z + yh
    r2 = a * a + b * b
    radial = k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = a + a * radial + p1 * (r2 + 2 * a * a) + 2 * p2 * a * b
    v = b + b * radial + p2 * (r2 + 2 * b * b) + 2 * p1 * a * b
    u, v = scx * u - math.sin(she) * v, math.cos(she) * v
    (width, height), (pixel_x, pixel_y) = SENSOR.image_size_px, SENSOR.pixel_size_mm
    return u / pixel_x + width / 2, height / 2 - v / pixel_y


def write_openptv(
    folder: Path, inner: tuple[float, ...], added: tuple[float, ...] | None
) -> list[Path]:
    paths = []
    for i, (position, angles) in enumerate(zip(POSITIONS, ANGLES), 1):
        rows = [position, angles, (1, 0, 0), (0, 1, 0), (0, 0, 1), inner[:2], inner[2:], (0, 0, 50)]
        path = folder / f"cam{i}.tif.ori"
        path.write_text("\n".join(" ".join(repr(v) for v in row) for row in rows) + "\n")
        if added is not None:
            path.with_suffix(".addpar").write_text(" ".join(repr(v) for v in added))
        paths.append(path)
    return paths


def openptv_misfit(folder: Path, inner: tuple[float, ...], added: tuple[float, ...]) -> float:
    paths = write_openptv(folder, inner, added)
    cameras, rig_from_world, notes = read_openptv_cameras(paths, SENSOR)
    np.testing.assert_array_equal(cameras[0].camera_from_rig.rotation, np.eye(3))
    assert [c.name for c in cameras] == ["cam1", "cam2"] and len(notes) in (0, 2)
    points = np.random.default_rng(2).uniform(-25, 25, (300, 3))
    worst = 0.0
    for camera, position, angles in zip(cameras, POSITIONS, ANGLES):
        assert np.linalg.det(camera.camera_from_rig.rotation) == pytest.approx(1)
        expected = np.array([openptv_pixel(p, position, angles, inner, added) for p in points])
        assert np.all((expected > 0) & (expected < SENSOR.image_size_px))
        seen = camera.project(rig_from_world.apply(points)) + 0.5
        worst = max(worst, float(np.abs(seen - expected).max()))
    return worst


BENT = (-2e-4, 3e-7, 0.0, 4e-5, -3e-5, 1.002, 0.003)


@pytest.mark.parametrize(
    ("inner", "added"),
    [
        ((0.0, 0.0, 90.0), (0, 0, 0, 0, 0, 1, 0)),
        ((0.4, -0.3, 90.0), (0, 0, 0, 0, 0, 1.002, 0.003)),
        ((0.0, 0.0, 90.0), BENT),
    ],
)
def test_openptv_is_exact_where_it_can_be(
    tmp_path: Path, inner: tuple[float, ...], added: tuple[float, ...]
) -> None:
    assert openptv_misfit(tmp_path, inner, added) < 1e-8


@pytest.mark.parametrize(
    ("added", "limit_px"), [(BENT, 0.2), ((-2e-5, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0), 1e-4)]
)
def test_openptv_distortion_beside_a_principal_point_is_fitted(
    tmp_path: Path, added: tuple[float, ...], limit_px: float
) -> None:
    inner = (0.4, -0.3, 90.0)
    worst = openptv_misfit(tmp_path, inner, added)
    _, _, notes = read_openptv_cameras(write_openptv(tmp_path, inner, added), SENSOR)
    stated = [float(note.split(", to ")[1].split()[0]) for note in notes]
    assert 0 < worst <= max(stated) * 1.05 < limit_px


def test_openptv_without_added_parameters_says_so(tmp_path: Path) -> None:
    paths = write_openptv(tmp_path, (0.0, 0.0, 90.0), None)
    _, _, notes = read_openptv_cameras(paths, SENSOR, names=["a", "b"])
    assert len(notes) == 2 and "no .addpar" in notes[0]


def test_openptv_refuses_what_it_cannot_read(tmp_path: Path) -> None:
    paths = write_openptv(tmp_path, (0.0, 0.0, -90.0), None)
    with pytest.raises(InputError, match="principal distance"):
        read_openptv_cameras(paths, SENSOR)
    paths = write_openptv(tmp_path, (0.0, 0.0, 90.0), (0, 0, 0, 0, 0, 1e-320, 0))
    with pytest.raises(InputError, match="cannot be inverted"):
        read_openptv_cameras(paths, SENSOR)
    paths[0].write_text("1 2 3")
    with pytest.raises(InputError, match="3 numbers, 21"):
        read_openptv_cameras(paths, SENSOR)
    paths[0].write_text("one two")
    with pytest.raises(InputError, match="no number"):
        read_openptv_cameras(paths, SENSOR)


@pytest.mark.parametrize("pixel_mm", [0.0, -0.01, 1e-310])
def test_openptv_pixels_without_a_size_are_refused(tmp_path: Path, pixel_mm: float) -> None:
    paths = write_openptv(tmp_path, (0.0, 0.0, 60.0), None)
    with pytest.raises(InputError, match="mm of one pixel"):
        read_openptv_cameras(paths, Sensor((1280, 1024), (0.012, pixel_mm)))
    with pytest.raises(InputError, match="does not exist"):
        read_openptv_cameras([tmp_path / "none.ori"], SENSOR)


PTV_PAR = "2\nimg/cam1.1\ncal/cam1.tif\nimg/cam2.1\ncal/cam2.tif\n1\n0\n1\n1280\n1024\n"


def test_ptv_par_gives_the_sensor_and_refuses_walls(tmp_path: Path) -> None:
    path = tmp_path / "ptv.par"
    path.write_text(PTV_PAR + "0.012\n0.0125\n0\n1\n1\n1\n0\n")
    assert read_ptv_par(path) == SENSOR
    path.write_text(PTV_PAR + "0.012\n0.0125\n0\n1\n1.49\n1.33\n5\n")
    with pytest.raises(InputError, match="refraction"):
        read_ptv_par(path)
    path.write_text(PTV_PAR + "0.012\n0.0125\n0\n")
    with pytest.raises(InputError, match="indices are missing"):
        read_ptv_par(path)
    path.write_text("nothing")
    with pytest.raises(InputError, match=r"not a ptv\.par"):
        read_ptv_par(path)


# ---------------------------------------------------------------------------------- nominals

TARGET = """
[target]
layout = "grid"
rows = 3
columns = 5
pitch_mm = 7.0
dot_diameter_mm = 2.4
polarity = "white_on_black"
"""


def test_nominals_are_read_as_rig_toml(tmp_path: Path) -> None:
    cameras, _, _ = read_openptv_cameras(write_openptv(tmp_path, (0, 0, 90.0), BENT), SENSOR)
    path = tmp_path / "rig.toml"
    path.write_text("schema = 1\n" + nominal_toml(cameras) + TARGET)
    rig = read_rig_toml(path)
    assert list(rig.cameras) == ["cam1", "cam2"]
    second = rig.cameras["cam2"]
    assert second.telecentricity_per_mm == pytest.approx(cameras[1]["kappa_per_mm"], rel=1e-8)
    assert second.scale_px_per_mm == pytest.approx(cameras[1]["scale_px_per_mm"], rel=1e-8)
    turn = np.degrees(cameras[1].camera_from_rig.rotvec_rad)
    np.testing.assert_allclose(rig.rotvec_from_first_deg[cameras[1].name], turn, atol=1e-6)
