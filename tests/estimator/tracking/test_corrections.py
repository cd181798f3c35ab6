"""Corrections of tracks by hand: what each does, what is refused, and a whole run."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import telerig
from telerig.errors import InputError
from telerig.estimator.tracking import track as track_module
from telerig.estimator.tracking.corrections import Corrections, add_correction, read_corrections
from telerig.estimator.tracking.linking.filter import TrackEvent
from telerig.estimator.tracking.linking.frames_to_rows import Linked
from telerig.estimator.tracking.results_folder import WORK
from telerig.estimator.tracking.tracks import Tracks, events_table
from telerig.io.results.stale import stale
from telerig.scripts.main import app

TABLES = ("tracks.csv", "detections.csv", "events.csv", "tracking.json")
HEAD = "action,particle,other,frame,reason\n"


def parts(ids: list[list[float]]) -> Iterator[Linked]:
    """One part per frame, with the ids of its tracks; detections have one more, without a track."""
    for frame, here in enumerate(ids):
        tracks = pd.DataFrame({"frame": frame, "particle": np.array(here, np.int64), "t_s": 0.1})
        found = pd.DataFrame({"frame": frame, "particle": [*here, np.nan], "camera": "left"})
        yield Linked(tracks, found)


def read(folder: Path, rows: str) -> Corrections:
    (folder / "corrections.csv").write_text(HEAD + rows)
    return read_corrections(folder, numbered=True)


def corrected(folder: Path, rows: str, ids: list[list[float]]) -> list[list[int]]:
    done = list(read(folder, rows).applied(parts(ids)))
    for part in done:
        assert part.tracks["particle"].dtype == np.int64
        seen = part.detections["particle"].dropna().astype(int).tolist()
        assert seen == part.tracks["particle"].tolist()
    return [part.tracks["particle"].tolist() for part in done]


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ("drop,1,,,a reflection\n", [[2], [2], [], []]),
        ("drop,1,,1,lost\n", [[1, 2], [2], [], []]),
        ("join,2,3,,the same bubble\n", [[1, 2], [1, 2], [1, 2], [1, 2]]),
        ("split,1,9,2,two bubbles\n", [[1, 2], [1, 2], [9, 3], [9, 3]]),
        ("rename,1,7,,as in the notebook\n", [[7, 2], [7, 2], [7, 3], [7, 3]]),
        ("join,2,3,,same\nrename,2,5,,number\n", [[1, 5], [1, 5], [1, 5], [1, 5]]),
        ("split,1,9,2,two\ndrop,9,,,noise\n", [[1, 2], [1, 2], [3], [3]]),
        ("", [[1, 2], [1, 2], [1, 3], [1, 3]]),
    ],
)
def test_each_action(tmp_path: Path, rows: str, expected: list[list[int]]) -> None:
    ids = [[1, 2], [1, 2], [1, 3], [1, 3]]
    if rows.startswith("drop,1"):
        expected = [[*e, *([] if 2 in e else [3])] for e in expected]
    assert corrected(tmp_path, rows, ids) == expected


def test_what_was_done_and_what_changed_nothing_is_said(tmp_path: Path) -> None:
    corrections = read(tmp_path, "drop,1,,,a speck\njoin,2,8,,gone\nsplit,2,5,40,late\n")
    list(corrections.applied(parts([[1, 2], [1, 2]])))
    (event,) = corrections.of_events([])
    assert (event.kind, event.frame, event.reason) == ("correction", 0, "drop: a speck")
    assert ["row 3" in corrections.warnings[0], "no track 8" in corrections.warnings[0]] == [1, 1]
    assert "no track 2 from frame 40 on" in corrections.warnings[1]


def test_events_are_those_of_the_corrected_tracks(tmp_path: Path) -> None:
    rows = "join,1,2,,same\nsplit,1,9,8,two\nrename,3,7,,label\ndrop,4,,,a speck\n"
    corrections = read(tmp_path, rows)
    ids = [[1], [1, 4], [1, 3, 4], [3], [3], [2, 3], [2, 3], [2, 3], [2, 3]]
    list(corrections.applied(parts(ids)))
    told = [
        ("birth", 0, (1,)), ("birth", 1, (4,)), ("split", 1, (1, 4)), ("birth", 2, (3,)),
        ("death", 3, (1,)), ("birth", 5, (2,)), ("split", 5, (1, 2)), ("split", 6, (2, 3)),
        ("gap", 7, (2,)), ("gap", 8, (2,)), ("death", 9, (2,)), ("death", 9, (3,)),
        ("break", 9, (3, 4)),
    ]  # fmt: skip
    events = [TrackEvent(kind, frame, 0.0, ids, "") for kind, frame, ids in told]
    *now, _, _, _, _ = corrections.of_events(events)
    found = [(e.kind, e.frame, e.particles) for e in now]
    assert found == [  # no death in frame 3: track 1 goes on until it is split
        ("birth", 0, (1,)), ("birth", 2, (7,)), ("split", 6, (1, 7)), ("gap", 7, (1,)),
        ("gap", 8, (9,)), ("death", 9, (9,)), ("death", 9, (7,)), ("break", 9, (7,)),
    ]  # fmt: skip
    names = TrackEvent("birth", 0, 0.0, ("3",), "")
    assert corrections.of_events([names])[0].particles == ("7",)


def test_a_join_with_a_track_that_is_not_there_is_said(tmp_path: Path) -> None:
    ids = [[1, 2], [1, 2], [3]]
    for rows, count in (("join,99,3,,typing error\n", 1), ("join,2,3,,the same\n", 0)):
        corrections = read(tmp_path, rows)
        list(corrections.applied(parts(ids)))
        found = [w for w in corrections.warnings if "there is no track 99 to join it with" in w]
        assert len(corrections.warnings) == len(found) == count


def test_numbers_with_zeros_before_them_are_numbers(tmp_path: Path) -> None:
    assert corrected(tmp_path, "rename,01,007,,x\n", [[1], [1]]) == [[7], [7]]
    assert corrected(tmp_path, "join,2.0,3.0,,x\n", [[2], [3]]) == [[2], [2]]
    with pytest.raises(InputError, match="there is a track 2 already"):
        corrected(tmp_path, "rename,1,02,,x\n", [[1, 2]])


def test_tracks_that_one_camera_sees_in_the_same_frame_are_not_joined(tmp_path: Path) -> None:
    """Both tracks are in one image, although only one of them has a point in that frame."""
    tracks = pd.DataFrame({"frame": [0], "particle": [1], "t_s": [0.0]})
    found = pd.DataFrame({"frame": 0, "particle": [1, 2, 1], "camera": ["a", "a", "b"]})
    found = found.astype({"particle": "Int64"})
    with pytest.raises(InputError, match="two tracks have the id 1 in frame 0"):
        list(read(tmp_path, "join,1,2,,x\n").applied(iter([Linked(tracks, found)])))


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("kill,1,,,x\n", "no action 'kill'"),
        ("join,1,,,x\n", "give particle (an id)"),
        ("join,1,1,,x\n", "give particle (an id)"),
        ("split,1,9,,x\n", "frame"),
        ("rename,1,b,,x\n", "whole number"),
        ("drop,1,2,,x\n", "drop has particle"),
        ("drop,1,,,\n", "is blank"),
        ("join,1,2,,x\n", "two tracks have the id 1 in frame 0"),
        ("rename,1,2,,x\n", "row 2: there is a track 2 already"),
        ("split,1,3,1,x\n", "there is a track 3 already"),
    ],
)
def test_refusals(tmp_path: Path, rows: str, words: str) -> None:
    with pytest.raises(InputError, match=r"corrections\.csv") as caught:
        list(read(tmp_path, rows).applied(parts([[1, 2], [1, 2], [1, 3]])))
    assert words in str(caught.value)


def test_named_bubbles(tmp_path: Path) -> None:
    (tmp_path / "corrections.csv").write_text(HEAD + "rename,a,left one,,label\n")
    table = pd.DataFrame({"frame": 0, "particle": np.array(["a", "b"], object), "t_s": 0.0})
    table["camera"] = "left"
    done = next(read_corrections(tmp_path, numbered=False).applied(iter([Linked(table, table)])))
    assert done.tracks["particle"].tolist() == ["left one", "b"]


def test_a_tracking_applies_them_and_tells_of_them(tank_copy: Path) -> None:
    run, results = tank_copy / "runs" / "rise", tank_copy / "results" / "rise"
    before = pd.read_csv(results / "tracks.csv")
    assert not stale(results, ["tracks.csv"])
    (run / "corrections.csv").write_text(HEAD + "split,0,5,6,it <hit> another bubble\n")
    assert any("corrections.csv" in sentence for sentence in stale(results, ["tracks.csv"]))
    done = CliRunner().invoke(app, ["track", str(run), "--quiet", "--no-report"])
    assert done.exit_code == 0, done.output
    after = pd.read_csv(results / "tracks.csv")
    pd.testing.assert_frame_equal(after.drop(columns="particle"), before.drop(columns="particle"))
    assert after["particle"].tolist() == [0] * 6 + [5] * (len(before) - 6)
    assert "2 tracks" in done.output
    found = telerig.load_tracks(results)
    said = found.events[found.events["kind"] == "correction"]
    assert said["reason"].tolist() == ["split: it <hit> another bubble"]
    assert set(found.detections["particle"].dropna()) == {0, 5}


def correct(run: Path, *words: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["correct", str(run), *words, "--quiet"])
    return done.exit_code, done.output


def contents(folder: Path) -> list[bytes]:
    return [(folder / name).read_bytes() for name in TABLES]


def test_a_correction_is_that_of_a_whole_tracking_and_repeats_none_of_it(
    tank_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, results = tank_copy / "runs" / "rise", tank_copy / "results" / "rise"
    command = ["track", str(run), "--quiet", "--no-report"]
    assert CliRunner().invoke(app, command).exit_code == 0
    before = contents(results)
    with monkeypatch.context() as patch:
        for name in ("make_scene", "detect_missing", "learn_rig", "_linked"):
            patch.setattr(track_module, name, lambda *_, **__: pytest.fail("repeated"))
        code, said = correct(run, "split", "0", "5", "--from", "6", "--reason", "a, b <c>")
        assert code == 0, said
        assert "row 2" in said and "frames 6 to" in said and "now track 5" in said
        assert "tracks.csv has changed since they were made" in said, "the smoothing is stale"
        corrected = contents(results)
        assert correct(run, "rename", "5", "8")[0] == correct(run, "rename", "8", "5")[0] == 0
        (run / "corrections.csv").unlink()
        assert CliRunner().invoke(app, command).exit_code == 0
        assert contents(results) == before != corrected
    (run / "corrections.csv").write_text(HEAD + 'split,0,5,6,"a, b <c>"\n')
    shutil.rmtree(results / WORK)
    assert CliRunner().invoke(app, command).exit_code == 0
    assert contents(results) == corrected


def test_other_detections_are_tracked_anew(tank_copy: Path) -> None:
    run, results = tank_copy / "runs" / "rise", tank_copy / "results" / "rise"
    command = ["track", str(run), "--quiet", "--no-report"]
    assert CliRunner().invoke(app, command).exit_code == 0
    before = pd.read_csv(results / "tracks.csv")
    found = pd.read_csv(run / "detections.csv")
    found.assign(u_px=found["u_px"] + 1).to_csv(run / "detections.csv", index=False)
    assert CliRunner().invoke(app, command).exit_code == 0
    after = pd.read_csv(results / "tracks.csv")
    assert after["left_u_px"].tolist() == pytest.approx((before["left_u_px"] + 1).tolist())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["join", "0", "3"], "there is no track 3"),
        (["drop", "7"], "there is no track 7"),
        (["split", "0", "5"], "split has particle"),
        (["split", "0", "5", "--from", "0"], "split from frame 0 on changes all of it"),
        (["split", "0", "5", "--from", "4000"], "split from frame 4000 on changes none of it"),
        (["rename", "0", "b"], "no whole number"),
        (["rename", "0", "9" * 23], "no whole number"),
        (["cut", "0"], "no action 'cut'"),
        (["drop", "0", "--reason", ""], "reason"),
    ],
)
def test_a_correction_that_does_not_fit_is_not_written(
    tank_copy: Path, words: list[str], said: str
) -> None:
    run = tank_copy / "runs" / "rise"
    code, found = correct(run, *words)
    assert code == 2 and said in " ".join(found.split())
    assert not (run / "corrections.csv").exists()


def test_a_reason_stays_in_its_row(tank_copy: Path) -> None:
    run = tank_copy / "runs" / "rise"
    code, found = correct(run, "drop", "0", "--reason", 'out of\nfocus, "blurred"')
    assert code == 0, found
    table = pd.read_csv(run / "corrections.csv")
    assert table["reason"].tolist() == ['out of focus, "blurred"']
    assert len((run / "corrections.csv").read_text().splitlines()) == 2


@pytest.mark.parametrize("option", ["--min-diameter", "--min-contrast"])
def test_options_of_the_detection_are_refused_where_bubbles_are_given(
    tank_copy: Path, option: str
) -> None:
    run = tank_copy / "runs" / "rise"
    found = CliRunner().invoke(app, ["track", str(run), option, "5"])
    assert found.exit_code == 2 and f"{option} 5 has no effect" in found.output


def test_tracks_that_are_both_seen_are_not_joined(tmp_path: Path) -> None:
    """Frame 4 shows both to one camera only."""
    run, results = tmp_path / "run", tmp_path / "results"
    run.mkdir()
    frames, ids = [0, 1, 2, 3, 3, 5], [1, 1, 1, 1, 2, 2]
    table = pd.DataFrame({"frame": frames, "particle": ids, "t_s": 0.0})
    table = table.assign(x_mm=0.0, y_mm=0.0, z_mm=0.0)
    summary = {"kind": "telerig tracks"}
    seen = pd.DataFrame({"frame": [*frames, 4, 4], "particle": [*ids, 1, 2], "camera": "left"})
    Tracks("run", seen.assign(u_px=1.0, v_px=1.0), table, events_table([]), summary).save(results)
    for first, many in ((0, "2 frames between 3 and 4"), (4, "1 frame between 4 and 4")):
        row = {"action": "join", "particle": "1", "other": "2", "frame": first, "reason": "x"}
        with pytest.raises(InputError, match=many):
            add_correction(run, results, row)
    assert "track 2, frames 5 to 5" in add_correction(run, results, {**row, "frame": 5})
    assert (run / "corrections.csv").read_text() == HEAD + "join,1,2,5,x\n"


def test_stale_tracks_are_not_corrected(tank_copy: Path) -> None:
    run = tank_copy / "runs" / "rise"
    (run / "corrections.csv").write_text(HEAD + "split,0,5,6,by hand\n")
    code, said = correct(run, "drop", "5")
    assert code == 2 and "corrections.csv was added" in said
    assert (run / "corrections.csv").read_text() == HEAD + "split,0,5,6,by hand\n"
