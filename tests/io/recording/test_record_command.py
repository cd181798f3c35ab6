"""telerig record and telerig simulate --devices, as a user calls them; devices in rig.toml."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from seeds import first_or_all
from simulated_log import simulated_log
from typer.testing import CliRunner

from telerig.errors import InputError
from telerig.io.recording.simulated.devices import (
    SimulatedDevice,
    SimulatedPorts,
    practice_devices,
    practice_rig,
)
from telerig.io.rig_file.rig_file import description_from_toml, read_rig_toml, write_rig_toml
from telerig.scripts.main import app

runner = CliRunner()

RIG = """
schema = 1
[cameras.left]
image_size_px = [512, 512]
scale_px_per_mm = 10.0
[target]
rows = 3
columns = 5
pitch_mm = 7.0
dot_diameter_mm = 2.4
[accelerometers.arm_left]
mounted_on = "left"
axes = [[1,0,0],[0,1,0],[0,0,1]]
noise_density_ug_sqrt_hz = 22.5
"""


def run(*arguments: str | Path, code: int = 0) -> str:
    result = runner.invoke(app, [str(a) for a in arguments])
    assert result.exit_code == code, result.output
    return re.sub(r"\s+", " ", result.output)


def words(devices: str) -> str:
    with pytest.raises(InputError) as caught:
        description_from_toml(RIG + devices, where="rig.toml")
    return str(caught.value)


@pytest.fixture
def dataset(tmp_path: Path) -> Iterator[Path]:
    with SimulatedPorts(practice_devices(), tmp_path / "p", np.random.default_rng(0)) as ports:
        write_rig_toml(practice_rig(ports.devices), tmp_path / "rig.toml")
        yield tmp_path


def test_record_and_replay_bit_for_bit(dataset: Path) -> None:
    folder = dataset / "runs" / "one"
    said = run("record", folder, "--seconds", "1.5", "--quiet")
    assert "encoder: 1" in said and "its clock:" in said and "frames, 0 missing" in said
    names = ["stage.csv", "accelerometer.csv", "frames.csv", "recording.json"]
    first = [(folder / name).read_bytes() for name in names]
    assert "readings" in run("record", "--replay", folder, "--out", dataset / "again")
    assert [(dataset / "again" / name).read_bytes() for name in names] == first
    assert "never written over" in run("record", folder, "--seconds", "1", code=2)
    run("record", folder.with_name("two"), "--seconds", "0.6", "--port", "arm_left=loop://")
    two = pd.read_csv(dataset / "runs" / "two" / "accelerometer.csv")
    assert set(two["sensor"]) == {"arm_right"}


@pytest.mark.parametrize("number", first_or_all(signal.SIGINT, signal.SIGTERM))
def test_a_signal_closes_the_recording(dataset: Path, number: signal.Signals) -> None:
    folder = dataset / "runs" / "one"
    command = [sys.executable, "-m", "telerig.scripts.main", "record", str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    log, deadline = folder / "recording.raw", time.monotonic() + 30
    while not log.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(1.0)
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert "written:" in out and "cut off" not in out
    assert re.search(r"\d s: encoder \d+ \(\d+/s\), malformed 0, lost 0", err), "plain lines"
    stage = pd.read_csv(folder / "stage.csv")
    assert len(stage) > 500 and np.all(np.diff(stage["t_s"]) > 0)


def test_simulated_devices_print_their_ports_and_end(tmp_path: Path) -> None:
    out = tmp_path / "practice"
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = [signal.getsignal(number) for number in numbers]
    said = run("simulate", "--devices", "--out", out, "--seconds", "0.2")
    assert [signal.getsignal(number) for number in numbers] == handlers
    for device in read_rig_toml(out / "rig.toml").devices.values():
        assert f"{device.name}: {device.port}" in said
        assert not os.path.lexists(device.port), "the ports go with their simulator"
    assert f"telerig record {out}" in said
    assert "exists already" in run("simulate", "--devices", "--out", out, code=2)
    assert "[devices.encoder]" in run("simulate", "--devices", "--seconds", "0.1")
    assert "--out is missing" in run("simulate", "paper", code=2)


def test_what_record_refuses(dataset: Path, tmp_path: Path) -> None:
    folder = dataset / "runs" / "one"
    assert "no [devices.encodr]" in run("record", folder, "--port", "encodr=/dev/x", code=2)
    assert "did you mean encoder?" in run("record", folder, "--port", "encodr=/dev/x", code=2)
    twice = ("--port", "encoder=a", "--port", "encoder=b")
    assert "names encoder twice" in run("record", folder, *twice, code=2)
    same = ("--port", "encoder=/dev/q", "--port", "arm_left=/dev/q")
    assert "have the same port" in run("record", folder, *same, code=2)
    assert "NAME=PORT" in run("record", folder, "--port", "encoder", code=2)
    gone = run("record", folder, "--port", "encoder=/dev/none", code=2)
    assert "there is no such port" in gone and "plug the device in" in gone
    assert "no run is given" in run("record", code=2)
    assert "records nothing" in run("record", folder, "--replay", folder, code=2)
    assert "no rig.toml" in run("record", tmp_path / "elsewhere" / "x" / "y", code=2)
    (dataset / "bare.toml").write_text(RIG)
    assert "names no device" in run("record", folder, "--rig", dataset / "bare.toml", code=2)
    assert not folder.exists()


@pytest.mark.parametrize("name", ["stage.csv", "accelerometer.csv", "frames.csv"])
def test_tables_that_are_there_are_not_written_over(dataset: Path, name: str) -> None:
    """As of a run whose images are there already, with the camera program's own times."""
    folder = dataset / "runs" / "one"
    folder.mkdir(parents=True)
    (folder / name).write_text("precious")
    assert "never written over" in run("record", folder, "--seconds", "0.2", code=2)
    elsewhere = ("--seconds", "0.2", "--out", folder)
    assert "never written over" in run("record", dataset / "runs" / "two", *elsewhere, code=2)
    assert [p.name for p in folder.iterdir()] == [name]
    assert (folder / name).read_text() == "precious"
    assert not (dataset / "runs" / "two").exists()


def test_a_replay_replaces_nothing_but_tables_of_a_recording(dataset: Path) -> None:
    run("record", dataset / "runs" / "one", "--seconds", "0.3", "--quiet")
    other = dataset / "runs" / "other"
    other.mkdir()
    (other / "stage.csv").write_text("precious")
    again = ("record", "--replay", dataset / "runs" / "one")
    assert "never written over" in run(*again, "--out", other, code=2)
    assert (other / "stage.csv").read_text() == "precious"
    run(*again)
    run(*again, "--out", dataset / "new")
    run(*again, "--out", dataset / "new")


def test_one_device_described_wrongly_costs_its_own_table_and_the_exit_code(
    tmp_path: Path,
) -> None:
    sims = practice_devices()[:2]
    told = [sims[0], replace(sims[1], device=replace(sims[1].device, time_unit_s=1e-3))]
    stamps_as_sent = replace(sims[1].device, port="x")
    rng = np.random.default_rng(2)
    simulated_log(tmp_path / "recording.raw", sims, 3.0, rng, [sim.device for sim in told])
    said = run("record", "--replay", tmp_path, code=2)
    assert "times as fast as the host's clock" in said and "time_unit_s = 1e-06" in said
    assert len(pd.read_csv(tmp_path / "stage.csv")) > 2900
    devices = with_ports([sims[0], replace(sims[1], device=stamps_as_sent)])
    write_rig_toml(practice_rig([sim.device for sim in devices]), tmp_path / "rig.toml")
    said = run("record", "--replay", tmp_path, "--rig", tmp_path / "rig.toml")
    assert len(pd.read_csv(tmp_path / "accelerometer.csv")) > 5900


def test_ports_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("telerig.io.recording.ports.known_ports", lambda: ["/dev/ttyACM0 (Stage)"])
    assert run("record", "--ports") == "/dev/ttyACM0 (Stage) "
    monkeypatch.setattr("telerig.io.recording.ports.known_ports", list)
    assert "telerig simulate --devices" in run("record", "--ports")


def test_devices_of_a_rig_file_round_trip(tmp_path: Path) -> None:
    rig = practice_rig([sim.device for sim in with_ports(practice_devices())])
    write_rig_toml(rig, tmp_path / "rig.toml")
    assert read_rig_toml(tmp_path / "rig.toml").devices == rig.devices


def with_ports(sims: list[SimulatedDevice]) -> list[SimulatedDevice]:
    return [
        replace(sim, device=replace(sim.device, port=f"/dev/tty{k}")) for k, sim in enumerate(sims)
    ]


@pytest.mark.parametrize(
    ("devices", "expected"),
    [
        ('[devices.e]\nkind = "encoder"\nprot = "x"', r"prot: unknown key(.|\n)*mean port\?"),
        ('[devices.e]\nkind = "encodr"\nport = "x"', r"encodr(.|\n)*did you mean encoder\?"),
        ('[devices.e]\nkind = "encoder"\nport = "x"', r"counts_per_mm: is missing(.|\n)*1 mm"),
        ('[devices.b]\nkind = "accelerometer"\nport = "x"', r"no accelerometer 'b'"),
        (
            '[devices.arm_lft]\nkind = "accelerometer"\nport = "x"',
            r"did you mean arm_left\?",
        ),
        (
            '[devices.arm_left]\nkind = "accelerometer"\nport = "x"\nprotocol = "zaber"',
            r"no protocol for the kind accelerometer(.|\n)*known: stream, packets, regex",
        ),
        (
            '[devices.e]\nkind = "encoder"\nport = "x"\nprotocol = "regex"',
            r"pattern: is missing(.|\n)*\(\?P<counts>",
        ),
        (
            '[devices.e]\nkind = "encoder"\nport = "x"\nprotocol = "regex"\npattern = "(?P<t>.)"',
            r"lacks groups \(it names t\)(.|\n)*\(\?P<position_mm>",
        ),
        (
            '[devices.e]\nkind = "encoder"\nport = "x"\nprotocol = "regex"\npattern = \'(?P<\'',
            r"is no regular expression",
        ),
        (
            '[devices.e]\nkind = "encoder"\nport = "x"\nprotocol = "regex"\n'
            'pattern = "(?P<time>.)(?P<counts>.)"\ncounts_per_mm = 1.0',
            r"has a group 'time'(.|\n)*known: counts, position_mm, t",
        ),
        (
            '[devices.f]\nkind = "frames"\nport = "x"\ncameras = ["lef"]',
            r"no camera 'lef'(.|\n)*did you mean left\?",
        ),
        (
            '[devices.e]\nkind = "encoder"\nport = "x"\ncounts_per_mm = 1.0\n'
            '[devices.f]\nkind = "frames"\nport = "x"',
            r"is x, which devices.e has already",
        ),
        (
            '[devices.e]\nkind = "encoder"\nport = "x"\ncounts_per_mm = 1.0\n'
            '[devices.e]\nkind = "frames"\nport = "y"',
            r"devices(.|\n)*twice|Cannot declare",
        ),
        (
            '[devices.e]\nkind = "encoder"\nport = "x"\ncounts_per_mm = 1.0\n'
            '[devices.E]\nkind = "frames"\nport = "y"',
            r"is one sensor named twice\?",
        ),
        (
            '[devices.e]\nkind = "encoder"\nport = "x"\ncounts_per_mm = 1.0\n'
            '[devices.d]\nkind = "encoder"\nport = "y"\ncounts_per_mm = 1.0',
            r"2 encoders(.|\n)*keep one",
        ),
        ('[devices.e]\nkind = "encoder"\nport = "x"\npoll = "?"', r"poll: is given(.|\n)*regex"),
        ('[device.e]\nkind = "encoder"', r"did you mean devices\?"),
        (
            '[devices.e]\nkind = "encoder"\nport = "spy:///dev/x?file=y"\ncounts_per_mm = 1.0',
            r"port(.|\n)*scheme spy://(.|\n)*socket://",
        ),
        (
            '[devices.e]\nkind = "encoder"\nport = "x"\nprotocol = "regex"\n'
            "pattern = '(?=x)(?P<position_mm>.)'",
            r"is no regular expression(.|\n)*look-around",
        ),
    ],
)
def test_what_a_rig_file_may_not_say(devices: str, expected: str) -> None:
    assert re.search(expected, words(devices)), words(devices)


def test_a_log_of_another_time_needs_no_rig_file(tmp_path: Path) -> None:
    simulated_log(tmp_path / "recording.raw", practice_devices()[:1], 3.0, np.random.default_rng(1))
    said = run("record", "--replay", tmp_path)
    assert "encoder: 29" in said or "encoder: 30" in said
    assert "no recording of telerig" in run("record", "--replay", tmp_path / "stage.csv", code=2)


@pytest.mark.parametrize("name", ["calibration", "@one"])
def test_a_run_that_no_command_would_take_is_not_recorded(tmp_path: Path, name: str) -> None:
    said = run("record", tmp_path / "runs" / name, code=2)
    assert "the calibration" in said or "begins with @" in said
