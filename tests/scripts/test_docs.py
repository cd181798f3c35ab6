"""The code blocks and commands of the documentation run as they stand; the pages build."""

from __future__ import annotations

import inspect
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import docs_pages
import numpy as np
import pytest
from typer.testing import CliRunner

import telerig
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.scripts.main import app

ROOT = docs_pages.ROOT
PAGES = [
    page
    for page in docs_pages.pages()
    if page not in docs_pages.ELSEWHERE and docs_pages.blocks_of(page)
]
ALONE = (
    "docs/index.md", "docs/tutorial.md", "docs/tutorial-images.md", "docs/recording.md",
    "docs/findings.md",
    *(page for page in PAGES if page.startswith("docs/notebooks/")),
)  # fmt: skip
"""Pages that begin in an empty folder."""
QUICK = ("docs/findings.md",)
"""Pages that are run with all other tests."""


@pytest.fixture(scope="session")
def tank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset `tank` with the run `run1` and all results: what pages take for granted."""
    folder = tmp_path_factory.mktemp("docs")
    runner = docs_pages.PageRunner(folder)
    steps = (
        "telerig simulate rise --no-images --frames 25 --seed 1 --out tank\n"
        "mv tank/runs/rise tank/runs/run1\n"
        "telerig run tank --quiet --no-report\n"
    )
    runner.run(docs_pages.Block("tests/scripts/test_docs.py", 1, "sh", steps))
    return folder / "tank"


def own_sensors() -> dict[str, object]:
    """What the worked example of smoothing.md has at hand: readings that no file of the run has."""
    config = run_preset("rise", frames=25)
    config = replace(config, stage=replace(config.stage, accelerometers=("left",)))
    dataset = telerig.simulate(config, rng=np.random.default_rng(4), out=Path("data"), images=False)
    readings = dataset.runs["rise"].load().accelerometers
    assert readings is not None
    (dataset.runs["rise"].path / "accelerometer.csv").unlink()
    return {
        "dataset": dataset,
        "calibration": calibration_from_cameras(list(true_cameras(config.calibration).values())),
        "left_t_s": readings["t_s"].to_numpy(),
        "left_m_s2": readings[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy(),
    }


def write_bubbles(folder: Path) -> None:
    """Two images of a bubble before a lit screen."""
    rng, folder = np.random.default_rng(0), folder.absolute()
    folder.mkdir()
    for name in ("a", "b"):
        image = np.full((800, 1000), 200.0)
        cv2.circle(image, (500, 400), 40, 60.0, -1, cv2.LINE_AA)
        noisy = cv2.GaussianBlur(image, (0, 0), 1.0) + rng.standard_normal(image.shape)
        cv2.imwrite(str(folder / f"{name}.png"), noisy.astype(np.uint8))


def measured_pixels(folder: Path) -> dict[str, object]:
    """The README's pixels of a few points."""
    calibration = telerig.load_calibration(folder / "tank" / "results" / "calibration")
    points_mm = np.array([[1.0, 2.0, 3.0], [-2.0, 0.5, 1.0]])
    pixels = [calibration.project(camera, points_mm) for camera in range(2)]
    return {"uv_left_px": pixels[0], "uv_right_px": pixels[1]}


@pytest.mark.parametrize(
    "page", [pytest.param(p, marks=[] if p in QUICK else [pytest.mark.slow]) for p in PAGES]
)
def test_blocks_run(
    page: str, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks = docs_pages.blocks_of(page)
    monkeypatch.chdir(tmp_path)
    if page not in ALONE and {b.language for b in blocks} & {"sh", "python"}:
        shutil.copytree(request.getfixturevalue("tank"), tmp_path / "tank")
    names: dict[str, object] = {}
    if page == "docs/smoothing.md":
        names = own_sensors()
    if page == "docs/commands.md":
        write_bubbles(Path("images"))
    if page == "README.md":
        shutil.copytree("tank", "tank-2")
        names = measured_pixels(tmp_path)
    runner = docs_pages.PageRunner(tmp_path, names)
    for block in blocks:
        runner.run(block)
    assert runner.ran == sum(not b.not_run for b in blocks)
    if page == "docs/smoothing.md":
        check_own_sensors(runner.names["smoothing"])


def check_own_sensors(smoothing: telerig.Smoothing) -> None:
    assert len(smoothing.trajectories) == 25
    assert abs(smoothing.summary["accelerometers"]["on the left arm"]["delay_s"]) < 0.01
    assert Path("results-with-my-sensor/trajectories.csv").is_file()


def test_every_block_is_run_or_says_why_not() -> None:
    here = [page for page in docs_pages.pages() if page not in docs_pages.ELSEWHERE]
    blocks = [b for page in here for b in docs_pages.blocks_of(page)]
    assert len(blocks) > 40
    unknown = [b.where for b in blocks if b.language not in docs_pages.LANGUAGES]
    assert not unknown, "blocks in a language that no test runs"
    used = Counter(b.not_run for b in blocks if b.not_run)
    assert set(used) == set(docs_pages.NOT_RUN), "keys of blocks that are not run"
    for page, test in docs_pages.ELSEWHERE.items():
        assert (ROOT / page).is_file() and (ROOT / test).is_file()


def test_no_command_hides_outside_a_block() -> None:
    """An indented line that begins with `telerig` is a command that no test runs."""
    hidden = []
    for page in docs_pages.pages():
        text = docs_pages.FENCE.sub("", (ROOT / page).read_text(encoding="utf-8"))
        hidden += [f"{page}: {m}" for m in re.findall(r"^ {4,}telerig .*$", text, re.MULTILINE)]
    assert not hidden


@pytest.mark.parametrize(
    ("page", "printed", "same"),
    [
        ("scale 10.04 ± 0.02", "scale 10.049 ± 0.02 px", True),
        ("scale 10.04 ± 0.02", "scale 10.06 ± 0.02 px", False),
        ("12 views, RMS 0.0091 px (3.1 s)", "12 views, RMS 0.0092 px (7.9 s)", True),
        ("12 views", "13 views", True),
        ("12 views", "14 views", False),
        ("chi-square 0.98", "chi-square 1.2", False),
        ("stated 161 µm", "stated 155 µm", False),
    ],
)
def test_numbers_of_the_tutorial_are_compared(page: str, printed: str, same: bool) -> None:
    assert docs_pages.like(page, printed) == same
    block = docs_pages.Block("docs/tutorial.md", 1, "text", f"{page} ...\n")
    if same:
        docs_pages.check_output(block, printed)
        return
    with pytest.raises(AssertionError, match=r"tutorial\.md:1"):
        docs_pages.check_output(block, printed)


@pytest.mark.slow
@pytest.mark.skipif(
    any(find_spec(name) is None for name in ("sphinx", "myst_nb", "furo", "xarray")),
    reason="the extra 'docs' is not installed: pip install 'telerig[docs]'",
)
def test_pages_build_without_a_warning(tmp_path: Path) -> None:
    """As text, which reads and links every page as HTML does."""
    command = [sys.executable, "-m", "sphinx", "-b", "text", "-W", "--keep-going", "-q", "-j", "2"]
    done = subprocess.run(
        [*command, "-d", str(tmp_path / "trees"), str(ROOT / "docs"), str(tmp_path / "text")],
        text=True, capture_output=True, timeout=600, env={**os.environ, "COLUMNS": "100"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for page in ("index", "tutorial", "_generated/commands", "_generated/CONVENTIONS"):
        assert (tmp_path / "text" / f"{page}.txt").is_file()
    api = (tmp_path / "text" / "api.txt").read_text(encoding="utf-8")
    assert "telerig.smooth(" in api and "Raises InputError" in api
    assert "class telerig.Calibration(" in api and "the rig frame" in api


def test_the_page_of_python_names_has_every_public_one() -> None:
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^\.\. auto(?:function|class|exception):: (\w+)$", page, re.MULTILINE))
    assert shown == set(telerig.__all__) - {"__version__", "plot"}


def test_every_public_function_is_called_on_a_page() -> None:
    blocks = [b for page in docs_pages.pages() for b in docs_pages.blocks_of(page)]
    code = "".join(b.code for b in blocks if b.language in ("python", docs_pages.CELL))
    functions = [name for name in telerig.__all__ if inspect.isfunction(getattr(telerig, name))]
    called = [n for n in functions if re.search(rf"\b(telerig\.{n}\(|import .*\b{n}\b)", code)]
    assert set(functions) - set(called) == {"view"}, "which opens a window"


@pytest.mark.parametrize(
    ("command", "words"),
    [("record", "[until Ctrl-C]"), ("batch", "[one per core]"), ("record", "[devices.NAME]")],
)
def test_help_keeps_what_stands_in_brackets(command: str, words: str) -> None:
    done = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "160"})
    assert words in done.output


def test_each_parameter_of_a_public_docstring_begins_a_line() -> None:
    things = {name: getattr(telerig, name) for name in telerig.__all__}
    for name, thing in [*things.items()]:
        if inspect.isclass(thing):
            things |= {f"{name}.{n}": f for n, f in inspect.getmembers(thing, callable)}
    glued = re.compile(r"^.*[.;)] (\w+(, \w+)*) :(?: .*)?$", re.MULTILINE)
    for name, thing in things.items():
        assert not glued.search(inspect.getdoc(thing) or ""), name


def test_architecture_names_what_is_there() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:rig|factors|estimator|io|scripts|tests)/[\w/]+(?:\.py)?)`", text)
    gone = [p for p in named if not (ROOT / p).exists() and not (ROOT / f"{p}.py").exists()]
    assert len(named) > 30 and not gone


def test_pictures_are_those_that_pages_show() -> None:
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    shown = re.compile(r"!\[[^]]*\]\((?:\.\./|docs/)*pictures/([\w-]+\.png)\)")
    named = {name for page in pages for name in shown.findall(page.read_text(encoding="utf-8"))}
    assert named == {file.name for file in (ROOT / "docs" / "pictures").iterdir()}


@pytest.mark.slow
def test_one_command_makes_all_pictures(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "docs" / "pictures.py"), "--out", str(tmp_path / "made")]
    done = subprocess.run(command, text=True, capture_output=True, timeout=1800)
    assert done.returncode == 0, done.stderr[-2000:]
    made = {file.name for file in (tmp_path / "made").iterdir()}
    missing = {file.name for file in (ROOT / "docs" / "pictures").iterdir()} - made
    may = {"report.png", "batch.png"} if "no browser" in done.stdout else set()
    if "not installed" in done.stdout:
        may |= {f"viewer-{name}.png" for name in ("calibration", "join", "run")}
    assert missing == may


def test_links_whose_text_is_code_are_turned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    from project_pages import with_links

    text = "See [`dots.md`](../../benchmarks/results/dots.md): `x`."
    turned = with_links(text, "decisions/005-dots")
    assert turned.endswith("benchmarks/results/dots.md): `x`.") and turned != text
    code = "`[a](../../benchmarks/results/dots.md)` and `x`"
    assert with_links(code, "decisions/005-dots") == code
