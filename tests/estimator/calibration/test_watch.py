"""`telerig calibrate --watch`: images that arrive one by one, late, broken, or not at all."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from finding_codes import only
from typer.testing import CliRunner

import telerig
from telerig.estimator.calibration.watch import WatchedFolder, standing, watch
from telerig.io.dataset.dataset import load_dataset
from telerig.io.results.findings import Code
from telerig.scripts.main import app

POLL_S = 0.05
PATIENCE_S = 60.0


@pytest.fixture
def empty(paper_images: Path, tmp_path: Path) -> Path:
    """A dataset to which no image has come yet."""
    folder = tmp_path / "live"
    folder.mkdir()
    shutil.copy(paper_images / "rig.toml", folder)
    return folder


def views(source: Path) -> list[str]:
    return sorted(p.name for p in (source / "calibration" / "left").iterdir())


def arrive(
    source: Path, folder: Path, name: str, cameras: tuple[str, ...] = ("left", "right")
) -> None:
    for camera in cameras:
        target = folder / "calibration" / camera
        target.mkdir(parents=True, exist_ok=True)
        shutil.copy(source / "calibration" / camera / name, target)


def until(condition: Callable[[], Any], what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, f"waited in vain for {what}"
        time.sleep(0.02)


class Watching:
    """`watch` in a thread, with its lines."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.lines: list[str] = []
        self.stop = threading.Event()
        self.result: Any = None
        self.error: Exception | None = None
        self._options = {
            "model": "radial", "medium": "air", "dots_free": "3d", "interval_s": POLL_S
        } | options  # fmt: skip
        self._data = load_dataset(folder, need_views=False)
        self.thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        try:
            self.result = watch(self._data, stop=self.stop, tell=self.lines.append, **self._options)
        except telerig.errors.TelerigError as error:
            self.error = error

    def said(self, text: str) -> bool:
        return any(text in line for line in self.lines)

    def wait_for(self, text: str) -> None:
        until(lambda: self.said(text), f"{text!r} in {self.lines}")


@contextmanager
def watching(folder: Path, **options: Any) -> Iterator[Watching]:
    it = Watching(folder, **options)
    it.thread.start()
    try:
        yield it
    finally:
        it.stop.set()
        it.thread.join(PATIENCE_S)
        assert not it.thread.is_alive()


def test_views_are_solved_as_they_arrive_and_enough_ends_it(
    paper_images: Path, empty: Path
) -> None:
    names = views(paper_images)
    with watching(empty, until_um=0.42) as it:
        it.wait_for("0 complete views; 6 more needed")
        arrive(paper_images, empty, names[0])
        it.wait_for("1 complete view; 5 more needed. Next: face the plate")
        arrive(paper_images, empty, names[1])
        it.wait_for("2 complete views")
        for name in names[2:5]:
            arrive(paper_images, empty, name)
        for count, name in enumerate(names[5:], 6):
            arrive(paper_images, empty, name)
            until(lambda c=count: it.said(f"{c} complete views") or it.result, str(count))  # type: ignore[misc]
            if it.result:
                break
        until(lambda: not it.thread.is_alive(), "the end")
    data, run = it.result
    assert "enough: 0.42 µm were asked for" in it.lines[-1]
    assert 6 <= len(data.views) < 12
    assert run.calibration.diagnostics["next_view"]["before_um"] <= 0.42
    assert len(run.detected.images) == 2 * len(data.views)
    assert all(image.overlay for image in run.detected.images)


@pytest.mark.slow
def test_what_was_watched_is_what_a_plain_calibration_finds(
    paper_images: Path, empty: Path
) -> None:
    for name in views(paper_images)[:6]:
        arrive(paper_images, empty, name)
    with watching(empty, until_um=10.0) as it:
        it.wait_for("enough: 10 µm were asked for")
        until(lambda: not it.thread.is_alive(), "the end")
    assert it.lines[-1].startswith("6 complete views") and len(it.lines) == 1
    plain = telerig.calibrate(load_dataset(empty), model="radial")
    found = it.result[1].calibration
    assert found.report() == plain.report()


def test_only_new_images_are_detected_and_one_being_written_is_waited_for(
    paper_images: Path, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    detected: list[str] = []
    from telerig.estimator.calibration import watch as module

    def counted(dataset: Any, view: Any, camera: str, **options: Any) -> Any:
        detected.append(f"{view.name}/{camera}")
        return real(dataset, view, camera, **options)

    real = module.detect_image
    monkeypatch.setattr(module, "detect_image", counted)
    said: list[str] = []
    names = views(paper_images)
    folder = WatchedFolder(empty, said.append)
    folder.poll()
    assert folder.complete() == [] and folder.version() == frozenset()
    arrive(paper_images, empty, names[0])
    folder.poll()
    assert not detected
    for _ in range(2):
        folder.poll()
        assert len(detected) == 2 and len(folder.version()) == 2

    whole = (paper_images / "calibration" / "left" / names[1]).read_bytes()
    growing = empty / "calibration" / "left" / names[1]
    growing.write_bytes(b"")
    folder.poll()
    folder.poll()
    for part in (1000, 5000, len(whole)):
        growing.write_bytes(whole[:part])
        os.utime(growing, ns=(part, part))
        folder.poll()
    assert len(detected) == 2
    folder.poll()
    assert len(detected) == 3
    assert folder.complete() == [Path(names[0]).stem]
    arrive(paper_images, empty, names[1], ("right",))
    folder.poll()
    folder.poll()
    assert len(folder.complete()) == 2 and len(folder.version()) == 4

    growing.unlink()
    folder.poll()
    assert folder.complete() == [Path(names[0]).stem] and len(folder.version()) == 2
    assert not said


@pytest.mark.slow
def test_a_bad_image_is_named_and_the_rest_goes_on(paper_images: Path, empty: Path) -> None:
    names = views(paper_images)
    with watching(empty) as it:
        for name in names[:3]:
            arrive(paper_images, empty, name)
        it.wait_for("3 complete views")
        bad = empty / "calibration" / "left" / names[3]
        bad.write_bytes((paper_images / "calibration" / "left" / names[3]).read_bytes()[:4000])
        arrive(paper_images, empty, names[3], ("right",))
        it.wait_for(f"view {Path(names[3]).stem}, camera left cannot be used: ")
        (empty / "calibration" / "left" / "notes.txt").write_text("not an image")
        arrive(paper_images, empty, names[4])
        it.wait_for("4 complete views")
        arrive(paper_images, empty, names[3], ("left",))
        it.wait_for("5 complete views")
        bad.write_bytes(b"no image at all")
        until(lambda: "4 complete views" in it.lines[-1], "the view to be left out again")
    run = it.result[1]
    left_out = only(run.calibration, Code.LEFT_OUT)
    assert (left_out.views, left_out.cameras) == ((Path(names[3]).stem,), ("left",))
    assert run.calibration.statistics["views"] >= 4


def test_a_view_that_one_camera_lacks_is_named_once(paper_images: Path, empty: Path) -> None:
    said: list[str] = []
    names = views(paper_images)
    folder = WatchedFolder(empty, said.append, patience_s=60.0)
    for name in names[:2]:
        arrive(paper_images, empty, name, ("left",))
    folder.poll()
    assert not said
    folder.patience_s = -1.0
    folder.poll()
    folder.poll()
    arrive(paper_images, empty, names[2], ("right",))
    folder.poll()
    arrive(paper_images, empty, names[2], ("left",))
    folder.poll()
    first, last = (Path(names[i]).stem for i in (0, 2))
    assert len(said) == 2
    assert said[0].startswith(f"2 views ({first}, ") and "no image of camera right" in said[0]
    assert said[1].startswith(f"view {last} has no image of camera left; ")
    assert "same name" in said[0]


def test_the_last_images_before_the_end_are_used(paper_images: Path, empty: Path) -> None:
    """Ctrl-C follows the last image at once; one that is empty is being written."""
    names = views(paper_images)
    for name in names[:3]:
        arrive(paper_images, empty, name)
    with watching(empty, interval_s=0.5) as it:
        it.wait_for("3 complete views")
        arrive(paper_images, empty, names[3])
        (empty / "calibration" / "left" / names[4]).touch()
        it.stop.set()
        it.thread.join(PATIENCE_S)
    dataset, run = it.result
    used = [name.split(".")[0] for name in names[:4]]
    assert [view.name for view in dataset.views] == used
    assert list(run.calibration.target_poses) == used
    assert it.said(f"{names[4]} is still being written and is not used")


def test_stopped_too_early_says_what_is_missing(paper_images: Path, empty: Path) -> None:
    with watching(empty) as it:
        it.wait_for("0 complete")
    assert it.error is not None and "no image has arrived" in str(it.error)
    arrive(paper_images, empty, views(paper_images)[0])
    with watching(empty) as it:
        it.wait_for("1 complete view")
    assert it.error is not None and "needs at least 2" in str(it.error)


def test_a_folder_of_an_unknown_camera_is_said_once(paper_images: Path, empty: Path) -> None:
    strange = empty / "calibration" / "lefft"
    with watching(empty) as it:
        it.wait_for("0 complete")
        strange.mkdir(parents=True)
        arrive(paper_images, empty, views(paper_images)[0])
        it.wait_for("no camera 'lefft'")
        time.sleep(5 * POLL_S)
        shutil.rmtree(strange)
        it.wait_for("1 complete view")
    assert sum("lefft" in line for line in it.lines) == 1


def test_standing_in_words(scene: Any, paper_images: Path) -> None:
    data = load_dataset(paper_images)
    calibration = scene("paper", 1, views=7).calibrate()
    words, enough = standing(calibration, data, 7, None)
    assert words.startswith("7 complete views") and "standard deviation of points in space" in words
    assert enough == calibration.diagnostics["next_view"]["enough"]
    assert standing(calibration, data, 7, 10.0)[1]
    assert not standing(calibration, data, 5, 10.0)[1]
    one = scene("paper", 1, views=7)
    alone = one.with_dots(one.dots[one.dots["camera"] == "left"])
    from dataclasses import replace

    mono = replace(alone, cameras=one.cameras[:1], nominal_rotvec_deg=None).calibrate()
    words, enough = standing(mono, data, 7, 10.0)
    assert "residual" in words and not enough


def test_ctrl_c_writes_the_results_once_and_ends_well(paper_images: Path, empty: Path) -> None:
    names = views(paper_images)
    for name in names[:2]:
        arrive(paper_images, empty, name)
    command = [sys.executable, "-m", "telerig.scripts.main", "calibrate", str(empty), "--watch",
               "--poll", str(POLL_S), "--model", "radial", "--no-report"]  # fmt: skip
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line)
            if "2 complete views" in line:
                break
        assert not (empty / "results").exists()
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    assert "written:" in rest and "2 views" in rest
    results = empty / "results" / "calibration"
    content = json.loads((results / "calibration.json").read_text())
    assert list(content["views"]) == [Path(n).stem for n in names[:2]]
    assert len(list((results / "overlays").rglob("*.jpg"))) == 4
    assert json.loads((results / "run.json").read_text())["options"]["watch"] is True


def test_options_of_watching(empty: Path) -> None:
    runner = CliRunner()
    for option in ("--until-um", "--poll"):
        result = runner.invoke(app, ["calibrate", str(empty), option, "0.4"])
        assert result.exit_code == 2 and f"{option} goes with --watch" in result.stderr
    result = runner.invoke(app, ["calibrate", str(empty), "--watch", "--from", "dots"])
    assert result.exit_code == 2 and "waits for images" in result.stderr
    for option in ("model", "medium", "dots"):
        result = runner.invoke(app, ["calibrate", str(empty), "--watch", f"--{option}", "nonsense"])
        assert result.exit_code == 2 and "unknown" in result.stderr
        assert "watching" not in result.stdout


def test_of_three_cameras_two_make_a_view(paper_images: Path, empty: Path) -> None:
    rig = (empty / "rig.toml").read_text(encoding="utf-8")
    third = "[cameras.top]\nimage_size_px = [512, 512]\nscale_px_per_mm = 10.0\n"
    (empty / "rig.toml").write_text(rig + third, encoding="utf-8")
    said: list[str] = []
    name = views(paper_images)[0]
    folder = WatchedFolder(empty, said.append, patience_s=-1.0)
    arrive(paper_images, empty, name, ("left",))
    for _ in range(2):
        folder.poll()
    assert folder.complete() == []
    assert any("no image of camera top" in words for words in said)
    arrive(paper_images, empty, name, ("right",))
    said.clear()
    for _ in range(3):
        folder.poll()
    assert folder.complete() == [Path(name).stem] and not said
