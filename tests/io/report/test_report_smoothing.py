"""The report of a smoothed run: from files to one page."""

from __future__ import annotations

import base64
import re
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from report_page import Page
from smoothed_folder import changed, read, write_folder

import telerig
from telerig.errors import InputError
from telerig.estimator.bubbles.shape.shapes import Shapes
from telerig.io.exchange.export.run_results import read_results
from telerig.io.report.page.figures import Figure, drawn
from telerig.io.report.plot.spectrum import shake_spectrum, velocity_spectrum
from telerig.io.report.run.bubbles import bubble_figures
from telerig.io.report.run.report import write_track_report
from telerig.io.report.run.smoothing import smoothing_verdict, use_rows
from telerig.io.results.verdict_words import uses_words, words_of_refusals

LAST = ["rays", "images", "more", "origin"]
SMOOTHING = ["verdict", "look", "smoothing-key", "axes", "lab", "shake", "residuals", "tracking"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with its page, which no test changes."""
    folder = write_folder(tmp_path_factory.mktemp("once") / "r", frames=300)
    write_track_report(folder)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "r", frames=80, bubbles=1)


def _titles(folder: Path) -> set[str]:
    """Titles of the figures of a page that is made again."""
    page = write_track_report(folder).read_text(encoding="utf-8")
    return set(re.findall("<h3>(.*?)</h3>", page))


def drawn_words(folder: Path, title: str) -> str:
    """What stands below a figure of the bubbles."""
    return next(one.caption for one in bubble_figures(read(folder)) if one.title == title)


def _judged(folder: Path) -> Any:
    return smoothing_verdict(read(folder))


def test_page_begins_with_the_smoothing_and_loads_nothing(whole: Path) -> None:
    page = Page(whole / "report.html")
    assert page.ids == [*SMOOTHING, *LAST]
    assert (whole / "report.html").stat().st_size < 5e6
    assert all(load.startswith(("data:", "#")) for load in page.loads)
    of_smoothing, of_tracking = 3 + 2 + 3 + 3 + 3, 2
    assert page.pictures("svg+xml") and len(page.pictures("")) == of_smoothing + of_tracking


def test_page_says_what_the_files_say(whole: Path) -> None:
    text = Page(whole / "report.html").spaced
    for words in (
        "RESOLVED: the data separate the motion of the bubbles from the shake of the rig",
        "y (vertical): bubble motion and shake are separated (99.6 %", "sd, µm 23.1 23.1 23.1",
        "q 1.01 1.07 1.02", "η 0.9961 0.9961 0.9961",
        "shake of left, µm 30.0", "verdict RESOLVED RESOLVED RESOLVED", "y (down)",
        "Camera left looks along z and does not see its own shake there",
        "Camera right looks along x", "bubbles 2 400 12 0.5 % 0.933 0.908",
        "arm_left bias x, mm/s² 223.80 ± 0.60", "arm_left delay, ms 1.020 ± 0.031",
        "encoder scale 1.01010 ± 0.00010", "0.0 ± 5.7 -281.0 ± 5.4 -1.4 ± 5.7",
        "bubbles' pixels was multiplied by 0.945", "marks' pixels was multiplied by 1.72",
        "Hyper-parameters: default frequencies",
        "broad bands[0]: camera left", "broad bands[0]: low, Hz 22.98",
        "The tracking beneath", "2 tracks",
    ):  # fmt: skip
        assert words in text, words
    assert text.index("RESOLVED") < text.index("Position, 1 sd") < text.index("2 tracks")
    html = (whole / "report.html").read_text(encoding="utf-8")
    assert 'class="verdict good" id="verdict"' in html


@pytest.mark.usefixtures("undrawn")
def test_without_smoothing_the_page_is_of_the_tracking_alone(folder: Path) -> None:
    (folder / "smoothing.json").unlink()
    (folder / "trajectories.csv").write_text("rubbish")
    page = Page(write_track_report(folder))
    assert page.ids == ["verdict", "key", *LAST[1:]]
    assert "Smoothed" not in page.spaced and "report of a tracked run" in page.spaced
    assert "Next: telerig smooth" in page.spaced


@pytest.mark.parametrize(
    ("word", "colour", "headline"),
    [
        ("RESOLVED", "good", "the data separate the motion of the bubbles"),
        ("PARTIAL", "usable", "only in part"),
        ("UNRESOLVED", "rejected", "cannot separate the bubbles' motion from the rig's shake"),
        ("CONTRADICTED", "rejected", "the measurements of this run disagree"),
        (None, "usable", "Not judged"),
    ],
)
def test_each_verdict_has_its_words_colour_and_remedy(
    folder: Path, word: str | None, colour: str, headline: str
) -> None:
    changed(folder, "words", "axes", "remedy", verdict=word, remedies=["strip", "arms"])
    told = _judged(folder)
    assert (told.colour, told.warnings) == (colour, ())
    assert headline in told.headline
    remedied = any("strip of dots" in s and "accelerometer" in s for s in told.sentences)
    assert remedied == (word in ("PARTIAL", "UNRESOLVED"))


def test_a_contradiction_is_named_with_its_sources_and_times(folder: Path) -> None:
    one = {"source": "marks", "axis": "y", "from_s": 0.4, "to_s": 1.5, "statistic": 3.14,
           "test": "residuals", "against": ["arm_left"]}  # fmt: skip
    axes = {axis: {"verdict": "CONTRADICTED"} for axis in "xyz"}
    changed(folder, verdict="CONTRADICTED", contradictions=[one], inflation=[1.0, 4.5, 1.0],
            axes=axes)  # fmt: skip
    told = _judged(folder)
    assert "(x 1, y 4.5, z 1)" in told.sentences[0]
    assert told.sentences[1] == (
        "marks and arm_left disagree along y from 0.4 s to 1.5 s (marks: residuals are 3.1 "
        "times as large as the noise allows)."
    )
    alone = {"source": "arm_left", "from_s": 0.0, "to_s": 1.5, "statistic": 719.0, "test": "bias"}
    changed(folder, contradictions=[alone])
    assert "arm_left disagrees with the other measurements" in _judged(folder).sentences[1]
    assert "719 standard deviations from 0" in _judged(folder).sentences[1]


def test_the_page_says_what_the_run_is_good_for(folder: Path) -> None:
    uses = [
        {"quantity": "velocity", "axis": "x", "value": 10.0, "sd": 8.0, "unit": "mm/s",
         "grade": "no"},
        {"quantity": "path", "axis": "x", "value": 2.5, "sd": 0.015, "unit": "mm",
         "grade": "good", "below_hz": 19.3},
        {"quantity": "mean velocity", "axis": "y", "value": -277.0, "sd": 2.8, "unit": "mm/s",
         "grade": "good", "assumes": ["encoder"]},
    ]  # fmt: skip
    changed(folder, usable_for=uses)
    rows = [row.cells for row in use_rows(read(folder))]
    assert [row[:3] for row in rows] == [
        ("good", "path about a line below 19 Hz", "x"), ("good", "mean velocity", "y"),
        ("no", "velocity in a frame", "x"),
    ]  # fmt: skip
    assert rows[1][3:] == ("-277.0 ±\u00a02.8 mm/s", "encoder")
    assert uses_words(read(folder).file.usable_for) == [
        "good for: path about a line (x), mean velocity (y)",
        "not good for: velocity in a frame (x)",
        "nothing in this run confirms the sign, unit and scale of: encoder",
    ]


def test_the_page_says_why_it_is_not_good_for_more_and_what_to_add(folder: Path) -> None:
    path = {"quantity": "path", "value": 0.19, "sd": 0.16, "unit": "mm", "grade": "no"}
    speed = path | {"quantity": "velocity", "value": 10.0, "sd": 8.0, "unit": "mm/s", "axis": "x"}
    axes = {
        "x": {"q": 1.1, "sigma_mm": 0.02, "sigma_shake_known_mm": 0.018},
        "y": {"q": 9.7, "sigma_mm": 0.154, "sigma_shake_known_mm": 0.0159},
    }
    changed(folder, usable_for=[path | {"axis": "y"}, speed], axes=axes, remedies=["arms"])
    by_noise, by_shake, *remedies = words_of_refusals(read(folder).file)
    assert by_noise.endswith("because of the pixels' noise.")
    assert "mostly because of the shake" in by_shake and "15.9 µm if the shake were" in by_shake
    assert "accelerometer" in remedies[0] and "pixels per mm" in remedies[1]
    axes["y"] |= {"q": 1.3, "sigma_mm": 0.0208, "sigma_shake_known_mm": 0.016}
    changed(folder, usable_for=[path | {"axis": "y"}], axes=axes, remedies=[])
    (by_shake,) = words_of_refusals(read(folder).file)  # strip and accelerometers are there
    assert "partly because of the shake" in by_shake
    changed(folder, verdict="CONTRADICTED")  # what widens q is no shake
    assert words_of_refusals(read(folder).file) == []
    changed(folder, verdict="PARTIAL")
    changed(folder, usable_for=[path | {"axis": "y", "grade": "good"}])
    assert words_of_refusals(read(folder).file) == []


def test_flags_are_explained_and_only_the_harmful_ones_warn(folder: Path) -> None:
    changed(folder, flags=["SHAKE_BELOW_NOISE"])
    told = _judged(folder)
    assert told.colour == "good" and "does no harm" in told.sentences[-1]
    changed(folder, flags=["ARMS_UNMEASURED", "ODD_ONE"])
    told = _judged(folder)
    assert told.colour == "usable" and len(told.warnings) == 2
    assert "does not measure how" in told.warnings[0]
    assert told.warnings[1].startswith("ODD_ONE: ") and "does not know" in told.warnings[1]


@pytest.mark.usefixtures("undrawn")
def test_nothing_judged_and_nothing_optional(folder: Path) -> None:
    changed(folder, "verdict", "axes", "words", "model", "residuals", "unseen", "cameras", "schema",
          "bubble_means", "encoder", "accelerometers", "modes", "flags", "remedy")  # fmt: skip
    table = pd.read_csv(folder / "trajectories.csv")
    kept = ["frame", "particle", "t_s", *(f"{a}_mm" for a in "xyz"), *(f"v{a}_mm_s" for a in "xyz")]
    table[kept].to_csv(folder / "trajectories.csv", index=False)
    shake = pd.read_csv(folder / "shake.csv")
    shake = shake[[n for n in shake if not n.startswith(("sl", "sr", "sp", "pos"))]]
    shake.to_csv(folder / "shake.csv", index=False)
    page = Page(write_track_report(folder))
    shown = [name for name in SMOOTHING if name not in ("look", "lab")]
    assert page.ids == [*shown, *LAST[1:]]
    assert "Not judged" in page.spaced and "nan" not in page.spaced.lower().split()


def test_the_page_tests_the_spheroid_by_what_tracking_tells_of_shapes(folder: Path) -> None:
    frames = pd.read_csv(folder / "trajectories.csv")[["frame", "particle", "t_s"]]
    frames.assign(aspect=1.5, spheroid_chi2=1.9).to_csv(folder / "bubbles.csv", index=False)
    changed(folder, bodies=asdict(Shapes(triaxial=0.02, bodies=60)))
    words = drawn_words(folder, "Aspect ratio in time")
    assert "differ by 4.0 % (1 sd)" in words and "chi-square of 1.9 (median)" in words
    assert "only noise: 1.4 of 2 outlines (degrees of freedom: 2)." in words
    frames.assign(aspect=1.5).to_csv(folder / "bubbles.csv", index=False)
    assert "too few to test" in drawn_words(folder, "Aspect ratio in time")


def test_up_is_what_the_smoothing_took_for_it(folder: Path) -> None:
    assert "Rise velocity" in _titles(folder) and "Velocity in x" in _titles(folder)
    changed(folder, up=[1.0, 0.0, 0.0])
    assert read(folder).up.tolist() == [1.0, 0.0, 0.0]
    assert "Velocity in y" in _titles(folder) and "Velocity in x" not in _titles(folder)


def test_no_bubbles_leaves_the_shake(folder: Path) -> None:
    (folder / "trajectories.csv").write_text("frame,particle,t_s\n")
    changed(folder, "verdict", "axes", "words", bubbles=0)
    titles = _titles(folder)
    assert "Shake of camera left" in titles and not any("Velocity" in title for title in titles)


def test_short_runs_have_no_spectra(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", frames=20, bubbles=1)
    results = read(folder)
    assert shake_spectrum(results.shake, "left") is None
    with pytest.raises(InputError, match="32 frames"):
        velocity_spectrum(results.trajectories)
    titles = _titles(folder)
    assert "Rise velocity" in titles and not any("Spectrum" in title for title in titles)


def test_long_runs_stay_small(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", frames=1_100, bubbles=2)
    assert write_track_report(folder).stat().st_size < 2e6


@pytest.mark.usefixtures("undrawn")
def test_hostile_names_stay_text(folder: Path) -> None:
    evil = "</script><b>x"
    changed(folder, flags=[evil],
          accelerometers={evil: {"scale": 1.0}},
          residuals={evil: {"pixels": 3, "outliers": 0}})  # fmt: skip
    html = write_track_report(folder).read_text(encoding="utf-8")
    assert evil not in html and html.count("&lt;/script&gt;&lt;b&gt;x") >= 3


def test_names_are_no_formulas_and_stand_in_the_legend() -> None:
    def draw(axes: Any) -> None:
        axes.set(yscale="log", title="cam$_$")
        for name in ("$_$", "_left", "s"):
            axes.plot([1, 2], [1, 1000], label=name)

    picture = drawn(Figure("", draw))
    assert picture is not None
    svg = base64.b64decode(picture.source.split(",")[1]).decode()
    texts = [text.strip() for text in re.findall(r"<text[^>]*>([^<]+)</text>", svg)]
    assert texts[-4:] == ["cam$_$", "$_$", "_left", "s"]


def test_importing_the_reports_draws_in_no_heavy_library_nor_the_estimator() -> None:
    reports = "run.report, telerig.io.report.overlays, telerig.io.report.calibration.report"
    code = f"import sys, telerig.io.report.{reports}; print(*sys.modules)"
    run = [sys.executable, "-c", code]
    done = subprocess.run(run, capture_output=True, text=True, check=True).stdout.split()
    assert not {"matplotlib", "plotly", "cv2", "scipy.signal", "jinja2"} & set(done)
    assert not [name for name in done if name.startswith("telerig.estimator")]


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("smoothing.json", "{", "JSON"),
        ("smoothing.json", "[]", "not an object"),
        ("smoothing.json", '{"schema": 9}', "newer"),
        ("smoothing.json", '{"verdict": 3}', "has a fault at 'verdict'"),
        ("smoothing.json", '{"flags": "A"}', "has a fault at 'flags'"),
        ("smoothing.json", '{"model": []}', "has a fault at 'model'"),
        ("smoothing.json", '{"cameras": ["left"]}', "smoothing.json's are ['left']"),
        ("shake.csv", None, "does not exist"),
        ("shake.csv", "frame,t_s\n0,0\n", "its columns are of cameras"),
        ("trajectories.csv", None, "does not exist"),
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


def test_pages_load_smoothing_and_exports_read_by_the_same_rules(folder: Path) -> None:
    loaded, results = telerig.load_smoothing(folder), read(folder)
    pd.testing.assert_frame_equal(loaded.trajectories, results.rows)
    pd.testing.assert_frame_equal(loaded.shake, results.shake)
    pd.testing.assert_frame_equal(read_results(folder).points, results.trajectories)
    shake = pd.read_csv(folder / "shake.csv")
    shake.drop(columns="left_z_mm").to_csv(folder / "shake.csv", index=False)
    for reader in (telerig.load_smoothing, read, read_results):
        with pytest.raises(InputError, match="missing column: left_z_mm"):
            reader(folder)


@pytest.mark.parametrize(
    ("file", "whose"), [("shake.csv", ""), ("trajectories.csv", " of bubble 0")]
)
def test_times_that_do_not_increase_are_named(folder: Path, file: str, whose: str) -> None:
    table = pd.read_csv(folder / file)
    table.loc[30, "t_s"] = table.loc[29, "t_s"]
    table.to_csv(folder / file, index=False)
    with pytest.raises(InputError, match=f"times{whose} do not increase at frame 30"):
        write_track_report(folder)
