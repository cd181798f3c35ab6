"""`telerig report`: the pages of a folder made again, in a browser and on paper; its films."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from browser_check import BROWSER, look, print_pdf
from calibration_folder import write_calibration_folder as write_calibration
from filmed_run import FRAMES, SIZE_PX, decoded, write_run
from places import ROOT
from typer.testing import CliRunner

from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.report.batch.report import write_batch_report
from telerig.io.report.remake import results_folders
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.scripts.main import app

pytestmark = pytest.mark.slow

browser = pytest.mark.skipif(BROWSER is None, reason="no chromium or chrome here")
PAGES = ("calibration", "rise", "batch")


def command(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["report", *map(str, arguments)])
    assert result.exit_code == code, result.output + str(result.exception)
    return result.output


def _batch(folder: Path, dataset: Path) -> None:
    jobs = [
        {"dataset": str(dataset), "run": "", "kind": "calibrate", "status": "done", "words": "",
         "seconds": 3.0, "figures": {"verdict": "GOOD", "rms_px": 0.03, "views": 12}},
        {"dataset": str(dataset), "run": "rise", "kind": "track", "status": "done", "words": "",
         "seconds": 4.0, "figures": {"frames": FRAMES, "tracks": 1, "points": FRAMES}},
        {"dataset": str(dataset), "run": "fall", "kind": "track", "status": "failed",
         "words": "no images -> put frames at left/*.tif " + "x" * 90, "seconds": 1.0},
    ]  # fmt: skip
    folder.mkdir()
    (folder / "batch.json").write_text(json.dumps({"jobs": jobs}))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a calibration, a run tracked with another one, and a batch; with pages."""
    place = tmp_path_factory.mktemp("data")
    (place / "results").mkdir()
    write_calibration(place / "results" / "calibration", cameras=2)
    write_run(place / "results" / "rise", calibration=False)
    _batch(place / "results" / "batch", place)
    command(place, "--quiet")
    return place


def test_a_dataset_gives_all_its_pages_calibration_first(dataset: Path) -> None:
    found = results_folders(dataset)
    assert [r.kind for r in found] == ["calibration", "run", "batch"]
    for name in PAGES:
        page = dataset / "results" / name / "report.html"
        text = page.read_text(encoding="utf-8")
        assert page.stat().st_size < 5e6 and text.index('class="status"') < text.index("<h2")
        assert not re.search(r'(?:src|href)="https?:', text.split("<script>")[0])


def test_pages_made_again_elsewhere_are_the_same(dataset: Path, tmp_path: Path) -> None:
    said = command(dataset, "--out", tmp_path / "all", "--quiet")
    for name in PAGES:
        again = tmp_path / "all" / name / "report.html"
        assert f"written: {again}" in said
        first = (dataset / "results" / name / "report.html").read_text(encoding="utf-8")
        if name != "batch":
            second = again.read_text(encoding="utf-8")
            assert len(re.sub(r'href="[^"]*jpg"', "", second)) == len(
                re.sub(r'href="[^"]*jpg"', "", first)
            )
        assert [p.name for p in again.parent.iterdir()] == ["report.html"]


def test_the_batch_page_links_to_the_others_from_where_it_lies(
    dataset: Path, tmp_path: Path
) -> None:
    page = write_batch_report(dataset / "results" / "batch", tmp_path / "b")
    links = re.findall(r'<td><a href="([^"]+)"', page.read_text(encoding="utf-8"))
    assert {(page.parent / link).resolve() for link in links} == {
        (dataset / "results" / name / "report.html").resolve() for name in ("calibration", "rise")
    }


def test_an_imported_calibration_does_not_keep_a_dataset_from_its_pages(tmp_path: Path) -> None:
    across = Pose.from_rotvec([0.0, np.pi / 2, 0.0])
    cameras = [Camera.create("left", (512, 400), 10.0),
               Camera.create("right", (512, 400), 10.0, camera_from_rig=across)]  # fmt: skip
    calibration_from_cameras(cameras).save(tmp_path / "results" / "calibration")
    own = write_run(tmp_path / "results" / "rise", calibration=False)
    said = command(tmp_path, "--quiet")
    assert (own / "report.html").is_file() and said.count("written") == 1
    assert "was imported" in command(tmp_path / "results" / "calibration", code=2)


@browser
@pytest.mark.parametrize("name", PAGES)
def test_pages_in_a_browser_at_desk_and_pocket_width(
    dataset: Path, tmp_path: Path, name: str
) -> None:
    page = dataset / "results" / name / "report.html"
    for width in (1280, 400):
        seen = look(page, width, tmp_path)
        assert seen.errors == []
        assert seen.layout["client"] == width and seen.layout["scroll"] <= width
        assert seen.layout["wide"] == [] and seen.layout["small"] == 0
        assert seen.layout["broken"] == 0
        assert 0 < seen.layout["top"] < 200 and seen.layout["first"]
        assert seen.layout["height"] <= 6000


@browser
def test_the_browser_notices_errors_and_what_is_too_wide(tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text(
        '<!DOCTYPE html><meta name="viewport" content="width=device-width"><body>'
        '<p class="status" style="width:700px">x</p><p style="font-size:5px">y</p>'
        '<img src="none.png"><script>nothing()</script></body>'
    )
    seen = look(page, 400, tmp_path)
    assert any("nothing is not defined" in error for error in seen.errors)
    assert seen.layout["scroll"] > 400 and seen.layout["wide"] == ["x"]
    assert seen.layout["small"] == 1 and seen.layout["broken"] == 1


@browser
@pytest.mark.parametrize("name", PAGES)
def test_pages_on_paper(dataset: Path, tmp_path: Path, name: str) -> None:
    printed = print_pdf(dataset / "results" / name / "report.html", tmp_path)
    pages = len(re.findall(rb"/Type\s*/Page\b(?!s)", printed))
    assert printed.startswith(b"%PDF") and 1 <= pages <= 8
    assert len(printed) < 8e6


@pytest.fixture
def filmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run with its images; its page is not made again, which others do."""
    folder = write_run(tmp_path / "results" / "rise")
    monkeypatch.setattr("telerig.io.report.remake.remake_report", lambda found, _: found.folder)
    for camera in ("left", "right"):
        (tmp_path / "runs" / "rise" / camera).mkdir(parents=True)
        for frame in range(FRAMES):
            image = np.full((SIZE_PX[1], SIZE_PX[0]), 150 + frame % 2, np.uint8)
            tifffile.imwrite(tmp_path / "runs" / "rise" / camera / f"{frame:03d}.tif", image)
    (tmp_path / "runs" / "rise" / "run.toml").write_text("frame_rate_hz = 100.0\n")
    return folder


def test_films_of_a_run(filmed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "av", None)
        assert "pip install 'telerig[video]'" in command(filmed, "--film", code=2)
    monkeypatch.setattr("telerig.io.report.film.path.STEP_DEG", 30)
    said = command(filmed, "--film")
    for name, count in (("path", 12), ("views", FRAMES)):
        assert f"written: {filmed / 'film' / name}.mp4 (" in said
        assert len(decoded(filmed / "film" / f"{name}.mp4")) == count
    assert sorted(p.name for p in (filmed / "film").iterdir()) == ["path.mp4", "views.mp4"]


def test_without_the_recording_only_the_path_is_filmed(
    filmed: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("telerig.io.report.film.path.STEP_DEG", 60)
    shutil.move(tmp_path / "runs" / "rise", tmp_path / "elsewhere")
    said = command(filmed, "--film")
    assert "both views is left out" in said and "--run" in said
    said = command(filmed, "--film", "--run", tmp_path / "elsewhere")
    assert "views.mp4 (" in said
    for camera in ("left", "right"):
        (tmp_path / "elsewhere" / camera / f"{FRAMES - 1:03d}.tif").unlink()
    said = command(filmed, "--film", "--run", tmp_path / "elsewhere", code=2)
    assert f"has {FRAMES - 1} frames, but {FRAMES} were tracked" in said


def test_bad_input_is_told_in_words(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    for arguments, words in (
        ([tmp_path / "empty"], "holds no results"),
        ([tmp_path / "file"], "is a file, not a folder"),
        ([tmp_path / "none"], "there is no such folder"),
        ([dataset / "reslts" / "batch"], "did you mean results?"),
        ([dataset / "results" / "batch", "--film"], "films are made of runs"),
        (
            [dataset / "results" / "batch", "--out", dataset / "results" / "calibration"],
            "holds other results",
        ),
    ):
        said = command(*arguments, code=2)
        assert words in said and "->" in said


def test_the_pages_commands_and_code_run(
    filmed: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Every command of docs/reports.md, with few views."""
    text = (ROOT / "docs" / "reports.md").read_text(encoding="utf-8")
    (tmp_path / "tank2").mkdir()
    for name in ("results", "runs"):
        shutil.move(tmp_path / name, tmp_path / "tank2" / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("telerig.io.report.film.path.STEP_DEG", 60)
    lines = re.findall(r"^telerig report (.*)$", text, re.M)
    assert len(lines) == 6
    for line in lines:
        command(*shlex.split(line, comments=True))
    assert Path("films/film/views.mp4").is_file() and Path("films/film/path.mp4").is_file()
