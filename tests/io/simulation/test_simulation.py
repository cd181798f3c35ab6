"""Simulated calibrations: their files, their truth, and that a person could have taken them."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
import tifffile

from telerig.errors import InputError
from telerig.io.simulation import preset_names
from telerig.io.simulation.calibration.scene import (
    hand_held_views,
    true_cameras,
    true_target,
)
from telerig.io.simulation.calibration_files import exact_dots, view_image
from telerig.io.simulation.images.plates import (
    Plate,
    disc_coverage,
    image_centres,
    pixel_from_plate,
)
from telerig.io.simulation.presets import PRESETS, RUN_PRESETS, preset
from telerig.io.simulation.simulate import simulate
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose


@cache
def scene(name, seed=0, **changes):
    config = preset(name, **changes)
    rng = np.random.default_rng(seed)
    cameras, target = true_cameras(config), true_target(config, rng)
    return config, cameras, target, hand_held_views(config, cameras, target, rng)


def image_jacobian(camera, view, target):
    """Determinant of d(u, v) / d(x, y) at the middle of the target."""
    middle = target.points_mm.mean(0)
    steps = middle + 0.01 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    uv = pixel_from_plate(camera, view.rig_from_target, steps, target.plate)
    return np.linalg.det(uv[1:] - uv[0])


def tilt_deg(camera, view):
    axis = camera.camera_from_rig.rotation[2]
    return np.degrees(np.arccos(axis @ view.rig_from_target.rotation[:, 2]))


@pytest.mark.parametrize("seed", range(4))
def test_paper_shows_every_dot_whole_in_every_image(seed):
    _, cameras, target, views = scene("paper", seed)
    assert len(views) == 12 and len(target.ids) == 15
    for view in views:
        assert view.cameras == ("left", "right")
        for camera in cameras.values():
            rim = np.linspace(0, 2 * np.pi, 40)
            circle = np.stack([np.cos(rim), np.sin(rim), 0 * rim], -1)
            outline = target.points_mm[:, None] + target.diameter_mm[:, None, None] / 2 * circle
            uv = camera.project(view.rig_from_target.apply(outline.reshape(-1, 3)))
            assert uv.min() > 5 and uv.max() < 511 - 5


@pytest.mark.parametrize("name", [n for n in PRESETS if n != "two_sided"])
def test_opaque_plates_show_both_cameras_their_front(name):
    config, cameras, target, views = scene(name)
    for view in views:
        for camera in (cameras[name] for name in view.cameras):
            assert image_jacobian(camera, view, target) > 0
            low, high = config.tilt_deg
            assert low - 1e-6 <= tilt_deg(camera, view) <= high + 1e-6


def test_three_cameras_stand_in_a_fan_and_see_the_target_in_turn():
    config, cameras, _, views = scene("three")
    axes = np.array([camera.camera_from_rig.rotation[2] for camera in cameras.values()])
    np.testing.assert_allclose(np.degrees(np.arccos(axes @ axes[0])), [0, 60, 120], atol=1.5)
    assert all(camera.camera_from_rig.translation_mm[2] == 0 for camera in cameras.values())
    assert [view.cameras for view in views[:3]] == list(config.seen_by)
    assert config.seen_by[2] == tuple(cameras)


def test_views_of_a_camera_that_is_not_there_are_refused():
    with pytest.raises(InputError, match="seen_by names top"):
        scene("three", seen_by=(("left", "top"),))


def test_two_sided_plates_show_one_camera_their_back():
    _, cameras, target, views = scene("two_sided")
    for view in views:
        sides = [image_jacobian(camera, view, target) > 0 for camera in cameras.values()]
        assert sorted(sides) == [False, True]


def test_print_errors_and_known_distance():
    config = preset("unbounded", print_factor=2.0)
    target = true_target(config, np.random.default_rng(0))
    error = target.points_mm - config.target.nominal_mm(target.ids)
    assert np.allclose(error.std(0), 0.04, rtol=0.06)
    ends = [target.points_mm[target.ids == dot][0] for dot in config.target.scale_dots]
    assert target.scale_distance_mm == pytest.approx(np.linalg.norm(ends[0] - ends[1]), abs=5e-3)
    assert target.scale_distance_mm != np.linalg.norm(ends[0] - ends[1])


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_renders_dots_where_the_truth_says(name):
    config, cameras, target, views = scene(name)
    exact = exact_dots(config, cameras, target, views[:1])
    for camera in (cameras[seeing] for seeing in views[0].cameras):
        image = view_image(
            replace(config, noise=0.0, light_gradient=0.0, dirt=0),
            camera,
            target,
            views[0].rig_from_target,
            np.random.default_rng(1),
        )
        width, height = camera.image_size_px
        assert image.shape == (height, width) and image.dtype == np.uint8
        mine = exact[(exact["camera"] == camera.name) & (exact["inside"] == 1)]
        plain = mine[~config.target.is_mark(mine["dot"].to_numpy())]
        uv = np.rint(plain[["u_px", "v_px"]].to_numpy()).astype(int)
        at_dots = image[uv[:, 1], uv[:, 0]].astype(float)
        middle = (config.black + config.white) / 2 * 255
        white = config.target.polarity == "white_on_black"
        assert len(at_dots) > 10
        assert np.mean((at_dots > middle) == white) > 0.98


def test_dataset_without_images(tmp_path):
    config = preset("paper", views=4, sigma_px=0.05)
    dataset = simulate(config, rng=np.random.default_rng(5), out=tmp_path / "set", images=False)
    measured = pd.read_csv(tmp_path / "set" / "calibration" / "dots.csv")
    exact = pd.read_csv(tmp_path / "set" / "truth" / "dots.csv")
    assert list(measured) == ["view", "camera", "dot", "u_px", "v_px", "sigma_px", "row", "column"]
    both = measured.merge(exact, on=["view", "camera", "dot", "row", "column"])
    assert len(both) == len(measured) == 4 * 2 * 15
    error = both[["u_px_x", "v_px_x"]].to_numpy() - both[["u_px_y", "v_px_y"]].to_numpy()
    assert error.std() == pytest.approx(0.05, rel=0.15)
    assert list(dataset.rig.cameras) == ["left", "right"]
    assert dataset.rig.rotvec_from_first_deg == {"right": (0.0, 90.0, 0.0)}
    assert dataset.rig.target.scale_distance_mm == dataset.truth["target"]["scale_distance_mm"]


def test_truth_reproduces_the_exact_dots(tmp_path):
    simulate("near_telecentric", rng=np.random.default_rng(2), out=tmp_path, images=False)
    truth = json.loads((tmp_path / "truth" / "truth.json").read_text())
    exact = pd.read_csv(tmp_path / "truth" / "dots.csv")
    target = preset("near_telecentric").target
    points = dict(zip(truth["target"]["dot"], truth["target"]["points_mm"]))
    for (view, name), rows in exact.groupby(["view", "camera"]):
        values = truth["cameras"][name]
        parameters = dict(values["parameters"])
        pose = values["camera_from_rig"]
        camera = Camera.create(
            name,
            tuple(values["image_size_px"]),
            parameters.pop("scale_px_per_mm"),
            camera_from_rig=Pose.from_rotvec(
                np.radians(pose["rotvec_deg"]), pose["translation_mm"]
            ),
            rho_mm=values["rho_mm"],
            **parameters,
        )
        place = truth["views"][view]["rig_from_target"]
        moved = Pose(np.array(place["rotation"]), np.array(place["translation_mm"]))
        seen = np.array([points[dot] for dot in rows["dot"]])
        plate = Plate(seen, target.diameter_mm(rows["dot"].to_numpy()), np.zeros(len(seen)))
        uv = image_centres(camera, moved, plate)
        assert np.allclose(uv, rows[["u_px", "v_px"]], atol=1e-9)
        assert 1e-6 < np.abs(uv - camera.project(moved.apply(seen))).max() < 0.01
    assert truth["config"]["name"] == "near_telecentric" and truth["seed"]["entropy"] == 2


def test_centres_of_images_are_those_of_their_area():
    """Rasters of dots through an ordinary lens; the images of their centres lie elsewhere."""
    camera = Camera.create("side", (400, 300), 30.0, kappa_per_mm=8e-3, k1=2e-3)
    pose = Pose.from_rotvec([0.5, -0.4, 0.2], [0.3, -0.2, 0.0])
    dots = np.array([[-3.0, -2, 0], [0, 0, 0], [3, 1, 0], [-2, 2.5, 0]])
    plate = Plate(dots, np.full(4, 1.6), np.zeros(4))
    expected = image_centres(camera, pose, plate)
    for dot, centre in zip(dots, expected):
        one = Plate(dot[None], plate.diameter_mm[:1], plate.hole_mm[:1])
        area = disc_coverage(camera, pose, one, one.dots_mm, one.diameter_mm, one.hole_mm, 0.7)
        v, u = np.indices(area.shape)
        assert np.allclose([np.average(u, weights=area), np.average(v, weights=area)], centre,
                           atol=2e-4)  # fmt: skip
    assert np.abs(expected - pixel_from_plate(camera, pose, dots, plate)).max() > 0.05


def test_same_seed_same_bytes(tmp_path):
    config = preset("paper", views=2, dirt=3, glare=0.2)
    files = []
    for name in ("a", "b"):
        simulate(config, rng=np.random.default_rng(7), out=tmp_path / name)
        found = sorted(p for p in (tmp_path / name).rglob("*") if p.is_file())
        files.append({p.relative_to(tmp_path / name): p.read_bytes() for p in found})
    assert files[0] == files[1] and len(files[0]) == 4 + 3
    simulate(config, rng=np.random.default_rng(8), out=tmp_path / "c")
    assert (tmp_path / "c" / "truth" / "dots.csv").read_bytes() not in files[0].values()


def test_one_camera_views_and_bit_depth(tmp_path):
    config = preset("paper", views=3, single_camera_views=2, bit_depth=12)
    simulate(config, rng=np.random.default_rng(0), out=tmp_path)
    seen = {p.relative_to(tmp_path / "calibration").as_posix() for p in tmp_path.rglob("*.tif")}
    assert seen == {"left/view00.tif", "right/view00.tif", "right/view01.tif", "left/view02.tif"}
    image = tifffile.imread(tmp_path / "calibration/left/view02.tif")
    assert image.dtype == np.uint16 and 1500 < image.max() < 4096


def test_outliers(tmp_path):
    config = preset("dense", outlier_fraction=0.1, outlier_px=20.0, views=4)
    simulate(config, rng=np.random.default_rng(0), out=tmp_path, images=False)
    keys = ["view", "camera", "dot"]
    both = pd.read_csv(tmp_path / "calibration/dots.csv").merge(
        pd.read_csv(tmp_path / "truth/dots.csv"), on=keys
    )
    error = np.hypot(both["u_px_x"] - both["u_px_y"], both["v_px_x"] - both["v_px_y"])
    assert np.mean(error > 0.1) == pytest.approx(0.1, abs=0.02)


def test_refusals(tmp_path):
    with pytest.raises(InputError, match="no preset 'papr'"):
        preset("papr")
    with pytest.raises(InputError, match="no setting"):
        preset("paper", angel_deg=3)
    with pytest.raises(InputError, match="no plate can stand"):
        simulate(preset("paper", angle_deg=150.0), rng=np.random.default_rng(0), out=tmp_path / "a")
    with pytest.raises(InputError, match="no pose"):
        simulate(preset("paper", border_px=150.0), rng=np.random.default_rng(0), out=tmp_path / "b")
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "mine.txt").write_text("x")
    with pytest.raises(InputError, match="exists and is not empty"):
        simulate("paper", rng=np.random.default_rng(0), out=tmp_path / "c")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c"]


@pytest.mark.parametrize(
    "fault",
    [{"views": 0}, {"tilt_deg": (60.0, 20.0)}, {"outlier_fraction": 1.5}, {"blur_px": -1.0}],
)
def test_senseless_settings_are_refused_by_name(fault):
    with pytest.raises(InputError, match=next(iter(fault))):
        preset("paper", **fault)


def test_the_help_names_all_presets() -> None:
    assert (tuple(PRESETS), tuple(RUN_PRESETS)) == (preset_names.CALIBRATIONS, preset_names.RUNS)
    assert not set(PRESETS) & set(RUN_PRESETS), "the command could not reach one of them"
