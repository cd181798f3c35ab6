"""The page of a trial recording: what `telerig doctor RUN` found, with pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from telerig.io.dataset.run import RunData
from telerig.io.files.atomic import write_text_atomic
from telerig.io.report.film.views import outlines_px
from telerig.io.report.overlays import draw_bubble_overlay
from telerig.io.report.page.figures import (
    CAMERA_COLOURS,
    Curve,
    Picture,
    data_uri,
    draw_curves,
    drawing,
)
from telerig.io.report.page.page import Row, Section, render_sections
from telerig.io.report.plot.spectrum import shake_spectrum
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
) -> None:
    """Write the page of a trial recording.

    checks : (name, "ok", "note", "warning" or "failure", words, what to do). detections : as in
    `telerig.Tracks`; None without tracks. shake : as in shake.csv; None where it was not smoothed.
    """
    bad = [check for check in checks if check[1] == "failure"]
    verdict = {
        "colour": "rejected" if bad else "good",
        "headline": f"{counted(len(bad), 'thing')} to mend before the run" if bad else "READY",
        "sentences": [f"{name}: {words}. To do: {todo}." for name, _, words, todo in bad]
        or ["Nothing that was looked at is beyond its limit."],
        "warnings": [words for _, status, words, _ in checks if status == "warning"],
    }
    rows = tuple(
        Row((name, _SIGNS[status], words, todo), strong=status == "failure")
        for name, status, words, todo in checks
    )
    pictures = (*_views(run, detections), *_shake(run, shake))
    page = render_sections(
        "telerig doctor of a trial recording", "Trial recording", run.name, verdict,
        [
            Section(pictures=pictures),
            Section("What was looked at", head=("check", "", "found", "to do"), rows=rows,
                    numbers=(99, 99)),
        ],
        TERMS,
    )  # fmt: skip
    file.parent.mkdir(parents=True, exist_ok=True)
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
        _, png = cv2.imencode(".png", drawn[..., ::-1])
        yield Picture(
            f"Camera {camera}, frame {frame}", data_uri("image/png", png.tobytes()),
            "Outlines should follow the rims, and the backlight should be even.",
        )  # fmt: skip


def _shake(run: RunData, shake: pd.DataFrame | None) -> Iterator[Picture]:
    """Yield each camera's shake in time, and its spectrum."""
    if shake is None:
        return
    for camera in run.cameras:
        t_s = shake["t_s"].to_numpy(float)
        with drawing(1.9, legend="above", xlabel="time / s", ylabel="shake / µm") as sheet:
            draw_curves(
                sheet,
                (
                    Curve(t_s, 1e3 * shake[f"{camera}_{axis}_mm"].to_numpy(float),
                          CAMERA_COLOURS[k % len(CAMERA_COLOURS)], axis)
                    for k, axis in enumerate("xyz")
                ),
            )  # fmt: skip
        yield Picture(f"Shake of camera {camera}", sheet.source, "Offset from the carriage.")
        spectrum = shake_spectrum(shake, camera)
        if spectrum is None:
            continue
        with drawing(
            1.9, legend="above", grid=True, xlabel="frequency / Hz", ylabel="µm² / Hz",
            xscale="log", yscale="log",
        ) as sheet:  # fmt: skip
            for k, axis in enumerate("xyz"):
                values = spectrum.density[1:, k]
                if (values > 0).any():
                    sheet.axes.plot(spectrum.frequency_hz[1:], values, label=axis,
                                    color=CAMERA_COLOURS[k % len(CAMERA_COLOURS)])  # fmt: skip
        yield Picture(
            f"Spectrum of the shake of camera {camera}", sheet.source,
            "A narrow peak is a resonance of the rig, which can be stiffened or damped.",
        )  # fmt: skip
