"""What is wrong with one device, or with the log, never costs the readings of others."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from simulated_log import simulated_log

from telerig.errors import InputError
from telerig.io.recording.clock import stamp_rate
from telerig.io.recording.log import (
    END,
    MARKER,
    RECEIVED,
    Entry,
    LogHeader,
    RawLog,
    packed,
    read_log,
    scan_log,
)
from telerig.io.recording.ports import open_port
from telerig.io.recording.replay import DeviceRecord, replay
from telerig.io.recording.simulated.devices import practice_devices
from telerig.io.recording.tables import Recording, write_tables
from telerig.io.rig_file.description import DeviceDescription
from telerig.io.rig_file.devices import LinePattern, port_fault

ENCODER = DeviceDescription("encoder", "encoder", "x", counts_per_mm=1000.0)
ARM = DeviceDescription("arm", "accelerometer", "y")


def log_of(path: Path, devices: list[DeviceDescription], chunks: list[Entry]) -> Path:
    with RawLog(path, LogHeader(0, "now", ("left", "right"), tuple(devices))) as log:
        for entry in sorted(chunks, key=lambda e: e.time_ns):
            log.append(entry)
        log.append(Entry(END, 0, 10**11, b""))
        log.flush()
    return path


def stream(index: int, seconds: float, line: str = "{t},{k}\n", unit: float = 1e-6) -> list[Entry]:
    """Entries of a 1 kHz stream in chunks of 8 ms; t is the stamp in units, k the number."""
    texts = [
        line.format(t=round(k * 1e-3 / unit), k=k).encode() for k in range(int(1000 * seconds))
    ]
    return [
        Entry(RECEIVED, index, 10**6 * (k + 8), b"".join(texts[k : k + 8]))
        for k in range(0, len(texts), 8)
    ]


def of_device(done: Recording, name: str) -> tuple[int, str | None]:
    told = done.summary["devices"][name]
    assert (told["error"] is None) == (name not in done.errors)
    return told["readings"], told["error"]


@pytest.mark.parametrize("count", [1, 2, 3, 5, 11, 40])
def test_a_few_stamped_lines_in_one_chunk(tmp_path: Path, count: int) -> None:
    lines = b"".join(b"%d,1,2,3\n" % (500 * k) for k in range(count))
    log = log_of(
        tmp_path / "r.raw",
        [ENCODER, ARM],
        [*stream(0, 2.0), Entry(RECEIVED, 1, 10**9, lines)],
    )
    done = write_tables(log)
    assert of_device(done, "encoder") == (2000, None)
    assert of_device(done, "arm") == (count, None)
    t_s = pd.read_csv(tmp_path / "accelerometer.csv")["t_s"]
    assert np.allclose(t_s, 1.0 - 500e-6 * np.arange(count)[::-1], atol=1e-6)


def test_a_device_whose_clock_cannot_be_fitted_is_timed_by_arrival(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = log_of(tmp_path / "r.raw", [ENCODER], stream(0, 2.0))

    def fails(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("telerig.io.recording.replay.host_times", fails)
    done = write_tables(log)
    readings, error = of_device(done, "encoder")
    assert readings == 2000 and error is not None and "times are those of arrival" in error
    table = pd.read_csv(tmp_path / "stage.csv")
    assert np.max(np.abs(table["t_s"] - 1e-3 * np.arange(2000))) < 0.01


def test_a_pattern_that_this_version_cannot_use_costs_its_own_device(tmp_path: Path) -> None:
    """As one with look-around in a log of an older version."""
    own = replace(ARM, protocol="regex", pattern=r"(?=\d)(?P<ax>.)(?P<ay>.)(?P<az>.)")
    done = write_tables(log_of(tmp_path / "r.raw", [ENCODER, own], [*stream(0, 1.0)]))
    assert of_device(done, "encoder") == (1000, None)
    readings, error = of_device(done, "arm")
    assert readings == 0 and error is not None and "--replay RUN --rig rig.toml" in error
    fixed = replace(own, pattern=r"(?P<ax>\d)(?P<ay>\d)(?P<az>\d)")
    assert not write_tables(tmp_path / "r.raw", tmp_path / "again", {"arm": fixed}).errors


def test_a_second_encoder_does_not_cost_the_first_one(tmp_path: Path) -> None:
    other = replace(ENCODER, name="second")
    done = write_tables(
        log_of(tmp_path / "r.raw", [ENCODER, other], [*stream(0, 1.0), *stream(1, 1.0)])
    )
    assert done.rows["stage.csv"] == 1000 and list(done.errors) == ["second"]


def test_a_frame_counter_gone_wild_costs_frames_csv_alone(tmp_path: Path) -> None:
    """Two lines within a microsecond, and an hour later a third: no table of 10^9 frames."""
    counter = DeviceDescription("counter", "frames", "z", protocol="regex", pattern=r"(?P<t>\d+)")
    lines = [Entry(RECEIVED, 1, 10**6 * (k + 1), b"%d\n" % k) for k in range(100)]
    late = Entry(RECEIVED, 1, 99 * 10**9, b"98999000\n98999001\n")
    done = write_tables(
        log_of(tmp_path / "r.raw", [ENCODER, counter], [*stream(0, 1.0), *lines, late])
    )
    assert of_device(done, "encoder") == (1000, None)
    assert done.rows["frames.csv"] < 200_000


@pytest.mark.parametrize("unit", [1e-3, 1e-9, 1 / 32768])
def test_stamps_in_another_unit_name_the_line_that_is_right(tmp_path: Path, unit: float) -> None:
    wide = replace(ENCODER, time_bits=0)
    sent = stream(1, 8.0, "{t},1,2,3\n", unit)
    done = write_tables(log_of(tmp_path / "r.raw", [wide, ARM], [*stream(0, 8.0), *sent]))
    assert of_device(done, "encoder") == (8000, None)
    readings, error = of_device(done, "arm")
    found = re.search(r"time_unit_s = (\S+)", error or "")
    assert readings == 0 and found is not None
    assert float(found[1]) == pytest.approx(unit, rel=0.02)
    right = replace(ARM, time_unit_s=float(found[1]), time_bits=0)
    again = write_tables(tmp_path / "r.raw", tmp_path / "again", {"arm": right})
    assert not again.errors and again.summary["devices"]["arm"]["readings"] > 7000


@pytest.mark.parametrize("rate_hz", [400, 500, 800, 3000])
def test_a_timer_of_16_bits_is_in_the_stated_unit(tmp_path: Path, rate_hz: int) -> None:
    """It wraps every 65 ms, less than the time over which the rate of stamps is measured."""
    short = replace(ENCODER, time_bits=16)
    sent = [
        Entry(RECEIVED, 0, round(1e9 * t), f"{round(1e6 * t) % 2**16},{k}\n".encode())
        for k, t in enumerate(np.arange(3 * rate_hz) / rate_hz)
    ]
    assert of_device(write_tables(log_of(tmp_path / "r.raw", [short], sent)), "encoder") == (
        len(sent), None,
    )  # fmt: skip
    slow = replace(short, time_unit_s=1e-3)
    readings, error = of_device(
        write_tables(tmp_path / "r.raw", None, {"encoder": slow}), "encoder"
    )
    assert readings == 0 and error is not None and "time_unit_s = 1e-06" in error


def test_the_rate_of_stamps_does_not_mind_pauses_wraps_and_bursts() -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(np.where(rng.random(3000) < 0.05, 1.0, 1e-3))
    arrived = np.ceil(t / 0.016) * 0.016
    assert stamp_rate(arrived, t) == pytest.approx(1.0, rel=0.2)
    wrapped = np.mod(np.arange(30_000) * 1e-3, 0.5)
    assert stamp_rate(np.ceil(np.arange(30_000) / 16) * 0.016, wrapped) == pytest.approx(1, rel=0.2)
    assert stamp_rate(arrived, 1e-3 * t) == pytest.approx(1e-3, rel=0.2)
    assert stamp_rate(np.full(100, 5.0), np.arange(100) / 1000) is None


@pytest.fixture
def practice_log(tmp_path: Path) -> tuple[Path, list[DeviceRecord]]:
    path = tmp_path / "recording.raw"
    simulated_log(path, practice_devices()[:2], 2.0, np.random.default_rng(0))
    return path, list(replay(path).records)


def same(found: list[DeviceRecord], expected: list[DeviceRecord]) -> bool:
    return all(
        np.array_equal(a.t_s, b.t_s) and np.array_equal(a.values["t"], b.values["t"])
        for a, b in zip(found, expected, strict=True)
    )


def pieces(path: Path) -> tuple[bytes, list[bytes]]:
    data = path.read_bytes()
    return data[: data.index(MARKER)], [packed(entry) for entry in read_log(path)]


def test_a_log_with_exchanged_and_doubled_parts_is_put_in_order(
    practice_log: tuple[Path, list[DeviceRecord]], tmp_path: Path
) -> None:
    path, expected = practice_log
    head, parts = pieces(path)
    third = len(parts) // 3
    a, b, c = parts[:third], parts[third : 2 * third], parts[2 * third :]
    for k, order in enumerate(([b, a, c], [a, c, b], [a, b, b, c], [a, a, b, c], [a, b, a, c])):
        spliced = tmp_path / f"{k}.raw"
        spliced.write_bytes(head + b"".join(b"".join(part) for part in order))
        assert not scan_log(spliced).ordered
        assert same(list(replay(spliced).records), expected), order


def test_entries_of_another_recording_are_not_used(
    practice_log: tuple[Path, list[DeviceRecord]], tmp_path: Path
) -> None:
    path, expected = practice_log
    other = tmp_path / "other.raw"
    with RawLog(other, LogHeader(10**12, "now", (), (ENCODER, ARM, ARM))) as log:
        for k in range(100):
            log.append(Entry(RECEIVED, k % 3, 10**12 + k * 10**6, b"%d,5\n" % k))
        log.flush()
    joined = tmp_path / "joined.raw"
    joined.write_bytes(path.read_bytes() + other.read_bytes())
    found = replay(joined)
    assert same(list(found.records), expected) and found.ended
    assert found.damaged_bytes == other.stat().st_size
    joined.write_bytes(other.read_bytes() + path.read_bytes())
    assert len(replay(joined).records[0].t_s) == 34, "its own entries, none that are older"


def test_a_log_with_bytes_changed_anywhere_is_read_or_refused(
    practice_log: tuple[Path, list[DeviceRecord]], tmp_path: Path
) -> None:
    path, expected = practice_log
    data, rng = path.read_bytes(), np.random.default_rng(1)
    torn, total = tmp_path / "torn.raw", sum(len(r.t_s) for r in expected)
    refused = 0
    for _ in range(10):
        kind, at = rng.integers(4), int(rng.integers(len(data)))
        other, size = int(rng.integers(len(data))), int(rng.integers(1, 3000))
        changed = {
            0: data[:at],
            1: data[:at] + rng.integers(0, 256, size, np.uint8).tobytes() + data[at:],
            2: data[:at] + data[at + size :],
            3: data[:at] + data[other : other + 10 * size] + data[at:],
        }[int(kind)]
        torn.write_bytes(changed)
        try:
            found = replay(torn).records
        except InputError:
            refused += 1
            continue
        if kind:
            assert sum(len(r.t_s) for r in found) > 0.8 * total
        for one, sound in zip(found, expected):
            assert one.error is None or not len(one.t_s)
            assert set(one.values["t"]) <= set(sound.values["t"])
    assert refused < 5


@pytest.mark.parametrize(
    "change",
    [
        {"start_ns": "x"},
        {"devices": [{"name": "e", "kind": "encoder", "port": 7}]},
        {"devices": [{"name": "e", "kind": "oven", "port": "x"}]},
        {"devices": [{"name": "e", "kind": "encoder", "port": "x", "time_bits": 10**9}]},
        {"devices": [{"name": "e", "kind": "encoder", "port": "x", "poll_hz": -1.0}]},
        {"devices": {"e": 1}},
        {"cameras": [[1]]},
    ],
)
def test_a_header_with_wrong_values_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    import zlib

    header = {"start_ns": 0, "started": "", "cameras": [], "devices": []} | change
    text = json.dumps(header).encode()
    length, crc = (n.to_bytes(4, "little") for n in (len(text), zlib.crc32(text)))
    (tmp_path / "x.raw").write_bytes(b"telerig recording 1\n" + length + text + crc)
    with pytest.raises(InputError, match="does not know") as caught:
        replay(tmp_path / "x.raw")
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("port", "words"),
    [
        ("spy:///dev/ttyUSB0?file={victim}", "has the scheme spy://"),
        ("SPY://{victim}?file={victim}", "has the scheme SPY://"),
        ("alt:///dev/ttyUSB0?class=PosixPollSerial", "scheme alt"),
        ("hwgrep://(a+)+$", "scheme hwgrep"),
        ("socket://localhost:1?logging=debug", "has the option 'logging=debug'"),
        ("rfc2217://localhost:1?file={victim}", "has the option"),
        ("{victim}", "is a file, not a serial port"),
        ("/dev/x\n", "control character"),
        ("/dev/" + 5000 * "x", "has 5005 characters"),
    ],
)
def test_a_port_that_is_no_port_touches_nothing(tmp_path: Path, port: str, words: str) -> None:
    victim = tmp_path / "victim.json"
    victim.write_text("precious")
    with pytest.raises(InputError, match=re.escape(words)):
        open_port(replace(ENCODER, port=port.format(victim=victim)))
    assert victim.read_text() == "precious" and len(list(tmp_path.iterdir())) == 1


def test_ports_that_may_be_used() -> None:
    for port in ("/dev/ttyUSB0", "COM3", "loop://", "socket://192.168.0.2:4001"):
        assert port_fault(port) is None
    assert port_fault("rfc2217://host:2217?ign_set_control&timeout=3") is None


def test_an_expression_takes_no_longer_than_its_line() -> None:
    expression = LinePattern(r"(?P<counts>(a+)+)$")
    assert expression.cells(b"a" * 4000 + b"b") is None
    assert expression.cells(b"aaa") == (b"aaa",)
    assert LinePattern(r"(?P<t>\d+)(?:,(?P<ax>\d))?").cells(b"12") == (None, b"12")
    for wrong in (r"(?P<t>", r"(?P<t>.)\1", r"(?=x)y", r"(((a{999}){999}){999})"):
        with pytest.raises(ValueError, match=r"."):
            LinePattern(wrong)
