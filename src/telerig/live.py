"""What a command finds, told to a viewer that shows it while the command works.

The work calls `publish`. Without a viewer it does nothing; with one it writes into a pipe to the
viewer's process and waits for nothing: what the pipe does not take stays in a short queue, of which
the oldest goes. There is no thread, so that the process can still be copied by fork.
"""

from __future__ import annotations

import os
import pickle
import select
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from telerig.errors import TelerigWarning

ADDRESS = "http://127.0.0.1:9090?url=rerun%2Bhttp://127.0.0.1:9876/proxy"
"""Where a viewer is served, for a browser on this computer or through an ssh tunnel."""
MOST_WAITING = 32
"""Messages that wait for the viewer; of more the oldest go."""
_PIPE_BYTES = 1 << 20
_EVERY_S = 0.5
_END_S = 5.0
"""How long the end of the work waits for a viewer that is slow."""
_VIEWER = (sys.executable, "-m", "telerig.io.view.live")
_feeds: list[Feed] = []


def publish(kind: str, **content: Any) -> None:
    """Tell the viewer something, if there is one; content : what can be pickled."""
    for feed in _feeds[-1:]:
        feed.put(kind, content)


def due(kind: str) -> bool:
    """Return whether there is a viewer that has got nothing of this kind for half a second.

    It is asked where a message costs more than naming what is there.
    """
    return any(feed.due(kind) for feed in _feeds[-1:])


def folder_for_viewer() -> Path:
    """Return a new folder for files that the viewer reads; it goes with the viewer's process."""
    return Path(tempfile.mkdtemp(dir=_feeds[-1].folder))


@contextmanager
def viewed(wanted: bool, name: str) -> Iterator[str]:
    """Show what is published meanwhile in a viewer, if it is wanted; name : the window's title.

    Yields the address at which a browser shows it, where no window can be opened; else "". Without
    rerun a TelerigWarning says what to install, and the work goes on without a viewer. A viewer
    that ends early is said at the end.
    """
    if wanted and find_spec("rerun") is None:
        warnings.warn(
            "--view needs rerun, which is not installed; it goes on without a viewer\n"
            "  -> pip install 'telerig[view]'",
            TelerigWarning, stacklevel=2,
        )  # fmt: skip
        wanted = False
    if not wanted:
        yield ""
        return
    web = sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ)
    feed = Feed()
    _feeds.append(feed)
    try:
        publish("begin", name=name, web=web)
        yield ADDRESS if web else ""
    finally:
        _feeds.remove(feed)
        feed.close()


class Feed:
    """The end of a pipe to a viewer's process, which `put` never waits for.

    command : of the viewer; it reads pickled pairs (kind, content) from its standard input.
    """

    def __init__(self, command: Sequence[str] | None = None) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="telerig-view-"))
        self._errors = (self.folder / "errors").open("wb+")
        self._process = subprocess.Popen(
            command or _VIEWER, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
            stderr=self._errors, start_new_session=True,  # Ctrl-C is for the work alone
        )  # fmt: skip
        assert self._process.stdin is not None
        self._end = self._process.stdin.fileno()
        os.set_blocking(self._end, False)
        with suppress(ImportError, AttributeError, OSError):
            import fcntl

            fcntl.fcntl(self._end, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._owner, self._open = os.getpid(), True
        self._waiting: deque[bytes] = deque(maxlen=MOST_WAITING)
        self._begun = b""
        self._last_s: dict[str, float] = {}

    def due(self, kind: str) -> bool:
        """Return whether nothing of this kind was told for half a second."""
        last_s = self._last_s.get(kind, float("-inf"))
        return self._mine() and time.monotonic() - last_s >= _EVERY_S

    def put(self, kind: str, content: dict[str, Any]) -> None:
        """Send a message, or keep it for the next call."""
        if self._mine():
            self._last_s[kind] = time.monotonic()
            self._waiting.append(pickle.dumps((kind, content), pickle.HIGHEST_PROTOCOL))
            self._send()

    def _mine(self) -> bool:
        return self._open and os.getpid() == self._owner  # not a copy of the process

    def _send(self) -> None:
        """Write what the pipe takes; a message that was begun is the next."""
        while self._open and (self._begun or self._waiting):
            self._begun = self._begun or self._waiting.popleft()
            try:
                self._begun = self._begun[os.write(self._end, self._begun) :]
            except BlockingIOError:
                return
            except OSError:  # the viewer has ended
                self._open = False

    def close(self) -> None:
        """Send what waits, and wait some seconds for the viewer to take it."""
        until = time.monotonic() + _END_S
        self.put("end", {})
        while self._open and (self._begun or self._waiting) and time.monotonic() < until:
            select.select([], [self._end], [], 0.1)
            self._send()
        self._open = False
        stdin = self._process.stdin
        assert stdin is not None
        stdin.close()
        try:
            code = self._process.wait(max(0.1, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait() and 0
        self._errors.seek(0)
        said = self._errors.read().decode(errors="replace").strip().rpartition("\n")[2]
        self._errors.close()
        shutil.rmtree(self.folder, ignore_errors=True)
        if code:
            warnings.warn(f"the viewer ended early: {said}", TelerigWarning, stacklevel=2)
