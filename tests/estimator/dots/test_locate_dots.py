"""Dots found and measured in whole pictures, rendered by an independent program and real."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from places import REAL, ROOT

from telerig.errors import InputError
from telerig.estimator.dots.fit.luminance import Reason
from telerig.estimator.dots.locate import DotMeasurement, locate_dots, measure_dots
from telerig.io.simulation.images.plates import Light, Plate, image_centres, render
from telerig.io.simulation.images.sensor import digitise
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec

Array = NDArray[np.float64]
PLATE = REAL / "dic_stereo_dots"
COLUMNS = "u_px v_px suu_px2 suv_px2 svv_px2 a_px b_px angle_rad chi2_dof inner_level outer_level"


def _load_renderer() -> ModuleType:
    path = ROOT / "benchmarks" / "dot_renderer.py"
    spec = importlib.util.spec_from_file_location("dot_renderer", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["dot_renderer"] = module
    spec.loader.exec_module(module)
    return module


renderer = _load_renderer()


def scene(radius: float, *, tilt_deg: float = 0.0, size: int = 200, **options: Any) -> Any:
    """A lattice of dots two diameters apart before the tilt foreshortens it."""
    rng = np.random.default_rng(int(10 * radius + tilt_deg))
    shape = renderer.tilted_disc(radius, np.deg2rad(tilt_deg), 0.6)
    index = np.stack(np.meshgrid(*[np.arange(-30, 31)] * 2), axis=-1).reshape(-1, 2)
    centres = index * 4.0 @ shape.T + (size - 1) / 2 + rng.uniform(-0.5, 0.5, (len(index), 2))
    margin = radius + 7
    inside = np.all((centres > margin) & (centres < size - 1 - margin), axis=1)
    values = {"blur_px": 0.8, "dot_level": 190.0, "ground_level": 40.0, "subpixels": 8} | options
    return renderer.Scene(size, size, centres[inside], shape, **values)


def errors(table: pd.DataFrame, truth: Array) -> tuple[Array, pd.DataFrame]:
    """Centre errors (N, 2) in the order of ``truth``, and the rows that belong to it."""
    found = table[["u_px", "v_px"]].to_numpy()
    gap = np.linalg.norm(found[None] - truth[:, None], axis=-1)
    nearest = np.argmin(gap, axis=1)
    assert len(set(nearest.tolist())) == len(truth)
    return found[nearest] - truth, table.iloc[nearest]


def normalised(gap: Array, table: pd.DataFrame) -> float:
    """RMS error over the predicted one."""
    suu, suv, svv = table[["suu_px2", "suv_px2", "svv_px2"]].to_numpy().T
    u, v = gap.T
    square = (svv * u * u - 2 * suv * u * v + suu * v * v) / (suu * svv - suv**2)
    return float(np.sqrt(np.mean(square) / 2))


def reasons(measured: DotMeasurement, u: float, v: float, within: float = 6.0) -> list[str]:
    table = measured.rejected
    return table.reason[np.hypot(table.u_px - u, table.v_px - v) < within].tolist()


@pytest.mark.parametrize(
    ("radius", "tilt", "blur", "noise", "swap"),
    [
        pytest.param(4.0, 0.0, 0.8, 3.0, False, marks=pytest.mark.slow),
        pytest.param(4.0, 65.0, 0.6, 1.5, False, marks=pytest.mark.slow),
        (4.0, 65.0, 1.5, 3.0, True),
        (10.0, 40.0, 0.8, 3.0, True),
        (22.0, 30.0, 1.0, 1.0, False),
    ],
)
def test_every_dot_where_it_is(
    radius: float, tilt: float, blur: float, noise: float, swap: bool
) -> None:
    levels = (40.0, 190.0) if swap else (190.0, 40.0)
    look = {"blur_px": blur, "dot_level": levels[0], "ground_level": levels[1]}
    truth = scene(
        radius, tilt_deg=tilt, size=int(np.interp(radius, [4, 10, 22], [140, 200, 440])), **look
    )
    image = renderer.picture(renderer.render(truth), noise, 8, np.random.default_rng(1))
    measured = measure_dots(image)
    assert measured.polarity == ("black_on_white" if swap else "white_on_black")
    assert len(measured.dots) == len(truth.centres_px)
    gap, table = errors(measured.dots, truth.centres_px)
    bound = renderer.centre_bound_px(truth, np.hypot(noise, np.sqrt(1 / 12)))
    assert np.sqrt(np.mean((gap / bound) ** 2)) < 1.25
    assert normalised(gap, table) == pytest.approx(1.0, abs=0.25)
    assert table.chi2_dof.mean() == pytest.approx(1.0, abs=0.1)
    assert table.a_px.median() == pytest.approx(radius, rel=0.02)
    assert table.b_px.median() == pytest.approx(radius * np.cos(np.deg2rad(tilt)), rel=0.06)
    assert table.blur_px.median() == pytest.approx(blur, rel=0.06)
    assert table.inner_level.median() == pytest.approx(levels[0], abs=6.0)
    assert table.outer_level.median() == pytest.approx(levels[1], abs=2.0)


@pytest.mark.parametrize("kind", ["uint8", "uint16", "12 bits at the top of 16", "float"])
def test_any_depth_gives_the_same_dots(kind: str) -> None:
    truth = scene(7.0, size=120)
    clean = renderer.render(truth)
    rng = np.random.default_rng(2)
    noisy = clean + 1.5 * rng.standard_normal(clean.shape)
    image = {
        "uint8": np.rint(noisy).astype(np.uint8),
        "uint16": np.rint(16 * noisy).astype(np.uint16),
        "12 bits at the top of 16": (np.rint(16 * noisy).astype(np.uint16) * 16).astype(np.uint16),
        "float": noisy / 255.0,
    }[kind]
    table = locate_dots(image)
    assert len(table) == len(truth.centres_px)
    gap, matched = errors(table, truth.centres_px)
    assert np.sqrt(np.mean(gap**2)) < 0.008
    assert matched.chi2_dof.mean() == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("radius", [4.0, 10.0])
def test_photon_noise_keeps_the_covariance_honest(radius: float) -> None:
    truth = scene(radius, size=int(np.interp(radius, [4, 10], [200, 420])))
    clean = renderer.render(truth)
    rng = np.random.default_rng(12)
    image = np.rint(clean + np.sqrt(0.04 * clean) * rng.standard_normal(clean.shape))
    gap, table = errors(locate_dots(image.astype(np.uint16)), truth.centres_px)
    assert table.chi2_dof.mean() == pytest.approx(1.0, abs=0.05)
    assert normalised(gap, table) == pytest.approx(1.0, abs=0.13)


def test_a_slope_of_light_does_not_move_the_dots() -> None:
    slope = 0.002
    truth = scene(5.0, size=220, light_per_px=(slope, 0.0))
    image = renderer.render(truth) + 0.05 * np.random.default_rng(3).standard_normal((220, 220))
    gap, _ = errors(locate_dots(image), truth.centres_px)
    # A centroid would be off by slope * R^2 / 4 = 0.0125 px, an unblurred light by slope * 0.72.
    assert abs(np.mean(gap[:, 0])) < 2e-4
    assert abs(np.mean(gap[:, 1])) < 2e-4


@pytest.mark.parametrize(
    ("radius", "ground", "dot", "offset", "noise"),
    [
        pytest.param(3.0, 0.0, 160.0, 0.0, 3.0, marks=pytest.mark.slow),
        (7.0, 0.0, 160.0, -12.0, 3.0),
        pytest.param(7.0, 270.0, 60.0, 0.0, 3.0, marks=pytest.mark.slow),
        (3.0, 250.0, 60.0, 0.0, 4.0),
    ],
    ids=["black", "far below black", "white", "half white"],
)
def test_a_clipped_background_costs_no_dot(
    radius: float, ground: float, dot: float, offset: float, noise: float
) -> None:
    plate = scene(radius, tilt_deg=25.0, ground_level=ground, dot_level=dot)
    rng = np.random.default_rng(12)
    grey = renderer.render(plate) + offset
    grey += noise * rng.standard_normal(grey.shape)
    gap, table = errors(locate_dots(grey.clip(0, 255).round().astype(np.uint8)), plate.centres_px)
    sd = np.sqrt(table[["suu_px2", "svv_px2"]].to_numpy())
    assert np.abs(gap / sd).max() < 5.0
    assert 0.5 < normalised(gap, table) < 1.25


def test_floats_without_noise_are_measured_like_integers() -> None:
    """A rendered or binary image has no noise at all, but its dots are not exact."""
    truth = scene(7.0, size=120)
    clean = renderer.render(truth)
    for levels in (np.rint(clean), 255.0 * (clean > 115.0)):
        whole = locate_dots(levels.astype(np.uint8))
        assert len(whole) == len(truth.centres_px)
        pd.testing.assert_frame_equal(locate_dots(levels), whole, rtol=1e-6)
    smooth = locate_dots(clean)
    assert len(smooth) == len(truth.centres_px)
    assert 1e-5 < np.sqrt(smooth["suu_px2"].median()) < 0.01


def test_columns_and_conventions() -> None:
    truth = scene(9.0, tilt_deg=50.0)
    table = locate_dots(renderer.picture(renderer.render(truth), 1.0, 8, np.random.default_rng(4)))
    assert table.columns.tolist()[:-3] == [*COLUMNS.split(), "blur_px", "ring", "noise"]
    assert table.columns.tolist()[-3:] == ["edge_suu_px2", "edge_suv_px2", "edge_svv_px2"]
    assert (table.a_px >= table.b_px).all()
    assert not table.ring.any()
    # The disc was tilted about the axis at 0.6 rad, so that is where its long axis lies.
    assert table.angle_rad.median() == pytest.approx(0.6, abs=0.02)


def test_partial_merged_tiny_and_glared_dots_are_named() -> None:
    rng = np.random.default_rng(5)
    image = np.full((240, 320), 60.0)
    for u, v, radius in [(0, 120, 12), (80, 60, 12), (103, 60, 12), (200, 60, 12), (60, 180, 12)]:
        cv2.circle(image, (u, v), radius, 180.0, -1, cv2.LINE_AA)
    cv2.circle(image, (260, 120), 3, 180.0, -1, cv2.LINE_AA)
    cv2.circle(image, (130, 180), 12, 180.0, -1, cv2.LINE_AA)
    cv2.circle(image, (200, 180), 12, 180.0, -1, cv2.LINE_AA)
    cv2.ellipse(image, (210, 172), (16, 9), 0, 0, 360, 400.0, -1)
    image = cv2.GaussianBlur(image, (0, 0), 0.9) + rng.standard_normal(image.shape)
    measured = measure_dots(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    assert reasons(measured, 6, 120) == ["touches the image border"]
    assert reasons(measured, 92, 60) == [Reason.NOT_ELLIPSE]
    assert reasons(measured, 260, 120) == ["much smaller than the other dots"]
    assert reasons(measured, 205, 177, 12.0) == [Reason.NOT_ELLIPSE]
    places = measured.dots[["u_px", "v_px"]].to_numpy()
    expected = np.array([[200, 60], [60, 180], [130, 180]])
    assert len(places) == 3
    for place in expected:
        assert np.min(np.linalg.norm(places - place, axis=1)) < 0.2


def test_dots_with_a_soft_glare_are_refused_or_right() -> None:
    """A soft highlight across an edge moved dots by up to 3 px that were accepted."""
    rng = np.random.default_rng(11)
    truth = scene(12.0, size=320)
    glare = np.zeros((320, 320))
    lit = truth.centres_px[::3]
    for centre in lit:
        angle = rng.uniform(0.0, 2 * np.pi)
        u, v = np.rint(centre + 10.0 * np.array([np.cos(angle), np.sin(angle)])).astype(int)
        cv2.circle(glare, (int(u), int(v)), 7, 120.0, -1, cv2.LINE_AA)
    image = renderer.render(truth) + cv2.GaussianBlur(glare, (0, 0), 4.0)
    table = locate_dots(renderer.picture(image, 2.0, 8, rng))
    apart = np.linalg.norm(table[["u_px", "v_px"]].to_numpy()[:, None] - truth.centres_px, axis=2)
    gap = table[["u_px", "v_px"]].to_numpy() - truth.centres_px[apart.argmin(1)]
    assert np.abs(gap / np.sqrt(table[["suu_px2", "svv_px2"]].to_numpy())).max() < 5.0
    assert len(truth.centres_px) - len(lit) <= len(table) < len(truth.centres_px)


def test_rings_are_marked_and_measured_by_their_outer_edge() -> None:
    truth = scene(18.0, size=260)
    image = renderer.render(truth)
    rng = np.random.default_rng(6)
    ringed = truth.centres_px[[0, 4]]
    for u, v in ringed:
        hole = (int(u) + 2, int(v) - 1)
        cv2.ellipse(image, hole, (6, 4), 30, 0, 360, 80.0, -1, cv2.LINE_AA)
    measured = measure_dots(renderer.picture(image, 1.5, 8, rng))
    gap, table = errors(measured.dots, truth.centres_px)
    assert table.ring.to_numpy().nonzero()[0].tolist() == [0, 4]
    assert np.max(np.abs(gap)) < 0.02
    assert table.chi2_dof.to_numpy()[[0, 4]] == pytest.approx(1.0, abs=0.2)


def test_dust_on_a_dot_is_left_out() -> None:
    truth = scene(12.0, size=200)
    image = renderer.render(truth)
    u, v = np.rint(truth.centres_px[0]).astype(int)
    image[v - 13 : v - 9, u - 2 : u + 2] -= 50.0
    gap, _ = errors(
        locate_dots(renderer.picture(image, 1.0, 8, np.random.default_rng(7))), truth.centres_px
    )
    assert np.linalg.norm(gap[0]) < 0.02


def test_a_strong_vignette_and_a_larger_mark() -> None:
    light = {"light_per_px": (0.003, 0.002)}
    small = scene(8.0, size=260, **light)
    middle = np.array([[128.3, 129.2]])
    apart = np.linalg.norm(small.centres_px - middle, axis=1) > 32
    small = replace(small, centres_px=small.centres_px[apart])
    big = replace(small, centres_px=middle, image_from_disc=renderer.tilted_disc(13.0, 0.0, 0.0))
    empty = renderer.render(replace(big, centres_px=np.zeros((0, 2))))
    image = renderer.render(small) + renderer.render(big) - empty
    table = locate_dots(renderer.picture(image, 1.0, 8, np.random.default_rng(8)))
    gap, matched = errors(table, np.concatenate([small.centres_px, middle]))
    assert len(table) == len(small.centres_px) + 1
    assert np.max(np.abs(gap)) < 0.025
    assert matched.a_px.iloc[-1] == pytest.approx(13.0, abs=0.05)


def test_light_that_falls_off_to_one_corner_moves_no_dot() -> None:
    """A gradient and a vignette together are no quadratic function of the place."""
    camera = Camera.create("c", (700, 700), 10.0)
    middles = np.array([(5.0 * x, 5.0 * y, 0.0) for x in range(-9, 10) for y in range(-9, 10)])
    many = len(middles)
    plate = Plate(
        middles, np.full(many, 2.2), np.zeros(many), dot_albedo=0.1, plate_albedo=0.75
    )  # fmt: skip
    squares = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        lean, towards = rng.uniform(0, 2 * np.pi, 2)
        turn = rotation_from_rotvec(np.deg2rad(35) * np.array([np.cos(lean), np.sin(lean), 0.0]))
        pose = Pose(turn, np.array([*rng.uniform(-1, 1, 2), 0.0]))
        light = Light(1.0, (0.4 * np.cos(towards), 0.4 * np.sin(towards)), 0.3)
        image = digitise(render(camera, pose, plate, light, blur_px=0.8), rng, read_noise=0.006)
        table = locate_dots(image, polarity="black_on_white")
        truth = image_centres(camera, pose, plate)
        gap = table[["u_px", "v_px"]].to_numpy()[:, None] - truth
        nearest = np.linalg.norm(gap, axis=-1).argmin(1)
        gap = gap[np.arange(len(gap)), nearest]
        squares.append(gap**2 / table[["suu_px2", "svv_px2"]].to_numpy())
    assert 0.8 < np.mean(np.concatenate(squares)) < 1.2


def test_a_bright_surround_of_the_plate_costs_nothing() -> None:
    """Its outline encloses every dot, whose pixels are not its own for that."""
    plate = scene(9.0, tilt_deg=40.0, size=280)
    near = np.all(np.abs(plate.centres_px - 139.5) < 80, axis=1)
    plate = replace(plate, centres_px=plate.centres_px[near])
    grey = renderer.render(plate) + 3.0 * np.random.default_rng(4).standard_normal((280, 280))
    framed = grey + 30.0
    framed[35:-35, 35:-35] = grey[35:-35, 35:-35]
    alone, within = measure_dots(grey), measure_dots(framed, polarity="white_on_black")
    assert any(r == "touches the image border" for r in within.rejected.reason)
    gap, table = errors(within.dots, plate.centres_px)
    assert np.sqrt(np.mean(gap**2)) < 1.2 * np.sqrt(
        np.mean(errors(alone.dots, plate.centres_px)[0] ** 2)
    )
    assert np.median(table.suu_px2) < 1.1 * np.median(alone.dots.suu_px2)


@pytest.mark.parametrize("level", [0.0, 3.0])
def test_nothing_is_found_in_nothing(level: float) -> None:
    rng = np.random.default_rng(9)
    image = np.clip(np.rint(90 + level * rng.standard_normal((128, 160))), 0, 255).astype(np.uint8)
    measured = measure_dots(image)
    assert len(measured.dots) == 0
    assert measured.dots.columns.tolist()[:9] == COLUMNS.split()[:9]
    assert measured.rejected.columns.tolist()[-1] == "reason"


@pytest.mark.parametrize(
    ("image", "options", "message"),
    [
        (np.zeros((20, 20, 3), np.uint8), {}, "colour"),
        (np.full((20, 20), np.nan), {}, "not finite"),
        (np.zeros((20, 20), np.complex128), {}, "type"),
        (np.zeros((3, 20), np.uint8), {}, "shape"),
        (np.zeros((20, 20), np.uint8), {"polarity": "white"}, "white_on_black"),
        (np.zeros((20, 20), np.uint8), {"min_diameter_px": 0.0}, "positive"),
    ],
)
def test_bad_input_is_refused_in_words(image: Any, options: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        locate_dots(image, **options)


@pytest.mark.skipif(not PLATE.is_dir(), reason="real images are not beside the repository")
@pytest.mark.parametrize(
    ("name", "complete"), [pytest.param("0001_0", 80, marks=pytest.mark.slow), ("0012_1", 84)]
)
def test_real_print(name: str, complete: int) -> None:
    image = cv2.imread(str(PLATE / f"CalB-sys2-{name}.jpeg"), cv2.IMREAD_GRAYSCALE)
    measured = measure_dots(np.asarray(image))
    assert measured.polarity == "black_on_white"
    assert abs(len(measured.dots) - complete) <= 8
    assert measured.dots.ring.sum() == 3
    assert measured.dots.b_px.min() > 35.0
    inside = measured.rejected.b_px > 35.0
    whole = measured.rejected[inside].u_px.between(50, image.shape[1] - 50)
    whole &= measured.rejected[inside].v_px.between(50, image.shape[0] - 50)
    assert not whole.any()
