"""A camera that has moved since the calibration: its estimate from ray misses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

import telerig
from telerig.errors import CalibrationError, InputError
from telerig.estimator.bubbles.pairing.learning import default_model
from telerig.estimator.bubbles.pairing.model import Finding
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.rig_drift import estimate
from telerig.estimator.rig_drift.change import with_change
from telerig.estimator.rig_drift.estimate import PairCollector, rig_change
from telerig.estimator.rig_drift.movement import (
    DriftPrior,
    Movement,
    covariance_root,
    drift_covariance,
    drift_posterior,
    moved_pose,
)
from telerig.estimator.rig_drift.noise import Noise, Series, _noise, _spectrum, learned_noise
from telerig.estimator.rig_drift.ray_misses import offset_roll_pitch, ray_misses
from telerig.estimator.smoothing.problem.problem import RigMode, ShakeModel
from telerig.estimator.smoothing.refined_pose import refinement_of
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.rig.camera import Camera
from telerig.rig.triangulation import triangulate, triangulate_views

Array = NDArray[np.float64]
Pair = tuple[Camera, Camera]

NAMES = tuple(f"right.{p}" for p in ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm"))
SHAKE_HZ, SHAKE_DAMPING = 19.2, 0.03


def rig(angle_deg: float = 90.0, kappa_per_mm: float = 0.0) -> Pair:
    """Cameras without distortion, at an angle."""
    config = replace(run_preset("rise").calibration, angle_deg=angle_deg)
    values = {"kappa_per_mm": kappa_per_mm}
    cameras = tuple(replace(c, parameters=values) for c in config.cameras)
    first, second = true_cameras(replace(config, cameras=cameras)).values()
    return first, second


def calibration(cameras: Pair, sd: tuple[float, float] = (2e-5, 5e-4)) -> Calibration:
    """One that is sure of its pose to sd (rad, mm)."""
    covariance = np.diag(np.repeat(np.square(sd), 3))
    return Calibration(
        cameras, np.zeros(0, np.int64), np.zeros((0, 3)), {}, covariance, NAMES, ((), ())
    )


def moved(cameras: Pair, tangent: Array) -> Pair:
    pose = moved_pose(cameras[1].camera_from_rig.inverse(), tangent)
    return cameras[0], replace(cameras[1], camera_from_rig=pose.inverse())


def along_perpendicular(
    cameras: Pair, offset_mm: float, roll_rad: float, pitch_rad: float
) -> Array:
    """(6,) a movement of that offset at the rig's origin, roll and pitch, and nothing else."""
    return np.asarray(
        np.linalg.pinv(offset_roll_pitch(cameras, np.zeros(3)))
        @ np.array([offset_mm, roll_rad, pitch_rad])
    )


def oscillation(t_s: Array, rms_mm: float, rng: np.random.Generator) -> Array:
    """A mass on a damped spring, driven by white noise; drawn from its covariance."""
    omega = 2 * np.pi * SHAKE_HZ
    decay, turn = SHAKE_DAMPING * omega, omega * np.sqrt(1 - SHAKE_DAMPING**2)
    lag = np.abs(t_s[:, None] - t_s)
    covariance = np.exp(-decay * lag) * (np.cos(turn * lag) + decay / turn * np.sin(turn * lag))
    root = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(t_s)))
    return np.asarray(rms_mm * root @ rng.standard_normal(len(t_s)))


@dataclass(frozen=True)
class Run:
    """One bubble that circles while the cameras shake against each other along the rig's y.

    late_s : how much later the second camera exposes. bob_mm : amplitude of 3 Hz along y.
    """

    frames: int = 300
    rate_hz: float = 100.0
    noise_px: float = 0.1
    shake_mm: float = 0.1
    radius_mm: float = 8.0
    late_s: float = 0.0
    bob_mm: float = 0.0

    def tracks(self, cameras: Pair, true: Pair, rng: np.random.Generator) -> pd.DataFrame:
        t = np.arange(self.frames) / self.rate_hz
        start = rng.uniform(0, 6)
        uv = []
        for camera, late in zip(true, (0.0, self.late_s)):
            angle = 2 * np.pi * 1.7 * (t + late) + start
            height = 5 * (t + late - t.mean()) + self.bob_mm * np.sin(6 * np.pi * (t + late))
            points = np.stack(
                [self.radius_mm * np.cos(angle), height, self.radius_mm * np.sin(angle)], -1
            )
            shift = oscillation(t, self.shake_mm / np.sqrt(2), rng)[:, None] * [0.0, 1.0, 0.0]
            seen = camera.project(points - shift)
            uv.append(seen + self.noise_px * rng.standard_normal(seen.shape))
        found = triangulate(cameras, (uv[0], uv[1]), self.noise_px)
        table = pd.DataFrame({"frame": np.arange(len(t)), "particle": 0, "t_s": t})
        table[["x_mm", "y_mm", "z_mm"]] = found.points_mm
        table["ray_miss_mm"] = found.ray_miss_mm
        for camera, pixels in zip(cameras, uv):
            table[[f"{camera.name}_u_px", f"{camera.name}_v_px"]] = pixels
            for name, value in (("suu", 1.0), ("suv", 0.0), ("svv", 1.0)):
                table[f"{camera.name}_{name}_px2"] = value * self.noise_px**2
        return table


@pytest.mark.parametrize("angle", [45.0, 90.0, 130.0])
def test_three_components_are_identifiable_with_telecentric_lenses_at_any_angle(
    angle: float,
) -> None:
    cameras = rig(angle)
    directions = covariance_root(drift_covariance(cameras, DriftPrior()))
    assert directions.shape == (6, 3)
    points = np.random.default_rng(0).uniform(-15, 15, (200, 3))
    n = np.cross(*(c.camera_from_rig.rotation[2] for c in cameras))
    n /= np.linalg.norm(n)
    pose = cameras[1].camera_from_rig
    turn_about_n, shift_along_depth = np.zeros(6), np.zeros(6)
    turn_about_n[:3] = 1e-4 * pose.rotation @ n
    shift_along_depth[5] = 0.05
    shift_across = np.concatenate([np.zeros(3), 0.05 * np.cross(pose.rotation @ n, [0, 0, 1.0])])
    for unseen in (turn_about_n, shift_along_depth, shift_across):
        true = moved(cameras, unseen)
        first, second = (c.project(points) for c in true)
        assert np.abs(triangulate(cameras, (first, second), 0.1).ray_miss_mm).max() < 2e-7


def test_more_components_are_identifiable_with_perspective_lenses() -> None:
    assert covariance_root(drift_covariance(rig(90.0, 1 / 300), DriftPrior())).shape == (6, 5)


@pytest.mark.parametrize(("angle", "kappa"), [(90.0, 0.0), (60.0, 0.0), (90.0, 1e-5)])
def test_ray_misses_against_rays_of_cameras_that_really_moved(angle: float, kappa: float) -> None:
    cameras = rig(angle, kappa)
    points = np.random.default_rng(1).uniform(-15, 15, (100, 3))
    tangent = np.array([5e-5, -3e-5, 4e-5, 0.02, 0.015, -0.01])
    true = moved(cameras, tangent)
    pixels = np.stack([c.project(points) for c in true], 1)
    misses = ray_misses(cameras, ((), ()), points, pixels)
    crossing = triangulate(cameras, (pixels[:, 0], pixels[:, 1]), 0.1)
    assert np.allclose(np.abs(misses.miss_mm), np.abs(crossing.ray_miss_mm), atol=3e-6)
    assert np.allclose(misses.by_rig @ tangent, misses.miss_mm, atol=3e-6)
    n = np.cross(*(c.camera_from_rig.rotation[2] for c in cameras))
    n /= np.linalg.norm(n)
    before, after = (c[1].camera_from_rig.inverse() for c in (cameras, true))
    carried = after.apply(cameras[1].camera_from_rig.apply(points))
    back = before.apply(cameras[1].camera_from_rig.apply(points))
    assert np.allclose((carried - back) @ n, misses.miss_mm, atol=4e-6)


def test_offset_roll_and_pitch_are_those_of_the_body() -> None:
    cameras = rig()
    tangent = along_perpendicular(cameras, 0.02, 3e-5, -4e-5)
    values = offset_roll_pitch(cameras, np.zeros(3)) @ tangent
    assert np.allclose(values, [0.02, 3e-5, -4e-5])
    pose = cameras[1].camera_from_rig.inverse()
    shift = moved_pose(pose, tangent).translation_mm - pose.translation_mm
    n = np.cross(*(c.camera_from_rig.rotation[2] for c in cameras))
    assert shift @ n / np.linalg.norm(n) == pytest.approx(0.02, abs=1e-4)


@pytest.mark.parametrize("shake_mm", [pytest.param(0.0, marks=pytest.mark.slow), 0.1])
def test_coverage_with_and_without_shake(shake_mm: float) -> None:
    """20 µm and 50 µrad come back with errors that their covariance says; 12 runs each."""
    rng = np.random.default_rng(5)
    cameras = rig()
    prior = DriftPrior()
    basis = np.linalg.pinv(covariance_root(drift_covariance(cameras, prior)))
    nees, called = [], 0
    for _ in range(12):
        known = calibration(cameras)
        wrong = np.sqrt(np.diagonal(known.covariance)) * rng.standard_normal(6)
        tangent = along_perpendicular(cameras, 0.02, 3e-5, 4e-5)
        run = Run(shake_mm=shake_mm, frames=250)
        found = rig_change(run.tracks(cameras, moved(cameras, wrong + tangent), rng), known, prior)
        assert found is not None
        change, _ = found
        called += change.moved
        assert abs(change.values[0] - 0.02) < 4 * change.sigmas[0] < 0.03
        error = basis @ (change.tangent - tangent)
        spread = basis @ change.covariance @ basis.T
        nees.append(error @ np.linalg.solve(spread, error) / 3)
    assert 0.4 < np.mean(nees) < 1.9
    assert called >= (9 if shake_mm else 12)


def test_no_movement_is_no_movement() -> None:
    rng = np.random.default_rng(6)
    cameras = rig()
    known = calibration(cameras)
    for shake_mm in (0.0, 0.1) * 3:
        wrong = np.sqrt(np.diagonal(known.covariance)) * rng.standard_normal(6)
        tracks = Run(shake_mm=shake_mm, frames=200).tracks(cameras, moved(cameras, wrong), rng)
        found = rig_change(tracks, known)
        assert found is not None and not found[0].moved


@pytest.mark.parametrize("late_s", [-0.004, 0.0, 0.002])
def test_a_camera_that_exposes_late_is_named_and_does_not_look_moved(late_s: float) -> None:
    rng = np.random.default_rng(11)
    cameras = rig()
    run = Run(shake_mm=0.05, noise_px=0.05, late_s=late_s, bob_mm=2.0)
    tracks = run.tracks(cameras, cameras, rng)
    found = rig_change(tracks, calibration(cameras))
    assert found is not None
    change, _ = found
    assert abs(change.late_s - late_s) < 3 * change.slate_s < 1e-3
    assert change.unsynchronised == (late_s != 0.0) and not change.moved


def test_a_poor_calibration_is_not_a_movement() -> None:
    """20 µm off is nothing for a calibration that is sure to 30 µm; a sure one has moved."""
    cameras = rig()
    rng = np.random.default_rng(7)
    tracks = Run().tracks(
        cameras, moved(cameras, along_perpendicular(cameras, 0.02, 0.0, 0.0)), rng
    )
    poor, good = (
        rig_change(tracks, calibration(cameras, sd)) for sd in ((1e-3, 0.03), (2e-5, 5e-4))
    )
    assert poor is not None and good is not None
    assert not poor[0].moved and good[0].moved


def test_wrong_pairs_do_not_count() -> None:
    cameras = rig()
    rng = np.random.default_rng(8)
    tracks = Run(shake_mm=0.02).tracks(
        cameras, moved(cameras, along_perpendicular(cameras, 0.02, 0.0, 0.0)), rng
    )
    some = rng.random(len(tracks)) < 0.06
    shift = rng.uniform(2, 30, some.sum())
    tracks.loc[some, "right_v_px"] += shift
    tracks.loc[some, "ray_miss_mm"] -= shift / 10
    found = rig_change(tracks, calibration(cameras))
    assert found is not None
    change, _ = found
    assert abs(change.values[0] - 0.02) < 4 * change.sigmas[0] < 0.012
    assert change.pairs < len(tracks) - 0.8 * some.sum()


def test_bubbles_that_come_one_by_one_are_no_movement() -> None:
    """Ten of 0.3 s, half a minute apart: the gaps between them tell nothing of the noise."""
    cameras = rig()
    tracks = Run(shake_mm=0.0).tracks(cameras, cameras, np.random.default_rng(0))
    bubble = tracks["frame"] // 30
    seldom = tracks.assign(particle=bubble, frame=tracks["frame"] + 3000 * bubble)
    seldom["t_s"] = seldom["frame"] / 100.0
    found = rig_change(seldom, calibration(cameras))
    assert found is not None
    change, noise = found
    assert not change.moved and change.pairs == len(tracks)
    assert noise.white_mm == pytest.approx(0.0137, rel=0.2)  # 0.1 px in both views


@pytest.mark.parametrize("stated", [0.0, np.nan])
def test_tracks_that_state_no_noise_are_tested_as_well(stated: float) -> None:
    cameras = rig(90.0)
    tracks = Run().tracks(cameras, cameras, np.random.default_rng(0))
    noise = [f"{c.name}_{name}_px2" for c in cameras for name in ("suu", "suv", "svv")]
    known = rig_change(tracks, calibration(cameras))
    bare = rig_change(tracks.assign(**dict.fromkeys(noise, stated)), calibration(cameras))
    assert known is not None and bare is not None
    np.testing.assert_allclose(bare[0].tangent, known[0].tangent, rtol=1e-6)


def test_the_noise_is_learned() -> None:
    rng = np.random.default_rng(9)
    t = np.arange(500) / 100
    gap = oscillation(t, 0.1, rng) + 0.01 * rng.standard_normal(len(t))
    ones = np.ones(len(t))
    frames = np.arange(len(t))
    series = Series(frames, 0 * frames, t, gap, ones, ones[:, None])
    noise = learned_noise([series])
    (rms, decay, hz), *rest = noise.shake
    assert not rest
    assert hz == pytest.approx(SHAKE_HZ, rel=0.03)
    assert rms == pytest.approx(0.1, rel=0.4)
    assert decay == pytest.approx(1 / (SHAKE_DAMPING * 2 * np.pi * SHAKE_HZ), rel=0.6)
    assert np.hypot(noise.white_mm, noise.wander_mm) == pytest.approx(0.01, rel=0.5)


def test_noise_covariance_of_two_bubbles() -> None:
    """Shake is common, wander and white noise are not."""
    noise = Noise(0.01, 0.02, 0.1, ((0.1, 0.5, 10.0),))
    frames = np.array([0, 0, 1, 1])
    series = Series(
        frames, np.array([0, 1, 0, 1]), frames * 0.1, np.zeros(4), np.ones(4), np.eye(4)
    )
    found = noise.covariance(series)
    assert found[0, 0] == pytest.approx(0.01**2 + 0.02**2 + 0.1**2)
    assert found[0, 1] == pytest.approx(0.1**2)
    later = 0.1**2 * np.exp(-0.2)
    assert found[0, 3] == pytest.approx(later)
    assert found[0, 2] == pytest.approx(later + 0.02**2 * np.exp(-1))


def test_the_share_of_a_movement_is_gaussian_conditioning() -> None:
    """Against the joint posterior of calibration error and movement, worked out at once."""
    rng = np.random.default_rng(10)
    movement = Movement.of(rig(), 1, 0, DriftPrior())
    root = 1e-3 * rng.standard_normal((8, 8))
    before = root @ root.T
    rows, sigma, seen = rng.standard_normal((5, 8)), 0.02, rng.standard_normal(5) * 0.05
    both = np.zeros((14, 14))
    both[:8, :8], both[8:, 8:] = before, movement.covariance
    by_both = np.concatenate([rows, rows[:, 2:]], 1)
    gain = both @ by_both.T @ np.linalg.inv(by_both @ both @ by_both.T + sigma**2 * np.eye(5))
    mean, left = gain @ seen, both - gain @ by_both @ both
    total = np.concatenate([np.eye(8), np.eye(8)[:, 2:]], 1)
    tangent, covariance = drift_posterior(total @ mean, total @ left @ total.T, before, movement)
    assert np.allclose(tangent, mean[8:], atol=1e-9)
    assert np.allclose(covariance, left[8:, 8:], atol=1e-11)


def test_words_say_it_once() -> None:
    cameras = rig()
    rng = np.random.default_rng(11)
    known = calibration(cameras)
    pairs = PairCollector(known)
    still = PairCollector(known)
    pairs.add(Run().tracks(cameras, moved(cameras, along_perpendicular(cameras, 0.08, 0, 0)), rng))
    still.add(Run().tracks(cameras, cameras, rng))
    findings = (Finding.CALIBRATION_OFFSET, Finding.UNCLEAR_OFFSET)
    model = replace(default_model(cameras).pairs[0, 1], findings=findings)
    models = {(0, 1): model}
    said = with_change(models, pairs.found(), known)
    assert said["calibration_problem"]
    assert said["words"][:-1] == model.sentences(without=findings[:1]) and len(said["words"]) == 3
    assert "'right'" in said["words"][-1] and "--refine-rig" in said["words"][-1]
    assert with_change(models, still.found(), known)["words"] == model.sentences()
    assert PairCollector(known).found() is None
    plain = default_model(cameras).pairs
    off = with_change(models | plain, None, known, (1, 7.0, -4.0))
    assert off["calibration_problem"] and "+7.00 px" in off["words"][-1]


def run_of_three(which: int, frames: int) -> tuple[Calibration, Array, pd.DataFrame]:
    """Return a calibration, the true points and the tracks of a run in which one camera is 0.08 mm
    higher along y than calibrated."""
    cameras = tuple(true_cameras(run_preset("swarm_three").calibration).values())
    names = tuple(f"{c.name}.{n.split('.')[1]}" for c in cameras[1:] for n in NAMES)
    covariance = np.diag(np.tile(np.repeat(np.square((2e-5, 5e-4)), 3), 2))
    known = Calibration(
        cameras, np.zeros(0, np.int64), np.zeros((0, 3)), {}, covariance, names, ((), (), ())
    )
    true = list(cameras)
    up = np.array([0.0, 0.0, 0.0, 0.0, 0.08, 0.0])
    pose = moved_pose(cameras[which].camera_from_rig.inverse(), up)
    true[which] = replace(cameras[which], camera_from_rig=pose.inverse())
    rng, t = np.random.default_rng(which), np.arange(frames) / 100.0
    points = np.stack([8 * np.cos(11 * t), 5 * (t - t.mean()), 8 * np.sin(11 * t)], -1)
    uv = [c.project(points) + 0.1 * rng.standard_normal((frames, 2)) for c in true]
    uv[0][::3] = np.nan  # the first camera misses every third frame
    found = triangulate_views(cameras, uv, 0.1)
    table = pd.DataFrame({"frame": np.arange(frames), "particle": 0, "t_s": t})
    table[["x_mm", "y_mm", "z_mm"]] = found.points_mm
    table["ray_miss_mm"] = np.sqrt(np.nanmean(found.ray_miss_mm**2, axis=1))
    for camera, pixels in zip(cameras, uv):
        table[[f"{camera.name}_u_px", f"{camera.name}_v_px"]] = pixels
        table[[f"{camera.name}_d{x}_px" for x in "uv"]] = 0.0
        spread = np.array([0.01, 0.0, 0.01]) + 0.0 * pixels[:, :1]
        table[[f"{camera.name}_s{x}_px2" for x in ("uu", "uv", "vv")]] = spread
    return known, points, table


@pytest.mark.parametrize("which", [0, 1, 2])
def test_of_three_cameras_the_one_that_moved_is_named(which: int) -> None:
    known, _, table = run_of_three(which, 300)
    pairs = PairCollector(known)
    pairs.add(table)
    change = pairs.found()
    assert change is not None and change.moved
    assert change.culprit == known.cameras[which].name
    assert abs(change.values[0]) == pytest.approx(0.08, abs=4 * change.sigmas[0])
    assert known.cameras[which].name in {change.camera, change.against}


@pytest.mark.parametrize("which", [0, 1, 2])
def test_of_three_cameras_the_one_that_moved_is_refined(which: int) -> None:
    known, points, table = run_of_three(which, 120)
    model = ShakeModel(modes=(RigMode(SHAKE_HZ, 0.03, (1e-3, 1e-3, 1e-3)),))
    refined = telerig.smooth(table, known, model=model, refine_rig=True)
    change = refined.summary["rig_change"]
    assert change["moved"] and change["camera"] == known.cameras[which].name
    assert change["tangent"][4] == pytest.approx(0.08, abs=0.006)
    found = refined.trajectories[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    if which == 0:  # the rig frame is that of the first camera, where it is now
        points = points - known.cameras[0].camera_from_rig.rotation.T @ [0.0, 0.08, 0.0]
    assert np.abs((found - points).mean(0)).max() < 0.006
    before = table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    assert np.abs((before - points).mean(0)).max() > 0.015


def test_a_long_run_is_collected_in_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "_MOST_COLLECTED", 400)
    cameras, known = rig(), calibration(rig())
    true = along_perpendicular(cameras, 0.08, 0, 0)
    tracks = Run(frames=1500, rate_hz=500.0).tracks(
        cameras, moved(cameras, true), np.random.default_rng(12)
    )
    pairs = PairCollector(known)
    for first in range(0, len(tracks), 50):
        pairs.add(tracks.iloc[first : first + 50])
        assert sum(map(len, pairs.parts)) <= 400
    kept = np.concatenate([part["frame"] for part in pairs.parts])
    assert np.array_equal(kept, np.arange(0, 1500, 4))
    found, every = pairs.found(), rig_change(tracks, known)
    assert found is not None and every is not None and found.moved
    assert np.all(np.abs(found.values - [0.08, 0, 0]) < 3 * found.sigmas)
    assert np.all(found.sigmas < 1.5 * every[0].sigmas)


def test_smoothing_refuses_the_calibration_of_fewer_cameras() -> None:
    from telerig.estimator.smoothing.results_folder import _check_tracks

    known, file = calibration(rig()), Path("tracks.csv")
    run: Any = SimpleNamespace(name="rise", path=Path("runs") / "rise")
    tracks = SimpleNamespace(summary={"image_size_px": {"left": [1, 1], "right": [1, 1]}})
    _check_tracks(tracks, file, run, known)
    _check_tracks(object(), file, run, known)
    with pytest.raises(InputError, match="tracked with cameras left, right, the calibration has"):
        _check_tracks(tracks, file, run, replace(known, cameras=known.cameras[:1]))


def test_refused() -> None:
    with pytest.raises(InputError, match="prior standard deviations of a movement"):
        DriftPrior(rotation_rad=0.0)
    first, _ = rig()
    with pytest.raises(CalibrationError, match="same line of sight"):
        drift_covariance((first, first), DriftPrior())
    cameras = rig()
    few = Run(frames=8).tracks(cameras, cameras, np.random.default_rng(0))
    assert rig_change(few, calibration(cameras)) is None
    with pytest.raises(InputError, match="refine-rig"):
        telerig.smooth(few, calibration(cameras), refine_rig=True)


def test_the_graph_refines_the_rig_with_the_shake() -> None:
    """The movement is found beside the shake; positions along the shared axis lose its bias."""
    cameras = rig()
    rng = np.random.default_rng(12)
    tangent = along_perpendicular(cameras, 0.06, 3e-5, 4e-5)
    run = Run(frames=150, shake_mm=0.03)
    tracks = run.tracks(cameras, moved(cameras, tangent), rng)
    model = ShakeModel(
        modes=tuple(
            RigMode(SHAKE_HZ, SHAKE_DAMPING, (0.0, 0.03 / np.sqrt(2), 0.0), c, None) for c in (0, 1)
        )
    )
    known = calibration(cameras)
    refined = telerig.smooth(tracks, known, model=model, refine_rig=True)
    change = refined.summary["rig_change"]
    assert change["moved"] and "has moved against 'left'" in change["words"]
    values = offset_roll_pitch(cameras, np.array(change["place_mm"])) @ tangent
    assert abs(change["offset_mm"] - values[0]) < 4 * change["soffset_mm"] < 0.02
    height = 5 * (np.arange(run.frames) / run.rate_hz - (run.frames - 1) / 2 / run.rate_hz)
    bias = [float((s["y_mm"] - height).mean()) for s in (tracks, refined.trajectories)]
    assert abs(bias[0]) > 0.02 and abs(bias[1]) < 0.006
    direct = rig_change(tracks, known)
    assert direct is not None
    assert abs(change["offset_mm"] - direct[0].values[0]) < 2 * change["soffset_mm"]
    pose = np.array(change["rig_from_camera"]["translation_mm"])
    true = moved(cameras, tangent)[1].camera_from_rig.inverse().translation_mm
    was = cameras[1].camera_from_rig.inverse().translation_mm
    assert np.linalg.norm(pose - true) < 0.3 * np.linalg.norm(was - true)


def test_tracks_on_disk_are_refined_by_all_their_parts() -> None:
    """The movement is in the last part; of long runs on disk only the first part was looked at."""
    cameras, rng = rig(), np.random.default_rng(12)
    now = moved(cameras, along_perpendicular(cameras, 0.06, 3e-5, 4e-5))
    still = Run(frames=75).tracks(cameras, cameras, rng)
    later = Run(frames=150).tracks(cameras, now, rng).query("frame >= 75")
    known = calibration(cameras)
    whole = refinement_of([pd.concat([still, later], ignore_index=True)], known, True)
    parts = refinement_of([still, later], known, True)
    first = refinement_of([still], known, True)
    assert whole is not None and parts is not None and first is not None
    assert parts.tangent == pytest.approx(whole.tangent, rel=0.05, abs=1e-5)
    assert np.abs(parts.tangent).max() > 5 * np.abs(first.tangent).max()


@pytest.mark.parametrize("samples", [40, 41])
def test_the_gradient_of_the_noise_is_that_of_its_likelihood(samples: int) -> None:
    rng = np.random.default_rng(3)
    t = 0.002 * np.arange(samples)
    spectrum = _spectrum(t, rng.standard_normal(samples) + np.sin(300 * t), 0.8, 0.3)
    log = np.log([0.5, 0.3, 0.05, 0.4, 0.2, 40.0, 0.2, 0.1, 90.0])

    def cost(place: np.ndarray) -> float:
        return spectrum.cost(_noise(place))[0]

    _, slope = spectrum.cost(_noise(log))
    steps = 1e-6 * np.eye(len(log))
    numeric = [(cost(log + step) - cost(log - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(slope, numeric, rtol=1e-5, atol=1e-6)
