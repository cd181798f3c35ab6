"""Serial ports: listing them, opening one, and a thread for each that passes on what arrives."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from telerig.errors import InputError
from telerig.io.recording.log import FOUND, LOST, RECEIVED, SENT, Entry
from telerig.io.recording.protocols import poll_command
from telerig.io.rig_file.description import DeviceDescription
from telerig.io.rig_file.devices import port_fault

WAIT_S = 0.1
"""Longest wait in s for a byte before a reader checks whether it has to stop."""
WRITE_S = 1.0
"""A port that does not accept a written byte for this time in s counts as lost."""
NO_PERMISSION = "sudo usermod -a -G dialout $USER (uucp on some systems), then log in again"
"""The remedy for a port that may not be opened."""


_PORTS_TODO = "give a device file like /dev/ttyUSB0; `telerig record --ports` lists those there are"


def found_ports() -> list[tuple[str, str]]:
    """List the machine's serial ports: (device file, description), "" without a description."""
    from serial.tools import list_ports

    return sorted(
        (str(port.device), "" if port.description in (None, "n/a") else str(port.description))
        for port in list_ports.comports()
    )


def known_ports() -> list[str]:
    """Return the ports of `found_ports`, each as one text."""
    return [device + (f" ({name})" if name else "") for device, name in found_ports()]


def open_port(device: DeviceDescription) -> Any:
    """Open a device's serial port with pyserial, and empty its buffer.

    Returns the open port. Raises InputError if it cannot be opened.
    """
    import serial

    place = f"devices.{device.name} port {device.port:.200}"
    if fault := port_fault(device.port):
        raise InputError(fault[0], where=place, todo=fault[1])
    if Path(device.port).is_file() or Path(device.port).is_dir():
        what = "is a folder" if Path(device.port).is_dir() else "is a file"
        raise InputError(f"{what}, not a serial port", where=place, todo=_PORTS_TODO)
    try:
        port = serial.serial_for_url(
            device.port, baudrate=device.baud, timeout=WAIT_S, write_timeout=WRITE_S, exclusive=True
        )
        port.reset_input_buffer()
        return port
    except Exception as error:
        raise _cannot_open(device, error) from error


def read_chunk(port: Any) -> tuple[int, bytes]:
    """Wait for the next byte of a port, and return its time of arrival and all bytes in the buffer.

    The time is the host's monotonic time in ns.
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
        return InputError("you have no permission to open it", where=place, todo=NO_PERMISSION)
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


RETRY_S = 0.2
"""Time in s between two attempts to open a lost port."""
ANSWER_S = 0.5
"""Longest time in s that a polled device may take to answer."""


class Reader(threading.Thread):
    """Read a port in a thread until `stop` is called; a port that was unplugged is opened again.

    ``emit`` is called in this thread with every entry.
    """

    def __init__(
        self, index: int, device: DeviceDescription, port: Any, emit: Callable[[Entry], None]
    ) -> None:
        super().__init__(name=f"read {device.name}", daemon=True)
        self.device = device
        self.connected = True
        self._index, self._port, self._emit = index, port, emit
        self._command = poll_command(device)
        self._stop_asked = threading.Event()

    def stop(self) -> None:
        """Ask the thread to end after what it is reading."""
        self._stop_asked.set()

    def run(self) -> None:
        """Read the port until `stop`; one that is lost is opened again when it comes back."""
        try:
            while not self._stop_asked.is_set():
                try:
                    self._listen()
                except Exception as error:  # noqa: BLE001
                    self._lost(error)
        finally:
            self._close()

    def _listen(self) -> None:
        """Read until `stop`; on an unplug pyserial raises OSError, TypeError or termios.error."""
        if self._command is None:
            while not self._stop_asked.is_set():
                self._receive()
            return
        due = time.monotonic()
        while not self._stop_asked.is_set():
            self._ask(self._command)
            due = max(due + 1 / self.device.poll_hz, time.monotonic())
            self._stop_asked.wait(max(0.0, due - time.monotonic()))

    def _ask(self, command: bytes) -> None:
        self._put(SENT, time.monotonic_ns(), command)
        self._port.write(command)
        deadline = time.monotonic() + ANSWER_S
        while time.monotonic() < deadline and not self._stop_asked.is_set():
            if b"\n" in self._receive():
                return

    def _receive(self) -> bytes:
        stamp, data = read_chunk(self._port)
        if data:
            self._put(RECEIVED, stamp, data)
        return data

    def _put(self, kind: int, time_ns: int, data: bytes = b"") -> None:
        self._emit(Entry(kind, self._index, time_ns, data))

    def _lost(self, error: Exception) -> None:
        """Wait for the port to come back; both moments are in the log."""
        self.connected = False
        self._put(LOST, time.monotonic_ns(), str(error).encode())
        self._close()
        while not self._stop_asked.wait(RETRY_S):
            try:
                self._port = open_port(self.device)
            except InputError:
                continue
            self._put(FOUND, time.monotonic_ns())
            self.connected = True
            return

    def _close(self) -> None:
        try:
            self._port.close()
        except Exception:  # noqa: BLE001
            self.connected = False
