"""`telerig.plot`: pictures of results for notebooks and papers, and all pictures of the reports.

In: tables as `telerig` returns and writes them, and optionally the axes to draw on. Out: matplotlib
axes. Read ``bubbles`` first.
"""

from telerig.io.report.plot.bubbles import (
    aspect,
    aspect_over_time,
    drag,
    height,
    path,
    sizes,
    speed,
    velocity,
)
from telerig.io.report.plot.rig import (
    coverage,
    residual_histogram,
    residuals,
    rig,
    split_half,
    target_in_image,
    tilts,
    uncertainty,
)
from telerig.io.report.plot.shake import (
    accelerometer,
    offsets,
    shake,
    spectra,
    spectrum,
    whiteness,
)
from telerig.io.report.plot.target import target
from telerig.io.report.plot.tracking import bubbles_in_frames, marks, ray_miss, ray_miss_along

__all__ = [
    "accelerometer", "aspect", "aspect_over_time", "bubbles_in_frames", "coverage", "drag",
    "height", "marks", "offsets", "path", "ray_miss", "ray_miss_along",
    "residual_histogram", "residuals",
    "rig", "shake", "sizes", "spectra", "spectrum", "speed", "split_half", "target",
    "target_in_image", "tilts", "uncertainty", "velocity", "whiteness",
]  # fmt: skip


def __dir__() -> list[str]:
    return sorted(__all__)
