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
    """Return how many cores this process may use: TELERIG_CORES, or all that the system allows."""
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
    """Yield ``function`` of each task, in the order of the tasks, by ``workers`` processes.

    function : a module's function or a `functools.partial` of one. meanwhile : is called once in
    this process while copies of it work.
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
    """Return how many processes pay for short work: one per core where they start at once."""
    return min(cores(), tasks) if can_fork() else 1


class Assistant:
    """Calls functions in another process, one after the other, or in this one without ``end``."""

    def __init__(self, end: Connection | None = None) -> None:
        self._end = end
        self._last: Answer | None = None

    def __call__(self, function: Callable[..., Result], *arguments: Any) -> Result:
        """Return what a module's function returns, and raise what it raises."""
        return self.begin(function, *arguments)()

    def begin(self, function: Callable[..., Result], *arguments: Any) -> Callable[[], Result]:
        """Ask for a call of a module's function; what is given back waits for its result.

        Without another process, or when it died, the function is called then, in this one.
        """
        if self._last is not None:
            self._last.fetch()  # an end that nobody reads would block the other one
        self._last = Answer(self._end, function, arguments)
        return self._last


class Answer:
    """A call that was asked for."""

    def __init__(
        self, end: Connection | None, function: Callable[..., Any], arguments: tuple[Any, ...]
    ) -> None:
        self._end, self._function, self._arguments = end, function, arguments
        self._found: tuple[bool, Any] | None = None
        try:
            if end is not None:
                end.send((function, arguments))
        except OSError:
            self._end = None

    def fetch(self) -> None:
        """Wait for it, where another process does it."""
        if self._end is None or self._found is not None:
            return
        try:
            self._found = self._end.recv()
        except (EOFError, OSError):
            self._end = None

    def __call__(self) -> Any:
        self.fetch()
        if self._found is None:
            return self._function(*self._arguments)
        failed, result = self._found
        if failed:
            raise result
        return result


@contextmanager
def assistant(prepare: Callable[[], object]) -> Iterator[Assistant]:
    """Yield a copy of this process that calls ``prepare`` at once, and functions when asked to.

    It loads libraries that only the end of a command needs. Where a copy does not pay, or it died,
    functions are called in this process.
    """
    if cores() < 2 or not can_fork():
        yield Assistant()
        return
    ours, theirs = multiprocessing.Pipe()
    with _copying():
        process = multiprocessing.get_context("fork").Process(
            target=_assist, args=(ours, theirs, prepare)
        )
        process.start()
    theirs.close()
    try:
        yield Assistant(ours)
    finally:
        ours.close()
        process.terminate()
        process.join()


def _assist(other_end: Connection, end: Connection, prepare: Callable[[], object]) -> None:
    """Answer until the other end is closed; then ``recv`` ends this copy by EOFError."""
    other_end.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # an exit within an import would be a traceback
    try:
        prepare()
        signal.signal(signal.SIGTERM, lambda *_: sys.exit())
        while True:
            end.send(_answer(*end.recv()))
    except (EOFError, BrokenPipeError):
        return


def _answer(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    """Whether the function failed, and what it returned or raised."""
    try:
        return False, function(*arguments)
    except Exception as error:  # noqa: BLE001 - raised where it was asked for
        error.add_note(traceback.format_exc())
        return True, error


ISOLATED_S = 60.0


def isolated(function: Callable[..., Result], *arguments: Any) -> Result:
    """Call a module's function in a copy of this process, which a crash of a C library may end.

    Where a copy would not be safe (`can_fork`), it is called in this process. Raises
    ChildProcessError if the copy died or took longer than `ISOLATED_S`, and what the function
    raises.
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
    """Let the C library keep what is freed, up to twice `FREED_BYTES`, for the next array.

    glibc gives blocks beyond a limit back to the system, whose fresh pages cost 5 us each, twice
    what is computed in them. A block that was freed raises the limit to its size (mallopt(3),
    M_MMAP_THRESHOLD); nothing is written into it, so that it takes no memory.
    """
    np.empty(FREED_BYTES, np.uint8)


def give_back_freed_memory() -> None:
    """Let the C library give what is freed back to the system, where it can (glibc's malloc_trim).

    GTSAM frees hundreds of MB in small pieces, which no large array can use.
    """
    import ctypes

    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)
