"""Estimate how long a run will take to track and to smooth, from one of its frames."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from telerig.estimator.bubbles.detect import Bubbles, find_bubbles, load_compiled_loops
from telerig.estimator.tracking.detect_run import described_fields
from telerig.io.dataset.run import RunData
from telerig.io.files.frame_table import FrameTable
from telerig.io.machine.parallel import cores

_BACKGROUND_S_PER_MPX = 1.5
_LINK_S, _SMOOTH_S, _LEARN_S = 0.4e-3, 0.2e-3, 25.0
"""Seconds to link and to smooth a bubble in a frame, and to learn a run's priors, as measured by
`benchmarks/whole_run.py` and `benchmarks/smoothing_speed.py`."""
_TRACK_MB, _TRACK_MB_PER_MPX = 200.0, 300.0


@dataclass(frozen=True)
class Sample:
    """What was found in an image (rows, columns), and the CPU time in s that it took."""

    bubbles: Bubbles
    size: int
    seconds: float


def samples_of(run: RunData) -> dict[str, Sample]:
    """Detect the bubbles in the middle of a run of images, by camera; those without it are absent.

    Raises InputError for an image or a mask that cannot be read.
    """
    fields, found = described_fields(run), {}
    load_compiled_loops()
    for camera in run.cameras:
        begun = time.process_time()
        image = run.image(camera, run.frame_count // 2)
        if image is not None:
            bubbles = find_bubbles(image, field=fields.get(camera))
            found[camera] = Sample(bubbles, image.size, time.process_time() - begun)
    return found


def cost_words(run: RunData, samples: Mapping[str, Sample]) -> str:
    """Return in words how long a run takes to track and to smooth, and the memory for tracking.

    samples : of its images, from `samples_of`; "" is returned where one of them is absent.
    """
    detect_s = background_s = pixels = 0.0
    if run.detections is not None:
        found = run.detections
        if isinstance(found, FrameTable):
            known = found.rows
        else:
            known = int(np.isfinite(found["u_px"].to_numpy(float)).sum())
        bubbles = known / (run.frame_count * len(run.cameras))
    elif len(samples) < len(run.cameras):
        return ""
    else:
        bubbles = float(np.mean([len(one.bubbles.accepted) for one in samples.values()]))
        detect_s = sum(one.seconds for one in samples.values())
        pixels = max(one.size for one in samples.values()) / 1e6
        background_s = _BACKGROUND_S_PER_MPX * pixels * len(run.cameras)
    link_s = run.frame_count * bubbles * _LINK_S
    track_s = (background_s + run.frame_count * detect_s) / cores() + link_s
    smooth_s = _LEARN_S + run.frame_count * bubbles * _SMOOTH_S
    memory = _TRACK_MB + _TRACK_MB_PER_MPX * pixels
    return (
        f"bubbles in sight: {bubbles:.0f}; tracking takes about {_duration(track_s)} on {cores()} "
        f"cores and {memory:.0f} MB a process, smoothing about {_duration(smooth_s)}"
    )


def _duration(seconds: float) -> str:
    """Return a time in words, rounded as an estimate deserves."""
    if seconds < 90:
        return f"{max(5, 5 * round(seconds / 5))} s"
    return f"{round(seconds / 60)} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
