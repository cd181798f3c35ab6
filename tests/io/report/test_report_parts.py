"""Parts of the reports: geometry against closed forms, overlays against pixels, words."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from telerig.errors import InputError
from telerig.io.report import plot, trial, validation
from telerig.io.report.batch import report as batch
from telerig.io.report.calibration import report as calibration
from telerig.io.report.overlays import GREEN, RED, draw_overlay
from telerig.io.report.page import page
from telerig.io.report.page.figures import Figure, drawn
from telerig.io.report.plot.outline import common_plane, rig_outline
from telerig.io.report.plot.rig import tilt_angles_rad
from telerig.io.report.plot.target import target_shape
from telerig.io.report.run import report as run
from telerig.io.results.calibration import CalibrationFile, Diagnostics, Target
from telerig.io.results.folders.calibration import CalibrationResults
from telerig.io.results.tracking import TrackingFile
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose


def _results() -> CalibrationResults:
    """Two cameras at 90 degrees, a 3 x 5 grid with one dot 50 µm high, three poses."""
    turned = Pose.from_rotvec([0.0, np.pi / 2, 0.0], [0.0, 0.3, 0.0])
    left = Camera.create("left", (512, 400), 10.0, k1=0.002)
    right = Camera.create("right", (512, 512), 10.3, camera_from_rig=turned)
    angles = np.radians([25.0, 155.0, 40.0])
    views = {f"view{i:02}": Pose.from_rotvec([0.0, a, 0.0]) for i, a in enumerate(angles)}
    lattice = np.stack(np.divmod(np.arange(15), 5), -1).astype(float)
    points = np.c_[7.0 * lattice[:, ::-1], np.zeros(15)]
    points[7, 2] = 0.05
    seen = [(view, camera) for view in views for camera in ("left", "right")]
    root = 1e-3 * np.random.default_rng(4).standard_normal((45, 45))
    target = Target(dots=np.arange(15), points_mm=points)
    file = CalibrationFile.model_construct(
        target=target, cameras={"left": None, "right": None}, diagnostics=Diagnostics()
    )
    return _with(
        file=file, cameras=(left, right), views=views,
        row_column=lattice, residuals=pd.DataFrame(seen, columns=["view", "camera"]),
        joint=(tuple(f"dot {i}.{axis}_mm" for i in range(15) for axis in "xyz"), root @ root.T),
    )  # fmt: skip


def _with(**read: Any) -> CalibrationResults:
    """A folder of which these parts count as read."""
    results = CalibrationResults(Path("nowhere"))
    vars(results).update(read)
    return results


def test_tilt_is_the_angle_between_axis_and_normal() -> None:
    results = _results()
    tilt, direction = tilt_angles_rad(results.cameras[0], results.views)
    np.testing.assert_allclose(np.degrees(tilt), [25.0, 25.0, 40.0], atol=1e-9)
    np.testing.assert_allclose(np.cos(direction), [-1.0, 1.0, -1.0], atol=1e-9)
    other, _ = tilt_angles_rad(results.cameras[1], results.views)
    np.testing.assert_allclose(np.degrees(other), [65.0, 65.0, 50.0], atol=1e-9)


@pytest.mark.parametrize(("turn", "name", "largest"), [([0, 1, 0], "x", 3), ([1, 0, 0], "y", 5)])
def test_uncertainty_is_drawn_in_the_plane_of_both_axes(
    turn: list[int], name: str, largest: int
) -> None:
    """Of cameras side by side, and of cameras one above the other."""
    side = np.array([-2.0, 0.0, 2.0])
    grid = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    sd_mm = 1e-3 * (1 + np.abs(grid) @ [1, 2, 0])
    pose = Pose.from_rotvec(np.pi / 2 * np.array(turn))
    second = Camera.create("right", (512, 512), 10.3, camera_from_rig=pose)
    uncertainty = {
        "points_mm": grid, "sigma_px": np.array(0.01),
        "calibration_mm2": sd_mm[:, None, None] ** 2 * np.eye(3) / 3,
        "measurement_mm2": np.broadcast_to(np.eye(3), (27, 3, 3)),
    }  # fmt: skip
    found = _results()
    cameras = (found.cameras[0], second)
    found = _with(file=found.file, cameras=cameras, uncertainty=uncertainty)
    (figure,) = calibration._maps(found)
    assert f"1.00 to {largest}.00 µm" in figure.caption
    axes = figure.draw()
    assert (axes.get_xlabel(), axes.get_ylabel()) == (f"{name} / mm", "z / mm")


def test_target_shape_finds_a_bump_and_its_deviation() -> None:
    results = _results()
    shape = target_shape(results.points_mm, results.row_column, results.target_covariance)
    assert shape is not None and shape.in_plane
    design = np.c_[results.row_column, np.ones(15)]
    residual = np.eye(15) - design @ np.linalg.pinv(design)
    np.testing.assert_allclose(shape.off_um[:, 2], 50 * residual[:, 7], atol=1e-9)
    np.testing.assert_allclose(shape.off_um[:, :2], 0, atol=1e-9)
    expected = 1e3 * np.sqrt(np.diag(residual @ results.joint[1][2::3, 2::3] @ residual.T))
    np.testing.assert_allclose(shape.sd_um[:, 2], expected)


def _outline(results: CalibrationResults) -> Any:
    return rig_outline(results.cameras, results.views, results.points_mm).cameras


def test_outline_of_a_field_is_what_the_image_corners_see() -> None:
    results = _results()
    corners = np.array([[-0.5, -0.5], [511.5, -0.5], [511.5, 511.5], [-0.5, 511.5]])
    for section in _outline(results)[1].field_mm:
        np.testing.assert_allclose(results.cameras[1].project(section), corners, atol=1e-9)


@pytest.mark.parametrize(
    ("rotvec_deg", "across", "sign"),
    [((0, 90, 0), (1, 0, 0), 1), ((0, -90, 0), (1, 0, 0), -1), ((0, 30, 0), (1, 0, 0), 1),
     ((90, 1e-6, 0), (0, 1, 0), -1), ((90, 0, 1e-6), (0, 1, 0), -1),
     ((-90, 1e-6, 0), (0, 1, 0), 1)],
)  # fmt: skip
def test_the_second_camera_is_drawn_where_it_stands(
    rotvec_deg: tuple[float, ...], across: tuple[int, ...], sign: int
) -> None:
    """A camera that is turned by +90 degrees about y stands at the right, by +90 about x above."""
    pose = Pose.from_rotvec(np.radians(rotvec_deg), [0.0, 0.0, 0.0])
    found = _results()
    second = replace(found.cameras[1], camera_from_rig=pose)
    results = _with(**vars(found) | {"cameras": (found.cameras[0], second)})
    plane = common_plane(results.cameras)
    np.testing.assert_allclose(plane, [across, (0, 0, 1)], atol=1e-6)
    first, other = (c.body_mm.reshape(8, 3).mean(0) @ plane.T for c in _outline(results))
    assert np.sign(other[0]) == sign and first[1] < -10.0 and abs(first[0]) < 1e-9
    assert second.unproject([256.0, 256.0])[1] @ np.array(across) * sign < 0  # towards the middle


def test_outline_of_a_perspective_camera_stays_in_front_of_its_centre() -> None:
    results = _results()
    near = results.cameras[0].with_parameters(kappa_per_mm=1 / 30.0)
    outline = _outline(_with(**vars(results) | {"cameras": (near,)}))[0]
    width_mm = np.linalg.norm(outline.field_mm[:, 1] - outline.field_mm[:, 0], axis=1)
    depth_mm = outline.axis_mm[:, 2] + 30.0
    assert depth_mm.min() > 0
    np.testing.assert_allclose(width_mm / depth_mm, 51.2 / 30.0)


def _overlay_tables() -> tuple[pd.DataFrame, pd.DataFrame]:
    shape = {"a_px": 40.0, "b_px": 20.0, "angle_rad": 0.0}
    accepted = pd.DataFrame(
        [{"u_px": 100.0, "v_px": 90.0, **shape, "dot": 7, "row": 1, "column": 2}]
    )
    reasons = ["touches the image border", "touches the image border", "too blurred"]
    rejected = pd.DataFrame(
        [
            {"u_px": 300.0, "v_px": 60.0 + 100 * i, **shape, "reason": r}
            for i, r in enumerate(reasons)
        ]
    )
    return accepted, rejected


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float64])
def test_overlay_marks_what_was_found(kind: type) -> None:
    image = np.full((400, 400), 50, kind)
    image[0, 0] = 51
    picture = draw_overlay(image, *_overlay_tables(), max_width_px=400)
    assert picture.dtype == np.uint8 and picture.shape[1] == 400 and picture.shape[0] > 440
    np.testing.assert_allclose(picture[90, 140], GREEN, atol=60)
    np.testing.assert_allclose(picture[70, 100], GREEN, atol=60)
    np.testing.assert_allclose(picture[60, 340], RED, atol=60)
    assert np.all(picture[200, 200] == picture[200, 200, 0])
    inside = picture[80:101, 90:111].astype(int)
    assert (inside[..., 1] - inside[..., 0] > 80).any(), "the index stands in the dot"
    assert (picture[400:].min(axis=2) < 100).any(), "the legend has letters"


def test_overlay_of_nothing_and_of_wrong_things() -> None:
    accepted, rejected = _overlay_tables()
    assert draw_overlay(np.zeros((50, 60)), accepted[:0], rejected[:0]).shape[1] == 60
    with pytest.raises(InputError, match="grey image"):
        draw_overlay(np.zeros((5, 5, 3)), accepted, rejected)


def test_records_take_numpy_scalars_and_write_nan_as_null(tmp_path: Path) -> None:
    file = tmp_path / "tracking.json"
    found = {"kind": "telerig tracks", "frames": np.int64(3), "pairs": {"scatter_px": np.nan},
             "rig_change": {"moved": np.bool_(True), "offset_mm": np.float64(0.1)}}  # fmt: skip
    TrackingFile.of(found, file).write(file)
    read = TrackingFile.read(file)
    assert read.frames == 3 and read.pairs is not None and read.pairs.scatter_px is None
    assert read.rig_change is not None and read.rig_change.moved


@pytest.mark.parametrize("of", [validation, trial, calibration, run, batch])
def test_every_term_of_a_page_is_in_the_glossary(of: Any) -> None:
    assert all(page.glossary()[term] for term in of.TERMS)


def _nothing(axes: Any) -> Any:
    raise InputError("there is nothing to draw")


def test_a_section_that_says_nothing_is_left_out_and_a_figure_that_cannot_be_drawn() -> None:
    empty = Figure("none", _nothing)
    said = [page.Section("a", "A", page.texts("", "words")), page.Section("b", "B", [empty]),
            page.Section("c", "C", page.table(["x"], []))]  # fmt: skip
    text = page.render_page(page.Page("k", "t", "n", page.Verdict("V", "good"), [empty], said))
    assert 'id="a"' in text and "words" in text
    assert not any(f'id="{name}"' in text for name in ("b", "c", "look"))


def test_a_figure_is_the_same_each_time_it_is_drawn() -> None:
    table = pd.DataFrame({"d_eq_mm": [1.0, 2.0], "sd_eq_mm": 0.1, "slip_mm_s": [100.0, 200.0]})
    table["s_slip_mm_s"], table["run"] = 5.0, ["a", "b"]
    figure = Figure("", partial(plot.speed, table, by="run"), inline=True)
    first, second = drawn(figure), drawn(figure)
    assert first is not None and first == second
    assert 'id="slip_mm_s.0.' in first.svg and 'id="slip_mm_s.1.' in first.svg
