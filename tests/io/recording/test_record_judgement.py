"""Readings that cannot be right are found; those that can be are not touched."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from simulated_log import simulated_log

from telerig.io.recording.judgement import amid_garbage, far_from_neighbours
from telerig.io.recording.log import END, RECEIVED, Entry, LogHeader, RawLog
from telerig.io.recording.protocols import parser
from telerig.io.recording.replay import replay
from telerig.io.recording.simulated.devices import (
    Faults,
    SimulatedDevice,
    stage_position_mm,
    true_values,
)
from telerig.io.recording.tables import write_tables
from telerig.io.rig_file.description import DeviceDescription

ENCODER = DeviceDescription("e", "encoder", "x", counts_per_mm=1000.0)
ARM = DeviceDescription("arm", "accelerometer", "x")
T_S = np.arange(2000) / 1000
COUNTS = np.round(1000 * stage_position_mm(T_S))
MOST = 5000.0 * 1000.0


def test_a_value_that_lost_a_digit_is_found() -> None:
    for i in (0, 1, 700, 1998, 1999):
        counts = COUNTS.copy() + 1000
        counts[i] = np.floor(counts[i] / 10)
        assert np.flatnonzero(far_from_neighbours(T_S, [counts], MOST)).tolist() == [i]
    counts = COUNTS.copy()
    damaged = [300, 301, 305, 306, 700, 704, 706, 1200]
    counts[damaged] /= 10
    assert np.flatnonzero(far_from_neighbours(T_S, [counts], MOST)).tolist() == damaged


@pytest.mark.parametrize("count", [3, 5])
def test_values_in_a_row_that_lost_a_digit_are_found(count: int) -> None:
    counts = COUNTS.copy() + 1000
    damaged = list(range(900, 900 + count))
    counts[damaged] = np.floor(counts[damaged] / 10)
    assert np.flatnonzero(far_from_neighbours(T_S, [counts], MOST)).tolist() == damaged


def test_what_a_stage_can_do_is_not_doubted() -> None:
    step = np.where(T_S < 1, 0.0, 5000.0)
    kick = np.where(T_S < 1, 0.0, 2e6 * np.maximum(T_S - 1, 0) ** 2)
    dither = np.round(np.random.default_rng(0).normal(0, 0.6, len(T_S)))
    still = np.zeros(len(T_S))
    blip = still.copy()
    blip[1000] = 2.0
    shake = np.round(50 * np.sin(2 * np.pi * 150 * T_S))
    for value in (COUNTS, step, np.round(kick), dither, still, blip, COUNTS + shake):
        assert not far_from_neighbours(T_S, [value], MOST).any()
    paused = np.concatenate([T_S[:900], T_S[1100:]])
    assert not far_from_neighbours(paused, [np.round(1000 * stage_position_mm(paused))]).any()


def test_a_knock_at_an_accelerometer_is_no_damage() -> None:
    rng = np.random.default_rng(1)
    value = np.round(rng.normal(9.81, 0.02, len(T_S)), 4)
    rings = T_S >= 1
    value[rings] += (
        40 * np.exp(-(T_S[rings] - 1) / 0.01) * np.cos(2 * np.pi * 180 * (T_S[rings] - 1))
    )
    assert not far_from_neighbours(T_S, [value]).any()
    value[500] = 98123.0
    assert np.flatnonzero(far_from_neighbours(T_S, [value])).tolist() == [500]


@pytest.mark.parametrize("seed", range(3))
def test_one_line_in_a_hundred_loses_a_byte(tmp_path: Path, seed: int) -> None:
    faults = Faults(lost_byte=0.01)
    sims = [SimulatedDevice(d, 1000.0, faults=faults) for d in (ENCODER, ARM)]
    truths = simulated_log(tmp_path / "r.raw", sims, 5.0, np.random.default_rng(seed))
    done = write_tables(tmp_path / "r.raw")
    assert not done.errors
    refused = pd.read_csv(tmp_path / "refused.csv", dtype={"line": str})
    for sim, truth, one, allowed in zip(sims, truths, replay(tmp_path / "r.raw").records, (5, 0.1)):
        number = np.round(one.values["t"] * 1e-3).astype(int)
        for name, value in true_values(sim, number).items():
            assert np.max(np.abs(one.values[name] - value)) < allowed
        told = done.summary["devices"][sim.device.name]
        own = refused[refused["device"] == sim.device.name]
        reasons = own["reason"].value_counts().to_dict()
        assert reasons == told["left_out"] | {"malformed": told["malformed"]}
        assert told["readings"] + told["lost"] == number[-1] - number[0] + 1
        assert len(number) > 0.98 * truth.sent


def test_refused_lines_are_kept_as_they_came(tmp_path: Path) -> None:
    lines = [b"%d,%d\n" % (1000 * k, 5000 + k) for k in range(200)]
    lines[50] = b"50000,505\n"
    lines[80] = b'80000,"\xff;=cmd\n'
    lines[120] = b"12000,5120\n"
    with RawLog(tmp_path / "r.raw", LogHeader(0, "now", (), (ENCODER,))) as log:
        for k, line in enumerate(lines):
            log.append(Entry(RECEIVED, 0, 10**6 * (k + 1), line))
        log.append(Entry(END, 0, 10**9, b""))
        log.flush()
    done = write_tables(tmp_path / "r.raw")
    assert done.summary["devices"]["e"]["left_out"] == {
        "wrong or repeated stamp": 1,
        "far from its neighbours": 1,
    }
    table = pd.read_csv(tmp_path / "refused.csv", dtype=str, keep_default_na=False)
    assert table["line"].tolist() == ["50000,505", '80000,"\\xff;=cmd', "12000,5120"]
    assert table["reason"].tolist()[1] == "malformed" and done.rows["refused.csv"] == 3
    assert float(table["t_s"][0]) == pytest.approx(0.051, abs=1e-4) and table["t_s"][2] == ""
    assert len(pd.read_csv(tmp_path / "stage.csv")) == 197


@pytest.mark.parametrize("share", [0.9, 0.999])
def test_a_device_that_sends_mostly_garbage_is_refused(tmp_path: Path, share: float) -> None:
    rng = np.random.default_rng(5)
    with RawLog(tmp_path / "r.raw", LogHeader(0, "now", (), (ENCODER, ARM))) as log:
        for k in range(4000):
            line = b"%d,%d\n" % (1000 * k, 5000)
            noise = rng.integers(0, 256, 12, np.uint8).tobytes()
            log.append(Entry(RECEIVED, 0, 10**6 * (k + 1), noise if rng.random() < share else line))
            log.append(Entry(RECEIVED, 1, 10**6 * (k + 1), b"%d,1,2,3\n" % (1000 * k)))
        log.flush()
    done = write_tables(tmp_path / "r.raw")
    told = done.summary["devices"]
    assert told["e"]["readings"] < 5 and "is garbage" in told["e"]["error"]
    assert told["arm"]["readings"] == 4000 and told["arm"]["error"] is None


def test_a_cable_that_was_loose_for_a_while_costs_that_while(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    with RawLog(tmp_path / "r.raw", LogHeader(0, "now", (), (ENCODER,))) as log:
        for k in range(6000):
            data = b"%d,%d\n" % (1000 * k, 5000)
            if 2000 < k < 4500:
                data = rng.integers(0, 256, 12, np.uint8).tobytes()
            log.append(Entry(RECEIVED, 0, 10**6 * (k + 1), data))
        log.flush()
    done = write_tables(tmp_path / "r.raw")
    assert not done.errors and 3400 < done.rows["stage.csv"] < 3501
    assert done.summary["devices"]["e"]["lost"] + done.rows["stage.csv"] == 6000


def test_text_between_the_answers_of_a_polled_device_is_no_garbage() -> None:
    """As the greetings of GRBL, or other sentences beside the one that a pattern matches."""
    grbl = parser(replace(ENCODER, protocol="grbl"))
    greeting = b"ok\r\nGrbl 1.1h ['$' for help]\r\nok\r\nM\xff\x80\r\n"
    found = grbl.feed([(0, greeting + b"<Idle|MPos:1.000,0.000,0.000>\r\n")])
    assert found.garbage.tolist() == [False, False, True] and len(found.spans) == 1
    found = parser(ENCODER).feed([(0, b"1,2\nhello\n")])
    assert found.garbage.tolist() == [True], "a stream has nothing but readings"


def test_garbage_counts_around_a_reading() -> None:
    spans = np.column_stack([np.arange(100) * 100, np.full(100, 20)])
    noise = np.column_stack([np.arange(50) * 100 + 21, np.full(50, 78)])
    amid = amid_garbage(spans, noise)
    assert amid[:46].all() and not amid[54:].any()
    assert not amid_garbage(spans, noise[:0]).any()


@pytest.mark.parametrize("frequency_hz", [0.3, 1.0, 3.0])
def test_one_line_in_twenty_that_lost_a_byte_leaves_few_wrong_positions(
    frequency_hz: float,
) -> None:
    rng = np.random.default_rng(7)
    t_s = np.arange(2_000) / 100.0
    true_mm = np.round(20 * np.sin(2 * np.pi * frequency_hz * t_s), 3)
    read_mm, whole = true_mm.copy(), np.ones(len(t_s), bool)
    for i in np.flatnonzero(rng.random(len(t_s)) < 0.05):
        text = f"{true_mm[i]:.3f}"
        lost = int(rng.integers(len(text)))
        try:
            read_mm[i] = float(text[:lost] + text[lost + 1 :])
        except ValueError:
            whole[i] = False
    far = far_from_neighbours(t_s[whole], [read_mm[whole]])
    off_mm = np.abs(read_mm - true_mm)[whole]
    assert (off_mm > 1).sum() > 20
    assert (off_mm[~far] > 1).sum() <= 0.1 * (off_mm > 1).sum()
    assert (off_mm[far] == 0).sum() <= 2
