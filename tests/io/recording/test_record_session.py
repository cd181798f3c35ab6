"""Recording in real time from simulated devices over pseudo-terminals."""

from __future__ import annotations

import errno
import os
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from telerig.errors import InputError
from telerig.io.recording import ports as record_ports
from telerig.io.recording.replay import replay
from telerig.io.recording.session import FAILED_NAME, LOG_NAME, Status, record
from telerig.io.recording.simulated.devices import (
    Faults,
    SimulatedDevice,
    SimulatedPorts,
    practice_devices,
    stage_position_mm,
    true_values,
)
from telerig.io.recording.tables import write_tables
from telerig.io.rig_file.description import DeviceDescription


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def numbers(sim: SimulatedDevice, stamps: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    ticks = np.mod(stamps - sim.start_ticks, 2.0**32)
    return np.round(ticks * 1e-6 * sim.rate_hz).astype(int)


def test_three_lines_at_five_thousand_readings_a_second(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    told: list[Status] = []
    with SimulatedPorts(practice_devices(), tmp_path / "ports", rng) as ports:
        used = time.process_time()
        log = record(ports.devices, tmp_path / "run", seconds=2.5, tell=told.append)
        used = time.process_time() - used
    assert used < 2.5, "devices and recorder together"
    found = replay(log)
    assert found.ended
    for sim, truth, one in zip(ports.sims, ports.truths, found.records):
        number = numbers(sim, one.values["t"])
        assert np.array_equal(np.diff(number), np.ones(len(number) - 1)), "no reading is missing"
        assert len(number) > 2.2 * sim.rate_hz
        for name, value in true_values(sim, number).items():
            assert np.array_equal(one.values[name], value)
        start_s = (truth.start_ns - found.header.start_ns) * 1e-9
        late = one.t_s - start_s - sim.due_s(number)
        assert late.min() > -1e-3 and late.max() < 0.02
        assert len(one.malformed_s) == 0 and not truth.overrun
    assert len(told) >= 4 and told[-1].devices[0].readings == len(found.records[0].t_s)
    assert abs(np.median([s.devices[0].rate_hz for s in told[1:-1]]) - 1000) < 150


def test_unplugged_and_plugged_in_again(tmp_path: Path, rng: np.random.Generator) -> None:
    sims = practice_devices()[:2]
    sims[0] = replace(sims[0], faults=Faults(unplug_s=(1.0,), away_s=0.8))
    with SimulatedPorts(sims, tmp_path / "ports", rng) as ports:
        log = record(ports.devices, tmp_path / "run", seconds=3.0)
    done = write_tables(log)
    encoder, arm = (done.summary["devices"][sim.device.name] for sim in sims)
    (away,) = encoder["unplugged"]
    assert 0.7 < away["found_s"] - away["lost_s"] < 1.6
    assert [gap["why"] for gap in encoder["gaps"]] == ["unplugged"]
    assert 700 < encoder["lost"] < 1700 and len(encoder["clocks"]) == 1
    assert arm["gap_count"] == 0 and arm["unplugged"] == []
    one = replay(log).records[0]
    number = numbers(ports.sims[0], one.values["t"])
    assert number[-1] - number[0] + 1 - len(number) == encoder["lost"]


@pytest.mark.parametrize("protocol", ["zaber", "grbl"])
def test_a_polled_stage(tmp_path: Path, rng: np.random.Generator, protocol: str) -> None:
    device = DeviceDescription(
        "stage", "encoder", "x", protocol=protocol, counts_per_mm=1e4, poll_hz=50.0  # type: ignore[arg-type]
    )  # fmt: skip
    sim = SimulatedDevice(device, 50.0, jitter_s=0.004)
    with SimulatedPorts([sim], tmp_path / "ports", rng) as ports:
        log = record(ports.devices, tmp_path / "run", seconds=1.2)
    found = replay(log)
    (one,) = found.records
    assert 35 < len(one.t_s) <= 61
    place = one.values.get("position_mm", one.values.get("counts", np.zeros(0)) / 1e4)
    elapsed = one.t_s - (ports.truths[0].start_ns - found.header.start_ns) * 1e-9
    assert np.median(np.abs(place - stage_position_mm(elapsed))) < 0.05
    assert one.time_from.startswith("middle") and 0 < one.half_width_s < 0.02


def test_the_stop_event_closes_at_once(tmp_path: Path, rng: np.random.Generator) -> None:
    stop = threading.Event()
    with SimulatedPorts(practice_devices()[:1], tmp_path / "ports", rng) as ports:
        threading.Timer(0.7, stop.set).start()
        begun = time.monotonic()
        log = record(ports.devices, tmp_path / "run", stop=stop)
        assert time.monotonic() - begun < 3.0
    assert replay(log).ended


def test_the_log_is_on_the_disk_while_it_runs(tmp_path: Path, rng: np.random.Generator) -> None:
    seen: list[float] = []
    log = tmp_path / "run" / LOG_NAME

    def look(status: Status) -> None:
        if status.seconds > 1.2 and not seen:
            copy = tmp_path / "copy.raw"
            copy.write_bytes(log.read_bytes())
            seen.append(status.seconds - float(replay(copy).records[0].t_s[-1]))

    with SimulatedPorts(practice_devices()[:1], tmp_path / "ports", rng) as ports:
        record(ports.devices, tmp_path / "run", seconds=2.0, tell=look)
    assert len(seen) == 1 and seen[0] < 1.0


class NoisyPort:
    """Bytes as a wrong baud rate gives them."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(1)
        self.in_waiting = 40

    def read(self, size: int) -> bytes:
        time.sleep(0.01)
        return self._rng.integers(128, 256, size, np.uint8).tobytes()

    def close(self) -> None:
        self.in_waiting = 0


def test_only_garbage_is_said_after_two_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("telerig.io.recording.session.open_port", lambda _: NoisyPort())
    device = DeviceDescription("encoder", "encoder", "/dev/x", counts_per_mm=1.0)
    begun = time.monotonic()
    with pytest.raises(InputError, match=r"not one reading(.|\n)*set baud in rig.toml"):
        record([device], tmp_path / "run", seconds=30.0)
    assert 1.9 < time.monotonic() - begun < 5.0
    assert (tmp_path / "run" / FAILED_NAME).is_file(), "the name of the run is free again"
    assert not (tmp_path / "run" / LOG_NAME).exists()


def test_stamps_in_another_unit_are_said_after_two_seconds(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    with SimulatedPorts(practice_devices()[:2], tmp_path / "ports", rng) as ports:
        wrong = [ports.devices[0], replace(ports.devices[1], time_unit_s=1e-3)]
        with pytest.raises(InputError, match=r"1000 times as fast(.|\n)*time_unit_s = 1e-06"):
            record(wrong, tmp_path / "run", seconds=30.0)
    found = replay(tmp_path / "run" / FAILED_NAME, {d.name: d for d in ports.devices})
    assert all(len(one.t_s) > 1500 for one in found.records), "nothing of it is lost"


def test_a_pattern_cannot_stop_the_other_devices(tmp_path: Path) -> None:
    class Line(NoisyPort):
        def __init__(self, text: bytes) -> None:
            super().__init__()
            self.text, self.sent = text, 0

        def read(self, size: int) -> bytes:
            time.sleep(0.002)
            self.sent += 1
            return b"%d,5\n1\n" % (2000 * self.sent) if self.text == b"stream" else self.text

    own = DeviceDescription(
        "own", "encoder", "/dev/y", protocol="regex", pattern=r"(?P<counts>(1+)+)"
    )
    stream = DeviceDescription("stream", "frames", "/dev/x", protocol="stream", cameras=("left",))
    lines = {"own": Line(b"1" * 3000 + b"x\n1\n"), "stream": Line(b"stream")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("telerig.io.recording.session.open_port", lambda d: lines[d.name])
        begun = time.monotonic()
        log = record([own, stream], tmp_path / "run", seconds=1.0)
    assert time.monotonic() - begun < 4.0
    own_record, other = replay(log).records
    assert len(own_record.malformed_s) > 50 and len(other.t_s) > 50


class BreakingPort(NoisyPort):
    """A port whose driver raises what nobody expects, each time after a few readings."""

    def __init__(self) -> None:
        super().__init__()
        self.sent = 0

    def read(self, size: int) -> bytes:
        time.sleep(0.01)
        self.sent += 1
        if self.sent % 20 == 0:
            raise RuntimeError("a fault of the driver")
        return b"%d,5\n" % (10_000 * self.sent)


def test_a_reader_that_breaks_is_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = BreakingPort()
    monkeypatch.setattr("telerig.io.recording.session.open_port", lambda _: port)
    monkeypatch.setattr("telerig.io.recording.ports.open_port", lambda _: port)
    device = DeviceDescription("encoder", "encoder", "/dev/x", counts_per_mm=1.0)
    log = record([device], tmp_path / "run", seconds=1.5)
    (one,) = replay(log).records
    assert len(one.away_s) >= 2 and len(one.t_s) + len(one.away_s) * 2 >= port.sent - 2


def test_a_missing_port_names_those_that_exist(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_ports, "known_ports", lambda: ["/dev/ttyUSB7 (FT232R)"])
    device = DeviceDescription("encoder", "encoder", str(tmp_path / "no"), counts_per_mm=1.0)
    with pytest.raises(InputError) as caught:
        record([device], tmp_path / "run")
    assert "there is no such port" in str(caught.value)
    assert "/dev/ttyUSB7 (FT232R)" in caught.value.todo and "--port encoder=" in caught.value.todo
    assert not (tmp_path / "run").exists()


def test_a_port_without_permission_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import serial

    def refused(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(serial, "serial_for_url", refused)
    device = DeviceDescription("encoder", "encoder", "/dev/ttyUSB0", counts_per_mm=1.0)
    with pytest.raises(InputError, match=r"no permission(.|\n)*dialout"):
        record([device], tmp_path / "run")
