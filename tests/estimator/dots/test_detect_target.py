"""From images to numbered dots: drawn plates with known truth, and real printed ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from finding_codes import codes, only
from numpy.typing import NDArray
from places import REAL
from target_pictures import DESIGN, draw, pixel_from_mm

import telerig
from telerig.errors import DetectionError, InputError
from telerig.estimator.dots.dataset_dots import (
    MEASURED,
    ImageDots,
    TargetDetection,
    detect_target,
    detected_together,
    numbered,
)
from telerig.estimator.dots.locate import measure_dots
from telerig.io.results.findings import Code
from telerig.rig.target import Target

Array = NDArray[np.float64]

PLATE = REAL / "dic_stereo_dots"

RING = replace(DESIGN, mark_style="ring", mark_diameter_mm=None)
PRINTED = Target(
    rows=8,
    columns=10,
    pitch_mm=(3.5, 3.5),
    dot_diameter_mm=1.35,
    polarity="black_on_white",
    marks=((0, 0), (0, 5), (3, 0)),
    mark_style="ring",
    extent="unbounded",
)


def find_target(image: Array, target: Target) -> TargetDetection:
    return numbered(measure_dots(image, polarity=target.polarity), target)


@pytest.mark.parametrize(
    ("target", "tilt_deg", "roll_deg", "mirrored"),
    [
        (DESIGN, 0, 5, False),
        (DESIGN, 65, 290, False),
        (RING, 50, 130, True),
        (replace(DESIGN, polarity="black_on_white"), 35, 200, True),
    ],
)
def test_drawn_plates_are_numbered_at_their_centres(
    target: Target, tilt_deg: float, roll_deg: float, mirrored: bool
) -> None:
    image, centres = draw(target, pixel_from_mm(12.0, tilt_deg, roll_deg, mirrored))
    found = find_target(image, target)
    assert found.table["dot"].tolist() == list(range(15))
    np.testing.assert_allclose(found.table[["u_px", "v_px"]], centres, atol=0.1)
    np.testing.assert_array_equal(found.table["row"] * 5 + found.table["column"], np.arange(15))
    assert found.numbering.handedness == (-1 if mirrored else 1)
    assert found.numbering.marks_found.tolist() == [7, 8, 2]


def test_columns_of_the_table() -> None:
    image, _ = draw(DESIGN, pixel_from_mm(12.0, 20, 0, False))
    table = detect_target(image, DESIGN)
    assert list(table.columns) == ["dot", "row", "column", *MEASURED]
    assert np.all(table[["suu_px2", "svv_px2"]] > 0)


def test_dots_off_the_grid_are_rejected_with_the_reason() -> None:
    image, _ = draw(DESIGN, pixel_from_mm(12.0, 20, 0, False))
    v, u = np.mgrid[:480, :480]
    image[(u - 240) ** 2 + (v - 440) ** 2 < 14**2] = 210
    found = find_target(image, DESIGN)
    assert len(found.table) == 15
    odd = found.rejected[found.rejected["reason"] == "not on the grid"]
    np.testing.assert_allclose(odd[["u_px", "v_px"]], [[240, 440]], atol=0.5)


def test_an_undecided_image_is_an_error_that_counts_the_marks() -> None:
    plain = replace(RING, marks=((1, 2), (1, 3)))
    image, _ = draw(plain, pixel_from_mm(12.0, 20, 0, False))
    assert find_target(image, RING).numbering.ambiguous
    with pytest.raises(DetectionError, match=r"2 of the target's 3 marks were found"):
        detect_target(image, RING)


SCATTERED = replace(
    DESIGN, layout="points", rows=0, columns=0, pitch_mm=(1.0, 1.0), marks=(), dot_diameter_mm=2.0,
    points_mm=tuple(map(tuple, np.random.default_rng(4).permutation(
        np.stack(np.meshgrid(np.arange(5), np.arange(4)), -1).reshape(-1, 2)
    )[:14] * 6.0 + np.random.default_rng(5).uniform(-1.5, 1.5, (14, 2)))),
)  # fmt: skip


@pytest.mark.parametrize("polarity", ["white_on_black", "black_on_white"])
@pytest.mark.parametrize("target", [DESIGN, SCATTERED], ids=["grid", "points"])
def test_a_wrong_polarity_is_named(target: Target, polarity: Any) -> None:
    drawn = replace(target, polarity=polarity)
    image, _ = draw(drawn, pixel_from_mm(12.0, 20, 5, False))
    assert len(detect_target(image, drawn)) == len(drawn.ids())
    other = {"white_on_black": "black_on_white", "black_on_white": "white_on_black"}[polarity]
    with pytest.raises(DetectionError) as caught:
        detect_target(image, replace(target, polarity=other))
    assert f'polarity = "{polarity}"' in caught.value.todo
    # a wrong polarity and a wrong grid: the polarity comes first
    if target is DESIGN:
        with pytest.raises(DetectionError) as caught:
            detect_target(image, replace(target, polarity=other, marks=((0, 0),)))
        assert f'polarity = "{polarity}"' in caught.value.todo


def test_the_polarity_is_not_accused_of_other_faults() -> None:
    image, _ = draw(DESIGN, pixel_from_mm(12.0, 20, 5, False))
    blank = np.full_like(image, 128)
    for spoilt, target in (
        (image[:150, :150], DESIGN), (blank, DESIGN), (image, replace(DESIGN, marks=((0, 0),))),
    ):  # fmt: skip
        with pytest.raises(DetectionError) as caught:
            detect_target(spoilt, target)
        assert "polarity =" not in caught.value.todo


def test_an_empty_image_is_an_error() -> None:
    noise = np.random.default_rng(0).normal(100, 2, (200, 200)).astype(np.uint8)
    with pytest.raises(DetectionError, match=r"no dots|too few"):
        detect_target(noise, DESIGN)
    with pytest.raises(InputError):
        detect_target(np.zeros((5, 5, 3)), DESIGN)


@pytest.mark.skipif(not PLATE.is_dir(), reason="the real images of ../shared/real are not here")
@pytest.mark.parametrize("camera", [0, 1])
def test_real_printed_grid_is_numbered_from_its_rings(camera: int) -> None:
    import cv2

    image = cv2.imread(str(PLATE / f"CalB-sys2-0014_{camera}.jpeg"), cv2.IMREAD_GRAYSCALE)
    half = np.asarray(image, float).reshape(1024, 2, 1224, 2).mean((1, 3))
    found = find_target(half.astype(np.uint8), PRINTED)
    table = found.table
    assert 80 <= len(table) <= 91
    assert table["column"].between(-2, 8).all()
    assert table["row"].between(-2, 6).all()
    assert not found.numbering.ambiguous
    assert len(found.numbering.marks_found) == 3
    assert found.numbering.handedness == -1
    row, column, one = table["row"], table["column"], np.ones(len(table))
    bilinear = np.column_stack([one, row, column, row * column, row**2, column**2])
    for axis in ("u_px", "v_px"):
        fit = np.linalg.lstsq(bilinear, table[axis], rcond=None)[0]
        assert np.abs(bilinear @ fit - table[axis]).max() < 4


def test_an_image_that_is_left_out_is_found(paper_images: Path) -> None:
    data = telerig.load_dataset(paper_images)
    table = pd.DataFrame({"dot": DESIGN.ids()[:0]})
    images = [ImageDots(f"{k}", "left", table, table, 1) for k in range(3)]
    dark = ImageDots("3", "left", table, table, 0, "no dots found")
    found = detected_together(data, [*images, dark])
    assert codes(found) == ["LEFT_OUT"]
    assert only(found, Code.LEFT_OUT).views == ("3",)


def test_an_image_of_rejected_spots_says_why() -> None:
    image = np.full((120, 160), 40.0)
    for row, column in np.ndindex(9, 12):
        image[10 + 12 * row :, 10 + 12 * column :][:3, :3] = 200.0
    image += np.random.default_rng(0).standard_normal(image.shape)
    with pytest.raises(DetectionError, match=r"spots were rejected.*smaller than the smallest dot"):
        detect_target(image, DESIGN)
