"""The pictures of docs/gallery.md, made again from a dataset with results.

Usage: python benchmarks/make_gallery.py DATASET RUN [--out docs/pictures]

For instance after `telerig demo` and `telerig report telerig-demo/results/rise --film --format
gif`: python benchmarks/make_gallery.py telerig-demo rise. The pictures are the reports' own and a
frame of each film, as PNG with few colours. (report.png and batch.png are pages in a browser.)
"""

from __future__ import annotations

import argparse
import base64
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from telerig.io.report.calibration import dot_fit, rig, target
from telerig.io.report.calibration import figures as calibration_figures
from telerig.io.report.calibration.results import read_results
from telerig.io.report.page.figures import Picture
from telerig.io.report.run.smoothing import figures
from telerig.io.report.run.smoothing.results import read_smoothing_results
from telerig.io.report.run.tracking.figures import ray_miss_histogram
from telerig.io.report.run.tracking.results import read_track_results, run_cameras
from telerig.io.report.run.tracking.two_rays import two_rays

DPI = 150
COLOURS = 64
LARGEST_BYTES, ALL_BYTES = 150_000, 1_200_000
_SAVE = Figure.savefig


def _as_png(figure: Figure, stream: Any, **options: Any) -> None:
    _SAVE(figure, stream, format="png", dpi=DPI, metadata={"Software": None})


def calibration_pictures(folder: Path) -> Iterator[tuple[str, Picture]]:
    results = read_results(folder)
    yield "rig", rig.rig_plan(results)
    yield "coverage", calibration_figures.coverage(results, 0)
    yield "tilts", calibration_figures.tilts(results)
    yield "residuals", calibration_figures.residual_field(results, 0)
    yield "residual-histogram", calibration_figures.residual_histogram(results)
    yield "target", target.target_pictures(results)[0]
    with np.load(folder / "dot_example.npz") as example:
        yield "dot", dot_fit.dot_pictures(dict(example))[-1]


def run_pictures(folder: Path) -> Iterator[tuple[str, Picture]]:
    tracks = read_track_results(folder)
    yield "ray-miss", ray_miss_histogram(tracks)
    cameras, _ = run_cameras(folder, tracks)
    rays = None if cameras is None else two_rays(tracks, cameras)
    if rays is not None:
        yield "two-rays", rays
    smoothed = read_smoothing_results(folder, np.array([0.0, -1.0, 0.0]))
    if smoothed is None:
        raise SystemExit(f"{folder} is not smoothed: telerig smooth first")
    up, first = 1, smoothed.cameras[0]
    yield "closer", figures.closer(smoothed, up)
    yield "velocity", figures.velocities(smoothed, up)
    yield "shake", figures.shake_in_time(smoothed, first, "y")

    spectra = figures.shake_spectra(smoothed, first)
    if spectra is not None:
        yield "shake-spectra", spectra


def save(image: Image.Image, file: Path) -> int:
    """Few colours, no metadata; bytes written."""
    few = image.convert("RGB").quantize(COLOURS, method=Image.Quantize.FASTOCTREE)
    few.save(file, optimize=True)
    size = file.stat().st_size
    if size > LARGEST_BYTES:
        raise SystemExit(f"{file} has {size} bytes: fewer colours or a smaller figure")
    return size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("run")
    default = Path(__file__).parents[1] / "docs" / "pictures"
    parser.add_argument("--out", type=Path, default=default)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    results = given.dataset / "results"
    total = 0
    with patch.object(Figure, "savefig", _as_png):
        drawn = [*calibration_pictures(results / "calibration"), *run_pictures(results / given.run)]
    for name, picture in drawn:
        pixels = base64.b64decode(picture.source.partition(",")[2])
        size = save(Image.open(BytesIO(pixels)), given.out / f"{name}.png")
        print(f"{name}: {size} bytes; {picture.title}. {picture.caption}")
        total += size
    for name, folder in (("view", results / "calibration"), ("bubble", results / given.run)):
        overlay = min((folder / "overlays").glob("*/*"))
        total += save(Image.open(overlay), given.out / f"{name}.png")
        print(f"{name}: {overlay}")
    for name, film, share in (("film", "path.gif", 0.1), ("film-views", "views.gif", 0.5)):
        with Image.open(results / given.run / "film" / film) as frames:
            frames.seek(int(share * frames.n_frames))
            total += save(frames.copy(), given.out / f"{name}.png")
        print(f"{name}: a frame of {film}")
    if total > ALL_BYTES:
        raise SystemExit(f"{total} bytes in all: more than {ALL_BYTES}")
    print(f"{total} bytes in all")


if __name__ == "__main__":
    main()
