"""A run from images or detections to tracks: against the simulator's truth, stopped, resumed."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import telerig
from telerig.errors import CalibrationError, InputError
from telerig.estimator.bubbles.outline.ellipse_geometry import outline_points
from telerig.estimator.calibration.result.calibration import (
    Calibration,
    calibration_from_cameras,
)
from telerig.estimator.tracking import detect_run
from telerig.estimator.tracking import track as track_module
from telerig.estimator.tracking.linking.frames_to_rows import Linked
from telerig.estimator.tracking.linking.tracker import Tracker
from telerig.estimator.tracking.results_folder import WORK, _Worst, write_tracking
from telerig.estimator.tracking.track import TrackOptions, tracking_stream
from telerig.estimator.tracking.tracks import Tracks
from telerig.io.results.calibration_words import NO_COVARIANCE
from telerig.io.results.stale import stale
from telerig.io.rig_file.rig_file import read_rig_toml, write_rig_toml
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.io.tables.table import COVARIANCE, PIXEL, PIXEL_COVARIANCE, POINT
from telerig.scripts.main import app

FRAMES = 10


@pytest.fixture(scope="module")
def rise(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One bubble from images; the calibration views are not needed."""
    folder = tmp_path_factory.mktemp("rise") / "data"
    config = run_preset("rise", frames=FRAMES)
    telerig.simulate(config, rng=np.random.default_rng(11), out=folder)
    shutil.rmtree(folder / "calibration")
    truth_calibration().save(folder / "results" / "calibration")
    return folder


@pytest.fixture(scope="module")
def whole(rise: Path) -> Tracks:
    return telerig.track(telerig.load_run(rise / "runs" / "rise"), truth_calibration())


def truth_calibration(preset: str = "rise") -> Calibration:
    return calibration_from_cameras(
        list(true_cameras(run_preset(preset).calibration).values()), name="truth"
    )


def truth_of(data: Path, run: str) -> pd.DataFrame:
    return pd.read_csv(data / "truth" / "runs" / run / "bubbles.csv")


def tracked(data: Path, folder: Path, **changes: Any) -> dict[str, Any]:
    run = replace(telerig.load_run(data / "runs" / "rise"), **changes)
    return write_tracking(
        run, truth_calibration(), folder, options=TrackOptions(), record={}, report=False
    )


def test_one_bubble_is_one_track_at_the_true_pixels(rise: Path, whole: Tracks) -> None:
    assert len(whole) == 1
    table = whole.table.merge(truth_of(rise, "rise"), on="frame", suffixes=("", "_true"))
    assert len(table) == FRAMES
    for camera in ("left", "right"):
        for x in "uv":
            error = table[f"{camera}_{x}_px"] - table[f"{camera}_silhouette_{x}_px"]
            assert np.sqrt((error**2).mean()) < 0.25
    assert np.allclose(table["d_eq_mm"], table["d_eq_mm_true"], rtol=0.03)


def test_min_contrast_reaches_the_detection(rise: Path) -> None:
    run = telerig.load_run(rise / "runs" / "rise").first(1)
    with pytest.raises(InputError, match="no bubble was found in 1 frame"):
        telerig.track(run, truth_calibration(), options=TrackOptions(min_contrast=0.98))


def test_detections_alone_give_the_same_track(rise: Path, whole: Tracks, tmp_path: Path) -> None:
    bare = tmp_path / "data" / "runs" / "rise"
    bare.mkdir(parents=True)
    shutil.copy(rise / "rig.toml", tmp_path / "data" / "rig.toml")
    for name in ("frames.csv", "stage.csv"):
        shutil.copy(rise / "runs" / "rise" / name, bare / name)
    columns = ["frame", "camera", "u_px", "v_px"]
    whole.detections[columns].to_csv(bare / "detections.csv", index=False)
    again = telerig.track(telerig.load_run(bare), truth_calibration())
    names = ["left_u_px", "left_v_px", "right_u_px", "right_v_px"]
    assert np.allclose(again.table[names], whole.table[names])
    assert set(again.table["centre"]) == {"silhouettes"}


def test_centres_without_outlines_are_as_good_as_their_ray_misses_say(rise: Path) -> None:
    """Their shapes shift them by 0.4 px, four times the noise that is stated."""
    run, cameras = telerig.load_run(rise / "runs" / "rise"), truth_calibration().cameras
    rng, rows, truth = np.random.default_rng(3), [], []
    start = np.array([[x, 2.0 * x, z] for x in (-6.0, 0.0, 6.0) for z in (-5.0, 5.0)])
    for frame in range(FRAMES):
        truth.append(start - [0.0, 0.5 * frame, 0.0])
        for camera in cameras:
            for u, v in camera.project(truth[-1]) + 0.4 * rng.standard_normal((len(start), 2)):
                rows.append((frame, camera.name, u, v, 0.01, 0.0, 0.01, ""))
    names = ["frame", "camera", *PIXEL, *PIXEL_COVARIANCE, "particle"]
    given = pd.DataFrame(rows, columns=names)
    found = telerig.track(
        replace(run, detections=given, source="detections"), truth_calibration()
    ).table
    every = np.stack(truth)[found["frame"]] - found[[*POINT]].to_numpy()[:, None]
    error = every[np.arange(len(found)), np.linalg.norm(every, axis=2).argmin(1)]
    covariance = np.zeros((len(found), 3, 3))
    covariance[:, *np.triu_indices(3)] = found[[*COVARIANCE]].to_numpy()
    covariance += np.triu(covariance, 1).mT
    nees = (error * np.linalg.solve(covariance, error[..., None])[..., 0]).mean()
    assert len(found) == FRAMES * len(start)
    assert 0.6 < nees < 4.0, "19 with the stated noise alone"
    assert (found["left_suu_px2"] > 0.04).all()


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.6, 0.0, -0.8)])
def test_the_summary_says_what_is_up(rise: Path, whole: Tracks, up: tuple[float, ...]) -> None:
    run = telerig.load_run(rise / "runs" / "rise")
    assert run.rig is not None and run.rig.stage is not None
    rig = replace(run.rig, stage=replace(run.rig.stage, up=up))
    detections = whole.detections.drop(columns="particle")
    turned = replace(run, detections=detections, source="detections", rig=rig)
    assert telerig.track(turned, truth_calibration()).summary["up"] == pytest.approx(up)


def test_the_tracker_is_told_what_is_up(
    rise: Path, whole: Tracks, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = telerig.load_run(rise / "runs" / "rise")
    assert run.rig is not None and run.rig.stage is not None and run.position_mm is not None
    told = []

    def tracker(*given: Any, up: Any, **more: Any) -> Tracker:
        told.append((given[0].tolist(), up.tolist()))
        return Tracker(*given, up=up, **more)

    monkeypatch.setattr(track_module, "Tracker", tracker)
    stage = replace(run.rig.stage, axis=(0.0, 1.0, 0.0), up=(0.0, -1.0, 0.0))
    counted = replace(
        run, detections=whole.detections.drop(columns="particle"), source="detections",
        rig=replace(run.rig, stage=stage), position_mm=-run.position_mm,
    )  # fmt: skip
    assert len(telerig.track(counted, truth_calibration())) == 1
    assert told == [([0.0, 1.0, 0.0], [0.0, -1.0, 0.0])]


def test_detections_without_a_rig_have_the_calibrations_image_sizes(
    rise: Path, whole: Tracks, tmp_path: Path
) -> None:
    shutil.copy(rise / "runs" / "rise" / "frames.csv", tmp_path)
    whole.detections.drop(columns="particle").to_csv(tmp_path / "detections.csv", index=False)
    calibration = truth_calibration()
    run = telerig.load_run(tmp_path, cameras=[c.name for c in calibration.cameras])
    summary = telerig.track(run, calibration).summary
    assert summary["image_size_px"] == {c.name: c.image_size_px for c in calibration.cameras}


def test_given_ids_pass_through(rise: Path, whole: Tracks) -> None:
    run = telerig.load_run(rise / "runs" / "rise")
    given = whole.detections[["frame", "camera", "u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"]]
    for text, expected in (("41", 41), ("41.0", 41), ("bubble A", "bubble A")):
        changed = replace(run, detections=given.assign(particle=text), source="detections")
        again = telerig.track(changed, truth_calibration())
        assert set(again.table["particle"]) == {expected}
        assert set(again.detections["particle"]) == {expected}


@pytest.mark.parametrize(
    ("ids", "numbers"),
    [
        (("1.0", "20.0"), {"1.0": 1, "20.0": 20}),
        (("1", "2.0"), {"1": 1, "2.0": 2}),
        (("1", "1.0"), None),
        (("1.0", "1.5"), None),
        (("-1.0",), None),
        (("1.0", "a"), None),
    ],
)
def test_ids_that_are_all_whole_numbers_are_such(
    ids: tuple[str, ...], numbers: dict[str, int] | None
) -> None:
    """pandas writes 1 as "1.0" where other cells of the column are blank."""
    found, names = track_module.numbers_of(set(ids))
    assert (found if names is None else None) == numbers


def test_an_id_given_in_one_camera_stays(rise: Path, whole: Tracks) -> None:
    """A track without a given id passes through a detection that has one and no partner."""
    table = whole.detections.drop(columns="particle").assign(particle="")
    one = table["frame"].isin([7, 8]) & (table["camera"] == "left")
    table.loc[one, "particle"] = "55"
    table = table[one | ~table["frame"].isin([7, 8])].reset_index(drop=True)
    run = replace(telerig.load_run(rise / "runs" / "rise"), detections=table, source="detections")
    again = telerig.track(run, truth_calibration()).detections
    assert set(again.loc[again["frame"].isin([7, 8]), "particle"]) == {55}


@pytest.mark.parametrize("name", ["0", "1", "02", "a", str(10**15 + 1), str(10**20)])
def test_a_new_track_has_no_given_name(rise: Path, whole: Tracks, name: str) -> None:
    """A named bubble beside one without a name: each is one track, also in the events."""
    table = whole.detections.drop(columns="particle")
    beside = table.assign(particle="", v_px=table["v_px"] + 60.0)
    both = pd.concat([table.assign(particle=name), beside], ignore_index=True)
    run = replace(telerig.load_run(rise / "runs" / "rise"), detections=both, source="detections")
    again = telerig.track(run, truth_calibration())
    tracks = again.table.assign(particle=again.table["particle"].astype(str))
    assert tracks["particle"].nunique() == 2 and not tracks.duplicated(["frame", "particle"]).any()
    assert name in set(tracks["particle"])
    births = again.events[again.events["kind"] == "birth"]
    assert set(births["particles"]) == set(tracks["particle"])


def test_named_bubbles_are_tracked_but_not_reported_nor_smoothed(
    rise: Path, whole: Tracks, tmp_path: Path
) -> None:
    table = whole.detections.drop(columns="particle").assign(particle="first")
    lonely = table[(table["frame"] == 4) & (table["camera"] == "left")]
    lonely = lonely.assign(particle="", v_px=lonely["v_px"] + 80.0)
    table = pd.concat([table, lonely], ignore_index=True)
    run = replace(telerig.load_run(rise / "runs" / "rise"), detections=table, source="detections")
    asked: dict[str, Any] = {"options": TrackOptions(), "record": {}}
    with pytest.raises(InputError, match=r"'first' is no whole number.*\n.*--no-report"):
        write_tracking(run, truth_calibration(), tmp_path / "out", **asked)
    assert list(tmp_path.iterdir()) == []
    write_tracking(run, truth_calibration(), tmp_path / "out", **asked, report=False)
    tracks = telerig.load_tracks(tmp_path / "out")
    assert set(tracks.table["particle"]) == {"first"}
    assert set(tracks.detections["particle"]) == {"first", ""}
    (worst,) = tracks.summary["worst_frames"]
    assert (worst["frame"], worst["why"]) == (4, "1 without partner or track")
    with pytest.raises(InputError, match="'first' is no whole number"):
        telerig.smooth(tracks, truth_calibration())


def test_an_interrupted_run_goes_on_and_ends_alike(
    rise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = tmp_path / "whole"
    tracked(rise, whole)
    seen: list[int] = []
    original = detect_run._detect

    def stops(scene: Any, camera: str, frame: int) -> Any:
        if frame == 6:
            raise KeyboardInterrupt
        return original(scene, camera, frame)

    def counts(scene: Any, camera: str, frame: int) -> Any:
        seen.append(frame)
        return original(scene, camera, frame)

    monkeypatch.setattr(detect_run, "quick_workers", lambda tasks: 1)
    monkeypatch.setattr(detect_run, "_detect", stops)
    parts = tmp_path / "parts"
    with pytest.raises(KeyboardInterrupt):
        tracked(rise, parts)
    assert not parts.exists()
    monkeypatch.setattr(detect_run, "_detect", counts)
    tracked(rise, parts)
    assert min(seen) > 0 and max(seen) == FRAMES - 1
    for name in ("detections.csv", "tracks.csv", "events.csv"):
        assert (parts / name).read_bytes() == (whole / name).read_bytes()
    assert not list(tmp_path.glob(".*work"))


def test_another_number_of_cores_takes_up_old_detections(
    rise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count, missing = 3000, list[int]()
    run = telerig.load_run(rise / "runs" / "rise")
    run = replace(run, frame_count=count, t_s=np.arange(count) / 100.0, position_mm=None)

    def stops(_scene: Any, store: detect_run.DetectionStore, *_: Any) -> None:
        missing.append(len(store.missing()))
        store.path(store.missing()[0]).write_text("frame\n", encoding="utf-8")
        raise KeyboardInterrupt

    monkeypatch.setattr(track_module, "make_scene", lambda *_: None)
    monkeypatch.setattr(track_module, "detect_missing", stops)
    for cores in ("2", "16", "1"):
        monkeypatch.setenv("TELERIG_CORES", cores)
        with pytest.raises(KeyboardInterrupt):
            tracking_stream(run, truth_calibration(), tmp_path / "work")
    assert missing[0] - missing[1] == missing[1] - missing[2] == 1


def test_pictures_show_what_the_tables_say(
    rise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Detection is made to find the bubble elsewhere than it is, and a shadow that is none."""
    original = detect_run._detect

    def elsewhere(scene: Any, camera: str, frame: int) -> Any:
        found, rejected = original(scene, camera, frame)
        speck = {"u_px": 30.0, "v_px": 40.0, "radius_px": 6.0, "reason": "a speck"}
        speck |= {"frame": frame, "camera": camera}
        found["v_px"] += 25.0
        return found, pd.concat([rejected, pd.DataFrame([speck])])

    monkeypatch.setattr(detect_run, "_detect", elsewhere)
    tracked(rise, tmp_path / "out")
    table = pd.read_csv(tmp_path / "out" / "detections.csv", dtype={"camera": str})
    pictures = sorted((tmp_path / "out" / "overlays").glob("*/*.jpg"))
    assert len(pictures) == 2 * 3  # of the first, a middle and the last frame
    for path in pictures:
        camera = path.parent.name
        row = table[(table["camera"] == camera) & (table["frame"] == int(path.stem))].iloc[0]
        overlay = cv2.imread(str(path))
        u, v = np.rint(outline_points(row, 40)).astype(int).T
        line, beside = (np.ptp(overlay[w, u].astype(int), axis=1) > 30 for w in (v, v - 25))
        assert line.mean() > 0.9 and beside.mean() < 0.4
        colour = np.ptp(overlay[36:45, 20:81].astype(int), axis=2)
        assert colour[:, :21].max() > 60 and colour[:, 40:].max() < 30


def test_corrected_images_are_those_of_a_whole_tracking(
    rise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    shutil.copytree(rise, data)
    tracked(data, out)
    text = "action,particle,other,frame,reason\nsplit,0,5,6,x\n"
    (data / "runs" / "rise" / "corrections.csv").write_text(text, encoding="utf-8")
    with monkeypatch.context() as patch:
        patch.setattr(track_module, "make_scene", lambda *_: pytest.fail("repeated"))
        tracked(data, out)
    tracked(data, tmp_path / "whole")
    names = [f.relative_to(out) for f in out.rglob("*.*") if WORK not in f.parts]
    kinds = {name.suffix for name in names}
    assert kinds == {".csv", ".json", ".jpg"}
    for name in set(names) - {Path("run.json"), Path("manifest.json")}:
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert set(pd.read_csv(out / "tracks.csv")["particle"]) == {0, 5}


def test_results_inside_the_run_are_no_input(rise: Path, tmp_path: Path) -> None:
    """A run that belongs to no dataset has its results, and its work folder, inside."""
    data = tmp_path / "data"
    shutil.copytree(rise, data)
    run = telerig.load_run(data / "runs" / "rise")
    before = detect_run.fingerprint(run, {})
    work = run.path / ".results.work"
    work.mkdir()
    (work / "detections-0000000.csv").write_text("frame\n", encoding="utf-8")
    assert detect_run.fingerprint(run, {}) == before
    next((run.path / "left").iterdir()).unlink()
    assert detect_run.fingerprint(run, {}) != before


def test_other_options_do_not_take_up_old_detections(rise: Path, tmp_path: Path) -> None:
    store = detect_run.DetectionStore(tmp_path / "work", "one", 20)
    store.path(store.batches[0]).write_text("frame\n", encoding="utf-8")
    same = detect_run.DetectionStore(tmp_path / "work", "one", 20)
    assert len(same.missing()) == len(same.batches) - 1
    other = detect_run.DetectionStore(tmp_path / "work", "two", 20)
    assert other.missing() == other.batches


def test_a_frame_missing_in_one_camera_is_told(rise: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    shutil.copytree(rise, data)
    file = sorted((data / "runs" / "rise" / "right").iterdir())[5]
    file.unlink()
    tracks = telerig.track(telerig.load_run(data / "runs" / "rise"), truth_calibration())
    assert sorted(tracks.table["frame"]) == [f for f in range(FRAMES) if f != 5]
    assert tracks.summary["frames_without_bubbles"]["right"] == {"no image": 1}
    seen = tracks.detections[tracks.detections["frame"] == 5]
    assert set(seen[seen["camera"] == "left"]["particle"]) == set(tracks.table["particle"])


def test_calibration_of_another_rig(rise: Path) -> None:
    run = telerig.load_run(rise / "runs" / "rise")
    good = truth_calibration()
    renamed = replace(good, cameras=tuple(replace(c, name=c.name + "2") for c in good.cameras))
    with pytest.raises(CalibrationError, match="left2"):
        telerig.track(run, renamed)
    larger = replace(
        good, cameras=tuple(replace(c, image_size_px=(1280, 800)) for c in good.cameras)
    )
    with pytest.raises(CalibrationError, match="512 x 512"):
        telerig.track(run, larger)
    with pytest.raises(CalibrationError, match="two cameras"):
        telerig.track(run, replace(good, cameras=good.cameras[:1]))


def test_a_single_frame_is_a_track_of_one_point(rise: Path, whole: Tracks) -> None:
    run = telerig.load_run(rise / "runs" / "rise")
    first = whole.detections[whole.detections["frame"] == 0].assign(particle="")
    one = replace(
        run, detections=first, source="detections", frame_count=1, t_s=run.t_s[:1],
        position_mm=None,
    )  # fmt: skip
    table = telerig.track(one, truth_calibration()).table
    names = ["left_u_px", "right_v_px", "x_mm", "z_mm"]
    expected = whole.table[whole.table["frame"] == 0]
    assert len(table) == 1
    assert np.allclose(table[names], expected[names], atol=0.05)


def test_a_crowded_run_is_warned_about(rise: Path, whole: Tracks) -> None:
    """Four bubbles in every image, each covering 5 % of it; one as large as all is no crowd."""
    assert whole.summary["warnings"] == [NO_COVARIANCE]
    run = telerig.load_run(rise / "runs" / "rise")
    width, height = run.image_sizes_px["left"]
    copies = []
    for k in range(4):
        moved = whole.detections.assign(particle=k, area_px2=0.05 * width * height)
        copies.append(moved.assign(v_px=moved["v_px"] + 40.0 * k))
    for table, count in (
        (pd.concat(copies), 2),
        (copies[0].assign(area_px2=0.2 * width * height), 0),
    ):
        tracks = telerig.track(
            replace(run, detections=table, source="detections"), truth_calibration()
        )
        said = [w for w in tracks.summary["warnings"] if "bubbles cover 20%" in w]
        assert len(said) == count


@pytest.mark.parametrize("reach", [1.3, 2.3])
def test_a_run_that_is_not_backlit_is_warned_about(
    rise: Path, whole: Tracks, tmp_path: Path, reach: float
) -> None:
    """Bright spots, ``reach`` times as wide as their dark hearts, in place of the bubble."""
    shutil.copytree(rise, tmp_path / "data")
    run = telerig.load_run(tmp_path / "data" / "runs" / "rise")
    for row in whole.detections.itertuples():
        width, height = run.image_sizes_px[row.camera]
        v, u = np.mgrid[:height, :width]
        far = np.hypot(u - row.u_px, v - row.v_px) / (row.d_eq_px / 2.0)
        image = np.where(far < reach, 170.0, 60.0)
        image[far < 1.0] = 15.0
        noise = np.random.default_rng(row.frame).normal(0.0, 1.0, image.shape)
        image = cv2.GaussianBlur(image, (0, 0), 1.5) + noise
        (file,) = (run.path / row.camera).glob(f"*{row.frame:06d}.*")
        cv2.imwrite(str(file), np.clip(np.rint(image), 0, 255).astype(np.uint8))
    warnings = telerig.track(run, truth_calibration()).summary["warnings"]
    said = [w for w in warnings if "the scene is not backlit" in w]
    assert len(said) == 2
    assert said[0].startswith("camera left: ") and "images are dark hearts of" in said[0]


def test_bubbles_after_a_long_time_without_any(rise: Path, whole: Tracks, tmp_path: Path) -> None:
    before = 700
    late = whole.detections.assign(frame=whole.detections["frame"] + before, particle="")
    count = before + FRAMES
    summary = tracked(
        rise, tmp_path / "late", detections=late, source="detections", frame_count=count,
        t_s=np.arange(count) / 100.0, position_mm=None,
    )  # fmt: skip
    assert (summary["points"], summary["tracks"]) == (FRAMES, 1)
    assert f"The run gives {FRAMES} pairs" in summary["pairs"]["words"][0]


def test_a_run_that_one_camera_sees_is_written(rise: Path, whole: Tracks, tmp_path: Path) -> None:
    left = whole.detections[whole.detections["camera"] == "left"].assign(particle="")
    summary = tracked(rise, tmp_path / "left", detections=left, source="detections")
    assert (summary["points"], summary["detections_without_partner_or_track"]) == (0, FRAMES)
    assert "No frame has detections in both cameras" in summary["pairs"]["words"][0]


def test_a_run_without_any_bubble_says_so(rise: Path) -> None:
    run = telerig.load_run(rise / "runs" / "rise")
    table = pd.DataFrame({"frame": [0], "camera": ["left"], "u_px": [np.nan], "v_px": [np.nan]})
    with pytest.raises(InputError, match="no bubble"):
        telerig.track(replace(run, detections=table, source="detections"), truth_calibration())


def test_the_command_writes_what_the_contract_names(rise: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = CliRunner().invoke(
        app, ["track", str(rise / "runs" / "rise"), "--out", str(out), "--quiet"]
    )
    assert result.exit_code == 0, result.output
    assert "1 track, " in result.output
    names = {"detections.csv", "tracks.csv", "events.csv", "tracking.json", "run.json"}
    assert names | {"report.html"} <= {p.name for p in out.iterdir()}
    summary = json.loads((out / "tracking.json").read_text(encoding="utf-8"))
    assert summary["frames"] == FRAMES
    loaded = telerig.load_tracks(out)
    assert len(loaded) == 1 and len(loaded.table) == FRAMES


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere/runs/rise"], "there is no such run"),
        (["RUN", "--calibration", "a.txt", "--calibration", "b.json"], "the OpenLPT camera files"),
        (["RUN", "--out", "RUN"], "choose another --out"),
        (["RUN", "--from", "video"], "'detections'"),
    ],
)
def test_bad_input_of_the_command(rise: Path, arguments: list[str], words: str) -> None:
    given = [str(rise / "runs" / "rise") if a == "RUN" else a for a in arguments]
    result = CliRunner().invoke(app, ["track", *given])
    assert result.exit_code == 2
    assert words in result.output.replace("\n", " ")


def test_a_first_look_tracks_the_first_frames_and_says_so(rise: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    shutil.copytree(rise, data)
    command = ["track", str(data / "runs" / "rise"), "--no-report"]
    first = CliRunner().invoke(app, [*command, "--frames", "0:6"])
    assert first.exit_code == 0 and f"only the first 6 of {FRAMES} frames" in first.output
    assert "detection: 0 of 6" in first.stderr and "tracks: 6 of 6" in first.stderr
    looked = telerig.load_tracks(data / "results" / "rise")
    assert set(looked.table["frame"]) == set(range(6))
    run = telerig.load_run(data / "runs" / "rise")
    assert run.first(FRAMES) is run


@pytest.mark.parametrize("frames", ["500", "5:10", "0:-1", "0:x", "0:0"])
def test_frames_that_are_no_first_frames_are_refused(rise: Path, frames: str) -> None:
    command = ["track", str(rise / "runs" / "rise"), "--frames", frames, "--no-report"]
    answer = CliRunner().invoke(app, command)
    assert answer.exit_code == 2 and "->" in answer.stderr
    assert frames in answer.stderr or "number of frames is 0" in answer.stderr


def test_bubbles_are_looked_for_where_rig_toml_says(
    rise: Path, whole: Tracks, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    shutil.copytree(rise, data)
    run = data / "runs" / "rise"
    rig = (data / "rig.toml").read_text(encoding="utf-8")
    left = whole.detections[whole.detections["camera"] == "left"]
    reach = 3 * float(left["a_px"].max())
    u, v = (np.array([left[n].min() - reach, left[n].max() + reach]) for n in ("u_px", "v_px"))

    def found(rows: np.ndarray) -> pd.DataFrame:
        corners = [[u[0], rows[0]], [u[1], rows[0]], [u[1], rows[1]], [u[0], rows[1]]]
        region = [[float(x) for x in corner] for corner in corners]
        (data / "rig.toml").write_text(f"{rig}\n[bubbles.left]\nregion = {region}\n")
        return telerig.track(telerig.load_run(run), truth_calibration()).detections

    columns = ["camera", "u_px", "v_px", "flags"]
    pd.testing.assert_frame_equal(found(v)[columns], whole.detections[columns])
    cut = found(np.array([v[0], float(left["v_px"].min())]))
    flags = cut[(cut["camera"] == "left") & cut["u_px"].notna()]["flags"]
    assert len(flags) and flags.str.contains("border").all()
    beside = found(v[1] + np.array([0.2, 1.0]) * reach)
    assert beside[beside["camera"] == "left"]["u_px"].isna().all()
    assert beside[beside["camera"] == "right"]["u_px"].notna().all()

    width, height = telerig.load_run(run).rig.cameras["left"].image_size_px
    mask = np.zeros((height, width), np.uint8)
    cv2.imwrite(str(data / "mask.png"), mask)
    (data / "rig.toml").write_text(f'{rig}\n[bubbles]\nmask = "mask.png"\n')
    with pytest.raises(InputError, match=r"mask\.png: is black"):
        telerig.track(telerig.load_run(run), truth_calibration())


def test_another_mask_is_another_input(rise: Path, tmp_path: Path) -> None:
    """Tracks made with the former mask are stale, and its detections are not continued."""
    data = tmp_path / "data"
    shutil.copytree(rise, data)
    with (data / "rig.toml").open("a", encoding="utf-8") as rig:
        rig.write('\n[bubbles.left]\nmask = "mask.png"\n')
    width, height = telerig.load_run(data / "runs" / "rise").rig.cameras["left"].image_size_px
    cv2.imwrite(str(data / "mask.png"), np.full((height, width), 255, np.uint8))
    folder = data / "results" / "rise"
    tracked(data, folder)
    assert stale(folder) == ()
    cv2.imwrite(str(data / "mask.png"), np.full((height, width), 128, np.uint8))
    assert any("mask.png" in words for words in stale(folder))


def test_a_resumed_run_is_as_crowded_as_one_in_one_go(
    rise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, shares = tmp_path / "data", list[float]()
    shutil.copytree(rise, data)
    with (data / "rig.toml").open("a", encoding="utf-8") as rig:
        rig.write('\n[bubbles.left]\nmask = "mask.png"\n')
    run = telerig.load_run(data / "runs" / "rise")
    width, height = run.image_sizes_px["left"]
    mask = np.full((height, width), 255, np.uint8)
    mask[: height // 3] = 0
    cv2.imwrite(str(data / "mask.png"), mask)
    monkeypatch.setattr(track_module, "is_crowded", lambda share, *_: bool(shares.append(share)))
    for _ in range(2):
        stream = tracking_stream(run, truth_calibration(), tmp_path / "work")
        list(stream.rows)
        stream.summary()
        monkeypatch.delattr(track_module, "make_scene", raising=False)  # all detections are there
    assert shares[2:] == pytest.approx(shares[:2])


def test_where_bubbles_are_looked_for_is_read_and_written(rise: Path, tmp_path: Path) -> None:
    text = (rise / "rig.toml").read_text(encoding="utf-8")
    file = tmp_path / "rig.toml"
    file.write_text(
        text + '\n[bubbles]\nmask = "m.png"\n[bubbles.left]\nregion = [[1, 2], [3, 4], [5.5, 0]]\n'
    )
    rig = read_rig_toml(file)
    assert rig.bubbles["left"].region == ((1, 2), (3, 4), (5.5, 0))
    assert rig.bubbles["left"].mask is None and rig.bubbles["right"].mask == "m.png"
    write_rig_toml(rig, tmp_path / "again.toml")
    assert read_rig_toml(tmp_path / "again.toml").bubbles == rig.bubbles
    for wrong, words in (
        ("[bubbles]\nregoin = [[1, 2]]", "region"),
        ("[bubbles.lefd]\nmask = 'm.png'", "no camera 'lefd'"),
        ("[bubbles]\nregion = [[1], [2, 3]]", "corners (u, v) in px"),
        ("[bubbles]\nmask = 3", 'a file, like "mask.png"'),
    ):
        file.write_text(f"{text}\n{wrong}\n")
        with pytest.raises(InputError) as caught:
            read_rig_toml(file)
        assert words in str(caught.value) and str(caught.value).count("[bubbles") == 1


def test_frames_outside_the_encoders_record_do_not_blur_the_background() -> None:
    camera = truth_calibration().cameras[0]
    axis = np.array([0.0, -1.0, 0.0])
    position = np.append(np.linspace(5.0, 9.0, 6), [np.nan, np.nan])
    shift = detect_run.lab_shift_px(camera, axis, position, len(position))
    scale = camera["scale_px_per_mm"]
    assert np.abs(shift[5]).max() == pytest.approx(4.0 * scale, rel=0.01)
    assert np.isnan(shift[6:]).all()
    position[2:] = np.nan
    assert not detect_run.lab_shift_px(camera, axis, position, len(position)).any()


def test_only_doubtful_frames_are_worst_and_where_none_is_three_are_shown() -> None:
    frame = np.arange(10)
    tracks = pd.DataFrame({"frame": frame, "flags": "", "confidence": 1.0})
    seen = pd.DataFrame({"frame": frame, "u_px": 1.0, "particle": 4.0, "flags": ""})
    sound = _Worst()
    sound.add(Linked(tracks, seen))
    assert [(w["frame"], w["why"]) for w in sound.frames()] == [(0, ""), (4, ""), (9, "")]
    seen.loc[6, "particle"] = np.nan
    tracks.loc[2, "confidence"] = 0.9
    doubtful = _Worst()
    doubtful.add(Linked(tracks, seen))
    assert [w["frame"] for w in doubtful.frames()] == [6, 2]
    assert doubtful.frames()[0]["why"] == "1 without partner or track"
