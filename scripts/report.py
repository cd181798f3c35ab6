"""telerig report: pages and films made again from a folder of results."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from telerig.errors import InputError
from telerig.scripts import options
from telerig.scripts.console import errors_in_words, progress, run_file, say

if TYPE_CHECKING:
    from telerig.io.report.film.files import Progress
    from telerig.io.report.remake import ResultsFolder


class FilmFormat(StrEnum):
    """Kinds of film files."""

    both = "both"
    mp4 = "mp4"
    gif = "gif"


@errors_in_words()
def report(
    folder: Annotated[
        Path,
        typer.Argument(help="Results of a calibration, run or batch; or a dataset, for all of it."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Where to write [the folder itself]; for a dataset, one folder each."),
    ] = None,
    film: Annotated[
        bool, typer.Option(help="Also make films of each run: its path in space, and both views.")
    ] = False,
    film_format: Annotated[
        FilmFormat, typer.Option("--format", help="Format of the films.")
    ] = FilmFormat.both,
    run: Annotated[
        Path | None,
        typer.Option(help="The recording, for the film of both views [DATASET/runs/NAME]."),
    ] = None,
    quiet: options.Quiet = False,
) -> None:
    """Make the reports of a folder again, from nothing but its files.

    A folder of results (calibration.json, tracking.json or batch.json) gives its report.html, a
    dataset gives those of its calibration and all its runs. With --film each run also gets
    film/path.mp4 and film/path.gif, its path in space turned once about the vertical, and
    film/views.mp4 and film/views.gif, the images of both cameras with the detected bubbles.

    Exit code 0: written. 2: the input cannot be used. 130: interrupted.
    """
    from telerig.io.report.film.files import need_av
    from telerig.io.report.remake import remake_report, results_folders

    found = results_folders(folder)
    runs = [results for results in found if results.kind == "run"]
    if (film or run) and not runs:
        raise InputError(
            "holds no tracked run, and films are made of runs", where=str(folder),
            todo="leave out --film, or name the results folder of a run",
        )  # fmt: skip
    if run and len(runs) > 1:
        raise InputError(
            "--run is given, but there are several runs", where=str(folder),
            todo=f"name the results folder of one run, e.g. {runs[0].folder}",
        )  # fmt: skip
    if film and film_format is not FilmFormat.gif:
        need_av()
    for i, results in enumerate(found):
        alone = found[0].folder == folder
        place = None if out is None else out if alone else out / results.folder.name
        with progress(quiet) as stage:
            if not quiet and len(found) > 1:
                stage("reports", i, len(found))
            say(f"written: {remake_report(results, place)}")
            if film and results.kind == "run":
                _film(results, (place or results.folder) / "film", film_format, run, stage)


def _film(
    results: ResultsFolder, place: Path, kind: FilmFormat, run: Path | None, stage: Progress
) -> None:
    """Both films; the second only where the recording's images are at hand."""
    from telerig.io.report.film.path import write_path_film

    endings = ("mp4", "gif") if kind is FilmFormat.both else (kind.value,)
    files = [place / f"path.{ending}" for ending in endings]
    notes = write_path_film(results.folder, files, stage=stage)
    _say_written(files, notes)
    recording, why = _recording(results.folder, run)
    if recording is None:
        say(f"the film of both views is left out: {why}")
        return
    files = [place / f"views.{ending}" for ending in endings]
    _say_written(files, _film_views(results.folder, recording, files, stage))


def _film_views(
    folder: Path, recording: Path, files: list[Path], stage: Progress
) -> tuple[str, ...]:
    from telerig.io.dataset.run import load_run
    from telerig.io.report.film.views import write_views_film
    from telerig.io.report.run.tracking.results import read_track_results

    tracked = read_track_results(folder)
    sizes = {c: s for c in tracked.cameras if (s := tracked.image_size_px(c)) is not None}
    data = load_run(recording, source="images", cameras=tracked.cameras, image_sizes_px=sizes)
    frames = int(tracked.content.get("frames") or data.frame_count)
    if frames > data.frame_count:
        raise InputError(
            f"has {data.frame_count} frames, but {frames} were tracked", where=str(recording),
            todo="name the recording that these results are of (--run DATASET/runs/NAME)",
        )  # fmt: skip
    images = replace(data, stage=None, accelerometers=None, references=None, skip_unreadable=True)
    return write_views_film(
        folder, files, images=images.image, image_sizes_px=data.image_sizes_px,
        frame_count=frames, t_s=data.t_s, stage=stage,
    )  # fmt: skip


def _recording(folder: Path, run: Path | None) -> tuple[Path | None, str]:
    """The run's folder, or why there is none. A run that is named must exist."""
    if run is not None:
        return run, ""
    place = folder.resolve()
    guess = place.parent.parent / "runs" / place.name
    if not guess.is_dir():
        return None, f"{guess} is not there (name the recording with --run)"
    entries = [p for p in guess.iterdir() if not p.name.startswith(".")]
    if not any(p.is_dir() or p.suffix.lower() in _RECORDED for p in entries):
        return None, f"{guess} holds no images"
    return guess, ""


_RECORDED = (".tif", ".tiff", ".avi", ".mp4", ".mov", ".mkv")


def _say_written(files: list[Path], notes: tuple[str, ...]) -> None:
    for file in files:
        say(f"written: {file} ({file.stat().st_size / 1e6:.1f} MB)")
    for note in notes:
        say(f"  {note}")


if __name__ == "__main__":
    run_file(report)
