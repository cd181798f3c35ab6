"""The page of a trial recording: what `telerig doctor RUN` found, with pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from telerig.io.dataset.run import RunData
from telerig.io.files.atomic import write_text_atomic
from telerig.io.report import plot
from telerig.io.report.film.views import outlines_px
from telerig.io.report.overlays import draw_bubble_overlay, encoded
from telerig.io.report.page.figures import Figure, Picture, data_uri
from telerig.io.report.page.page import Page, Row, Section, Verdict, render_page, table
from telerig.short_text import counted

TERMS = ("Verdict", "Covariance, standard deviation (sd)")
_SIGNS = {"ok": "", "note": "note", "warning": "look", "failure": "mend"}
_WIDTH_PX = 480


def write_trial_report(
    file: Path,
    run: RunData,
    checks: Sequence[tuple[str, str, str, str]],
    detections: pd.DataFrame | None,
    shake: pd.DataFrame | None,
    *,
    up: str = "-y",
) -> None:
    """Write the page of a trial recording.

    checks : (name, "ok", "note", "warning" or "failure", words, what to do). detections : as in
    `telerig.Tracks`; None without tracks. shake : as in shake.csv; None where it was not smoothed.
    up : the axis of the rig that points upwards, as for `telerig.plot`.
    """
    bad = [check for check in checks if check[1] == "failure"]
    verdict = Verdict(
        f"{counted(len(bad), 'thing')} to mend before the run" if bad else "READY",
        "rejected" if bad else "good",
        tuple(f"{name}: {words}. To do: {todo}." for name, _, words, todo in bad)
        or ("Nothing that was looked at is beyond its limit.",),
        tuple(words for _, status, words, _ in checks if status == "warning"),
    )
    rows = [
        Row((name, _SIGNS[status], words, todo), strong=status == "failure")
        for name, status, words, todo in checks
    ]
    head = ("check", "", "found", "to do")
    page = render_page(Page(
        "telerig doctor of a trial recording", "Trial recording", run.name, verdict,
        [*_views(run, detections), *_shake(run, shake, up)],
        [Section("checks", "What was looked at", table(head, rows, (99, 99)))], TERMS,
    ))  # fmt: skip
    write_text_atomic(file, page)


def _views(run: RunData, detections: pd.DataFrame | None) -> Iterator[Picture]:
    """Yield each camera's image in the middle of the recording, with the outlines found there."""
    if run.source != "images":
        return
    frame = run.frame_count // 2
    for camera in run.cameras:
        image = run.image(camera, frame)
        if image is None:
            continue
        outlines = np.zeros((0, 0, 2))
        if detections is not None:
            here = (detections["camera"] == camera) & (detections["frame"] == frame)
            outlines = outlines_px(detections[here])
        drawn = draw_bubble_overlay(
            image, list(outlines), [""] * len(outlines), max_width_px=_WIDTH_PX
        )
        yield Picture(
            f"Camera {camera}, frame {frame}", data_uri("image/png", encoded(drawn, ".png")),
            "Outlines should follow the rims, and the backlight should be even.",
        )  # fmt: skip


def _shake(run: RunData, shake: pd.DataFrame | None, up: str) -> Iterator[Figure]:
    """Yield each camera's shake in time, and its spectrum."""
    if shake is None:
        return
    for camera in run.cameras:
        yield Figure(f"Shake of camera {camera}", partial(plot.shake, shake, camera, up=up),
                     "Offset from the carriage.", 2.2)  # fmt: skip
        yield Figure(f"Spectrum of the shake of camera {camera}",
                     partial(plot.spectrum, shake, camera, up=up),
                     "A narrow peak is a resonance of the rig, which can be stiffened or damped.",
                     2.2)  # fmt: skip
