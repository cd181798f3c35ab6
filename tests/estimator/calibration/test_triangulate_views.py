"""`Calibration.triangulate` from the pixels of two to four cameras, and pairs of a calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.result.calibration import Calibration, calibration_from_cameras
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

pytestmark = pytest.mark.usefixtures("without_advice")

NAMES = ("left", "middle", "right", "top")
FREE = (("scale_px_per_mm",), ("scale_px_per_mm", "k1"), (), ("k1",))


def cameras(count: int) -> list[Camera]:
    turns = [[0.0, 0.0, 0.0], [0.02, 0.9, 0.0], [0.0, 1.9, 0.05], [-1.2, 0.0, 0.0]]
    poses = [Pose.from_rotvec(turn, [0.1 * i, 0.2 * i, 0.0]) for i, turn in enumerate(turns)]
    return [
        Camera.create(name, (512, 512), 10.0, camera_from_rig=pose, k1=0.01)
        for name, pose in list(zip(NAMES, poses))[:count]
    ]


def calibrated(count: int) -> Calibration:
    """Cameras with a made-up covariance: 2e-4 rad, 2e-3 mm and the like, all correlated."""
    found = calibration_from_cameras(cameras(count))
    free = FREE[:count]
    names = [f"{n}.{p}" for n, parameters in zip(NAMES, free) for p in parameters]
    names += found.covariance_names
    size = {"mm": 2e-3, "scale_px_per_mm": 1e-3, "k1": 2e-4}
    sd = [next((s for end, s in size.items() if n.endswith(end)), 2e-4) for n in names]
    root = np.random.default_rng(3).standard_normal((len(names), len(names))) / len(names) ** 0.5
    root = np.array(sd)[:, None] * root
    return replace(found, free=free, covariance_names=tuple(names), covariance=root @ root.T)


@pytest.mark.parametrize("sigma", [{"left": 0.1}, (0.1,), (0.1, 0.1, 0.1)], ids=str)
def test_standard_deviations_of_other_cameras_are_refused(sigma: Any) -> None:
    with pytest.raises(InputError, match="one for each of left and middle"):
        calibrated(2).triangulate([[250.0, 250.0]], [[250.0, 250.0]], sigma_px=sigma)


def moved(calibration: Calibration, offset: Any) -> tuple[Camera, ...]:
    """The cameras with the components of the rig block moved."""
    change = dict(zip(calibration.covariance_names, offset))
    out = []
    for camera, free in zip(calibration.cameras, calibration.free):
        values = {p: camera[p] + change[f"{camera.name}.{p}"] for p in free}
        step = [change.get(f"{camera.name}.r{a}_rad", 0.0) for a in "xyz"]
        shift = [change.get(f"{camera.name}.t{a}_mm", 0.0) for a in "xyz"]
        # Exp of a small tangent, to first order in its rotation
        pose = camera.rig_from_camera @ Pose.from_rotvec(step, shift)
        out.append(replace(camera.with_parameters(**values), camera_from_rig=pose.inverse()))
    return tuple(out)


def shifts(calibration: Calibration, seen: Callable[[Calibration], Any]) -> Any:
    """(..., 3, P): how points move with each component of the rig block, by differences."""
    columns, spread = [], np.sqrt(np.diag(calibration.covariance))
    for unit, sd in zip(np.eye(len(spread)), spread):
        ends = [
            seen(replace(calibration, cameras=moved(calibration, sign * sd * unit)))
            for sign in (1, -1)
        ]
        columns.append((ends[0] - ends[1]) / (2 * sd))
    return np.moveaxis(columns, 0, -1)


def some_pixels(calibration: Calibration, points: Any) -> dict[str, Any]:
    """Exact pixels; every second point is hidden from one camera, in turn."""
    out = {c.name: c.project(points) for c in calibration.cameras}
    for i, uv in enumerate(out.values()):
        uv[2 * i + 1 :: 2 * len(out)] = np.nan
    return out


@pytest.mark.parametrize("count", [2, 3, 4])
def test_the_calibrations_share_is_how_points_move_with_it(count: int) -> None:
    calibration = calibrated(count)
    points = np.random.default_rng(0).uniform(-10, 10, (12, 3))
    pixels = some_pixels(calibration, points)
    found = calibration.triangulate(pixels, sigma_px=0.1)
    alone = calibration.triangulate(pixels, sigma_px=0.1, include_calibration=False)
    np.testing.assert_array_equal(found.measurement_covariance_mm2, alone.covariance_mm2)
    share = found.covariance_mm2 - alone.covariance_mm2
    shift = shifts(
        calibration,
        lambda c: c.triangulate(pixels, sigma_px=0.1, include_calibration=False).points_mm,
    )
    expected = shift @ calibration.covariance @ np.swapaxes(shift, -1, -2)
    placed = np.isfinite(found.points_mm).all(-1)
    assert found.unplaced == np.sum(~placed) == (6 if count == 2 else 0)
    np.testing.assert_allclose(found.points_mm[placed], points[placed], atol=1e-8)
    np.testing.assert_allclose(share[placed], expected[placed], rtol=2e-3, atol=1e-9)


def test_pixels_by_name_of_two_cameras_are_those_of_two_arrays() -> None:
    calibration = calibrated(2)
    uv = [c.project(np.random.default_rng(0).uniform(-9, 9, (7, 3))) for c in calibration.cameras]
    arrays = calibration.triangulate(*uv, sigma_px=(0.1, 0.2))
    assert arrays.ray_miss_mm.shape == (7,) and arrays.seen_by is None
    noise = {"right": 9.9, "left": 0.1, "middle": 0.2}
    names = calibration.triangulate({"middle": uv[1], "left": uv[0]}, sigma_px=noise)
    assert names.ray_miss_mm.shape == (7, 2)
    np.testing.assert_allclose(names.points_mm, arrays.points_mm, atol=1e-9)
    np.testing.assert_allclose(names.covariance_mm2, arrays.covariance_mm2, rtol=1e-8)


def test_a_camera_that_is_not_named_has_seen_nothing() -> None:
    calibration = calibrated(3)
    points = np.random.default_rng(0).uniform(-9, 9, (7, 3))
    uv = {c.name: c.project(points) for c in calibration.cameras}
    two = calibration.triangulate({"left": uv["left"], "right": uv["right"]}, sigma_px=0.1)
    assert np.isnan(two.ray_miss_mm[:, 1]).all() and two.seen_by.tolist() == [2] * 7
    pair = calibration.subset("left", "right").triangulate(uv["left"], uv["right"], sigma_px=0.1)
    np.testing.assert_allclose(two.covariance_mm2, pair.covariance_mm2, rtol=1e-8)
    first = calibration.triangulate(uv["left"], uv["middle"], sigma_px=0.1)
    same = calibration.subset(0, 1).triangulate(uv["left"], uv["middle"], sigma_px=0.1)
    np.testing.assert_array_equal(first.covariance_mm2, same.covariance_mm2)


def test_a_pair_without_the_first_camera_rides_on_its_own_first() -> None:
    calibration = calibrated(3)
    pair = calibration.subset("middle", "right")
    assert pair.covariance_names[-6] == "right.rx_rad" and len(pair.covariance_names) == 2 + 6
    points = np.array([[3.0, -4.0, 5.0], [-6.0, 2.0, 1.0]])
    pixels = [c.project(points) for c in pair.cameras]

    def seen(calibration: Calibration) -> Any:
        rider = calibration.subset("middle", "right")
        return rider.triangulate(*pixels, sigma_px=0.1, include_calibration=False).points_mm

    def back(calibration_: Calibration) -> Any:
        """In the first rig of the pair, which the first camera of the pair carries."""
        turn = calibration.cameras[1].rig_from_camera @ calibration_.cameras[1].camera_from_rig
        return turn.apply(seen(calibration_))

    shift = shifts(calibration, back)
    expected = shift @ calibration.covariance @ np.swapaxes(shift, -1, -2)
    whole = pair.triangulate(*pixels, sigma_px=0.1)
    share = whole.covariance_mm2 - whole.measurement_covariance_mm2
    np.testing.assert_allclose(share, expected, rtol=5e-3, atol=1e-9)


def test_what_cannot_be_triangulated_says_why() -> None:
    calibration = calibrated(3)
    uv = np.full((2, 2), 250.0)
    with pytest.raises(InputError, match="pixels of 1 camera"):
        calibration.triangulate({"left": uv})
    with pytest.raises(InputError, match="pixels of one camera only"):
        calibration.triangulate(uv)
    with pytest.raises(CalibrationError, match="no camera 'up'"):
        calibration.triangulate({"left": uv, "up": uv})
    with pytest.raises(InputError, match="sigma_px lacks right"):
        calibration.triangulate({"left": uv, "right": uv}, sigma_px={"left": 0.1})
    with pytest.raises(CalibrationError, match="not in the rig's order"):
        calibration.subset("right", "left")
    bare = replace(calibration, covariance=np.zeros((0, 0)), covariance_names=())
    for pair in (("left", "right"), ("middle", "right")):
        with pytest.raises(InputError, match=r"its covariance has no .*more\)"):
            bare.subset(*pair)
    with pytest.raises(CalibrationError, match="one camera cannot triangulate"):
        calibration_from_cameras(cameras(1)).triangulate(uv, uv)
