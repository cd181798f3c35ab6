"""The film of both cameras' images."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from filmed_run import (
    FRAMES,
    SIZE_PX,
    decoded,
    write_run,
)

from telerig.errors import InputError
from telerig.io.report.film import views
from telerig.io.report.film.mp4 import write_film
from telerig.io.report.film.views import (
    draw_views,
    found_outlines,
    outlines_px,
    view_frames,
    write_views_film,
)
from telerig.io.results.folders.tracking import read_track_results


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("film") / "results" / "rise")


def _few(count: int = 3) -> Iterator[np.ndarray]:
    for k in range(count):
        yield np.full((40, 60, 3), 60 * k, np.uint8)


def test_without_pyav_the_error_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError) as caught:
        write_film(_few(), 3, tmp_path / "a.mp4")
    assert "pip install 'telerig[video]'" in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_broken_off_film_leaves_the_old_one(tmp_path: Path) -> None:
    def fails() -> Iterator[np.ndarray]:
        yield from _few(2)
        raise KeyboardInterrupt

    file = tmp_path / "a.mp4"
    file.write_text("old")
    with pytest.raises(KeyboardInterrupt):
        write_film(fails(), 9, file)
    assert list(tmp_path.iterdir()) == [file] and file.read_text() == "old"


def _image(camera: str, frame: int) -> np.ndarray | None:
    if camera == "right" and frame == 2:
        return None
    return np.full((SIZE_PX[1], SIZE_PX[0]), 150 if frame else 151, np.uint8)


SIZES = {"left": SIZE_PX, "right": SIZE_PX}


def test_both_views_film(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "v.mp4"
    write_views_film(run, file, images=_image, image_sizes_px=SIZES, frame_count=FRAMES)
    frames = decoded(file)
    assert len(frames) == FRAMES
    assert frames[0].shape[1] >= 2 * SIZE_PX[0] and frames[0].shape[0] >= SIZE_PX[1]
    monkeypatch.setattr(views, "MOST_FRAMES", 10)
    notes = write_views_film(run, file, images=_image, image_sizes_px=SIZES, frame_count=FRAMES)
    assert notes == (f"both views: every 3. of {FRAMES} frames is shown",)
    assert len(decoded(file)) == 8


def test_outlines_and_tails_are_drawn_where_they_were_found(run: Path) -> None:
    table = found_outlines(read_track_results(run), ("left", "right"))
    frames = list(view_frames(table, ("left", "right"), range(FRAMES), None))
    tracks = read_track_results(run).tracks
    np.testing.assert_allclose(
        frames[5].found[1][0].tail_px, tracks[["right_u_px", "right_v_px"]].to_numpy()[:6]
    )
    shades = dict.fromkeys(SIZES, (0.0, 255.0))
    page = draw_views(_image, SIZES, shades, frames[9]).astype(int)
    ring = frames[9].found[0][0].outline_px
    coloured = np.ptp(page, axis=2) > 50
    top = page.shape[0] - SIZE_PX[1]
    u, v = np.round(ring.T).astype(int)
    assert coloured[v + top, u].mean() > 0.95
    assert not coloured[top + 2 : top + 40].any()
    assert np.ptp(draw_views(_image, SIZES, shades, frames[2])[-20:, -60:]) == 0


def test_outline_is_the_documented_curve() -> None:
    """At phi = 0 the normal is the long axis: c_k add up there; s_3 acts at phi = 30 degrees."""
    row = dict.fromkeys(views._SHAPE, 0.0)
    row |= {"u_px": 10, "v_px": 20, "a_px": 8, "b_px": 5, "angle_rad": np.pi / 2}
    table = pd.DataFrame([row, row | {"c3_px": 0.5, "c4_px": 0.25}, row | {"s3_px": 1.0},
                          row | {"a_px": np.nan}])  # fmt: skip
    plain, bumpy, turned, bare = outlines_px(table, 72)
    np.testing.assert_allclose(plain[[0, 18]], [[10, 28], [5, 20]], atol=1e-12)
    np.testing.assert_allclose(bumpy[0], [10, 28.75], atol=1e-12)
    assert np.linalg.norm(turned[6] - plain[6]) == pytest.approx(1.0)
    np.testing.assert_allclose(np.linalg.norm(bare - [10, 20], axis=1), 6.0)
