"""Cameras in HALCON's models against HALCON's documented projection."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from camera_pairs import DISTORTED, PRISM, RIGHT, SQUARE_ON, Array, pair, random_points
from scipy.optimize import fsolve

from telerig.errors import GeometryError
from telerig.io.exchange.export import halcon
from telerig.io.exchange.export.halcon import halcon_cameras, hdevelop_lines, write_halcon
from telerig.io.exchange.export.volume import seen_points, working_volume
from telerig.rig import projection
from telerig.rig.pose import Pose

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
        assert found == kind and not ours.notes and ours.misfit.max_px < 1e-9
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
        assert "polynomial" in ours.kind and "approximated by a fit" in ours.notes[0]
        pixels = halcon_project(*read, some)
        np.testing.assert_allclose(ours.project(some), pixels, rtol=0, atol=1e-9)
        distance = np.linalg.norm(ours.project(everywhere) - camera.project(everywhere), axis=1)
        assert ours.misfit.max_px == pytest.approx(distance.max(), rel=1e-6)
        assert ours.misfit.rms_px == pytest.approx(np.sqrt(np.mean(distance**2)), rel=1e-6)
        assert 0 < distance.max() < limit_px
        assert np.linalg.norm(pixels - camera.project(some), axis=1).max() <= distance.max()


def test_halcon_takes_the_coefficients_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another order of the coefficients in the distortion module must not change the export."""
    cameras = pair(**DISTORTED)
    usual = halcon_cameras(cameras)
    last = len(projection.COEFFICIENTS) - 1
    monkeypatch.setattr(halcon, "COEFFICIENTS", projection.COEFFICIENTS[::-1])
    monkeypatch.setattr(
        halcon,
        "coefficient_jacobian",
        lambda xy, which: projection.coefficient_jacobian(xy, [last - i for i in which]),
    )
    for name in ("undistort", "distortion_jacobian"):
        function = getattr(projection, name)
        monkeypatch.setattr(halcon, name, lambda xy, c, f=function: f(xy, c[::-1]))
    for before, after in zip(usual, halcon_cameras(cameras)):
        assert after.parameters == before.parameters and after.misfit == before.misfit


def test_halcon_states_the_residual_perspective_it_leaves_out() -> None:
    cameras = pair(kappa_per_mm=2e-6)
    for ours in halcon_cameras(cameras):
        assert ours.kind == "area_scan_telecentric_division"
        assert "kappa_per_mm = 2e-06" in ours.notes[0] and 1e-3 < ours.misfit.max_px < 0.05


def test_halcon_distortion_without_inverse_is_an_error() -> None:
    ours = halcon_cameras(pair(k1=0.02))[0]
    with pytest.raises(GeometryError, match="no inverse"):
        ours.project([[2000.0, 1500.0, 0.0]])


def test_a_camera_with_a_tilted_sensor_leaves_no_old_parameters(tmp_path: Path) -> None:
    flat, tilted = pair(SQUARE_ON), pair(SQUARE_ON, tilt_x=0.02)
    assert "left.dat" in write_halcon(halcon_cameras(flat), tmp_path)
    names = write_halcon(halcon_cameras(tilted), tmp_path)
    assert sorted(names) == sorted(p.name for p in tmp_path.iterdir())


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
