"""Numbers per volume, against bubbles scattered with a known density."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from telerig.estimator.physics.swarm import swarm_numbers
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

UP = np.array([0.0, -1.0, 0.0])
PER_CM3, RISE = 0.6, 200.0
HALF_MM = np.array([30.0, 150.0, 30.0])


def cameras() -> tuple[Camera, Camera]:
    turned = Pose.from_rotvec([0.0, np.pi / 2, 0.0])
    first, second = (
        Camera.create(name, (800, 500), 20.0, camera_from_rig=pose)
        for name, pose in (("left", Pose.identity()), ("right", turned))
    )
    return first, second


def swarm(rng: np.random.Generator) -> tuple[pd.DataFrame, pd.DataFrame, np.ndarray]:
    """Spheroids that rise through the field of view, seen where both images show them whole."""
    count = rng.poisson(PER_CM3 * 1e-3 * np.prod(2 * HALF_MM))
    d = rng.uniform(2.0, 8.0, count)
    equator, polar = d / 2 * np.cbrt(1.5), d / 2 * np.cbrt(1.5) / 1.5
    frames = 60
    t, carriage = np.arange(frames) / 100, 1.0 * np.arange(frames)
    start = rng.uniform(-HALF_MM, HALF_MM, (count, 3))
    lab = start[:, None] + RISE * t[:, None] * UP
    rig = lab - carriage[:, None] * UP
    margin = 3.0 / 20
    side, height = 20.0 - margin, 12.5 - margin
    whole = (np.abs(rig[..., [0, 2]]) + equator[:, None, None] < side).all(-1)
    whole &= np.abs(rig[..., 1]) + polar[:, None] < height
    k, f = np.nonzero(whole)
    table = pd.DataFrame({"frame": f, "particle": k, "t_s": t[f]})
    table[["x_mm", "y_mm", "z_mm"]] = lab[k, f]
    table[["vx_mm_s", "vy_mm_s", "vz_mm_s"]] = RISE * UP
    bodies = table[["frame", "particle"]].assign(
        d_eq_mm=d[k], sd_eq_mm=0.0, aspect=1.5, equator_mm=equator[k], polar_mm=polar[k],
        pole_x=0.0, pole_y=-1.0, pole_z=0.0,
    )  # fmt: skip
    return table, bodies, carriage


def test_densities_are_those_of_the_swarm_whatever_the_sizes() -> None:
    found = [
        swarm_numbers(*swarm(np.random.default_rng(seed)), UP, UP, cameras()) for seed in range(20)
    ]
    sizes = np.linspace(2.0, 8.0, 4001)
    gas = PER_CM3 * 1e-3 * np.pi / 6 * (sizes**3).mean()
    expected = {
        "number_per_cm3": PER_CM3,
        "void_fraction": gas,
        "gas_flux_mm_s": gas * RISE,
        "d10_mm": 5.0,
        "d32_mm": (sizes**3).mean() / (sizes**2).mean(),
    }
    for name, true in expected.items():
        values, sd = (np.array([f[n] for f in found]) for n in (name, f"s_{name}"))
        error = values.std(ddof=1) / np.sqrt(len(found))
        assert abs(values.mean() - true) < 3.5 * error, name
        assert error < 0.07 * true
        assert 0.45 < np.mean((values - true) ** 2 / sd**2) < 1.9, name
    assert found[0]["volume_mm3"] == pytest.approx(39.7 * 39.7 * 24.7, rel=0.02)


def test_what_does_not_fit_or_has_no_shape_is_counted_apart() -> None:
    table, bodies, carriage = swarm(np.random.default_rng(1))
    assert swarm_numbers(table, bodies.assign(aspect=np.nan), carriage, UP, UP, cameras()) == {}
    assert swarm_numbers(table[:0], bodies, carriage, UP, UP, cameras()) == {}
    first = bodies["particle"].iloc[0]
    huge = bodies.assign(
        equator_mm=np.where(bodies["particle"] == first, 40.0, bodies["equator_mm"])
    )
    found = swarm_numbers(table, huge, carriage, UP, UP, cameras())
    assert found["left_out"] == 1
