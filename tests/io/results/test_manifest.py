"""Results folders with a manifest: what readers get after kills, edits, copies and second runs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from killed_writers import killed_at_every_rename

from telerig.errors import InputError, TelerigWarning
from telerig.io.files import atomic
from telerig.io.results import manifest
from telerig.io.results.inputs import Source, fingerprints
from telerig.io.results.manifest import (
    check_file,
    check_place,
    is_whole,
    read_manifest,
    reading,
    replaced_results,
)
from telerig.io.results.stale import refuse_stale, stale

TRACKS = ("tracks.csv", "tracking.json")


def write(folder: Path, command: str, inputs: dict[str, Path] | None = None, **files: str) -> None:
    """Write a section; a file's name is given with _ in place of its dot."""
    used = fingerprints(folder, (inputs or {}).values())
    with replaced_results(folder, command, again=f"telerig {command} X", inputs=used) as staged:
        for name, text in files.items():
            file = staged / name.replace("_", ".")
            file.write_text(text)


def read(folder: Path, *names: str) -> list[str]:
    """The texts of the files; no warning is allowed."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with reading(folder, names):
            return [(folder / name).read_text() for name in names if (folder / name).exists()]


def test_readers_get_the_old_or_the_new_files_or_a_refusal(tmp_path: Path) -> None:
    folder = tmp_path / "rise"

    def old() -> None:
        write(folder, "track", tracks_csv="old", tracking_json="old", references_csv="old")

    def new() -> None:
        write(folder, "track", tracks_csv="new", tracking_json="new", more_csv="new")

    seen = []
    for _ in killed_at_every_rename(folder, old, new):
        try:
            texts = read(folder, "tracks.csv", "tracking.json", "references.csv", "more.csv")
        except InputError as error:
            assert "two different results" in str(error)
            assert "`telerig track X` again" in str(error)
            assert not is_whole(folder / "tracks.csv")
            seen.append("refused")
        else:
            assert is_whole(folder / "tracks.csv")
            assert texts in (["old"] * 3, ["new"] * 3)
            seen.append(texts[0])
        new()
        assert read(folder, "tracks.csv", "more.csv") == ["new", "new"], "run again"
        assert not (folder / "references.csv").exists(), "what is not written again is removed"
    assert seen == ["old", "old", *["refused"] * 3, "new", "new"]


def test_a_first_result_that_was_killed_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "rise"
    seen = []
    for _ in killed_at_every_rename(
        folder, lambda: None, lambda: write(folder, "track", tracks_csv="new", tracking_json="new")
    ):
        try:
            seen.append(read(folder, *TRACKS))
        except InputError:
            seen.append(["refused"])
    assert seen == [[], [], ["refused"], ["new"] * 2, ["new"] * 2]


def test_a_mixture_of_one_command_leaves_the_files_of_the_others(tmp_path: Path) -> None:
    folder = tmp_path / "rise"

    def tracked() -> None:
        write(folder, "track", tracks_csv="t", run_json="track")

    def smoothed() -> None:
        write(folder, "smooth", trajectories_csv="s", run_json="smooth", shake_csv="s")

    for step in killed_at_every_rename(folder, tracked, smoothed):
        assert read(folder, "tracks.csv") == ["t"], "smoothing can be run again"
        if step in (2, 3):
            with pytest.raises(InputError, match="telerig smooth X"):
                read(folder, "run.json")
        smoothed()
        assert read(folder, "tracks.csv", "run.json", "shake.csv") == ["t", "smooth", "s"]


def test_tracking_again_takes_over_shared_files_only(tmp_path: Path) -> None:
    folder = tmp_path / "rise"
    write(folder, "track", tracks_csv="1", run_json="track")
    write(folder, "smooth", {"t": folder / "tracks.csv"}, shake_csv="s", run_json="smooth")
    (folder / "mine.txt").write_text("mine")
    assert stale(folder) == ()
    write(folder, "track", tracks_csv="2", run_json="track 2")
    found = read_manifest(folder)
    assert found is not None
    assert {name: set(s.files) for name, s in found.sections.items()} == {
        "track": {"tracks.csv", "run.json"},
        "smooth": {"shake.csv"},
    }
    assert (folder / "mine.txt").read_text() == "mine"
    (words,) = stale(folder, ["shake.csv"])
    assert "`telerig smooth X`" in words
    assert "tracks.csv has changed" in words
    assert stale(folder, ["tracks.csv"]) == ()


def test_a_killed_command_is_forgotten_once_others_replaced_its_files(tmp_path: Path) -> None:
    """A mixture is remembered until its own command runs again, also over other commands."""
    folder = tmp_path / "rise"

    def old() -> None:
        write(folder, "smooth", shake_csv="old", trajectories_csv="old")

    def new() -> None:
        write(folder, "smooth", shake_csv="new", trajectories_csv="new")

    for step in killed_at_every_rename(folder, old, new):
        write(folder, "track", tracks_csv="t")
        if step == 2:
            with pytest.raises(InputError, match="telerig smooth X"):
                read(folder, "shake.csv")
        else:
            assert read(folder, "shake.csv", "trajectories.csv") in (["old"] * 2, ["new"] * 2)


def test_an_edited_result_that_was_not_replaced_is_still_usable(tmp_path: Path) -> None:
    """The old result counts as it was when the killed command began."""
    folder = tmp_path / "rise"

    def old() -> None:
        write(folder, "track", tracks_csv="frame\n1\n2\n", tracking_json="old")
        (folder / "tracks.csv").write_text("frame\n1\n")

    def new() -> None:
        write(folder, "track", tracks_csv="frame\n", tracking_json="new")

    steps = killed_at_every_rename(folder, old, new)
    for _ in range(2):
        next(steps)
        with (
            pytest.warns(TelerigWarning, match="1 of the 2 rows"),
            reading(folder, ["tracks.csv"]),
        ):
            pass
    steps.close()


def test_a_table_cut_at_the_end_of_a_line_is_noticed(tmp_path: Path) -> None:
    write(tmp_path / "rise", "track", tracks_csv="frame,x\n0,1\n1,2\n2,3\n")
    file = tmp_path / "rise" / "tracks.csv"
    file.write_text("frame,x\n0,1\n")
    with (
        pytest.warns(TelerigWarning, match="has 1 of the 3 rows that telerig wrote"),
        reading(file.parent, [file.name]),
    ):
        pass
    file.unlink()
    with (
        pytest.warns(TelerigWarning, match=r"tracks\.csv: is no longer there"),
        reading(file.parent, [file.name]),
    ):
        pass
    file.write_text("frame,x\n0,1\n1,2\n2,4\n")
    with (
        pytest.warns(TelerigWarning, match="was changed after telerig wrote it"),
        reading(file.parent, [file.name]),
    ):
        pass


def test_files_that_telerig_did_not_write_here(tmp_path: Path) -> None:
    lone = tmp_path / "lone"
    lone.mkdir()
    (lone / "calibration.json").write_text("{}")
    assert read(lone, "calibration.json") == ["{}"], "a copied file gives no warning"
    (lone / "run.json").write_text("{}")
    with (
        pytest.warns(TelerigWarning, match="there is no manifest.json") as said,
        reading(lone, ["calibration.json", "run.json"]),
    ):
        pass
    assert len(said) == 1, "a folder from before gives one warning"
    write(tmp_path / "rise", "track", tracks_csv="t")
    (tmp_path / "rise" / "events.csv").write_text("foreign")
    with (
        pytest.warns(TelerigWarning, match=r"events\.csv: was not written .* by telerig"),
        reading(tmp_path / "rise", ["tracks.csv", "events.csv"]),
    ):
        pass


@pytest.mark.parametrize("before", [None, "{"])
def test_a_smoothing_of_before_becomes_stale(tmp_path: Path, before: str | None) -> None:
    folder = tmp_path / "rise"
    folder.mkdir()
    for name in ("tracks.csv", "trajectories.csv", "smoothing.json"):
        (folder / name).write_text("old")
    if before is not None:
        (folder / "manifest.json").write_text(before)
    write(folder, "track", tracks_csv="old")
    assert stale(folder) == ()
    write(folder, "track", tracks_csv="new")
    (words,) = stale(folder, ["trajectories.csv"])
    assert "`telerig smooth RUN` are stale (tracks.csv has changed" in words


def test_a_reader_notices_that_the_folder_is_written_while_it_reads(tmp_path: Path) -> None:
    write(tmp_path / "rise", "track", tracks_csv="old")
    with (
        pytest.raises(InputError, match="written again while it was being read"),
        reading(tmp_path / "rise", ["tracks.csv"]),
    ):
        write(tmp_path / "rise", "track", tracks_csv="new")


def test_a_folder_that_is_written_during_the_check_is_checked_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "rise"
    write(folder, "track", tracks_csv="old", tracking_json="old")
    texts = iter(["new", "newer"])

    def written_meanwhile(place: Path) -> manifest.Manifest | None:
        found = read_manifest(place)
        if text := next(texts, ""):
            write(folder, "track", tracks_csv=text, tracking_json=text)
        return found

    monkeypatch.setattr(manifest, "read_manifest", written_meanwhile)
    assert read(folder, *TRACKS) == ["newer", "newer"]


def chain(folder: Path) -> tuple[Path, Path]:
    """A dataset with a calibration and tracks that were made from it."""
    calibration, tracked = folder / "results" / "calibration", folder / "results" / "rise"
    folder.mkdir()
    (folder / "rig.toml").write_text("[cameras]\na = 1\n[devices]\nb = 1\n")
    rig = fingerprints(calibration, [Source(folder / "rig.toml", tables=("cameras",))])
    with replaced_results(calibration, "calibrate", again="telerig calibrate D", inputs=rig) as out:
        (out / "calibration.json").write_text("{}")
    write(tracked, "track", {"c": calibration / "calibration.json"}, tracks_csv="t")
    return calibration, tracked


def test_what_makes_results_stale(tmp_path: Path) -> None:
    calibration, tracked = chain(tmp_path / "data")
    rig = tmp_path / "data" / "rig.toml"
    rig.write_text("# a comment\n[cameras]\na = 1\n[devices]\nb = 2\n")
    assert stale(tracked) == (), "what a calibration does not use may change"
    rig.write_text("[cameras]\na = 2\n")
    first, second = stale(tracked)
    assert "`telerig calibrate D` are stale (rig.toml has changed" in first
    assert "`telerig track X` are stale (calibration/calibration.json is stale itself" in second
    write(calibration, "calibrate", calibration_json="{2}")
    (words,) = stale(tracked)
    assert "calibration/calibration.json has changed" in words
    with pytest.raises(InputError, match="--accept stale"):
        refuse_stale(tracked, ["tracks.csv"])
    assert refuse_stale(tracked, ["tracks.csv"], ["stale"]) == (words,)
    with pytest.raises(InputError, match="did you mean stale"):
        refuse_stale(tracked, ["tracks.csv"], ["stal"])


def test_moved_and_copied_folders_are_not_stale(tmp_path: Path) -> None:
    _, tracked = chain(tmp_path / "data")
    (tmp_path / "data").rename(tmp_path / "moved data")
    tracked = tmp_path / "moved data" / "results" / "rise"
    assert stale(tracked) == ()
    tracked.rename(tmp_path / "alone")
    assert stale(tmp_path / "alone") == (), "inputs that are not there make nothing stale"
    assert read(tmp_path / "alone", "tracks.csv") == ["t"]


def test_an_input_that_is_added_later_makes_results_stale(tmp_path: Path) -> None:
    stage = tmp_path / "stage.csv"
    write(tmp_path / "rise", "smooth", {"s": stage}, shake_csv="s")
    assert stale(tmp_path / "rise") == ()
    stage.write_text("t_s,position_mm\n")
    (words,) = stale(tmp_path / "rise")
    assert "stage.csv was added after they were made" in words


def test_images_count_by_number_and_size(tmp_path: Path) -> None:
    run, folder = tmp_path / "run", tmp_path / "run" / "results"
    (run / "left").mkdir(parents=True)
    (run / "left" / "1.tif").write_bytes(b"123")
    (run / "right.avi").write_bytes(b"1")
    found = fingerprints(folder, [Source(run, cameras=("left", "right"))])
    assert (found[".."].files, found[".."].bytes) == (2, 4)
    with replaced_results(folder, "track", again="telerig track X", inputs=found) as staged:
        (staged / "tracks.csv").write_text("t")
    assert stale(folder) == (), "results inside the run's folder are none of its images"
    (run / "left" / "2.tif").write_bytes(b"123")
    assert len(stale(folder)) == 1


def test_an_image_replaced_by_one_of_the_same_size_makes_results_stale(tmp_path: Path) -> None:
    run, folder = tmp_path / "run", tmp_path / "run" / "results"
    (run / "left").mkdir(parents=True)
    noise = np.random.default_rng(0)
    for k in range(5):
        (run / "left" / f"{k}.raw").write_bytes(noise.bytes(20_000))
    found = fingerprints(folder, [Source(run, cameras=("left",))])
    with replaced_results(folder, "track", again="telerig track X", inputs=found) as staged:
        (staged / "tracks.csv").write_text("t")
    assert stale(folder) == ()
    kept = (run / "left" / "3.raw").read_bytes()
    (run / "left" / "3.raw").write_bytes(noise.bytes(20_000))
    assert len(stale(folder)) == 1
    (run / "left" / "3.raw").write_bytes(kept)
    assert stale(folder) == ()
    (run / "left" / "4.raw").replace(run / "left" / "5.raw")
    assert len(stale(folder)) == 1, "an image was renamed"


@pytest.mark.parametrize(
    "name", ["../outside.txt", "/etc/passwd", "a/../../b", "manifest.json", "a\0b", "x" * 300]
)
def test_a_manifest_cannot_name_files_outside_its_folder(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "rise"
    write(folder, "track", tracks_csv="t")
    content = json.loads((folder / "manifest.json").read_text())
    content["sections"]["track"]["files"][name] = {"sha256": "0", "bytes": 0}
    (folder / "manifest.json").write_text(json.dumps(content))
    (tmp_path / "outside.txt").write_text("mine")
    with pytest.raises(InputError, match=r"names (no file|a file outside the folder)"):
        read(folder, "tracks.csv")
    write(folder, "track", tracks_csv="new")
    assert read(folder, "tracks.csv") == ["new"], "the command that is run again mends the manifest"
    assert (tmp_path / "outside.txt").read_text() == "mine"


def test_a_folder_in_the_place_of_a_file_is_refused_before_anything_changes(tmp_path: Path) -> None:
    write(tmp_path / "rise", "track", a_csv="old")
    (tmp_path / "rise" / "b.csv").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        write(tmp_path / "rise", "track", a_csv="new", b_csv="new")
    assert read(tmp_path / "rise", "a.csv") == ["old"]


def test_two_commands_at_once_leave_one_whole_result(tmp_path: Path) -> None:
    """The files of two processes that write at the same moment never end up side by side."""
    code = (
        "import sys, time; from pathlib import Path\n"
        "from telerig.io.results.manifest import replaced_results\n"
        "while time.time() < float(sys.argv[3]): pass\n"
        "with replaced_results(Path(sys.argv[1]), 'track', again='x', inputs={}) as staged:\n"
        "    for i in range(60): (staged / f'{i}.csv').write_text(sys.argv[2])\n"
    )
    names = [f"{i}.csv" for i in range(60)]
    start = str(time.time() + 1.5)
    writers = [
        subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "rise"), text, start])
        for text in ("a", "b")
    ]
    assert [writer.wait() for writer in writers] == [0, 0]
    assert len(set(read(tmp_path / "rise", *names))) == 1


def leftovers(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if ".part" in p.name)


def test_leftovers_of_dead_commands_are_removed(tmp_path: Path, monkeypatch) -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    folder, machine = tmp_path / "results" / "rise", atomic._machine()
    folder.mkdir(parents=True)

    def left(mark: str, days: float = 0) -> Callable[[], None]:
        for place in (folder.parent / f".rise.{mark}.part", folder / f".a.csv.{mark}.part.csv"):
            place.mkdir() if place.suffix == ".part" else place.touch()
            os.utime(place, (time.time() - days * 86400,) * 2)
        return lambda: None

    left(f"{machine}-{child.pid}-0123abcd")
    left(f"{machine}-{os.getpid()}-0123abcd", days=99)
    left(f"ffffff-{child.pid}-0123abcd", days=1)
    left(f"eeeeee-{child.pid}-0123abcd", days=8)
    left(f"{child.pid}-0123abcd", days=8)
    (folder / ".notes.part").touch()
    write(folder, "track", tracks_csv="t")
    kept = [f"{machine}-{os.getpid()}-0123abcd", f"ffffff-{child.pid}-0123abcd"]
    assert leftovers(folder.parent) == sorted(f".rise.{mark}.part" for mark in kept)
    assert leftovers(folder) == sorted(
        [".notes.part", *(f".a.csv.{mark}.part.csv" for mark in kept)]
    )


def test_results_never_replace_what_they_are_made_from(tmp_path: Path) -> None:
    (tmp_path / "detections.csv").write_text("recorded")
    with pytest.raises(InputError, match="would be written over"):
        write(tmp_path, "track", {"d": tmp_path / "detections.csv"}, detections_csv="found")
    assert (tmp_path / "detections.csv").read_text() == "recorded"


@pytest.mark.parametrize("alone", [True, False])
def test_a_folder_that_is_a_disk_of_its_own_and_one_without_a_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, alone: bool
) -> None:
    """Files can be renamed within a disk only; "." has no name beside which to write."""
    (folder := tmp_path / "disk").mkdir()
    monkeypatch.setattr(os.path, "ismount", lambda path: alone)
    monkeypatch.chdir(folder)
    (source := tmp_path / "rig.toml").write_text("a = 1")
    inputs = fingerprints(Path(), [source])
    with replaced_results(Path(), "track", again="telerig track X", inputs=inputs) as staged:
        assert staged.parent == (folder if alone else tmp_path)
        (staged / "tracks.csv").write_text("new")
        assert not stale(staged)
        source.write_text("a = 2")
        assert "rig.toml has changed" in " ".join(stale(staged))
    assert read(folder, "tracks.csv") == ["new"]
    assert sorted(p.name for p in folder.iterdir()) == ["manifest.json", "tracks.csv"]


def test_results_of_different_things_need_folders_of_their_own(tmp_path: Path) -> None:
    write(tmp_path, "calibrate", calibration_json="c", run_json="c")
    write(tmp_path, "report", report_html="c")
    with pytest.raises(InputError, match="holds results of `telerig calibrate`"):
        write(tmp_path, "track", tracks_csv="t", run_json="t")
    assert read(tmp_path, "run.json", "report.html") == ["c", "c"]
    write(tmp_path, "detect", dots_csv="d")
    write(tmp_path, "report", report_html="d")


def test_a_place_that_would_replace_an_input_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "overlays").mkdir()
    (image := tmp_path / "overlays" / "a.jpg").write_text("image")
    used = fingerprints(tmp_path, [image])
    with (
        pytest.raises(InputError, match="would be written over"),
        replaced_results(tmp_path, "bubbles", again="", inputs=used),
    ):
        pytest.fail("the work has begun")
    check_place(tmp_path, "validate", used)
    write(tmp_path / "rise", "track", tracks_csv="t")
    with pytest.raises(InputError, match="holds results of `telerig track`"):
        check_place(tmp_path / "rise", "batch")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("rig.toml", "belongs to the dataset"),
        ("runs/rise/frames.csv", "belongs to the dataset"),
        ("runs", "is a folder"),
        ("results/rise/tracks.csv", "is a result of `telerig track`"),
        ("results/rise/mine.csv", ""),
        ("plan.csv", ""),
        ("runs/rise/new.csv", ""),
    ],
)
def test_a_single_file_never_replaces_data_or_results(
    tmp_path: Path, name: str, words: str
) -> None:
    (tmp_path / "runs" / "rise").mkdir(parents=True)
    write(tmp_path / "results" / "rise", "track", tracks_csv="t")
    for file in ("rig.toml", "runs/rise/frames.csv", "results/rise/mine.csv", "plan.csv"):
        (tmp_path / file).write_text("x")
    with pytest.raises(InputError, match=words) if words else nullcontext():
        check_file(tmp_path / name)
