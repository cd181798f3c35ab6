"""Calibrations as files: what is written is read back, what is foreign is refused in words."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import telerig
from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import (
    Calibration,
    calibration_for,
    calibration_from_cameras,
    load_calibration,
)
from telerig.io.results.findings import Code
from telerig.io.simulation.presets import run_preset
from telerig.scripts.main import app

pytestmark = pytest.mark.usefixtures("without_advice")


@pytest.fixture(scope="module")
def calibration(scene: Any) -> Calibration:
    made = scene("near_telecentric", 3, outlier_share=0.02)
    note = Code.NOTE.found(text="a note")
    return made.calibrate("kappa+radial", name="tank 2", findings=[note])


@pytest.fixture
def saved(calibration: Calibration, tmp_path: Path) -> Path:
    calibration.save(tmp_path / "calibration")
    return tmp_path / "calibration"


def assert_same(a: Calibration, b: Calibration) -> None:
    assert [c.name for c in a.cameras] == [c.name for c in b.cameras]
    for x, y in zip(a.cameras, b.cameras):
        np.testing.assert_array_equal(x.intrinsics, y.intrinsics)
        np.testing.assert_array_equal(x.camera_from_rig.rotation, y.camera_from_rig.rotation)
        shifts = (c.camera_from_rig.translation_mm for c in (x, y))
        np.testing.assert_array_equal(*shifts)
        assert (x.image_size_px, x.rho_mm) == (y.image_size_px, y.rho_mm)
    np.testing.assert_array_equal(a.dot_ids, b.dot_ids)
    np.testing.assert_array_equal(a.target_points_mm, b.target_points_mm)
    np.testing.assert_array_equal(a.covariance, b.covariance)
    assert a.covariance_names == b.covariance_names
    assert (a.free, a.name, a.findings) == (b.free, b.name, b.findings)
    assert list(a.target_poses) == list(b.target_poses)
    for x, y in zip(a.target_poses.values(), b.target_poses.values()):
        np.testing.assert_array_equal(x.rotation, y.rotation)
    for part in ("verdict", "statistics", "twin", "model", "diagnostics"):
        assert json.dumps(getattr(a, part), default=float) == json.dumps(getattr(b, part))


def test_a_view_without_a_kept_dot_is_written_and_read(scene: Any, tmp_path: Path) -> None:
    made = scene("paper", 1)
    dots = made.dots
    few = (dots["view"] != "view08") | ((dots["dot"] < 3) & (dots["camera"] == "left"))
    found = made.with_dots(dots[few]).calibrate("radial")
    assert np.isinf(found.joint_covariance.diagonal()).sum() == 3  # the pose's rotation
    found.save(tmp_path / "calibration")
    loaded = load_calibration(tmp_path / "calibration")
    np.testing.assert_array_equal(loaded.joint_covariance, found.joint_covariance)


def test_round_trip(calibration: Calibration, saved: Path) -> None:
    for path in (saved, saved / "calibration.json", str(saved)):
        loaded = load_calibration(path)
        assert_same(calibration, loaded)
        assert loaded.joint_names == calibration.joint_names
        np.testing.assert_array_equal(loaded.joint_covariance, calibration.joint_covariance)


def test_a_second_save_of_the_loaded_is_the_same_file(saved: Path, tmp_path: Path) -> None:
    load_calibration(saved).save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text() == (saved / "calibration.json").read_text()
    assert (tmp_path / "again.covariance.npz").is_file()
    assert not (tmp_path / "dots.csv").exists()


def test_calibrations_of_several_days_in_one_folder(calibration: Calibration, saved: Path) -> None:
    """None takes covariance or dots of another."""
    tuesday = replace(
        calibration, covariance=2 * calibration.covariance,
        joint_covariance=2 * calibration.joint_covariance,
        tables={"dots.csv": calibration.dots.iloc[:9], "residuals.csv": calibration.residuals},
    )  # fmt: skip
    calibration.save(saved / "monday.json")
    tuesday.save(saved / "tuesday.json")
    tuesday.save(saved)
    for name, right in (("monday", calibration), ("tuesday", tuesday), ("calibration", tuesday)):
        found = load_calibration(saved / f"{name}.json")
        np.testing.assert_array_equal(found.joint_covariance, right.joint_covariance)
        if name == "calibration":
            assert len(found.dots) == 9
            continue
        with pytest.raises(InputError, match=f"is not of {name}.json, which was saved alone"):
            _ = found.dots
    (saved / "copied.json").write_bytes((saved / "monday.json").read_bytes())
    assert load_calibration(saved / "copied.json").joint_names == ()
    (saved / "copied.json").write_bytes((saved / "tuesday.json").read_bytes())
    assert load_calibration(saved / "copied.json").joint_names == tuesday.joint_names


def test_the_file_says_what_others_rely_on(calibration: Calibration, saved: Path) -> None:
    text = (saved / "calibration.json").read_text(encoding="utf-8")
    assert "NaN" not in text
    assert "Infinity" not in text
    data = json.loads(text)
    assert data["schema"] == 1
    assert data["pixel_origin"] == "centre"
    assert "axes come closest" in data["gauge"]
    assert list(data["cameras"]) == ["left", "right"]
    assert data["twin"]["decided_by"] == "nominal rotation"
    size = len(data["covariance"]["names"])
    assert np.shape(data["covariance"]["matrix"]) == (size, size)
    sd = data["cameras"]["left"]["standard_deviations"]["k1"]
    assert sd == pytest.approx(calibration.sd("left.k1"))
    assert calibration.sd("left.wall_x_rad") == 0.0, "held fixed"
    with pytest.raises(InputError, match=r"did you mean left\.scale_px_per_mm"):
        calibration.sd("left.scale")
    with pytest.raises(InputError, match=r"did you mean left\.k1"):
        calibration.sd("left.K1_")


def test_a_folder_is_an_input_by_its_file(saved: Path) -> None:
    folder = saved if saved.is_dir() else saved.parent
    _, used = calibration_for(folder, [folder])
    assert used == [folder / "calibration.json"] and used[0].is_file()


def test_it_loads_without_the_full_covariance(calibration: Calibration, saved: Path) -> None:
    (saved / "covariance.npz").unlink()
    loaded = load_calibration(saved)
    assert_same(calibration, loaded)
    assert loaded.joint_covariance.shape == (0, 0)


def test_saving_without_the_full_covariance_leaves_no_old_one(
    calibration: Calibration, saved: Path
) -> None:
    replace(calibration, joint_names=(), joint_covariance=np.zeros((0, 0))).save(saved)
    assert load_calibration(saved).joint_names == ()


def test_a_covariance_of_another_calibration_is_refused(
    calibration: Calibration, saved: Path
) -> None:
    other = replace(calibration, joint_covariance=2 * calibration.joint_covariance)
    other.save(saved.parent / "other")
    (saved / "covariance.npz").write_bytes((saved.parent / "other" / "covariance.npz").read_bytes())
    with pytest.raises(InputError, match="covariance"):
        load_calibration(saved)


def test_a_loaded_calibration_has_its_tables(calibration: Calibration, saved: Path) -> None:
    loaded = load_calibration(saved)
    for name in ("dots", "residuals"):
        read, made = getattr(loaded, name), getattr(calibration, name)
        columns = list(made.columns)
        pd.testing.assert_frame_equal(read[columns].fillna(""), made.fillna(""), check_dtype=False)
        assert getattr(loaded, name) is read
    loaded.save(saved.parent / "again")
    for name in ("dots.csv", "residuals.csv"):
        assert (saved.parent / "again" / name).read_bytes() == (saved / name).read_bytes()


def test_tables_that_are_not_there_or_of_another_calibration(
    calibration: Calibration, saved: Path
) -> None:
    late, moved = load_calibration(saved), load_calibration(saved)
    changed = {**calibration.statistics, "rms_px": 1.0}
    replace(calibration, statistics=changed).save(saved)
    with pytest.raises(InputError, match="replaced"):
        _ = late.residuals
    calibration.save(saved)
    (saved / "residuals.csv").unlink()
    with pytest.raises(InputError, match=r"residuals\.csv"):
        _ = moved.residuals
    moved.save(saved.parent / "again")
    assert not (saved.parent / "again" / "residuals.csv").exists()
    imported = calibration_from_cameras(list(calibration.cameras))
    with pytest.raises(InputError, match=r"dots\.csv"):
        _ = imported.dots


def test_missing(saved: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no calibration here"):
        load_calibration(tmp_path)
    for name in ("calibratoin", "calibratoin/calibration.json"):
        with pytest.raises(InputError) as error:
            load_calibration(tmp_path / name)
        assert "calibratoin" in error.value.where
        assert error.value.todo == "did you mean calibration?"


@pytest.mark.parametrize(
    "text",
    [
        "", "not json", "[]", "{}", "null", '{"kind": "something else", "schema": 1}',
        '{"kind": "telerig calibration", "schema": 1}',
        '{"kind": "telerig calibration", "schema": "one"}',
    ],
)  # fmt: skip
def test_foreign_files(text: str, tmp_path: Path) -> None:
    file = tmp_path / "calibration.json"
    file.write_text(text)
    with pytest.raises(InputError, match=r"calibration\.json: (is|cannot|has a fault at)"):
        load_calibration(file)


def edited(folder: Path, change: Any) -> Path:
    file = folder / "calibration.json"
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))
    return file


def test_newer_schema(saved: Path) -> None:
    file = edited(saved, lambda d: d.update(schema=2))
    with pytest.raises(InputError, match=r"newer(.|\n)*update telerig"):
        load_calibration(file)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d["cameras"]["left"].update(rho_mm="wide"),
        lambda d: d["cameras"]["left"]["parameters"].pop("k3"),
        lambda d: d["cameras"]["right"]["camera_from_rig"].update(rotation="none"),
        lambda d: d["target"].update(points_mm=[[1, 2]]),
        lambda d: d["covariance"].update(matrix=[[1.0, 2.0], [3.0]]),
        lambda d: d["cameras"]["left"].update(image_size_px=[512]),
        lambda d: d.update(cameras=[1, 2]),
    ],
)
def test_damaged_files(change: Any, saved: Path) -> None:
    with pytest.raises(InputError, match=r"calibration\.json: (cannot|has a fault at|lacks)"):
        load_calibration(edited(saved, change))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d["cameras"]["left"]["parameters"].update(scale_px_per_mm=0), "positive"),
        (lambda d: d["cameras"]["left"]["parameters"].update(aspect=-1), "positive"),
        (lambda d: d["cameras"]["left"]["parameters"].update(kappa_per_mm=1e10), "any lens"),
        (lambda d: d["cameras"]["left"]["parameters"].update(k1=50.0), "any lens"),
        (lambda d: d["diagnostics"].update(next_view={"poses": 5}), "next_view.*poses"),
        (lambda d: d["diagnostics"].update(halves={"views": "x"}), "halves.*views"),
        (lambda d: d["diagnostics"].update(structure={"widening": "x"}), "structure.*widening"),
        (lambda d: d["cameras"]["left"].update(free=["zoom"]), "no parameter"),
        (lambda d: d["cameras"]["left"].update(standard_deviations={"zoom": 1}), "no parameter"),
        (lambda d: d["covariance"]["matrix"][0].__setitem__(0, -1), "variance is negative"),
        (
            lambda d: d["covariance"].update(names=["a", "b"], matrix=[[1, 2], [2, 1]]),
            "variance along some direction",
        ),
        (
            lambda d: d["covariance"].update(names=["a", "a"], matrix=[[1, 0], [0, 1]]),
            "stands twice",
        ),
    ],
)
def test_cameras_and_covariances_that_cannot_be(change: Any, words: str, saved: Path) -> None:
    content = json.loads((saved / "calibration.json").read_text())
    content.setdefault("diagnostics", {})
    change(content)
    (saved / "calibration.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=words):
        load_calibration(saved)


def test_two_views_and_a_chosen_model_can_be_saved(scene: Any, tmp_path: Path) -> None:
    """Nothing in the file may be NaN, even where there was too little to compute it from."""
    made = scene("paper", 1, views=2)
    made.calibrate("auto").save(tmp_path / "few")
    text = (tmp_path / "few" / "calibration.json").read_text()
    assert "NaN" not in text
    assert load_calibration(tmp_path / "few").statistics["views"] == 2


def test_dots_free_is_the_option_of_the_command(tmp_path: Path) -> None:
    config = run_preset("swarm", frames=2, bubbles=2)
    data = telerig.simulate(
        config, rng=np.random.default_rng(1), out=tmp_path / "tank", images=False
    )
    words = ["calibrate", str(data.path), "--model", "none", "--dots", "plane"]
    done = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "of_command")])
    assert done.exit_code in (0, 1), done.output
    by_command = load_calibration(tmp_path / "of_command")
    called = telerig.calibrate(data, model="none", dots_free="plane")
    np.testing.assert_allclose(called.target_points_mm, by_command.target_points_mm, atol=1e-9)
    free = telerig.calibrate(data, model="none")
    assert np.abs(free.target_points_mm - called.target_points_mm).max() > 1e-4
