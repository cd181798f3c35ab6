"""Jobs run in order on an executor: the cores of this machine or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from graphlib import TopologicalSorter
from typing import Any

from telerig.errors import InputError
from telerig.estimator.batch.jobs import Job, fingerprint
from telerig.estimator.batch.records import Journal
from telerig.estimator.batch.work import (
    CRASHED,
    DONE,
    LEFT_OUT,
    allow,
    failure,
    perform,
    stop_all,
)
from telerig.io.machine.parallel import cores

Tell = Callable[[Job, dict[str, Any], int, int], None]
"""Progress: (job, its record, number of jobs done, number of jobs)."""

_CONNECT_S = 20


def run_batch(
    jobs: Sequence[Job], executor: Executor, journal: Journal, *, tell: Tell | None = None
) -> list[dict[str, Any]]:
    """Do all jobs, each after those that it needs; returns their records, in the order of jobs.

    A job that ``journal`` records as done with the same inputs is not done again. A job that fails
    stops only those that need it: they are left out, and their record says because of which.
    """
    by_name = {job.name: job for job in jobs}
    records: dict[str, dict[str, Any]] = {}
    running: dict[Future[dict[str, Any]], tuple[Job, str]] = {}
    order = TopologicalSorter({job.name: job.needs for job in jobs})
    order.prepare()

    def keep(job: Job, record: dict[str, Any]) -> None:
        records[job.name] = record
        order.done(job.name)
        if tell is not None:
            tell(job, record, len(records), len(jobs))

    while order.is_active():
        ready = [by_name[name] for name in order.get_ready()]
        for job in ready:
            known = _known_record(job, records, journal)
            if known is None:
                inputs = fingerprint(job)
                running[executor.submit(perform, job)] = job, inputs
            else:
                keep(job, known)
        if not ready:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, inputs = running.pop(future)
                keep(job, journal.write(job, _result(future), inputs))
    return [records[job.name] for job in jobs]


def _known_record(
    job: Job, records: dict[str, dict[str, Any]], journal: Journal
) -> dict[str, Any] | None:
    """The record of a job that needs no work; None for one that does."""
    for needed in job.needs:
        if records[needed]["status"] != DONE:
            words = f"needs {needed}, which was {records[needed]['status']}"
            return journal.write(job, failure(LEFT_OUT, words), fingerprint(job))
    before = journal.done(job)
    return None if before is None else {**before, "resumed": True}


def _result(future: Future[dict[str, Any]]) -> dict[str, Any]:
    """A cluster that gives up a job, for instance because its workers die, raises an error."""
    error = future.exception()
    if error is None:
        return future.result()
    return failure(CRASHED, f"{type(error).__name__}: {error}")


@contextmanager
def local_executor(workers: int | None = None) -> Iterator[Executor]:
    """Runs ``workers`` jobs at once on this machine, each in a process of its own.

    workers : None means one per core.
    """
    count = cores() if workers is None else workers
    if count < 1:
        raise InputError(f"{count} workers", where="--workers", todo="give 1 or more")
    allow()
    executor = ThreadPoolExecutor(count)
    try:
        yield executor
    except BaseException:
        stop_all()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """The workers of a Dask cluster that is running already.

    address : tcp://host:port of its scheduler. The datasets must be at the same paths on every
    worker; only the descriptions of jobs and their results are sent. A job whose worker dies is
    done again by another one, as often as the cluster's setting allowed-failures says (3). Raises
    InputError when no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(
            "Dask is not installed", where=f"--scheduler {address}",
            todo="pip install 'telerig[cluster]'",
        ) from error  # fmt: skip
    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"no Dask scheduler answers: {error}", where=f"--scheduler {address}",
            todo="start one with `dask scheduler` and workers with `dask worker ADDRESS "
            "--nthreads 1`, and give the address that it prints",
        ) from error  # fmt: skip
    with client:
        if not client.scheduler_info()["workers"]:
            raise InputError(
                "the scheduler has no workers", where=f"--scheduler {address}",
                todo="start some with `dask worker ADDRESS --nthreads 1`",
            )  # fmt: skip
        yield client.get_executor(pure=False)
