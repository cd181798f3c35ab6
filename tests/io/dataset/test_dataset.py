"""The dataset folder: what is found, what is noted, what is refused; and files written whole."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import tifffile

import telerig.io.dataset.dataset as dataset_module
from telerig.errors import InputError
from telerig.io.dataset.dataset import Dataset, load_dataset
from telerig.io.files.atomic import atomic_folder, atomic_path, write_json_atomic, write_text_atomic
from telerig.io.rig_file.description import CameraDescription, RigDescription
from telerig.io.rig_file.rig_file import write_rig_toml
from telerig.rig.target import Target

TARGET = Target(rows=3, columns=5, pitch_mm=(7.0, 7.0))
IMAGE = np.arange(12 * 16, dtype=np.uint8).reshape(12, 16)
DOTS = "view,camera,dot,u_px,v_px\nv10,left,0,1,2\nv2,left,0,1,2\nv2,right,3,1,2\n"


def make_rig(folder: Path, *names: str) -> None:
    cameras = {name: CameraDescription(name, (16, 12), 10.0) for name in names}
    write_rig_toml(RigDescription("tank", cameras, TARGET), folder / "rig.toml")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A stereo rig without views."""
    place = tmp_path / "tank_2"
    make_rig(place, "left", "right")
    return place


def add_images(folder: Path, *names: str) -> None:
    for name in names:
        file = folder / "calibration" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(file, IMAGE)


def add_dots(folder: Path, text: str = DOTS) -> None:
    (folder / "calibration").mkdir(exist_ok=True)
    (folder / "calibration" / "dots.csv").write_text(text)


def error_of(call: Callable[[], object]) -> str:
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.where and caught.value.todo
    return str(caught.value)


def load_error(folder: Path) -> str:
    message = error_of(lambda: load_dataset(folder))
    assert str(folder) in message, "says where"
    return message


def test_views_of_images(folder: Path) -> None:
    add_images(folder, "left/v10.tif", "left/v9.tif", "right/v9.TIFF", "right/v10.tif")
    dataset = load_dataset(folder)
    assert isinstance(dataset, Dataset)
    assert dataset.source == "images"
    assert [view.name for view in dataset.views] == ["v9", "v10"], "natural order"
    assert dataset.views[0].image_paths == {
        "left": folder / "calibration" / "left" / "v9.tif",
        "right": folder / "calibration" / "right" / "v9.TIFF",
    }
    assert dataset.notes == []
    assert dataset.target.rows == 3 and dataset.rig.name == "tank"
    assert dataset.results == folder / "results"
    np.testing.assert_array_equal(dataset.image(dataset.views[1], 1), IMAGE)


def test_no_image_is_decoded_at_load(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add_images(folder, "left/a.tif", "right/a.tif")
    (folder / "calibration" / "left" / "a.tif").write_bytes(b"no image at all")

    def fail(*_: object, **__: object) -> None:
        raise AssertionError("decoded")

    with monkeypatch.context() as patch:
        patch.setattr(dataset_module, "read_image", fail)
        dataset = load_dataset(folder)
    assert "known format" in error_of(lambda: dataset.image(dataset.views[0], "left"))


def test_the_size_of_an_image_is_that_of_the_rig_file(folder: Path) -> None:
    add_images(folder, "left/a.tif", "right/a.tif")
    tifffile.imwrite(folder / "calibration" / "right" / "a.tif", IMAGE[:8])
    dataset = load_dataset(folder)
    message = error_of(lambda: dataset.image(dataset.views[0], "right"))
    assert "is 16 x 8 px, expected 16 x 12" in message


def test_views_of_dots(folder: Path) -> None:
    add_dots(folder)
    dataset = load_dataset(folder)
    assert dataset.source == "dots"
    assert [view.name for view in dataset.views] == ["v2", "v10"]
    assert len(dataset.dots()) == 3
    taken = dataset.dots()
    taken.loc[:, "u_px"] = 0.0
    assert dataset.dots()["u_px"].tolist() == [1.0] * 3, "a copy each time"
    assert dataset.notes == [
        "dots.csv states no sigma_px: its centres count as good to 0.02 px (1 sd)"
    ]
    assert "no image of view v2" in error_of(lambda: dataset.image(dataset.views[0], "left"))


def test_faults_of_the_dots_table_come_up_at_load(folder: Path) -> None:
    add_dots(folder, DOTS.replace("right,3", "rigth,3"))
    message = error_of(lambda: load_dataset(folder))
    assert "dots.csv row 4, column camera" in message and "did you mean right?" in message


def test_images_and_dots_must_be_told_apart(folder: Path) -> None:
    add_images(folder, "left/a.tif", "right/a.tif")
    add_dots(folder)
    message = load_error(folder)
    assert "images and dots.csv" in message
    assert "--from images or --from dots" in message
    assert load_dataset(folder, "images").views[0].name == "a"
    assert load_dataset(folder, "dots").views[0].name == "v2"
    assert load_dataset(folder, need_views=False).views == ()


def test_a_source_that_is_not_there(folder: Path) -> None:
    add_dots(folder)
    message = error_of(lambda: load_dataset(folder, "images"))
    assert "no images in calibration/<camera>/" in message and "put images at" in message
    message = error_of(lambda: load_dataset(folder, "pictures"))  # type: ignore[arg-type]
    assert "source is 'pictures'" in message and "--from" in message


def test_views_of_one_camera_alone_are_kept(folder: Path) -> None:
    add_images(folder, "left/a.tif", "left/b.tif", "left/c.tif", "right/a.tif", "right/d.tif")
    dataset = load_dataset(folder)
    assert [view.name for view in dataset.views] == ["a", "b", "c", "d"]
    assert list(dataset.views[3].image_paths) == ["right"]


@pytest.mark.parametrize(
    ("names", "what"),
    [
        (["left/a.tif", "left/a.png"], "a.png and a.tif are the same view twice"),
        (["left/View.tif", "left/view.tif"], "left/View.tif and left/view.tif differ only"),
        (["left/View.tif", "right/view.tif"], "left/View.tif and right/view.tif differ only"),
    ],
)
def test_the_same_view_twice(names: list[str], what: str, folder: Path) -> None:
    add_images(folder, *names)
    if len(list((folder / "calibration").rglob("*.*"))) < 2:
        pytest.skip("this file system does not tell upper from lower case")
    message = load_error(folder)
    assert what in message and "rename" in message


def test_the_folder_of_an_unknown_camera(folder: Path) -> None:
    add_images(folder, "left/a.tif", "Rigth/a.tif")
    message = load_error(folder)
    assert "calibration/Rigth" in message and "no camera 'Rigth'" in message
    assert "did you mean right?" in message


def test_files_that_are_not_used_are_noted(folder: Path) -> None:
    add_images(folder, "left/a.tif", "right/a.tif", "loose.tif")
    (folder / "calibration" / "left" / "a.raw").touch()
    (folder / "calibration" / "left" / ".hidden").touch()
    notes = load_dataset(folder).notes
    assert len(notes) == 2
    assert "a.raw" in notes[0] and "no images" in notes[0]
    assert "loose.tif" in notes[1] and "no camera's folder" in notes[1]


def test_no_views(folder: Path) -> None:
    message = load_error(folder)
    assert "there are no views" in message
    assert "calibration/<camera>/<view>.tif" in message and "dots.csv" in message
    (folder / "calibration" / "left").mkdir(parents=True)
    assert "there are no views" in load_error(folder)
    add_images(folder, "a.tif")
    assert "into calibration/left/" in load_error(folder)


def test_a_misspelled_calibration_folder(folder: Path) -> None:
    (folder / "calibraton").mkdir()
    assert "rename calibraton to calibration" in load_error(folder)


def test_runs_without_views(folder: Path) -> None:
    for name in ("run_10", "run_9", ".trash"):
        (folder / "runs" / name).mkdir(parents=True)
    (folder / "runs" / "notes.txt").touch()
    assert "there are no views" in load_error(folder)
    dataset = load_dataset(folder, need_views=False)
    assert list(dataset.runs) == ["run_9", "run_10"]
    assert dataset.runs["run_9"].path == folder / "runs" / "run_9"
    assert (dataset.source, dataset.views) == (None, ())
    assert dataset.notes == ["no calibration views were read"]


def test_truth_is_read_when_it_is_asked_for(folder: Path) -> None:
    add_dots(folder)
    assert load_dataset(folder).truth is None
    (folder / "truth").mkdir()
    (folder / "truth" / "truth.json").write_text("{")
    dataset = load_dataset(folder)
    assert "cannot be read as JSON" in error_of(lambda: dataset.truth)
    write_json_atomic(folder / "truth" / "truth.json", {"kappa": np.float64(1e-3)})
    assert load_dataset(folder).truth == {"kappa": 1e-3}


def test_a_run_that_does_not_exist(folder: Path) -> None:
    (folder / "runs" / "rise").mkdir(parents=True)
    runs = load_dataset(folder, need_views=False).runs
    assert "did you mean rise?" in error_of(lambda: runs["rize"])
    assert "rize" not in runs and runs.get("rize") is None


def test_a_path_that_is_no_dataset(folder: Path) -> None:
    parent = folder.parent
    message = load_error(parent / "tank_3x")
    assert "no such dataset folder" in message and "did you mean tank_2?" in message
    assert "telerig init" in load_error(parent / "elsewhere")
    message = load_error(folder / "rig.toml")
    assert "is a file" in message and f"give its folder, {folder}" in message
    message = load_error(parent)
    assert "has no rig.toml" in message and "telerig init" in message and "tank_2" in message


# --- files written whole ---


@dataclass
class Record:
    values: np.ndarray
    path: Path


def test_json_of_numpy(tmp_path: Path) -> None:
    content = {
        "record": Record(np.array([[1.5, np.nan], [np.inf, 1 / 3]]), Path("a/b")),
        "scalar": np.float32(0.5),
        "count": np.int64(3),
        "flag": np.bool_(True),
        "names": ("ä", None),
        2: {"nested": float("-inf")},
    }
    write_json_atomic(tmp_path / "a.json", content)

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    text = (tmp_path / "a.json").read_text(encoding="utf-8")
    assert json.loads(text, parse_constant=refuse) == {
        "record": {"values": [[1.5, None], [None, 1 / 3]], "path": "a/b"},
        "scalar": 0.5,
        "count": 3,
        "flag": True,
        "names": ["ä", None],
        "2": {"nested": None},
    }
    with pytest.raises(TypeError, match="set has no form in JSON"):
        write_json_atomic(tmp_path / "a.json", {"x": {1, 2}})
    assert (tmp_path / "a.json").read_text(encoding="utf-8") == text, "the old file stays"


def test_an_interrupted_file_leaves_the_old_one(tmp_path: Path) -> None:
    file = tmp_path / "new" / "a.npz"
    write_text_atomic(file, "old\n")
    with pytest.raises(KeyboardInterrupt), atomic_path(file) as temporary:
        assert temporary.suffix == ".npz" and temporary.parent == file.parent
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert file.read_text() == "old\n"
    assert list(file.parent.iterdir()) == [file]


def test_an_interrupted_folder_leaves_the_old_files(tmp_path: Path) -> None:
    results = tmp_path / "results" / "calibration"
    results.mkdir(parents=True)
    (results / "mine.txt").write_text("mine")
    (results / "run.json").write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_folder(results) as stage:
        (stage / "run.json").write_text("new")
        raise KeyboardInterrupt
    assert (results / "run.json").read_text() == "old"
    with atomic_folder(results) as stage:
        (stage / "run.json").write_text("new")
        (stage / "maps").mkdir()
        (stage / "maps" / "a.csv").write_text("1")
        assert (results / "run.json").read_text() == "old", "nothing moves before the end"
    assert (results / "run.json").read_text() == "new"
    assert (results / "maps" / "a.csv").read_text() == "1"
    assert (results / "mine.txt").read_text() == "mine"
    assert list(results.parent.iterdir()) == [results], "no temporary folder stays"


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "is a folder" in error_of(lambda: write_text_atomic(tmp_path, "x"))
    message = error_of(lambda: write_text_atomic(tmp_path / "file" / "a.txt", "x"))
    assert "cannot be written" in message and "choose another place" in message

    def stage_into_a_file() -> None:
        with atomic_folder(tmp_path / "file"):
            raise AssertionError("never reached")

    assert "is a file" in error_of(stage_into_a_file)
