"""telerig record: encoder, accelerometers and frame counters over serial lines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from telerig.errors import InputError
from telerig.scripts.console import errors_in_words, say, stopped_by_signals

if TYPE_CHECKING:
    from telerig.io.rig_file.description import DeviceDescription, RigDescription


def record(
    run: Annotated[
        Path | None, typer.Argument(help="Run to record: DATASET/runs/NAME, a new folder.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="How long [until Ctrl-C].", min=0.1)] = None,
    port: Annotated[
        list[str] | None,
        typer.Option(help="NAME=PORT instead of the port in rig.toml; may be given again."),
    ] = None,
    rig: Annotated[Path | None, typer.Option(help="rig.toml [DATASET/rig.toml].")] = None,
    replay: Annotated[
        Path | None,
        typer.Option(help="Make the tables again from this recording.raw, byte for byte."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the tables [the run].")] = None,
    ports: Annotated[bool, typer.Option("--ports", help="List the serial ports and end.")] = False,
    quiet: Annotated[bool, typer.Option(help="Print only the summary.")] = False,
) -> None:
    """Record the devices of rig.toml ([devices.NAME]) until Ctrl-C: stage.csv and the others.

    Every byte goes to recording.raw first, on the disk within a second; stage.csv,
    accelerometer.csv, frames.csv and recording.json are made of it at the end, and can be made
    again (--replay). A device that is unplugged is waited for. Practise without hardware:
    telerig simulate --devices --out practice.

    Exit code 0: recorded. 2: a device, port or file cannot be used, with what to do.
    """
    with errors_in_words():
        if ports:
            _list_ports()
            return
        from telerig.io.recording.tables import refuse_existing, write_tables
        from telerig.scripts.record_display import recording_words

        if replay is not None:
            _alone(run, seconds, port)
            log = replay / "recording.raw" if replay.is_dir() else replay
            if not ((out or log.parent) / "recording.json").exists():
                refuse_existing(out or log.parent)
            done = write_tables(log, out)
        else:
            place = out or run
            if place is not None:
                refuse_existing(place)
            done = write_tables(_recorded(run, seconds, port or [], rig, quiet), out)
        say(recording_words(done))


def _alone(run: Path | None, seconds: float | None, port: list[str] | None) -> None:
    if run is not None or seconds is not None or port:
        raise InputError(
            "--replay reads a recording, it records nothing",
            todo="leave out the run, --seconds and --port; --out says where the tables go",
        )


def _recorded(
    run: Path | None, seconds: float | None, ports: list[str], rig: Path | None, quiet: bool
) -> Path:
    from telerig.io.recording.session import record as record_run
    from telerig.scripts.record_display import display

    if run is None:
        raise InputError(
            "no run is given", todo="name a new folder: telerig record DATASET/runs/NAME"
        )
    description = _rig(run, rig)
    devices = _devices(description, ports)
    with stopped_by_signals() as stop, display(quiet) as tell:
        return record_run(
            devices, run, cameras=list(description.cameras), seconds=seconds, stop=stop, tell=tell
        )


def _rig(run: Path, rig: Path | None) -> RigDescription:
    from telerig.io.rig_file.rig_file import read_rig_toml

    file = rig or run.resolve().parent.parent / "rig.toml"
    if rig is None and not file.is_file():
        raise InputError(
            "there is no rig.toml two folders above the run",
            where=str(run),
            todo="record into DATASET/runs/NAME, or give the file (--rig FILE)",
        )
    description = read_rig_toml(file)
    if not description.devices:
        raise InputError(
            "names no device to record",
            where=str(file),
            todo='add a table [devices.encoder] with kind = "encoder", port and counts_per_mm; '
            "see docs/recording.md",
        )
    return description


def _devices(rig: RigDescription, ports: list[str]) -> list[DeviceDescription]:
    """The rig's devices, with the ports that the command line gives."""
    from telerig.errors import suggestion

    given: dict[str, str] = {}
    for text in ports:
        name, equals, port = text.partition("=")
        if not equals or not port:
            raise InputError(f"--port {text}", todo="write --port NAME=PORT")
        if name not in rig.devices:
            known = list(rig.devices)
            raise InputError(f"--port: no device {name!r}", todo=suggestion(name, known))
        if name in given:
            raise InputError(f"--port names {name} twice", todo="give each device one port")
        given[name] = port
    devices = [replace(d, port=given.get(name, d.port)) for name, d in rig.devices.items()]
    for i, device in enumerate(devices):
        for other in devices[:i]:
            if other.port == device.port:
                raise InputError(
                    f"{other.name} and {device.name} have the same port",
                    where=device.port,
                    todo="give each device its own port",
                )
    return devices


def _list_ports() -> None:
    from telerig.io.recording.ports import known_ports

    found = known_ports()
    for text in found:
        say(text)
    if not found:
        say("no serial port is there; practise with telerig simulate --devices --out practice")


if __name__ == "__main__":
    typer.run(record)
