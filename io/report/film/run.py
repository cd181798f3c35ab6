"""The films of a run: its path in space, and the images of all cameras where they are at hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from telerig.errors import InputError
from telerig.io.dataset.run import load_run, recordings
from telerig.io.report.film.path import write_path_film
from telerig.io.report.film.views import write_views_film
from telerig.io.results.folders.tracking import read_track_results
from telerig.progress import Progress
from telerig.short_text import counted


def write_films(
    results_folder: Path,
    place: Path,
    recording: Path | None,
    stage: Progress,
) -> Iterator[str]:
    """Write path.mp4 and views.mp4 into the folder ``place``; yield a line for each file and note.

    recording : the run's folder; None looks in the dataset, and leaves out the film of the views
    where it is not there. Raises InputError for what cannot be used.
    """
    file = place / "path.mp4"
    yield from _lines(file, write_path_film(results_folder, file, stage=stage))
    if recording is None:
        folder = results_folder.resolve()
        recording = folder.parent.parent / "runs" / folder.name
        why = f"{recording} is not there (name the recording with --run)"
        if recording.is_dir():
            why = "" if recordings(recording) else f"{recording} holds no images"
        if why:
            yield f"the film of both views is left out: {why}"
            return
    tracked = read_track_results(results_folder)
    sizes = tracked.image_sizes_px
    data = load_run(recording, source="images", cameras=tracked.cameras, image_sizes_px=sizes)
    frames = tracked.file.frames or data.frame_count
    if frames > data.frame_count:
        raise InputError(
            f"has {counted(data.frame_count, 'frame')}, but {frames} were tracked",
            where=str(recording),
            todo="name the recording that these results are of (--run DATASET/runs/NAME)",
        )
    images = replace(data, stage=None, accelerometers=None, references=None, skip_unreadable=True)
    file = place / "views.mp4"
    notes = write_views_film(
        results_folder,
        file,
        images=images.image,
        image_sizes_px=data.image_sizes_px,
        frame_count=frames,
        t_s=data.t_s,
        stage=stage,
    )
    yield from _lines(file, notes)


def _lines(file: Path, notes: Sequence[str]) -> Iterator[str]:
    yield f"written: {file} ({file.stat().st_size / 1e6:.1f} MB)"
    yield from (f"  {note}" for note in notes)
