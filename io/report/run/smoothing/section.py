"""The part of a run's report that is about its smoothing: words and drawings for the page."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from telerig.io.report.run.smoothing.figures import closer, places, taken_off, velocities
from telerig.io.report.run.smoothing.results import SmoothingResults
from telerig.io.report.run.smoothing.shake import (
    shake_in_time,
    shake_spectra,
    unseen_words,
    velocity_before_and_after,
)
from telerig.io.report.run.smoothing.tables import (
    MODE_HEADS,
    constant_rows,
    mean_rows,
    mode_rows,
    model_rows,
    model_words,
)
from telerig.io.report.run.smoothing.whiteness import (
    WHITENESS_HEADS,
    accelerometer_before_and_after,
    accelerometer_names,
    autocorrelation,
    whiteness_rows,
    whiteness_words,
)
from telerig.io.report.run.smoothing.wording import (
    axis_table,
    judged_axes,
    residual_rows,
    residual_words,
    smoothing_figures,
    smoothing_verdict,
    swap_rows,
)
from telerig.io.report.run.tracking.results import TrackResults

PLACES = ("lab", "taken", "velocity", "shake", "spectra", "white")
"""Sections that hold drawings."""


def smoothing_words(results: SmoothingResults, tracks: TrackResults) -> dict[str, Any]:
    """What template_smoothing.html calls ``smoothing``."""
    verdict = smoothing_verdict(results, tracks)
    return {
        "verdict": verdict,
        "figures": smoothing_figures(results),
        "axes": axis_table(results),
        "judged": bool(judged_axes(results.content)),
        "swaps": swap_rows(results),
        "unseen": unseen_words(results),
        "mode_heads": MODE_HEADS,
        "modes": mode_rows(results),
        "unsure": verdict.colour == "rejected",
        "residuals": residual_rows(results),
        "residual_words": residual_words(results),
        "whiteness_heads": WHITENESS_HEADS,
        "whiteness": whiteness_rows(results),
        "whiteness_words": whiteness_words(results),
        "constants": constant_rows(results),
        "means": mean_rows(results),
        "model": model_rows(results),
        "model_words": model_words(results),
    }


def smoothing_drawings(results: SmoothingResults) -> list[tuple[str, Callable[[], Any]]]:
    """(section, drawing); a drawing gives a `Picture`, or None where there is nothing to see."""
    axes = range(3)
    bubbles = axes if len(results.trajectories) else range(0)
    drawings: list[tuple[str, Callable[[], Any]]] = [
        *(("lab", partial(places, results, axis)) for axis in bubbles),
        *(("lab", partial(closer, results, axis)) for axis in bubbles),
        *(("taken", partial(taken_off, results, axis)) for axis in bubbles),
        *(("velocity", partial(velocities, results, axis)) for axis in bubbles),
    ]
    for camera in results.cameras if len(results.shake) else ():
        drawings += [("shake", partial(shake_in_time, results, camera, axis))
                     for axis in results.seen(camera)]  # fmt: skip
    drawings += [("spectra", partial(velocity_before_and_after, results, axis)) for axis in axes]
    drawings += [("spectra", partial(shake_spectra, results, c)) for c in results.cameras]
    drawings += [
        ("spectra", partial(accelerometer_before_and_after, results, sensor))
        for sensor in accelerometer_names(results)
    ]
    white = [("white", partial(autocorrelation, results))] if whiteness_rows(results) else []
    return drawings + white
