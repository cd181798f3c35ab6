"""A batch over a Dask cluster: a real scheduler and two worker processes, one killed on the way."""

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from telerig.errors import InputError
from telerig.estimator.batch import cluster as connecting
from telerig.estimator.batch.batch import Journal, local_executor, run_batch
from telerig.estimator.batch.cluster import dask_executor
from telerig.estimator.batch.jobs import jobs_of
from telerig.io.simulation.simulate import simulate

pytestmark = pytest.mark.slow

distributed = pytest.importorskip(
    "distributed", reason="the extra 'cluster' is not installed: pip install 'telerig[cluster]'"
)


@pytest.fixture
def cluster(tmp_path):
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
        local_directory=str(tmp_path / "dask"), silence_logs=50,
    ) as running:  # fmt: skip
        yield running


@pytest.fixture(scope="module")
def datasets(tmp_path_factory) -> list[Path]:
    base = tmp_path_factory.mktemp("cluster")
    for seed in range(4):
        simulate("paper", rng=np.random.default_rng(seed), out=base / f"rig{seed}", images=False)
    return [base / f"rig{seed}" for seed in range(4)]


def _results(datasets: list[Path]) -> list[bytes]:
    return [(d / "results" / "calibration" / "residuals.csv").read_bytes() for d in datasets]


def test_a_killed_worker_costs_nothing_but_time(cluster, datasets, tmp_path):
    jobs = jobs_of(datasets, report=False)
    with local_executor(1) as executor:
        here = run_batch(jobs, executor, Journal(tmp_path / "here"))
    alone = _results(datasets)
    for d in datasets:
        (d / "results" / "calibration" / "calibration.json").unlink()

    killed: list[int] = []
    killer = threading.Thread(target=_kill_a_busy_worker, args=(cluster, killed))
    with dask_executor(cluster.scheduler_address) as executor:
        killer.start()
        there = run_batch(jobs, executor, Journal(tmp_path / "there"))
        killer.join()
    assert len(killed) == 1
    assert [r["status"] for r in there] == ["done"] * 4, [r["words"] for r in there]
    assert not any(r.get("resumed") for r in there)
    assert _results(datasets) == alone
    assert [r["figures"] for r in there] == [r["figures"] for r in here]


def _kill_a_busy_worker(cluster, killed: list[int]) -> None:
    """SIGKILL, as when a machine of the cluster goes down with a job half done."""
    with distributed.Client(cluster.scheduler_address) as client:
        pids = client.run(os.getpid)
        while not killed:
            for worker, tasks in client.processing().items():
                if tasks:
                    time.sleep(0.3)
                    os.kill(pids[worker], signal.SIGKILL)
                    killed.append(pids[worker])
                    return
            time.sleep(0.02)


def test_a_scheduler_that_is_not_there_is_an_error_in_words(monkeypatch):
    monkeypatch.setattr(connecting, "_CONNECT_S", 1)
    with (
        pytest.raises(InputError, match="no Dask scheduler answers"),
        dask_executor("tcp://127.0.0.1:9"),
    ):
        pass


def test_a_scheduler_without_workers_is_an_error_in_words(tmp_path):
    with (
        distributed.LocalCluster(
            n_workers=0, dashboard_address=None, local_directory=str(tmp_path), silence_logs=50
        ) as empty,
        pytest.raises(InputError, match="has no workers"),
        dask_executor(empty.scheduler_address),
    ):
        pass
