"""Simulated runs: files that can be read, and a truth that agrees with cameras and clocks."""

import json
import tempfile
from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
import tifffile
from typer.testing import CliRunner

from telerig.errors import InputError
from telerig.io.dataset.run import load_run
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.config import (
    BubbleConfig,
    ImageConfig,
    RunConfig,
    SimulationConfig,
    StripConfig,
)
from telerig.io.simulation.presets import RUN_PRESETS, any_preset, run_preset
from telerig.io.simulation.run.scene import AXIS_RIG, run_scene
from telerig.io.simulation.run.views import camera_view
from telerig.io.simulation.simulate import simulate
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.scripts.main import app

LAB = ["x_lab_mm", "y_lab_mm", "z_lab_mm"]
SPEED = ["vx_lab_mm_s", "vy_lab_mm_s", "vz_lab_mm_s"]


@pytest.fixture(autouse=True, scope="module")
def _datasets_go_where_pytest_cleans_up(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("datasets")))
        yield


def few_views(name, **changes):
    config = run_preset(name, **changes)
    return replace(config, calibration=replace(config.calibration, views=2))


@cache
def scene(name, seed=0, **changes):
    config = run_preset(name, **changes)
    return run_scene(config, true_cameras(config.calibration), np.random.default_rng(seed))


@cache
def dataset(name, images=True, **changes):
    config = few_views(name, **changes)
    return simulate(config, rng=np.random.default_rng(7), images=images)


def truth_of(data, name):
    folder = data.path / "truth" / "runs" / name
    return (
        pd.read_csv(folder / "bubbles.csv"),
        pd.read_csv(folder / "cameras.csv"),
        json.loads((folder / "truth.json").read_text()),
    )


def cameras_from_truth(data):
    for name, c in data.truth["cameras"].items():
        pose = c["camera_from_rig"]
        yield (
            name,
            Camera.create(
                name,
                tuple(c["image_size_px"]),
                rho_mm=c["rho_mm"],
                camera_from_rig=Pose(np.array(pose["rotation"]), np.array(pose["translation_mm"])),
                **c["parameters"],
            ),
        )


@pytest.mark.parametrize("name, frames", [("rise", 6), ("swarm", 3), ("S2", 20)])
def test_pixels_of_the_truth_are_projections_of_the_truth(name, frames):
    data = dataset(name, images=False, frames=frames)
    bubbles, cameras, _ = truth_of(data, name)
    at = cameras.set_index("frame").loc[bubbles["frame"]]
    lab = bubbles[LAB].to_numpy()
    carriage = lab - AXIS_RIG * at[["position_mm"]].to_numpy()
    assert np.allclose(bubbles[["x_rig_mm", "y_rig_mm", "z_rig_mm"]], carriage, atol=1e-9)
    for camera, model in cameras_from_truth(data):
        shake = at[[f"{camera}_shake_{a}_mm" for a in "xyz"]].to_numpy()
        seen = bubbles[f"{camera}_visible"].to_numpy() == 1
        uv = model.project((carriage - shake)[seen])
        assert seen.sum() >= frames
        assert np.allclose(bubbles.loc[seen, [f"{camera}_u_px", f"{camera}_v_px"]], uv, atol=1e-7)
        offset = bubbles.loc[seen, [f"{camera}_silhouette_u_px", f"{camera}_silhouette_v_px"]] - uv
        assert 0 < np.abs(offset.to_numpy()).max() < 3


def test_rise_is_the_run_of_2004():
    run = scene("rise")
    assert run.lab_mm.shape == (1, 59, 3) and np.allclose(np.diff(run.t_s), 0.01)
    assert 4.0 <= run.population.d_eq_mm[0] <= 5.0
    views = [camera_view(run, frame, j) for frame in range(59) for j in range(2)]
    assert all(view.whole.all() and len(view.whole) == 1 for view in views)
    shift = np.concatenate([view.silhouette_px - view.centre_px for view in views])
    assert 0.1 < np.linalg.norm(shift, axis=1).mean() < 2
    speed = np.linalg.norm(run.lab_mm_s[0], axis=-1)
    assert abs(speed.mean() - 280) < 12
    climb = run.lab_mm[0, 40:] @ AXIS_RIG - run.position_mm[40:]
    assert np.abs(np.diff(climb)).max() < 1.5


@pytest.mark.parametrize("seed", range(3))
def test_swarm_has_its_bubbles_in_view_and_they_come_and_go(seed):
    run = scene("swarm", seed)
    inside = np.zeros((2, 100, len(run.lab_mm)), bool)
    overlap = np.zeros((2, 10))
    for k, frame in enumerate(range(0, 100, 10)):
        for j in range(2):
            view = camera_view(run, frame, j)
            inside[j, frame, view.particle[view.visible]] = True
            overlap[j, k] = view.overlap[view.visible].sum()
            radius = np.sqrt(view.area_px2 / np.pi)
            assert radius.min() > 6.5 and radius.max() < 46
    some = inside[:, ::10]
    assert 16 <= some.sum(-1).mean() <= 25
    assert np.any(some[:, 0] & ~some[:, -1]) and np.any(~some[:, 0] & some[:, -1])
    assert overlap.mean() > 0.3


def test_bubbles_never_touch():
    run = scene("swarm", bubbles=30)
    gap = np.linalg.norm(run.lab_mm[:, None] - run.lab_mm, axis=-1).min(-1)
    room = (run.population.d_eq_mm[:, None] + run.population.d_eq_mm) / 2
    off = ~np.eye(len(gap), dtype=bool)
    assert np.all(gap[off] > room[off])
    config = run_preset("rise", bubbles=60)
    with pytest.raises(InputError, match="do not fit"):
        run_scene(config, true_cameras(config.calibration), np.random.default_rng(0))


def test_crossing_pairs_separate_as_stated():
    run = scene("crossing")
    motion = run.config.motion
    assert len(run.closest_s) == 5
    for k, closest in enumerate(run.closest_s):
        gap = run.lab_mm[2 * k] - run.lab_mm[2 * k + 1]
        distance = np.linalg.norm(gap, axis=-1)
        rate = np.linalg.norm(np.gradient(gap, run.t_s, axis=0), axis=-1).mean()
        expected = np.hypot(motion.closest_mm, rate * (run.t_s - closest))
        assert np.allclose(distance, expected, atol=1e-9)
        assert np.hypot(motion.closest_mm, rate * 0.01) == pytest.approx(0.3, rel=1e-9)
        assert run.t_s[0] < closest < run.t_s[-1]


def test_velocities_are_derivatives_of_places():
    run = scene("S4")
    middle = (run.lab_mm_s[:, 1:] + run.lab_mm_s[:, :-1]) / 2
    slope = np.diff(run.lab_mm, axis=1) / np.diff(run.t_s)[:, None]
    kick = np.hypot(10 * np.sqrt(2 / 0.3), 2 * 2.0 * np.sqrt(0.03 * (2 * np.pi * 6) ** 3))
    lateral = (slope - middle)[..., [0, 2]]
    assert lateral.std() == pytest.approx(kick * np.sqrt(1e-3 / 12), rel=0.06)


def test_images_can_be_read_and_show_the_bubble_where_the_truth_says():
    data = dataset("rise", frames=4)
    run = load_run(data.runs["rise"].path)
    bubbles, _, _ = truth_of(data, "rise")
    assert run.frame_count == 4 and list(run.cameras) == ["left", "right"]
    assert np.allclose(run.t_s, np.arange(4) / 100)
    for camera in run.cameras:
        image = run.image(camera, 2).astype(float)
        assert image.shape == (512, 512)
        row = bubbles[bubbles["frame"] == 2].iloc[0]
        u, v = row[f"{camera}_silhouette_u_px"], row[f"{camera}_silhouette_v_px"]
        near = np.hypot(*(np.mgrid[:512, :512][::-1] - np.array([u, v])[:, None, None])) < 45
        dark = near & (image < 0.55 * np.median(image[near]))
        place = np.argwhere(dark).mean(0)[::-1]
        assert np.allclose(place, [u, v], atol=0.7)


def test_heartless_bubbles_darken_their_silhouette_area():
    """Sum of the missing light over the screen's level = area (1 - rim), noise and dirt away."""
    config = few_views("rise", frames=2)
    bubble = replace(config.bubble, heart=(0.0, 0.0), ring=0.0, rim=(0.1, 0.1))
    image = ImageConfig(
        texture=0.0, gradient=0.0, vignetting=0.0, window_dirt=0, lens_dirt=0, flicker=0.0,
        read_noise=0.0, shot_noise=0.0, bit_depth=16, screen=0.8,
    )  # fmt: skip
    data = simulate(replace(config, bubble=bubble, image=image), rng=np.random.default_rng(1))
    bubbles, _, _ = truth_of(data, "rise")
    for camera in ("left", "right"):
        pixels = tifffile.imread(data.runs["rise"].path / camera / "000001.tif") / 65535
        missing = (1 - pixels / 0.8) / 0.9
        row = bubbles[bubbles["frame"] == 1].iloc[0]
        assert missing.sum() == pytest.approx(row[f"{camera}_area_px2"], rel=1e-3)
        v, u = np.mgrid[:512, :512]
        centre = [(missing * u).sum() / missing.sum(), (missing * v).sum() / missing.sum()]
        expected = row[[f"{camera}_silhouette_u_px", f"{camera}_silhouette_v_px"]]
        assert np.allclose(centre, expected.astype(float), atol=2e-2)


def test_same_seed_same_bytes_and_same_bubbles_without_images():
    first, second = (
        simulate(few_views("rise", frames=2), rng=np.random.default_rng(3)) for _ in range(2)
    )
    files = sorted(p.relative_to(first.path) for p in first.path.rglob("*") if p.is_file())
    assert len(files) > 12
    for file in files:
        assert (first.path / file).read_bytes() == (second.path / file).read_bytes(), file
    tables = simulate(few_views("rise", frames=2), rng=np.random.default_rng(3), images=False)
    for name in ("bubbles.csv", "cameras.csv"):
        file = f"truth/runs/rise/{name}"
        assert (tables.path / file).read_bytes() == (first.path / file).read_bytes()
    other = simulate(few_views("rise", frames=2), rng=np.random.default_rng(4), images=False)
    file = "truth/runs/rise/bubbles.csv"
    assert (tables.path / file).read_bytes() != (other.path / file).read_bytes()


def test_detections_have_the_noise_asked_for_and_no_names():
    data = dataset("swarm", images=False, frames=20)
    table = pd.read_csv(data.runs["swarm"].path / "detections.csv")
    bubbles, _, _ = truth_of(data, "swarm")
    assert "particle" not in table
    for camera in ("left", "right"):
        found = table[table["camera"] == camera]
        whole = bubbles[bubbles[f"{camera}_whole"] == 1]
        assert len(found) == len(whole)
        errors = []
        for frame, group in found.groupby("frame"):
            true = whole.loc[
                whole["frame"] == frame, [f"{camera}_silhouette_u_px", f"{camera}_silhouette_v_px"]
            ].to_numpy()
            gap = group[["u_px", "v_px"]].to_numpy()[:, None] - true
            nearest = np.argmin(np.linalg.norm(gap, axis=-1), -1)
            errors.append(gap[np.arange(len(gap)), nearest])
        assert np.std(np.concatenate(errors)) == pytest.approx(0.1, rel=0.1)
    assert np.all(table["a_px"] >= table["b_px"])


def test_missed_and_false_detections_and_given_names():
    config = few_views("swarm", frames=15)
    table = replace(config.table, missed=0.2, false_per_image=2.0, particle_ids=True)
    data = simulate(replace(config, table=table), rng=np.random.default_rng(7), images=False)
    found = pd.read_csv(data.runs["swarm"].path / "detections.csv")
    bubbles, _, _ = truth_of(data, "swarm")
    false = found["particle"].isna()
    assert false.sum() == pytest.approx(2.0 * 30, abs=5 * np.sqrt(60))
    whole = bubbles["left_whole"].sum() + bubbles["right_whole"].sum()
    assert (~false).sum() == pytest.approx(0.8 * whole, abs=5 * np.sqrt(0.16 * whole))
    left = found[(found["camera"] == "left") & ~false].copy()
    left["particle"] = left["particle"].astype(int)
    joined = left.merge(bubbles, on=["frame", "particle"])
    assert np.abs(joined["u_px"] - joined["left_silhouette_u_px"]).max() < 0.6


def test_dropped_frames_are_told_and_read_as_missing():
    config = few_views("rise", frames=12)
    data = simulate(
        replace(config, image=replace(config.image, dropped=0.3)), rng=np.random.default_rng(2)
    )
    _, cameras, _ = truth_of(data, "rise")
    run = load_run(data.runs["rise"].path)
    assert run.frame_count == 12
    lost = {name: cameras[f"{name}_lost"].to_numpy() == 1 for name in ("left", "right")}
    assert 1 <= sum(gone.sum() for gone in lost.values()) <= 14
    for name, gone in lost.items():
        assert [run.image(name, frame) is None for frame in range(12)] == gone.tolist()


def test_presets_are_found_and_refused_by_name():
    assert isinstance(any_preset("swarm"), RunConfig)
    assert isinstance(any_preset("paper"), SimulationConfig)
    assert {"rise", "swarm", "crossing", "S0", "S6"} <= set(RUN_PRESETS)
    with pytest.raises(InputError, match="rise"):
        any_preset("rize")
    with pytest.raises(InputError, match="no setting"):
        run_preset("rise", frame=3)
    with pytest.raises(InputError, match="frames is 0"):
        run_preset("rise", frames=0)
    with pytest.raises(InputError, match="pairs"):
        run_preset("crossing", bubbles=7)
    with pytest.raises(InputError, match="d_eq_mm"):
        run_preset("rise", bubble=BubbleConfig(d_eq_mm=(0.0, 1.0)))


def test_the_command_takes_frames_and_bubbles(tmp_path):
    runner, out = CliRunner(), tmp_path / "data"
    words = ["simulate", "crossing", "--out", str(out), "--frames", "5", "--bubbles", "4"]
    result = runner.invoke(app, [*words, "--no-images", "--seed", "3"])
    assert result.exit_code == 0 and "run crossing" in result.output
    assert len(pd.read_csv(out / "runs" / "crossing" / "frames.csv")) == 5
    table = pd.read_csv(out / "runs" / "crossing" / "detections.csv")
    assert table.groupby(["frame", "camera"]).size().max() == 4
    paper = ["simulate", "paper", "--out", str(tmp_path / "no"), "--frames", "5", "--no-images"]
    refused = runner.invoke(app, paper)
    assert refused.exit_code == 2 and "without a run" in refused.output


def test_a_run_with_a_strip_of_marks_has_its_whole_truth():
    data = dataset("rise", frames=2, strip=StripConfig(dots=4))
    _, _, known = truth_of(data, "rise")
    assert known["config"]["strip"]["dots"] == 4
    marks = pd.read_csv(data.path / "truth" / "runs" / "rise" / "references.csv")
    assert set(marks["camera"]) == {"left", "right"}
