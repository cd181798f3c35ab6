"""Ordinary lenses as the limit of telecentric ones: what is said of them, and nearly parallel axes.

OpenCV projects the dots.
"""

from __future__ import annotations

import cv2
import numpy as np
import pandas as pd
import pytest
from finding_codes import codes
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from telerig.estimator.calibration.quality import checks
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.io.results.findings import Code
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import INDEX
from telerig.rig.target import Target

pytestmark = pytest.mark.usefixtures("without_advice")

Array = NDArray[np.float64]
SIZE = (1280, 1024)
NOISE_PX = 0.03
TARGET = Target(
    rows=6, columns=8, pitch_mm=(10.0, 10.0), dot_diameter_mm=0.1,
    marks=((2, 3), (2, 5), (1, 3)), print_sigma_mm=0.005, flatness_sigma_mm=0.005,
)  # fmt: skip
CENTRES = np.array([[610.0, 530.0], [660.0, 490.0]])


def calibrated(
    focal_px: float,
    angle_deg: float,
    base: float,
    seed: int = 0,
    wave_px: float = 0.0,
    aspect: float = 1.0,
) -> Calibration:
    """A rig whose axes cross at ``angle_deg``; ``base`` shifts the cameras apart, as a share of
    their distance to the target; ``wave_px`` is a lens error that no model has."""
    rng = np.random.default_rng(seed)
    away_mm = focal_px * 100.0 / SIZE[0]
    ids = TARGET.ids()
    points = TARGET.nominal_mm(ids)
    points = points - points.mean(axis=0)
    tables = []
    for v in range(8):
        along = rng.uniform(0, 2 * np.pi)
        tilt = np.radians(rng.uniform(12, 30)) * np.array([np.cos(along), np.sin(along), 0.0])
        pose = Rotation.from_rotvec(tilt) * Rotation.from_euler("z", 45.0 * v, degrees=True)
        world = pose.apply(points) + rng.uniform(-10, 10, 3)
        for c, side in enumerate((-0.5, 0.5)):
            turn = np.array([0.0, side * np.radians(angle_deg), 0.0])
            place = np.array([-side * base * away_mm, 0.0, away_mm])
            matrix = np.diag([focal_px, aspect * focal_px, 1.0])
            matrix[:2, 2] = CENTRES[c]
            uv, _ = cv2.projectPoints(world, turn, place, matrix, np.zeros(4))
            wave = np.sin(uv[:, 0] @ [[0.005, 0.002], [0.003, 0.006]] + [c, 2.0 - c])
            uv = uv[:, 0] + wave_px * wave + NOISE_PX * rng.standard_normal((len(ids), 2))
            tables.append(pd.DataFrame({
                "view": f"{v}", "camera": ("left", "right")[c], "dot": ids, "u_px": uv[:, 0],
                "v_px": uv[:, 1], "suu_px2": NOISE_PX**2, "suv_px2": 0.0, "svv_px2": NOISE_PX**2,
            }))  # fmt: skip
    cameras = [Camera.create(name, SIZE, 12.8) for name in ("left", "right")]
    return self_calibrate(
        pd.concat(tables, ignore_index=True), cameras, TARGET,
        nominal_rotvec_deg=[0.0, angle_deg, 0.0],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("focal_px", "angle_deg", "base", "aspect"),
    [(3000.0, 0.0, 0.15, 1.0), (8000.0, 1.0, 0.0, 1.0), (2200.0, 19.0, 0.0, 1.0006)],
)
def test_centres_and_angle_are_as_good_as_stated(
    focal_px: float, angle_deg: float, base: float, aspect: float
) -> None:
    found = calibrated(focal_px, angle_deg, base, aspect=aspect)
    assert found.verdict["status"] == "GOOD"
    for camera, centre in zip(found.cameras, CENTRES):
        for name, truth in zip(("centre_u_px", "centre_v_px"), centre):
            error = abs(camera.intrinsics[INDEX[name]] - truth)
            assert error < min(2.0, 4.0 * found.sd(f"{camera.name}.{name}"))
    statistics = found.statistics
    assert abs(statistics["axes_angle_deg"] - angle_deg) < 4.0 * statistics["axes_angle_sd_deg"]
    assert statistics["axes_angle_sd_deg"] < 0.1
    for lens in statistics["telecentricity"].values():
        per_mm = 1.0 / (focal_px * 100.0 / SIZE[0])
        assert lens["change_per_mm"] == pytest.approx(per_mm, rel=0.05)
    first = found.report().splitlines()[1]
    assert "ordinary lenses, not telecentric" in first
    assert ("NEAR_PARALLEL" in codes(found)) == (angle_deg < 10)
    assert ("nearly parallel" in found.diagnostics["gauge"]) == (angle_deg < 10)


@pytest.mark.parametrize("seeds", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_smooth_error_of_the_lens_model_widens_the_standard_deviations(seeds: int) -> None:
    """Independent errors of the dots would give centres that are up to 20 of them off."""
    squares = []
    for seed in range(seeds):
        found = calibrated(3000.0, 45.0, 0.0, seed, wave_px=0.15)
        widening = found.diagnostics["structure"]["widening"]
        assert 3.0 < widening < 8.0
        stated = {f.numbers["widening"] for f in found.findings if f.code is Code.PATTERN}
        assert stated == {widening}
        for camera, centre in zip(found.cameras, CENTRES):
            for name, truth in zip(("centre_u_px", "centre_v_px"), centre):
                error = camera.intrinsics[INDEX[name]] - truth
                squares.append((error / found.sd(f"{camera.name}.{name}")) ** 2)
    assert max(squares) < 4.0**2
    assert 0.1 < np.mean(squares) < 3.0


def test_linked_parameters_make_one_finding_a_group() -> None:
    names = ("left.k1", "left.k2", "left.kappa_per_mm", "right.k1", "right.k2", "right.skew")
    direction = np.array([[1.0, -2.0, 0.5, 0, 0, 0], [0, 0, 0, 1.0, -1.0, 0], [0, 0, 0, 0, 0, 1.0]])
    covariance = direction.T @ direction + 1e-4 * np.eye(6)
    first, second = checks.linked_parameters(names, covariance)
    assert (first.names, second.names) == (names[:3], names[3:5])
    assert first.words.startswith(
        "the distortion coefficient k1 of camera 'left', the distortion coefficient k2 of camera "
        "'left' and the residual perspective kappa of camera 'left' can hardly be told apart"
    )
    assert -1 < second.numbers["correlation"] < -0.98
