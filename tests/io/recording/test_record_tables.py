"""From raw bytes to a run's tables, against simulated devices of known clocks and values."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from simulated_log import simulated_log

from telerig.io.dataset.tables import read_accelerometer_csv, read_frames_csv, read_stage_csv
from telerig.io.recording.log import (
    FOUND,
    LOST,
    RECEIVED,
    SENT,
    Entry,
    LogHeader,
    RawLog,
)
from telerig.io.recording.replay import replay
from telerig.io.recording.simulated.devices import (
    Faults,
    SimulatedDevice,
    Truth,
    practice_devices,
    true_values,
)
from telerig.io.recording.tables import frame_numbers, write_tables
from telerig.io.rig_file.description import DeviceDescription

SECONDS = 11.0


@pytest.fixture(scope="module")
def sims() -> list[SimulatedDevice]:
    made = practice_devices()
    made[3] = replace(made[3], faults=Faults(skip=(300, 301, 600)))
    return made


@pytest.fixture(scope="module")
def recorded(
    sims: list[SimulatedDevice], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[Truth]]:
    log = tmp_path_factory.mktemp("recorded") / "recording.raw"
    truths = simulated_log(log, sims, SECONDS, np.random.default_rng(0))
    write_tables(log)
    return log, truths


def written(log: Path, entries: list[Entry], *devices: DeviceDescription) -> Path:
    with RawLog(log, LogHeader(0, "now", ("left", "right"), devices)) as writer:
        for entry in entries:
            writer.append(entry)
        writer.flush()
    return log


def test_stage_csv_is_the_motion(
    recorded: tuple[Path, list[Truth]], sims: list[SimulatedDevice]
) -> None:
    log, truths = recorded
    file = log.parent / "stage.csv"
    assert file.read_text().splitlines()[0] == "t_s,position_mm"
    table = read_stage_csv(file)
    number = np.arange(truths[0].sent)
    assert len(table) == len(number)
    assert np.max(np.abs(table["t_s"] - sims[0].due_s(number))) < 200e-6
    assert np.array_equal(table["position_mm"], true_values(sims[0], number)["counts"] / 1000)


def test_accelerometer_csv_has_every_sensor_in_si_units(
    recorded: tuple[Path, list[Truth]], sims: list[SimulatedDevice]
) -> None:
    log, truths = recorded
    file = log.parent / "accelerometer.csv"
    assert file.read_text().splitlines()[0] == "t_s,sensor,ax_m_s2,ay_m_s2,az_m_s2"
    table = read_accelerometer_csv(file, ["arm_left", "arm_right"])
    for sim, truth in zip(sims[1:3], truths[1:3]):
        one = table[table["sensor"] == sim.device.name]
        number = np.arange(truth.sent)
        true = true_values(sim, number)
        assert len(one) == len(number)
        assert np.max(np.abs(one["t_s"] - sim.due_s(number))) < 200e-6
        for axis in ("ax", "ay", "az"):
            assert np.allclose(one[f"{axis}_m_s2"], true[axis] * sim.device.unit_m_s2, rtol=1e-8)
    assert abs(float(table["ay_m_s2"].mean()) - 9.81) < 0.02


def test_frames_csv_names_what_the_cameras_missed(
    recorded: tuple[Path, list[Truth]], sims: list[SimulatedDevice]
) -> None:
    log, truths = recorded
    table = read_frames_csv(log.parent / "frames.csv", ["left", "right"])
    assert table["frame"].tolist() == list(range(truths[3].sent))
    named = table.set_index("frame")["missing"]
    assert named[named != ""].to_dict() == dict.fromkeys((300, 301, 600), "left|right")
    assert np.max(np.abs(table["t_s"] - sims[3].due_s(np.arange(truths[3].sent)))) < 2e-3


def test_the_summary_tells_clocks_and_counts(recorded: tuple[Path, list[Truth]]) -> None:
    log, truths = recorded
    summary = json.loads((log.parent / "recording.json").read_text())
    assert summary["closed"] and summary["log_damaged_bytes"] == 0
    assert summary["rows"]["stage.csv"] == truths[0].sent
    for name, drift_ppm in (("encoder", 40.0), ("arm_left", -60.0), ("arm_right", 15.0)):
        device = summary["devices"][name]
        (clock,) = device["clocks"]
        assert abs(clock["drift_ppm"] - drift_ppm) < 1.0
        assert device["malformed"] == device["lost"] == device["gap_count"] == 0
        assert device["left_out"] == {}
    assert summary["devices"]["encoder"]["counter_wraps"] == 1


def test_replay_gives_the_same_bytes_and_so_does_a_cut_log_up_to_its_cut(
    recorded: tuple[Path, list[Truth]], tmp_path: Path
) -> None:
    log, truths = recorded
    write_tables(log, tmp_path / "again")
    names = ("stage.csv", "accelerometer.csv", "frames.csv", "recording.json")
    for name in names:
        assert (tmp_path / "again" / name).read_bytes() == (log.parent / name).read_bytes()
    torn = tmp_path / "torn" / "recording.raw"
    torn.parent.mkdir()
    torn.write_bytes(log.read_bytes()[: int(0.8 * log.stat().st_size)])
    done = write_tables(torn)
    assert not done.summary["closed"]
    assert abs(done.rows["stage.csv"] - 0.8 * truths[0].sent) < 100


def test_a_replay_in_place_keeps_sensors_that_were_imported(tmp_path: Path) -> None:
    copy = tmp_path / "recording.raw"
    simulated_log(copy, practice_devices(), 1.0, np.random.default_rng(0))
    write_tables(copy)
    file = tmp_path / "accelerometer.csv"
    before = file.read_bytes()
    kept = b"0.5,carriage,1.0,2.0,3.25\n0.6,carriage,4.0,5.0,6.0\n"
    file.write_bytes(before + b"0.5,carriage,1,2,3.25\n0.6,carriage,4,5,6")
    for _ in range(2):
        write_tables(copy)
        assert file.read_bytes() == before + kept
    # a byte order mark, columns in another order, and one more column, as spreadsheets leave them
    turned = (
        b"sensor,az_m_s2,t_s,ay_m_s2,ax_m_s2,note\ncarriage,3.25,0.5,2,1,a\ncarriage,6,0.6,5,4,\n"
    )
    file.write_bytes(b"\xef\xbb\xbf" + turned)
    write_tables(copy)
    assert file.read_bytes() == before + kept


@pytest.mark.parametrize("protocol", ["stream", "packets"])
def test_bad_bytes_cost_what_they_touch_and_nothing_else(tmp_path: Path, protocol: str) -> None:
    device = DeviceDescription("e", "encoder", "x", counts_per_mm=1000.0, protocol=protocol)  # type: ignore[arg-type]
    faults = Faults(garbage_hz=5.0, cut_hz=5.0)
    sim = SimulatedDevice(device, 1000.0, drift_ppm=-30.0, faults=faults)
    log = tmp_path / "recording.raw"
    (truth,) = simulated_log(log, [sim], 20.0, np.random.default_rng(3))
    (record,) = replay(log).records
    number = np.round(record.values["t"] * 1e-3).astype(int)
    gone = np.setdiff1d(np.arange(truth.sent), number)
    assert 100 < len(truth.spoilt) < 400
    assert set(gone) <= set(truth.spoilt)
    assert len(record.malformed_s) > 50 and record.malformed_bytes > 500
    off = np.abs(record.values["counts"] - true_values(sim, number)["counts"])
    assert np.count_nonzero(off) <= (8 if protocol == "stream" else 0)
    assert np.count_nonzero(off > 15) <= 1, "only those within a step of their neighbours"
    assert np.max(np.abs(record.t_s - sim.due_s(number))) < 200e-6


def test_a_checksum_lets_no_wrong_value_through(tmp_path: Path) -> None:
    device = DeviceDescription("e", "encoder", "x", counts_per_mm=1000.0, checksum="xor")
    sim = SimulatedDevice(device, 1000.0, faults=Faults(garbage_hz=10.0, cut_hz=10.0))
    simulated_log(tmp_path / "recording.raw", [sim], 20.0, np.random.default_rng(4))
    (record,) = replay(tmp_path / "recording.raw").records
    number = np.round(record.values["t"] * 1e-3).astype(int)
    assert np.array_equal(record.values["counts"], true_values(sim, number)["counts"])


def test_an_unplug_is_a_gap_with_its_reason(tmp_path: Path) -> None:
    device = DeviceDescription("e", "encoder", "x", counts_per_mm=1.0)
    lines = [(k, f"{1000 * k},{k}\r\n".encode()) for k in range(10_000)]
    entries = [Entry(RECEIVED, 0, 10**6 * k + 500, line) for k, line in lines]
    entries[3000:5000] = [
        Entry(RECEIVED, 0, 10**6 * 3000, b"3000"),
        Entry(LOST, 0, 10**6 * 3001, b"gone"),
        Entry(FOUND, 0, 10**6 * 4998, b""),
        Entry(RECEIVED, 0, 10**6 * 4999, b"00,49\r\n"),
    ]
    done = write_tables(written(tmp_path / "recording.raw", entries, device))
    told = done.summary["devices"]["e"]
    assert told["unplugged"] == [pytest.approx({"lost_s": 3.001, "found_s": 4.998})]
    (gap,) = told["gaps"]
    assert (gap["lost"], gap["why"]) == (2000, "unplugged")
    assert told["readings"] == 8000 and told["malformed"] == 0 and told["partial_bytes"] == 4


def test_gaps_that_nothing_explains(tmp_path: Path) -> None:
    device = DeviceDescription("e", "encoder", "x", counts_per_mm=1.0)
    kept = [k for k in range(1000) if not 400 <= k < 405]
    entries = [Entry(RECEIVED, 0, 10**6 * k, f"{1000 * k},{k}\n".encode()) for k in kept]
    done = write_tables(written(tmp_path / "recording.raw", entries, device))
    (gap,) = done.summary["devices"]["e"]["gaps"]
    assert (gap["lost"], gap["why"]) == (5, "nothing came")


def test_polled_readings_are_timed_between_question_and_answer(tmp_path: Path) -> None:
    device = DeviceDescription(
        "z", "encoder", "x", protocol="zaber", counts_per_mm=10.0, latency_s=0.0005
    )
    entries = []
    for k in range(50):
        asked = 20_000_000 * k
        entries.append(Entry(SENT, 0, asked, b"/1 get pos\n"))
        if k != 20:
            text = f"@01 0 OK BUSY -- {k}\r\n".encode()
            entries.append(Entry(RECEIVED, 0, asked + 4_000_000, text))
    done = write_tables(written(tmp_path / "recording.raw", entries, device))
    table = pd.read_csv(tmp_path / "stage.csv")
    told = done.summary["devices"]["z"]
    expected = [k for k in range(50) if k not in (20, 21)]
    assert np.allclose(table["t_s"], 0.02 * np.array(expected) + 0.002 - device.latency_s)
    assert np.allclose(table["position_mm"], np.array(expected) / 10)
    assert np.isclose(told["half_question_to_answer_ms"], 2.0)
    assert told["left_out"] == {
        "which question it answers is not known": 1,
        "question without answer": 1,
    }


def test_a_known_latency_is_subtracted(tmp_path: Path) -> None:
    device = DeviceDescription("e", "encoder", "x", counts_per_mm=1.0, latency_s=0.25)
    entries = [Entry(RECEIVED, 0, 10**7 * k, f"{10**4 * k},{k}\n".encode()) for k in range(100)]
    (record,) = replay(written(tmp_path / "recording.raw", entries, device)).records
    assert np.allclose(record.t_s, np.arange(100) / 100 - 0.25, atol=1e-6)


def test_two_counters_agree_on_the_frames_and_name_their_own_cameras(tmp_path: Path) -> None:
    left = DeviceDescription("l", "frames", "x", cameras=("left",))
    right = DeviceDescription("r", "frames", "x", cameras=("right",))
    entries = []
    for k in range(300):
        text = f"{10_000 * k},{k + 5}\n".encode()
        if k != 40:
            entries.append(Entry(RECEIVED, 0, 10**7 * k, text))
        if k not in (41, 42) and k > 0:
            entries.append(
                Entry(RECEIVED, 1, 10**7 * k + 1000, f"{10**4 * k},{k + 900}\n".encode())
            )
    write_tables(written(tmp_path / "recording.raw", entries, left, right))
    table = read_frames_csv(tmp_path / "frames.csv", ["left", "right"])
    named = table.set_index("frame")["missing"]
    missing = named[named != ""].to_dict()
    assert missing == {0: "right", 40: "left", 41: "right", 42: "right"}
    assert np.allclose(table["t_s"], np.arange(300) / 100, atol=1e-4)


def test_a_damaged_counter_line_is_no_missing_frame(tmp_path: Path) -> None:
    device = DeviceDescription("f", "frames", "x", cameras=("left", "right"))
    lines = [f"{10_000 * k},{k}\n".encode() for k in range(100)]
    lines[50] = b"500\x00\xff,50\n"
    entries = [Entry(RECEIVED, 0, 10**7 * k, line) for k, line in enumerate(lines)]
    done = write_tables(written(tmp_path / "recording.raw", entries, device))
    table = read_frames_csv(tmp_path / "frames.csv", ["left", "right"])
    assert "missing" not in table and done.summary["frames"]["interpolated"] == [50]
    assert np.allclose(table["t_s"], np.arange(100) / 100, atol=1e-6)


@pytest.mark.parametrize("found", [False, True], ids=["lost for good", "found at the end"])
def test_frames_after_a_counter_was_unplugged_are_not_missing(tmp_path: Path, found: bool) -> None:
    """The camera goes on without it: as after an unplug in the middle, the images say."""
    left = DeviceDescription("l", "frames", "x", cameras=("left",))
    right = DeviceDescription("r", "frames", "y", cameras=("right",))
    lines = [(10**7 * k, f"{10_000 * k},{k}\n".encode()) for k in range(100)]
    entries = [Entry(RECEIVED, 0, time_ns, line) for time_ns, line in lines]
    entries += [Entry(RECEIVED, 1, time_ns + 1000, line) for time_ns, line in lines[:60]]
    entries.append(Entry(LOST, 1, 10**7 * 60, b"gone"))
    entries += [Entry(FOUND, 1, 10**7 * 99, b"")] if found else []
    done = write_tables(written(tmp_path / "recording.raw", entries, left, right))
    table = read_frames_csv(tmp_path / "frames.csv", ["left", "right"])
    assert len(table) == 100 and "missing" not in table
    assert done.summary["frames"] == {"count": 100, "missing": 0, "interpolated": []}


@pytest.mark.parametrize(
    ("counter", "expected"),
    [
        ([0, 1, 2, 3, 4, 7], [0, 1, 2, 3, 4, 7]),
        ([5, 6, 7, 900, 9, 12], [0, 1, 2, 3, 4, 7]),
        ([65533, 65534, 65535, 0, 1, 4], [0, 1, 2, 3, 4, 7]),
        (None, [0, 1, 2, 3, 4, 7]),
        ([0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5]),
    ],
    ids=["skip", "damaged", "wraps", "no counter", "pause"],
)
def test_frame_numbers(counter: list[int] | None, expected: list[int]) -> None:
    t_s = np.array([0, 1, 2, 3, 4, 7]) * 0.01
    given = None if counter is None else np.array(counter, float)
    assert frame_numbers(t_s, given).tolist() == expected


def test_nothing_came_at_all(tmp_path: Path) -> None:
    devices = [sim.device for sim in practice_devices()]
    done = write_tables(written(tmp_path / "recording.raw", [], *devices))
    assert done.rows == {"stage.csv": 0, "accelerometer.csv": 0, "frames.csv": 0}
    assert (tmp_path / "stage.csv").read_text() == "t_s,position_mm\n"
