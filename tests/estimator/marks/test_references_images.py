"""Strips of dots in images: found, followed and used, against the simulator's truth."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import telerig
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.estimator.marks.following import HIDDEN, StripInImages, TankView
from telerig.estimator.marks.strip_dots import find_dots, learn_look
from telerig.estimator.smoothing.results_folder import smooth_run
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.config import RunConfig, StripConfig
from telerig.io.simulation.presets import run_preset
from telerig.scripts.main import app

pytestmark = pytest.mark.slow
UP = np.array([0.0, -1.0, 0.0])
FRAMES = 56


def config() -> RunConfig:
    """Small images; the strip is so near the middle that the bubble passes in front of it."""
    chosen = run_preset("rise", frames=FRAMES, strip=StripConfig(dots=5, at=0.15))
    cameras = tuple(replace(c, image_size_px=(320, 320)) for c in chosen.calibration.cameras)
    return replace(chosen, calibration=replace(chosen.calibration, cameras=cameras, views=1))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulated and tracked by the command."""
    folder = tmp_path_factory.mktemp("strip") / "data"
    telerig.simulate(config(), rng=np.random.default_rng(4), out=folder)
    shutil.rmtree(folder / "calibration")
    cameras = list(true_cameras(config().calibration).values())
    calibration_from_cameras(cameras, name="truth").save(folder / "results" / "calibration")
    command = ["track", str(folder / "runs" / "rise"), "--no-report", "--quiet"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert "marks of the strip" in result.output
    return folder


def truth(data: Path, name: str) -> pd.DataFrame:
    return pd.read_csv(data / "truth" / "runs" / "rise" / f"{name}.csv")


def nearest(sightings: pd.DataFrame, dots: pd.DataFrame) -> pd.DataFrame:
    """Each sighting beside the true dot nearest to it."""
    both = sightings.merge(dots, on=["frame", "camera"], suffixes=("", "_true"))
    off = np.hypot(both["u_px"] - both["u_px_true"], both["v_px"] - both["v_px_true"])
    both = both.assign(off=off)
    return both.loc[both.groupby(["frame", "camera", "mark"])["off"].idxmin()]


def free_dots(data: Path) -> pd.DataFrame:
    """Dots well inside the images and well away from the bubble."""
    both = truth(data, "references").merge(truth(data, "bubbles"), on="frame")
    away = pd.Series(False, both.index)
    for camera in ("left", "right"):
        off = np.hypot(
            both["u_px"] - both[f"{camera}_silhouette_u_px"],
            both["v_px"] - both[f"{camera}_silhouette_v_px"],
        )
        away |= (both["camera"] == camera) & (off > 48)
    inside = (both["v_px"] > 10) & (both["v_px"] < 309)
    return both.loc[away & inside, ["frame", "camera", "dot"]]


def test_sightings_are_as_good_as_they_say(data: Path) -> None:
    found = pd.read_csv(data / "results" / "rise" / "references.csv")
    assert list(found) == ["frame", "camera", "mark", "u_px", "v_px", "sigma_px"]
    pairs = nearest(found, truth(data, "references"))
    error = np.concatenate([pairs["u_px"] - pairs["u_px_true"], pairs["v_px"] - pairs["v_px_true"]])
    assert len(pairs) == len(found)
    assert np.sqrt(np.mean(error**2)) < 1.3 * np.sqrt(np.mean(found["sigma_px"] ** 2))
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert np.abs(error).max() < 0.15
    free = free_dots(data)
    seen = free.merge(pairs, on=["frame", "camera", "dot"])
    assert len(seen) > 0.97 * len(free) > 300


def test_a_mark_is_one_dot_throughout(data: Path) -> None:
    found = pd.read_csv(data / "results" / "rise" / "references.csv")
    pairs = nearest(found, truth(data, "references"))
    assert pairs.groupby(["camera", "mark"])["dot"].nunique().max() == 1
    assert pairs.groupby(["camera", "dot"])["mark"].nunique().max() == 1
    marks = found.groupby("camera")["mark"].agg(["min", "max", "nunique"])
    assert marks.loc["left", "max"] < 1000 <= marks.loc["right", "min"]
    assert (marks["nunique"] > 15).all(), "dots left the image and others came"


def test_a_dot_behind_a_bubble_is_left_out_and_comes_back(data: Path) -> None:
    told = json.loads((data / "results" / "rise" / "tracking.json").read_text(encoding="utf-8"))
    cameras = told["references"]["cameras"]
    assert sum(c["left_out"].get(HIDDEN, 0) for c in cameras.values()) > 3
    for name, camera in cameras.items():
        table = pd.read_csv(data / "results" / "rise" / "references.csv")
        mine = table[table["camera"] == name]
        assert (camera["marks"], camera["sightings"]) == (mine["mark"].nunique(), len(mine))
        assert camera["median_sigma_px"] == pytest.approx(mine["sigma_px"].median())
        assert camera["breaks"] == []


def test_no_dot_becomes_a_bubble_and_no_bubble_a_mark(data: Path) -> None:
    bubbles = truth(data, "bubbles")
    detections = pd.read_csv(data / "results" / "rise" / "detections.csv")
    assert len(detections) == 2 * FRAMES
    marks = pd.read_csv(data / "results" / "rise" / "references.csv")
    for camera in ("left", "right"):
        place = bubbles.set_index("frame")[
            [f"{camera}_silhouette_u_px", f"{camera}_silhouette_v_px"]
        ].to_numpy()
        mine = detections[detections["camera"] == camera].sort_values("frame")
        whole = ~mine["flags"].astype(str).str.contains("border").to_numpy()
        off = np.abs(mine[["u_px", "v_px"]].to_numpy() - place)
        assert off[whole].max() < 1.0 and off.max() < 3.0
        mine = marks[marks["camera"] == camera]
        apart = mine[["u_px", "v_px"]].to_numpy() - place[mine["frame"]]
        assert np.linalg.norm(apart, axis=1).min() > 15
    tracks = pd.read_csv(data / "results" / "rise" / "tracks.csv")
    assert len(set(tracks["particle"])) == 1


def test_smoothing_uses_the_marks_that_were_followed(data: Path, tmp_path: Path) -> None:
    run = telerig.load_run(data / "runs" / "rise")
    calibration = telerig.load_calibration(data / "results" / "calibration" / "calibration.json")
    bare = tmp_path / "bare"
    shutil.copytree(data / "results" / "rise", bare)
    (bare / "references.csv").unlink()
    errors = {}
    for name, tracks in (("marks", data / "results" / "rise"), ("none", bare)):
        found = smooth_run(run, calibration, tracks, tmp_path / name, report=name == "marks")
        joined = found.trajectories.merge(truth(data, "bubbles"), on="frame", suffixes=("", "_t"))
        errors[name] = float((joined["y_mm"] - joined["y_lab_mm"]).std())
        if name == "marks":
            assert found.verdict["axes"]["y"]["verdict"] == "RESOLVED"
            assert found.verdict["verdict"] == "RESOLVED"
    assert errors["marks"] < 0.5 * errors["none"]
    page = (tmp_path / "marks" / "report.html").read_text(encoding="utf-8")
    assert "Marks fixed to the tank, left" in page
    manifest = json.loads((tmp_path / "marks" / "manifest.json").read_text(encoding="utf-8"))
    inputs = manifest["sections"]["smooth"]["inputs"]
    assert any(name.endswith("rise/references.csv") for name in inputs)


def short(data: Path, target: Path, frames: int = 5) -> Path:
    """The first frames of the run as a dataset of its own."""
    run = target / "runs" / "rise"
    run.mkdir(parents=True)
    shutil.copy(data / "rig.toml", target)
    shutil.copytree(data / "results" / "calibration", target / "results" / "calibration")
    source = data / "runs" / "rise"
    shutil.copy(source / "stage.csv", run)
    pd.read_csv(source / "frames.csv").iloc[:frames].to_csv(run / "frames.csv", index=False)
    for camera in ("left", "right"):
        (run / camera).mkdir()
        for file in sorted((source / camera).iterdir())[:frames]:
            shutil.copy(file, run / camera)
    return run


def tracked(run: Path) -> tuple[str, dict[str, Any]]:
    result = CliRunner().invoke(app, ["track", str(run), "--no-report", "--quiet"])
    assert result.exit_code == 0, result.output
    place = run.parent.parent / "results" / "rise"
    return result.output, json.loads((place / "tracking.json").read_text(encoding="utf-8"))


def test_a_strip_that_is_not_there_is_told_and_the_work_goes_on(data: Path, tmp_path: Path) -> None:
    run = short(data, tmp_path / "data")
    rig = tmp_path / "data" / "rig.toml"
    text = rig.read_text(encoding="utf-8")
    rig.write_text(text.replace("dot_diameter_mm = 1.0\n", "dot_diameter_mm = 2.4\n"))
    stale = tmp_path / "data" / "results" / "rise" / "references.csv"
    stale.parent.mkdir(parents=True)
    stale.write_text("of an earlier run")
    output, summary = tracked(run)
    assert output.count("none is seen in the images") == 2
    assert "dot_diameter_mm" in output
    assert not stale.exists()
    assert summary["references"]["cameras"]["left"]["marks"] == 0


def test_a_strip_in_one_view_only(data: Path, tmp_path: Path) -> None:
    import tifffile

    run = short(data, tmp_path / "data")
    strip = truth(data, "references")
    for file in sorted((run / "right").iterdir()):
        image = tifffile.imread(file)
        mine = strip[(strip["frame"] == int(file.stem)) & (strip["camera"] == "right")]
        v, u = np.mgrid[: image.shape[0], : image.shape[1]]
        for place in mine[["u_px", "v_px"]].to_numpy():
            disc = np.hypot(u - place[0], v - place[1]) < 9
            image[disc] = np.roll(image, 40, axis=1)[disc]
        tifffile.imwrite(file, image)
    output, summary = tracked(run)
    cameras = summary["references"]["cameras"]
    assert (cameras["left"]["marks"] >= 5, cameras["right"]["marks"]) == (True, 0)
    assert "camera right: rig.toml describes a strip" in output
    table = pd.read_csv(tmp_path / "data" / "results" / "rise" / "references.csv")
    assert set(table["camera"]) == {"left"}


def test_the_runs_own_table_goes_first(data: Path, tmp_path: Path) -> None:
    run = short(data, tmp_path / "data")
    own = pd.read_csv(data / "results" / "rise" / "references.csv").query("frame < 5")
    own.to_csv(run / "references.csv", index=False)
    _, summary = tracked(run)
    assert "references" not in summary
    assert not (tmp_path / "data" / "results" / "rise" / "references.csv").exists()


def test_images_are_the_same_without_a_strip(tmp_path: Path) -> None:
    """The strip's own random numbers leave all others as they were."""
    chosen = replace(config(), frames=2)
    for name, strip in (("with", chosen.strip), ("without", None)):
        some = replace(chosen, strip=strip)
        telerig.simulate(some, rng=np.random.default_rng(1), out=tmp_path / name)
    names = ["frames.csv", "stage.csv"]
    for name in names:
        one, other = (tmp_path / n / "runs" / "rise" / name for n in ("with", "without"))
        assert one.read_bytes() == other.read_bytes()
    one, other = (tmp_path / n / "truth" / "runs" / "rise" for n in ("with", "without"))
    assert (one / "bubbles.csv").read_bytes() == (other / "bubbles.csv").read_bytes()
    assert "strip" not in json.loads((other / "truth.json").read_text(encoding="utf-8"))["config"]
    assert "[references]" not in (tmp_path / "without" / "rig.toml").read_text(encoding="utf-8")


def test_the_command_draws_a_strip(tmp_path: Path) -> None:
    out = tmp_path / "data"
    command = ["simulate", "rise", "--frames", "1", "--references", "4", "--out", str(out)]
    assert CliRunner().invoke(app, command).exit_code == 0
    seen = pd.read_csv(out / "truth" / "runs" / "rise" / "references.csv")
    assert set(seen["camera"]) == {"left", "right"}
    assert not (out / "runs" / "rise" / "references.csv").exists()
    bare = CliRunner().invoke(app, [*command[:-1], str(tmp_path / "b"), "--no-images"])
    assert bare.exit_code == 0
    assert (tmp_path / "b" / "runs" / "rise" / "references.csv").is_file()
    refused = CliRunner().invoke(app, ["simulate", "paper", "--references", "4", "--out", "x"])
    assert refused.exit_code == 2


def test_cut_dots_and_erased_ones(data: Path) -> None:
    """Dots at the border are no sightings; erased images hold none."""
    run = telerig.load_run(data / "runs" / "rise")
    mine = true_cameras(config().calibration)["left"]
    images = [run.image("left", f) for f in range(0, FRAMES, 14)]
    look = learn_look(
        [i for i in images if i is not None],
        TankView.of(mine, UP).travel_px_per_mm,
        polarity="black_on_white",
        diameter_px=10.0,
    )
    assert look is not None
    image = images[1]
    assert image is not None
    dots = find_dots(image, look)
    cut = image[int(dots.uv_px[:, 1].min()) :]
    assert len(find_dots(cut, look).uv_px) == len(dots.uv_px) - 1
    view = TankView.of(mine, UP)
    strip = StripInImages(
        view, look, view.lab_mm(dots.uv_px, 0.0), np.zeros(len(dots.uv_px), np.int64),
        np.zeros(1, np.int64), np.zeros((1, 2)), np.zeros(1), (0.0, 0.0), 1.0,
    )  # fmt: skip
    assert len(find_dots(strip.erased(image, 0), look).uv_px) == 0
