"""`telerig.plot`: axes that show what the tables hold, and errors in words."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest

import telerig
from telerig.errors import InputError
from telerig.io.tables.smoothing import BUBBLES, SUMMARY
from telerig.rig.bubble_physics import Liquid, mendelson_velocity, moore_aspect_weber

WATER = {"density_kg_m3": 998.2, "viscosity_pa_s": 1e-3, "surface_tension_n_m": 0.0728}


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    import matplotlib.pyplot as plt

    mpl.use("agg")
    yield
    plt.close("all")


def summary(count: int = 5) -> pd.DataFrame:
    d = np.linspace(2.0, 4.0, count)
    table = pd.DataFrame({"particle": np.arange(count)}).reindex(columns=SUMMARY.names())
    speed = 1e3 * mendelson_velocity(1e-3 * d, Liquid(998.2, 1e-3, 0.0728))
    re = 998.2 * d * 1e-3 * speed * 1e-3 / 1e-3
    known = {"d_eq_mm": d, "sd_eq_mm": 0.05, "slip_mm_s": speed, "s_slip_mm_s": 3.0,
             "reynolds": re, "s_reynolds": 9.0, "drag": 0.6, "s_drag": 0.02}  # fmt: skip
    return table.assign(**known)


def frames(count: int = 200) -> pd.DataFrame:
    t = np.arange(count) / 500
    table = pd.DataFrame({"frame": np.arange(count), "particle": 3}).reindex(
        columns=BUBBLES.names()
    )
    swing = np.cos(2 * np.pi * 20 * t)
    known = {"t_s": t, "x_mm": swing, "y_mm": -250 * t, "z_mm": 0.0, "vx_mm_s": 40 * swing,
             "vy_mm_s": -250.0 + swing, "vz_mm_s": swing, "slip_mm_s": 250 + swing,
             "reynolds": 700.0 + swing, "drag": 0.6, "d_eq_mm": 3.0}  # fmt: skip
    return table.assign(**known)


@pytest.mark.parametrize("draw", [telerig.plot.path, telerig.plot.height, telerig.plot.velocity])
def test_names_in_place_of_numbers_of_bubbles_are_refused(draw: Callable[..., Any]) -> None:
    with pytest.raises(InputError, match=r"particle of the DataFrame is not of numbers: .*'b'"):
        draw(frames().assign(particle="b"))


def test_a_map_of_uncertainty_is_smooth_between_its_points() -> None:
    """The variance of a grid of five is a polynomial that the finer map has, too."""
    side = np.linspace(-10, 10, 5)
    points = np.stack(np.meshgrid(side, [0.0], side, indexing="ij"), -1).reshape(-1, 3)
    variance = 1e-6 * (3 + 1e-2 * points[:, 0] ** 2 + 2e-2 * points[:, 2] ** 2)
    arrays = {"points_mm": points, "calibration_mm2": variance[:, None, None] * np.eye(3) / 3}
    drawn = telerig.plot.uncertainty(arrays).collections[0]
    assert len(drawn.get_paths()) >= 5
    for low, high, path in zip(drawn.levels, drawn.levels[1:], drawn.get_paths()):
        x, z = path.vertices[(np.abs(path.vertices) < 9.9).all(1)].T
        found = np.sqrt(3 + 1e-2 * x**2 + 2e-2 * z**2)
        assert (np.minimum(np.abs(found - low), np.abs(found - high)) < 0.01).all()


def test_a_path_rises_on_the_screen() -> None:
    axes = telerig.plot.path(frames().drop(columns="d_eq_mm"))
    (line,) = axes.get_lines()
    _, _, height = line.get_data_3d()
    assert height[-1] > height[0] and np.allclose(height, -frames()["y_mm"])
    assert axes.get_zlabel() == "height / mm" and "20 times as wide" in axes.get_title()
    for up in ("-y", "y", "x", "-x", "z", "-z"):  # a right-handed helix stays one
        chosen = telerig.plot.path(frames(), up=up)
        names = [getattr(chosen, f"get_{side}label")().split()[0] for side in "xyz"]
        unit = dict(zip("xyz", np.eye(3))) | {
            "height": (-1 if up[0] == "-" else 1) * np.eye(3)["xyz".index(up[-1])]
        }
        assert np.linalg.det([unit[name] for name in names]) == pytest.approx(1)
    assert len(telerig.plot.path(frames(), particles=[9]).get_lines()) == 0
    coloured = telerig.plot.path(frames(), colour_by="slip_mm_s")
    assert coloured.figure.axes[-1].get_ylabel() == "slip_mm_s"
    with pytest.raises(InputError, match="up is 'down'"):
        telerig.plot.path(frames(), up="down")


def test_a_path_has_bubbles_of_their_size_that_leave_it_free() -> None:
    wide = frames().assign(x_mm=lambda t: 60 * t["x_mm"])
    axes = telerig.plot.path(wide)
    (bodies,) = axes.collections
    outlines = bodies._faces
    centres = outlines.mean(1)
    np.testing.assert_allclose(np.linalg.norm(outlines - centres[:, None], axis=2), 1.5)
    assert 10 < len(centres) <= 121, "apart, and not too many"
    slender = telerig.plot.path(frames())
    assert "5 times as wide" in slender.get_title()
    heights = slender.collections[0]._faces.mean(1)[:, 2]
    assert np.diff(heights).min() > 5 * 3.0, "they would hide the path"


def test_height_and_velocity_stand_beside_what_was_measured() -> None:
    table = frames().assign(naive_y_mm=lambda t: t["y_mm"] + 0.1, sy_mm=0.01, svy_mm_s=1.0)
    naive, smooth = telerig.plot.height(table, frames=50).get_lines()
    np.testing.assert_allclose(smooth.get_ydata(), 0.0, atol=1e-9)
    np.testing.assert_allclose(naive.get_ydata(), -0.1, atol=1e-9)
    assert len(smooth.get_xdata()) == 50
    side = telerig.plot.height(table, axis="x")
    assert side.get_ylabel() == "x less a line / mm"
    rise = telerig.plot.velocity(table)
    np.testing.assert_allclose(rise.get_lines()[0].get_ydata(), -table["vy_mm_s"])
    assert rise.get_ylabel() == "rise / (mm/s)" and len(rise.collections) == 1
    with pytest.raises(InputError, match="no bubble 9"):
        telerig.plot.velocity(table, 9)


def test_velocities_lie_on_the_law_that_made_them() -> None:
    axes = telerig.plot.speed(summary(), WATER)
    law = next(line for line in axes.get_lines() if line.get_label() == "Mendelson 1967")
    d, speed = law.get_data()
    expected = np.interp(summary()["d_eq_mm"], d, speed)
    assert np.allclose(expected, summary()["slip_mm_s"], rtol=1e-3)
    assert axes.get_ylabel() == "speed along the path / (mm/s)"
    names = axes.get_legend_handles_labels()[1]
    assert {"bubbles, ± 1 sd", "Clift 1978, contaminated", "Moore 1965"} <= set(names)
    assert telerig.plot.speed(summary()).get_legend_handles_labels()[1] == ["bubbles, ± 1 sd"]


def test_drag_of_bubbles_and_of_frames() -> None:
    axes = telerig.plot.drag(summary(), WATER)
    low, high = telerig.plot.drag(summary(3).assign(drag=[-0.2, -0.1, 0.6]), WATER).get_ylim()
    assert low < -0.2 and high > 0.6
    assert telerig.plot.drag(summary(3).assign(drag=-0.2)).get_ylim()[1] > -0.2
    law = next(line for line in axes.get_lines() if line.get_label() == "Mendelson 1967")
    re, drag = law.get_data()
    at = np.nanargmin(np.abs(re - summary()["reynolds"][2]))
    wave = 4 * 9.80665 * 3e-3 / (3 * (1e-3 * summary()["slip_mm_s"][2]) ** 2)
    assert drag[at] == pytest.approx(wave, rel=0.02)
    cloud = telerig.plot.drag(frames())
    assert len(cloud.get_lines()[0].get_xdata()) == 200
    with pytest.raises(InputError, match="nothing to draw"):
        telerig.plot.drag(summary().assign(drag=np.nan))
    with pytest.raises(InputError, match=r"the dict has no column reynolds(.|\n)*bubble_summary"):
        telerig.plot.drag({})


def test_aspect_ratios_lie_on_moores_law_and_groups_have_their_colours() -> None:
    ratio = np.array([1.1, 1.4, 1.7, 2.0])
    weber = moore_aspect_weber(ratio)
    table = summary(4).assign(aspect=ratio, s_aspect=0.01, weber=weber, s_weber=0.1)
    axes = telerig.plot.aspect(table.assign(run=["a", "a", "b", "b"]), by="run")
    law = next(line for line in axes.get_lines() if line.get_label() == "Moore 1965, pure")
    assert np.allclose(np.interp(weber, *law.get_data()), ratio, atol=2e-3)
    handles, labels = axes.get_legend_handles_labels()
    assert labels == ["Moore 1965, pure", "a", "b"]
    colours = {handle.lines[0].get_color() for handle in handles[1:]}
    assert len(colours) == 2


def test_sizes_by_number_and_volume() -> None:
    axes = telerig.plot.sizes(summary(9), bins=5)
    number, volume = (patch.get_data().values for patch in axes.patches)
    assert number.sum() == pytest.approx(100) and volume.sum() == pytest.approx(100)
    assert volume[-1] > number[-1] and volume[0] < number[0]
    sauter = next(x for x in axes.get_lines() if x.get_label() == "Sauter mean").get_xdata()[0]
    d = summary(9)["d_eq_mm"]
    assert sauter == pytest.approx((d**3).sum() / (d**2).sum())
    telerig.plot.sizes(summary(1))


def test_spectra_peak_where_the_bubble_swings() -> None:
    axes = telerig.plot.spectra(frames())
    x, height, z = axes.get_lines()
    assert [line.get_label() for line in (x, height, z)] == ["x", "height", "z"]
    assert x.get_xdata()[np.argmax(x.get_ydata())] == pytest.approx(20, abs=4)
    (one,) = telerig.plot.spectra(frames(), "x").get_lines()
    np.testing.assert_allclose(one.get_ydata(), x.get_ydata())
    with pytest.raises(InputError, match="32 frames"):
        telerig.plot.spectra(frames(20))


def test_pictures_of_the_rig(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    dots = pd.DataFrame(rng.uniform(0, 500, (40, 2)), columns=["u_px", "v_px"])
    dots[["du_px", "dv_px"]] = 0.01 * rng.standard_normal((40, 2))
    dots = dots.assign(camera="left", weight=1.0)
    dots.loc[0, "weight"] = 0.0
    axes = telerig.plot.residuals(dots, "left")
    assert axes.yaxis_inverted() and [c.N for c in axes.collections] == [39, 1]
    covered = telerig.plot.coverage(dots, "left", (640, 480))
    assert covered.get_xlim() == (-0.5, 639.5) and covered.get_ylim() == (479.5, -0.5)
    for draw in (telerig.plot.residuals, telerig.plot.coverage):
        with pytest.raises(InputError, match="no camera 'right'"):
            draw(dots, "right")
    grid = np.stack(np.meshgrid([-1.0, 0, 1], [0.0], [-1.0, 0, 1]), -1).reshape(-1, 3)
    arrays = {
        "points_mm": grid,
        "calibration_mm2": (1 + grid[:, 0] ** 2)[:, None, None] * np.eye(3),
    }
    assert telerig.plot.uncertainty(arrays).get_xlabel() == "x / mm"
    upright = {
        "points_mm": grid[:, [1, 0, 2]],
        "calibration_mm2": arrays["calibration_mm2"],
    }
    above = telerig.plot.uncertainty(upright, across="y")
    assert above.get_xlabel() == "y / mm" and above.get_xlim() == (-1, 1)
    with pytest.raises(InputError, match="measurement_mm2"):
        telerig.plot.uncertainty(arrays, "measurement")
    with pytest.raises(InputError, match="does not exist"):
        telerig.plot.uncertainty("/nowhere/uncertainty.npz")
    for content in (b"", b"PK\x03\x04 cut", b"\x93NUMPY\x01\x00"):
        (tmp_path / "cut.npz").write_bytes(content)
        with pytest.raises(InputError, match="cannot be read"):
            telerig.plot.uncertainty(tmp_path / "cut.npz")


def test_shake_has_one_sign() -> None:
    table = pd.DataFrame({"t_s": [0.0, 0.1], "left_y_mm": [0.0, 0.02], "sleft_y_mm": 0.001})
    assert telerig.plot.shake(table, "left", "y").get_lines()[0].get_ydata()[1] == pytest.approx(
        -20
    )
    down = telerig.plot.shake(table, "left", "y", up="y")
    assert down.get_lines()[0].get_ydata()[1] == pytest.approx(20)
    odd = telerig.plot.shake(table.rename(columns=lambda n: n.replace("left", "$_$")), "$_$", "y")
    odd.figure.canvas.draw()
    with pytest.raises(InputError, match="left_z_mm"):
        telerig.plot.shake(table, "left", "z")


def test_the_directory_names_functions_only() -> None:
    names = dir(telerig.plot)
    assert set(names) == set(telerig.plot.__all__) >= {"path", "residuals"}
    assert all(inspect.isfunction(getattr(telerig.plot, name)) for name in names)


def test_given_axes_are_drawn_on() -> None:
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    assert telerig.plot.sizes(summary(), axes=axes) is axes
    with pytest.raises(InputError, match="d_eq_mm"):
        telerig.plot.sizes(summary().drop(columns="d_eq_mm"), axes=axes)
    with pytest.raises(InputError, match="unknown key"):
        telerig.plot.speed(summary(), {**WATER, "sigma": 1.0}, axes=axes)
