"""Open a viewer of rerun that listens on 127.0.0.1 alone.

rerun's own `spawn`, `serve_grpc` and `serve_web_viewer` listen on all network interfaces and take
no address, so its program is started with `--bind`, and the recording is sent to it.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
import weakref
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

from telerig.errors import InputError
from telerig.io.view.names import need_rerun

HOST = "127.0.0.1"
PORT, WEB_PORT = 9876, 9090
"""Those of `telerig.live.ADDRESS`."""
_START_S = 30.0
_WHILE_PARENT = """
import os, signal, subprocess, sys, threading
server = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)
signal.signal(signal.SIGINT, signal.SIG_IGN)
def end():
    os.read(0, 1)
    server.terminate()
threading.Thread(target=end, daemon=True).start()
os._exit(server.wait() or 0)
"""
"""Runs a program until it ends or standard input closes: also when the parent was killed."""


def open_window(stream: Any, memory_limit: str = "75%") -> None:
    """Show a recording in a window, which stays open; one that is open already is used.

    Raises InputError if it cannot be started.
    """
    if not _answers(PORT):
        options = ["--port", str(PORT), "--memory-limit", memory_limit, "--expect-data-soon"]
        process, said = _start([*_program(), *options], subprocess.DEVNULL, RERUN_APP_ONLY="true")
        _wait(process, said, PORT)
        process.returncode = 0  # without the warning of Popen: the window outlives this process
    _connect(stream)


def serve(stream: Any) -> None:
    """Serve a recording for a browser, at `telerig.live.ADDRESS`, while the recording exists.

    Raises InputError if a port is taken, or the server cannot be started.
    """
    for port in (PORT, WEB_PORT):
        if _answers(port):
            raise InputError(
                f"port {port} is taken, perhaps by another viewer", todo="close that program first"
            )
    command = [sys.executable, "-c", _WHILE_PARENT, *_program(), "--serve-web"]
    ports = ["--port", str(PORT), "--web-viewer-port", str(WEB_PORT)]
    process, said = _start([*command, *ports], subprocess.PIPE)
    weakref.finalize(stream, _end, process)
    _wait(process, said, PORT, WEB_PORT)
    _connect(stream)


def _program() -> list[str]:
    """Return the path of rerun's program, which need not be in PATH, and where it listens."""
    folder = Path(need_rerun().__file__).parents[1] / "rerun_cli"
    bundle = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    name = "rerun.exe" if os.name == "nt" else "rerun"
    return [str(bundle if bundle.exists() else folder / name), "--bind", HOST]


def _start(
    command: list[str], stdin: int, **environment: str
) -> tuple[subprocess.Popen[bytes], IO[bytes]]:
    """Start a program that Ctrl-C does not reach; return it and the file with its messages."""
    # No pipe and not this process's own output, whose reader would wait for the window's end.
    said = TemporaryFile()  # noqa: SIM115
    try:
        process = subprocess.Popen(
            command, stdin=stdin, stdout=subprocess.DEVNULL, stderr=said,
            env={"RUST_LOG": "warn", "NO_COLOR": "1", **os.environ, **environment},
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )  # fmt: skip
    except OSError as error:
        raise _not_started(str(error)) from error
    return process, said


def _wait(process: subprocess.Popen[bytes], said: IO[bytes], *ports: int) -> None:
    """Wait until the viewer answers on the ports."""
    until = time.monotonic() + _START_S
    while not all(map(_answers, ports)):
        if process.poll() is not None:
            said.seek(0)
            last = said.read().decode(errors="replace").strip().rpartition("\n")[2]
            raise _not_started(last[-300:] or f"it ended with exit code {process.returncode}")
        if time.monotonic() > until:
            _end(process)
            raise _not_started(f"it did not answer within {_START_S:.0f} s")
        time.sleep(0.05)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        process.stdin.close()
    else:
        process.terminate()
    process.wait()


def _not_started(why: str) -> InputError:
    return InputError(
        f"the viewer of rerun cannot be started: {why}",
        todo="save an .rrd file instead (--save FILE), which needs no viewer",
    )


def _answers(port: int) -> bool:
    try:
        with socket.create_connection((HOST, port), timeout=1.0):
            return True
    except OSError:
        return False


def _connect(stream: Any) -> None:
    stream.connect_grpc(f"rerun+http://{HOST}:{PORT}/proxy")
