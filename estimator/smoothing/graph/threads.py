"""Room for GTSAM's recursion in long runs."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

STACK_BYTES = 512 << 20


def in_large_stack(task: Callable[[], T]) -> T:
    """Run in a thread with a large stack: GTSAM's recursion is as deep as the run is long.

    Python's cycle collector rests meanwhile: it would walk through a million small arrays, none of
    them in a cycle, again and again, more than linearly in the length of the run.
    """
    result: list[T] = []
    fault: list[BaseException] = []

    def run() -> None:
        try:
            result.append(task())
        except BaseException as error:  # noqa: BLE001 - raised again in the caller's thread
            fault.append(error)

    collecting = gc.isenabled()
    gc.disable()
    before = threading.stack_size(STACK_BYTES)
    try:
        thread = threading.Thread(target=run, name="telerig-smoother")
        thread.start()
    finally:
        threading.stack_size(before)
    thread.join()
    if collecting:
        gc.enable()
    if fault:
        raise fault[0]
    return result[0]
