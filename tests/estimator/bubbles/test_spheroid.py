"""Spheroids from two outlines, against bodies whose shape is known."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from telerig.arrays import Array
from telerig.estimator.bubbles.shape.spheroid import (
    Deviations,
    Spheroids,
    fit_spheroids,
    paired_outlines,
)
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

UP = np.array([0.0, -1.0, 0.0])
SCALE = 20.0


def cameras(angle_deg: float = 90.0) -> tuple[Camera, Camera]:
    turned = Pose.from_rotvec([0.0, np.radians(angle_deg), 0.0])
    first, second = (
        Camera.create(name, (1024, 1024), SCALE, camera_from_rig=pose)
        for name, pose in (("left", Pose.identity()), ("right", turned))
    )
    return first, second


def bodies(
    rng: np.random.Generator, aspect: Array, tilt_deg: float, triaxial: float, d_mm: float = 4.0
) -> tuple[Array, Array]:
    """Poles (M, 3) and moments A A^T (M, 3, 3); built from rotated axes, unlike the estimator."""
    count = len(aspect)
    tilt, azimuth = rng.uniform(0, np.radians(tilt_deg), count), rng.uniform(0, 2 * np.pi, count)
    pole = np.stack(
        [np.sin(tilt) * np.cos(azimuth), -np.cos(tilt), np.sin(tilt) * np.sin(azimuth)], -1
    )
    first = np.cross(pole, rng.standard_normal((count, 3)))
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    axes = np.stack([first, np.cross(pole, first), pole], -1)
    t = triaxial * np.linalg.norm(rng.standard_normal((count, 2)), axis=-1)
    logs = np.stack([np.log(aspect) / 3 + t, np.log(aspect) / 3 - t, -2 / 3 * np.log(aspect)], -1)
    scaled = axes * (d_mm / 2 * np.exp(logs))[:, None, :]
    return pole, scaled @ np.swapaxes(scaled, -1, -2)


def table(moments: Array, jacobian: Array, rng: np.random.Generator, sigma: float) -> pd.DataFrame:
    """Detections of outlines at the image's centre, their radius displaced by relative noise."""
    seen = jacobian @ moments @ jacobian.T
    grown, stretched, sheared = sigma * rng.standard_normal((3, len(seen)))
    change = np.stack([grown / 2**0.5 + stretched, sheared, sheared, grown / 2**0.5 - stretched])
    values, vectors = np.linalg.eigh(seen)
    axes = vectors * np.sqrt(values)[:, None, :]
    axes = axes @ (np.eye(2) + change.T.reshape(-1, 2, 2))
    values, vectors = np.linalg.eigh(axes @ np.swapaxes(axes, -1, -2))
    centre = sigma**2 * seen
    return pd.DataFrame(
        {
            "u_px": 511.5,
            "v_px": 511.5,
            "suu_px2": centre[:, 0, 0],
            "suv_px2": centre[:, 0, 1],
            "svv_px2": centre[:, 1, 1],
            "a_px": np.sqrt(values[:, 1]),
            "b_px": np.sqrt(values[:, 0]),
            "angle_rad": np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]),
        }
    )


def fitted(
    moments: Array,
    rng: np.random.Generator,
    sigma: float,
    angle_deg: float = 90.0,
    deviations: Deviations | None = None,
) -> tuple[Spheroids, Deviations]:
    rig = cameras(angle_deg)
    tables = [table(moments, SCALE * c.camera_from_rig.rotation[:2], rng, sigma) for c in rig]
    outlines = paired_outlines(tables[0], tables[1], rig)
    return fit_spheroids(outlines, np.zeros((len(moments), 3)), rig, UP, deviations)


@pytest.mark.parametrize("angle_deg", [90.0, 60.0])
@pytest.mark.parametrize("aspect", [1.1, 1.6, 2.5])
def test_exact_outlines_of_a_spheroid_give_it_back(aspect: float, angle_deg: float) -> None:
    rng = np.random.default_rng(1)
    pole, moments = bodies(rng, np.full(50, aspect), 40.0, 0.0)
    known = Deviations(triaxial=1e-3, excess=1e-3)
    found, _ = fitted(moments, rng, 1e-5, angle_deg, known)
    assert np.allclose(found.d_eq_mm, 4.0, rtol=1e-4)
    assert np.allclose(found.aspect, aspect, rtol=1e-3)
    assert np.abs((found.pole * pole).sum(-1)).min() > 1 - 1e-4
    equator = 2 * np.cbrt(aspect)
    assert np.allclose(found.equator_mm, equator, rtol=1e-3)
    assert np.allclose(found.polar_mm, equator / aspect, rtol=1e-3)


@pytest.mark.parametrize(
    ("low", "high", "triaxial"), [(1.3, 2.0, 0.0), (1.2, 2.0, 0.02), (1.08, 1.3, 0.01)]
)
def test_errors_are_as_large_as_stated(low: float, high: float, triaxial: float) -> None:
    rng = np.random.default_rng(2)
    aspect = rng.uniform(low, high, 1500)
    pole, moments = bodies(rng, aspect, 30.0, triaxial)
    found, known = fitted(moments, rng, 0.003)
    size = np.log(found.d_eq_mm / 4.0) ** 2 / found.covariance[:, 0, 0]
    flat = np.log(found.aspect / aspect) ** 2 / found.covariance[:, 1, 1]
    sign = np.sign((found.pole * pole).sum(-1))[:, None]
    lean = np.einsum("mji,mj->mi", found.frame, sign * pole)[:, :2]
    inverse = np.linalg.inv(found.covariance[:, 2:4, 2:4])
    turn = np.einsum("mi,mij,mj->m", lean, inverse, lean) / 2
    for square in (size, flat, turn):
        assert 0.65 < square.mean() < 1.35
    assert known.triaxial == pytest.approx(triaxial, rel=0.35, abs=0.0025)
    assert abs(np.log(found.d_eq_mm / 4.0).mean()) < 1e-3
    if triaxial == 0:
        assert found.chi2.mean() == pytest.approx(2.0, abs=0.25)
    else:
        assert found.chi2.mean() > 5  # two views refute the spheroid


def test_an_unequal_equator_does_not_make_bubbles_larger() -> None:
    """Without the correction 2/3 of the variance of t: 0.001."""
    rng = np.random.default_rng(6)
    _, moments = bodies(rng, np.full(1500, 1.6), 10.0, 0.04)
    found, known = fitted(moments, rng, 0.001)
    off = np.log(found.d_eq_mm / 4.0)
    assert known.triaxial == pytest.approx(0.04, rel=0.1)
    assert abs(off.mean()) < 2e-4


def test_outlines_that_contradict_each_other_are_stated_to_be_wrong() -> None:
    rng = np.random.default_rng(8)
    _, moments = bodies(rng, np.full(200, 1.5), 20.0, 0.01)
    rig = cameras()
    tables = [table(moments, SCALE * c.camera_from_rig.rotation[:2], rng, 0.001) for c in rig]
    spoilt = np.arange(0, 200, 67)
    tables[1].loc[spoilt, ["a_px", "b_px"]] *= 1.05
    found, known = fit_spheroids(
        paired_outlines(tables[0], tables[1], rig), np.zeros((200, 3)), rig, UP
    )
    sd, wrong = np.sqrt(found.covariance[:, 0, 0]), np.isin(np.arange(200), spoilt)
    off = np.abs(np.log(found.d_eq_mm / 4.0)) / sd
    assert np.median(sd[wrong]) > 0.01 and np.median(sd[~wrong]) < 0.0015
    assert off[wrong].max() < 3
    assert known.triaxial == pytest.approx(0.01, rel=0.3)


def test_a_prolate_bubble_that_rises_along_its_axis_is_not_taken_for_a_coin() -> None:
    rng = np.random.default_rng(3)
    _, moments = bodies(rng, np.full(300, 0.75), 15.0, 0.005)
    found, _ = fitted(moments, rng, 0.003)
    assert np.mean(found.aspect < 1) > 0.95
    assert np.median(found.aspect) == pytest.approx(0.75, rel=0.01)


def test_a_sphere_is_not_stated_to_be_flat() -> None:
    rng = np.random.default_rng(4)
    _, moments = bodies(rng, np.ones(500), 30.0, 0.0)
    found, _ = fitted(moments, rng, 0.003)
    off = np.abs(found.aspect - 1) / np.sqrt(found.covariance[:, 1, 1])
    assert np.quantile(off, 0.95) < 2.5
    lean = np.sqrt(found.covariance[:, 2, 2])
    assert np.median(lean) > 0.3  # rad: its pole is not known


def test_missing_and_cut_outlines_have_no_body() -> None:
    rng = np.random.default_rng(5)
    _, moments = bodies(rng, np.full(4, 1.5), 20.0, 0.0)
    rig = cameras()
    first, second = (
        table(moments, SCALE * c.camera_from_rig.rotation[:2], rng, 0.003) for c in rig
    )
    first["flags"] = ["", "border", "", ""]
    second.loc[2, "a_px"] = np.nan
    outlines = paired_outlines(first, second, rig)
    points = np.zeros((4, 3))
    points[3] = np.nan
    found, known = fit_spheroids(outlines, points, rig, UP)
    assert np.isfinite(found.d_eq_mm).tolist() == [True, False, False, False]
    assert known.pairs == 1
    none, _ = fit_spheroids(paired_outlines(first[:0], second[:0], rig), points[:0], rig, UP)
    assert none.d_eq_mm.shape == (0,)
