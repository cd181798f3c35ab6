"""Loops that numba compiles in one of xdist's workers are loaded by the others."""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path
from threading import RLock
from typing import Any

from numba.core.dispatcher import Dispatcher

_LOCK = Path(tempfile.gettempdir()) / f"telerig-tests-compile-{os.getuid()}.lock"


def compile_one_at_a_time() -> None:
    """Let this process compile while no other does; it loads then what another has compiled.

    In a new checkout, two workers compile every loop twice otherwise, which takes a minute of each.
    """
    compiling, this_process = Dispatcher.compile, RLock()
    depth = 0

    def alone(self: Any, signature: Any) -> Any:
        nonlocal depth
        with this_process:
            if depth:  # a loop that the one being compiled calls
                return compiling(self, signature)
            with _LOCK.open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                depth += 1
                try:
                    return compiling(self, signature)
                finally:
                    depth -= 1

    Dispatcher.compile = alone
