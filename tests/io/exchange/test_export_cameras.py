"""Cameras as matrices against OpenCV."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_pairs import DISTORTED, PRISM, SQUARE_ON, Array, pair, random_points

from telerig.errors import InputError
from telerig.io.exchange.export import volume
from telerig.io.exchange.export.halcon import halcon_cameras
from telerig.io.exchange.export.opencv import camera_matrices, write_opencv
from telerig.io.exchange.export.volume import seen_points, volume_of, working_volume
from telerig.rig.triangulation import triangulate

# ------------------------------------------------------------------------------------- OpenCV


def read_yaml(path: Path) -> list[dict[str, Array]]:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    nodes = storage.getNode("cameras")
    out = []
    for i in range(nodes.size()):
        node = nodes.at(i)
        out.append({k: node.getNode(k).mat() for k in node.keys() if not _scalar(node, k)})  # noqa: SIM118
        out[-1] |= {k: node.getNode(k).real() for k in node.keys() if k.endswith("_px")}  # noqa: SIM118
        assert node.getNode("name").string() in ("left", "right")
    storage.release()
    return out


def _scalar(node: cv2.FileNode, key: str) -> bool:
    return not node.getNode(key).isMap()


def test_opencv_file_that_cannot_be_written_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_self: Path, _data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match="No space left"):
        write_opencv(camera_matrices(pair()), tmp_path / "rig.yml")
    assert not list(tmp_path.iterdir())


def in_homogeneous(matrix: Array, points: Array) -> Array:
    image = np.c_[points, np.ones(len(points))] @ matrix.T
    return np.asarray(image[:, :2] / image[:, 2:])


@pytest.mark.parametrize(
    "parameters", [{}, {"aspect": 1.01, "skew": 0.02}, {"tilt_x": 0.1, "tilt_y": 0.05}]
)
def test_opencv_affine_matrix_is_the_projection(
    parameters: dict[str, float], tmp_path: Path
) -> None:
    cameras = pair(**parameters)
    write_opencv(camera_matrices(cameras), tmp_path / "rig.yml")
    points = random_points(cameras)
    for camera, read in zip(cameras, read_yaml(tmp_path / "rig.yml")):
        np.testing.assert_array_equal(read["affine"][2], [0, 0, 0, 1])
        for name in ("affine", "undistorted"):
            pixels = in_homogeneous(read[name], points)
            np.testing.assert_allclose(pixels, camera.project(points), rtol=0, atol=1e-10)
            assert read[f"{name}_max_px"] < 1e-10
        assert ("camera_matrix" in read) == (not set(parameters) & {"skew", "tilt_x"})


def test_opencv_matrix_of_a_perspective_camera_with_tilt_is_exact() -> None:
    cameras = pair(kappa_per_mm=1 / 250, tilt_x=0.1, tilt_y=-0.06, image_convergence_per_mm=0.002)
    points = random_points(cameras)
    for camera, ours in zip(cameras, camera_matrices(cameras)):
        pixels = in_homogeneous(ours.undistorted, points)
        np.testing.assert_allclose(pixels, camera.project(points), rtol=0, atol=1e-9)
        assert ours.affine_misfit.max_px > 5


def test_opencv_undistorts_and_triangulates_what_telerig_projects(tmp_path: Path) -> None:
    cameras = pair(**DISTORTED, **PRISM, k3=0.002, aspect=1.002)
    write_opencv(camera_matrices(cameras), tmp_path / "rig.yml")
    points = random_points(cameras)
    straight, matrices = [], []
    for camera, read in zip(cameras, read_yaml(tmp_path / "rig.yml")):
        seen = camera.project(points)
        k = read["camera_matrix"]
        best = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15)
        coefficients = read["distortion_coefficients"]
        if hasattr(cv2, "undistortPointsIter"):
            flat = cv2.undistortPointsIter(
                seen.reshape(-1, 1, 2), k, coefficients, np.eye(3), k, best
            )
        else:
            flat = cv2.undistortPoints(
                seen.reshape(-1, 1, 2), k, coefficients, R=np.eye(3), P=k, criteria=best
            )
        straight.append(flat.reshape(-1, 2))
        matrices.append(read["undistorted"])
        volume = seen_points(cameras, working_volume(cameras), 25)
        error = in_homogeneous(read["affine"], volume) - camera.project(volume)
        largest = np.linalg.norm(error, axis=1).max()
        assert read["affine_max_px"] == pytest.approx(largest, rel=1e-6)
        assert read["affine_max_px"] < read["undistorted_max_px"]
    found = cv2.triangulatePoints(*matrices, straight[0].T, straight[1].T)
    np.testing.assert_allclose((found[:3] / found[3]).T, points, rtol=0, atol=1e-6)
    ours = triangulate(cameras, [c.project(points) for c in cameras], 0.1, "ml").points_mm
    np.testing.assert_allclose((found[:3] / found[3]).T, ours, rtol=0, atol=1e-6)


# ------------------------------------------------------------------------------------- volume


def test_volume_is_the_cube_both_cameras_see() -> None:
    cameras = pair(SQUARE_ON)
    box = working_volume(cameras)
    edge = box.upper_mm - box.lower_mm
    np.testing.assert_allclose(edge, 512 / 10.1)
    assert np.all(np.abs(box.upper_mm + box.lower_mm) < 2)
    with pytest.raises(InputError, match="in every camera's image"):
        seen_points(cameras, volume_of([(90, 100), (0, 1), (0, 1)]), 13)
    with pytest.raises(InputError, match="no box"):
        volume_of([(1, 0), (0, 1), (0, 1)])


def test_a_lens_parameter_that_an_export_does_not_know_is_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cameras = [camera.with_parameters(s4=2e-3) for camera in pair(SQUARE_ON)]
    monkeypatch.setattr(volume, "EXPORTED", tuple(n for n in volume.EXPORTED if n != "s4"))
    for program, export in (("HALCON", halcon_cameras), ("OpenCV", camera_matrices)):
        with pytest.raises(InputError, match=f"s4 = 0.002, which the export to {program}") as found:
            export(cameras)
        assert "without s4" in str(found.value)
    halcon_cameras([camera.with_parameters(s4=0.0) for camera in cameras])
