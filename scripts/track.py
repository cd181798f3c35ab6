"""telerig track: from pairs of bubble images to 3-D tracks."""

from __future__ import annotations

import time

from telerig.command_options import TrackingOptions
from telerig.scripts import options
from telerig.scripts.console import (
    errors_in_words,
    progress,
    run_file,
    say,
    say_written,
    typed_command,
    viewed,
)


@options.with_options()
@errors_in_words()
def track(
    run: options.Run,
    chosen: TrackingOptions,
    calibration: options.CalibrationFiles = None,
    out: options.RunFolder = None,
    report: options.Report = True,
    view: options.View = False,
    quiet: options.Quiet = False,
) -> None:
    """Find the bubbles of a run, match them across the views, and follow them in space.

    Writes detections.csv, tracks.csv, events.csv, tracking.json, run.json and report.html. The
    same command, given again, continues an interrupted run. With --cluster the workers detect the
    bubbles, in batches of frames; they must see the run and the results at the same paths. When
    only corrections.csv has changed, the detection is not repeated.

    Exit code 0: tracked. 2: the input cannot be used; the message says what, where and what to do.
    130: interrupted.
    """
    from telerig.estimator.batch.jobs import check_run_name
    from telerig.estimator.batch.work import default_folder, track_run
    from telerig.estimator.tracking.tracks import tracking_words

    begun = time.perf_counter()
    if out is None:
        check_run_name(run)
    folder = out or default_folder(run)
    with viewed(view, run.name), progress(quiet) as stage:
        summary = track_run(
            run, folder, chosen, calibration, again=typed_command(), report=report, stage=stage
        )
    say(tracking_words(summary, time.perf_counter() - begun, stage.words()))
    say_written(folder, report)


if __name__ == "__main__":
    run_file(track)
