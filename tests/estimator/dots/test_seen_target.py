"""What images tell of the target: the lines of rig.toml, and where its marks are seen."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from seeds import first_or_all
from target_pictures import draw, pixel_from_mm

from telerig.errors import DetectionError, InputError
from telerig.estimator.dots.dataset_dots import detect_target
from telerig.estimator.dots.grid.seen_target import contradiction, seen_target
from telerig.estimator.dots.locate import measure_dots
from telerig.estimator.dots.target_from_images import target_from_images
from telerig.io.dataset.new_dataset import NewCamera, new_dataset
from telerig.io.rig_file.rig_file import read_rig_toml
from telerig.rig.target import Target

PLATE = Target(
    rows=5, columns=7, pitch_mm=(7.0, 7.0), dot_diameter_mm=2.4,
    marks=((2, 2), (2, 4), (1, 2)), mark_style="ring",
)  # fmt: skip
LARGE = replace(PLATE, mark_style="large", mark_diameter_mm=3.6)
SIZE = 424
OBLONG = replace(LARGE, pitch_mm=(7.0, 9.0), polarity="black_on_white")
MISSING = replace(PLATE, mark_style="missing")


@cache
def views(target: Target) -> list[Any]:
    """Three images; read only."""
    poses = ((10.0, 8.0), (35.0, -20.0), (40.0, 170.0))
    return [
        draw(target, pixel_from_mm(6.5, tilt, roll, False), size_px=SIZE, seed=k)[0]
        for k, (tilt, roll) in enumerate(poses)
    ]


@pytest.mark.parametrize(
    ("plate", "cameras"),
    [
        (PLATE, ("camera",)), pytest.param(LARGE, ("left", "right"), marks=pytest.mark.slow),
        pytest.param(OBLONG, ("camera",), marks=pytest.mark.slow),
        (MISSING, ("left", "right")),
    ],
    ids=["ring", "large", "oblong", "gap"],
)  # fmt: skip
def test_the_description_from_images_numbers_them(
    tmp_path: Path, plate: Target, cameras: tuple[str, ...]
) -> None:
    images = views(plate)
    folder = tmp_path / "images"
    for name in cameras:
        place = folder / name if len(cameras) > 1 else folder
        place.mkdir(parents=True, exist_ok=True)
        for k, image in enumerate(images):
            cv2.imwrite(str(place / f"{k}.png"), image)
    seen = target_from_images(folder, pitch_mm=7.0, scale_px_per_mm=1.0)
    made = new_dataset(tmp_path / "new", [NewCamera(*c) for c in seen.cameras], target=seen.lines)
    rig = read_rig_toml(made[0])
    found = rig.target
    assert tuple(rig.cameras) == cameras
    places = (folder,) if len(cameras) == 1 else tuple(folder / name for name in cameras)
    assert dict(seen.sources) == dict(zip(cameras, places))
    assert found.mark_style == plate.mark_style and found.polarity == plate.polarity
    assert found.extent == "bounded" and len(found.marks) == 3
    assert sorted((found.rows, found.columns)) == [5, 7]
    assert sorted(found.pitch_mm) == pytest.approx(sorted(plate.pitch_mm), rel=0.02) or (
        found.pitch_mm[0] == 7.0 and found.pitch_mm[1] == pytest.approx(7.0 * 7 / 9, rel=0.02)
    )
    for camera in rig.cameras.values():
        assert camera.image_size_px == (SIZE, SIZE)
    if plate is PLATE:
        assert found.dot_diameter_mm == pytest.approx(2.4, rel=0.02)
        assert rig.cameras[cameras[0]].scale_px_per_mm == pytest.approx(6.5, rel=0.02)
    count = 35 - (3 if plate is MISSING else 0)
    for image in images:
        assert len(detect_target(image, found)) == count


def test_marks_that_are_counted_otherwise_are_said_with_lines_that_fit() -> None:
    image = views(PLATE)[0]
    with pytest.raises(DetectionError) as refused:
        detect_target(image, replace(PLATE, marks=((0, 0), (0, 3), (2, 0))))
    words = str(refused.value)
    assert "3 ring marks at (row, column)" in words
    assert "rig.toml says ring marks at (0, 0), (0, 3), (2, 0)" in words
    line = next(part for part in words.split("; ") if part.startswith("marks = "))
    marks = tuple(map(tuple, json.loads(line.removeprefix("marks = "))))
    numbered = detect_target(image, replace(PLATE, marks=marks))
    assert len(numbered) == 35


def test_rows_that_are_not_there_are_said() -> None:
    seen = seen_target(measure_dots(views(PLATE)[0]).dots, (SIZE, SIZE))
    assert (seen.rows, seen.columns, seen.whole) == (5, 7, True)
    words = contradiction(seen, replace(PLATE, rows=6))
    assert "5 rows and 7 columns; rig.toml says 6 and 7" in words


def test_what_fits_is_no_contradiction() -> None:
    for image in views(PLATE):
        seen = seen_target(measure_dots(image).dots, image.shape)
        assert contradiction(seen, PLATE) == ""
        flipped = seen_target(measure_dots(image[:, ::-1]).dots, image.shape)
        assert contradiction(flipped, PLATE) == ""


def test_a_part_of_a_grid_is_counted_from_its_first_mark() -> None:
    image = views(replace(PLATE, rows=9, columns=9, marks=((4, 4), (4, 6), (3, 4))))[1]
    seen = seen_target(measure_dots(image[98:328, 90:336]).dots, (230, 246))
    assert not seen.whole
    assert seen.counted().marks[0] == (0, 0)
    assert 'extent = "unbounded"' in seen.lines()


def test_folders_without_a_target(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no images"):
        target_from_images(tmp_path, pitch_mm=None, scale_px_per_mm=1.0)
    noise = np.random.default_rng(0).integers(0, 255, (64, 64), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    with pytest.raises(DetectionError, match="no image shows a grid of dots"):
        target_from_images(tmp_path, pitch_mm=None, scale_px_per_mm=1.0)


@pytest.mark.parametrize(
    ("names", "several"),
    [
        ([f"CalB-sys2-{v:04}_{c}" for v in range(1, 15) for c in (0, 1)], True),
        ([f"cam{c}-{v}" for v in range(3) for c in "abc"], True),
        ([f"{v}_left" for v in range(9)] + [f"{v}_right" for v in range(8)], True),
        ([f"view_{v}" for v in range(4)], False),
        ([f"{v}" for v in range(4)], False),
        ([f"2024-05-{v:02}_b" for v in range(8)], False),
        ([f"{v}_{c}" for v in range(6) for c in range(5)], False),
        ([f"{v}_{v % 2}" for v in range(6)], False),
    ],
)
def test_images_of_several_cameras_in_one_folder_are_noticed(
    tmp_path: Path, names: list[str], several: bool
) -> None:
    for name in names:
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((16, 16), np.uint8))
    with pytest.raises(InputError if several else DetectionError) as caught:
        target_from_images(tmp_path, pitch_mm=None, scale_px_per_mm=1.0)
    assert ("make a folder for each camera" in caught.value.todo) == several


def test_images_that_disagree_are_named(tmp_path: Path) -> None:
    image = views(PLATE)[0]
    for camera, picture in (
        ("left", image), ("right", np.repeat(np.repeat(image, 2, 0), 2, 1)), ("top", 255 - image),
    ):  # fmt: skip
        (tmp_path / camera).mkdir()
        cv2.imwrite(str(tmp_path / camera / "a.png"), picture)
    seen = target_from_images(tmp_path, pitch_mm=7.0, scale_px_per_mm=1.0)
    assert [name for name, *_ in seen.cameras] == ["left", "right"]
    assert any("top/a.png: its dots are" in words for words in seen.words)
    alone = target_from_images(tmp_path / "left", pitch_mm=7.0, scale_px_per_mm=1.0)
    across = alone.words[0].split(", dots ")[1]
    assert across.split(" px")[0] in seen.words[0]

    cv2.imwrite(str(tmp_path / "left" / "b.png"), np.repeat(np.repeat(image, 2, 0), 2, 1))
    with pytest.raises(InputError, match="images of camera left have different sizes"):
        target_from_images(tmp_path, pitch_mm=7.0, scale_px_per_mm=1.0)


@pytest.mark.parametrize("style", first_or_all("ring", "large", "missing", None))
def test_the_description_of_a_hexagonal_plate_numbers_its_images(
    tmp_path: Path, style: Any
) -> None:
    """It was once proposed as a square grid, with the corners of the hexagon as missing dots."""
    q, r = np.mgrid[-3:4, -3:4].reshape(2, -1)
    places = 7.0 * np.stack([q + r / 2, r * np.sqrt(0.75)], -1)[np.abs(q + r) <= 3]
    if style == "missing":
        places = np.delete(places, [8, 9, 20], axis=0)
    plate = Target(
        layout="points", points_mm=places, dot_diameter_mm=2.4,
        marks=((0, 8), (0, 9), (0, 20)) if style in ("ring", "large") else (),
        mark_style="large" if style == "large" else "ring",
        mark_diameter_mm=3.6 if style == "large" else None,
    )  # fmt: skip
    poses = ((10.0, 8.0), (40.0, 170.0))
    images = [
        draw(plate, pixel_from_mm(7.0, *pose, False), size_px=400, seed=5)[0] for pose in poses
    ]
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    seen = target_from_images(tmp_path, pitch_mm=7.0, scale_px_per_mm=1.0)
    assert "a hexagonal grid" in seen.words[0]
    made = new_dataset(tmp_path / "new", [NewCamera(*c) for c in seen.cameras], target=seen.lines)
    found = read_rig_toml(made[0]).target
    assert len(found.points_mm) == len(places) and len(found.marks) == len(plate.marks)
    assert found.dot_diameter_mm == pytest.approx(2.4, rel=0.02)
    near = np.linalg.norm(found.points_mm[:, None] - found.points_mm, axis=-1)
    np.fill_diagonal(near, np.inf)
    np.testing.assert_allclose(near.min(axis=1), 7.0, atol=2e-4)
    for image in images:
        assert len(detect_target(image, found)) == len(places)


def staggered(rows: int, columns: int, between: float) -> Target:
    """Rows 7 mm long between dots, each second one shifted by half of it."""
    places = [(7.0 * (c + r % 2 / 2), between * r) for r in range(rows) for c in range(columns)]
    return Target(layout="points", points_mm=np.array(places), dot_diameter_mm=1.8)


def test_staggered_rows_are_described_by_the_places_of_their_dots(tmp_path: Path) -> None:
    """Seven by eleven once were "12 rows, 12 columns, no marks"."""
    plate = staggered(11, 7, 3.5)
    for k, pose in enumerate(((10.0, 8.0), (40.0, 170.0))):
        image = draw(plate, pixel_from_mm(8.0, *pose, False), size_px=560, seed=k)[0]
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    seen = target_from_images(tmp_path, pitch_mm=7.0 * np.sqrt(0.5), scale_px_per_mm=1.0)
    assert "staggered rows" in seen.words[0] and "of 77 dots" in seen.words[0]
    made = new_dataset(tmp_path / "new", [NewCamera(*c) for c in seen.cameras], target=seen.lines)
    found = np.asarray(read_rig_toml(made[0]).target.points_mm)
    apart = np.linalg.norm(found[:, None] - found, axis=-1)
    true = np.linalg.norm(plate.points_mm[:, None] - plate.points_mm, axis=-1)
    np.testing.assert_allclose(np.sort(apart.ravel()), np.sort(true.ravel()), atol=1e-3)


@pytest.mark.parametrize("kind", ["staggered", "two levels"])
def test_dots_on_more_than_one_grid_are_no_grid(kind: str) -> None:
    """Of either plate every second row was proposed as the whole."""
    plate = staggered(7, 6, 7.0)
    if kind == "two levels":
        level = np.arange(81) % 2
        places = 7.0 * np.mgrid[:9, :9].reshape(2, -1).T + level[:, None] * (1.2, 0.7)
        plate = replace(plate, points_mm=places)
    image = draw(plate, pixel_from_mm(6.5, 20.0, 8.0, False), size_px=480, seed=1)[0]
    with pytest.raises(DetectionError, match=r"of .* dots are on one grid"):
        seen_target(measure_dots(image).dots, image.shape)
