"""The tables `[devices.<name>]` of `rig.toml`: sensors on serial lines, for `telerig record`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field

from telerig.errors import suggestion
from telerig.io.rig_file.device_description import DeviceDescription
from telerig.io.rig_file.parts import subtables
from telerig.io.rig_file.schema import Positive, Problem, Table, validate

_VALUES = {
    "encoder": ({"counts"}, {"position_mm"}),
    "accelerometer": ({"ax", "ay", "az"},),
    "frames": ({"frame"}, {"t"}),
}
_PROTOCOLS = {
    "encoder": ("stream", "packets", "zaber", "grbl", "regex"),
    "accelerometer": ("stream", "packets", "regex"),
    "frames": ("stream", "regex"),
}


class DeviceTable(Table):
    kind: Literal["encoder", "accelerometer", "frames"] = Field(
        description='"encoder", "accelerometer" or "frames"'
    )
    port: Annotated[str, Field(min_length=1)] = Field(description='text like "/dev/ttyUSB0"')
    baud: Annotated[int, Field(ge=50)] = Field(115200, description="a whole number like 115200")
    protocol: Literal["stream", "packets", "zaber", "grbl", "regex"] = Field(
        "stream", description='"stream", "packets", "zaber", "grbl" or "regex"'
    )
    pattern: str | None = Field(None, description="a regular expression in single quotes")
    poll: Annotated[str, Field(min_length=1)] | None = Field(
        None, description='the text that asks for one reading, like "?" or "/1 get pos\\n"'
    )
    poll_hz: Positive = Field(50.0, description="a positive number")
    counts_per_mm: float | None = Field(None, description="a number that is not 0")
    unit_m_s2: Positive = Field(1.0, description="a positive number: m/s^2 in one unit")
    time_unit_s: Positive = Field(1e-6, description="a positive number: 1e-6 for microseconds")
    time_bits: Annotated[int, Field(ge=0, le=52)] = Field(
        32, description="a whole number from 0 (never wraps) to 52"
    )
    checksum: Literal["none", "xor"] = Field("none", description='"none" or "xor"')
    latency_s: float = Field(0.0, description="a number of seconds")
    axis: Literal["x", "y", "z"] = Field("x", description='"x", "y" or "z"')
    cameras: list[str] | None = Field(None, description="a list of cameras' names")


def devices_from_tables(
    raw: dict[str, Any], cameras: list[str], problems: list[Problem]
) -> dict[str, DeviceDescription]:
    """The devices by name; appends what is wrong with them to ``problems``."""
    out: dict[str, DeviceDescription] = {}
    sensors = raw.get("accelerometers", {})
    known = list(sensors) if isinstance(sensors, dict) else []
    for name, content in subtables(raw.get("devices", {}), "devices", problems).items():
        place = f"devices.{name}"
        table, found = validate(DeviceTable, content, place)
        problems += found
        if table is None or found:
            continue
        problems += _own_problems(place, table)
        problems += _reference_problems(place, name, table, cameras, known)
        given = table.model_dump(exclude={"cameras"})
        of = tuple(table.cameras or cameras) if table.kind == "frames" else ()
        out[name] = DeviceDescription(name, cameras=of, **given)
    problems += _shared_problems(out)
    return out


def _own_problems(place: str, table: DeviceTable) -> Iterator[Problem]:
    allowed = _PROTOCOLS[table.kind]
    if table.protocol not in allowed:
        what = f"is {table.protocol!r}, which no {table.kind} speaks"
        yield Problem(place, "protocol", what, "known: " + ", ".join(allowed))
    if table.protocol == "regex":
        yield from pattern_problems(place, table.kind, table.pattern)
    else:
        for key in ("pattern", "poll"):
            if getattr(table, key) is not None:
                what = f'is given, but the protocol is "{table.protocol}"'
                yield Problem(place, key, what, 'remove it, or write protocol = "regex"')
    counted = table.protocol in ("stream", "packets", "zaber") or "counts" in _groups(table.pattern)
    if table.kind == "encoder" and counted and not table.counts_per_mm:
        what = "is missing" if table.counts_per_mm is None else "is 0"
        todo = "add counts_per_mm: counts of the encoder in 1 mm; negative if it counts backwards"
        yield Problem(place, "counts_per_mm", what, todo)


def _groups(pattern: str | None) -> set[str]:
    try:
        return set(re.compile(pattern or "").groupindex)
    except re.error:
        return set()


def pattern_problems(place: str, kind: str, pattern: str | None) -> Iterator[Problem]:
    """What is wrong with the regular expression of a device of this kind."""
    needed = _VALUES[kind]
    words = " or ".join(", ".join(f"(?P<{g}>...)" for g in sorted(group)) for group in needed)
    if pattern is None:
        yield Problem(place, "pattern", "is missing", f"add a regular expression with {words}")
        return
    try:
        groups = set(re.compile(pattern.encode()).groupindex)
    except re.error as error:
        what = f"is no regular expression: {error}"
        yield Problem(place, "pattern", what, "write it in 'single quotes', as Python's re")
        return
    known = {"t"}.union(*needed)
    for name in sorted(groups - known):
        yield Problem(place, "pattern", f"has a group {name!r}", suggestion(name, sorted(known)))
    if not any(group <= groups for group in needed):
        named = ", ".join(sorted(groups)) or "none"
        yield Problem(place, "pattern", f"lacks groups (it names {named})", f"name {words}")


def _reference_problems(
    place: str, name: str, table: DeviceTable, cameras: list[str], sensors: list[str]
) -> Iterator[Problem]:
    if table.kind == "accelerometer" and name not in sensors:
        todo = f"add [accelerometers.{name}], which says where it sits"
        if sensors:
            todo = f"{suggestion(name, sensors)} Else {todo}"
        yield Problem(place, "", f"there is no accelerometer {name!r}", todo)
    for camera in table.cameras or ():
        if camera not in cameras:
            what = f"there is no camera {camera!r}"
            yield Problem(place, "cameras", what, suggestion(camera, cameras))
    if table.cameras is not None and table.kind != "frames":
        yield Problem(place, "cameras", f"is given to an {table.kind}", "remove it")


def _shared_problems(devices: dict[str, DeviceDescription]) -> Iterator[Problem]:
    ports: dict[str, str] = {}
    for name, device in devices.items():
        if device.port in ports:
            what = f"is {device.port}, which devices.{ports[device.port]} has already"
            yield Problem(f"devices.{name}", "port", what, "give each device its own port")
        ports.setdefault(device.port, name)
    encoders = [name for name, device in devices.items() if device.kind == "encoder"]
    if len(encoders) > 1:
        what = f"has {len(encoders)} encoders ({', '.join(encoders)}); a run has one stage.csv"
        yield Problem("devices", "", what, "keep one")
    if len({name.lower() for name in devices}) < len(devices):
        what = "two names differ only in upper and lower case: is one sensor named twice?"
        yield Problem("devices", "", what, "give them different names")
