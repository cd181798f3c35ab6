"""Size, shape and pole from two to four outlines, against bodies whose shape is known."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from telerig.arrays import Array
from telerig.estimator.bubbles.shape.body import Bodies, fit_bodies
from telerig.estimator.bubbles.shape.lasting import LastingShare
from telerig.estimator.bubbles.shape.learning import learn_shapes
from telerig.estimator.bubbles.shape.shapes import Shapes
from telerig.estimator.bubbles.shape.sightings import Sightings, sightings_from_table
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

UP = np.array([0.0, -1.0, 0.0])
SCALE = 20.0


def cameras(*angles_deg: float) -> tuple[Camera, ...]:
    return tuple(
        Camera.create(
            f"camera{i}", (1024, 1024), SCALE,
            camera_from_rig=Pose.from_rotvec([0.0, np.radians(angle), 0.0]),
        )
        for i, angle in enumerate(angles_deg)
    )  # fmt: skip


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


def measured(
    moments: Array, rng: np.random.Generator, sigma: float, rig: tuple[Camera, ...]
) -> list[pd.DataFrame]:
    return [table(moments, SCALE * c.camera_from_rig.rotation[:2], rng, sigma) for c in rig]


def fitted_tables(
    tables: list[pd.DataFrame], rig: tuple[Camera, ...], shapes: Shapes | None = None
) -> tuple[Bodies, Shapes]:
    sightings = Sightings.concat([sightings_from_table(t, c, rig) for c, t in enumerate(tables)])
    count = len(tables[0])
    seen = np.arange(count)[:, None] + count * np.arange(len(rig))
    known = learn_shapes(sightings, seen, rig, UP) if shapes is None else shapes
    return fit_bodies(sightings, seen, rig, UP, known), known


def fitted(
    moments: Array,
    rng: np.random.Generator,
    sigma: float,
    angles_deg: tuple[float, ...] = (0.0, 90.0),
    shapes: Shapes | None = None,
) -> tuple[Bodies, Shapes]:
    rig = cameras(*angles_deg)
    return fitted_tables(measured(moments, rng, sigma, rig), rig, shapes)


@pytest.mark.parametrize("angles", [(0.0, 90.0), (0.0, 60.0), (0.0, 60.0, 120.0)])
@pytest.mark.parametrize("aspect", [1.1, 1.6, 2.5])
def test_exact_outlines_of_a_spheroid_give_it_back(
    aspect: float, angles: tuple[float, ...]
) -> None:
    rng = np.random.default_rng(1)
    pole, moments = bodies(rng, np.full(50, aspect), 40.0, 0.0)
    known = Shapes(triaxial=1e-3, excess=1e-3, third=1e-6, fourth=1e-6)
    found, _ = fitted(moments, rng, 1e-5, angles, known)
    assert np.allclose(found.d_eq_mm, 4.0, rtol=1e-4)
    assert np.allclose(found.aspect, aspect, rtol=1e-3)
    assert np.abs((found.pole * pole).sum(-1)).min() > 1 - 1e-4


@pytest.mark.parametrize(
    ("low", "high", "triaxial", "angles"),
    [
        (1.3, 2.0, 0.0, (0.0, 90.0)),
        (1.2, 2.0, 0.02, (0.0, 60.0)),
        (1.08, 1.3, 0.01, (0.0, 90.0)),
        (1.2, 2.0, 0.02, (0.0, 60.0, 120.0)),
        (1.2, 2.0, 0.02, (0.0, 45.0, 90.0, 135.0)),
    ],
)
def test_errors_are_as_large_as_stated(
    low: float, high: float, triaxial: float, angles: tuple[float, ...]
) -> None:
    rng = np.random.default_rng(2)
    aspect = rng.uniform(low, high, 1500)
    pole, moments = bodies(rng, aspect, 30.0, triaxial)
    found, known = fitted(moments, rng, 0.003, angles)
    size = np.log(found.d_eq_mm / 4.0) ** 2 / found.shape_covariance[:, 0, 0]
    flat = np.log(found.aspect / aspect) ** 2 / found.shape_covariance[:, 1, 1]
    sign = np.sign((found.pole * pole).sum(-1))[:, None]
    lean = np.einsum("mji,mj->mi", found.frame, sign * pole)[:, :2]
    inverse = np.linalg.inv(found.shape_covariance[:, 2:4, 2:4])
    turn = np.einsum("mi,mij,mj->m", lean, inverse, lean) / 2
    for square in (size, flat, turn):
        assert 0.65 < square.mean() < 1.35
    assert known.triaxial == pytest.approx(triaxial, rel=0.35, abs=0.0025)
    assert abs(np.log(found.d_eq_mm / 4.0).mean()) < 1e-3
    if triaxial == 0:
        assert found.chi2.mean() == pytest.approx(2.0, abs=0.25)
    else:
        assert found.chi2.mean() > 2.5 * (3 * len(angles) - 4)  # the views refute the spheroid


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
    rig = cameras(0.0, 90.0)
    tables = measured(moments, rng, 0.001, rig)
    spoilt = np.arange(0, 200, 67)
    tables[1].loc[spoilt, ["a_px", "b_px"]] *= 1.05
    found, known = fitted_tables(tables, rig)
    sd, wrong = np.sqrt(found.shape_covariance[:, 0, 0]), np.isin(np.arange(200), spoilt)
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
    off = np.abs(found.aspect - 1) / np.sqrt(found.shape_covariance[:, 1, 1])
    assert np.quantile(off, 0.95) < 2.5
    lean = np.sqrt(found.shape_covariance[:, 2, 2])
    assert np.median(lean) > 0.3  # rad: its pole is not known


def test_an_outline_that_two_others_contradict_is_left_alone() -> None:
    rng = np.random.default_rng(9)
    _, moments = bodies(rng, np.full(200, 1.5), 20.0, 0.01)
    rig = cameras(0.0, 60.0, 120.0)
    tables = measured(moments, rng, 0.001, rig)
    spoilt = np.arange(0, 200, 67)
    tables[1].loc[spoilt, ["a_px", "b_px"]] *= 1.05
    found, _ = fitted_tables(tables, rig)
    off = np.log(found.d_eq_mm / 4.0)[spoilt]
    sd = np.sqrt(found.shape_covariance[spoilt, 0, 0])
    assert np.abs(off).max() < 0.01 and (np.abs(off) < 3 * sd).all()
    assert sd.max() < 0.006


def test_missing_and_cut_outlines() -> None:
    rng = np.random.default_rng(5)
    _, moments = bodies(rng, np.full(4, 1.5), 20.0, 0.0)
    rig = cameras(0.0, 90.0)
    first, second = measured(moments, rng, 0.003, rig)
    first["flags"] = ["", "border", "", ""]
    second.loc[2, "a_px"] = np.nan
    second.loc[3, "u_px"] = np.nan
    found, known = fitted_tables([first, second], rig)
    assert found.entire.tolist() == [True, False, False, False]
    assert known.bodies == 1
    relative = found.sd_eq_mm / found.d_eq_mm
    assert relative[0] < 0.01 < relative[1] and relative[2] > 0.01  # known from one outline alone
    assert (np.abs(found.d_eq_mm - 4.0) < 3 * found.sd_eq_mm)[:3].all()
    assert np.isnan(found.d_eq_mm[3])
    assert found.used.tolist() == ["silhouettes"] * 3 + ["none"]
    none, _ = fitted_tables([first[:0], second[:0]], rig)
    assert none.d_eq_mm.shape == (0,)


def test_the_noise_of_a_body_is_the_scatter_of_repeated_outlines() -> None:
    rng, draws = np.random.default_rng(7), 40
    _, moments = bodies(rng, np.full(40, 1.5), 25.0, 0.01)
    found, _ = fitted(np.repeat(moments, draws, 0), rng, 0.003, shapes=Shapes(excess=5e-4))
    values = np.stack([np.log(found.d_eq_mm), np.log(found.aspect), found.stretch])
    scatter = values.reshape(3, -1, draws).var(-1, ddof=1).mean(-1)
    assert scatter == pytest.approx(found.noise.mean(0), rel=0.15)
    own = found.shape_covariance[:, [0, 1], [0, 1]] - found.noise[:, :2] - found.fixed
    assert own.min() > 0


def test_a_body_that_is_as_good_as_impossible_does_not_widen_a_standard_deviation() -> None:
    """Sharp outlines of upright bodies: the prolate body is a hundred standard deviations away."""
    rng = np.random.default_rng(8)
    aspect = rng.uniform(1.15, 1.5, 800)
    _, moments = bodies(rng, aspect, 10.0, 0.01)
    found, _ = fitted(moments, rng, 2e-4, shapes=Shapes(triaxial=0.01, excess=1e-5))
    off = np.log(found.aspect / aspect) / np.sqrt(found.shape_covariance[:, 1, 1])
    assert 0.7 < np.mean(off**2) < 1.4


def test_the_lasting_share_is_that_of_the_variance_of_the_means() -> None:
    rng, frames, bubbles = np.random.default_rng(9), 80, 200
    lasting, swing, noise = 0.01, 0.02, 0.03
    phase = rng.uniform(0, 2 * np.pi, (bubbles, 1)) + 2.5 * np.arange(frames)
    stretch = lasting * rng.standard_normal((bubbles, 1)) + 2**0.5 * swing * np.cos(phase)
    stretch = stretch + noise * rng.standard_normal(stretch.shape)
    rows = pd.DataFrame(
        {
            "frame": np.tile(np.arange(frames), bubbles),
            "particle": np.repeat([f"b{k}" for k in range(bubbles)], frames),
            "stretch": stretch.ravel(),
            "noise_stretch": noise,
        }
    ).sort_values("frame", kind="stable")
    found = LastingShare()
    assert found.found() == {"lasting_share": 1.0, "lasting_square": 0.5}
    for part in (rows[rows["frame"] < 30], rows[rows["frame"] >= 30]):
        found.add(part)
    share = lasting**2 / (lasting**2 + swing**2)
    assert found.found()["lasting_share"] == pytest.approx(share, rel=0.2)
    found = LastingShare()
    found.add(rows[rows["frame"] == 0])
    assert found.found()["lasting_share"] == 1.0


@pytest.mark.parametrize(("turns", "share"), [(0.0, 1.0), (3.0, 0.5)])
def test_the_lasting_square_is_the_scatter_of_the_mean_squares(turns: float, share: float) -> None:
    """Of still bodies it is that of a normal variable's square; one that turns shows both t."""
    rng, frames, bubbles = np.random.default_rng(10), 60, 2000
    t = 0.01 * rng.standard_normal((2, bubbles, 1))
    angle = 2 * np.pi * turns * np.arange(frames) / frames
    stretch = t[0] * np.cos(angle) + t[1] * np.sin(angle)
    found = LastingShare()
    found.add(
        pd.DataFrame(
            {
                "particle": np.repeat(np.arange(bubbles), frames),
                "stretch": (stretch + 0.002 * rng.standard_normal(stretch.shape)).ravel(),
                "noise_stretch": 0.002,
            }
        )
    )
    assert found.found()["lasting_square"] == pytest.approx(share, rel=0.15)


def test_noise_does_not_flatten_a_nearly_round_body_on_average() -> None:
    """Noise across the pole pushes the eigenvalues apart: 1.1 % of log aspect ratios of 0.08."""
    rng, aspect = np.random.default_rng(12), np.full(6000, 1.08)
    _, moments = bodies(rng, aspect, 15.0, 0.0)
    found, _ = fitted(moments, rng, 0.003, shapes=Shapes(triaxial=1e-3, excess=1e-5))
    bias = np.log(found.aspect / aspect).mean()
    lean2 = np.trace(found.shape_covariance[:, 2:4, 2:4], axis1=1, axis2=2).mean()
    assert abs(bias) < 0.25 * 1.5 * np.log(1.08) * lean2
