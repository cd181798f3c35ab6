"""Scenes that are not backlit: dark hearts of bright spots are no bubbles, and a word says why."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from places import REAL

from telerig.arrays import Array
from telerig.estimator.bubbles.detect import find_bubbles
from telerig.estimator.bubbles.lighting import NOT_BACKLIT, on_bright_spots, share_of_hearts
from telerig.estimator.bubbles.single_images import write_bubbles

PLACES = np.stack(np.meshgrid(np.arange(60, 500, 90), np.arange(60, 400, 90)), -1).reshape(-1, 2)


def spots(reach: float, seed: int = 0) -> Array:
    """Return an image of bright spots, ``reach`` times as wide as their dark hearts, on grey."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:400, :500]
    image = np.full(u.shape, 60.0)
    for u0, v0 in PLACES + rng.uniform(-3, 3, PLACES.shape):
        radius, far = rng.uniform(7, 14), np.hypot(u - u0, v - v0)
        image[far < reach * radius] = rng.uniform(140, 200)
        image[far < radius] = 40.0
    image = cv2.GaussianBlur(image, (0, 0), 1.5) + rng.normal(0, 2, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("reach", [1.3, 1.8, 2.3])
def test_dark_hearts_of_bright_spots_are_no_bubbles(reach: float, tmp_path: Path) -> None:
    image = spots(reach)
    found = find_bubbles(image)
    assert found.bright_spots >= 0.9 * len(PLACES) and len(found.accepted) <= 2
    assert np.sum(found.rejected["reason"] == "dark heart of a bright spot") == found.bright_spots
    cv2.imwrite(str(tmp_path / "spots.png"), image)
    (words,) = write_bubbles([tmp_path / "spots.png"], tmp_path / "out")
    assert "the scene is not backlit" in words and "put the light behind the bubbles" in words


@pytest.mark.parametrize("heart", [0.3, 1.0])
def test_shadows_with_a_bright_heart_on_a_lit_screen_are_bubbles(heart: float) -> None:
    rng = np.random.default_rng(1)
    v, u = np.mgrid[:400, :500]
    image = 180.0 - 0.1 * u
    for u0, v0 in PLACES:
        far = np.hypot(u - u0, v - v0)
        image[far < 12.0] = 30.0
        image[far < 4.0] = 180.0 * heart
    image = cv2.GaussianBlur(image, (0, 0), 1.2) + rng.normal(0, 2, image.shape)
    found = find_bubbles(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    assert len(found.accepted) == len(PLACES) and not found.bright_spots


@pytest.mark.skipif(not REAL.is_dir(), reason="the real images are not here")
@pytest.mark.parametrize(
    "name",
    [
        *(f"bubble_pair/cam{k}frame000000.tif" for k in (1, 2)),
        *(
            pytest.param(f"bubbles_microgravity/images/ZeroG_FlightDay_Test_{end}.png",
                         marks=pytest.mark.slow)
            for end in ("C1S0014_img006001", "C1S0019_img011890", "_C1S0004_IMG_S0001005070",
                        "_C1S0004_IMG_S0001012062")
        ),
    ],
)  # fmt: skip
def test_no_real_backlit_frame_is_said_not_to_be(name: str) -> None:
    image = cv2.imread(str(REAL / name), cv2.IMREAD_UNCHANGED)
    assert image is not None
    found = find_bubbles(image)
    ellipse = found.accepted[["u_px", "v_px", "a_px", "b_px", "angle_rad"]].to_numpy(float)
    share = share_of_hearts(*on_bright_spots(image, found.field, ellipse, found.clusters))
    assert share < 0.3 * NOT_BACKLIT and not found.bright_spots
