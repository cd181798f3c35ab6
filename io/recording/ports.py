"""Serial ports: listing them, opening one, and what to do when one cannot be opened."""

from __future__ import annotations

import errno
import time
from pathlib import Path
from typing import Any

from telerig.errors import InputError
from telerig.io.rig_file.description import DeviceDescription

WAIT_S = 0.1
"""Longest wait for a byte before a reader checks whether it has to stop."""
WRITE_S = 1.0
"""A port that does not accept a written byte for so long is lost."""
NO_PERMISSION = "sudo usermod -a -G dialout $USER (uucp on some systems), then log in again"
"""The remedy for a port that may not be opened."""


def found_ports() -> list[tuple[str, str]]:
    """(device file, description or "") of the serial ports that the machine has now."""
    from serial.tools import list_ports

    return sorted(
        (str(port.device), "" if port.description in (None, "n/a") else str(port.description))
        for port in list_ports.comports()
    )


def known_ports() -> list[str]:
    """`found_ports`, as one text for each port."""
    return [device + (f" ({name})" if name else "") for device, name in found_ports()]


def open_port(device: DeviceDescription) -> Any:
    """The open port, its input buffer emptied. Raises InputError when it cannot be opened."""
    import serial

    try:
        port = serial.serial_for_url(
            device.port, baudrate=device.baud, timeout=WAIT_S, write_timeout=WRITE_S, exclusive=True
        )
        port.reset_input_buffer()
        return port
    except (serial.SerialException, OSError, ValueError) as error:
        raise _cannot_open(device, error) from error


def read_chunk(port: Any) -> tuple[int, bytes]:
    """(host's monotonic time in ns, bytes received), after waiting for the first byte.

    The time is taken after all of these bytes have arrived, before they are copied.
    """
    first = port.read(1)
    if not first:
        return time.monotonic_ns(), b""
    more = port.in_waiting
    now = time.monotonic_ns()
    return now, first + port.read(more) if more else first


def _cannot_open(device: DeviceDescription, error: Exception) -> InputError:
    place = f"devices.{device.name} port {device.port}"
    code = getattr(error, "errno", None)
    local = "://" not in device.port
    if code == errno.EACCES:
        return InputError(
            "you have no permission to open it",
            where=place,
            todo=NO_PERMISSION,
        )
    if local and (code == errno.ENOENT or not Path(device.port).exists()):
        ports = known_ports()
        there = "ports there are: " + ", ".join(ports) if ports else "no serial port is there"
        return InputError(
            "there is no such port",
            where=place,
            todo=f"{there}; plug the device in, or correct the port "
            f"(rig.toml, or --port {device.name}=PORT)",
        )
    return InputError(
        f"cannot be opened: {error}",
        where=place,
        todo="close other programs that use it; check port and baud in rig.toml",
    )
