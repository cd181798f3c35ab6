"""The report of a smoothed run: its numbers, spectra and modes against known signals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from smoothed_folder import (
    ALONE_UM,
    ARM_UM,
    COMMON_HZ,
    COMMON_UM,
    RATE_HZ,
    SD_MM,
    SD_MM_S,
    changed,
    read,
    write_folder,
)

from telerig.io.report.plot.shake import density_limits
from telerig.io.report.plot.spectrum import shake_spectrum, velocity_spectrum
from telerig.io.report.run.smoothing import axis_table, mode_rows
from telerig.io.results.folders.smoothing import (
    axis_sd,
    shake_rms_um,
    taken_away,
)
from telerig.spectra import evenly


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that no test changes."""
    return write_folder(tmp_path_factory.mktemp("once") / "r")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "r", frames=80, bubbles=1)


def test_numbers_are_those_of_the_signals(whole: Path) -> None:
    results = read(whole)
    assert axis_sd(results) == [SD_MM] * 3 and axis_sd(results, "v{}_mm_s") == [SD_MM_S] * 3
    away = taken_away(results)
    moved_um = np.hypot(COMMON_UM, ARM_UM)
    assert away[1] == pytest.approx(1e-3 * moved_um, rel=0.02)
    assert taken_away(results, "rts_")[1] == pytest.approx(0.5e-3 * moved_um, rel=0.02)
    assert shake_rms_um(results, "right", "y") == pytest.approx(COMMON_UM, rel=0.01)
    assert shake_rms_um(results, "right", "x") is None
    assert results.bubbles == (0, 1) and results.rate_hz == pytest.approx(RATE_HZ)


def test_depth_is_read_from_the_file_else_from_what_stands_still(folder: Path) -> None:
    results = read(folder)
    assert (results.unseen("left"), results.unseen("right")) == (("z",), ("x",))
    oblique = {"left": [0.643, 0, 0.766]}
    results = read(changed(folder, depth_axes=oblique))
    assert results.unseen("left") == () and results.seen("left") == ("x", "y", "z")
    np.testing.assert_allclose(results.depth("left"), [0.643, 0, 0.766], atol=1e-3)
    results = read(changed(folder, "depth_axes"))
    assert (results.unseen("left"), results.unseen("right")) == (("z",), ("x",))


def test_spectra_obey_parseval_and_show_the_lines(whole: Path) -> None:
    results = read(whole)
    shake = shake_spectrum(results.shake, "left")
    assert shake is not None
    variance = shake.density.sum(0) * shake.step_hz
    np.testing.assert_allclose(variance[0], ALONE_UM**2, rtol=0.05)
    np.testing.assert_allclose(variance[1], COMMON_UM**2 + ARM_UM**2, rtol=0.05)
    at = shake.frequency_hz[np.argmax(shake.density[:, 1])]
    assert at == pytest.approx(COMMON_HZ, abs=shake.step_hz)
    naive, smooth = (velocity_spectrum(results.trajectories, kind) for kind in ("naive_", ""))
    near = np.argmin(np.abs(naive.frequency_hz - COMMON_HZ))
    assert naive.density[near, 1] > 1e3 * smooth.density[near, 1]


def test_modes_are_listed_by_place(folder: Path) -> None:
    modes = [
        {"where": f"{place} {camera}", "place": place, "camera": camera, "frequency_hz": hz,
         "damping": damping, "rms_mm": rms_mm}
        for place, camera, hz, damping, rms_mm in (
            ("common", "", 20.0, 0.03, [0, 0.12, 0]), ("arm", "right", 32.0, 0.01, [0.02, 0.05, 0]),
            ("servo", "", 15.0, 0.3, [0, 0.1, 0]),
        )
    ]  # fmt: skip
    rows, words = mode_rows(read(changed(folder, modes=modes)))
    common, arm, servo = (row.cells for row in rows)
    assert common[:4] == ("all cameras alike (carriage, mount)", "20.0", "0.0300", "y: 120")
    assert arm[0] == "arm of right" and arm[3] == "x: 20.0, y: 50.0"
    assert servo[:3] == ("servo (following error)", "15.0", "0.300")
    assert "model" in words


def test_a_mode_learned_axis_by_axis_is_one_row(folder: Path) -> None:
    mode = {
        "where": "common",
        "place": "common",
        "frequency_hz": 20.36,
        "damping": 0.028,
        "source": "model",
    }
    parts = [mode | {"rms_mm": [0.0, 0.075, 0.0]}, mode | {"rms_mm": [0.063, 0.0, 0.064]}]
    rows, _ = mode_rows(read(changed(folder, modes=parts)))
    assert [row.cells[3] for row in rows] == ["x: 63.0, y: 75.0, z: 64.0"]


def test_evenly_fills_gaps_with_straight_lines() -> None:
    t = np.array([0.0, 0.1, 0.2, 0.5, 0.6])
    even, rate = evenly(t, np.stack([2 * t, np.where(t == 0.2, np.nan, t)], 1))
    assert rate == pytest.approx(10.0) and len(even) == 7
    grid = np.linspace(0, 0.6, 7)
    np.testing.assert_allclose(even, np.stack([2 * grid, grid], 1), atol=1e-12)


def test_every_density_is_within_the_limits_of_its_picture() -> None:
    readings, left, noise = np.geomspace(1, 1e-9, 60), np.full(60, 1e-13), np.full(60, 5e-8)
    assert density_limits([readings, left, noise]) == (1e-13, 1.0)
    assert density_limits([readings]) == pytest.approx((1e-6, 1.0))
    assert density_limits([np.zeros(3)]) == (1.0, 1.0)


def test_axis_table_is_complete_without_a_verdict(folder: Path) -> None:
    heads, rows = axis_table(read(changed(folder, "axes")))
    assert heads == ["", "x", "y (down)", "z"]
    found = {row.cells[0]: row.cells[1:] for row in rows}
    assert found["sd, µm"] == ("20.0",) * 3 and found["sd of velocity, mm/s"] == ("4.00",) * 3
    assert found["shake of left, µm"][2] == "unseen" and found["shake of right, µm"][0] == "unseen"
