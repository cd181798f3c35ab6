"""`telerig.bubble_table` of a simulated run whose forces are known: a small bubble_physics.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import telerig
from telerig.estimator.smoothing.result import Smoothing
from telerig.io.simulation.presets import run_preset
from telerig.io.simulation.run.motion import Forces, added_mass_along, driven_paths
from telerig.io.tables.smoothing import BUBBLES
from telerig.rig.bubble_physics import Liquid, added_mass, clift_velocity, drag_coefficient

pytestmark = pytest.mark.usefixtures("without_advice")

WATER = Liquid(998.2, 1e-3, 0.0728)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Smoothing, pd.DataFrame]:
    """A smoothed run, and its true bubbles."""
    folder = tmp_path_factory.mktemp("forces") / "d"
    config = run_preset("forces", frames=80, bubbles=2)
    dataset = telerig.simulate(config, rng=np.random.default_rng(5), out=folder, images=False)
    calibration, data = telerig.calibrate(dataset, model="radial"), dataset.runs["forces"].load()
    smoothing = telerig.smooth(telerig.track(data, calibration), calibration, stage=data)
    return smoothing, pd.read_csv(folder / "truth/runs/forces/bubbles.csv")


def test_drag_of_the_clift_law_is_recovered(run: tuple[Smoothing, pd.DataFrame]) -> None:
    smoothing, truth = run
    both = telerig.bubble_table(smoothing).merge(
        truth, on=["frame", "particle"], suffixes=("", "_true")
    )
    error = both["drag"] - both["drag_true"]
    assert abs(error.mean()) < 0.02 * both["drag_true"].mean()
    assert (error.abs() < 2 * both["s_drag"]).mean() > 0.9
    summary = telerig.bubble_summary(smoothing)
    drag = truth.groupby("particle")["drag"].first()[summary["particle"]].to_numpy()
    assert np.all(np.abs(summary["drag"] / drag - 1) < 0.02)
    expected = WATER.terminal_drag(
        1e-3 * summary["d_eq_mm"], clift_velocity(1e-3 * summary["d_eq_mm"], WATER)
    )
    assert np.allclose(summary["drag"], expected, rtol=0.02)


def test_sizes_and_motion_have_the_errors_that_are_stated(
    run: tuple[Smoothing, pd.DataFrame],
) -> None:
    smoothing, truth = run
    both = telerig.bubble_table(smoothing).merge(
        truth, on=["frame", "particle"], suffixes=("", "_true")
    )
    off = (both["d_eq_mm"] - both["d_eq_mm_true"]) / both["sd_eq_mm"]
    assert 0.5 < (off**2).mean() < 1.7
    for axis in "xyz":
        for name, true in (("v{}_mm_s", "v{}_lab_mm_s"), ("a{}_mm_s2", "a{}_lab_mm_s2")):
            error = both[name.format(axis)] - both[true.format(axis)]
            assert (error.abs() < 2 * both[f"s{name.format(axis)}"]).mean() > 0.85
    speed = 1e-3 * np.sqrt((truth[[f"v{a}_lab_mm_s" for a in "xyz"]] ** 2).sum(axis=1))
    re = pd.Series(WATER.reynolds(1e-3 * truth["d_eq_mm"], speed)).mean()
    assert both["reynolds"].mean() == pytest.approx(re, rel=0.02)


def test_the_table_has_the_columns_of_the_contract(run: tuple[Smoothing, pd.DataFrame]) -> None:
    table = telerig.bubble_table(run[0])
    first = (
        "frame particle t_s d_eq_mm sd_eq_mm aspect s_aspect tilt_deg vx_mm_s vy_mm_s vz_mm_s "
        "svx_mm_s svy_mm_s svz_mm_s ax_mm_s2 ay_mm_s2 az_mm_s2 sax_mm_s2 say_mm_s2 saz_mm_s2 "
        "reynolds s_reynolds weber s_weber eotvos s_eotvos drag s_drag"
    )
    assert list(table)[:28] == first.split()
    assert list(table) == BUBBLES.names() and len(table) == len(run[0].trajectories)


def test_another_liquid_can_be_given(run: tuple[Smoothing, pd.DataFrame]) -> None:
    smoothing, _ = run
    known = dict(smoothing.summary["fluid"])
    thick = telerig.bubble_table(smoothing, known | {"viscosity_pa_s": 2e-3})
    water = telerig.bubble_table(smoothing)
    assert np.allclose(2 * thick["reynolds"], water["reynolds"], equal_nan=True)
    assert np.allclose(thick["drag"], water["drag"], equal_nan=True)


def test_what_is_saved_gives_the_same_tables(
    run: tuple[Smoothing, pd.DataFrame], tmp_path: Path
) -> None:
    smoothing, _ = run
    smoothing.save(tmp_path / "r")
    again = telerig.load_smoothing(tmp_path / "r")
    pd.testing.assert_frame_equal(telerig.bubble_table(again), telerig.bubble_table(smoothing))
    written = pd.read_csv(tmp_path / "r" / "bubble_summary.csv")
    assert np.allclose(written["drag"], telerig.bubble_summary(again)["drag"], equal_nan=True)
    assert written["particle"].tolist() == sorted(smoothing.trajectories["particle"].unique())
    assert again.summary["swarm"]["void_fraction"] > 0


def test_driven_bubbles_obey_their_equation_of_motion() -> None:
    """The acceleration is that of the path, and the balance gives the drag back."""
    count, d = 3, 1e-3 * np.array([2.0, 3.0, 4.0])
    drag = WATER.terminal_drag(d, clift_velocity(d, WATER))
    aspect = [1.1, 1.3, 1.6]
    forces = Forces(
        0.75e-3 * drag / d, np.array([added_mass_along(a) for a in aspect]),
        np.full(count, 3000.0), np.full(count, 6.0), np.zeros(count),
        np.tile([1.0, 0.0], (count, 1)), 0.0, 0.02, 9806.65,
    )  # fmt: skip
    path = driven_paths(1e-3, 300, forces, np.random.default_rng(1))
    assert path.height_mm_s2 is not None and path.lateral_mm_s2 is not None
    slope = np.gradient(path.lateral_mm_s[..., 0], 1e-3, axis=1)
    assert np.abs(slope - path.lateral_mm_s2[..., 0])[:, 2:-2].max() < 3.0
    assert np.abs(path.lateral_mm_s2).max() > 1000
    velocity = np.concatenate([path.height_mm_s[..., None], path.lateral_mm_s], -1)
    rate = np.concatenate([path.height_mm_s2[..., None], path.lateral_mm_s2], -1)
    up = np.array([1.0, 0.0, 0.0])
    mass = added_mass(np.array(aspect))[0][:, None]
    found = drag_coefficient(
        d[:, None], 1e-3 * velocity, 1e-3 * rate, up, mass, Liquid(998.2, 1e-3, 0.0728, 9.80665)
    )
    assert np.allclose(found, drag[:, None], rtol=1e-9)
