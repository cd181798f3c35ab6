"""The calibration's share of the errors: in points, tables, words, and with many bubbles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from shake_learning_data import CAMERAS, run, true_model

import telerig
from telerig.errors import TelerigWarning
from telerig.estimator.calibration.quality.comparison import compare_calibrations
from telerig.estimator.calibration.result.calibration import (
    Calibration,
    calibration_from_cameras,
)
from telerig.estimator.smoothing.graph import crowd
from telerig.estimator.smoothing.graph.solve import Options, solve
from telerig.estimator.smoothing.problem.calibration_share import calibration_share
from telerig.estimator.smoothing.problem.problem import SmoothingProblem
from telerig.estimator.smoothing.terminal_summary import smoothing_words
from telerig.estimator.tracking.tracks import Tracks, load_tracks, tracking_words
from telerig.io.results.calibration_words import NO_COVARIANCE
from telerig.io.simulation.presets import run_preset
from telerig.io.tables.run import TRACKS
from telerig.io.tables.table import CALIBRATION_SHARE, EXTRAPOLATED
from telerig.rig.pose import Pose

pytestmark = pytest.mark.usefixtures("without_advice", "known_low_passes")

Array = NDArray[np.float64]
COLUMNS = [*CALIBRATION_SHARE, EXTRAPOLATED]
LENS = Calibration(
    CAMERAS, np.zeros(0, int), np.zeros((0, 3)), {}, np.diag([9e-6, 9e-6, *[1e-16] * 6]),
    ("left.k1", "right.k1", *(f"right.{n}" for n in "abcdef")), (("k1",), ("k1",)),
)  # fmt: skip


@dataclass(frozen=True)
class Swarm:
    dataset: telerig.Dataset
    calibration: Calibration
    tracks: Tracks


@pytest.fixture(scope="module")
def swarm(tmp_path_factory: pytest.TempPathFactory) -> Swarm:
    folder = tmp_path_factory.mktemp("share") / "swarm"
    rng = np.random.default_rng(1)
    config = run_preset("swarm", frames=12, bubbles=8)
    dataset = telerig.simulate(config, rng=rng, out=folder, images=False)
    calibration = telerig.calibrate(dataset, model="radial")
    return Swarm(dataset, calibration, telerig.track(dataset.runs["swarm"].load(), calibration))


def test_the_share_is_what_triangulation_adds(swarm: Swarm) -> None:
    rng, calibration = np.random.default_rng(0), swarm.calibration
    points = rng.uniform(-15, 15, (4, 5, 3))
    pixels = [camera.project(points.reshape(-1, 3)) for camera in calibration.cameras]
    found = calibration.triangulate(*pixels, sigma_px=0.05)
    share = calibration.common_covariance(points)
    assert share.shape == (4, 5, 3, 3)
    added = found.covariance_mm2 - found.measurement_covariance_mm2
    np.testing.assert_allclose(share.reshape(-1, 3, 3), added, atol=1e-12)
    points[0, 0, 1] = np.nan
    assert np.isnan(calibration.common_covariance(points)[0, 0]).all()


def test_shares_scatter_as_calibrations_do(swarm: Swarm) -> None:
    """Points that shift as the calibration is redrawn from its covariance have this scatter."""
    rng, calibration = np.random.default_rng(3), swarm.calibration
    points = rng.uniform(-20, 20, (40, 3))
    pixels = [camera.project(points) for camera in calibration.cameras]
    root = np.linalg.cholesky(calibration.covariance + 1e-18 * np.eye(len(calibration.covariance)))
    moved, growth = [], []
    for _ in range(60):
        change = dict(zip(calibration.covariance_names, root @ rng.standard_normal(len(root))))
        left, right = (
            camera.with_parameters(**{n: camera[n] + change[f"{camera.name}.{n}"] for n in free})
            for camera, free in zip(calibration.cameras, calibration.free)
        )
        tangent = [change[f"right.{n}"] for n in
                   ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")]  # fmt: skip
        pose = right.rig_from_camera @ Pose.from_rotvec(tangent[:3], tangent[3:])
        cameras = (left, replace(right, camera_from_rig=pose.inverse()))
        redrawn = replace(calibration, cameras=cameras)
        moved.append(redrawn.triangulate(*pixels, sigma_px=0.05).points_mm - points)
        affine = np.linalg.lstsq(np.column_stack([points, np.ones(40)]), moved[-1], rcond=None)[0]
        growth.append(np.trace(affine[:3]) / 3)
    sd = np.sqrt(np.diagonal(calibration.common_covariance(points), axis1=1, axis2=2))
    ratio = np.mean(np.array(moved) ** 2, axis=(0, 1)) / (sd**2).mean(0)
    assert (ratio > 0.6).all() and (ratio < 1.5).all()
    stated = calibration.scale_sd(points.mean(0))
    assert 0.6 < np.mean(np.square(growth)) / stated**2 < 1.5
    assert swarm.tracks.summary["shapes"]["scale_sd"] == pytest.approx(stated, rel=0.3)


def test_beyond_dots_is_outside_their_hull_in_any_camera(swarm: Swarm, tmp_path: Path) -> None:
    calibration = swarm.calibration
    hull = [[400.0, 200.0], [900.0, 200.0], [900.0, 600.0], [400.0, 600.0]]
    boxed = replace(calibration, diagnostics={"dots_hull_px": {"left": hull, "right": hull[::-1]}})
    points = np.random.default_rng(0).uniform(-25, 25, (200, 3))
    inside = np.ones(200, bool)
    for camera in calibration.cameras:
        u, v = camera.project(points).T
        inside &= (u >= 400) & (u <= 900) & (v >= 200) & (v <= 600)
    found = boxed.beyond_dots(points)
    assert found is not None and 0.1 < inside.mean() < 0.9
    np.testing.assert_array_equal(found, ~inside)
    assert replace(calibration, diagnostics={}).beyond_dots(points) is None
    used = calibration.residuals[calibration.residuals["weight"] > 0]
    for camera in calibration.cameras:
        mine = used[used["camera"] == camera.name]
        corners = np.array(calibration.diagnostics["dots_hull_px"][camera.name])
        for axis, name in enumerate(("u_px", "v_px")):
            assert corners[:, axis].max() == pytest.approx(mine[name].max(), abs=1e-3)
    calibration.save(tmp_path / "saved")
    again = telerig.load_calibration(tmp_path / "saved")
    np.testing.assert_array_equal(again.beyond_dots(points), calibration.beyond_dots(points))


def test_tracks_have_the_share_at_their_end(swarm: Swarm, tmp_path: Path) -> None:
    table, tracks = swarm.tracks.table, swarm.tracks
    assert list(table.columns[-4:]) == COLUMNS
    assert TRACKS.names(["left", "right"])[-4:] == COLUMNS
    points = table[["x_mm", "y_mm", "z_mm"]].to_numpy()
    share = swarm.calibration.common_covariance(points)
    sd = table[list(CALIBRATION_SHARE)].to_numpy()
    np.testing.assert_allclose(sd**2, np.diagonal(share, axis1=1, axis2=2))
    beyond = swarm.calibration.beyond_dots(points)
    assert beyond is not None and 0 < beyond.mean() < 1
    np.testing.assert_array_equal(table[EXTRAPOLATED], beyond)
    assert tracks.summary["extrapolated"] == pytest.approx(beyond.mean())
    np.testing.assert_allclose(
        tracks.summary["calibration_sd_mm"], np.sqrt((sd**2).mean(0)), rtol=1e-9
    )
    words = tracking_words(tracks.summary, 1.0)
    assert f"{100 * beyond.mean():.2g} % of the positions lie beyond the dots" in words
    assert "The calibration adds errors of" in words
    tracks.save(tmp_path / "tracks")
    file = tmp_path / "tracks" / "tracks.csv"
    pd.read_csv(file).drop(columns=COLUMNS).to_csv(file, index=False)
    with pytest.warns(TelerigWarning, match="changed"):
        old = load_tracks(tmp_path / "tracks")
    assert not set(COLUMNS) & set(old.table) and len(old.table) == len(table)


def test_trajectories_have_the_share_whatever_the_tracks_have(swarm: Swarm) -> None:
    old = swarm.tracks.table.drop(columns=COLUMNS)
    stage = swarm.dataset.runs["swarm"].load()
    smoothing = telerig.smooth(old, swarm.calibration, stage=stage, model="default")
    found = smoothing.trajectories
    words = smoothing_words(smoothing)
    assert f"{100 * found[EXTRAPOLATED].mean():.2g} % of the positions lie beyond the dots" in words
    assert list(found.columns[-4:]) == COLUMNS
    both = found.merge(swarm.tracks.table, on=["frame", "particle"], suffixes=("", "_tracked"))
    for name in CALIBRATION_SHARE:
        np.testing.assert_allclose(both[name], both[f"{name}_tracked"], rtol=0.2, atol=1e-4)


def test_the_unknown_share_of_an_imported_calibration_is_not_zero(swarm: Swarm) -> None:
    imported = calibration_from_cameras(swarm.calibration.cameras)
    assert swarm.calibration.covariance_known and not imported.covariance_known
    run = swarm.dataset.runs["swarm"].load()
    tracks = telerig.track(run, imported)
    assert not set(CALIBRATION_SHARE) & set(tracks.table)
    assert "calibration_sd_mm" not in tracks.summary
    assert tracks.summary["warnings"][-1] == NO_COVARIANCE
    smoothing = telerig.smooth(tracks, imported, stage=run, model="default")
    assert not set(CALIBRATION_SHARE) & set(smoothing.trajectories)
    assert smoothing.summary["warnings"].count(NO_COVARIANCE) == 1
    for words in (tracking_words(tracks.summary, 1.0), smoothing_words(smoothing)):
        assert "The calibration adds errors of" not in words
    for name in imported.covariance_names:
        assert np.isnan(imported.sd(name))
    assert imported.to_pandas()["sd"].isna().all()
    assert np.isnan(imported.to_xarray()["covariance"]).all()
    compared = compare_calibrations(imported, swarm.calibration)
    assert compared.known == (False, True)


def spread_out(bubbles: int) -> tuple[SmoothingProblem, Array]:
    """Bubbles from one corner of the field to the other, and a lens that is unsure there."""
    problem, lab, _ = run(np.random.default_rng(1), bubbles=bubbles, seconds=0.3)
    shift = np.linspace(-1, 1, bubbles)[:, None] * [45.0, 0.0, 0.0]
    seen, far = problem.observations, lab + shift[:, None]
    uv = seen.uv_px.copy()
    for index, camera in enumerate(CAMERAS):
        mine = seen.camera == index
        at = seen.item[mine], seen.frame[mine]
        uv[mine] += camera.project(far[at]) - camera.project(lab[at])
    moved = tuple(
        replace(b, start_mm=b.start_mm + s, guess_mm=b.guess_mm + s)
        for b, s in zip(problem.bubbles, shift)
    )
    share = calibration_share(LENS, far[:, ::20].reshape(-1, 3), 0.3)
    assert share is not None
    return replace(
        problem, bubbles=moved, observations=replace(seen, uv_px=uv), calibration=share
    ), far


def test_every_bubble_of_a_crowd_has_the_calibrations_errors_at_its_own_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, lab = spread_out(6)
    sd = []
    for joint in (True, False):
        monkeypatch.setattr(crowd, "jointly", lambda _, joint=joint: joint)
        solution = solve(problem, true_model(), Options(robust=False))
        assert solution.covariances is not None
        rows = solution.graph.bubble.position
        variance = np.diagonal(rows @ solution.covariances.bubbles @ rows.T, axis1=1, axis2=2)
        sd.append(np.sqrt(variance).reshape(6, -1, 3)[:, 30, 0])
    alone, many = sd
    prior = np.sqrt(LENS.common_covariance(lab[:, 30])[:, 0, 0])
    assert prior[0] > 0.025 and alone[0] > 1.2 * alone[2], (prior, alone, many)
    assert (many > 0.97 * alone).all(), "no error is hidden"
    assert (many < 1.5 * alone).all(), "what the run tells of the lens is left out, no more"
