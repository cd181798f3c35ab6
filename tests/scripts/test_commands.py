"""The commands on real files: what they write, and what they say of bad input."""

from __future__ import annotations

import errno
import inspect
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import tifffile
from typer.testing import CliRunner

import telerig
from telerig.scripts import console
from telerig.scripts.main import app

pytestmark = pytest.mark.usefixtures("without_advice", "undrawn")

runner = CliRunner()


@pytest.fixture(autouse=True)
def tracebacks_of_our_own_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TELERIG_DEBUG", "1")


def run(*arguments: str | Path, code: int = 0) -> str:
    result = runner.invoke(app, [str(a) for a in arguments])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    text = result.output + result.stderr
    assert result.exit_code == code, text
    return text


@pytest.fixture
def small_copy(paper_copy: Path) -> Path:
    """Three of its views."""
    for camera in ("left", "right"):
        for path in images(paper_copy, camera)[3:]:
            path.unlink()
    return paper_copy


def images(folder: Path, camera: str) -> list[Path]:
    return sorted((folder / "calibration" / camera).iterdir())


def spoil(path: Path, change) -> None:  # type: ignore[no-untyped-def]
    tifffile.imwrite(path, change(tifffile.imread(path)))


@pytest.fixture(scope="module")
def calibrated(paper_images: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    out = tmp_path_factory.mktemp("out") / "calibration"
    return out, run("calibrate", paper_images, "--out", out, "--quiet")


def test_calibrate_writes_every_file_of_the_contract(calibrated):
    out, text = calibrated
    for name in ("calibration.json", "covariance.npz", "dots.csv", "residuals.csv", "report.html",
                 "run.json"):  # fmt: skip
        assert (out / name).is_file(), name
    dots = pd.read_csv(out / "dots.csv")
    assert list(dots.columns) == [
        "view", "camera", "dot", "row", "column", "u_px", "v_px", "suu_px2", "suv_px2", "svv_px2",
        "edge_suu_px2", "edge_suv_px2", "edge_svv_px2", "chi2_dof",
    ]  # fmt: skip
    residuals = pd.read_csv(out / "residuals.csv")
    assert list(residuals.columns) == [
        "view", "camera", "dot", "row", "column", "u_px", "v_px", "du_px", "dv_px", "weight",
        "reason",
    ]  # fmt: skip
    assert len(dots) == len(residuals) == 12 * 2 * 15
    data = json.loads((out / "calibration.json").read_text())
    assert data["pixel_origin"] == "centre" and data["gauge"]
    assert "GOOD" in text
    manifest = json.loads((out / "manifest.json").read_text())
    inputs = manifest["sections"]["calibrate"]["inputs"]
    assert any(name.endswith("rig.toml") for name in inputs)


def test_calibrate_says_what_moved_since_an_earlier_calibration(calibrated, paper_images, tmp_path):
    """A dataset to compare with stands for its own results."""
    data = tmp_path / "tank"
    (data / "calibration").mkdir(parents=True)
    shutil.copy(paper_images / "rig.toml", data)
    shutil.copy(calibrated[0] / "dots.csv", data / "calibration")
    shutil.copytree(calibrated[0], tmp_path / "last-year" / "results" / "calibration")
    earlier = tmp_path / "last-year"
    text = run("calibrate", data, "--quiet", "--compare", earlier, "--no-report")
    found = json.loads((data / "results" / "calibration" / "comparison.json").read_text())
    assert found["verdict"] == "SAME" and found["earlier"].startswith(str(earlier))
    assert f"since {earlier}: " in text.replace("\n", "")
    text = run("calibrate", data, "--quiet", "--compare", data / "none", code=2)
    assert "none" in text


def test_a_calibration_of_another_rig_is_refused_before_anything_is_solved(
    calibrated, small_copy, monkeypatch
):
    earlier, _ = calibrated
    rig = small_copy / "rig.toml"
    rig.write_text(rig.read_text().replace("right", "top"))
    (small_copy / "calibration" / "right").rename(small_copy / "calibration" / "top")
    monkeypatch.setattr("telerig.estimator.calibration.calibrate.run_calibration", None)
    text = run("calibrate", small_copy, "--quiet", "--compare", earlier, code=2)
    assert "calibrations of different rigs" in text.replace("\n", " ")


def test_a_reader_that_has_gone_is_no_fault():
    code = "import typer\nfrom telerig.scripts.console import errors_in_words, say\n"
    code += "def long():\n  with errors_in_words():\n    [say('x' * 1000) for _ in range(1000)]\n"
    code += "typer.run(long)"
    done = subprocess.run(
        ["bash", "-c", '"$0" -c "$1" | head -1; echo "${PIPESTATUS[0]}"', sys.executable, code],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "fault" not in done.stderr and "Traceback" not in done.stderr
    assert done.stdout.split()[-1] == "141"


def test_calibration_agrees_with_the_truth(calibrated):
    from telerig.estimator.calibration.quality.comparison import difference_from_truth
    from telerig.io.simulation.calibration.scene import true_cameras
    from telerig.io.simulation.presets import preset

    out, _ = calibrated
    cameras = tuple(true_cameras(preset("paper")).values())
    found = difference_from_truth(telerig.load_calibration(out), cameras)
    assert found.rms_um < min(2 * found.predicted_um, 1.2)
    assert found.p_value > 1e-4


@pytest.mark.slow
def test_a_second_run_gives_the_same_bytes(calibrated, paper_images, tmp_path):
    out, _ = calibrated
    run("calibrate", paper_images, "--out", tmp_path / "again", "--quiet", "--no-report")
    for name in ("calibration.json", "residuals.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes()


def test_detect_draws_what_it_found_and_rejects_dots_merged_by_glare(small_copy, tmp_path):
    path = images(small_copy, "left")[2]
    before = telerig.detect_target(tifffile.imread(path), telerig.load_dataset(small_copy).target)
    pair = before[before["dot"].isin([0, 1])][["u_px", "v_px"]].to_numpy()

    def glare(image):
        out = image.copy()
        ends = [tuple(round(x) for x in p) for p in pair]
        cv2.line(out, ends[0], ends[1], int(image.max()), 9)
        return out

    spoil(path, glare)
    text = run("detect", small_copy, "--out", tmp_path / "found", "--quiet")
    assert len(re.findall(r"15 dots", text)) == 5
    assert len(list((tmp_path / "found" / "overlays").glob("*/*.jpg"))) == 6
    tables = [pd.read_csv(tmp_path / f"found/{n}.csv", dtype={"view": str}) for n in
              ("dots", "rejected")]  # fmt: skip
    dots, rejected = (t[(t["view"] == path.stem) & (t["camera"] == "left")] for t in tables)
    assert len(dots) == 13 and not set(dots["dot"]) & {0, 1} and len(rejected) >= 1


def test_a_truncated_image_and_one_of_another_size_are_refused_and_nothing_is_written(small_copy):
    path = images(small_copy, "right")[1]
    whole = path.read_bytes()
    path.write_bytes(whole[:3000])
    assert path.name in run("calibrate", small_copy, "--quiet", code=2)
    path.write_bytes(whole)
    spoil(path, lambda image: image[:500])
    text = run("calibrate", small_copy, "--quiet", code=2)
    assert "512" in text and "500" in text
    assert not (small_copy / "results").exists()


def test_unknown_preset_and_model_are_named(paper_images, tmp_path):
    assert "paper" in run("simulate", "papper", "--out", tmp_path / "x", code=2)
    assert "radial" in run("calibrate", paper_images, "--model", "radail", code=2)


def test_bubbles_of_single_images(tmp_path: Path) -> None:
    v, u = np.mgrid[:200, :260]
    image = np.where(np.hypot(u - 90, v - 100) < 15, 40, 200).astype(np.uint8)
    image += np.random.default_rng(0).integers(0, 5, image.shape, np.uint8)
    tifffile.imwrite(tmp_path / "one.tif", image)
    text = run("bubbles", tmp_path / "one.tif", "--out", tmp_path / "found", "--quiet")
    assert "one: 1 bubble, 0 clusters" in text
    row = pd.read_csv(tmp_path / "found" / "detections.csv").iloc[0]
    assert row["image"] == "one" and abs(row["u_px"] - 90) < 0.2
    far = "--region=200,20 250,20 250,180"
    assert "one: 0 bubbles" in run("bubbles", tmp_path, far, "--out", tmp_path / "far", "--quiet")
    text = run("bubbles", tmp_path, "--region=1,2,3 4", "--out", tmp_path / "bad", code=2)
    assert "--region, one.tif: is no polygon" in text and not (tmp_path / "bad").exists()
    (tmp_path / "none").mkdir()
    assert "holds no image" in run("bubbles", tmp_path / "none", code=2)


def test_the_manifest_has_the_whole_command_line(tmp_path: Path) -> None:
    for name in ("one.png", "number two.png"):
        cv2.imwrite(str(tmp_path / name), np.full((60, 80), 200, np.uint8))
    line = ["bubbles", "one.png", "number two.png", "--out", "found", "--min-diameter", "9"]
    subprocess.run(
        [sys.executable, "-m", "telerig", *line], cwd=tmp_path, timeout=120, check=True
    )  # fmt: skip
    assert section_of(tmp_path / "found", "bubbles")["again"] == shlex.join(["telerig", *line])
    images = [str(tmp_path / name) for name in ("one.png", "number two.png")]
    run("bubbles", *images, "--out", tmp_path / "here", "--quiet")
    again = shlex.join(["telerig", "bubbles", *images, "--out", str(tmp_path / "here")])
    assert section_of(tmp_path / "here", "bubbles")["again"] == again


def section_of(folder: Path, command: str) -> dict[str, object]:
    content = json.loads((folder / "manifest.json").read_text())
    section = content["sections"][command]
    assert isinstance(section, dict)
    return section


def test_only_telerigs_own_command_line_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    package = Path(telerig.__file__).parent
    rest = ["track", "a run", "--quiet"]
    for program in ("/usr/bin/telerig", str(package / "__main__.py"), inspect.getfile(console)):
        monkeypatch.setattr(sys, "argv", [program, *rest])
        assert console.typed_command() == "telerig track 'a run' --quiet"
    for program in ("/lib/pytest/__main__.py", "/home/lab/nightly.py"):
        monkeypatch.setattr(sys, "argv", [program, *rest])
        assert console.typed_command() == ""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["report", "TANK", "--run", "x"], "add --film"),
        (["init", "new", "--pitch", "7"], "add --from-images"),
        (["init", "new", "--size", "640.5x480"], "whole numbers are needed"),
        (["import", "opencv", "x", "--out", "new", "--image-size", "nan,480"], "2 numbers are"),
        (["view", "TANK", "--web", "--save", "a.rrd"], "give only one of them"),
        (["simulate", "paper", "--devices"], "give only one of them"),
        (["simulate", "paper", "--out", "new", "--seconds", "5"], "is for --devices"),
        (["simulate", "paper", "--out", "new", "--seed", "-1"], "--seed"),
        (["simulate", "rise", "--out", "new", "--encoder-scale", "nan"], "encoder_scale is nan"),
        (["simulate", "rise", "--out", "new", "--accelerometers", "left,roof"], "'roof' cannot"),
        (["export", "TANK", "--to", "csv"], "there is no such format"),
        (["calibrate", "TANK", "--out", "TANK/rig.toml"], "is a file"),
        (["track", "TANK"], "is not the folder of a run"),
    ],
)
def test_options_without_effect_and_impossible_ones(
    paper_images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    shown = run(*(word.replace("TANK", str(paper_images)) for word in words), code=2)
    assert said in " ".join(shown.replace("│", " ").split())
    assert not list(tmp_path.iterdir())


def test_a_name_that_is_too_long_is_no_fault_of_telerig() -> None:
    error = OSError(errno.ENAMETOOLONG, "File name too long")
    assert "give a shorter name" in console._words_of_system(error)
