"""Batches: what is planned, done again or not, and what a failure stops."""

import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from batch_dataset import make_dataset, outcome_here
from typer.testing import CliRunner

import telerig
from telerig.command_options import CalibrationOptions
from telerig.estimator.batch import batch as work
from telerig.estimator.batch.batch import Journal, do_job, perform, run_batch
from telerig.estimator.batch.jobs import Job, jobs_of, share_of
from telerig.io.results.findings import Code
from telerig.io.results.inputs import Source, fingerprints
from telerig.io.results.manifest import replaced_results
from telerig.io.tables.smoothing import BATCH_BUBBLES
from telerig.scripts.main import app

pytestmark = pytest.mark.usefixtures("without_advice", "known_low_passes", "undrawn")

RESULTS = ["calibration/calibration.json", "rise/tracks.csv", "rise/trajectories.csv"]


@pytest.fixture(scope="module")
def datasets(tmp_path_factory) -> list[Path]:
    base = tmp_path_factory.mktemp("batch")
    return [make_dataset(base / name, seed) for seed, name in enumerate(["monday", "tuesday"])]


def _begun(monkeypatch, result=lambda job: {"status": "done", "words": "", "figures": {}}) -> list:
    """The jobs that are begun from now on, which write next to nothing."""
    begun = []

    def perform_nothing(job: Job) -> dict:
        begun.append((job.kind, job.only_report))
        place = Path(job.dataset)
        used = [Source(place / "rig.toml", tables=("cameras",))]
        if job.run:
            used += [place / "runs" / job.run / name for name in ("detections.csv", "stage.csv")]
        if job.report:
            inputs = fingerprints(job.results, used)
        found = result(job)
        if job.report:
            with replaced_results(job.results, job.kind, again="", inputs=inputs) as staged:
                (staged / job.result.name).write_text("{}")
            (job.results / "report.html").touch()
        return found

    monkeypatch.setattr(work, "perform", perform_nothing)
    return begun


def _again(jobs: list[Job], out: Path) -> list[bool]:
    """Which of the jobs are not done again."""
    with ThreadPoolExecutor(2) as executor:
        return [bool(r.get("resumed")) for r in run_batch(jobs, executor, Journal(out))]


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


@pytest.mark.parametrize("reason", ["both images and calibration/dots.csv", "no views"])
def test_a_dataset_that_is_not_calibrated_again_has_its_row(tank_copy, reason, monkeypatch):
    monkeypatch.setattr(work, "_outcome", outcome_here)
    if reason == "no views":
        shutil.rmtree(tank_copy / "calibration")
    else:
        image = tank_copy / "calibration" / "left" / "0.tif"
        image.parent.mkdir(exist_ok=True)
        image.touch()
    jobs, out = jobs_of([tank_copy]), tank_copy / "batch"
    assert [job.kind for job in jobs] == ["calibrate", "track", "smooth"]
    result = CliRunner().invoke(app, ["batch", str(tank_copy), "--out", str(out)])
    assert result.exit_code == 0 and f"calibrate kept: {reason}" in result.output
    row = pd.read_csv(out / "batch.csv").iloc[0]
    assert row["status"] == "kept" and reason in row["words"] and row["verdict"] == "GOOD"
    assert "GOOD, kept" in (out / "report.html").read_text()
    result = CliRunner().invoke(app, ["run", str(tank_copy)])
    assert result.exit_code == 0 and f"calibrate kept: {reason}" in result.output


def test_with_a_calibration_given_nothing_is_calibrated(datasets):
    jobs = jobs_of(datasets, calibration=Path("elsewhere.json"))
    assert [j.kind for j in jobs] == ["track", "smooth"] * 2
    assert all(Path(j.calibration).is_absolute() for j in jobs)


def test_shares_keep_a_dataset_together_and_cover_all(datasets):
    jobs = jobs_of(datasets)
    shares = [share_of(jobs, i, 2) for i in range(2)]
    assert [{Path(j.dataset).name for j in s} for s in shares] == [{"monday"}, {"tuesday"}]
    assert sorted(j.name for s in shares for j in s) == sorted(j.name for j in jobs)


def test_all_is_done_and_summed_up(tank):
    table = pd.read_csv(tank / "batch" / "batch.csv")
    assert list(table["kind"]) == ["calibrate", "track", "smooth"]
    assert list(table["status"]) == ["done"] * 3
    calibrated = json.loads((tank / "results/calibration/calibration.json").read_bytes())
    assert table["rms_px"][0] == pytest.approx(calibrated["statistics"]["rms_px"])
    assert table["sy_um"][2] > 0
    bubbles = pd.read_csv(tank / "batch" / "bubbles.csv")
    assert list(bubbles) == BATCH_BUBBLES.names() and set(bubbles["run"]) == {"rise"}
    own = pd.read_csv(tank / "results" / "rise" / "bubble_summary.csv")
    pd.testing.assert_frame_equal(bubbles[list(own)], own)
    assert all((tank / "results" / name).is_file() for name in RESULTS)
    said = (tank / "batch" / "said.txt").read_text(encoding="utf-8").splitlines()
    assert said[3:5] == ["calibrate: 1 done (1 GOOD)", "track: 1 done"]


def test_what_is_done_is_not_done_again_until_an_input_changes(tmp_path, monkeypatch):
    data, out = make_dataset(tmp_path / "data", 5), tmp_path / "out"
    begun, jobs = _begun(monkeypatch), jobs_of([data])
    assert _again(jobs, out) == [False] * 3 and len(begun) == 3
    (data / "results" / "rise" / "report.html").unlink()
    begun.clear()
    assert _again([replace(job, report=False) for job in jobs], out) == [True] * 3 and not begun
    assert _again(jobs, out) == [True] * 3
    assert begun and all(drawn for _, drawn in begun)
    begun.clear()
    rig, found = data / "rig.toml", data / "runs" / "rise" / "detections.csv"
    rig.write_text("# the tank at the window\n" + rig.read_text())
    os.utime(found, ns=(1, 1))
    assert _again(jobs, out) == [True] * 3 and not begun, "the content is the same"
    found.write_text("\n".join(found.read_text().split("\n")[:-3]) + "\n")
    assert _again(jobs, out) == [True, False, False]
    assert begun == [("track", False), ("smooth", False)]
    assert _again(jobs, out) == [True] * 3
    (data / "runs" / "rise" / "stage.csv").unlink()
    assert _again(jobs, out) == [True, False, False], "an input was removed"


def test_a_missing_report_is_drawn(tank_copy):
    job = jobs_of([tank_copy])[0]
    assert job.lacks_report
    assert do_job(replace(job, only_report=True))["status"] == "done"
    assert not job.lacks_report


def test_a_failure_stops_only_what_needs_it(datasets, tmp_path, monkeypatch):
    def but_monday(job: Job) -> dict:
        failed = job.kind == "calibrate" and Path(job.dataset).name == "monday"
        return {"status": "failed" if failed else "done", "words": "no light", "figures": {}}

    begun = _begun(monkeypatch, but_monday)
    jobs = jobs_of(datasets, report=False)
    with ThreadPoolExecutor(2) as executor:
        records = run_batch(jobs, executor, Journal(tmp_path / "out"))
    assert [r["status"] for r in records] == ["failed", "left out", "left out"] + ["done"] * 3
    assert all(f"needs {jobs[0].name}, which was failed" in r["words"] for r in records[1:3])
    assert sorted(begun) == [(k, False) for k in ("calibrate", "calibrate", "smooth", "track")]


def test_datasets_that_cannot_be_used_are_told_and_the_rest_is_done(tmp_path, monkeypatch):
    monkeypatch.setattr(work, "_outcome", outcome_here)
    broken = make_dataset(tmp_path / "broken", 7)
    (broken / "calibration" / "dots.csv").write_text("view,camera,dot,u_px,v_px\n")
    no_rig = tmp_path / "no_rig"
    no_rig.mkdir()
    good = make_dataset(tmp_path / "good", 8)
    shutil.rmtree(good / "runs")
    out = tmp_path / "out"
    given = [str(place) for place in (no_rig, broken, good)]
    result = CliRunner().invoke(app, ["batch", *given, "--model", "none", "--out", str(out)])
    assert result.exit_code == 1, result.output
    table = pd.read_csv(out / "batch.csv", keep_default_na=False)
    assert list(table["status"]) == ["failed", "failed", "done"]
    assert "rig.toml" in table["words"][0]
    assert "dots.csv" in table["words"][1]
    assert "    -> write one with `telerig init`\n" in result.output, "what to do"
    page = (out / "report.html").read_text()
    assert "What failed" in page and "dots.csv" in page
    assert 'href="../good/results/calibration/report.html"' in page


def test_a_folder_that_this_machine_does_not_see_is_named(tmp_path):
    result = perform(Job("calibrate", str(tmp_path / "elsewhere"), CalibrationOptions()))
    assert result["status"] == "failed"
    assert "elsewhere" in result["words"] and "available there" in result["words"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "there is no such folder"),
        (["{0}/rig.toml"], "is a file, not a folder"),
        (["{0}", "{0}"], "named twice"),
        (["{0}", "--share", "3/2"], "--share 3/2"),
        (["{0}", "--workers", "0"], "0 workers"),
        (["{0}", "--model", "fisheye"], "--model: unknown model 'fisheye'"),
        (
            ["{0}", "--only", "smooth", "--min-diameter", "5"],
            "--min-diameter is an option of",
        ),
        (["{0}", "--only", "track", "--shake", "default"], "--shake is an option of smooth"),
        (["{0}", "--calibration", "{0}/rig.toml", "--dots", "plane"], "--dots is an option of"),
        (["{0}", "--calibration", "nowhere.json"], "no such calibration"),
        (["{0}", "--workers", "2", "--scheduler", "tcp://x:1"], "both --workers and --scheduler"),
    ],
)
def test_bad_requests_are_told_in_words(datasets, tmp_path, arguments, words):
    given = [a.format(datasets[0]) for a in arguments]
    result = CliRunner().invoke(app, ["batch", *given, "--out", str(tmp_path / "out")])
    assert result.exit_code == 2, result.output
    assert words in result.output
    assert not (tmp_path / "out").exists() and not (datasets[0] / "results").exists()


@pytest.mark.parametrize(
    ("status", "lines", "code"),
    [
        ("done", ["calibrate: 1 done (1 GOOD)", "track: 1 done (1 GOOD)"], 0),
        ("rejected", ["calibrate: 1 rejected", "track: 1 left out"], 1),
    ],
)
def test_run_does_everything_for_one_dataset(datasets, monkeypatch, status, lines, code):
    result = {"status": status, "words": "", "figures": {"verdict": "GOOD"}}
    monkeypatch.setattr(work, "do_job", lambda *_: result)
    words = ["run", str(datasets[0]), "--no-report", "--quiet"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == code, done.output
    assert [line for line in done.output.splitlines() if line.startswith(("cal", "tr"))] == lines


def test_a_rejected_calibration_of_before_is_not_used_unseen(tank_copy):
    """The command that calibrated has ended; its verdict stands in calibration.json alone."""
    folder, run = tank_copy / "results" / "calibration", tank_copy / "runs" / "rise"
    good = telerig.load_calibration(folder)
    assert not good.rejection
    replace(good, findings=(Code.FEW_KEPT.found(share=0.5),)).save(folder)
    warning = "the calibration is REJECTED, so no number that follows from it is right: only 50%"
    shutil.rmtree(tank_copy / "calibration")
    for kind, only in (
        ("track", ["--only", "track"]),
        ("smooth", ["--only", "smooth"]),
        ("calibrate", []),
    ):
        words = ["run", str(tank_copy), *only, "--no-report", "--quiet"]
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 1 and f"{kind}: 1 failed" in done.output, done.output
        assert warning in done.output and "--calibration" in done.output
    wanted = CliRunner().invoke(app, ["track", str(run), "--no-report", "--quiet"])
    assert wanted.exit_code == 0 and f"warning: {warning}" in wanted.output, wanted.output
    smoothed = CliRunner().invoke(app, ["smooth", str(run), "--no-report", "--quiet"])
    assert smoothed.exit_code == 0 and warning in smoothed.output, smoothed.output


@pytest.mark.parametrize(
    "words",
    [["--only", "fall"], ["--model", "nothing"], ["--calibration", "nothing"]],
)
def test_run_refuses_before_work_begins(datasets, words):
    result = CliRunner().invoke(app, ["run", str(datasets[0]), *words])
    assert result.exit_code == 2
    assert words[1] in result.output
    assert not (datasets[0] / "results").exists()


@pytest.mark.parametrize("command", ["run", "batch"])
def test_where_there_is_nothing_to_do_it_is_said(tmp_path, command):
    """The folder of the runs has another name."""
    data = make_dataset(tmp_path / "data", 5)
    (data / "runs").rename(data / "run")
    out = ["--out", str(tmp_path / "out")] if command == "batch" else []
    result = CliRunner().invoke(app, [command, str(data), "--only", "track", *out])
    assert result.exit_code == 2, result.output
    assert "nothing to do: no dataset has a run" in result.output and "runs/NAME" in result.output
    assert not (tmp_path / "out").exists()


def test_a_run_named_calibration_does_not_mix_with_the_calibration(tmp_path):
    data = make_dataset(tmp_path / "data", 5)
    (data / "runs" / "rise").rename(data / "runs" / "calibration")
    words = ["run", str(data), "--no-report", "--quiet", "--model", "none"]
    result = CliRunner().invoke(app, words)
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

    def slowly(job: Job) -> dict:
        text = (data / "rig.toml").read_text(encoding="utf-8")
        (data / "rig.toml").write_text(text.replace("[512, 512]", "[512, 500]"), encoding="utf-8")
        return {"status": "done", "words": "", "figures": {}}

    _begun(monkeypatch, slowly)
    jobs = jobs_of([data])[:1]
    assert [_again(jobs, tmp_path / "out") for _ in range(3)] == [[False], [False], [True]]


def test_datasets_of_the_same_name_are_told_apart(tmp_path, monkeypatch):
    monkeypatch.setattr(work, "_outcome", outcome_here)
    places = [tmp_path / day / "tank" for day in ("monday", "tuesday")]
    for place in places:
        place.mkdir(parents=True)
    given = [str(place) for place in places]
    words = ["batch", *given, "--no-report", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 1, result.output
    told = [line for line in result.output.splitlines() if line.startswith("[")]
    assert all(sum(place in line.split(": failed")[0] for line in told) == 1 for place in given)
