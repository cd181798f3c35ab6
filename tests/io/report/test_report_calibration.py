"""The calibration report: from files to one page, and the figures' numbers against authorities."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from calibration_folder import write_calibration_folder
from matplotlib.figure import Figure as Figure_
from report_page import Page, edit

import telerig
from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.report.calibration.report import page_of, write_calibration_report
from telerig.io.report.calibration.tables import held_everywhere, parameter_rows, worst_rows
from telerig.io.report.page.figures import Figure
from telerig.io.report.remake import ResultsFolder, remake_report
from telerig.io.results.calibration_words import telecentricity_words
from telerig.io.results.folders.calibration import read_calibration_results
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import PARAMETERS

SIGMA_PX, BUMP_MM = 0.01, 0.05
SECTIONS = [
    *("verdict", "look", "key", "parameters", "residuals", "coverage", "target", "views", "model"),
    *("more", "origin"),
]
OPTIONAL = ("dots.csv", "covariance.npz", "run.json", "overlays")

_edit = partial(edit, "calibration.json")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_calibration_folder(tmp_path / "results", cameras=2)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a whole folder, which no test changes."""
    return write_calibration_report(
        write_calibration_folder(tmp_path_factory.mktemp("once") / "r", cameras=2)
    )


def test_page_is_whole_small_and_loads_nothing(report: Path) -> None:
    page = Page(report)
    assert report.name == "report.html" and report.stat().st_size < 5e6
    assert page.ids == SECTIONS
    links = [load for load in page.loads if not load.startswith(("data:", "#"))]
    assert links == ["overlays/left/view01.jpg"]
    css = report.read_text(encoding="utf-8").split("<style>")[1].split("</style>")[0]
    assert "url(" not in css and "@import" not in css
    assert not list(report.parent.glob(".report*"))


def test_page_says_verdict_parameters_and_everything_else(report: Path) -> None:
    text = Page(report).text
    odd = text.index("View '<odd> &', camera 'left': only 6 of its 15 dots agree")
    assert text.index("USABLE, with warnings") < odd < text.index("Cameras", 500)
    for name in PARAMETERS:
        assert (name in text) != name.startswith("wall_")  # no wall, no word of it
    for words in (
        "10.00000 ±\u00a00.00034", "0.002000 ±\u00a00.000048", "90.00000 ±\u00a00.00069", "98.9 %",
        "178 of 180", "0.510 µm", "none was enough", "99.25", "nominal rotation", "90 deviations",
        "a note", "the gauge in words", "packages.numpy",
        "9.9", "14 of 15",
    ):  # fmt: skip
        assert words in text, words


def test_every_figure_is_one_of_plot_with_a_caption(report: Path) -> None:
    page = Page(report)
    drawn = page.pictures("svg+xml")
    assert len(drawn) == 3 + 1 + 3 + 2
    assert report.read_text(encoding="utf-8").count("<figcaption>") == len(drawn)
    blocks = page_of(read_calibration_results(report.parent), (), report.parent)
    figures = [*blocks.look, *(b for s in blocks.sections for b in s.contents)]
    for figure in (one for one in figures if isinstance(one, Figure)):
        assert figure.draw.func.__name__ in telerig.plot.__all__


@pytest.mark.parametrize(("status", "colour"), [("GOOD", "good"), ("REJECTED", "rejected")])
def test_verdict_has_its_colour(folder: Path, status: str, colour: str) -> None:
    found = [] if status == "GOOD" else [{"code": "FEW_KEPT", "numbers": {"share": 0.5}}]
    page = write_calibration_report(_edit(folder, verdict={"status": status}, findings=found))
    assert f'class="verdict {colour}"' in page.read_text(encoding="utf-8")
    ids, usable = Page(page).ids, status == "GOOD"
    assert (ids.index("parameters") < ids.index("residuals")) == usable
    assert ("In space" in Page(page).text) == usable, "no number of what must not be used"


@pytest.mark.parametrize(
    ("change_per_mm", "sd_per_mm", "said"),
    [
        (1e-6, 1e-6, "camera left is telecentric: "),
        (5e-5, 6e-5, "camera left is telecentric as far as these views can show it: "),
        (5e-5, 1e-5, "camera left is not quite telecentric: "),
    ],
)
def test_a_scale_that_may_not_change_is_not_said_to(
    change_per_mm: float, sd_per_mm: float, said: str
) -> None:
    lens = {"change_per_mm": change_per_mm, "sd_per_mm": sd_per_mm, "depth_mm": 40.0,
            "perspective": 1e-3}  # fmt: skip
    (words,) = telecentricity_words({"telecentricity": {"left": lens}})
    assert words.startswith(said)


def test_the_page_of_ordinary_lenses_says_one_thing(folder: Path) -> None:
    lens = {"change_per_mm": 9.39e-3, "sd_per_mm": 4.4e-7, "depth_mm": 80.0, "perspective": 0.6}
    _edit(folder, statistics={"telecentricity": {"left": lens, "right": lens}})
    text = Page(write_calibration_report(folder)).text
    assert "the scale changes by 0.94 and 0.94 % per mm" in text
    assert "9390.00 ±\u00a00.44 ppm" in text
    assert "centre of perspective is at the distance" in text
    assert "Only the three rotations" not in text


def test_one_camera_and_nothing_optional(tmp_path: Path) -> None:
    folder = write_calibration_folder(tmp_path / "mono", cameras=1)
    _edit(folder, model={}, twin={}, covariance=None, statistics={"rms_px": None})
    for name in OPTIONAL:
        (folder / name).rename(tmp_path / f"away {name}")
    text = Page(write_calibration_report(folder)).text
    for words in (
        "one camera never sees the depth", "run.json (no versions", "overlays/ (no pictures",
        "residuals are shown in px only", "not available px",
    ):  # fmt: skip
        assert words in text, words


def test_hostile_names_stay_text(folder: Path) -> None:
    evil, begun = "</script><b>x", "<!--<script>"
    views = json.loads((folder / "calibration.json").read_text())["views"]
    _edit(folder, name=evil, views=views | {begun: views["view00"]})
    html = write_calibration_report(folder).read_text(encoding="utf-8")
    assert evil not in html and "&lt;/script&gt;&lt;b&gt;x" in html
    assert begun not in html


def test_an_imported_calibration_is_said_to_have_no_report(tmp_path: Path) -> None:
    camera = Camera.create("left", (640, 480), 10.0)
    calibration_from_cameras([camera]).save(tmp_path / "out")
    with pytest.raises(InputError, match="was imported") as caught:
        write_calibration_report(tmp_path / "out")
    assert "residuals.csv" not in str(caught.value)


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("calibration.json", None, "no calibration here"),
        ("calibration.json", "{", "JSON"),
        ("calibration.json", '{"kind": "soup"}', "not a calibration"),
        ("calibration.json", '{"kind": "telerig calibration", "schema": 9}', "newer"),
        ("residuals.csv", None, "residuals are missing"),
        ("residuals.csv", "view,camera\n1,2\n", "dot"),
        ("covariance.npz", "rubbish", "cannot be read"),
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
        write_calibration_report(folder)
    assert file in str(caught.value) and "->" in str(caught.value)
    assert (folder / "report.html").read_text() == "old"


def test_files_that_do_not_fit_together_are_refused(folder: Path) -> None:
    file = folder / "residuals.csv"
    file.write_text(file.read_text().replace("view05,right,14,", "view05,middle,14,"))
    with pytest.raises(
        InputError, match=r"row 181, column camera: calibration.json has no camera 'middle'"
    ):
        read_calibration_results(folder)
    with pytest.raises(InputError, match="has a fault at 'views'"):
        content = json.loads((folder / "calibration.json").read_text())
        del content["views"]
        (folder / "calibration.json").write_text(json.dumps(content))
        read_calibration_results(folder)


def test_whitened_residuals_are_unit_normal(folder: Path) -> None:
    table = read_calibration_results(folder).residuals
    white = table.loc[table["kept"], ["whitened_u", "whitened_v"]].to_numpy()
    raw = table.loc[table["kept"], ["du_px", "dv_px"]].to_numpy()
    inverse = np.linalg.inv(SIGMA_PX**2 * np.array([[1.0, 0.6], [0.6, 1.0]]))
    np.testing.assert_allclose((white**2).sum(1), np.einsum("ni,ij,nj->n", raw, inverse, raw))
    assert abs(np.corrcoef(white.T)[0, 1]) < 0.2


def test_what_rough_edges_share_in_all_images_does_not_whiten_residuals(folder: Path) -> None:
    before = read_calibration_results(folder).residuals
    file = folder / "dots.csv"
    dots = pd.read_csv(file, dtype={"view": str})
    for name, shared in (("suu_px2", 0.09), ("suv_px2", 0.01), ("svv_px2", 0.09)):
        dots[name], dots[f"edge_{name}"] = dots[name] + shared, shared
    dots.to_csv(file, index=False)
    after = read_calibration_results(folder).residuals
    columns = ["whitened_u", "whitened_v"]
    np.testing.assert_allclose(after[columns], before[columns], rtol=1e-6)


def test_parameter_rows_tell_held_from_free_and_distortion_in_px(folder: Path) -> None:
    results = read_calibration_results(folder)
    rows = {row.cells[0]: row for row in parameter_rows(results)}
    assert "skew" in held_everywhere(results) and "skew (skew)" not in rows
    centre = rows["image centre u, px (centre_u_px)"]
    assert centre.faint and centre.cells[1].endswith("(held)")
    moved = float(rows["largest distortion in the image"].cells[1].removesuffix(" px"))
    half_diagonal_px = np.hypot(512, 400) / 2
    assert moved == pytest.approx(0.002 * half_diagonal_px, rel=0.02)


def test_worst_dots_are_those_left_out(folder: Path) -> None:
    (row,) = worst_rows(read_calibration_results(folder))
    assert row.strong and row.cells[2] == "3" and row.cells[-1] == "90 deviations"


def test_many_residuals_become_means_of_cells(folder: Path) -> None:
    table = read_calibration_results(folder).residuals
    many = pd.concat([table] * 20)
    few, means = (
        telerig.plot.residuals(one, "left", (512, 400), axes=Figure_().add_subplot())
        for one in (table, many)
    )
    assert few.collections[0].N == 89 and means.collections[0].N < 89


def test_views_link_to_their_pictures_from_where_the_page_lies(folder: Path) -> None:
    for out in (None, folder.parent / "else where"):
        page = remake_report(ResultsFolder(folder, "calibration"), out)
        links = re.findall(r'href="([^"]*view01.jpg)"', page.read_text())
        assert [(page.parent / unquote(link)).is_file() for link in links] == [True]
        assert links[0].startswith("overlays/") == (out is None)
