"""The film of a run's path."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from filmed_run import decoded, write_run

from telerig.errors import InputError
from telerig.io.report.film import path as film_path
from telerig.io.report.film.path import draw_path, write_path_film
from telerig.io.results.folders.tracking import read_track_results


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("film") / "results" / "rise")


def test_the_film_turns_the_figure_of_the_page_once(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(film_path, "STEP_DEG", 90)
    monkeypatch.setattr(film_path, "DPI", 50)
    (note,) = write_path_film(run, tmp_path / "path.mp4")
    assert note == "rise: triangulated, rig frame"
    frames = decoded(tmp_path / "path.mp4")
    assert len(frames) == 4 and {f.shape for f in frames} == {(360, 320, 3)}
    tracks = read_track_results(run).tracks
    drawn = [draw_path(tracks, "-y", note, angle) for angle in (0.0, 90.0, 180.0, 270.0)]
    for frame, picture in zip(frames, drawn):
        away = [np.abs(frame.astype(float) - other).mean() for other in drawn]
        assert int(np.argmin(away)) == [np.array_equal(picture, d) for d in drawn].index(True)


def test_no_track_no_film(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "results" / "rise", calibration=False)
    header = (folder / "tracks.csv").read_text().splitlines()[0]
    (folder / "tracks.csv").write_text(header + "\n")
    with pytest.raises(InputError, match="no bubble was followed"):
        write_path_film(folder, tmp_path / "a.mp4")
    assert not (tmp_path / "a.mp4").exists()
