"""Exported cameras, read and projected by other programs or by formulas written out here."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import fsolve

from telerig.errors import GeometryError, InputError
from telerig.io.export.halcon import halcon_cameras
from telerig.io.export.halcon_files import hdevelop_lines, write_halcon
from telerig.io.export.opencv import camera_matrices, write_opencv
from telerig.io.export.soloff import fit_soloff, read_soloff, write_soloff
from telerig.io.export.volume import seen_points, volume_of, working_volume
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.triangulation import triangulate

Array = NDArray[np.float64]

RIGHT = Pose.from_rotvec([0.03, np.pi / 2 - 0.02, 0.01], [0.2, -0.4, 3.0])
SQUARE_ON = Pose.from_rotvec([0.0, np.pi / 2, 0.0], [0.2, -0.4, 0.0])
DISTORTED = {"k1": 0.012, "k2": -0.004, "p1": 0.0011, "p2": -0.0007}
PRISM = {"s1": 0.0008, "s2": -0.0003, "s3": -0.0005, "s4": 0.0002}


def pair(second: Pose = RIGHT, **parameters: float) -> tuple[Camera, Camera]:
    """Two cameras of one kind, the image of the second not square."""
    ours = {"centre_u_px": 258.3, "centre_v_px": 251.1} | parameters
    return (
        Camera.create("left", (512, 512), 10.1, **ours),
        Camera.create("right", (640, 512), 9.9, camera_from_rig=second, **parameters),
    )


def random_points(cameras: tuple[Camera, ...]) -> Array:
    return seen_points(cameras, working_volume(cameras), 7)


# ------------------------------------------------------------------------------------- HALCON


def about(axis: int, degrees: float) -> Array:
    """Elementary rotation, written out."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    out = np.eye(3)
    out[i, i] = out[j, j] = c
    out[i, j], out[j, i] = -s, s
    return out


def halcon_undistorted(kind: str, values: dict[str, float], bent: Array) -> Array:
    """Distorted to undistorted image coordinates, as the manual has it."""
    a, b = bent
    r2 = a * a + b * b
    if "division" in kind:
        return np.array([a, b]) / (1 + values["kappa"] * r2)
    f = 1 + values["k1"] * r2 + values["k2"] * r2**2 + values["k3"] * r2**3
    p1, p2 = values["p1"], values["p2"]
    u = a * f + p1 * (r2 + 2 * a * a) + 2 * p2 * a * b
    return np.array([u, b * f + 2 * p1 * a * b + p2 * (r2 + 2 * b * b)])


def halcon_distorted(kind: str, values: dict[str, float], straight: Array) -> Array:
    """By root finding, in millimetres."""
    if not any(values.get(n) for n in ("kappa", "k1", "k2", "k3", "p1", "p2")):
        return straight

    def miss(bent_mm: Array) -> Array:
        return (halcon_undistorted(kind, values, 1e-3 * bent_mm) - straight) * 1e3

    return 1e-3 * np.asarray(fsolve(miss, 1e3 * straight, xtol=1e-12))


def halcon_project(kind: str, values: dict[str, float], pose: list[float], points: Array) -> Array:
    """HALCON's documented camera, one point at a time."""
    turn = about(0, pose[3]) @ about(1, pose[4]) @ about(2, pose[5])
    out = []
    for point in points / 1000:
        x, y, z = turn @ point + pose[:3]
        lens = values["magnification"] if "magnification" in values else values["focus"] / z
        bent = halcon_distorted(kind, values, lens * np.array([x, y]))
        if "tilt" in values:
            rho = values["rot"]
            r = about(2, rho) @ about(0, values["tilt"]) @ about(2, -rho)
            bent = np.linalg.inv(r[:2, :2]) @ bent
        out.append(bent / [values["sx"], values["sy"]] + [values["cx"], values["cy"]])
    return np.array(out)


NAMES = {
    "area_scan_telecentric_division": "magnification kappa",
    "area_scan_telecentric_polynomial": "magnification k1 k2 k3 p1 p2",
    "area_scan_tilt_bilateral_telecentric_division": "magnification kappa tilt rot",
    "area_scan_tilt_bilateral_telecentric_polynomial": "magnification k1 k2 k3 p1 p2 tilt rot",
    "area_scan_division": "focus kappa",
    "area_scan_polynomial": "focus k1 k2 k3 p1 p2",
    "area_scan_tilt_image_side_telecentric_division": "focus kappa tilt rot",
}


def read_hdevelop(text: str) -> list[tuple[str, dict[str, float], list[float]]]:
    """The tuples of the text, named in the order of HALCON's manual."""
    out = []
    for kind, numbers, pose in re.findall(
        r"CamParam\d := \['(\w+)', (.*)\]\nPose\d := \[(.*), 0\]", text
    ):
        names = [*NAMES[kind].split(), "sx", "sy", "cx", "cy", "image_width", "image_height"]
        values = [float(n) for n in numbers.split(",")]
        assert len(values) == len(names)
        out.append((kind, dict(zip(names, values)), [float(n) for n in pose.split(",")]))
    return out


@pytest.mark.parametrize("second", [RIGHT, SQUARE_ON])
@pytest.mark.parametrize(
    ("parameters", "kind"),
    [
        ({}, "area_scan_telecentric_division"),
        ({"aspect": 1.003}, "area_scan_telecentric_division"),
        ({"tilt_x": 0.05}, "area_scan_telecentric_division"),
        ({"aspect": 0.998, "skew": 0.004}, "area_scan_tilt_bilateral_telecentric_division"),
        ({"tilt_x": 0.05, "tilt_y": -0.08}, "area_scan_tilt_bilateral_telecentric_division"),
        ({"kappa_per_mm": 1 / 300}, "area_scan_division"),
        (
            {"kappa_per_mm": 1 / 300, "skew": 0.002},
            "area_scan_tilt_image_side_telecentric_division",
        ),
    ],
)
def test_halcon_is_exact_without_distortion(
    parameters: dict[str, float], kind: str, second: Pose
) -> None:
    cameras = pair(second, **parameters)
    exported = halcon_cameras(cameras)
    points = random_points(cameras)[::7]
    for camera, ours, (found, values, pose) in zip(
        cameras, exported, read_hdevelop(hdevelop_lines(exported))
    ):
        assert found == kind and ours.exact and ours.misfit.max_px < 1e-9
        pixels = halcon_project(found, values, pose, points)
        np.testing.assert_allclose(pixels, camera.project(points), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("parameters", "limit_px"),
    [({"k1": 0.004}, 1e-3), (DISTORTED, 0.02), (DISTORTED | {"skew": 0.003}, 0.02),
     (DISTORTED | PRISM, 0.5)],
)  # fmt: skip
def test_halcon_distortion_is_fitted_and_its_error_stated(
    parameters: dict[str, float], limit_px: float
) -> None:
    cameras = pair(**parameters)
    exported = halcon_cameras(cameras)
    everywhere = seen_points(cameras, working_volume(cameras), 25)
    some = random_points(cameras)[::7]
    for camera, ours, read in zip(cameras, exported, read_hdevelop(hdevelop_lines(exported))):
        assert "polynomial" in ours.kind and not ours.exact and "fitted" in ours.notes[0]
        pixels = halcon_project(*read, some)
        np.testing.assert_allclose(ours.project(some), pixels, rtol=0, atol=1e-9)
        distance = np.linalg.norm(ours.project(everywhere) - camera.project(everywhere), axis=1)
        assert ours.misfit.max_px == pytest.approx(distance.max(), rel=1e-6)
        assert ours.misfit.rms_px == pytest.approx(np.sqrt(np.mean(distance**2)), rel=1e-6)
        assert 0 < distance.max() < limit_px
        assert np.linalg.norm(pixels - camera.project(some), axis=1).max() <= distance.max()


def test_halcon_division_model_on_request() -> None:
    cameras = pair(k1=0.004)
    for camera, ours in zip(cameras, halcon_cameras(cameras, distortion="division")):
        assert ours.kind == "area_scan_telecentric_division" and ours.parameters["kappa"] != 0
        points = random_points(cameras)[::9]
        (read,) = read_hdevelop(hdevelop_lines([ours]))
        distance = np.linalg.norm(halcon_project(*read, points) - camera.project(points), axis=1)
        assert distance.max() < ours.misfit.max_px * 1.01 < 0.02


def test_halcon_states_the_residual_perspective_it_leaves_out() -> None:
    cameras = pair(kappa_per_mm=2e-6)
    for ours in halcon_cameras(cameras):
        assert ours.kind == "area_scan_telecentric_division" and not ours.exact
        assert "kappa = 2e-06" in ours.notes[0] and 1e-3 < ours.misfit.max_px < 0.05
    with pytest.raises(InputError, match="need a positive one"):
        halcon_cameras(pair(), lens="perspective")
    for ours in halcon_cameras(cameras, lens="perspective"):
        assert ours.exact and ours.parameters["focus"] == pytest.approx(500.0)
        assert ours.misfit.max_px < 1e-7


@pytest.mark.parametrize("kind", ["division", "polynomial"])
def test_halcon_distortion_without_inverse_is_an_error(kind: str) -> None:
    ours = halcon_cameras(pair(k1=0.02), distortion=kind)[0]  # type: ignore[arg-type]
    with pytest.raises(GeometryError, match="no inverse"):
        ours.project([[2000.0, 1500.0, 0.0]])


def test_halcon_files(tmp_path: Path) -> None:
    cameras = pair(SQUARE_ON, **DISTORTED)
    exported = halcon_cameras(cameras)
    names = write_halcon(exported, tmp_path / "halcon")
    assert sorted(names) == sorted(p.name for p in (tmp_path / "halcon").iterdir())
    points = random_points(cameras)[::9]
    for camera, ours in zip(cameras, exported):
        text = (tmp_path / "halcon" / f"{camera.name}.dat").read_text()
        found = re.findall(r"^(\w+):\w+: ([^;]+);\n  (?:DOUBLE|INT)", text, re.MULTILINE)
        assert " ".join(n for n, _ in found) == (
            "Focus Poly1 Poly2 Poly3 Poly4 Poly5 Sx Sy Cx Cy ImageWidth ImageHeight"
        )
        focus, *numbers = (float(v) for _, v in found)
        assert focus == 0
        values = dict(zip(("k1", "k2", "k3", "p1", "p2", "sx", "sy", "cx", "cy"), numbers)) | {
            "magnification": 1.0
        }
        pose = (tmp_path / "halcon" / f"{camera.name}_pose.dat").read_text()
        lines = {
            row[0]: row[2:].split() for row in pose.splitlines() if row[:2] in ("f ", "r ", "t ")
        }
        assert lines["f"] == ["0"]
        numbers = [float(v) for v in lines["t"] + lines["r"]]
        pixels = halcon_project("polynomial", values, numbers, points)
        np.testing.assert_allclose(pixels, ours.project(points), rtol=0, atol=1e-8)


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


# ------------------------------------------------------------------------------------- Soloff


def soloff_by_hand(a: Array, x: Array, y: Array, z: Array) -> Array:
    """Equation 8 of the paper, term by term."""
    return np.asarray(
        a[0] + a[1] * x + a[2] * y + a[3] * z + a[4] * x**2 + a[5] * x * y + a[6] * y**2
        + a[7] * x * z + a[8] * y * z + a[9] * z**2 + a[10] * x**3 + a[11] * x**2 * y
        + a[12] * x * y**2 + a[13] * y**3 + a[14] * x**2 * z + a[15] * x * y * z
        + a[16] * y**2 * z + a[17] * x * z**2 + a[18] * y * z**2
    )  # fmt: skip


@pytest.mark.parametrize("parameters", [{}, {"k1": 0.004}, {"kappa_per_mm": 1 / 400}])
def test_soloff_error_in_the_header_is_that_of_an_independent_evaluation(
    parameters: dict[str, float], tmp_path: Path
) -> None:
    cameras = pair(**parameters)
    points = np.random.default_rng(5).uniform(-25, 25, (40000, 3))
    for camera in cameras:
        uv = camera.project(points)
        points = points[np.all((uv > 0) & (uv < np.array(camera.image_size_px) - 1), axis=1)]
    inside = working_volume(cameras)
    points = points[np.all((points > inside.lower_mm) & (points < inside.upper_mm), axis=1)]
    for camera, fit in zip(cameras, fit_soloff(cameras)):
        path = tmp_path / f"{camera.name}.csv"
        write_soloff(fit, path)
        text = path.read_text()
        rms, largest = (
            float(v)
            for v in re.search(r"rms_px = (\S+), max_px = (\S+) at", text).groups()  # type: ignore[union-attr]
        )
        a = np.array([[float(v) for v in row.split(",")[3:]] for row in text.splitlines()[-19:]])
        pixels = np.stack([soloff_by_hand(a[:, i], *points.T) for i in (0, 1)], -1)
        distance = np.linalg.norm(pixels - camera.project(points), axis=1)
        if not parameters:
            assert largest < 1e-9 and distance.max() < 1e-9
        else:
            assert np.sqrt(np.mean(distance**2)) == pytest.approx(rms, rel=0.25)
            assert distance.max() < 1.1 * largest
        np.testing.assert_array_equal(read_soloff(path), a)
        write_soloff(fit, path, first_pixel=1.0)
        np.testing.assert_allclose(read_soloff(path)[0] - a[0], 1, atol=1e-12)


def test_the_missing_cubic_term_is_what_a_camera_along_x_lacks(tmp_path: Path) -> None:
    """Distortion k1 is a cubic; the 19 terms have no z^3, and z lies in the second image."""
    cameras = pair(SQUARE_ON, k1=0.004)
    nineteen, twenty = fit_soloff(cameras), fit_soloff(cameras, full_cubic=True)
    assert nineteen[0].misfit.max_px < 1e-9 and 0.05 < nineteen[1].misfit.max_px < 0.2
    assert max(fit.misfit.max_px for fit in twenty) < 1e-9
    write_soloff(twenty[1], tmp_path / "right.csv")
    points = random_points(cameras)
    coefficients = read_soloff(tmp_path / "right.csv")
    pixels = np.stack([soloff_by_hand(a, *points.T) for a in coefficients.T], -1)
    pixels += np.outer(points[:, 2] ** 3, coefficients[19])
    np.testing.assert_allclose(pixels, cameras[1].project(points), rtol=0, atol=1e-9)


def test_soloff_reader_refuses_other_terms(tmp_path: Path) -> None:
    path = tmp_path / "other.csv"
    path.write_text("i,j,k,u,v\n0,0,0,1,2\n")
    with pytest.raises(InputError, match="19 terms"):
        read_soloff(path)


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
