"""Batches: what is planned, done again or not, and what a failure stops."""

import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from batch_dataset import make_dataset
from typer.testing import CliRunner

from telerig.errors import InputError
from telerig.estimator.batch.batch import Journal, local_executor, perform, run_batch, write_batch
from telerig.estimator.batch.jobs import Job, fingerprint, jobs_of, share_of
from telerig.scripts.main import app

RESULTS = ["calibration/calibration.json", "rise/tracks.csv", "rise/trajectories.csv"]


@pytest.fixture(scope="module")
def datasets(tmp_path_factory) -> list[Path]:
    base = tmp_path_factory.mktemp("batch")
    return [make_dataset(base / name, seed) for seed, name in enumerate(["monday", "tuesday"])]


def _jobs(datasets: list[Path]) -> list[Job]:
    """One of them with its report: drawing takes most of the time."""
    return [
        replace(job, report=job.kind == "smooth" and Path(job.dataset).name == "monday")
        for job in jobs_of(datasets)
    ]


@pytest.fixture(scope="module")
def first_run(datasets) -> tuple[Path, list[dict]]:
    """Both datasets done, by two workers."""
    out = datasets[0].parent / "out"
    with local_executor(2) as executor:
        records = run_batch(_jobs(datasets), executor, Journal(out))
    write_batch(records, out)
    return out, records


def _tables(dataset: Path) -> dict[str, bytes]:
    return {name: (dataset / "results" / name).read_bytes() for name in RESULTS}


def test_a_dataset_is_calibrated_then_tracked_then_smoothed(datasets):
    jobs = jobs_of(datasets)
    assert [(Path(j.dataset).name, j.kind, j.run) for j in jobs] == [
        (name, kind, run)
        for name in ("monday", "tuesday")
        for kind, run in (("calibrate", ""), ("track", "rise"), ("smooth", "rise"))
    ]
    assert jobs[0].needs == ()
    assert jobs[1].needs == (jobs[0].name,)
    assert jobs[2].needs == (jobs[0].name, jobs[1].name)
    assert len({j.name for j in jobs}) == 6
    assert Job.from_json(jobs[2].as_json()) == jobs[2]


def test_with_a_calibration_given_nothing_is_calibrated(datasets):
    jobs = jobs_of(datasets, calibration=Path("elsewhere.json"))
    assert [j.kind for j in jobs] == ["track", "smooth"] * 2
    assert all(Path(j.calibration).is_absolute() for j in jobs)


def test_shares_keep_a_dataset_together_and_cover_all(datasets):
    jobs = jobs_of(datasets)
    shares = [share_of(jobs, i, 2) for i in range(2)]
    assert [{Path(j.dataset).name for j in s} for s in shares] == [{"monday"}, {"tuesday"}]
    assert sorted(j.name for s in shares for j in s) == sorted(j.name for j in jobs)


def test_all_is_done_and_summed_up(first_run, datasets):
    out, records = first_run
    assert [r["status"] for r in records] == ["done"] * 6, [r["words"] for r in records]
    table = pd.read_csv(out / "batch.csv")
    assert list(table["kind"]) == ["calibrate", "track", "smooth"] * 2
    calibrated = json.loads((datasets[0] / "results/calibration/calibration.json").read_bytes())
    assert table["rms_px"][0] == pytest.approx(calibrated["statistics"]["rms_px"])
    assert (table.loc[table["kind"] == "smooth", "sy_um"] > 0).all()
    page = (out / "report.html").read_text()
    assert "2 of 2 runs done" in page
    assert 'href="../monday/results/rise/report.html"' in page
    assert "../tuesday" not in page


def test_what_is_done_is_not_done_again_until_an_input_changes(first_run, datasets):
    out, _ = first_run
    before = [_tables(d) for d in datasets]
    stamps = [(d / "results" / name).stat().st_mtime_ns for d in datasets for name in RESULTS]
    with local_executor(2) as executor:
        again = run_batch(_jobs(datasets), executor, Journal(out))
    assert all(r["resumed"] for r in again)
    assert stamps == [
        (d / "results" / name).stat().st_mtime_ns for d in datasets for name in RESULTS
    ]
    missing = datasets[0] / "results" / "rise" / "report.html"
    words = missing.read_text(encoding="utf-8")
    missing.unlink()
    with local_executor(2) as executor:
        quick = [replace(job, report=False) for job in _jobs(datasets)]
        silent = run_batch(quick, executor, Journal(out))
        assert not missing.is_file()
        drawn = run_batch(_jobs(datasets), executor, Journal(out))
    assert all(r["resumed"] for r in [*silent, *drawn])
    assert len(missing.read_text(encoding="utf-8")) == pytest.approx(len(words), rel=0.01)
    assert [_tables(d) for d in datasets] == before
    job = _jobs(datasets)[4]
    same = fingerprint(job)
    table = datasets[1] / "runs" / "rise" / "detections.csv"
    os.utime(table, ns=(1, 1))
    assert fingerprint(job) != same
    with local_executor(2) as executor:
        third = run_batch(_jobs(datasets), executor, Journal(out))
    assert [bool(r.get("resumed")) for r in third] == [True] * 4 + [False] * 2
    assert [_tables(d) for d in datasets] == before


def test_a_failure_stops_only_what_needs_it(datasets, tmp_path, monkeypatch):
    begun = []

    def perform_but_fail_at_monday(job: Job) -> dict:
        begun.append(job.name)
        failed = job.kind == "calibrate" and Path(job.dataset).name == "monday"
        return {"status": "failed" if failed else "done", "words": "no light", "figures": {}}

    monkeypatch.setattr("telerig.estimator.batch.batch.perform", perform_but_fail_at_monday)
    jobs = jobs_of(datasets)
    with ThreadPoolExecutor(2) as executor:
        records = run_batch(jobs, executor, Journal(tmp_path / "out"))
    assert [r["status"] for r in records] == ["failed", "left out", "left out"] + ["done"] * 3
    assert all(f"needs {jobs[0].name}, which was failed" in r["words"] for r in records[1:3])
    assert sorted(begun) == sorted(j.name for j in [jobs[0], *jobs[3:]])


def test_datasets_that_cannot_be_used_are_told_and_the_rest_is_done(tmp_path):
    broken = make_dataset(tmp_path / "broken", 7)
    (broken / "calibration" / "dots.csv").write_text("view,camera,dot,u_px,v_px\n")
    no_rig = tmp_path / "no_rig"
    no_rig.mkdir()
    good = make_dataset(tmp_path / "good", 8)
    shutil.rmtree(good / "runs")
    out = tmp_path / "out"
    given = [str(place) for place in (no_rig, broken, good)]
    result = CliRunner().invoke(app, ["batch", *given, "--out", str(out)])
    assert result.exit_code == 1, result.output
    table = pd.read_csv(out / "batch.csv", keep_default_na=False)
    assert list(table["status"]) == ["failed", "failed", "done"]
    assert "rig.toml" in table["words"][0]
    assert "dots.csv" in table["words"][1]
    page = (out / "report.html").read_text()
    assert "What failed" in page and "dots.csv" in page


def test_a_folder_that_this_machine_does_not_see_is_named(tmp_path):
    result = perform(Job("calibrate", str(tmp_path / "elsewhere")))
    assert result["status"] == "failed"
    assert "elsewhere" in result["words"] and "available there" in result["words"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "there is no such folder"),
        (["{0}", "{0}"], "named twice"),
        (["{0}", "--share", "3/2"], "--share 3/2"),
        (["{0}", "--workers", "0"], "0 workers"),
        (["{0}", "--model", "fisheye"], "--model fisheye"),
        (["{0}", "--calibration", "nowhere.json"], "no such calibration"),
        (["{0}", "--workers", "2", "--scheduler", "tcp://x:1"], "both --workers and --scheduler"),
    ],
)
def test_bad_requests_are_told_in_words(datasets, tmp_path, arguments, words):
    given = [a.format(datasets[0]) for a in arguments]
    result = CliRunner().invoke(app, ["batch", *given, "--out", str(tmp_path / "out")])
    assert result.exit_code == 2, result.output
    assert words in result.output
    assert not (tmp_path / "out").exists()


def test_run_does_everything_for_one_dataset(tmp_path):
    data = make_dataset(tmp_path / "data", 5)
    result = CliRunner().invoke(app, ["run", str(data), "--no-report", "--quiet"])
    assert result.exit_code == 0, result.output
    assert result.output == (
        "calibrate: 1 done (1 GOOD)\ntrack: 1 done\nsmooth: 1 done (1 UNRESOLVED)\n"
    )
    assert all((data / "results" / name).is_file() for name in RESULTS)


def test_run_refuses_an_unknown_run(datasets):
    result = CliRunner().invoke(app, ["run", str(datasets[0]), "--only", "fall"])
    assert result.exit_code == 2
    assert "no dataset has a run 'fall'" in result.output


def test_unknown_runs_are_an_error_of_the_library_too(datasets):
    with pytest.raises(InputError, match="fall"):
        jobs_of(datasets, only=["fall"])


@pytest.mark.parametrize("command", ["run", "batch"])
@pytest.mark.parametrize("option", ["--model", "--calibration"])
def test_an_option_that_cannot_be_used_is_refused_before_work_begins(
    tmp_path, monkeypatch, command, option
):
    monkeypatch.chdir(tmp_path)
    data = make_dataset(tmp_path / "data", 5)
    result = CliRunner().invoke(app, [command, str(data), option, "nothing"])
    assert result.exit_code == 2, result.output
    assert not (data / "results").exists() and not (tmp_path / "telerig-batch").exists()


def test_a_run_named_calibration_does_not_mix_with_the_calibration(tmp_path):
    data = make_dataset(tmp_path / "data", 5)
    (data / "runs" / "rise").rename(data / "runs" / "calibration")
    result = CliRunner().invoke(app, ["run", str(data), "--no-report", "--quiet"])
    assert result.exit_code == 1, result.output
    assert "track: 1 failed" in result.output and "rename the folder" in result.output
    assert "written" not in result.output
    assert not (data / "results" / "calibration" / "tracks.csv").exists()
    alone = CliRunner().invoke(app, ["track", str(data / "runs" / "calibration")])
    assert alone.exit_code == 2 and "rename the folder" in alone.output
    seen = CliRunner().invoke(app, ["doctor", str(data)])
    assert seen.exit_code == 1 and "rename the folder" in seen.output


def test_an_input_that_changes_during_the_work_is_done_again(tmp_path, monkeypatch):
    data = make_dataset(tmp_path / "data", 5)
    jobs = jobs_of([data])[:1]

    def perform_slowly(job: Job) -> dict:
        job.result.parent.mkdir(parents=True, exist_ok=True)
        job.result.write_text("{}")
        os.utime(data / "rig.toml", ns=(1, 1))
        return {"status": "done", "words": "", "figures": {}}

    monkeypatch.setattr("telerig.estimator.batch.batch.perform", perform_slowly)
    resumed = []
    for _ in range(3):
        with ThreadPoolExecutor(1) as executor:
            (record,) = run_batch(jobs, executor, Journal(tmp_path / "out"))
        resumed.append(bool(record.get("resumed")))
    assert resumed == [False, False, True]


def test_datasets_of_the_same_name_are_told_apart(tmp_path):
    places = [tmp_path / day / "tank" for day in ("monday", "tuesday")]
    for place in places:
        place.mkdir(parents=True)
    given = [str(place) for place in places]
    result = CliRunner().invoke(app, ["batch", *given, "--out", str(tmp_path / "out")])
    assert result.exit_code == 1, result.output
    told = [line for line in result.output.splitlines() if line.startswith("[")]
    assert all(sum(place in line.split(": failed")[0] for line in told) == 1 for place in given)
