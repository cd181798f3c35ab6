"""The film of a run's path, turned once about the vertical."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from telerig.io.machine.parallel import ordered_map, quick_workers
from telerig.io.report.film.drawing import draw_path, film_layout
from telerig.io.report.film.files import Progress, write_film
from telerig.io.report.film.geometry import read_film_path
from telerig.io.report.run.tracking.cameras import run_cameras
from telerig.io.report.run.tracking.results import read_track_results

STEP_DEG = 2


def write_path_film(
    results_folder: Path, files: Sequence[Path], *, stage: Progress | None = None
) -> tuple[str, ...]:
    """Film the path that a run's results folder holds, from 180 sides; what to know, in words.

    The view goes round the vertical in steps of 2 degrees, 25 pictures a second. Bubbles are
    ellipsoids from both outlines where the calibration is at hand (`results_cameras`), else
    spheres; the band round a path is +-2 sd, widened by a factor that stands in the film where it
    would be thinner than a line. A long run's path is thinned.

    files : .mp4 (needs PyAV), .gif. Raises InputError for results that cannot be read or hold no
    path, and files that cannot be written.
    """
    folder = Path(results_folder)
    cameras, why = run_cameras(folder, read_track_results(folder))
    path = read_film_path(folder, cameras)
    layout = film_layout(path)
    angles = [float(angle) for angle in range(0, 360, STEP_DEG)]
    pictures = ordered_map(partial(draw_path, path, layout), angles, quick_workers(len(angles)))
    write_film(pictures, len(angles), files, what="turning the path", stage=stage)
    return (*path.notes, *([f"spheres, because {why}"] if why else []))
