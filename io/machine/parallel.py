"""Work spread over the cores of this machine, results in order; and the memory that it frees."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.pool import Pool
from typing import Any, TypeVar

import numpy as np

Task = TypeVar("Task")
Result = TypeVar("Result")


def cores() -> int:
    """Return how many cores this process may use.

    It is the environment variable TELERIG_CORES, or the number that the system allows.
    """
    asked = os.environ.get("TELERIG_CORES", "")
    if asked.isdecimal() and int(asked) > 0:
        return int(asked)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def can_fork() -> bool:
    """Return whether this process may be copied by fork: on Linux, while it has one thread."""
    return sys.platform == "linux" and threading.active_count() == 1


def ordered_map(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    workers: int,
    meanwhile: Callable[[], object] | None = None,
) -> Iterator[Result]:
    """Yield the result of ``function`` for each task, in the order of the tasks.

    function : a module's function or a `functools.partial` of one.
    workers : number of processes that work at the same time.
    meanwhile : is called once in this process while the others work.
    """
    if workers <= 1:
        yield from map(function, tasks)
    elif can_fork():
        with _forked(workers) as pool:
            results = pool.imap(function, tasks)
            if meanwhile is not None:
                meanwhile()
            yield from results
    else:
        from joblib import Parallel, delayed

        jobs = Parallel(n_jobs=workers, return_as="generator")
        yield from jobs(delayed(function)(task) for task in tasks)


def quick_workers(tasks: int) -> int:
    """Return how many processes are worthwhile for ``tasks`` short tasks.

    It is one per core if processes start at once (`can_fork`), otherwise one.
    """
    return min(cores(), tasks) if can_fork() else 1


def _answer(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    """Return whether the function failed, and what it returned or raised."""
    try:
        return False, function(*arguments)
    except Exception as error:  # noqa: BLE001 - raised where it was asked for
        error.add_note(traceback.format_exc())
        return True, error


ISOLATED_S = 60.0


def isolated(function: Callable[..., Result], *arguments: Any) -> Result:
    """Call a module's function in a copy of this process, so that a crash of a C library ends only
    the copy, and return its result.

    If a copy would not be safe (`can_fork`), the function is called in this process. Raises
    ChildProcessError if the copy died or took longer than `ISOLATED_S`, and the errors of the
    function.
    """
    if not can_fork():
        return function(*arguments)
    ours, theirs = multiprocessing.Pipe(duplex=False)
    with _copying():
        process = multiprocessing.get_context("fork").Process(
            target=_answer_once, args=(theirs, function, arguments)
        )
        process.start()
    theirs.close()
    try:
        if not ours.poll(ISOLATED_S):
            raise ChildProcessError(f"took longer than {ISOLATED_S:.0f} s")
        failed, result = ours.recv()
    except EOFError as error:
        raise ChildProcessError("crashed") from error
    finally:
        process.kill()
        process.join()
        ours.close()
    if failed:
        raise result
    return result  # type: ignore[no-any-return]


def _answer_once(end: Connection, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end.send(_answer(function, arguments))


def _forked(workers: int) -> Pool:
    with _copying():
        return multiprocessing.get_context("fork").Pool(workers, initializer=_begin_work)


@contextmanager
def _copying() -> Iterator[None]:
    """Silence the warning of numerical libraries' own idle threads, which restart in the copy.

    The copy's garbage collector leaves alone what is here, whose memory it would copy by looking.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        gc.freeze()
        try:
            yield
        finally:
            gc.unfreeze()


def _begin_work() -> None:
    """Leave an interrupt to this process's parent, which then ends it by SIGTERM.

    A handler of that signal that the parent has would keep the copy alive, and the parent waiting.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


FREED_BYTES = 16 << 20
"""No more than 32 MB, where glibc stops to learn."""


def keep_freed_memory() -> None:
    """Let the C library keep freed memory, up to twice `FREED_BYTES`, for the next array.

    glibc gives freed blocks beyond a limit back to the system. A fresh page of memory then costs 5
    us, twice the time of the computation in it. Freeing a large block raises the limit to the size
    of this block (mallopt(3), M_MMAP_THRESHOLD). Nothing is written into the block, so that it
    needs no memory.
    """
    np.empty(FREED_BYTES, np.uint8)


def give_back_freed_memory() -> None:
    """Let the C library give freed memory back to the system, by malloc_trim of glibc.

    GTSAM frees hundreds of MB in small pieces, which cannot be used for a large array.
    """
    import ctypes

    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)
