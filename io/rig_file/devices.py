"""The tables `[devices.<name>]` of `rig.toml`: sensors on serial lines, for `telerig record`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from telerig.errors import suggestion
from telerig.io.rig_file.description import DeviceDescription
from telerig.io.rig_file.tables import Problem, Problems, read_table, subtables

Devices = dict[str, DeviceDescription]

PORT_SCHEMES = ("socket", "rfc2217", "loop")
"""Schemes of pyserial's URLs that a port may have: a serial server, and a line back to itself."""
_LONGEST_PORT = 255
_PORT_OPTIONS = re.compile(r"ign_set_control|poll_modem|timeout=\d+(?:\.\d+)?")


class LinePattern:
    """A regular expression that a user gave, matched in a time that grows linearly with the line.

    Python's own ``re`` may need years for one line (docs/decisions/023-linear-expressions.md).

    names : the names of the groups, sorted.

    Raises ValueError for a text that is no regular expression.
    """

    def __init__(self, pattern: str) -> None:
        import re2

        options = re2.Options()
        options.encoding = re2.Options.Encoding.LATIN1
        options.log_errors = False
        try:
            self._expression = re2.compile(pattern.encode(), options)
        except re2.error as error:
            raise ValueError(error.args[0].decode(errors="replace")) from error
        index = {name.decode(): i for name, i in self._expression.groupindex.items()}
        self.names = tuple(sorted(index))
        self._groups = [index[name] for name in self.names]

    def cells(self, line: bytes) -> tuple[bytes | None, ...] | None:
        """Return the bytes of each group if the whole line matches, otherwise None."""
        found = self._expression.fullmatch(line)
        return found.group(*self._groups, 0)[:-1] if found else None


def port_fault(port: str) -> tuple[str, str] | None:
    """Return what is wrong with the text of a port and what to do; None if nothing is wrong.

    Allowed are device files, port names, and URLs of the schemes `PORT_SCHEMES`. Other schemes of
    pyserial are refused: ``spy://...?file=PATH`` writes over PATH.
    """
    if any(ord(c) < 32 for c in port):
        return "contains a control character", 'write a device file like "/dev/ttyUSB0"'
    if len(port) > _LONGEST_PORT:
        return f"has {len(port)} characters", 'write a device file like "/dev/ttyUSB0"'
    scheme, url, place = port.partition("://")
    if not url:
        return None
    if scheme.lower() not in PORT_SCHEMES:
        allowed = ", ".join(f"{name}://" for name in PORT_SCHEMES)
        return f"has the scheme {scheme[:40]}://", f"use a device file, or one of {allowed}"
    _, _, options = place.partition("?")
    for option in filter(None, options.split("&")):
        if scheme.lower() != "rfc2217" or not _PORT_OPTIONS.fullmatch(option):
            todo = "remove it; rfc2217:// takes ign_set_control, poll_modem and timeout=SECONDS"
            return f"has the option {option[:40]!r}", todo
    return None


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


def devices_from_tables(raw: Any, cameras: list[str], problems: Problems) -> Devices:
    """Return the devices by name; what is wrong with them is added to ``problems``.

    raw : the whole file.
    """
    out: Devices = {}
    sensors = raw.get("accelerometers", {})
    known = list(sensors) if isinstance(sensors, dict) else []
    for name, content in subtables(raw, "devices", problems).items():
        place, before = f"devices.{name}", len(problems)
        device = read_table(DeviceDescription, content, place, problems, homes={}, name=name)
        if device is None or len(problems) > before:
            continue
        problems += _own_problems(place, device)
        problems += _reference_problems(place, device, "cameras" in content, cameras, known)
        of = (device.cameras or tuple(cameras)) if device.kind == "frames" else ()
        out[name] = replace(device, cameras=of)
    problems += _shared_problems(out)
    return out


def _own_problems(place: str, device: DeviceDescription) -> Iterator[Problem]:
    if fault := port_fault(device.port):
        yield Problem(place, "port", *fault)
    allowed = _PROTOCOLS[device.kind]
    if device.protocol not in allowed:
        what = f"is {device.protocol!r}, which is no protocol for the kind {device.kind}"
        yield Problem(place, "protocol", what, "known: " + ", ".join(allowed))
    if device.protocol == "regex":
        yield from pattern_problems(place, device.kind, device.pattern)
    else:
        for key in ("pattern", "poll"):
            if getattr(device, key) is not None:
                what = f'is given, but the protocol is "{device.protocol}"'
                yield Problem(place, key, what, 'remove it, or write protocol = "regex"')
    counted = device.protocol in ("stream", "packets", "zaber") or "counts" in _groups(
        device.pattern
    )
    if device.kind == "encoder" and counted and not device.counts_per_mm:
        what = "is missing" if device.counts_per_mm is None else "is 0"
        todo = "add counts_per_mm: counts of the encoder in 1 mm; negative if it counts backwards"
        yield Problem(place, "counts_per_mm", what, todo)


def _groups(pattern: str | None) -> set[str]:
    try:
        return set(LinePattern(pattern).names) if pattern else set()
    except ValueError:
        return set()


def pattern_problems(place: str, kind: str, pattern: str | None) -> Iterator[Problem]:
    """Return what is wrong with the regular expression of a device of this kind."""
    needed = _VALUES[kind]
    words = " or ".join(", ".join(f"(?P<{g}>...)" for g in sorted(group)) for group in needed)
    if pattern is None:
        yield Problem(place, "pattern", "is missing", f"add a regular expression with {words}")
        return
    try:
        groups = set(LinePattern(pattern).names)
    except ValueError as error:
        todo = "write it in 'single quotes', as Python's re without look-around, back-references"
        yield Problem(place, "pattern", f"is no regular expression: {error}", todo)
        return
    known = {"t"}.union(*needed)
    for name in sorted(groups - known):
        yield Problem(place, "pattern", f"has a group {name!r}", suggestion(name, sorted(known)))
    if not any(group <= groups for group in needed):
        named = ", ".join(sorted(groups)) or "none"
        yield Problem(place, "pattern", f"lacks groups (it names {named})", f"name {words}")


def _reference_problems(
    place: str, device: DeviceDescription, cameras_given: bool, cameras: list[str], known: list[str]
) -> Iterator[Problem]:
    name = device.name
    if device.kind == "accelerometer" and name not in known:
        todo = f"add [accelerometers.{name}], which says where it sits"
        if known:
            todo = f"{suggestion(name, known)} Else {todo}"
        yield Problem(place, "", f"there is no accelerometer {name!r}", todo)
    for camera in device.cameras:
        if camera not in cameras:
            what = f"there is no camera {camera!r}"
            yield Problem(place, "cameras", what, suggestion(camera, cameras))
    if cameras_given and device.kind != "frames":
        yield Problem(place, "cameras", f"is given to an {device.kind}", "remove it")


def _shared_problems(devices: Devices) -> Iterator[Problem]:
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
