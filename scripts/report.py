"""telerig report: pages and films made again from a folder of results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.errors import InputError
from telerig.scripts import options
from telerig.scripts.console import errors_in_words, progress, run_file, say


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
    run: Annotated[
        Path | None,
        typer.Option(help="The recording, for the film of both views [DATASET/runs/NAME]."),
    ] = None,
    quiet: options.Quiet = False,
) -> None:
    """Make the reports of a folder again, from nothing but its files.

    A folder of results (calibration.json, tracking.json, validation.json or batch.json) gives its
    report.html, a dataset gives those of its calibration and all its runs. With --film each run
    also gets film/path.mp4, its path in space turned once about the vertical, and film/views.mp4,
    the images of all cameras with the detected bubbles.

    Exit code 0: written. 2: the input cannot be used. 130: interrupted.
    """
    from telerig.io.report.film.mp4 import need_av
    from telerig.io.report.film.run import write_films
    from telerig.io.report.remake import remake_report, results_folders
    from telerig.io.results.stale import stale

    if run and not film:
        raise InputError(f"--run {run} is for films", todo="add --film, or leave it out")
    found = results_folders(folder)
    runs = [results for results in found if results.kind == "run"]
    if film and not runs:
        raise InputError(
            "holds no tracked run, and films are made of runs", where=str(folder),
            todo="leave out --film, or name the results folder of a run",
        )  # fmt: skip
    if run and len(runs) > 1:
        raise InputError(
            "--run is given, but there are several runs", where=str(folder),
            todo=f"name the results folder of one run, e.g. {runs[0].folder}",
        )  # fmt: skip
    if film:
        need_av()
    for i, results in enumerate(found):
        alone = found[0].folder == folder
        place = None if out is None else out if alone else out / results.folder.name
        with progress(quiet) as stage:
            if not quiet and len(found) > 1:
                stage("reports", i, len(found))
            say(f"written: {remake_report(results, place)}")
            for sentence in stale(results.folder):
                say(f"warning: {sentence}")
            if film and results.kind == "run":
                folder_of_films = (place or results.folder) / "film"
                for line in write_films(results.folder, folder_of_films, run, stage):
                    say(line)


if __name__ == "__main__":
    run_file(report)
