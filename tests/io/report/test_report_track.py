"""The report of a tracked run: from files to one page, and its numbers against authorities."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from report_page import Page, edit
from tracked_folder import SCALE, SIGMA_PX, WORST, write_folder

import telerig
from telerig.errors import InputError
from telerig.io.report.plot.tracking import miss_steps
from telerig.io.report.plot.tracks import thinned
from telerig.io.report.run import report
from telerig.io.report.run.report import write_track_report
from telerig.io.report.run.tracking import marks_words, verdict
from telerig.io.results.folders.tracking import (
    TrackResults,
    learnt_sd_mm,
    per_frame,
    ray_miss_ratio,
    ray_miss_sd_mm,
    read_track_results,
)

SECTIONS = [
    "verdict",
    "look",
    "key",
    "paths",
    "rays",
    "images",
    "frames",
    "events",
    "more",
    "origin",
]
OPTIONAL = ("detections.csv", "events.csv", "run.json", "overlays")
_edit = partial(edit, "tracking.json")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole folder with its page, which no test changes."""
    folder = write_folder(tmp_path_factory.mktemp("once") / "r")
    write_track_report(folder)
    return folder


@pytest.fixture(scope="module")
def results(whole: Path) -> TrackResults:
    return read_track_results(whole)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "r", bubbles=3, frames=60, drawn=False)


def _edit_table(folder: Path, name: str, **columns: Any) -> Path:
    table = pd.read_csv(folder / f"{name}.csv")
    table.assign(**columns).to_csv(folder / f"{name}.csv", index=False)
    return folder


def test_page_is_whole_small_and_loads_nothing(whole: Path) -> None:
    page = Page(whole / "report.html")
    assert (whole / "report.html").stat().st_size < 5e6
    assert page.ids == SECTIONS
    links = {load for load in page.loads if not load.startswith(("data:", "#"))}
    assert links == {f"overlays/{c}/{f:06d}.jpg" for c in ("left", "right") for f in WORST}
    assert len(page.pictures("")) == 3 + 3 + 1 + 3


def test_page_says_what_the_files_say(whole: Path, results: TrackResults) -> None:
    text = Page(whole / "report.html").text
    sd = np.median(1e3 * np.sqrt(results.tracks[["sxx_mm2", "syy_mm2", "szz_mm2"]]), axis=0)
    found = int(np.isfinite(results.outlines["u_px"]).sum())
    for words in (
        f"12 tracks, {len(results.tracks)} positions in space, 120 frames",
        f"known to {sd[0]:.1f}, {sd[1]:.1f} and {sd[2]:.1f} µm in x, y and z",
        f"{100 * 2 * len(results.tracks) / found:.1f} % of them have a partner",
        "seen in 3 of 4 frames", 'two continuations, 1.2 nats apart, "unsafe", <cut>', "1, 2",
        "birth: 12, death: 12, break: 1.", "frame 7, left3 bubbles without a partner",
        "an ambiguous pair & a break", "frames.csv has <no> times", "packages.numpy",
        "frames without: no image", "flag: border", "0.011", "0.004",
        "RMS for pairs left out of it, px", "of the measurement alone", "volume",
    ):  # fmt: skip
        assert words in text, words
    assert text.index("positions in space") < text.index("median length")


def test_ray_miss_prediction_is_the_propagated_pixel_noise(results: TrackResults) -> None:
    """Both v of SIGMA_PX / SCALE, independent: the difference has sqrt(2) of it."""
    sd = ray_miss_sd_mm(results)
    assert sd is not None
    np.testing.assert_allclose(sd, np.sqrt(2) * SIGMA_PX / SCALE, rtol=2e-3)
    assert ray_miss_ratio(results, sd) == pytest.approx(1.0, abs=0.12)
    assert verdict(results).colour == "good" and not verdict(results).warnings


def test_the_cameras_of_a_run_stand_in_its_folder(tmp_path: Path) -> None:
    """A folder of an older version has none; those of another run are refused."""
    folder = write_folder(tmp_path / "r", bubbles=3, frames=59, drawn=False)
    cameras = json.loads((folder / "tracking.json").read_text())["cameras"]
    old = read_track_results(_edit(folder, cameras={}))
    assert old.rig == () and ray_miss_sd_mm(old) is None and verdict(old).colour == "good"
    with pytest.raises(InputError, match=r"tracking\.json: its cameras are \['left'\]"):
        read_track_results(_edit(folder, cameras={"left": cameras["left"]}))
    turned = cameras["left"] | {"parameters": {"scale_px_per_mm": -1.0}}
    with pytest.raises(InputError, match="must be positive"):
        read_track_results(_edit(folder, cameras=cameras | {"left": turned}))


def test_a_biased_calibration_is_named_first_and_seen_in_the_rays(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", bubbles=3, frames=59, bias_px=1.8, drawn=False)
    results = read_track_results(folder)
    told = verdict(results)
    assert told.colour == "usable"
    (warning,) = told.warnings
    assert "(offset 1.80 px): this is a calibration problem" in warning
    assert ray_miss_ratio(results, ray_miss_sd_mm(results)) > 10
    steps = miss_steps(results.height_mm, 1e3 * results.tracks["ray_miss_mm"].to_numpy(float))
    off_um = float(np.abs(steps[:, 1]).max())
    assert off_um == pytest.approx(1e3 * 1.8 / SCALE, rel=0.1)


def test_shake_learnt_from_the_run_accounts_for_the_ray_miss(folder: Path) -> None:
    table = pd.read_csv(folder / "tracks.csv")
    rng = np.random.default_rng(8)
    _edit_table(folder, "tracks", ray_miss_mm=0.08 * rng.standard_normal(len(table)))
    quiet = read_track_results(folder)
    assert "Rays miss by" in verdict(quiet).warnings[0]
    pairs = quiet.pairs.content() | {"frame_px": 1.5, "scatter_px": 0.2}
    results = read_track_results(_edit(folder, pairs=pairs))
    assert learnt_sd_mm(results) == pytest.approx(np.hypot(1.5, 0.2) / SCALE, rel=2e-3)
    assert not verdict(results).warnings
    assert "against each other (1.5 px from frame to frame)" in verdict(results).sentences[-1]


def test_covariances_too_small_and_few_partners_are_warned_of(folder: Path) -> None:
    table = pd.read_csv(folder / "tracks.csv")
    small = {name: table[name] / 100 for name in table if name.endswith("_px2")}
    _edit(folder, pairs={"scatter_px": 0.0, "frame_px": 0.0})
    results = read_track_results(_edit_table(folder, "tracks", **small))
    assert "worse than the covariances" in verdict(results).warnings[0]
    table.iloc[: len(table) // 3].to_csv(folder / "tracks.csv", index=False)
    assert "More than half" in verdict(read_track_results(folder)).warnings[-1]


def test_per_frame_counts_add_up(results: TrackResults) -> None:
    counts = per_frame(results)
    for camera in ("left", "right"):
        assert counts[camera].sum() == (results.outlines["camera"] == camera).sum()
    assert counts["both"].sum() == len(results.tracks)
    frame = int(results.tracks["frame"].iloc[40])
    assert counts["both"][frame] == (results.tracks["frame"] == frame).sum()


def test_nothing_optional(folder: Path) -> None:
    for name in OPTIONAL[:3]:
        (folder / name).unlink()
    content = json.loads((folder / "tracking.json").read_text())
    bare = {key: content[key] for key in ("schema", "kind")}
    (folder / "tracking.json").write_text(json.dumps(bare))
    text = Page(write_track_report(folder)).text
    for words in (
        "events.csv (no history", "detections.csv (no numbers", "run.json (no versions",
        "overlays/ (no pictures",
        "How many bubbles the single images held is not known",
    ):  # fmt: skip
        assert words in text, words
    assert not {"frames", "events"} & set(Page(folder / "report.html").ids)


@pytest.mark.usefixtures("undrawn")
def test_no_rows_for_a_camera_and_no_tracks(folder: Path) -> None:
    detections = pd.read_csv(folder / "detections.csv")
    detections[detections["camera"] == "left"].to_csv(folder / "detections.csv", index=False)
    tracks = (folder / "tracks.csv").read_text().splitlines()[0]
    (folder / "tracks.csv").write_text(tracks + "\n")
    (folder / "events.csv").write_text("frame,t_s,kind,particles,reason\n")
    _edit(folder, points=0, tracks=0, events={})
    text = Page(write_track_report(folder)).text
    assert "No bubble was followed in 60 frames" in text
    assert 'class="verdict rejected"' in (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.usefixtures("undrawn")
def test_hostile_names_stay_text(folder: Path) -> None:
    evil = "</script><b>x"
    _edit(folder, run=evil, notes=[evil], worst_frames=[{"frame": 1, "score": 1, "why": evil}])
    _edit_table(folder, "events", kind=evil, reason=evil)
    _edit_table(folder, "detections", flags=evil)
    html = write_track_report(folder).read_text(encoding="utf-8")
    assert evil not in html and html.count("&lt;/script&gt;&lt;b&gt;x") >= 4


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("tracking.json", None, "no tracks here"),
        ("tracking.json", "{", "JSON"),
        ("tracking.json", '{"kind": "telerig calibration"}', "is not a tracks file"),
        ("tracking.json", '{"kind": "telerig tracks", "schema": 9}', "newer"),
        (
            "tracking.json",
            '{"kind": "telerig tracks", "schema": 1, "pairs": 3}',
            "has a fault at 'pairs'",
        ),
        ("tracks.csv", None, "does not exist"),
        ("tracks.csv", "frame,particle\n1,2\n", "missing columns: t_s, x_mm"),
        ("detections.csv", "frame,camera,u_px,v_px\n1,left,2,3\n", "particle"),
        ("detections.csv", "frame,camera,particle,u_px,v_px\n1,left,,2,x\n", "row 2, column v_px"),
        ("detections.csv", "frame,camera,particle,u_px,v_px\n1,left,,2\n", "row 2: has 4 cells"),
        ("detections.csv", "frame,camera,particle,u_px,v_px\n1,top,,2,3\n", "no camera 'top'"),
        ("events.csv", "frame,t_s,kind,particles,reason\n1.5,0,birth,1,x\n", "not a whole number"),
        ("run.json", "[1]", "not an object"),
    ],
)
def test_bad_files_are_named_and_the_old_report_stays(
    folder: Path, file: str, content: str | None, words: str
) -> None:
    (folder / "report.html").write_text("old")
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_text(content)
    with pytest.raises(InputError, match=words) as caught:
        write_track_report(folder)
    assert file in str(caught.value) and "->" in str(caught.value)
    assert (folder / "report.html").read_text() == "old"


def test_pages_and_load_tracks_read_by_the_same_rules(folder: Path) -> None:
    loaded, results = telerig.load_tracks(folder), read_track_results(folder)
    pd.testing.assert_frame_equal(loaded.table, results.tracks)
    pd.testing.assert_frame_equal(loaded.detections, results.detections)
    text = (folder / "tracks.csv").read_text()
    _edit_table(folder, "tracks", particle="b", own="x")
    assert set(telerig.load_tracks(folder).table["particle"]) == {"b"}
    with pytest.raises(InputError, match="'b' is no whole number, which a page needs"):
        read_track_results(folder)
    (folder / "tracks.csv").write_text(text)
    _edit_table(folder, "tracks", left_u_px="x")
    for read in (telerig.load_tracks, read_track_results):
        with pytest.raises(InputError, match="row 2, column left_u_px"):
            read(folder)


def test_tracks_without_columns_of_cameras_have_no_page(folder: Path) -> None:
    table = pd.read_csv(folder / "tracks.csv")
    bare = table[[name for name in table if not name.startswith(("left_", "right_"))]]
    bare.to_csv(folder / "tracks.csv", index=False)
    _edit(folder, frames_without_bubbles={})
    with pytest.raises(InputError, match="of a camera's pixels, like 'left_u_px'"):
        read_track_results(folder)


def test_quick_and_strict_reading_agree(folder: Path) -> None:
    quick = read_track_results(folder)
    for name in ("tracks", "detections"):
        file = folder / f"{name}.csv"
        lines = file.read_text().splitlines()
        file.write_text("\n".join([lines[0], *lines[1:4], "", *lines[4:]]) + "\n")
    strict = read_track_results(folder)
    pd.testing.assert_frame_equal(quick.tracks, strict.tracks)
    pd.testing.assert_frame_equal(quick.detections, strict.detections)


def test_thinning_keeps_ends_and_breaks_at_gaps(results: TrackResults) -> None:
    every = thinned(results.tracks, 10**6)
    assert len(every) == len(results.tracks)
    gaps = every.groupby("particle")["frame"].diff() != 1
    np.testing.assert_array_equal(every["new"], gaps)
    few = thinned(results.tracks, 200)
    assert len(few) < 300
    ends = results.tracks.groupby("particle")["frame"].agg(["min", "max"])
    pd.testing.assert_frame_equal(few.groupby("particle")["frame"].agg(["min", "max"]), ends)
    assert thinned(results.tracks.iloc[:0], 10).empty


def test_up_from_the_file_turns_heights_round(folder: Path) -> None:
    down = read_track_results(folder).height_mm
    np.testing.assert_allclose(read_track_results(_edit(folder, up=[0, 2, 0])).height_mm, -down)
    assert report.up_name(read_track_results(folder).up) == "y"
    with pytest.raises(InputError, match="has a fault at 'up'"):
        read_track_results(_edit(folder, up=[1, 2]))


def _repeated(file: Path, times: int, frames: int) -> int:
    """The table so many times, one after the other in time; its number of rows."""
    header, *rows = file.read_text().splitlines()
    parts = [row.split(",", 1) for row in rows]
    longer = [f"{int(f) + k * frames},{rest}" for k in range(times) for f, rest in parts]
    file.write_text("\n".join([header, *longer]) + "\n")
    return len(longer)


@pytest.mark.slow
def test_a_hundred_thousand_rows_are_thinned(folder: Path) -> None:
    times = 100_000 // len(pd.read_csv(folder / "tracks.csv")) + 1
    assert _repeated(folder / "tracks.csv", times, 60) > 100_000
    assert _repeated(folder / "detections.csv", times, 60) > 200_000
    page = write_track_report(folder)
    assert page.stat().st_size < 5e6


def test_marks_fixed_to_the_tank_are_drawn_where_there_are_some(folder: Path) -> None:
    bare = read_track_results(folder)
    assert not any(bare.marked(camera) for camera in range(2))
    content = json.loads((folder / "tracking.json").read_text())
    camera, other = list(content["frames_without_bubbles"])
    frames = np.arange(40)
    marks = [
        pd.DataFrame({"frame": f, "camera": camera, "mark": f"m{i}", "u_px": 100.0,
                      "v_px": 400.0 - 4 * f + 60 * i, "sigma_px": 0.05})
        for i, f in enumerate((frames, frames[5:35], frames[[3, 4, 5, 20, 21]]))
    ]  # fmt: skip
    pd.concat(marks).to_csv(folder / "references.csv", index=False)
    found = read_track_results(folder)
    assert not found.marked(found.cameras.index(other))
    words = marks_words(found, camera)
    assert "3 marks, 2 in a frame and each in 30 frames" in words and "0.0500 px" in words
    page = write_track_report(folder).read_text(encoding="utf-8")
    assert f"<h3>Marks fixed to the tank, {camera}</h3>" in page
    (folder / "references.csv").write_text("frame,camera\n0,left\n")
    with pytest.raises(InputError, match="mark"):
        write_track_report(folder)
