"""What users give as sensors: every shape, unit and name that is wrong is refused in words."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from telerig.errors import InputError
from telerig.estimator.sensors.findings import Code, Finding, SensorError, settled
from telerig.estimator.sensors.given import given_sensors, longest_increase, numbers, table_columns
from telerig.estimator.sensors.gravity import check_accelerometer
from telerig.estimator.sensors.samples import screened
from telerig.io.rig_file.description import AccelerometerDescription
from telerig.rig.units import ACCELERATION_UNITS, STANDARD_GRAVITY_M_S2

UP = np.array([0.0, -1.0, 0.0])
N = 200
T = np.arange(N) / 1000


def readings(seed: int = 1) -> Any:
    rng = np.random.default_rng(seed)
    return STANDARD_GRAVITY_M_S2 * UP + 0.05 * rng.standard_normal((N, 3))


def record(**changes: Any) -> dict[str, Any]:
    whole = {"t_s": T, "a_m_s2": readings(), "mounted_on": "left", "axes": np.eye(3)} | changes
    return {key: value for key, value in whole.items() if value is not None}


def given(**changes: Any) -> Any:
    sensors, findings = given_sensors({"box": record(**changes)}, None, ["left", "right"])
    return sensors[0], findings


def test_a_mapping_is_taken_as_it_is() -> None:
    sensor, findings = given(range_m_s2=20, bias_sigma_m_s2=0.1, noise_density_ug_sqrt_hz=25)
    assert findings == []
    assert (sensor.clock, sensor.unit, sensor.mounted_on) == ("unknown", "m/s^2", "left")
    assert (sensor.range_m_s2, sensor.bias_sigma_m_s2) == (20.0, 0.1)
    np.testing.assert_array_equal(sensor.reading_m_s2, readings())
    assert given(clock="frames")[0].clock == "frames"
    frame = pd.DataFrame(readings(), columns=list("xyz"))
    np.testing.assert_array_equal(given(a_m_s2=frame)[0].reading_m_s2, readings())


@pytest.mark.parametrize("unit", sorted(ACCELERATION_UNITS))
def test_a_unit_that_is_said_or_shown_by_gravity(unit: str) -> None:
    own = readings() / ACCELERATION_UNITS[unit]
    said, findings = given(a_m_s2=None, a=own, unit=unit)
    assert findings == []
    np.testing.assert_allclose(said.reading_m_s2, readings())
    shown, findings = given(a_m_s2=None, a=own)
    assert len(findings) == 1 and findings[0].code is None
    assert "no unit is given" in findings[0].words
    size = np.linalg.norm(np.median(shown.reading_m_s2, axis=0))
    assert size == pytest.approx(STANDARD_GRAVITY_M_S2, rel=0.03)


@pytest.mark.parametrize("claimed", ["m/s^2", "g"])
@pytest.mark.parametrize("unit", ["m/s^2", "g", "mg", "mm/s^2"])
def test_a_wrong_unit_is_refused_and_its_fix_is_right(claimed: str, unit: str) -> None:
    own = readings() / ACCELERATION_UNITS[unit]
    sensor, _ = given(a_m_s2=None, a=own, unit=claimed)
    found = check_accelerometer(sensor, UP, STANDARD_GRAVITY_M_S2)
    if claimed == unit:
        assert found == []
        return
    assert [f.code for f in found] == [Code.SENSOR_UNIT]
    assert found[0].fix == {"sensor": "box", "unit": unit}
    with pytest.raises(SensorError, match="--accept SENSOR_UNIT"):
        settled(found, frozenset())
    assert "accepted: SENSOR_UNIT" in settled(found, frozenset({Code.SENSOR_UNIT}))[0]


@pytest.mark.parametrize("count", [1, 2, 3, 15])
def test_every_refused_fault_is_named(count: int) -> None:
    found = [
        Finding(f"fault of {i}", f"sensor {i}", "mend it", Code.SENSOR_AXES) for i in range(count)
    ]
    with pytest.raises(SensorError) as caught:
        settled([*found, Finding("a warning")], frozenset())
    first, *others = caught.value.what.splitlines()
    named = [f"  {one.where}: {one.words} (SENSOR_AXES)" for one in found[1:13]]
    ends = ["  and 2 more"] if count == 15 else []
    heads = {1: [], 2: ["and 1 more fault:"], 3: ["and 2 more faults:"]}
    assert first == found[0].words
    assert others == [*heads.get(count, ["and 14 more faults:"]), *named, *ends]


@pytest.mark.parametrize(("factor", "code"), [(0, "SENSOR_GRAVITY"), (2, "SENSOR_GRAVITY")])
def test_gravity_missing_or_contained_twice(factor: float, code: str) -> None:
    axes = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    gravity = STANDARD_GRAVITY_M_S2 * axes @ UP
    off = readings() - STANDARD_GRAVITY_M_S2 * UP
    sensor, _ = given(a_m_s2=off + factor * gravity, axes=axes)
    found = check_accelerometer(sensor, UP, STANDARD_GRAVITY_M_S2)
    assert [f.code for f in found] == [code]
    mended, _ = given(a_m_s2=sensor.reading_m_s2 + found[0].fix["add_m_s2"], axes=axes)
    assert check_accelerometer(mended, UP, STANDARD_GRAVITY_M_S2) == []


def test_a_dead_axis_along_gravity_is_no_removed_gravity() -> None:
    sensor, _ = given(a_m_s2=readings() * np.where(np.abs(UP) > 0, 0.0, 1.0))
    kept, found = screened(sensor)
    assert len(kept.unused_axes) == 1 and any("never changes" in f.words for f in found)
    assert check_accelerometer(kept, UP, STANDARD_GRAVITY_M_S2) == []


def test_axes_against_gravity_are_refused_and_the_fix_is_right() -> None:
    turned = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    sensor, _ = given(a_m_s2=readings() @ turned.T)
    found = check_accelerometer(sensor, UP, STANDARD_GRAVITY_M_S2)
    assert [f.code for f in found] == [Code.SENSOR_AXES]
    assert "axes = [[" in found[0].todo and "[accelerometers.box]" in found[0].todo
    mended, _ = given(a_m_s2=readings() @ turned.T, axes=found[0].fix["axes"])
    assert check_accelerometer(mended, UP, STANDARD_GRAVITY_M_S2) == []


def unordered(step: int) -> Any:
    t = T.copy()
    t[::step] = t[1]
    return t


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"a_ms2": 1}, "did you mean a_m_s2"),
        ({"noise_density": 22.5}, "did you mean noise_density_ug_sqrt_hz"),
        ({"mounted": "left"}, "did you mean mounted_on"),
        ({"a_m_s2": readings().T}, "transpose the readings"),
        ({"a_m_s2": readings()[:-1]}, r"give \(200, 3\)"),
        ({"a_m_s2": readings()[:, 0]}, r"has the shape \(200,\)"),
        ({"a_m_s2": None}, "no readings"),
        ({"a": readings()}, "both a and a_m_s2"),
        ({"unit": "g"}, 'give the readings as "a"'),
        ({"a_m_s2": None, "a": readings(), "unit": "G"}, "unit is 'G'"),
        ({"a_m_s2": readings().astype(str)}, "not numbers"),
        ({"a_m_s2": readings().astype(object)}, "numpy.asarray"),
        ({"a_m_s2": [[1, 2, 3], [1, 2]]}, "different lengths"),
        ({"a_m_s2": np.where(T[:, None] == T[7], np.nan, readings())}, "sample 7"),
        ({"a_m_s2": np.ma.masked_less(readings(), -9.9)}, "not finite"),
        ({"t_s": None}, "has no t_s"),
        ({"t_s": "accelerometer.csv"}, "the text 'accelerometer.csv'"),
        ({"t_s": pd.date_range("2026-01-01", periods=N, freq="ms")}, "give seconds as numbers"),
        ({"t_s": T[:, None]}, r"t_s has the shape \(200, 1\)"),
        ({"t_s": np.where(T[3] == T, np.nan, T)}, "not finite at row 3"),
        ({"t_s": T[::-1]}, "sort the samples"),
        ({"t_s": np.round(T, 2)}, "coarser than its rate"),
        ({"t_s": T[:1], "a_m_s2": readings()[:1]}, "has 1 sample"),
        ({"mounted_on": None}, "lacks mounted_on"),
        ({"mounted_on": "lef"}, "did you mean left"),
        ({"axes": None}, "lacks axes"),
        ({"axes": [1, 0, 0]}, r"shape \(3,\)"),
        ({"axes": np.zeros((3, 3))}, "no direction"),
        ({"axes": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}, "in one plane"),
        ({"noise_density_ug_sqrt_hz": -1}, "give one positive number"),
        ({"noise_density_ug_sqrt_hz": "22.5 ug"}, "not numbers"),
        ({"range_m_s2": [16, 16, 16]}, "give one positive number"),
        ({"bias_sigma_m_s2": float("nan")}, "give one positive number"),
        ({"clock": "utc"}, '"frames" or "unknown"'),
    ],
)
def test_a_wrong_record_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        given(**changes)
    assert caught.value.todo and "box" in caught.value.where


@pytest.mark.parametrize(
    ("accelerometers", "words"),
    [
        (readings(), "neither a mapping nor a table"),
        ([record()], "neither a mapping nor a table"),
        ("accelerometer.csv", "the text"),
        (record(), "has no name"),
        ({1: record()}, "is no text"),
        ({"box": readings()}, "not a mapping"),
        ({"box": pd.DataFrame({"t_s": T})}, "give its columns"),
        (pd.DataFrame({"t_s": T, "ax_m_s2": T}), "no column sensor, ay_m_s2, az_m_s2"),
        (pd.DataFrame({"t_s": T, "sensor": "box", "ax_m_s2": "a", "ay_m_s2": 0, "az_m_s2": 0}),
         "not numbers"),
    ],
)  # fmt: skip
def test_other_things_than_records_are_refused(accelerometers: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        given_sensors(accelerometers, None, ["left"])


def test_a_table_in_g_of_a_described_sensor() -> None:
    table = pd.DataFrame(readings() / STANDARD_GRAVITY_M_S2, columns=["ax_g", "ay_g", "az_g"])
    table = table.assign(t_s=T, sensor="box")
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    box = AccelerometerDescription("box", "left", axes, 22.5, range_m_s2=156.9)
    rig = SimpleNamespace(accelerometers={"box": box})
    (sensor,), findings = given_sensors(table, rig, ["left"])
    assert findings == []
    assert (sensor.clock, sensor.range_m_s2) == ("frames", 156.9)
    np.testing.assert_allclose(sensor.reading_m_s2, readings())
    rig = SimpleNamespace(
        accelerometers={"box": AccelerometerDescription("box", "left", axes, 22.5, clock="unknown")}
    )
    assert given_sensors(table, rig, ["left"])[0][0].clock == "unknown"
    both = {"box": record(clock="frames", mounted_on=None)}
    assert given_sensors(both, rig, ["left"])[0][0].clock == "frames"


def test_few_stamps_out_of_order_are_left_out() -> None:
    t = T.copy()
    t[50], t[90], t[120] = t[49], t[80], t[140]
    sensor, findings = given(t_s=t)
    assert len(sensor.t_s) == N - 3
    assert "3 of 200 samples" in findings[0].words and "0.049 s" in findings[0].words
    assert np.flatnonzero(~longest_increase(t)).tolist() == [49, 90, 120]


def test_columns_of_pandas_own_types() -> None:
    for kind in ("Float64", "Int64", "string"):
        column = pd.Series([1, 2, None]).astype("Int64").astype(kind)
        if kind == "string":
            with pytest.raises(InputError, match="not numbers"):
                numbers(column, "here", "t_s")
        else:
            np.testing.assert_array_equal(numbers(column, "here", "t_s"), [1, 2, np.nan])
    column = pd.Series(pd.date_range("2026-01-01", periods=3, tz="UTC"))
    with pytest.raises(InputError, match="not numbers"):
        numbers(column, "here", "t_s")


def test_tables_of_the_encoder() -> None:
    good = {"t_s": [0.0, 1.0], "position_mm": [0.0, 2.0]}
    t, position = table_columns(good, ("t_s", "position_mm"), "stage", what="a table")
    assert t.tolist() == [0.0, 1.0] and position.tolist() == [0.0, 2.0]
    for bad, words in (
        ({**good, "positon": 1}, "unknown key 'positon'"),
        ({"t_s": [0.0, 1.0]}, "no column position_mm"),
        ({**good, "t_s": [0.0]}, "unequal length: t_s 1, position_mm 2"),
        (np.zeros((2, 2)), "not a table"),
        ({**good, "position_mm": ["0", "1"]}, "not numbers"),
    ):
        with pytest.raises(InputError, match=words):
            table_columns(bad, ("t_s", "position_mm"), "stage", what="a table")
