"""telerig simulate --devices: serial devices to practise recording with, over pseudo-terminals."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from numpy.random import Generator

from telerig.errors import InputError
from telerig.scripts.console import say, stopped_by_signals


def simulate_devices(out: Path | None, seconds: float | None, rng: Generator) -> None:
    """Print the ports' names; with ``out`` also write a dataset whose rig.toml has them."""
    if sys.platform == "win32":
        raise InputError("Windows has no pseudo-terminals", todo="practise on Linux or macOS")
    from telerig.io.recording.simulated.devices import SimulatedPorts
    from telerig.io.recording.simulated.practice import practice_devices, practice_rig
    from telerig.io.rig_file.rig_file import write_rig_toml
    from telerig.io.rig_file.writer import rig_toml

    if out is not None and (out / "rig.toml").exists():
        raise InputError(
            "exists already", where=str(out / "rig.toml"), todo="give a new folder with --out"
        )
    with (
        tempfile.TemporaryDirectory(prefix="telerig-") as folder,
        SimulatedPorts(practice_devices(), Path(folder), rng) as ports,
    ):
        rig = practice_rig(ports.devices)
        for device in ports.devices:
            say(f"{device.name}: {device.port}")
        if out is not None:
            write_rig_toml(rig, out / "rig.toml")
            say(f"next, in another terminal: telerig record {out}/runs/practice --seconds 20")
        else:
            say("\nfor rig.toml:\n" + "[devices" + rig_toml(rig).split("[devices", 1)[1])
        say("Ctrl-C ends the devices")
        sys.stdout.flush()
        with stopped_by_signals() as stop:
            stop.wait(seconds)
