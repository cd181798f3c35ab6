"""The report of a tracked run: from files to one page, and its numbers against authorities."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest

from telerig.errors import InputError
from telerig.io.report import contact_sheet as sheets
from telerig.io.report.bubble_overlay import draw_binary, draw_bubble_overlay
from telerig.io.report.track_figures import time_series
from telerig.io.report.track_figures_rays import ray_miss_in_space, seen_where
from telerig.io.report.track_numbers import (
    learnt_sd_mm,
    per_frame,
    ray_miss_ratio,
    ray_miss_sd_mm,
)
from telerig.io.report.track_report import write_track_report
from telerig.io.report.track_results import TrackResults, read_track_results
from telerig.io.report.track_scene import thinned, track_scene_json
from telerig.io.report.track_tables import event_words, verdict
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.triangulation import triangulate

SIZE_PX, SCALE, SIGMA_PX, RATE_HZ = (640, 800), 20.0, 0.05, 500.0
SECTIONS = [
    *("verdict", "key", "space", "time", "rays", "quality", "images", "worst", "events", "notes"),
    *("more", "origin"),
]
OPTIONAL = ("detections.csv", "events.csv", "run.json", "overlays", "binary")
WORST = (7, 31)


def _cameras() -> tuple[Camera, Camera]:
    turned = Pose.from_rotvec([0.0, np.pi / 2, 0.0], [0.0, 0.0, 0.0])
    left = Camera.create("left", SIZE_PX, SCALE)
    return left, Camera.create("right", SIZE_PX, SCALE, camera_from_rig=turned)


def _helices(rng: np.random.Generator, bubbles: int, frames: int) -> pd.DataFrame:
    """Bubbles that wind upwards (rig -y), come and go, and are missed now and then."""
    parts = []
    for particle in range(bubbles):
        first = int(rng.integers(0, max(1, frames // 2)))
        frame = np.arange(first, min(frames, first + int(rng.integers(frames // 3, frames))))
        frame = frame[(rng.random(len(frame)) > 0.03) | (frame == first)]
        t = frame / RATE_HZ
        turn = 2 * np.pi * (rng.uniform(5, 8) * t + rng.random())
        centre, radius = rng.uniform(-9, 9, 3), rng.uniform(0.5, 2.5)
        rise = rng.uniform(-20, 20) * (t - t.mean())
        xyz = [
            centre[0] + radius * np.cos(turn),
            centre[1] - rise,
            centre[2] + radius * np.sin(turn),
        ]
        size = rng.uniform(2.0, 3.0)
        parts.append(pd.DataFrame({"frame": frame, "particle": particle, "t_s": t, "d_eq_mm": size}
                                  | dict(zip(("x_mm", "y_mm", "z_mm"), xyz))))  # fmt: skip
    return pd.concat(parts, ignore_index=True).sort_values(["frame", "particle"], ignore_index=True)


def _tracks(rng: np.random.Generator, true: pd.DataFrame, bias_px: float) -> pd.DataFrame:
    cameras, n = _cameras(), len(true)
    points = true[["x_mm", "y_mm", "z_mm"]].to_numpy()
    covariance = SIGMA_PX**2 * np.array([[1.0, 0.3], [0.3, 1.0]])
    noise = rng.multivariate_normal(np.zeros(2), covariance, (2, n))
    noise[1, :, 1] += bias_px
    uv = [camera.project(points) + error for camera, error in zip(cameras, noise)]
    each = np.broadcast_to(covariance, (n, 2, 2))
    found = triangulate(cameras, (uv[0], uv[1]), (each, each))
    table = true[["frame", "particle", "t_s"]].copy()
    table[["x_mm", "y_mm", "z_mm"]] = found.points_mm
    upper = found.covariance_mm2[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    table[[f"s{pair}_mm2" for pair in ("xx", "xy", "xz", "yy", "yz", "zz")]] = upper
    for camera, pixels in zip(cameras, uv):
        c = camera.name
        table[[f"{c}_u_px", f"{c}_v_px"]] = pixels
        table[[f"{c}_suu_px2", f"{c}_suv_px2", f"{c}_svv_px2"]] = covariance.ravel()[[0, 1, 3]]
        table[[f"{c}_du_px", f"{c}_dv_px"]] = 0.01 * rng.standard_normal((n, 2))
    table["ray_miss_mm"] = found.ray_miss_mm
    table["d_eq_mm"] = true["d_eq_mm"] * (1 + 0.02 * rng.standard_normal(n))
    table["sd_eq_mm"] = 0.02 * true["d_eq_mm"]
    table["confidence"] = 1 - 0.2 * rng.random(n) ** 8
    table["centre"] = np.where(rng.random(n) < 0.8, "volume", "silhouettes")
    table[["silhouettes_x_mm", "silhouettes_y_mm", "silhouettes_z_mm"]] = found.points_mm
    table["flags"] = np.where(rng.random(n) < 0.02, "ambiguous|overlap", "")
    return table


def _detections(rng: np.random.Generator, tracks: pd.DataFrame) -> pd.DataFrame:
    """Every tracked bubble in both cameras, dirt in no track, and images without a bubble."""
    parts = []
    for camera in ("left", "right"):
        pixels = tracks[[f"{camera}_u_px", f"{camera}_v_px"]].to_numpy()
        seen = tracks[["frame", "particle"]].assign(u_px=pixels[:, 0], v_px=pixels[:, 1])
        many = len(tracks) // 25
        dirt = pd.DataFrame({
            "frame": rng.integers(0, tracks["frame"].max() + 1, many), "particle": np.nan,
            "u_px": rng.uniform(0, 80, many), "v_px": rng.uniform(0, SIZE_PX[1] - 1, many),
        })  # fmt: skip
        parts.append(pd.concat([seen, dirt]).assign(camera=camera))
    table = pd.concat(parts, ignore_index=True)
    table["particle"] = table["particle"].astype("Int64")
    n = len(table)
    table = table.assign(
        suu_px2=2.5e-3, suv_px2=0.0, svv_px2=2.5e-3, a_px=25.0, b_px=22.0, angle_rad=0.1,
        area_px2=1700.0, d_eq_px=47.0, contrast=0.6, edge_px=1.1, chi2_dof=1.0,
        flags=np.where(rng.random(n) < 0.03, "border", ""), reason="",
    )  # fmt: skip
    blank = pd.DataFrame({"frame": [3], "camera": ["right"], "flags": [""], "reason": ["no image"]})
    return pd.concat([table, blank]).sort_values(["frame", "camera"], ignore_index=True)


def _events(tracks: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for particle, mine in tracks.groupby("particle"):
        first, last = mine.iloc[0], mine.iloc[-1]
        rows.append((first.frame, first.t_s, "birth", particle, "seen in 3 of 4 frames"))
        rows.append((last.frame, last.t_s, "death", particle, "unseen for 4 frames, 8 ms"))
    rows.append((31, 0.062, "break", "1 2", 'two continuations, 1.2 nats apart, "unsafe", <cut>'))
    table = pd.DataFrame(rows, columns=["frame", "t_s", "kind", "particles", "reason"])
    return table.sort_values("frame")


def _content(tracks: pd.DataFrame, detections: pd.DataFrame, bias_px: float) -> dict[str, Any]:
    words = [f"The rays of a pair miss each other by {abs(bias_px) + 0.07:.2f} px RMS."]
    if bias_px:
        words.append(
            f"This is a calibration problem: the shared coordinate is off by {bias_px} px."
        )
    found = int(detections["u_px"].notna().sum())
    return {
        "schema": 1, "kind": "telerig tracks", "run": "swarm <3>",
        "frames": int(tracks["frame"].max()) + 1, "detections": found, "points": len(tracks),
        "tracks": int(tracks["particle"].nunique()),
        "detections_without_partner_or_track": found - 2 * len(tracks),
        "frames_without_bubbles": {"left": {}, "right": {"no image": 1}},
        "events": {"birth": 12, "death": 12, "break": 1},
        "pairs": {"bias_px": [bias_px], "scatter_px": 0.07, "frame_px": 0.01,
                  "rms_px": [abs(bias_px) + 0.07, 0.07, 0.07, 0.072],
                  "calibration_problem": bool(bias_px), "words": words},
        "image_size_px": {"left": list(SIZE_PX), "right": list(SIZE_PX)},
        "shape_sigma": [0.011, 0.004], "covariance": "of the measurement alone",
        "notes": ["frames.csv has <no> times"],
        "worst_frames": [{"frame": WORST[0], "score": 4.0, "why": "3 bubbles without a partner"},
                         {"frame": WORST[1], "score": 2.5, "why": "an ambiguous pair & a break"}],
    }  # fmt: skip


def _ring(u: float, v: float, radius: float, wobble: float = 0.0) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    far = radius * (1 + wobble * np.cos(3 * turn))
    return np.stack([u + far * np.cos(turn), v + far * np.sin(turn)], -1)


def _pictures(folder: Path, rng: np.random.Generator, detections: pd.DataFrame) -> None:
    for camera in ("left", "right"):
        for frame in WORST:
            here = detections[(detections["frame"] == frame) & (detections["camera"] == camera)]
            here = here[here["u_px"].notna()]
            rings = [_ring(u, v, 24, 0.04) for u, v in here[["u_px", "v_px"]].to_numpy()]
            inside = draw_binary((SIZE_PX[1], SIZE_PX[0]), rings) > 0
            image = np.where(inside, 60.0, 200.0) + 3 * rng.standard_normal(inside.shape)
            image = cv2.GaussianBlur(image, (0, 0), 1.2).clip(0, 255).astype(np.uint8)
            labels = ["" if pd.isna(p) else str(p) for p in here["particle"]]
            colours = [(40, 200, 70) if label else (240, 160, 30) for label in labels]
            dust = [(60.0, 90.0, 5.0, "smaller than 8 px"), (300.0, 700.0, 6.0, "no contrast")]
            picture = draw_bubble_overlay(image, rings, labels, colours, rejected=dust)
            for kind, suffix, pixels in (
                ("overlays", "jpg", picture[..., ::-1]),
                ("binary", "png", draw_binary(image.shape, rings)),
            ):
                (folder / kind / camera).mkdir(parents=True, exist_ok=True)
                assert cv2.imwrite(str(folder / kind / camera / f"{frame:06d}.{suffix}"), pixels)


def write_folder(
    folder: Path, *, bubbles: int = 12, frames: int = 120, bias_px: float = 0.0, drawn: bool = True
) -> Path:
    rng = np.random.default_rng(5)
    tracks = _tracks(rng, _helices(rng, bubbles, frames), bias_px)
    detections = _detections(rng, tracks)
    folder.mkdir()
    (folder / "tracking.json").write_text(json.dumps(_content(tracks, detections, bias_px)))
    (folder / "run.json").write_text(json.dumps({"packages": {"numpy": "9.9"}, "seed": 3}))
    leading = ["frame", "camera", "particle"]
    detections = detections[leading + [n for n in detections if n not in leading]]
    for name, table in (
        ("tracks", tracks),
        ("detections", detections),
        ("events", _events(tracks)),
    ):
        table.to_csv(folder / f"{name}.csv", index=False)
    if drawn:
        _pictures(folder, rng, detections)
    return folder


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


class _Page(HTMLParser):
    """Text, section ids, what the page loads; fails on tags that do not close."""

    EMPTY = ("meta", "link", "img", "input", "br")
    LOADS = ("src", "href", "srcset", "data", "poster", "action", "background")

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.loads: list[str] = []
        self.text = ""
        self.feed(file.read_text(encoding="utf-8"))
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.EMPTY:
            self.open.append(tag)
        self.ids += [value or "" for name, value in attrs if name == "id" and tag == "section"]
        self.loads += [value or "" for name, value in attrs if name in self.LOADS]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.text += data


def _edit(folder: Path, **changes: Any) -> Path:
    file = folder / "tracking.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    return folder


def _edit_table(folder: Path, name: str, **columns: Any) -> Path:
    table = pd.read_csv(folder / f"{name}.csv")
    table.assign(**columns).to_csv(folder / f"{name}.csv", index=False)
    return folder


def test_page_is_whole_small_and_loads_nothing(whole: Path) -> None:
    page = _Page(whole / "report.html")
    assert (whole / "report.html").stat().st_size < 8e6
    assert page.ids == SECTIONS
    assert all(load.startswith("data:") for load in page.loads)
    drawn = [p for p in page.loads if p.startswith("data:image/svg+xml")]
    for picture in drawn:
        ET.fromstring(base64.b64decode(picture.split(",")[1]))
    assert len(drawn) == 2 + 3 + 4 + 1 + 3 + 2
    overlays = [p for p in page.loads if p.startswith("data:image/jpeg")]
    assert len(overlays) == 2 * len(WORST)
    assert sum(p.startswith("data:image/png") for p in page.loads) == 2 * len(WORST)


def test_page_says_what_the_files_say(whole: Path, results: TrackResults) -> None:
    text = _Page(whole / "report.html").text
    sd = np.median(1e3 * np.sqrt(results.tracks[["sxx_mm2", "syy_mm2", "szz_mm2"]]), axis=0)
    found = int(np.isfinite(results.detections["u_px"]).sum())
    for words in (
        f"12 tracks, {len(results.tracks)} positions in space, 120 frames",
        f"known to {sd[0]:.1f}, {sd[1]:.1f} and {sd[2]:.1f} µm in x, y and z",
        f"{100 * 2 * len(results.tracks) / found:.1f} % of them have a partner",
        "seen in 3 of 4 frames", 'two continuations, 1.2 nats apart, "unsafe", <cut>', "1, 2",
        "birth: 12, death: 12, break: 1.", "Frame 7: 3 bubbles without a partner",
        "an ambiguous pair & a break", "frames.csv has <no> times", "packages.numpy",
        "frames without: no image", "flag: border", "shape_sigma", "0.011, 0.004",
        "RMS for pairs left out of it, px", "of the measurement alone", "volume",
    ):  # fmt: skip
        assert words in text, words
    assert text.index("positions in space") < text.index("median length") < text.index("Events")


def test_ray_miss_prediction_is_the_propagated_pixel_noise(results: TrackResults) -> None:
    """Both v of SIGMA_PX / SCALE, independent: the difference has sqrt(2) of it."""
    sd = ray_miss_sd_mm(results)
    assert sd is not None
    np.testing.assert_allclose(sd, np.sqrt(2) * SIGMA_PX / SCALE, rtol=2e-3)
    assert ray_miss_ratio(results, sd) == pytest.approx(1.0, abs=0.12)
    assert verdict(results).colour == "good" and not verdict(results).warnings


def test_a_biased_calibration_is_named_first_and_seen_in_the_rays(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", bubbles=3, frames=59, bias_px=1.8, drawn=False)
    results = read_track_results(folder)
    told = verdict(results)
    assert told.colour == "usable"
    assert told.warnings == (
        "This is a calibration problem: the shared coordinate is off by 1.8 px.",
    )
    assert ray_miss_ratio(results, ray_miss_sd_mm(results)) > 10
    strays = ray_miss_in_space(results, results.up, "height").caption
    off_um = float(strays.split("up to ")[1].split(" ±")[0])
    assert off_um == pytest.approx(1e3 * 1.8 / SCALE, rel=0.1)


def test_shake_learnt_from_the_run_accounts_for_the_ray_miss(folder: Path) -> None:
    table = pd.read_csv(folder / "tracks.csv")
    rng = np.random.default_rng(8)
    _edit_table(folder, "tracks", ray_miss_mm=0.08 * rng.standard_normal(len(table)))
    quiet = read_track_results(folder)
    assert "Rays miss by" in verdict(quiet).warnings[0]
    pairs = quiet.pairs | {"frame_px": 1.5, "scatter_px": 0.2}
    results = read_track_results(_edit(folder, pairs=pairs))
    assert learnt_sd_mm(results) == pytest.approx(np.hypot(1.5, 0.2) / SCALE, rel=2e-3)
    assert not verdict(results).warnings
    assert "shake against each other (1.5 px from frame to frame)" in verdict(results).sentences[-1]


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
        assert counts[camera].sum() == (results.detections["camera"] == camera).sum()
    assert counts["both"].sum() == len(results.tracks)
    frame = int(results.tracks["frame"].iloc[40])
    assert counts["both"][frame] == (results.tracks["frame"] == frame).sum()


def test_nothing_optional(folder: Path) -> None:
    for name in OPTIONAL[:3]:
        (folder / name).unlink()
    content = json.loads((folder / "tracking.json").read_text())
    bare = {key: content[key] for key in ("schema", "kind")}
    (folder / "tracking.json").write_text(json.dumps(bare))
    text = _Page(write_track_report(folder)).text
    for words in (
        "No pictures in this folder", "There is no run.json", "Nothing is known of any event",
        "events.csv (no history", "detections.csv is not in this folder", "There are no notes",
        "How many bubbles the single images held is not known",
    ):  # fmt: skip
        assert words in text, words


def test_no_rows_for_a_camera_and_no_tracks(folder: Path) -> None:
    detections = pd.read_csv(folder / "detections.csv")
    detections[detections["camera"] == "left"].to_csv(folder / "detections.csv", index=False)
    tracks = (folder / "tracks.csv").read_text().splitlines()[0]
    (folder / "tracks.csv").write_text(tracks + "\n")
    (folder / "events.csv").write_text("frame,t_s,kind,particles,reason\n")
    _edit(folder, points=0, tracks=0, events={})
    results = read_track_results(folder)
    assert "No bubble was found in this camera" in seen_where(results, 1).caption
    text = _Page(write_track_report(folder)).text
    assert "No bubble was followed in 60 frames" in text
    assert 'class="verdict rejected"' in (folder / "report.html").read_text(encoding="utf-8")


def test_hostile_names_stay_text(folder: Path) -> None:
    evil = "</script><b>x"
    _edit(folder, run=evil, notes=[evil], worst_frames=[{"frame": 1, "score": 1, "why": evil}])
    _edit_table(folder, "events", kind=evil, reason=evil)
    _edit_table(folder, "detections", flags=evil)
    html = write_track_report(folder).read_text(encoding="utf-8")
    assert evil not in html and html.count("&lt;/script&gt;&lt;b&gt;x") > 4


def test_importing_the_report_draws_in_no_plotting_library() -> None:
    code = "import sys, telerig.io.report.track_report, telerig.io.report.bubble_overlay;"
    done = subprocess.run(
        [sys.executable, "-c", code + "print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert not {"matplotlib", "plotly", "cv2", "jinja2"} & set(done.stdout.split())


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("tracking.json", None, "no tracks here"),
        ("tracking.json", "{", "JSON"),
        ("tracking.json", '{"kind": "telerig calibration"}', "is not a tracks file"),
        ("tracking.json", '{"kind": "telerig tracks", "schema": 9}', "newer"),
        ("tracking.json", '{"kind": "telerig tracks", "schema": 1, "pairs": 3}', "garbles 'pairs'"),
        ("tracks.csv", None, "cannot be read"),
        ("tracks.csv", "frame,particle\n1,2\n", "its columns are of cameras"),
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
    assert "points are drawn" not in time_series(results, 0).caption


def test_scene_holds_every_point_with_up_upwards(results: TrackResults) -> None:
    scene = json.loads(track_scene_json(results))
    drawn = [
        point
        for trace in scene["data"]
        for point in zip(trace["x"], trace["y"], trace["z"])
        if None not in point
    ]
    truth = np.round(results.points_mm, 3)
    assert {tuple(p) for p in drawn} == {tuple(p) for p in truth.tolist()}
    camera = scene["layout"]["scene"]["camera"]
    assert camera["up"] == {"x": 0.0, "y": -1.0, "z": 0.0} and camera["eye"]["y"] < 0
    assert scene["layout"]["scene"]["yaxis"]["title"]["text"] == "y / mm"


def test_up_from_the_file_turns_heights_round(folder: Path) -> None:
    down = read_track_results(folder).height_mm
    np.testing.assert_allclose(read_track_results(_edit(folder, up=[0, 2, 0])).height_mm, -down)
    assert "turned round" not in time_series(read_track_results(folder), 1).caption
    with pytest.raises(InputError, match="garbles 'up'"):
        read_track_results(_edit(folder, up=[1, 2]))


def test_many_events_are_counted(folder: Path) -> None:
    table = pd.read_csv(folder / "events.csv")
    pd.concat([table] * 20).to_csv(folder / "events.csv", index=False)
    words = event_words(read_track_results(_edit(folder, events={})))
    assert "break: 20" in words and f"{20 * len(table) - 60} more are in events.csv" in words


def test_pictures_beyond_the_budget_shrink_and_the_page_stays_small(
    whole: Path, results: TrackResults, monkeypatch: pytest.MonkeyPatch
) -> None:
    columns = ["left", "left, binary"]
    size = sum(file.stat().st_size for file in results.pictures.values())
    frames = [f"{frame:06d}" for frame in WORST]
    make = {"small_width_px": 200, "budget_bytes": size - 1}
    small = sheets.picture_sheet(frames, columns, results.pictures, **make)
    assert small.shrunk and small.linked == 0
    png = base64.b64decode(small.views[1][1][1].source.split(",")[1])
    assert cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED).shape[1] == 200
    none = sheets.picture_sheet(frames, columns, results.pictures, budget_bytes=0)
    assert none.linked == 4 and none.views[0][1][1].link == "binary/left/000007.png"


def _repeated(file: Path, times: int, frames: int) -> int:
    """The table so many times, one after the other in time; its number of rows."""
    header, *rows = file.read_text().splitlines()
    parts = [row.split(",", 1) for row in rows]
    longer = [f"{int(f) + k * frames},{rest}" for k in range(times) for f, rest in parts]
    file.write_text("\n".join([header, *longer]) + "\n")
    return len(longer)


def test_a_hundred_thousand_rows_are_thinned_and_cheap(folder: Path) -> None:
    times = 100_000 // len(pd.read_csv(folder / "tracks.csv")) + 1
    assert _repeated(folder / "tracks.csv", times, 60) > 100_000
    assert _repeated(folder / "detections.csv", times, 60) > 200_000
    before = sum(os.times()[:4])
    page = write_track_report(folder)
    assert sum(os.times()[:4]) - before < 15
    assert page.stat().st_size < 8e6
    assert "are drawn" in page.read_text(encoding="utf-8")


def test_binary_picture_has_the_outlines_area_and_place() -> None:
    ring = _ring(33.3, 20.8, 12.0)
    picture = draw_binary((60, 80), [ring, np.full((5, 2), np.nan)])
    assert picture.shape == (60, 80) and set(np.unique(picture)) == {0, 255}
    v, u = np.nonzero(picture)
    assert len(u) == pytest.approx(np.pi * 12**2, rel=0.01)
    assert (u.mean(), v.mean()) == (pytest.approx(33.3, abs=0.05), pytest.approx(20.8, abs=0.05))
    cut = draw_binary((60, 80), [_ring(0, 0, 12.0)], max_width_px=40)
    assert cut.shape == (30, 40) and np.count_nonzero(cut) == pytest.approx(
        np.pi * 6**2 / 4 + 6, rel=0.15
    )


def test_overlay_draws_each_outline_where_it_is() -> None:
    image = np.full((200, 300), 180, np.uint16)
    rings = [_ring(80.5, 90.25, 30), _ring(210.0, 100.0, 20)]
    colours = [(10, 250, 20), (20, 30, 250)]
    picture = draw_bubble_overlay(image, rings, ["", ""], colours)
    assert picture.dtype == np.uint8 and picture.shape[1:] == (300, 3) and len(picture) > 200
    for channel, other, (u, v), radius in (
        (1, 2, (80.5, 90.25), 30.0),
        (2, 1, (210.0, 100.0), 20.0),
    ):
        excess = picture[:200, :, channel].astype(int) - picture[:200, :, other]
        rows, columns = np.nonzero(excess > 60)
        np.testing.assert_allclose(np.hypot(columns - u, rows - v), radius, atol=1.3)
        assert columns.mean() == pytest.approx(u, abs=0.2)
    half = draw_bubble_overlay(image, rings, ["7", "8"], colours, max_width_px=150)
    assert half.shape[1] == 150


def test_overlay_tells_why_something_was_rejected() -> None:
    image = np.full((120, 200), 90.0)
    dust = [(50.0, 40.0, 6.0, "too small"), (150.0, 60.0, float("nan"), "too small")]
    bare = draw_bubble_overlay(image, [], [])
    told = draw_bubble_overlay(image, [], [], rejected=dust)
    assert len(told) > len(bare) > 120
    rows, columns = np.nonzero(told[:120, :, 0].astype(int) - told[:120, :, 1] > 60)
    assert {tuple(p) for p in np.c_[columns, rows] // 100} >= {(0, 0), (1, 0)}
    with pytest.raises(InputError, match="grey image"):
        draw_bubble_overlay(np.zeros((4, 4, 3)), [], [])
    with pytest.raises(InputError, match="1 outlines, 0 labels"):
        draw_bubble_overlay(image, [_ring(5, 5, 3)], [])


def test_empty_bright_image_stays_bright() -> None:
    rng = np.random.default_rng(2)
    image = (200 + rng.standard_normal((80, 90))).astype(np.uint8)
    assert draw_bubble_overlay(image, [], [])[:80].min() > 150
