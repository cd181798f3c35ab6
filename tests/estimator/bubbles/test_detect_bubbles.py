"""Bubbles in rendered backlit images: places, shapes, covariances, flags, and refusals."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from bubble_outline_renderer import Drawn, centre_bound_px, draw
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.estimator.bubbles.detect import (
    detect_bubbles,
    find_bubbles,
    outline_centroid,
    outline_points,
)
from telerig.estimator.bubbles.outline.ellipse_geometry import DETECTION_COLUMNS, HARMONIC_COLUMNS
from telerig.io.simulation.images.bubbles import Look, Silhouette, transmission

Array = NDArray[np.float64]
WHITE = 3000.0


def digitised(
    image: Array, *, noise: float = 0.0, seed: int = 0, white: float = WHITE
) -> NDArray[np.uint16]:
    rng = np.random.default_rng(seed)
    soiled = white * (image + noise * rng.standard_normal(image.shape))
    return np.clip(np.round(soiled), 0, 65535).astype(np.uint16)


def level(shape: tuple[int, ...], white: float = WHITE) -> NDArray[np.float32]:
    return np.full(shape, white, np.float32)


@pytest.mark.parametrize(
    ("radius", "ratio", "blur", "heart", "tolerance"),
    [
        (6.0, 1.0, 0.7, 0.0, 0.01),
        (12.0, 1.6, 1.0, 0.4, 0.015),
        (20.0, 1.0, 2.5, 0.3, 0.03),
        (8.0, 1.0, 3.0, 0.0, 0.02),
    ],
)
def test_noise_free_ellipse_is_exact(
    radius: float, ratio: float, blur: float, heart: float, tolerance: float
) -> None:
    size = int(2 * radius * ratio**0.5 + 10 * blur + 20)
    truth = (size / 2 + 0.31, size / 2 - 0.17, radius * ratio**0.5, radius / ratio**0.5, 0.7)
    image = digitised(draw([Drawn(truth, heart=heart)], (size, size), blur_px=blur), white=40000)
    table = detect_bubbles(image, background=level(image.shape, 40000))
    assert list(table.columns) == DETECTION_COLUMNS
    assert len(table) == 1
    row = table.iloc[0]
    assert np.hypot(row["u_px"] - truth[0], row["v_px"] - truth[1]) < 0.003
    assert row["a_px"] == pytest.approx(truth[2], abs=tolerance)
    assert row["b_px"] == pytest.approx(truth[3], abs=tolerance)
    assert row["area_px2"] == pytest.approx(np.pi * truth[2] * truth[3], rel=2 * tolerance / radius)
    assert row["d_eq_px"] == pytest.approx(2 * radius, abs=3 * tolerance)
    assert row["edge_px"] == pytest.approx(blur, abs=0.05)
    assert row["contrast"] == pytest.approx(0.88, abs=0.02)
    if ratio > 1.0:
        assert row["angle_rad"] == pytest.approx(truth[4], abs=0.002)


@pytest.mark.parametrize(
    ("radius", "ratio", "blur", "noise", "heart"),
    [(7.0, 1.0, 0.8, 0.02, 0.0), (14.0, 1.5, 1.2, 0.01, 0.4)],
)
def test_centres_reach_the_bound_and_know_their_error(
    radius: float, ratio: float, blur: float, noise: float, heart: float
) -> None:
    copies, size = 120, int(2 * radius * ratio**0.5 + 10 * blur + 14)
    truth = (size / 2 + 0.2, size / 2 - 0.4, radius * ratio**0.5, radius / ratio**0.5, 0.5)
    bubble = Drawn(truth, heart=heart)
    clean = np.tile(draw([bubble], (size, size), blur_px=blur), (1, copies))
    image = digitised(clean, noise=noise, seed=3)
    table = detect_bubbles(image, background=level(image.shape))
    assert len(table) == copies
    u = table["u_px"].to_numpy()
    miss = np.stack(
        [(u - truth[0] + size / 2) % size - size / 2, table["v_px"].to_numpy() - truth[1]], axis=1
    )
    bound = centre_bound_px(bubble, (size, size), blur_px=blur, sigma=noise)
    assert np.sqrt(np.mean(miss**2) / (np.trace(bound) / 2)) < 1.25
    names = ["suu_px2", "suv_px2", "suv_px2", "svv_px2"]
    covariance = table[names].to_numpy().reshape(-1, 2, 2)
    scores = np.einsum("ni,nij,nj->n", miss, np.linalg.inv(covariance), miss) / 2
    assert 0.72 < np.mean(scores) < 1.32  # 120 pairs: 1 +- 0.09, three sigma
    assert 0.93 < table["chi2_dof"].mean() < 1.07


def test_harmonics_of_a_deformed_outline_come_back() -> None:
    size, radius = 90, 22.0
    harmonics = {3: (0.8, -0.4), 4: (0.3, 0.2), 5: (-0.1, 0.15)}
    truth = (44.7, 45.2, radius * 1.1, radius / 1.1, 0.4)
    image = draw([Drawn(truth, harmonics=harmonics)], (size, size), blur_px=1.0)
    table = detect_bubbles(digitised(image, noise=0.005), background=level(image.shape))
    row = table.iloc[0]
    assert np.hypot(row["u_px"] - truth[0], row["v_px"] - truth[1]) < 0.02
    wanted = [harmonics.get(k, (0.0, 0.0))[i] for k in (3, 4, 5, 6) for i in (0, 1)]
    found = row[HARMONIC_COLUMNS].to_numpy(dtype=float)
    assert found == pytest.approx(np.array(wanted), abs=0.04)
    assert row["flags"] == ""
    # The area's centroid, against the polygon of the drawn outline.
    fine = draw([Drawn(truth, harmonics=harmonics, level=0.0)], (size, size), blur_px=0.2)
    dark = 1.0 - fine
    v, u = np.mgrid[:size, :size]
    centroid = np.array([np.sum(dark * u), np.sum(dark * v)]) / np.sum(dark)
    assert outline_centroid(table)[0] == pytest.approx(centroid, abs=0.02)
    assert row["area_px2"] == pytest.approx(np.sum(dark), rel=0.003)


@pytest.mark.parametrize(("radius", "allowed"), [(9.0, 0.018), (13.0, 0.0125)])
def test_light_within_a_small_blurred_bubble_hardly_moves_it(radius: float, allowed: float) -> None:
    # A ring of light at 0.69 radii, brighter below: 2 to 3 blurs from the rim.
    angle = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    off = []
    for seed in range(6):
        place = np.random.default_rng(seed).uniform(28.0, 32.0, 2)
        outline = place + radius * np.stack([np.cos(angle), np.sin(angle)], 1)
        seen = transmission((60, 60), [Silhouette(outline, Look(ring=0.08), 1.6)])
        image = digitised(seen, noise=0.01, seed=seed)
        table = detect_bubbles(image, background=level(image.shape))
        off.append(outline_centroid(table)[0] - place)
    assert np.max(np.abs(np.mean(off, axis=0))) < allowed


def test_a_thing_at_the_rim_that_bends_an_outline_is_part_of_its_error() -> None:
    shape, white = (160, 320), 3000.0
    places = [(40.3 + 80 * i, 39.8 + 80 * j) for i in range(4) for j in range(2)]
    image = draw([Drawn((*place, 20, 20, 0.0)) for place in places], shape, blur_px=1.2)
    speck = Drawn((places[0][0] + 20, places[0][1], 4, 4, 0.0))
    image *= 0.5 + 0.5 * draw([speck], shape, blur_px=1.2)
    found = detect_bubbles(digitised(image, noise=0.01, white=white), background=level(shape))
    off = found[["u_px", "v_px"]].to_numpy() - places[0]
    k = int(np.argmin(np.hypot(*off.T)))
    covariance = found.loc[k, ["suu_px2", "suv_px2", "suv_px2", "svv_px2"]].to_numpy(float)
    square = off[k] @ np.linalg.solve(covariance.reshape(2, 2), off[k])
    assert np.hypot(*off[k]) > 0.05  # it is bent
    assert square < 2.0  # and says so; it is 11 without the variance of what bends it


def test_outline_points_lie_on_the_half_level() -> None:
    truth = (40.2, 39.6, 20.0, 14.0, 1.1)
    image = draw([Drawn(truth)], (80, 80), blur_px=0.8)
    row = detect_bubbles(digitised(image), background=level(image.shape)).iloc[0]
    points = outline_points(row, 40)
    x = (points[:, 0] - truth[0]) * np.cos(1.1) + (points[:, 1] - truth[1]) * np.sin(1.1)
    y = (points[:, 1] - truth[1]) * np.cos(1.1) - (points[:, 0] - truth[0]) * np.sin(1.1)
    assert np.max(np.abs(np.hypot(x / 20.0, y / 14.0) - 1.0)) < 0.003


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.int32])
def test_types_of_image(dtype: type) -> None:
    white = 200.0 if dtype is np.uint8 else WHITE
    clean = draw([Drawn((50.3, 48.8, 15.0, 13.0, 0.3), heart=0.4)], (100, 110), blur_px=1.0)
    image = digitised(clean, noise=0.01, white=white).astype(dtype)
    table = detect_bubbles(image, background=level(image.shape, white))
    assert len(table) == 1
    assert np.hypot(table["u_px"][0] - 50.3, table["v_px"][0] - 48.8) < 0.03
    assert 0.85 < table["chi2_dof"][0] < 1.15


def test_uneven_screen_is_estimated_from_the_image() -> None:
    rng = np.random.default_rng(5)
    v, u = np.mgrid[:240, :300]
    screen = 1.0 - 0.3 * ((u - 130) / 300) ** 2 - 0.25 * ((v - 160) / 240) ** 2
    truth = [(50.0, 60.0), (150.4, 130.7), (240.2, 190.5), (200.6, 50.1)]
    bubbles = [Drawn((*at, 14.0, 13.0, rng.uniform(0, 3)), heart=0.4) for at in truth]
    image = digitised(draw(bubbles, screen.shape, blur_px=1.0) * screen, noise=0.01)
    table = detect_bubbles(image)
    assert len(table) == 4
    gap = table[["u_px", "v_px"]].to_numpy()[None] - np.array(truth)[:, None]
    assert np.max(np.min(np.hypot(gap[..., 0], gap[..., 1]), axis=1)) < 0.05


def test_dirt_and_faint_shadows_are_rejected_with_a_reason() -> None:
    image = draw(
        [
            Drawn((60.0, 60.0, 15.0, 15.0, 0.0)),
            Drawn((120.0, 40.0, 2.5, 2.0, 0.0)),
            Drawn((140.0, 120.0, 12.0, 12.0, 0.0), level=0.8),
            Drawn((60.0, 140.0, 30.0, 4.0, 0.0)),
        ],
        (180, 190),
        blur_px=1.0,
    )
    bubbles = find_bubbles(digitised(image, noise=0.01), background=level(image.shape))
    assert len(bubbles.accepted) == 1
    reasons = {
        (round(row.u_px, -1), round(row.v_px, -1)): row.reason
        for row in bubbles.rejected.itertuples()
    }
    assert reasons[(120, 40)] == "smaller than 8 px"
    assert "contrast" in reasons[(140, 120)]
    assert "times as long as wide" in reasons[(60, 140)]


def test_blurred_bubble_among_sharp_ones_is_flagged() -> None:
    sharp = [Drawn((40.0 + 60 * i, 40.0, 14.0, 14.0, 0.0)) for i in range(4)]
    image = draw(sharp, (80, 280), blur_px=0.8)
    image = np.vstack([image, draw([Drawn((90.0, 40.0, 14.0, 14.0, 0.0))], (80, 280), blur_px=3.0)])
    table = detect_bubbles(digitised(image, noise=0.01), background=level(image.shape))
    assert sorted(table["flags"]) == ["", "", "", "", "defocus"]
    assert table["v_px"][table["flags"] == "defocus"].iloc[0] == pytest.approx(120.0, abs=0.05)


def test_bubble_only_at_the_border() -> None:
    truth = (3.0, 40.0, 18.0, 18.0, 0.0)
    image = draw([Drawn(truth, heart=0.4)], (80, 90), blur_px=1.0)
    table = detect_bubbles(digitised(image, noise=0.01), background=level(image.shape))
    assert len(table) == 1
    row = table.iloc[0]
    assert row["flags"] == "border"
    miss = np.array([row["u_px"] - truth[0], row["v_px"] - truth[1]])
    sigma = np.sqrt([row["suu_px2"], row["svv_px2"]])
    assert np.all(np.abs(miss) < 4.0 * sigma + 0.05)
    assert sigma[0] > 2.0 * sigma[1] or sigma[0] > 0.02


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.full((60, 80), 65535, np.uint16), "saturated"),
        (np.full((60, 80), 4095, np.uint16), "saturated"),
        (np.full((60, 80), 255, np.uint8), "saturated"),
        (np.full((60, 80), 120, np.uint8), "uniform"),
        (np.zeros((60, 80), np.uint16), "black"),
        (digitised(np.ones((200, 200)), noise=0.01), "no shadow"),
    ],
)
def test_images_without_bubbles_say_why(image: NDArray[np.generic], reason: str) -> None:
    table = detect_bubbles(image)
    assert len(table) == 0
    assert list(table.columns) == DETECTION_COLUMNS
    assert reason in table.attrs["reason"]


def test_clipped_screen_is_flagged() -> None:
    clean = draw([Drawn((50.0, 50.0, 15.0, 13.0, 0.3))], (100, 110), blur_px=1.0)
    image = np.minimum(digitised(clean, noise=0.01, white=290.0), 255).astype(np.uint8)
    table = detect_bubbles(image)
    assert list(table["flags"]) == ["saturated"]


@pytest.mark.parametrize("kind", ["white", "whiter", "compressed"])
def test_a_screen_without_noise_does_not_tell_that_of_the_rims(kind: str) -> None:
    truth = (50.3, 49.8, 15.0, 13.0, 0.3)
    clean = draw([Drawn(truth)], (100, 110), blur_px=1.0)
    level = {"white": 265.0, "whiter": 300.0, "compressed": 200.0}[kind]
    image = np.minimum(digitised(clean, noise=0.004, white=level), 255).astype(np.uint8)
    if kind == "compressed":
        code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 75])[1]
        image = cv2.imdecode(code, cv2.IMREAD_GRAYSCALE)
    row = detect_bubbles(image).iloc[0]
    sd = np.sqrt([row["suu_px2"], row["svv_px2"]])
    assert np.all(sd < 0.015)
    assert np.all(np.abs([row["u_px"] - truth[0], row["v_px"] - truth[1]]) < 3.0 * sd)


@pytest.mark.parametrize(
    ("image", "options"),
    [
        (np.zeros((20, 20, 3), np.uint8), {}),
        (np.zeros((5, 20), np.uint8), {}),
        (np.zeros((50, 50), np.complex128), {}),
        (np.full((50, 50), np.nan), {}),
        (np.ones((50, 50)), {"min_diameter_px": 0.0}),
        (np.ones((50, 50)), {"min_contrast": 2.0}),
        (digitised(np.eye(50)), {"background": np.ones((40, 50))}),
        (digitised(np.eye(50)), {"background": np.zeros((50, 50))}),
    ],
)
def test_bad_input_is_refused(image: NDArray[np.generic], options: dict[str, object]) -> None:
    with pytest.raises(InputError):
        detect_bubbles(image, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("gain", [0.5, 0.8, 1.3])
def test_light_that_differs_from_the_background_changes_no_outline(gain: float) -> None:
    drawn = [Drawn((30.3, 40.2, 18.0, 13.0, 0.4)), Drawn((85.1, 33.0, 11.0, 11.0, 0.0))]
    image = draw(drawn, (80, 120), blur_px=1.2)
    usual, other = (
        detect_bubbles(
            digitised(light * image, noise=0.005), background=level(image.shape)
        ).sort_values("u_px")
        for light in (1.0, gain)
    )
    assert len(other) == len(drawn)
    assert other["d_eq_px"].to_numpy() == pytest.approx(usual["d_eq_px"].to_numpy(), rel=0.003)


def test_image_without_light_says_so() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 40, (80, 120)).astype(np.uint16)
    found = find_bubbles(image, background=level(image.shape))
    assert found.accepted.empty
    assert "usual brightness" in found.reason
    assert found.rejected.empty


def test_no_bubble_is_seen_before_a_black_background() -> None:
    """Black tape on the tank's wall: 0 grey levels divided by a few are no shadow."""
    image = draw([Drawn((80.3, 60.2, 20.0, 20.0, 0.0))], (128, 200), blur_px=1.0)
    screen = level(image.shape)
    screen[40:80, 140:180] = 0.01 * WHITE
    taped = digitised(image, noise=0.005)
    taped[40:80, 140:180] = 0
    found = detect_bubbles(taped, background=screen)
    assert len(found) == 1 and found["u_px"][0] == pytest.approx(80.3, abs=0.1)


def test_background_brighter_than_white_makes_no_bubble_outside_the_field() -> None:
    image = digitised(np.ones((80, 120)), noise=0.005, white=250.0).clip(0, 255).astype(np.uint8)
    background = level(image.shape, 250.0)
    background[30:50, 70:90] = 256.4
    field = np.zeros(image.shape, bool)
    field[:, :60] = True
    assert find_bubbles(image, background=background, field=field).accepted.empty
