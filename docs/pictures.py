"""Make all pictures of docs/pictures again: python docs/pictures.py [--out FOLDER]

It runs `telerig demo` and a small batch in a temporary folder (some minutes), and draws the
pictures of their reports, a frame of each film, and which folder imports which. The two pictures of
whole pages need chromium or Chrome, those of the viewer what docs/viewer.py needs; without it they
stay as they are. Needs telerig[dev].
"""

from __future__ import annotations

import argparse
import base64
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

import av
import grimp
import networkx as nx
import viewer
from matplotlib.figure import Figure
from PIL import Image

from telerig.io.report.calibration import report as calibration_report
from telerig.io.report.page import figures
from telerig.io.report.run import report as run_report
from telerig.io.results.folders.calibration import read_calibration_results
from telerig.io.results.folders.smoothing import read_smoothing_results
from telerig.io.results.folders.tracking import read_track_results

FOLDER = Path(__file__).parent / "pictures"
DPI = 150
COLOURS = 64
LARGEST_BYTES, ALL_BYTES = 150_000, 700_000
OPENED = ("telerig.estimator", "telerig.io")
"""Folders that are shown as their inner folders in the picture of the imports."""
FLOOR_COLOURS = {"rig": "#d9ead3", "factors": "#fce5cd", "io": "#d0e0f0", "estimator": "#fff2cc"}
_SAVE = Figure.savefig


def pictures(work: Path) -> Iterator[tuple[str, Image.Image]]:
    """Yield the name and the pixels of each picture. work : an empty folder."""
    yield "imports", imports_picture(folder_graph())
    telerig("demo", "--out", work / "demo", "--quiet")
    calibration, run = (work / "demo" / "results" / name for name in ("calibration", "rise"))
    telerig("report", run, "--film", "--quiet")
    with patch.object(Figure, "savefig", _as_png):
        drawn = [*calibration_pictures(calibration), *run_pictures(run)]
    for name, picture in drawn:
        yield name, Image.open(BytesIO(base64.b64decode(picture.source.partition(",")[2])))
    for name, folder in (("view", calibration), ("bubble", run)):
        yield name, Image.open(min((folder / "overlays").glob("*/*")))
    for name, film, share in (("film", "path.mp4", 0.1), ("film-views", "views.mp4", 0.5)):
        with av.open(str(run / "film" / film)) as film:
            frames = list(film.decode(video=0))
        yield name, frames[int(share * len(frames))].to_image()
    if viewer.missing():
        sys.stdout.write(f"not installed: {viewer.missing()}; the viewer's pictures stay\n")
    else:
        yield from viewer_pictures(calibration, run, work)
    browser = next(filter(None, map(shutil.which, viewer.BROWSERS)), None)
    if browser is None:
        sys.stdout.write("no browser: report.png and batch.png stay as they are\n")
        return
    yield "report", screenshot(browser, parts_of_report(calibration), (1280, 1500), work)
    yield "batch", screenshot(browser, batch_page(work / "batch"), (1280, 1700), work)


def viewer_pictures(calibration: Path, run: Path, work: Path) -> Iterator[tuple[str, Image.Image]]:
    """Yield pictures of the viewer: a calibration, a run, and the page's wrong join."""
    wrong = wrong_join(work / "pair")
    for name, folder in (("calibration", calibration), ("run", run), ("join", wrong)):
        yield f"viewer-{name}", shrunk(viewer.viewer_picture(folder))


def wrong_join(place: Path) -> Path:
    """Return the results of docs/viewer.md before its correction, from the blocks of the page."""
    page = (FOLDER.parent / "viewer.md").read_text(encoding="utf-8")
    code = "".join(re.findall(r"^(?:import|found|late|kept).*\n", page, re.MULTILINE))
    telerig("simulate", "rise", "--no-images", "--bubbles", "2", "--frames", "40", "--seed", "1",
            "--out", place)  # fmt: skip
    telerig("calibrate", place, "--quiet", "--no-report")
    telerig("track", place / "runs" / "rise", "--quiet", "--no-report")
    subprocess.run(
        [sys.executable, "-c", f"import pandas as pd\n{code}"], check=True, cwd=place.parent
    )
    telerig("track", place / "runs" / "rise", "--quiet", "--no-report")
    return place / "results" / "rise"


def shrunk(picture: Image.Image) -> Image.Image:
    """Return a picture at three quarters."""
    size_px = (picture.width * 3 // 4, picture.height * 3 // 4)
    return picture.resize(size_px, Image.Resampling.LANCZOS)


def telerig(*arguments: str | Path, code: int = 0) -> None:
    """Run a command. code : the exit code that it has to have."""
    done = subprocess.run([sys.executable, "-m", "telerig", *map(str, arguments)], check=False)
    if done.returncode != code:
        raise SystemExit(f"telerig {arguments[0]} ended with {done.returncode}")


def calibration_pictures(folder: Path) -> Iterator[tuple[str, Any]]:
    titles = {
        "The rig and all poses of the target": "rig", "Coverage, camera left": "coverage",
        "Tilts of the target": "tilts", "Residuals, camera left": "residuals",
        "Distribution of the residuals": "residual-histogram",
        "Print errors in the plane": "target",
    }  # fmt: skip
    return of_page(calibration_report.page_of(read_calibration_results(folder), (), folder), titles)


def run_pictures(folder: Path) -> Iterator[tuple[str, Any]]:
    tracks = read_track_results(folder)
    titles = {
        "Ray miss": "ray-miss", "Height of the longest track, before and after": "closer",
        "Rise velocity": "velocity", "Shake of camera left": "shake",
        "Spectrum of the shake of camera left": "shake-spectra",
    }  # fmt: skip
    smoothed = read_smoothing_results(folder, tracks.up)
    return of_page(run_report.page_of(tracks, smoothed, (), folder), titles)


def of_page(page: Any, titles: dict[str, str]) -> Iterator[tuple[str, Any]]:
    """Yield name and picture of the figures of a page that have these titles."""
    for block in (*page.look, *(one for section in page.sections for one in section.contents)):
        if isinstance(block, figures.Figure) and block.title in titles:
            yield titles[block.title], figures.drawn(block)


def _as_png(figure: Figure, stream: Any, **options: Any) -> None:
    _SAVE(figure, stream, format="png", dpi=DPI, metadata={"Software": None})


def parts_of_report(folder: Path) -> str:
    """Return the page of a calibration without its links, and with its first sections open."""
    shown = "".join(f":not(#{name})" for name in ("verdict", "look", "key", "parameters"))
    style = f"nav, footer, section{shown} {{ display: none }}"
    text = (folder / "report.html").read_text(encoding="utf-8")
    return text.replace("</head>", f"<style>{style}</style></head>", 1)


def batch_page(work: Path) -> str:
    """Return the page of a batch of three small datasets and one without views."""
    places = [work / f"tank-{number}" for number in range(1, 5)]
    for seed, place in enumerate(places[:3]):
        options = ("--no-images", "--accelerometers", "left,right", "--seed", str(seed))
        telerig("simulate", "rise", *options, "--out", place)
    places[3].mkdir()
    shutil.copy(places[0] / "rig.toml", places[3])
    telerig("batch", *places, "--out", work / "weekly", code=1)
    text = (work / "weekly" / "report.html").read_text(encoding="utf-8")
    return text.replace(str(work.resolve()), "/lab")


def screenshot(browser: str, text: str, size_px: tuple[int, int], work: Path) -> Image.Image:
    """Return the upper part of a page in a window of (width, height), at three quarters."""
    page, file, (width, height) = work / "page.html", work / "page.png", size_px
    page.write_text(text, encoding="utf-8")
    subprocess.run(
        [
            browser, "--headless", "--no-sandbox", "--hide-scrollbars",
            "--virtual-time-budget=6000", f"--user-data-dir={work / 'profile'}",
            f"--window-size={width},{height}", f"--screenshot={file}", page.as_uri(),
        ],
        check=True, capture_output=True, timeout=120,
    )  # fmt: skip
    return shrunk(Image.open(file))


def folder_graph() -> nx.DiGraph:
    """Return the graph folder -> folder of the imports.

    Only direct imports that no other path explains are in it (the transitive reduction), so that
    the picture stays readable.
    """
    modules = grimp.build_graph("telerig")
    graph: nx.DiGraph = nx.DiGraph()
    for importer in modules.modules:
        for imported in modules.find_modules_directly_imported_by(importer):
            a, b = _folder_of(importer), _folder_of(imported)
            if a and b and a != b and not {a, b} & {"errors", "version", "io", "estimator"}:
                graph.add_edge(a, b)
    return nx.transitive_reduction(graph)


def _folder_of(module: str) -> str:
    """Return the folder that a module is shown in; "" for modules beside the folders."""
    parts = module.split(".")
    depth = 3 if ".".join(parts[:2]) in OPENED else 2
    return ".".join(parts[1:depth])


def imports_picture(graph: nx.DiGraph) -> Image.Image:
    """Draw each folder one floor above the highest that it imports."""
    floors: dict[str, int] = {}
    for folder in reversed(list(nx.topological_sort(graph))):
        floors[folder] = 1 + max((floors[b] for b in graph.successors(folder)), default=-1)
    place = {}
    for floor in sorted(set(floors.values())):
        here = sorted(f for f, n in floors.items() if n == floor)
        for i, folder in enumerate(here):
            place[folder] = ((i - (len(here) - 1) / 2) * 2.6 + 0.5 * (floor % 2), floor)
    figure = Figure(figsize=(11, 0.85 * len(set(floors.values())) + 1))
    axes = figure.add_subplot()
    for a, b in graph.edges:
        arrow = {"arrowstyle": "->", "color": "#777777", "shrinkA": 12, "shrinkB": 12}
        axes.annotate("", place[b], place[a], arrowprops=arrow)
    for folder, (x, y) in place.items():
        colour = FLOOR_COLOURS.get(folder.split(".")[0], "#eeeeee")
        box = {"boxstyle": "round,pad=0.35", "facecolor": colour, "edgecolor": "#888888"}
        axes.text(x, y, folder.replace(".", "/"), ha="center", va="center", fontsize=9, bbox=box)
    sides = [x for x, _ in place.values()]
    axes.set(xlim=(min(sides) - 1.5, max(sides) + 1.5), ylim=(-0.6, max(floors.values()) + 0.6))
    axes.axis("off")
    stream = BytesIO()
    figure.savefig(stream, dpi=110, bbox_inches="tight")
    return Image.open(stream)


def save(image: Image.Image, file: Path) -> int:
    """Write a PNG with few colours and no metadata; return its size in bytes."""
    few = image.convert("RGB").quantize(COLOURS, method=Image.Quantize.FASTOCTREE)
    few.save(file, optimize=True)
    size = file.stat().st_size
    if size > LARGEST_BYTES:
        raise SystemExit(f"{file} has {size} bytes: fewer colours or a smaller figure")
    return size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=FOLDER)
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    total = 0
    with tempfile.TemporaryDirectory(prefix="telerig-") as work:
        for name, image in pictures(Path(work)):
            size = save(image, out / f"{name}.png")
            sys.stdout.write(f"{name}: {size} bytes\n")
            total += size
    if total > ALL_BYTES:
        raise SystemExit(f"{total} bytes in all: more than {ALL_BYTES}")


if __name__ == "__main__":
    main()
