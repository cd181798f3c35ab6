"""The film of a run's path in space: `telerig.plot.path`, turned once about the vertical."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from telerig.errors import InputError
from telerig.io.machine.parallel import ordered_map, quick_workers
from telerig.io.report import plot
from telerig.io.report.film.mp4 import Picture, write_film
from telerig.io.report.run.report import up_name
from telerig.io.results.folders.smoothing import read_smoothing_results
from telerig.io.results.folders.tracking import read_track_results
from telerig.io.results.manifest import reading
from telerig.io.tables.table import POINT
from telerig.progress import Progress

STEP_DEG = 3
SIZE_IN, DPI = (6.4, 7.2), 120
"""Width and height of the film, and pixels per inch; both are even in pixels."""
_ELEVATION_DEG = 14.0
_PLACE = (-0.05, 0.02, 1.1, 0.92)
"""Left, bottom, width and height of the axes in the film, below its title."""


def write_path_film(
    results_folder: Path, file: Path, *, stage: Progress | None = None
) -> tuple[str, ...]:
    """Film the path that a run's results folder holds, from 120 sides; return remarks in words.

    The path is that of the page: the smoothed one, or what was tracked. Raises InputError for
    results that cannot be read or hold no path, and a file that cannot be written.
    """
    folder = Path(results_folder)
    with reading(folder, ()):
        results = read_track_results(folder)
        smoothing = read_smoothing_results(folder, results.up)
    smoothed = smoothing is not None and len(smoothing.trajectories) > 0
    table = smoothing.shaped if smoothing is not None and smoothed else results.tracks
    if not np.isfinite(table[[*POINT]].to_numpy(float)).all(1).any():
        raise InputError(
            "no bubble was followed, so there is no path to film", where=str(folder),
            todo="look at the run's report.html for the reasons",
        )  # fmt: skip
    title = f"{results.file.run or folder.name}: "
    title += "smoothed, lab frame" if smoothed else "triangulated, rig frame"
    angles = [float(angle) for angle in range(0, 360, STEP_DEG)]
    draw = partial(draw_path, table, up_name(results.up), title)
    pictures = ordered_map(draw, angles, quick_workers(len(angles)))
    write_film(pictures, len(angles), file, what="turning the path", stage=stage)
    return (title,)


def draw_path(table: pd.DataFrame, up: str, title: str, angle_deg: float) -> Picture:
    """Return the paths of a table as RGB, seen from an angle about the vertical.

    up : as `telerig.plot.path` takes it.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sheet = Figure(figsize=SIZE_IN, dpi=DPI)
    canvas = FigureCanvasAgg(sheet)
    axes = sheet.add_axes(_PLACE, projection="3d", elev=_ELEVATION_DEG, azim=angle_deg)
    plot.path(table, up=up, axes=axes)
    sheet.suptitle(title)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]
