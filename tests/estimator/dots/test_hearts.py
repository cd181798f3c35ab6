"""Dots with a brighter or darker heart: the fit is at the rim, and its covariance is true."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from telerig.arrays import Array
from telerig.estimator.dots.locate import measure_dots

FINE = 5
"""Sub-pixels along u and v."""
RADIUS_PX, BLUR_PX, NOISE, SIDE = 8.0, 1.0, 2.0, 9


class Hearts(NamedTuple):
    """share : of the dots that have a heart. least, most : its extra light, relative to the dot.
    size : its radius relative to the dot. dark : whether the image is inverted. small : relative
    radius of every ninth dot."""

    share: float
    least: float
    most: float
    size: float = 0.5
    dark: bool = False
    small: float = 1.0


def plate(hearts: Hearts, seed: int) -> tuple[Array, Array]:
    """Return an image of dots, some with an off-centre heart, and all centres (N, 2)."""
    rng = np.random.default_rng(seed)
    pitch = 4.0 * RADIUS_PX
    place = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), -1).reshape(-1, 2)
    centres = pitch * (place + 0.75) + rng.uniform(-0.5, 0.5, (SIDE**2, 2))
    size = int(pitch * (SIDE + 0.5))
    at = (np.arange(size * FINE) + 0.5) / FINE - 0.5
    covered = np.zeros((size * FINE, size * FINE), np.float32)
    for number, (u, v) in enumerate(centres):
        whole = RADIUS_PX * (hearts.small if number % SIDE == 0 else 1.0)
        near = [slice(*np.searchsorted(at, [c - 1.5 * RADIUS_PX, c + 1.5 * RADIUS_PX]))
                for c in (u, v)]  # fmt: skip
        du, dv = at[near[0]] - u, (at[near[1]] - v)[:, None]
        covered[near[1], near[0]] += np.hypot(du, dv) < whole
        if rng.uniform() < hearts.share:
            way, turn = rng.uniform(0, 0.25) * RADIUS_PX, rng.uniform(0, 2 * np.pi)
            radius = hearts.size * RADIUS_PX * rng.uniform(0.8, 1.2)
            inside = np.hypot(du - way * np.cos(turn), dv - way * np.sin(turn)) < radius
            covered[near[1], near[0]] += rng.uniform(hearts.least, hearts.most) * inside
    light = gaussian_filter(covered, BLUR_PX * FINE).reshape(size, FINE, size, FINE).mean((1, 3))
    grey = 60.0 + 50.0 * light
    grey = (250.0 - grey if hearts.dark else grey) + NOISE * rng.standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8), centres


@pytest.mark.parametrize(
    ("hearts", "found"),
    [
        (Hearts(0.27, 1.0, 3.0), 0.98),
        (Hearts(1.0, 0.3, 1.2), 0.98),
        (Hearts(1.0, 0.5, 3.0), 0.95),
        (Hearts(0.27, -0.7, -0.3), 0.98),
        (Hearts(1.0, 0.3, 2.0, dark=True), 0.95),
        (Hearts(1.0, 1.5, 1.5), 0.98),
        (Hearts(1.0, 0.4, 0.4, 0.6), 0.98),
        (Hearts(1.0, -0.4, -0.4, 0.6), 0.98),
    ],
    ids=[
        "some, bright",
        "all, moderate",
        "all, bright",
        "some, dark",
        "dark dots",
        "all alike",
        "wide, faint",
        "wide, dark",
    ],
)
def test_dots_with_hearts_are_measured_at_their_rim(hearts: Hearts, found: float) -> None:
    image, centres = plate(hearts, 5)
    dots = measure_dots(image).dots
    gap = dots[["u_px", "v_px"]].to_numpy()[:, None] - centres
    nearest = np.argmin(np.linalg.norm(gap, axis=-1), 1)
    error = gap[np.arange(len(gap)), nearest]
    assert len(set(nearest)) == len(dots) >= found * len(centres)
    radius = np.sqrt(dots["a_px"] * dots["b_px"])
    assert radius.between(0.9 * RADIUS_PX, 1.1 * RADIUS_PX).all()
    # A single disc is off by 0.1 to 0.5 px RMS here, 0.9 to 1.7 px at most.
    assert np.sqrt(np.mean(error**2)) < 0.025
    assert np.abs(error).max() < 0.2
    parts = dots[["suu_px2", "suv_px2", "svv_px2"]].to_numpy()
    covariance = parts[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    nees = np.mean(error[:, None] @ np.linalg.solve(covariance, error[:, :, None])) / 2
    # The mean of 81 pairs of squares scatters by 11 %.
    assert 0.6 < nees < 1.6


@pytest.mark.parametrize("small", [0.86, 0.7])
def test_smaller_dots_are_found_with_their_own_size(small: float) -> None:
    image, centres = plate(Hearts(0.0, 0.0, 0.0, small=small), 5)
    dots = measure_dots(image).dots
    assert len(dots) == len(centres)
    points = dots[["u_px", "v_px"]].to_numpy()
    nearest = np.argmin(np.linalg.norm(centres[::SIDE, None] - points, axis=-1), 1)
    radius = np.sqrt(dots["a_px"] * dots["b_px"]).to_numpy()[nearest]
    assert np.abs(radius / RADIUS_PX - small).max() < 0.01


def test_a_plate_without_hearts_is_measured_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    image, _ = plate(Hearts(0.0, 0.0, 0.0), 5)
    dots = measure_dots(image).dots
    monkeypatch.setattr("telerig.estimator.dots.locate.with_hearts", lambda fits, *_: fits)
    assert dots.equals(measure_dots(image).dots)
    assert len(dots) == SIDE**2


def test_the_flat_inside_of_clipped_dots_is_no_heart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "NOISE", 0.7)
    image, centres = plate(Hearts(0.0, 0.0, 0.0), 5)
    bright = 3.0 * image - 60.0 + np.random.default_rng(0).standard_normal(image.shape)
    dots = measure_dots(np.clip(bright, 0, 255).astype(np.uint8)).dots
    gap = dots[["u_px", "v_px"]].to_numpy()[:, None] - centres
    error = np.sort(np.linalg.norm(gap, axis=-1), 1)[:, 0]
    assert len(dots) == len(centres)
    # 0.008 px as single discs, 0.020 with hearts.
    assert np.sqrt(np.mean(error**2) / 2) < 0.012


def test_hearts_that_the_blur_hides_look_like_those_of_other_dots(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(globals(), "RADIUS_PX", 5.0)
    image, centres = plate(Hearts(1.0, 1.5, 1.5, 0.65), 5)
    dots = measure_dots(image).dots
    gap = dots[["u_px", "v_px"]].to_numpy()[:, None] - centres
    nearest = np.argmin(np.linalg.norm(gap, axis=-1), 1)
    error = gap[np.arange(len(gap)), nearest]
    assert len(set(nearest)) == len(dots) == len(centres)
    assert np.sqrt(dots["a_px"] * dots["b_px"]).between(4.5, 5.5).all()
    parts = dots[["suu_px2", "suv_px2", "svv_px2"]].to_numpy()
    covariance = parts[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    nees = np.mean(error[:, None] @ np.linalg.solve(covariance, error[:, :, None])) / 2
    assert 0.6 < nees < 1.6
