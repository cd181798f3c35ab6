"""Detection of a run over a Dask cluster: a real scheduler, two workers, one killed on the way."""

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import telerig
from telerig.errors import InputError
from telerig.estimator.batch.cluster import dask_executor
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.estimator.tracking.results_folder import write_tracking
from telerig.estimator.tracking.track import TrackOptions
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset

pytestmark = pytest.mark.slow

distributed = pytest.importorskip(
    "distributed", reason="the extra 'cluster' is not installed: pip install 'telerig[cluster]'"
)
FRAMES = 24


@pytest.fixture
def cluster(tmp_path: Path) -> Any:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
        local_directory=str(tmp_path / "dask"), silence_logs=50,
    ) as running:  # fmt: skip
        yield running


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cluster") / "data"
    telerig.simulate(run_preset("rise", frames=FRAMES), rng=np.random.default_rng(3), out=folder)
    return folder


def tracked(data: Path, folder: Path, **more: Any) -> list[pd.DataFrame]:
    cameras = list(true_cameras(run_preset("rise").calibration).values())
    write_tracking(
        telerig.load_run(data / "runs" / "rise"),
        calibration_from_cameras(cameras, name="truth"),
        folder, options=TrackOptions(), record={}, report=False, **more,
    )  # fmt: skip
    return [pd.read_csv(folder / f"{name}.csv") for name in ("detections", "tracks")]


def test_a_killed_worker_costs_nothing_but_time(cluster: Any, data: Path, tmp_path: Path) -> None:
    here = tracked(data, tmp_path / "here")
    killed: list[int] = []
    killer = threading.Thread(target=_kill_a_busy_worker, args=(cluster, killed))
    done: list[int] = []
    with dask_executor(cluster.scheduler_address, "--cluster") as executor:
        killer.start()
        there = tracked(
            data, tmp_path / "there", executor=executor,
            stage=lambda name, at, of: done.append(at) if name == "detection" else None,
        )  # fmt: skip
        killer.join()
    assert len(killed) == 1
    assert done[0] == 0 and done[-1] == FRAMES and done == sorted(done)
    for ours, theirs in zip(here, there, strict=True):
        assert len(ours) >= FRAMES
        pd.testing.assert_frame_equal(ours, theirs, rtol=1e-9)
    assert {path.name for path in tmp_path.iterdir()} >= {"here", "there"}
    assert not list(tmp_path.glob(".*.work"))


def _kill_a_busy_worker(cluster: Any, killed: list[int]) -> None:
    """SIGKILL, as when a machine of the cluster goes down with a batch half done."""
    with distributed.Client(cluster.scheduler_address) as client:
        pids = client.run(os.getpid)
        while not killed:
            for worker, tasks in client.processing().items():
                if tasks:
                    os.kill(pids[worker], signal.SIGKILL)
                    killed.append(pids[worker])
                    return
            time.sleep(0.01)


def test_an_error_on_a_worker_is_raised_here(cluster: Any, data: Path, tmp_path: Path) -> None:
    with (
        dask_executor(cluster.scheduler_address, "--cluster") as executor,
        pytest.raises(InputError, match="no outline of less than 4 px"),
    ):
        write_tracking(
            telerig.load_run(data / "runs" / "rise"),
            calibration_from_cameras(
                list(true_cameras(run_preset("rise").calibration).values()), name="truth"
            ),
            tmp_path / "out", options=TrackOptions(min_diameter_px=1.0), record={}, report=False,
            executor=executor,
        )  # fmt: skip
    assert not (tmp_path / "out").exists()
