"""The report of a smoothed run: from files to one page, and its numbers against known signals."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from telerig.errors import InputError
from telerig.io.report import track_report
from telerig.io.report.figures_common import Picture
from telerig.io.report.smoothing_drawing import thin_band, thin_line
from telerig.io.report.smoothing_numbers import (
    axis_sd,
    evenly,
    shake_lines,
    shake_rms_um,
    shake_spectrum,
    taken_away,
    velocity_spectrum,
)
from telerig.io.report.smoothing_report import smoothing_drawings
from telerig.io.report.smoothing_results import SmoothingResults, read_smoothing_results
from telerig.io.report.smoothing_tables import constant_rows, mode_rows
from telerig.io.report.smoothing_words import axis_table, smoothing_verdict
from telerig.io.report.track_report import write_track_report
from telerig.io.report.track_results import read_track_results

RATE_HZ, SD_MM, SD_MM_S = 500.0, 0.02, 4.0
COMMON_HZ, ARM_HZ, COMMON_UM, ARM_UM = 20.0, 45.0, 120.0, 50.0
TRACKING = ["verdict", "key", "space", "time", "rays", "quality", "images", "worst", "events"]
TRACKING += ["notes", "more", "origin"]
SMOOTHING = ["smoothing", "smoothing-key", "lab", "taken", "velocity", "shake", "spectra"]
SMOOTHING += ["residuals", "constants", "priors"]
AXES = {
    name: {"verdict": "RESOLVED", "flags": [], "q": q, "eta": 0.9961, "sigma_mm": 0.0231,
           "sigma_shake_known_mm": 0.0222, "shake_rms_mm": 0.13, "lines": []}
    for name, q in zip("xyz", (1.01, 1.07, 1.02))
}  # fmt: skip


def _tracks(frames: int, bubbles: int) -> pd.DataFrame:
    """What the tracking part of the page needs of tracks.csv."""
    frame = np.tile(np.arange(frames), bubbles)
    particle = np.repeat(np.arange(bubbles), frames)
    rng = np.random.default_rng(2)
    table = pd.DataFrame({"frame": frame, "particle": particle, "t_s": frame / RATE_HZ})
    table[["x_mm", "y_mm", "z_mm"]] = rng.uniform(-5, 5, (len(table), 3))
    table[["sxx_mm2", "syy_mm2", "szz_mm2"]] = 1e-3
    table[["sxy_mm2", "sxz_mm2", "syz_mm2"]] = 0.0
    for camera in ("left", "right"):
        table[[f"{camera}_u_px", f"{camera}_v_px"]] = rng.uniform(0, 900, (len(table), 2))
        table[[f"{camera}_suu_px2", f"{camera}_svv_px2"]] = 0.25
        table[f"{camera}_suv_px2"] = 0.0
    return table.assign(ray_miss_mm=0.01, d_eq_mm=4.0, confidence=1.0)


def _shake(rng: np.random.Generator, frames: int) -> pd.DataFrame:
    """On y a line that both cameras share and one of the left arm; left x alone sees a third."""
    t = np.arange(frames) / RATE_HZ

    def tone(hz: float, rms_um: float) -> Any:
        return 1e-3 * np.sqrt(2) * rms_um * np.sin(2 * np.pi * (hz * t + rng.random()))

    common, arm, alone = tone(COMMON_HZ, COMMON_UM), tone(ARM_HZ, ARM_UM), tone(80.0, 30.0)
    table = pd.DataFrame({"frame": np.arange(frames), "t_s": t})
    for camera, x, y, z in (("left", alone, common + arm, 0.0), ("right", 0.0, common, 0 * t)):
        table[f"{camera}_x_mm"], table[f"{camera}_y_mm"], table[f"{camera}_z_mm"] = x, y, z
        table[[f"s{camera}_x_mm", f"s{camera}_y_mm", f"s{camera}_z_mm"]] = 0.005
    table["right_z_mm"] = 1e-4 * rng.standard_normal(frames)
    return table.assign(position_mm=280 * t, sposition_mm=1e-3)


def _trajectories(rng: np.random.Generator, tracks: pd.DataFrame, shake: pd.DataFrame) -> Any:
    """Straight rise and a zigzag; naive carries the shake on y, RTS half of it."""
    t = tracks["t_s"].to_numpy()
    table = tracks[["frame", "particle", "t_s"]].copy()
    turn = 2 * np.pi * 6.0 * t + tracks["particle"].to_numpy()
    true = {"x": 3 * np.sin(turn), "y": -280 * t, "z": 3 * np.cos(turn)}
    speed = {"x": 36 * np.pi * np.cos(turn), "y": -280 + 0 * t, "z": -36 * np.pi * np.sin(turn)}
    moved = shake["left_y_mm"].to_numpy()[tracks["frame"]]
    moving = np.gradient(shake["left_y_mm"].to_numpy(), 1 / RATE_HZ)[tracks["frame"]]
    for axis in "xyz":
        noise = SD_MM * rng.standard_normal(len(t))
        off = moved if axis == "y" else noise
        off_speed = moving if axis == "y" else 20 * rng.standard_normal(len(t))
        for kind, part in (("", 0.0), ("naive_", 1.0), ("rts_", 0.5)):
            table[f"{kind}{axis}_mm"] = true[axis] + part * off
            table[f"{kind}v{axis}_mm_s"] = speed[axis] + part * off_speed
        table[f"s{axis}_mm"], table[f"sv{axis}_mm_s"] = SD_MM, SD_MM_S
    table["observed"] = 1
    blind = table["frame"].isin([40, 41, 42])
    table.loc[blind, "observed"] = 0
    naive = [n for n in table if n.startswith("naive_")]
    table.loc[blind, naive] = np.nan
    return table


def _content() -> dict[str, Any]:
    return {
        "verdict": "RESOLVED", "flags": [], "axes": AXES, "remedy": "",
        "words": "x: told apart (23 um). y (vertical): told apart (13 um). z: told apart (23 um).",
        "modes": [], "schema": 1, "cameras": ["left", "right"], "frames": 600, "bubbles": 2,
        "model": {
            "bubble": {"velocity_sigma_mm_s": 10.0, "zigzags": []}, "modes": [],
            "broad_bands": [{"rms_mm": [0.06, 0.13, 0.1], "camera": 0, "low_hz": 22.984973269}],
            "pitches": [], "carriage": {"kind": "force", "servo": None},
            "pixel_inflation": 0.945, "name": "default", "learned": {},
        },
        "unseen": {"left": "along its depth, (0, 0, 1) in rig axes",
                   "right": "along its depth, (-1, 0.00693, 0.0122) in rig axes"},
        "residuals": {"bubbles": {"pixels": 2400, "outliers": 12, "rms_sigmas": 0.933,
                                  "median_sigmas": 0.908}, "references": {"pixels": 0}},
        "encoder": {"scale": 1.0101, "sscale": 0.0001},
        "accelerometers": {"arm_left": {"bias_x_mm_s2": 223.7997, "sbias_x_mm_s2": 0.598,
                                        "delay_s": 1.02e-3, "sdelay_s": 3.1e-5}},
        "bubble_means": {"0": {"x_mm_s": 0.02, "y_mm_s": -281.04, "z_mm_s": -1.37,
                               "sx_mm_s": 5.7, "sy_mm_s": 5.4, "sz_mm_s": 5.7}},
    }  # fmt: skip


def write_folder(folder: Path, *, frames: int = 600, bubbles: int = 2) -> Path:
    rng = np.random.default_rng(4)
    folder.mkdir()
    tracks, shake = _tracks(frames, bubbles), _shake(rng, frames)
    tracking = {"schema": 1, "kind": "telerig tracks", "run": "rise <3>", "frames": frames}
    (folder / "tracking.json").write_text(json.dumps(tracking))
    (folder / "smoothing.json").write_text(json.dumps(_content()))
    tracks.to_csv(folder / "tracks.csv", index=False)
    shake.to_csv(folder / "shake.csv", index=False)
    _trajectories(rng, tracks, shake).to_csv(folder / "trajectories.csv", index=False)
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with its page, which no test changes."""
    folder = write_folder(tmp_path_factory.mktemp("once") / "r")
    write_track_report(folder)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "r", frames=80, bubbles=1)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's words without its drawings, which take seconds."""
    blank = Picture("", "data:,", "")
    monkeypatch.setattr(track_report, "drawn_over_cores", lambda drawings: [blank] * len(drawings))


def _captions(folder: Path) -> str:
    """Titles and captions of all the smoothing's drawings."""
    drawn = [draw() for _, draw in smoothing_drawings(_read(folder))]
    return " ".join(f"{p.title}: {p.caption}" for p in drawn if p is not None)


class _Page(HTMLParser):
    """Text, section ids, pictures; fails on tags that do not close."""

    EMPTY = ("meta", "link", "img", "input", "br")

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.loads: list[str] = []
        self.text = ""
        self.feed(file.read_text(encoding="utf-8"))
        assert self.open == []
        self.text = re.sub(r"\s+", " ", self.text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.EMPTY:
            self.open.append(tag)
        self.ids += [value or "" for name, value in attrs if name == "id" and tag == "section"]
        self.loads += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.text += data + " "


def _read(folder: Path) -> SmoothingResults:
    results = read_smoothing_results(folder, np.array([0.0, -1.0, 0.0]))
    assert results is not None
    return results


def _edit(folder: Path, *without: str, **changes: Any) -> Path:
    file = folder / "smoothing.json"
    content = json.loads(file.read_text()) | changes
    file.write_text(json.dumps({k: v for k, v in content.items() if k not in without}))
    return folder


def _judged(folder: Path) -> Any:
    return smoothing_verdict(_read(folder), read_track_results(folder))


def test_page_begins_with_the_smoothing_and_loads_nothing(whole: Path) -> None:
    page = _Page(whole / "report.html")
    assert page.ids == SMOOTHING + TRACKING
    assert (whole / "report.html").stat().st_size < 8e6
    assert all(load.startswith("data:") for load in page.loads)
    for picture in (p for p in page.loads if p.startswith("data:image/svg+xml")):
        ET.fromstring(base64.b64decode(picture.split(",")[1]))
    drawn = [p for p in page.loads if p.startswith("data:image/")]
    of_smoothing, of_tracking = 3 + 3 + 3 + 3 + 4 + 3 + 2, 2 + 3 + 4 + 1 + 3 + 2
    assert len(drawn) == of_smoothing + of_tracking


def test_page_says_what_the_files_say(whole: Path) -> None:
    text = _Page(whole / "report.html").text
    for words in (
        "RESOLVED: the bubbles' motion and the rig's shake are told apart",
        "y (vertical): told apart (13 µm).", "sd, µm 23.1 23.1 23.1",
        "q 1.01 1.07 1.02", "η 0.9961 0.9961 0.9961",
        "shake of left, µm 30.0", "verdict RESOLVED RESOLVED RESOLVED", "y (down)",
        "Camera left looks along z and does not see its own shake there",
        "Camera right looks along x", "bubbles 2 400 12 0.5 % 0.933 0.908",
        "arm_left bias x, mm/s² 223.80 ± 0.60", "arm_left delay, ms 1.020 ± 0.031",
        "encoder scale 1.01010 ± 0.00010", "0.0 ± 5.7 -281.0 ± 5.4 -1.4 ± 5.7",
        "multiplied by 0.945", "default: fixed priors", "broad bands[0]: camera left",
        "broad bands[0]: low, Hz 22.98", "3 frames without",
        "The tracking beneath", "2 tracks",
    ):  # fmt: skip
        assert words in text, words
    assert text.index("RESOLVED") < text.index("Position, 1 sd") < text.index("2 tracks")
    html = (whole / "report.html").read_text(encoding="utf-8")
    assert 'class="verdict good" id="smoothing"' in html


@pytest.mark.usefixtures("undrawn")
def test_without_smoothing_the_page_is_of_the_tracking_alone(folder: Path) -> None:
    (folder / "smoothing.json").unlink()
    (folder / "trajectories.csv").write_text("rubbish")
    page = _Page(write_track_report(folder))
    assert page.ids == TRACKING
    assert "smooth" not in page.text.lower() and "report of a tracked run" in page.text


@pytest.mark.parametrize(
    ("word", "colour", "headline"),
    [
        ("RESOLVED", "good", "are told apart"),
        ("PARTIAL", "usable", "told apart in part"),
        ("UNRESOLVED", "rejected", "do not tell the bubbles' motion from the rig's shake"),
        (None, "usable", "Not judged"),
        ("NEW_WORD", "usable", "NEW WORD"),
    ],
)
def test_each_verdict_has_its_words_colour_and_remedy(
    folder: Path, word: str | None, colour: str, headline: str
) -> None:
    _edit(folder, "words", "axes", "remedy", verdict=word)
    told = _judged(folder)
    assert (told.colour, told.warnings) == (colour, ())
    assert headline in told.headline
    remedied = any("strip of dots" in s and "accelerometer" in s for s in told.sentences)
    assert remedied == (word in ("PARTIAL", "UNRESOLVED"))


def test_the_remedy_of_the_file_is_said_once(folder: Path) -> None:
    remedy = "fix a strip of dots to the tank"
    _edit(folder, verdict="UNRESOLVED", remedy=remedy, words="x: cannot be told apart.")
    assert _judged(folder).sentences[-1] == f"To resolve it: {remedy}"
    _edit(folder, words=f"x: cannot be told apart. To resolve it: {remedy}.")
    told = _judged(folder)
    assert told.sentences[1:] == ("x: cannot be told apart.", f"To resolve it: {remedy}.")


def test_flags_are_explained_and_only_the_harmful_ones_warn(folder: Path) -> None:
    _edit(folder, flags=["SHAKE_BELOW_NOISE"])
    told = _judged(folder)
    assert told.colour == "good" and "does no harm" in told.sentences[-1]
    _edit(folder, flags=["LABEL_AMBIGUOUS", "ODD_ONE"])
    told = _judged(folder)
    assert told.colour == "usable" and len(told.warnings) == 2
    assert "do not say whose it is" in told.warnings[0] and "odd one" in told.warnings[1]


@pytest.mark.usefixtures("undrawn")
def test_nothing_judged_and_nothing_optional(folder: Path) -> None:
    _edit(folder, "verdict", "axes", "words", "model", "residuals", "unseen", "cameras", "schema",
          "bubble_means", "encoder", "accelerometers", "modes", "flags", "remedy")  # fmt: skip
    table = pd.read_csv(folder / "trajectories.csv")
    kept = ["frame", "particle", "t_s", *(f"{a}_mm" for a in "xyz"), *(f"v{a}_mm_s" for a in "xyz")]
    table[kept].to_csv(folder / "trajectories.csv", index=False)
    shake = pd.read_csv(folder / "shake.csv")
    shake = shake[[n for n in shake if not n.startswith(("sl", "sr", "sp", "pos"))]]
    shake.to_csv(folder / "shake.csv", index=False)
    page = _Page(write_track_report(folder))
    assert page.ids == SMOOTHING + TRACKING
    for words in ("Not judged", "holds no verdict per axis", "No constant of encoder"):
        assert words in page.text, words
    captions = _captions(folder)
    assert "nan" not in f"{page.text} {captions}".lower().split()
    assert "There is no naive trajectory to compare with" in captions


@pytest.mark.usefixtures("undrawn")
def test_lines_that_could_be_the_others_are_listed(folder: Path) -> None:
    line = {"owner": "bubble", "frequency_hz": 12.1, "rms_mm": 0.2, "ambiguous": True,
            "other_owner_costs_nats": 0.42}  # fmt: skip
    sure = line | {"owner": "rig", "frequency_hz": 31.0, "ambiguous": False,
                   "other_owner_costs_nats": 14.04}  # fmt: skip
    free = line | {"other_owner_costs_nats": -1e-6}
    _edit(folder, flags=["LABEL_AMBIGUOUS"],
          axes=AXES | {"y": AXES["y"] | {"lines": [line, sure]},
                       "z": AXES["z"] | {"lines": [free]}})  # fmt: skip
    text = _Page(write_track_report(folder)).text
    assert "Whose is the line?" in text
    assert "12.1 y, z 200, 200 0.0 bubble open" in text
    assert "31.0 y 200 14.0 rig told by the data" in text


def test_tables_of_another_tracking_are_named(folder: Path) -> None:
    tracks = pd.read_csv(folder / "tracks.csv")
    tracks.assign(particle=7).to_csv(folder / "tracks.csv", index=False)
    told = _judged(folder)
    assert "Bubbles 0 of trajectories.csv are not in tracks.csv" in told.warnings[-1]
    assert told.colour == "usable"


def test_numbers_are_those_of_the_signals(whole: Path) -> None:
    results = _read(whole)
    assert axis_sd(results) == [SD_MM] * 3 and axis_sd(results, "v{}_mm_s") == [SD_MM_S] * 3
    away = taken_away(results)
    moved_um = np.hypot(COMMON_UM, ARM_UM)
    assert away[1] == pytest.approx(1e-3 * moved_um, rel=0.02)
    assert taken_away(results, "rts_")[1] == pytest.approx(0.5e-3 * moved_um, rel=0.02)
    assert shake_rms_um(results, "right", "y") == pytest.approx(COMMON_UM, rel=0.01)
    assert shake_rms_um(results, "right", "x") is None
    assert results.bubbles == (0, 1) and results.rate_hz == pytest.approx(RATE_HZ)


def test_depth_is_read_from_the_file_else_from_what_stands_still(folder: Path) -> None:
    results = _read(folder)
    assert (results.unseen("left"), results.unseen("right")) == (("z",), ("x",))
    oblique = {"left": "along its depth, (0.643, 0, 0.766) in rig axes"}
    results = _read(_edit(folder, unseen=oblique))
    assert results.unseen("left") == () and results.seen("left") == ("x", "y", "z")
    np.testing.assert_allclose(results.depth("left"), [0.643, 0, 0.766], atol=1e-3)
    results = _read(_edit(folder, "unseen"))
    assert (results.unseen("left"), results.unseen("right")) == (("z",), ("x",))


def test_spectra_obey_parseval_and_show_the_lines(whole: Path) -> None:
    results = _read(whole)
    shake = shake_spectrum(results, "left")
    assert shake is not None
    variance = shake.density.sum(0) * shake.step_hz
    np.testing.assert_allclose(variance[0], 30.0**2, rtol=0.05)
    np.testing.assert_allclose(variance[1], COMMON_UM**2 + ARM_UM**2, rtol=0.05)
    at = shake.frequency_hz[np.argmax(shake.density[:, 1])]
    assert at == pytest.approx(COMMON_HZ, abs=shake.step_hz)
    naive, smooth = velocity_spectrum(results, "naive_"), velocity_spectrum(results)
    assert naive is not None and smooth is not None
    near = np.argmin(np.abs(naive.frequency_hz - COMMON_HZ))
    assert naive.density[near, 1] > 1e3 * smooth.density[near, 1]


def test_lines_of_the_shake_are_found_and_placed(whole: Path) -> None:
    lines = shake_lines(_read(whole))
    found = {(line.axis, round(line.frequency_hz)): line for line in lines}
    common = min(lines, key=lambda x: abs(x.frequency_hz - COMMON_HZ))
    arm = min(lines, key=lambda x: abs(x.frequency_hz - ARM_HZ))
    alone = min(lines, key=lambda x: abs(x.frequency_hz - 80))
    assert (common.where, common.axis, common.alone) == ("common", "y", False)
    assert (arm.where, arm.axis) == ("left", "y")
    assert (alone.where, alone.axis, alone.alone) == ("left", "x", True)
    for line, rms in ((common, COMMON_UM), (arm, ARM_UM), (alone, 30.0)):
        assert line.rms_um == pytest.approx(rms, rel=0.1)
        assert line.upper and line.frequency_hz == pytest.approx(line.frequency_hz, abs=2.5)
    assert lines[0] is common and len(found) == len(lines)


def test_a_damped_modes_damping_is_measured(folder: Path) -> None:
    """White force through one oscillator of damping 0.05, against the truth."""
    rng, zeta, hz, frames = np.random.default_rng(6), 0.05, 25.0, 20_000
    w, dt = 2 * np.pi * hz, 1 / RATE_HZ
    state, out = np.zeros(2), np.empty(frames)
    damped = w * np.sqrt(1 - zeta**2)
    c, s, e = np.cos(damped * dt), np.sin(damped * dt), np.exp(-zeta * w * dt)
    step = e * np.array([[c + zeta * w / damped * s, s / damped],
                         [-(w**2) / damped * s, c - zeta * w / damped * s]])  # fmt: skip
    for i, force in enumerate(rng.standard_normal(frames)):
        state = step @ state + [0.0, force]
        out[i] = state[0]
    out *= 0.1 / out.std()
    shake = pd.DataFrame({"frame": np.arange(frames), "t_s": np.arange(frames) * dt})
    for camera in ("left", "right"):
        shake[[f"{camera}_x_mm", f"{camera}_y_mm", f"{camera}_z_mm"]] = 0.0
        shake[f"{camera}_y_mm"] = out
    shake.to_csv(folder / "shake.csv", index=False)
    (line,) = shake_lines(_read(folder))
    assert line.where == "common" and not line.upper
    assert line.frequency_hz == pytest.approx(hz, rel=0.04)
    assert line.damping == pytest.approx(zeta, rel=0.35)
    assert line.rms_um == pytest.approx(100.0, rel=0.15)


def test_modes_of_the_model_come_with_what_a_mechanic_can_do(folder: Path) -> None:
    modes = [
        {"frequency_hz": 20.0, "damping": 0.03, "rms_mm": [0, 0.12, 0], "camera": -1},
        {"frequency_hz": 32.0, "damping": 0.01, "rms_mm": [0.02, 0.05, 0], "camera": 1},
    ]
    pitch = {"frequency_hz": 14.0, "damping": 0.02, "rms_rad": 1e-4, "camera": 0}
    model = _content()["model"] | {"modes": modes, "pitches": [pitch]}
    rows, words = mode_rows(
        _read(_edit(folder, model=model | {"carriage": {"servo": [0.1, 15, 0.3]}}))
    )
    common, arm, turning, servo = (row.cells for row in rows)
    assert common[:4] == ("all cameras alike (carriage, mount)", "20.0", "0.0300", "y: 120")
    assert arm[0] == "arm of right" and arm[3] == "x: 20.0, y: 50.0"
    assert "shorter" in arm[4] and "damping layer" in arm[4] and "damping layer" not in common[4]
    assert "turning" in turning[0] and "controller" in servo[4] and "15" in servo[4]
    assert "model" in words


def test_a_mode_learned_axis_by_axis_is_one_row(folder: Path) -> None:
    mode = {"where": "common", "frequency_hz": 20.36, "damping": 0.028, "source": "model"}
    parts = [mode | {"rms_mm": [0.0, 0.075, 0.0]}, mode | {"rms_mm": [0.063, 0.0, 0.064]}]
    rows, _ = mode_rows(_read(_edit(folder, modes=parts)))
    assert [row.cells[3] for row in rows] == ["x: 63.0, y: 75.0, z: 64.0"]


def test_given_remedies_of_the_modes_are_shown(folder: Path) -> None:
    row = {"where": "arm left", "frequency_hz": 31.0, "damping": 0.02, "rms_mm": [0.0, 0.02, 0.0],
           "source": "model", "remedy": "brace it <here>"}  # fmt: skip
    servo = row | {"where": "servo", "remedy": "less gain", "source": "estimate"}
    rows, _ = mode_rows(_read(_edit(folder, modes=[row, servo])))
    assert [r.cells[0] for r in rows] == ["arm of left", "servo (following error)"]
    assert [r.cells[4] for r in rows] == ["brace it <here>", "less gain"]


@pytest.mark.usefixtures("undrawn")
def test_no_bubbles_leaves_the_shake(folder: Path) -> None:
    (folder / "trajectories.csv").write_text("frame,particle,t_s\n")
    _edit(folder, "verdict", "axes", "words", bubbles=0)
    page = _Page(write_track_report(folder))
    assert "No bubble was smoothed" in page.text and "velocity" not in page.ids
    captions = _captions(folder)
    assert "Shake of camera left in y" in captions and "Velocity" not in captions


def test_short_runs_have_no_spectra(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", frames=20, bubbles=1)
    results = _read(folder)
    assert shake_spectrum(results, "left") is None and velocity_spectrum(results) is None
    assert shake_lines(results) == []
    assert "Spectrum" not in _captions(folder) and "Velocity in y" in _captions(folder)


def test_thinning_loses_no_excursion() -> None:
    t = np.arange(50_000.0)
    values = np.sin(t)
    values[31_234] = 40.0
    values[10_000:12_000] = np.nan
    thin_t, thin = thin_line(t, values)
    assert len(thin) < 1_000 and np.nanmax(thin) == 40.0 and np.isnan(thin).any()
    assert np.all(np.diff(thin_t) >= 0)
    _, low, high = thin_band(t, values - 1, values + 1)
    assert np.nanmax(high) == 41.0 and np.nanmin(low) == pytest.approx(-2.0, abs=1e-6)


def test_evenly_fills_gaps_with_straight_lines() -> None:
    t = np.array([0.0, 0.1, 0.2, 0.5, 0.6])
    even, rate = evenly(t, np.stack([2 * t, np.where(t == 0.2, np.nan, t)], 1))
    assert rate == pytest.approx(10.0) and len(even) == 7
    grid = np.linspace(0, 0.6, 7)
    np.testing.assert_allclose(even, np.stack([2 * grid, grid], 1), atol=1e-12)


def test_long_runs_stay_small(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", frames=2_500, bubbles=2)
    drawn = [draw() for _, draw in smoothing_drawings(_read(folder))]
    assert sum(len(p.source) for p in drawn) < 2e6
    text = " ".join(p.caption for p in drawn)
    assert "Bubble 0, the longest track, 1\u202f000 frames of its middle." in text
    assert "1\u202f000 frames of the run's middle" in text


@pytest.mark.usefixtures("undrawn")
def test_hostile_names_stay_text(folder: Path) -> None:
    evil = "</script><b>x"
    _edit(folder, verdict=evil, flags=[evil], words=[evil],
          accelerometers={evil: {"scale": 1.0}},
          residuals={evil: {"pixels": 3, "outliers": 0}})  # fmt: skip
    html = write_track_report(folder).read_text(encoding="utf-8")
    assert evil not in html and html.count("&lt;/script&gt;&lt;b&gt;x") >= 4


def test_constants_without_sd_are_shown_bare(folder: Path) -> None:
    sensors = {"a": {"bias_x_mm_s2": 12.345678, "scale": None, "delay_s": 0.0}}
    rows = constant_rows(_read(_edit(folder, accelerometers=sensors, encoder={})))
    assert [row.cells for row in rows] == [
        ("a", "bias x, mm/s²", "12.35"), ("a", "scale", "not available"), ("a", "delay, ms", "0"),
    ]  # fmt: skip


def test_axis_table_is_complete_without_a_verdict(folder: Path) -> None:
    heads, rows = axis_table(_read(_edit(folder, "axes")))
    assert heads == ["", "x", "y (down)", "z"]
    found = {row.cells[0]: row.cells[1:] for row in rows}
    assert found["sd, µm"] == ("20.0",) * 3 and found["sd of velocity, mm/s"] == ("4.00",) * 3
    assert found["shake of left, µm"][2] == "unseen" and found["shake of right, µm"][0] == "unseen"


def test_importing_the_report_draws_in_no_heavy_library_nor_the_estimator() -> None:
    code = "import sys, telerig.io.report.track_report; print(*sys.modules)"
    run = [sys.executable, "-c", code]
    done = subprocess.run(run, capture_output=True, text=True, check=True).stdout.split()
    assert not {"matplotlib", "plotly", "scipy.signal", "jinja2"} & set(done)
    assert not [name for name in done if name.startswith("telerig.estimator")]


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("smoothing.json", "{", "JSON"),
        ("smoothing.json", "[]", "not an object"),
        ("smoothing.json", '{"schema": 9}', "newer"),
        ("smoothing.json", '{"verdict": 3}', "garbles 'verdict'"),
        ("smoothing.json", '{"flags": "A"}', "garbles 'flags'"),
        ("smoothing.json", '{"model": []}', "garbles 'model'"),
        ("smoothing.json", '{"cameras": ["left"]}', "smoothing.json's are ['left']"),
        ("shake.csv", None, "cannot be read"),
        ("shake.csv", "frame,t_s\n0,0\n", "its columns are of cameras"),
        ("trajectories.csv", None, "cannot be read"),
        ("trajectories.csv", "frame,particle\n1,2\n", "t_s"),
        ("trajectories.csv", "frame,particle,t_s\n1,2,3\n", "no column x_mm"),
        ("trajectories.csv", "frame,particle,t_s,x_mm\n1,2,3,a\n", "row 2, column x_mm"),
        ("trajectories.csv", "frame,particle,t_s,x_mm\n1,2,3\n", "row 2: has 3 cells"),
    ],
)
def test_bad_files_are_named(folder: Path, file: str, content: str | None, words: str) -> None:
    if content is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(content)
    before = list(folder.iterdir())
    with pytest.raises(InputError) as caught:
        write_track_report(folder)
    assert words in str(caught.value) and file in str(caught.value)
    assert list(folder.iterdir()) == before


@pytest.mark.parametrize(
    ("file", "whose"), [("shake.csv", ""), ("trajectories.csv", " of bubble 0")]
)
def test_times_that_do_not_increase_are_named(folder: Path, file: str, whose: str) -> None:
    table = pd.read_csv(folder / file)
    table.loc[30, "t_s"] = table.loc[29, "t_s"]
    table.to_csv(folder / file, index=False)
    with pytest.raises(InputError, match=f"times{whose} do not increase at frame 30"):
        write_track_report(folder)
