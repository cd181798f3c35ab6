"""What `telerig record` shows while it runs, and what it says at the end."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from telerig.io.recording.session import DeviceStatus, Status
    from telerig.io.recording.tables import Recording

_PLAIN_EVERY_S = 5.0


@contextmanager
def display(quiet: bool) -> Iterator[Callable[[Status], None]]:
    """A table that follows the recording; plain lines where there is no terminal."""
    if quiet:
        yield lambda _: None
    elif sys.stderr.isatty():
        yield from _table_display()
    else:
        yield _plain_lines()


def _table_display() -> Iterator[Callable[[Status], None]]:
    from rich.console import Console
    from rich.live import Live

    with Live(console=Console(stderr=True), auto_refresh=False) as live:
        yield lambda status: live.update(_table(status), refresh=True)


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
    last = {"time": -_PLAIN_EVERY_S}

    def tell(status: Status) -> None:
        if status.seconds - last["time"] < _PLAIN_EVERY_S:
            return
        last["time"] = status.seconds
        parts = [
            f"{_state(d)} {d.readings} ({d.rate_hz:.0f}/s), malformed {d.malformed}, lost {d.lost}"
            for d in status.devices
        ]
        typer.echo(f"{status.seconds:.0f} s: " + "; ".join(parts), err=True)

    return tell


def recording_words(done: Recording) -> str:
    """The summary of a recording, a line or more for each device."""
    s = done.summary
    lines = [f"{s['seconds']:.1f} s recorded"]
    if not s["closed"]:
        lines.append("the recording was cut off: what came after the last entry is not there")
    if s["log_damaged_bytes"]:
        lines.append(f"{s['log_damaged_bytes']} bytes of the log are damaged and were left out")
    for name, device in s["devices"].items():
        lines += [f"{name}: " + ", ".join(_device_words(device))]
        lines += [f"  {line}" for line in _clock_words(device)]
    if s["frames"]:
        f = s["frames"]
        lines.append(
            f"{f['count']} frames, {f['missing']} missing, "
            f"{len(f['interpolated'])} with interpolated times"
        )
    lines.append(
        "written: " + ", ".join(str(done.folder / n) for n in (*s["rows"], "recording.json"))
    )
    return "\n".join(lines)


def _device_words(device: dict[str, Any]) -> Iterator[str]:
    yield f"{device['readings']} readings"
    if not device["readings"]:
        yield "nothing came: is it switched on, and must it be asked (poll in rig.toml)?"
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
            f"its clock: {clock['drift_ppm']:+.2f} ppm (sd {clock['sd_drift_ppm']:.2g}), "
            f"offset known to {clock['sd_offset_us']:.2g} us and the line's least delay; "
            f"arrival later by {clock['delay_median_ms']:.2g} ms (median)"
        )
    if device["time_from"] == "arrival" and device["readings"]:
        yield "it sends no time of its own: its times are those of arrival, up to 16 ms late"
    if device["half_question_to_answer_ms"]:
        half = device["half_question_to_answer_ms"]
        yield f"times are known to {half:.2g} ms (half of question to answer)"
