"""Work spread over the cores of this machine, results in order."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.pool import Pool
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def cores() -> int:
    """Cores that this process may use: TELERIG_CORES, else all that the system lets it have."""
    asked = os.environ.get("TELERIG_CORES", "")
    if asked.isdecimal() and int(asked) > 0:
        return int(asked)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def can_fork() -> bool:
    """Copies of this process start at once, but are safe only while it has a single thread."""
    return sys.platform == "linux" and threading.active_count() == 1


def ordered_map(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    workers: int,
    meanwhile: Callable[[], object] | None = None,
) -> Iterator[Result]:
    """``function`` of each task, in the order of the tasks, by ``workers`` processes.

    function : a module's function or a `functools.partial` of one. An error raised in a process
        is raised here.
    meanwhile : called once in this process while copies of it work.
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
    """How many processes pay for short work: one per core where they start at once, else 1."""
    return min(cores(), tasks) if can_fork() else 1


def _forked(workers: int) -> Pool:
    with warnings.catch_warnings():
        # numerical libraries' own idle threads: they restart in the copy
        warnings.simplefilter("ignore", DeprecationWarning)
        return multiprocessing.get_context("fork").Pool(workers, initializer=_begin_work)


def _begin_work() -> None:
    """An interrupt is this process's parent's to handle, which then ends it by SIGTERM.

    A handler of that signal that the parent has would keep the copy alive, and the parent waiting.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
