"""A Dask cluster that does the jobs of a batch, or detects the bubbles of a run."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from telerig.errors import InputError, need_package

_CONNECT_S = 20


@contextmanager
def dask_executor(address: str, option: str = "--scheduler") -> Iterator[Executor]:
    """Give an executor that uses the workers of a running Dask cluster.

    The datasets must be at the same paths on every worker. If a worker dies, another one does its
    job again, as often as the cluster's setting allowed-failures permits.

    address : tcp://host:port of the scheduler. option : name of the command-line option with which
    the user gave the address, for messages.
    Raises InputError if Dask is not installed, if no scheduler answers, or if the scheduler has no
    workers.
    """
    distributed = need_package("distributed", "cluster", option)
    try:
        client = distributed.Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"no Dask scheduler answers: {error}", where=f"{option} {address}",
            todo="start one with `dask scheduler` and workers with `dask worker ADDRESS "
            "--nthreads 1`, and give the address that it prints",
        ) from error  # fmt: skip
    with client:
        if not client.scheduler_info()["workers"]:
            raise InputError(
                "the scheduler has no workers", where=f"{option} {address}",
                todo="start some with `dask worker ADDRESS --nthreads 1`",
            )  # fmt: skip
        yield client.get_executor(pure=False)
