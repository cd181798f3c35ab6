"""run, batch and smooth do the same kinds of jobs with the same options."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from telerig.errors import InputError
from telerig.estimator.batch.jobs import Job, jobs_of, shake_model
from telerig.io.simulation.presets import run_preset
from telerig.io.simulation.simulate import simulate
from telerig.scripts.main import app


def command(line: str, code: int = 0) -> str:
    result = CliRunner().invoke(app, shlex.split(line)[1:])
    assert result.exit_code == code, result.output + str(result.exception)
    return result.output


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibrated dataset with the tracked runs rise and fall, and none smoothed."""
    data = tmp_path_factory.mktemp("tracked") / "data"
    config = run_preset("rise", frames=24)
    simulate(config, rng=np.random.default_rng(1), out=data, images=False)
    shutil.copytree(data / "runs" / "rise", data / "runs" / "fall")
    command(f"telerig run {data} --only calibrate --only track --model radial --no-report --quiet")
    assert not list(data.rglob("smoothing.json"))
    return data


@pytest.fixture
def data(tracked: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tracked, tmp_path / "data"))


def smoothed(folder: Path) -> bytes:
    return (folder / "trajectories.csv").read_bytes() + (folder / "shake.csv").read_bytes()


def test_several_runs_are_smoothed_with_one_call(data: Path) -> None:
    """As one by one, also with options; a batch does the same."""
    options = "--model default --refine-rig --accept SENSOR_MOUNT"
    runs = f"{data}/runs/rise {data}/runs/fall"
    said = command(f"telerig smooth {runs} {options} --no-report --quiet")
    assert said.endswith("2 of 2 runs are smoothed\n") and f"{data}/runs/fall:\n" in said
    found = {name: smoothed(data / "results" / name) for name in ("rise", "fall")}
    content = json.loads((data / "results" / "fall" / "smoothing.json").read_text())
    assert content["accepted"] == ["SENSOR_MOUNT"] and content["rig_change"]
    manifest = (data / "results" / "fall" / "manifest.json").read_text()
    assert f"telerig smooth {data}/runs/fall --model=default --refine-rig --accept" in manifest

    command(f"telerig smooth {data}/runs/rise {options} --no-report --quiet --out {data}/alone")
    assert smoothed(data / "alone") == found["rise"]

    for name in found:
        (data / "results" / name / "trajectories.csv").unlink()
    command(
        f"telerig batch {data} --only smooth {options} --no-report --quiet --workers 1 "
        f"--out {data}/b"
    )
    assert {name: smoothed(data / "results" / name) for name in found} == found


def test_tracks_and_results_of_several_runs_have_a_folder_each(data: Path) -> None:
    shutil.move(data / "results" / "rise", data / "elsewhere" / "rise")
    shutil.copytree(data / "results" / "fall", data / "elsewhere" / "fall")
    runs = f"{data}/runs/rise {data}/runs/fall"
    command(
        f"telerig smooth {runs} --tracks {data}/elsewhere --out {data}/new --model default --quiet "
        "--no-report"
    )
    command(f"telerig run {data} --only smooth --tracks {data}/elsewhere --model default "
            "--no-report --quiet")  # fmt: skip
    assert smoothed(data / "new" / "rise") == smoothed(data / "results" / "rise")


def test_a_run_that_fails_does_not_stop_the_others(data: Path) -> None:
    (data / "results" / "rise" / "tracks.csv").unlink()
    runs = f"{data}/runs/rise {data}/runs/fall"
    said = command(f"telerig smooth {runs} --model default --no-report --quiet", code=1)
    assert f"{data}/runs/rise: not smoothed:" in said
    assert "1 of 2 runs are smoothed; failed: rise" in said
    assert (data / "results" / "fall" / "smoothing.json").is_file()
    command(f"telerig smooth {data}/runs/rise --no-report", code=2)


def test_jobs_are_chosen_by_kind_and_run(tracked: Path) -> None:
    def named(*only: str) -> list[tuple[str, str]]:
        jobs = jobs_of([tracked], only=only)
        names = {job.name for job in jobs}
        assert all(set(job.needs) <= names for job in jobs)
        return [(job.kind, job.run) for job in jobs]

    assert named("smooth") == [("smooth", "fall"), ("smooth", "rise")]
    assert named("smooth", "track", "rise") == [("track", "rise"), ("smooth", "rise")]
    assert named("calibrate") == [("calibrate", "")]
    assert len(named()) == 5
    with pytest.raises(InputError, match=r"a kind of job \(calibrate, track, smooth\)"):
        named("smoothe")


def test_a_job_says_the_command_that_does_the_same(tracked: Path) -> None:
    (job, _) = jobs_of(
        [tracked], only=["smooth"], shake="default", refine_rig=True, accept=["A", "B"],
        tracks=Path("/t"), report=False,
    )  # fmt: skip
    assert job.command == (
        f"telerig smooth {tracked}/runs/fall --tracks /t/fall --model=default --refine-rig "
        "--accept A --accept B --no-report"
    )
    assert Job.from_json(job.as_json()) == job


def test_model_means_the_shake_where_only_smoothing_is_done() -> None:
    assert shake_model("default", None, ["smooth"]) == ("auto", "default")
    assert shake_model("auto", None, ["smooth", "rise"]) == ("auto", "auto")
    assert shake_model("radial", "default", []) == ("radial", "default")
    for model, shake, only, words in (
        ("default", None, [], "give --shake default"),
        ("radial", None, ["smooth"], "--model radial: there is no such choice"),
        ("auto", "rough", [], "--shake rough: there is no such choice"),
    ):
        with pytest.raises(InputError, match=words):
            shake_model(model, shake, only)


def test_one_folder_for_two_runs_is_refused(tracked: Path, tmp_path: Path) -> None:
    run = tracked / "runs" / "rise"
    for option in ("--out", "--tracks"):
        said = command(f"telerig smooth {run} {run} {option} {tmp_path}/x", code=2)
        assert "several runs are named 'rise'" in said
    said = command(f"telerig batch {tracked} --tracks {tmp_path} --out {tmp_path}/b", code=2)
    assert "add --only smooth" in said
    assert not list(tmp_path.iterdir())


def test_a_cluster_is_named_where_runs_are_tracked(data: Path) -> None:
    from telerig.estimator.batch.batch import do_job
    from telerig.estimator.batch.jobs import fingerprint

    address = "tcp://127.0.0.1:1"
    here, there = (jobs_of([data], only=["track"], cluster=c) for c in (None, address))
    assert all(job.command.endswith(f"--cluster {address}") for job in there)
    assert [fingerprint(job) for job in here] == [fingerprint(job) for job in there]
    assert Job.from_json(there[0].as_json()) == there[0]
    with pytest.raises(InputError, match="Dask"):
        do_job(there[0], None)
    command(f"telerig run {data} --only track --cluster {address} --quiet", code=1)
