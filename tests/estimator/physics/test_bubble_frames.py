"""bubbles.csv and bubble_summary.csv: numbers, errors by Monte-Carlo, what is not known."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter

from telerig.errors import InputError
from telerig.estimator.physics.bodies import bodies_table
from telerig.estimator.physics.frames import frames_table
from telerig.estimator.physics.means import Lasting, mean_of_body
from telerig.estimator.physics.oscillation import dominant_oscillation
from telerig.estimator.physics.summary import summary_table
from telerig.io.rig_file.fluid import liquid_of
from telerig.io.tables.smoothing import BODY_COLUMNS, BUBBLES, NUMBERS, SUMMARY

UP = np.array([0.0, -1.0, 0.0])
WATER = {"density_kg_m3": 998.2, "viscosity_pa_s": 1e-3, "surface_tension_n_m": 0.0728}
G = 9.80665


def motion(frames: int = 1, **changes: object) -> pd.DataFrame:
    """A bubble that rises at 250 mm/s and brakes a little."""
    t = np.arange(frames) / 500
    values = {"vx": 60.0, "vy": -250.0, "vz": -20.0, "ax": 900.0, "ay": 250.0, "az": -500.0}
    table = {
        "frame": np.arange(frames), "particle": 4, "t_s": t,
        "x_mm": 0.06 * t, "y_mm": -0.25 * t, "z_mm": 0 * t,
        "sx_mm": 0.02, "sy_mm": 0.02, "sz_mm": 0.02, "observed": 1,
    }  # fmt: skip
    for name, value in values.items():
        unit = "mm_s" if name[0] == "v" else "mm_s2"
        table[f"{name}_{unit}"] = value
        table[f"s{name}_{unit}"] = 3.0 if name[0] == "v" else 120.0
    return pd.DataFrame(table | changes)


def body(frames: int = 1) -> pd.DataFrame:
    table = pd.DataFrame({"frame": np.arange(frames), "particle": 4}).reindex(columns=BODY_COLUMNS)
    known = {
        "d_eq_mm": 3.0, "sd_eq_mm": 0.03, "aspect": 1.6, "s_aspect": 0.05, "tilt_deg": 13.0,
        "s_tilt_deg": 1.0, "pole_x": 0.2, "pole_y": -(0.96**0.5), "pole_z": 0.0,
        "r_size_aspect": 0.5,
    }  # fmt: skip
    return table.assign(**known)


def test_standard_deviations_are_those_of_a_monte_carlo() -> None:
    """Inputs are drawn with their stated errors, and every row is computed anew."""
    rng, count = np.random.default_rng(1), 20_000
    one = frames_table(motion(), body(), UP, G, WATER).iloc[0]
    drawn, bodies = motion(count), body(count)
    for column in [c for c in drawn if c.endswith(("mm_s", "mm_s2")) and not c.startswith("s")]:
        drawn[column] += drawn[f"s{column}"] * rng.standard_normal(count)
    sd = np.array([0.01, 0.05 / 1.6])
    off = rng.multivariate_normal([0, 0], np.outer(sd, sd) * [[1, 0.5], [0.5, 1]], count)
    bodies["d_eq_mm"] *= np.exp(off[:, 0])
    bodies["aspect"] *= np.exp(off[:, 1])
    many = frames_table(drawn, bodies, UP, G, WATER)
    for name in (*NUMBERS, "slip_mm_s", "curvature_1_mm"):
        stated = one[f"s_{name}"]
        assert many[name].std() == pytest.approx(stated, rel=0.04), name
        assert abs(many[name].mean() - one[name]) < 0.15 * stated, name


def test_errors_that_cancel_along_the_slip() -> None:
    """Drawn with so much less variance along the slip velocity."""
    rng, count, (slow, calm) = np.random.default_rng(2), 20_000, (0.4, 0.1)
    sharp = body(count).assign(sd_eq_mm=1e-9, s_aspect=1e-9)
    one = frames_table(motion(), sharp, UP, G, WATER, (slow, calm)).iloc[0]
    drawn, along = motion(count), np.array([60.0, -250.0, -20.0])
    along /= np.linalg.norm(along)
    for columns, sd, share in (
        (["vx_mm_s", "vy_mm_s", "vz_mm_s"], 3.0, slow),
        (["ax_mm_s2", "ay_mm_s2", "az_mm_s2"], 120.0, calm),
    ):
        off = sd * rng.standard_normal((count, 3))
        drawn[columns] += off - (1 - np.sqrt(share)) * np.outer(off @ along, along)
    many = frames_table(drawn, sharp, UP, G, WATER)
    for name in ("reynolds", "weber", "drag", "slip_mm_s", "curvature_1_mm"):
        assert many[name].std() == pytest.approx(one[f"s_{name}"], rel=0.04), name


def test_numbers_by_hand() -> None:
    row = frames_table(motion(), body(), UP, G, WATER).iloc[0]
    speed = np.sqrt(60**2 + 250**2 + 20**2)
    assert row["slip_mm_s"] == pytest.approx(speed)
    assert row["reynolds"] == pytest.approx(998.2 * speed * 1e-3 * 3e-3 / 1e-3)
    assert row["eotvos"] == pytest.approx(998.2 * G * 9e-6 / 0.0728)
    along = np.array([60, -250, -20]) / speed
    braking = along @ np.array([0.9, 0.25, -0.5])
    expected = (
        4 * 3e-3 / (3 * (speed * 1e-3) ** 2) * (G * 250 / speed - row["added_mass"] * braking)
    )
    assert row["drag"] == pytest.approx(expected)
    assert 0.5 < row["added_mass"] < 0.9


def test_liquid_that_moves_is_taken_off() -> None:
    still = frames_table(motion(), body(), UP, G, WATER).iloc[0]
    upward = frames_table(motion(), body(), UP, G, {**WATER, "velocity_mm_s": 100.0}).iloc[0]
    same = frames_table(motion(), body(), UP, G, {**WATER, "velocity_mm_s": [0, -100, 0]}).iloc[0]
    assert upward["slip_mm_s"] == pytest.approx(np.sqrt(60**2 + 150**2 + 20**2))
    assert same["drag"] == upward["drag"] > still["drag"]
    assert upward["curvature_1_mm"] == still["curvature_1_mm"]  # of the path in the laboratory


def test_what_is_not_known_is_not_a_number() -> None:
    none = frames_table(motion(3), None, UP, G)
    assert list(none) == BUBBLES.names() and len(none) == 3
    assert none[["d_eq_mm", "drag", "reynolds"]].isna().all(axis=None)
    assert none["slip_mm_s"].notna().all()
    slow = motion(2).drop(columns=[c for c in motion() if c.endswith("mm_s2")])
    without = frames_table(slow, body(1), UP, G, WATER)
    assert without["drag"].isna().all() and without["reynolds"].notna().tolist() == [True, False]
    round_ = body().assign(aspect=np.nan, s_aspect=np.nan, pole_x=np.nan, r_size_aspect=np.nan)
    sphere = frames_table(motion(), round_, UP, G, WATER).iloc[0]
    assert sphere["added_mass"] == pytest.approx(0.5) and np.isfinite(sphere["s_drag"])


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"viscosity_pa_s": None}, "missing"),
        ({"viscosity_pa_s": -1.0}, "-1"),
        ({"viscosity": 1.0}, "unknown key"),
        ({"gas_density_kg_m3": 2000.0}, "2000"),
        ({"velocity_mm_s": [1.0, 2.0]}, "velocity"),
        ({"density_kg_m3": "998"}, "998"),
    ],
)
def test_an_impossible_fluid_is_refused(changes: dict[str, object], word: str) -> None:
    with pytest.raises(InputError, match=word):
        frames_table(motion(), body(), UP, G, {**WATER, **changes})


def test_fluid_of_rig_toml_and_none() -> None:
    assert liquid_of(None, G) is None
    found = liquid_of(WATER, 9.8)
    assert found is not None and found[0].gravity == 9.8 and found[0].gas_density == 0


def test_bodies_of_a_table_without_outlines_are_diameters() -> None:
    tracks = pd.DataFrame({"frame": [0, 1], "particle": 7, "d_eq_mm": [3.0, np.nan]})
    bodies = bodies_table(tracks)
    assert list(bodies) == BODY_COLUMNS and bodies["d_eq_mm"].tolist() == [3.0]
    assert not len(bodies_table(tracks.assign(d_eq_mm=np.nan)))


def test_the_mean_of_a_body_states_its_error() -> None:
    """Noise averages out, rims stay, and of the rest and of squares the learned shares are left."""
    rng, frames, runs = np.random.default_rng(2), 100, 400
    noise, rims, unseen, rest, share, scale = 0.05, 0.004, 0.006, 0.02, 0.2, 0.001
    half = rims**2 + unseen**2 / 2
    rows = body(frames).assign(
        sd_eq_mm=np.sqrt(noise**2 + half + unseen**2 / 2 + rest**2), noise_eq_mm=noise,
        fixed_eq_mm=np.sqrt(half), noise_aspect=0.01, fixed_aspect=1.6 / 2 * unseen / 2**0.5,
    )  # fmt: skip
    swing = np.sqrt(2) * np.cos(2 * np.pi * np.arange(frames) / 10)
    off = []
    for _ in range(runs):
        common = rims, 0.5 * unseen, 3 * scale, rest * np.sqrt(share)
        error = common @ rng.standard_normal(4) + rest * np.sqrt(1 - share) * swing
        error = error + noise * rng.standard_normal(frames)
        lasting = Lasting(share, 0.25, scale)
        mean, sd = mean_of_body(rows.assign(d_eq_mm=3.0 + error), "d_eq_mm", lasting)
        off.append((mean - 3.0) / sd)
    assert np.mean(np.square(off)) == pytest.approx(1.0, abs=0.2)
    assert mean_of_body(body(9), "aspect", Lasting(0.1, 0.2, scale))[1] == pytest.approx(0.05)
    assert np.isnan(mean_of_body(body(3).assign(aspect=np.nan), "aspect", Lasting())[0])


def series(
    rng: np.random.Generator, f: float, amplitude: float, noise: float
) -> tuple[object, ...]:
    t = np.arange(750) / 500
    kicks = noise * np.sqrt(1 - 0.98**2) * rng.standard_normal((750, 2))
    wander = np.zeros((750, 2))
    for i in range(1, 750):
        wander[i] = 0.98 * wander[i - 1] + kicks[i]
    angle = rng.uniform(0, 2 * np.pi)
    swing = np.cos(2 * np.pi * f * t + angle)[:, None] * [0.6, 0.8]
    return t, amplitude * swing + wander + 10 * t[:, None]


def test_an_oscillation_is_found_with_its_errors() -> None:
    rng = np.random.default_rng(3)
    off = []
    for _ in range(60):
        f = rng.uniform(5, 7)
        t, values = series(rng, f, 80.0, 10.0)
        found = dominant_oscillation(t, values)
        assert found is not None
        off.append(((found.frequency_hz - f) / found.s_frequency_hz,
                    (found.major - 80.0) / found.s_major))  # fmt: skip
        assert found.minor < 5 * found.s_minor
    nees = np.mean(np.square(off), 0)
    assert nees.min() > 0.3 and nees.max() < 1.7


def test_frequency_and_amplitude_in_red_noise_have_their_errors() -> None:
    """A velocity under a force that is correlated in time: flat, then f^-2 and f^-4."""
    rng, off = np.random.default_rng(21), []
    step = 0.002
    slow, fast = np.exp(-2 * np.pi * step * np.array([3.0, 20.0]))
    for _ in range(250):
        f = rng.uniform(5, 7)
        force = lfilter([1.0], [1.0, -fast], rng.standard_normal((1250, 2)), axis=0)
        wander = lfilter([1.0], [1.0, -slow], force, axis=0)[1000:]
        t, values = series(rng, f, 60.0, 0.0)
        found = dominant_oscillation(t[:250], values[:250] + 0.25 * wander, significant=4.5)
        if found is not None:
            frequency = (found.frequency_hz - f) / found.s_frequency_hz
            off.append((frequency, (found.major - 60.0) / found.s_major))
    assert len(off) > 200
    nees = np.mean(np.square(off), 0)
    assert (nees > 0.75).all() and (nees < 1.4).all()


def test_noise_and_short_records_have_no_oscillation() -> None:
    rng = np.random.default_rng(4)
    found = sum(dominant_oscillation(*series(rng, 6.0, 0.0, 10.0)) is not None for _ in range(40))
    assert found <= 4
    t, values = series(rng, 6.0, 80.0, 1.0)
    assert dominant_oscillation(t[:100], values[:100]) is None  # 1.2 periods
    assert dominant_oscillation(t[:5], values[:5]) is None
    assert dominant_oscillation(t, np.full((750, 2), np.nan)) is None
    holes = values.copy()
    holes[200:260] = np.nan
    assert dominant_oscillation(t, holes).frequency_hz == pytest.approx(6.0, abs=0.05)


def test_no_wrong_fringe_of_a_gap_of_half_the_record_is_believed() -> None:
    off, rng = [], np.random.default_rng(20)
    for _ in range(120):
        f = rng.uniform(5, 12)
        t, values = series(rng, f, 30.0, 10.0)
        t, values = t[:300], values[:300]
        seen = np.abs(t - t.mean()) > t.mean() / 2
        found = dominant_oscillation(t[seen], values[seen], significant=4.5)
        if found is not None:
            off.append((found.frequency_hz - f) / found.s_frequency_hz)
    assert len(off) > 75 and np.max(np.abs(off)) < 6


def test_errors_that_oscillate_with_a_series_widen_its_line() -> None:
    """Two spectral lines closer than the record resolves, of which the second one is an error."""
    rng, off = np.random.default_rng(13), []
    t = np.arange(250) / 500
    for _ in range(200):
        f, phase = rng.uniform(40, 100), rng.uniform(0, 2 * np.pi, 3)
        f_error = f + rng.uniform(-4, 4)
        error = 0.1 * np.cos(2 * np.pi * f_error * t + phase[1])
        values = np.cos(2 * np.pi * f * t + phase[0]) + error + 0.02 * rng.standard_normal(250)
        seen = 0.1 * np.cos(2 * np.pi * f_error * t + phase[2])
        found = dominant_oscillation(t, values[:, None], alike=seen[:, None])
        alone = dominant_oscillation(t, values[:, None])
        assert found is not None and alone is not None
        assert found.frequency_hz == alone.frequency_hz
        off.append([(one.frequency_hz - f) / one.s_frequency_hz for one in (found, alone)])
    nees = np.mean(np.square(off), 0)
    assert 0.75 < nees[0] < 1.3 and nees[1] > 5


def test_a_line_is_not_believed_below_the_stated_noise() -> None:
    rng, t = np.random.default_rng(14), np.arange(250) / 500
    found, known = 0, 0
    for _ in range(300):
        values = 0.1 * rng.standard_normal((250, 1))
        found += dominant_oscillation(t, values, 15.0, significant=4.5) is not None
        known += dominant_oscillation(t, values, 15.0, significant=4.5, noise=0.1) is not None
    assert known <= 2 < found


@pytest.mark.parametrize(
    ("swing", "noise", "hz"), [(0.0, 0.01, 60.0), (0.1, 0.01, np.nan), (0.03, 0.045, np.nan)]
)
def test_twice_the_frequency_of_a_pole_that_swings_is_not_the_shapes(
    swing: float, noise: float, hz: float
) -> None:
    rng, t = np.random.default_rng(15), np.arange(250) / 500
    pole = swing * np.cos(2 * np.pi * 32 * t) + noise * rng.standard_normal(250)
    shaped = body(250).assign(
        aspect=1.6 * np.exp(0.01 * np.cos(2 * np.pi * 60 * t) + 1e-3 * rng.standard_normal(250)),
        s_aspect=0.0017, noise_aspect=0.0016, fixed_aspect=1e-5, stretch=0.0, noise_stretch=1e-3,
        noise_eq_mm=0.03, fixed_eq_mm=1e-5, pole_x=pole, pole_z=0.0,
    )  # fmt: skip
    row = summary_table(frames_table(motion(250), shaped, UP, G, WATER), UP).iloc[0]
    np.testing.assert_allclose(row["shape_hz"], hz, atol=0.05)


def test_an_oscillation_at_unequal_times() -> None:
    even = np.arange(400) / 200
    pairs = np.repeat(np.arange(100) / 50, 2)
    slower = np.concatenate([np.arange(0, 0.8, 0.005), np.arange(0.8, 8, 0.02)])
    for t, f in (
        (pairs + np.tile([0, 1e-3], 100), 30.0),
        (slower, 30.0),
        (even[np.abs(even - 1) > 0.5], 30.0),
        (even[np.abs(even - 1) > 0.5], 5.0),
    ):
        off = []
        for seed in range(20):
            noise = 0.1 * np.random.default_rng(seed).standard_normal(len(t))
            found = dominant_oscillation(t, (np.sin(2 * np.pi * f * t + seed) + noise)[:, None])
            assert found is not None
            off.append(((found.frequency_hz - f) / found.s_frequency_hz,
                        (found.major - 1) / found.s_major))  # fmt: skip
        nees = np.mean(np.square(off), 0)
        assert nees.min() > 0.3 and nees.max() < 2.5
    # images of a pair 10 us apart do not tell 30 from 20 Hz
    t = pairs + np.tile([0, 1e-5], 100)
    noise = 0.1 * np.random.default_rng(1).standard_normal(len(t))
    assert dominant_oscillation(t, (np.sin(60 * np.pi * t) + noise)[:, None]) is None


def test_a_bubble_is_summarised() -> None:
    frames = frames_table(motion(400), body(400), UP, G, WATER)
    liquid = liquid_of(WATER, G)
    assert liquid is not None
    found = summary_table(frames, UP, liquid[0])
    assert list(found) == SUMMARY.names() and len(found) == 1
    row = found.iloc[0]
    assert row["rise_mm_s"] == pytest.approx(0.25) and row["lifetime_s"] == pytest.approx(399 / 500)
    particle = int(row["particle"])
    for rows, sd_mm in ((400, 0.004), (399, row["s_rise_mm_s"] * 399 / 500)):
        ways = {(particle, rows): np.array([1.0, 0.004, 1.0, 0.006])}
        way = summary_table(frames, UP, liquid[0], ways).iloc[0]
        assert way["s_rise_mm_s"] == pytest.approx(sd_mm * 500 / 399)
        noise = (3.0**2 * 3) / (2 * way["slip_mm_s"])
        length = 0.006 * 500 / 399 if rows == 400 else row["s_rise_mm_s"]
        assert way["s_slip_mm_s"] == pytest.approx(np.hypot(length, noise))
    # 0.02 mm at both ends
    assert row["s_rise_mm_s"] == pytest.approx(0.02 * 2**0.5 / row["lifetime_s"])
    assert row["d_eq_mm"] == pytest.approx(3.0) and row["sd_eq_mm"] == pytest.approx(0.03)
    assert np.isnan(row["zigzag_hz"]) and np.isnan(row["strouhal"])
    assert row["drag"] == pytest.approx(frames["drag"].mean())
    alone = summary_table(frames_table(motion(1), None, UP, G), UP)
    assert alone.loc[0, "rise_mm_s"] == 250.0 and alone.loc[0, "s_rise_mm_s"] == 3.0
    still = motion(1).assign(vx_mm_s=0.0, vy_mm_s=0.0, vz_mm_s=0.0)
    once = summary_table(frames_table(still, body(1), UP, G, WATER), UP, liquid[0]).iloc[0]
    assert once["d_eq_mm"] == pytest.approx(3.0) and np.isnan(once["reynolds"])
    assert not len(summary_table(frames.iloc[:0], UP))
