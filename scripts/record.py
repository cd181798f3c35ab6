"""telerig record: encoder, accelerometers and frame counters over serial lines."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from telerig.errors import InputError
from telerig.scripts import options
from telerig.scripts.console import (
    EXIT_BAD_INPUT,
    errors_in_words,
    run_file,
    say,
    stopped_by_signals,
    viewed,
)
from telerig.short_text import counted

if TYPE_CHECKING:
    from rich.table import Table

    from telerig.io.recording.session import DeviceStatus, Status
    from telerig.io.recording.tables import Recording
    from telerig.io.rig_file.description import DeviceDescription, RigDescription

_PLAIN_EVERY_S = 5.0


@errors_in_words()
def record(
    run: Annotated[
        Path | None, typer.Argument(help="Run to record: DATASET/runs/NAME, a new folder.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(help="Duration in seconds [until Ctrl-C].", min=0.1)
    ] = None,
    port: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME=PORT replaces the port of a device in rig.toml; can be given several times."
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            help="The rig file [default: DATASET/rig.toml]; with --replay, its settings of the "
            "devices are used instead of those stored in the recording."
        ),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(help="Write the tables of this recording.raw again, byte for byte the same."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the tables [the run].")] = None,
    ports: Annotated[bool, typer.Option("--ports", help="List the serial ports and end.")] = False,
    view: options.View = False,
    quiet: options.Quiet = False,
) -> None:
    """Record the devices of rig.toml ([devices.NAME]) until Ctrl-C: stage.csv and the others.

    Every byte is written to recording.raw first, at most a second after it came. At the end
    stage.csv, accelerometer.csv, frames.csv and recording.json are made from it; --replay makes
    them again. If a device is unplugged, the recording waits for it and goes on. To practise
    without hardware: telerig simulate --devices --out practice.

    Exit code 0: recorded. 2: a device, port or file cannot be used; the message says what to do,
    and what the other devices sent is written.
    """
    if ports:
        from telerig.io.recording.ports import known_ports

        found = known_ports()
        for text in found:
            say(text)
        if not found:
            say("there is no serial port; practise with telerig simulate --devices --out practice")
        return
    from telerig.io.recording.tables import refuse_existing, write_tables

    if replay is not None:
        if run is not None or seconds is not None or port:
            raise InputError(
                "--replay reads a recording, it records nothing",
                todo="leave out the run, --seconds and --port; --out says where the tables go",
            )
        from telerig.io.recording.session import log_in

        log = log_in(replay) if replay.is_dir() else replay
        if not ((out or log.parent) / "recording.json").exists():
            refuse_existing(out or log.parent)
        devices = _devices(_description(rig), []) if rig is not None else []
        done = write_tables(log, out, {device.name: device for device in devices})
    else:
        place = out or run
        if place is not None:
            refuse_existing(place)
        done = write_tables(_recorded(run, seconds, port or [], rig, view, quiet), out)
    say(recording_words(done))
    for error in done.errors.values():
        typer.echo(f"telerig: {error}", err=True)
    if done.errors:
        raise typer.Exit(EXIT_BAD_INPUT)


def _recorded(
    run: Path | None, seconds: float | None, ports: list[str], rig: Path | None, view: bool,
    quiet: bool,
) -> Path:  # fmt: skip
    from telerig.estimator.batch.jobs import check_run_name
    from telerig.io.files.names import check_name
    from telerig.io.recording.session import record as record_run

    if run is None:
        raise InputError(
            "no run is given", todo="name a new folder: telerig record DATASET/runs/NAME"
        )
    check_name(run.resolve().name, str(run), "run")
    check_run_name(run)
    file = rig or run.resolve().parent.parent / "rig.toml"
    if rig is None and not file.is_file():
        raise InputError(
            "there is no rig.toml two folders above the run",
            where=str(run),
            todo="record into DATASET/runs/NAME, or give the file (--rig FILE)",
        )
    description = _description(file)
    devices = _devices(description, ports)
    cameras = list(description.cameras)
    with viewed(view, run.name), stopped_by_signals() as stop, _display(quiet) as tell:
        return record_run(devices, run, cameras=cameras, seconds=seconds, stop=stop, tell=tell)


def _description(file: Path) -> RigDescription:
    """Return the content of a rig.toml that names devices."""
    from telerig.io.rig_file.rig_file import read_rig_toml

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
    """Return the rig's devices with the ports from the command line."""
    from telerig.errors import suggestion

    given: dict[str, str] = {}
    for text in ports:
        name, equals, port = text.partition("=")
        if not equals or not port:
            raise InputError(
                f"--port {text!r} does not say which device is at which port",
                todo="write --port NAME=PORT with the name of a [devices] table of rig.toml, like "
                "--port encoder=/dev/ttyUSB0",
            )
        if name not in rig.devices:
            known = list(rig.devices)
            raise InputError(
                f"--port {text}: rig.toml has no [devices.{name}]", todo=suggestion(name, known)
            )
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


@contextmanager
def _display(quiet: bool) -> Iterator[Callable[[Status], None]]:
    """Return a callback for the status: a table on a terminal, plain lines elsewhere."""
    if quiet:
        yield lambda _: None
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.live import Live

        with Live(console=Console(stderr=True), auto_refresh=False) as live:
            yield lambda status: live.update(_table(status), refresh=True)
    else:
        yield _plain_lines()


def _table(status: Status) -> Table:
    from rich.table import Table

    title = f"recording {status.seconds:.0f} s, {status.log_bytes / 1e6:.1f} MB; Ctrl-C ends"
    table = Table(title=title, title_justify="left")
    table.add_column("device")
    for heading in ("readings", "per s", "malformed", "lost", "gaps", "unplugged"):
        table.add_column(heading, justify="right")
    for d in status.devices:
        counts = (d.readings, round(d.rate_hz), d.malformed, d.lost, d.gaps, d.unplugged)
        style = None if d.connected and d.rate_hz else "red" if not d.connected else "yellow"
        table.add_row(_state(d), *(f"{n:,}" for n in counts), style=style)
    return table


def _state(device: DeviceStatus) -> str:
    if not device.connected:
        return f"{device.name} (unplugged)"
    return device.name if device.rate_hz else f"{device.name} (silent)"


def _plain_lines() -> Callable[[Status], None]:
    last_s = -_PLAIN_EVERY_S

    def tell(status: Status) -> None:
        nonlocal last_s
        if status.seconds - last_s < _PLAIN_EVERY_S:
            return
        last_s = status.seconds
        parts = [
            f"{_state(d)} {d.readings} ({d.rate_hz:.0f}/s), malformed {d.malformed}, lost {d.lost}"
            for d in status.devices
        ]
        typer.echo(f"{status.seconds:.0f} s: " + "; ".join(parts), err=True)

    return tell


def recording_words(done: Recording) -> str:
    """Return the summary of a recording, one or more lines per device."""
    s = done.summary
    lines = [f"{s['seconds']:.1f} s recorded"]
    if not s["closed"]:
        lines.append("the recording was cut off: nothing that came after its last entry is in it")
    if s["log_damaged_bytes"]:
        lines.append(
            f"{s['log_damaged_bytes']} bytes of the log are damaged, or of another recording, and "
            "are not used"
        )
    for name, device in s["devices"].items():
        lines += [f"{name}: " + ", ".join(_device_words(device))]
        lines += [f"  {line}" for line in _clock_words(device)]
    if s["frames"]:
        f = s["frames"]
        lines.append(
            f"{counted(f['count'], 'frame')}, {f['missing']} missing, "
            f"{len(f['interpolated'])} with interpolated times"
        )
    lines.append(
        "written: " + ", ".join(str(done.folder / n) for n in (*s["rows"], "recording.json"))
    )
    return "\n".join(lines)


def _device_words(device: dict[str, Any]) -> Iterator[str]:
    yield counted(device["readings"], "reading")
    if not device["readings"]:
        yield (
            "it sent nothing: check that it is switched on, and whether it has to be polled (poll "
            "in rig.toml)"
        )
    if device["rate_hz"]:
        yield f"{device['rate_hz']:.6g} Hz"
    if device["lost"]:
        yield f"{device['lost']} lost in {device['gap_count']} gaps"
    if device["malformed"]:
        yield f"{device['malformed']} malformed"
    if device["unplugged"]:
        times = len(device["unplugged"])
        yield "unplugged once" if times == 1 else f"unplugged {times} times"
        if device["unplugged"][-1]["found_s"] is None:
            yield "not plugged in again"
    for reason, count in device["left_out"].items():
        yield f"{count} left out ({reason})"


def _clock_words(device: dict[str, Any]) -> Iterator[str]:
    for clock in device["clocks"]:
        yield (
            f"its clock: drift {clock['drift_ppm']:+.2f} ppm (standard deviation "
            f"{clock['sd_drift_ppm']:.2g} ppm); offset with a standard deviation of "
            f"{clock['sd_offset_us']:.2g} µs, not counting the unknown least delay of the line; "
            f"readings arrive {clock['delay_median_ms']:.2g} ms later than this least delay "
            "(median)"
        )
    if device["time_sd_ms"] is not None and device["readings"]:
        yield (
            f"it sends no time stamps: its times are from {device['time_from']}, with a standard "
            f"deviation of {device['time_sd_ms']:.2g} ms, not counting the unknown least delay of "
            "the line"
        )
    if device["half_question_to_answer_ms"]:
        half = device["half_question_to_answer_ms"]
        yield (
            "the time of each reading is the middle between the request to the device and its "
            f"answer, so it is off by at most half of the time between them, {half:.2g} ms (median)"
        )


if __name__ == "__main__":
    run_file(record)
