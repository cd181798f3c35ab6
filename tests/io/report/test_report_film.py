"""The film of a run's path, and its geometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from filmed_run import (
    FRAMES,
    HALF_AXES_MM,
    decoded,
    two_cameras,
    write_run,
)

from telerig.errors import InputError
from telerig.io.report.film import path as film_path
from telerig.io.report.film.path import (
    FilmPath,
    Panel,
    draw_path,
    film_axes,
    film_layout,
    read_film_path,
    screen_of,
    view_matrix,
    write_path_film,
)
from telerig.io.results.folders.tracking import read_track_results

BLUE = (31, 95, 168)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("film") / "results" / "rise")


@pytest.fixture(scope="module")
def films(run: Path) -> Path:
    """The path's film, smaller and from a third of the sides, to be quick."""
    place = run / "film"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(film_path, "DPI", 80)
        patch.setattr(film_path, "STEP_DEG", 15)
        write_path_film(run, place / "path.mp4")
    return place


def _path(points: Any, **changes: Any) -> FilmPath:
    points = np.asarray(points, float)
    n = len(points)
    whole: dict[str, Any] = {
        "points_mm": points, "sd_mm": np.full((n, 3), np.nan), "particle": np.zeros(n, np.int64),
        "new": np.arange(n) == 0, "bodies": np.zeros(0, np.int64),
        "quadrics_mm2": np.zeros((0, 3, 3)), "names": ("x", "z", "height"), "title": "",
        "notes": (),
    }  # fmt: skip
    return FilmPath(**(whole | changes))


def project_px(panel: Panel, points_mm: np.ndarray, angle_deg: float) -> np.ndarray:
    matrix, offset = screen_of(panel, angle_deg)
    return np.asarray(points_mm @ matrix[:2].T + offset)


def _is_blue(picture: np.ndarray, at: np.ndarray) -> bool:
    u, v = np.round(at).astype(int)
    return bool(np.abs(picture[v, u].astype(int) - BLUE).max() < 40)


def test_the_film_goes_round_once_and_its_other_half_is_mirrored(run: Path, films: Path) -> None:
    frames = decoded(films / "path.mp4")
    assert [f.name for f in films.iterdir()] == ["path.mp4"]
    path = read_film_path(run)
    layout = film_layout(path)
    assert len(frames) == 24
    assert {f.shape for f in frames} == {
        (layout.size_px[1] * 4 // 5, layout.size_px[0] * 4 // 5, 3)
    }
    end, panel = path.points_mm[-1:], layout.panels[0]
    places = [project_px(panel, end, 15.0 * k)[0] * 0.8 for k in range(24)]
    assert all(_is_blue(frames[k], places[k]) for k in (0, 3, 6, 12, 15, 23))
    middle = project_px(panel, (panel.low_mm + panel.high_mm)[None] / 2, 0.0)[0] * 0.8
    assert abs(places[0][0] - middle[0]) > 12
    assert places[12][0] - middle[0] == pytest.approx(middle[0] - places[0][0])
    mirrored = np.array([2 * middle[0] - places[0][0], places[12][1]])
    assert _is_blue(frames[12], mirrored) and not _is_blue(frames[0], mirrored)


def test_axes_are_no_mirror_image() -> None:
    up = np.array([0.1, -0.9, 0.3])
    up /= np.linalg.norm(up)
    right, forward, above = film_axes(up)
    np.testing.assert_allclose(np.cross(right, above), -forward, atol=1e-12)
    np.testing.assert_allclose(
        film_axes(np.array([0, -1.0, 0])), [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    )
    for angle in (0.0, 33.0, 200.0):
        view = view_matrix(angle, 14.0)
        np.testing.assert_allclose(view @ view.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view) == pytest.approx(-1.0)


def test_the_film_shows_points_where_the_first_camera_sees_them(run: Path) -> None:
    """At angle 0 right on the screen is u of the first camera, and height is -v."""
    path, camera = read_film_path(run), two_cameras()[0]
    results = read_track_results(run)
    uv = camera.project(results.points_mm)
    screen = project_px(film_layout(path).panels[0], path.points_mm, 0.0)
    per_px = np.polyfit(uv[:, 0], screen[:, 0], 1)
    np.testing.assert_allclose(np.polyval(per_px, uv[:, 0]), screen[:, 0], atol=1e-6)
    assert per_px[0] > 0
    np.testing.assert_allclose(path.points_mm[:, 2], -results.points_mm[:, 1])


def test_bodies_are_the_ellipsoids_that_were_seen(run: Path) -> None:
    path = read_film_path(run)
    assert len(path.bodies) >= 4 and "ellipsoids" in path.notes[-1]
    expected = np.diag(HALF_AXES_MM[[0, 2, 1]] ** 2)
    np.testing.assert_allclose(path.quadrics_mm2 - expected, 0, atol=1e-6)


def test_bubbles_of_unknown_shape_are_spheres(tmp_path: Path) -> None:
    run = write_run(tmp_path / "rise")
    table = pd.read_csv(run / "tracks.csv").drop(columns=["equator_mm", "polar_mm"])
    table.to_csv(run / "tracks.csv", index=False)
    (run / "manifest.json").unlink(missing_ok=True)
    path = read_film_path(run)
    radius = np.prod(HALF_AXES_MM) ** (1 / 3)
    np.testing.assert_allclose(path.quadrics_mm2[0], radius**2 * np.eye(3))
    assert "spheres" in path.notes[-1]


def test_the_band_is_two_sd_wide_times_what_the_film_says() -> None:
    height = np.linspace(0, 30, 60)
    straight = np.stack([0 * height, 0 * height, height], -1)
    box = np.array([[-15.0, 0, 0], [15.0, 0, 0]])
    points = np.concatenate([straight, box])
    path = _path(
        points, sd_mm=np.broadcast_to([0.02, 0.02, 0.02], points.shape),
        new=np.isin(np.arange(62), (0, 60, 61)), particle=np.r_[np.zeros(60, int), 1, 2],
    )  # fmt: skip
    layout = film_layout(path)
    (panel,) = layout.panels
    u, v = project_px(panel, np.array([[0, 0, 20.0]]), 0.0)[0]
    row = draw_path(path, layout, 0.0)[round(v)].astype(int)
    tinted = np.flatnonzero(
        row[round(u) - 40 : round(u) + 40, 2] - row[round(u) - 40 : round(u) + 40, 0] > 20
    )
    assert panel.band > 1
    assert np.ptp(tinted) + 1 == pytest.approx(4 * 0.02 * panel.px_per_mm * panel.band, abs=2)


def test_a_slender_path_has_a_second_panel_drawn_wider() -> None:
    height = np.linspace(0, 160, 80)
    path = _path(np.stack([2 * np.sin(height / 9), 2 * np.cos(height / 9), height], -1))
    layout = film_layout(path)
    assert [p.stretch for p in layout.panels] == [1, 10]
    assert all(n % 2 == 0 for n in layout.size_px)
    wide = layout.panels[1]
    at = project_px(wide, np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]), 0.0)
    ratio = (at[1] - at[0])[0] / -(at[2] - at[0])[1]
    assert ratio == pytest.approx(wide.stretch, rel=0.01)
    assert str(wide.stretch) in wide.words


def test_a_long_path_is_thinned_with_words(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film_path, "MOST_POINTS", 8)
    path = read_film_path(run)
    assert len(path.points_mm) <= 9
    assert path.notes[0] == f"{len(path.points_mm)} of {FRAMES} positions drawn"


def test_no_track_no_film(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "results" / "rise", calibration=False)
    header = (folder / "tracks.csv").read_text().splitlines()[0]
    (folder / "tracks.csv").write_text(header + "\n")
    with pytest.raises(InputError, match="no bubble was followed"):
        write_path_film(folder, tmp_path / "a.mp4")
    assert not (tmp_path / "a.mp4").exists()
