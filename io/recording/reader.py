"""One thread for each serial line, which passes on the bytes and their times of arrival."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from telerig.errors import InputError
from telerig.io.recording.log import FOUND, LOST, RECEIVED, SENT, Entry
from telerig.io.recording.ports import open_port, read_chunk
from telerig.io.recording.protocols import poll_command
from telerig.io.rig_file.description import DeviceDescription

RETRY_S = 0.2
"""How often a lost port is tried again."""
ANSWER_S = 0.5
"""How long a polled device may take to answer."""


class Reader(threading.Thread):
    """Reads a port until `stop` is called; opens it again after it was unplugged.

    emit : called in this thread with every entry. `fault` : the exception that ended the thread.
    """

    def __init__(
        self, index: int, device: DeviceDescription, port: Any, emit: Callable[[Entry], None]
    ) -> None:
        super().__init__(name=f"read {device.name}", daemon=True)
        self.device = device
        self.connected = True
        self.fault: Exception | None = None
        self._index, self._port, self._emit = index, port, emit
        self._command = poll_command(device)
        self._stop_asked = threading.Event()

    def stop(self) -> None:
        self._stop_asked.set()

    def run(self) -> None:
        try:
            while not self._stop_asked.is_set():
                try:
                    self._listen()
                except (OSError, TypeError) as error:
                    self._lost(error)
        except Exception as error:  # noqa: BLE001
            self.fault = error
        finally:
            self._close()

    def _listen(self) -> None:
        """Read until `stop`; on an unplug pyserial raises OSError, or TypeError within a read."""
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
        except OSError:
            self.connected = False
