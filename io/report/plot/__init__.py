"""`telerig.plot`: pictures of results for notebooks and papers, and for the reports.

In: tables as `telerig` returns and writes them, and optionally the axes to draw on. Out: matplotlib
axes. Read ``bubbles`` first.
"""

from telerig.io.report.plot.bubbles import aspect, drag, path, sizes, spectra, velocity
from telerig.io.report.plot.rig import coverage, residuals, shake, uncertainty

__all__ = [
    "aspect", "coverage", "drag", "path", "residuals", "shake", "sizes", "spectra", "uncertainty",
    "velocity",
]  # fmt: skip


def __dir__() -> list[str]:
    return sorted(__all__)
