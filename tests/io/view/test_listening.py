"""Viewers listen on 127.0.0.1 alone, and end with the process that opened them."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from viewed import needs_rerun

from telerig.errors import InputError
from telerig.io.view import open as opening

pytestmark = [
    needs_rerun,
    pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs /proc"),
]
LOCAL = "0100007F"
SERVE = """
import sys, rerun as rr
from telerig.io.view import show, live
name = "telerig test"
if sys.argv[1] == "view":
    show.log_results = lambda *_: None
    stream = show.view("nothing", web=True)
else:
    import pickle
    sys.stdin = type("Said", (), {"buffer": open(sys.argv[2], "rb")})
    live.show = lambda stream, _: globals().update(kept=stream)
    live.main()
print("ready", flush=True)
import time; time.sleep(100)
"""


def family(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [pid, *(one for child in children for one in family(int(child)))]


def listening(pids: list[int]) -> dict[int, str]:
    """Ports on which processes listen, with the addresses as /proc writes them."""
    held = {link.readlink().name for pid in pids for link in Path(f"/proc/{pid}/fd").iterdir()}
    found = {}
    for table in ("tcp", "tcp6"):
        file = Path("/proc/net") / table
        for line in file.read_text().splitlines()[1:] if file.exists() else ():
            words = line.split()
            if words[3] == "0A" and f"socket:[{words[9]}]" in held:
                address, _, port = words[1].partition(":")
                found[int(port, 16)] = address
    return found


def free() -> bool:
    return not any(map(opening._answers, (opening.PORT, opening.WEB_PORT)))


@pytest.fixture(autouse=True)
def _ports_are_free() -> None:
    if not free():
        pytest.skip("another viewer is open on this computer")


@pytest.mark.parametrize("way", ["view", "live"])
def test_a_served_viewer_listens_here_alone_and_ends_when_its_parent_is_killed(
    tmp_path: Path, way: str
) -> None:
    begin = tmp_path / "begin"
    begin.write_bytes(pickle.dumps(("begin", {"name": "a", "web": True})))
    process = subprocess.Popen(
        [sys.executable, "-c", SERVE, way, str(begin)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        found = listening(family(process.pid))
    finally:
        process.kill()
        process.wait()
    assert found == {opening.PORT: LOCAL, opening.WEB_PORT: LOCAL}
    until = time.monotonic() + 10
    while not free() and time.monotonic() < until:
        time.sleep(0.05)
    assert free(), "the server outlives its parent"


def test_a_window_listens_here_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    import rerun as rr

    program, started = [*opening._program(), "--headless"], []
    start = opening._start

    def kept(*words: Any, **more: Any) -> Any:
        started.append(start(*words, **more))
        return started[-1]

    monkeypatch.setattr(opening, "_program", lambda: program)
    monkeypatch.setattr(opening, "_start", kept)
    opening.open_window(rr.RecordingStream("test"))
    ((process, _),) = started
    try:
        assert listening([process.pid]) == {opening.PORT: LOCAL}
    finally:
        os.kill(process.pid, signal.SIGKILL)
        os.waitpid(process.pid, 0)


def test_a_port_that_is_taken_and_a_program_that_is_missing_are_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import rerun as rr

    taken = socket.create_server(("127.0.0.1", opening.WEB_PORT))
    with taken, pytest.raises(InputError, match=f"port {opening.WEB_PORT} is taken"):
        opening.serve(rr.RecordingStream("test"))
    monkeypatch.setattr(opening, "_program", lambda: ["/nothing/rerun"])
    for way in (opening.serve, opening.open_window):
        with pytest.raises(InputError, match="cannot be started"):
            way(rr.RecordingStream("test"))
