"""run, batch and smooth do the same kinds of jobs with the same options."""

from __future__ import annotations

import inspect
import json
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import telerig
from telerig.command_options import (
    CalibrationOptions,
    Options,
    SmoothingOptions,
    TrackingOptions,
)
from telerig.errors import InputError
from telerig.estimator.batch.jobs import Job, jobs_of, shake_of_model
from telerig.estimator.calibration.calibrate import run_calibration
from telerig.estimator.smoothing import results_folder
from telerig.scripts.main import app


def command(line: str, code: int = 0) -> str:
    result = CliRunner().invoke(app, shlex.split(line)[1:])
    assert result.exit_code == code, result.output + str(result.exception)
    return result.output


@pytest.fixture
def data(tank: Path, tmp_path: Path) -> Path:
    """A calibrated dataset with the tracked runs rise and fall."""
    data = Path(shutil.copytree(tank, tmp_path / "data"))
    for folder in ("runs", "results"):
        shutil.copytree(data / folder / "rise", data / folder / "fall")
    return data


@pytest.fixture
def asked(tank: Path, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What smoothings are asked for from now on. None is done; their result is the dataset's."""
    found, calls = telerig.load_smoothing(tank / "results" / "rise"), list[dict[str, Any]]()

    def smooth_run(
        run: Any, _: Any, tracks: Path, folder: Path, options: SmoothingOptions, **others: Any
    ) -> Any:
        if not (Path(tracks) / "tracks.csv").is_file():
            raise InputError("not tracked", where=str(tracks))
        where = {"run": run.path, "tracks": Path(tracks), "out": Path(folder)}
        said = options.keywords | {"accept": list(options.accept), "report": others["report"]}
        calls.append(where | said)
        return found

    monkeypatch.setattr(results_folder, "smooth_run", smooth_run)
    return calls


@pytest.mark.parametrize("apart", [False, True])
def test_several_runs_are_smoothed_with_one_call(
    data: Path, asked: list[dict[str, Any]], apart: bool
) -> None:
    """With the options, and with folders of their own; `run` and `batch` do the same."""
    options = "--model default --refine-rig --accept SENSOR_MOUNT --no-report"
    if apart:
        shutil.move(data / "results" / "rise", data / "elsewhere" / "rise")
        shutil.move(data / "results" / "fall", data / "elsewhere" / "fall")
        options += f" --tracks {data}/elsewhere"
    said = command(f"telerig smooth {data}/runs/fall {data}/runs/rise {options} --quiet")
    assert said.endswith("2 of 2 runs are smoothed\n") and f"{data}/runs/fall:\n" in said
    tracks, results = data / ("elsewhere" if apart else "results"), data / "results"
    expected = [
        {"run": data / "runs" / name, "tracks": tracks / name, "out": results / name,
         "model": "default", "refine_rig": True, "accept": ["SENSOR_MOUNT"], "report": False}
        for name in ("fall", "rise")
    ]  # fmt: skip
    assert asked == expected
    command(f"telerig run {data} --only smooth {options} --quiet")
    assert asked == 2 * expected
    if apart:
        command(f"telerig smooth {data}/runs/fall {data}/runs/rise {options} --out {data}/new")
        assert [call["out"] for call in asked[4:]] == [data / "new/fall", data / "new/rise"]


def test_a_run_that_fails_does_not_stop_the_others(data: Path, asked: list[dict[str, Any]]) -> None:
    (data / "results" / "rise" / "tracks.csv").unlink()
    runs = f"{data}/runs/rise {data}/runs/fall"
    said = command(f"telerig smooth {runs} --model default --no-report --quiet", code=1)
    assert f"{data}/runs/rise: not smoothed:" in said
    assert "1 of 2 runs are smoothed; failed: rise" in said
    assert [call["run"].name for call in asked] == ["fall"]
    command(f"telerig smooth {data}/runs/rise --no-report", code=2)


def test_jobs_are_chosen_by_kind_and_run(data: Path) -> None:
    def named(*only: str) -> list[tuple[str, str]]:
        jobs = jobs_of([data], only=only)
        names = {job.name for job in jobs}
        assert all(set(job.needs) <= names for job in jobs)
        return [(job.kind, job.run) for job in jobs]

    assert named("smooth") == [("smooth", "fall"), ("smooth", "rise")]
    assert named("smooth", "track", "rise") == [("track", "rise"), ("smooth", "rise")]
    assert named("calibrate") == [("calibrate", "")]
    assert len(named()) == 5
    with pytest.raises(InputError, match=r"a kind of job \(calibrate, track, smooth\)"):
        named("smoothe")


def test_a_job_says_the_command_that_does_the_same(tank: Path) -> None:
    (job,) = jobs_of(
        [tank], only=["smooth"], smoothing=SmoothingOptions("default", True, ("A", "B")),
        tracks=Path("/t"), report=False,
    )  # fmt: skip
    assert job.command == (
        f"telerig smooth {tank}/runs/rise --tracks /t/rise --model=default --refine-rig "
        "--accept=A --accept=B --no-report"
    )
    assert Job.from_json(job.as_json()) == job


def test_model_means_the_shake_where_only_smoothing_is_done() -> None:
    for model, shake, only, expected in (
        ("default", "auto", ["smooth"], ("auto", "default")),
        ("auto", "auto", ["smooth", "rise"], ("auto", "auto")),
        ("auto", "default", ["smooth"], ("auto", "default")),
        ("radial", "default", [], ("radial", "default")),
    ):
        found = shake_of_model(CalibrationOptions(model), SmoothingOptions(shake), only)  # type: ignore[arg-type]
        assert (found[0].model, found[1].model) == expected
    for model, only in (("default", []), ("radial", ["smooth"])):
        with pytest.raises(InputError, match=f"--model {model}"):
            shake_of_model(CalibrationOptions(model), SmoothingOptions(), only)


@pytest.mark.parametrize(
    ("options", "function"),
    [
        (CalibrationOptions("radial", "plane", 5.0, "water"), run_calibration),
        (SmoothingOptions("default", True, ("A",)), telerig.smooth),
    ],
)
def test_the_functions_have_the_defaults_of_the_command_line(
    options: Options, function: Callable[..., Any]
) -> None:
    defaults = {n: p.default for n, p in inspect.signature(function).parameters.items()}
    assert {name: defaults[name] for name in options.keywords} == type(options)().keywords


def test_options_are_kept_in_the_record_and_in_words() -> None:
    for options in (
        CalibrationOptions("radial", "plane", 5.0, "water", "dots"),
        TrackingOptions(5.0, 0.2, "images", "0:100"),
        SmoothingOptions("default", True, ("A", "B")),
    ):
        assert type(options).of(json.loads(json.dumps(options.record()))) == options
        assert not type(options)().words()
    words = TrackingOptions(5.0, frames="0:100", cluster="tcp://here:1").words()
    assert words == ["--min-diameter=5.0", "--frames=0:100", "--cluster=tcp://here:1"]


def test_a_changed_option_of_one_kind_leaves_the_others_done(data: Path) -> None:
    before = jobs_of([data])
    after = jobs_of([data], smoothing=SmoothingOptions(refine_rig=True))
    same = [(a.kind, a.asked == b.asked) for a, b in zip(before, after)]
    assert set(same) == {("calibrate", True), ("track", True), ("smooth", False)}


def test_one_folder_for_two_runs_is_refused(tank: Path, tmp_path: Path) -> None:
    run = tank / "runs" / "rise"
    for option in ("--out", "--tracks"):
        said = command(f"telerig smooth {run} {run} {option} {tmp_path}/x", code=2)
        assert "several runs are named 'rise'" in said
    said = command(f"telerig batch {tank} --tracks {tmp_path} --out {tmp_path}/b", code=2)
    assert "add --only smooth" in said
    assert not list(tmp_path.iterdir())


def test_a_cluster_is_named_where_runs_are_tracked(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from telerig.estimator.batch import cluster
    from telerig.estimator.batch.batch import do_job

    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
    address = "tcp://127.0.0.1:1"
    here, there = (
        jobs_of([data], only=["track"], tracking=TrackingOptions(cluster=c))
        for c in (None, address)
    )
    assert all(job.command.endswith(f"--cluster={address}") for job in there)
    assert [job.asked for job in here] == [job.asked for job in there]
    assert Job.from_json(there[0].as_json()) == there[0]
    with pytest.raises(InputError, match="Dask"):
        do_job(there[0], None)
    command(f"telerig run {data} --only track --cluster {address} --quiet", code=1)
