"""telerig correct: one track of a run corrected by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.command_options import TrackingOptions
from telerig.errors import InputError
from telerig.scripts import options
from telerig.scripts.console import errors_in_words, progress, run_file, say, say_written


@errors_in_words()
def correct(
    run: options.Run,
    action: Annotated[str, typer.Argument(help="drop, join, split or rename.")],
    particle: Annotated[
        str, typer.Argument(help="Id of the track; of the one that stays for join.")
    ],
    other: Annotated[
        str,
        typer.Argument(
            help="join: the track that gets the id. split, rename: the new id. drop: nothing."
        ),
    ] = "",
    frame: Annotated[
        int | None,
        typer.Option("--from", min=0, help="First frame that is corrected; needed by split [all]."),
    ] = None,
    reason: Annotated[str, typer.Option(help="Why, for events and report.")] = "by hand",
    out: options.RunFolder = None,
    quiet: options.Quiet = False,
) -> None:
    """Drop, join, split or rename tracks: `telerig correct tank/runs/rise join 12 31 --from 105`.

    Checks the correction against the tracks, adds a row to corrections.csv in the folder of the
    run, and writes the results of `telerig track` again with it. Neither background nor detection
    nor linking is repeated, so that it takes seconds. To undo it, remove the row and track again.

    Exit code 0: corrected. 2: the correction does not fit the tracks, or they are stale; the
    message says why. 130: interrupted.
    """
    from telerig.estimator.batch.work import default_folder, track_run
    from telerig.estimator.tracking.corrections import add_correction
    from telerig.estimator.tracking.tracks import count_words
    from telerig.io.results.stale import stale

    folder = out or default_folder(run)
    if old := stale(folder, ["tracks.csv"]):
        todo = "then correct the new tracks, which may have other ids"
        raise InputError(" ".join(old), where=str(folder), todo=todo)
    chosen, calibration, again = _tracking(folder)
    row = {"action": action, "particle": particle, "other": other, "frame": frame, "reason": reason}
    say(add_correction(run, folder, row))
    report = (folder / "report.html").is_file()
    with progress(quiet) as stage:
        summary = track_run(
            run, folder, chosen, calibration, again=again, report=report, stage=stage
        )
    say(count_words(summary))
    for sentence in (*(f"  warning: {w}" for w in summary["warnings"]), *stale(folder)):
        say(sentence)
    say_written(folder, report)


def _tracking(folder: Path) -> tuple[TrackingOptions, list[Path], str]:
    """Return how the tracks in a folder were made: options, calibration, and the command line."""
    from telerig.io.results.manifest import read_manifest
    from telerig.io.results.record import RunFile

    record, manifest = RunFile.read_if_there(folder / "run.json"), read_manifest(folder)
    recorded = {**(record.tracks.get("options", {}) or record.options)}
    section = manifest.sections.get("track") if manifest is not None else None
    if section is None or "calibration" not in recorded:
        raise InputError(
            "there are no tracks, or run.json does not tell how they were made",
            where=str(folder),
            todo="run `telerig track` first",
        )
    files = [folder / file for file in recorded["calibration"]]
    return TrackingOptions.of(recorded), files, section.again


if __name__ == "__main__":
    run_file(correct)
