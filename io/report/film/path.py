"""The film of a run's path in space, turned once about the vertical."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.io.machine.parallel import ordered_map, quick_workers
from telerig.io.report.film.mp4 import Picture, Progress, write_film
from telerig.io.report.plot.axes import colour_of
from telerig.io.report.plot.tracks import spaced, thinned
from telerig.io.results.bodies import ellipsoids_of
from telerig.io.results.folders.smoothing import read_smoothing_results
from telerig.io.results.folders.tracking import TrackResults, read_track_results
from telerig.io.results.manifest import reading
from telerig.io.tables.table import SHAPE_COLUMNS

STEP_DEG = 2
MOST_POINTS = 3_000
MOST_BODIES = 120
_PLACE, _SD = ["x_mm", "y_mm", "z_mm"], ["sx_mm", "sy_mm", "sz_mm"]
_VARIANCE = ["sxx_mm2", "syy_mm2", "szz_mm2"]

DPI = 100
"""Of the pictures; all lengths below in px are at 100 dpi."""

_HEIGHT_PX, _NARROW_PX, _WIDE_PX = 960, 560, 960
_ABOVE_PX, _BELOW_PX, _SIDE_PX = 112, 92, 74
_LEFT_PX, _RIGHT_PX = 300, 500
_ELEVATION_DEG, _ELEVATION_STRETCHED_DEG = 14.0, 4.0
_SLENDER, _STRETCHED = 3.5, 0.6
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_LEAST_BAND_PX, _TICK_PX = 2.5, 46
_MOST_NAMES = 12
_INK, _SOFT, _EDGE = "#1c1f24", "#5b626d", "#c4c9d1"
_SHADES = ((1.0, 0.62), (0.72, 0.74), (0.42, 0.86))
"""Size and share of white of the three discs that shade a bubble, lightest towards upper left."""


def write_path_film(
    results_folder: Path, file: Path, *, stage: Progress | None = None
) -> tuple[str, ...]:
    """Film the path that a run's results folder holds, from 180 sides; return remarks in words.

    Bubbles are ellipsoids where their shapes are known, else spheres; the band round a path is
    +-2 sd, widened where it would be thinner than a line, by a factor that stands in the film. A
    long run's path is thinned. Raises InputError for results that cannot be read or hold no path,
    and a file that cannot be written.
    """
    folder = Path(results_folder)
    path = read_film_path(folder)
    angles = [float(angle) for angle in range(0, 360, STEP_DEG)]
    draw = partial(draw_path, path, film_layout(path))
    pictures = ordered_map(draw, angles, quick_workers(len(angles)))
    write_film(pictures, len(angles), file, what="turning the path", stage=stage)
    return path.notes


@dataclass(frozen=True)
class FilmPath:
    """Paths in the film's axes: right and forward (away from the viewer) at angle 0, and up.

    points_mm, sd_mm : (N, 3), by particle and frame.
    particle : (N,).
    new : (N,), rows before which the line is interrupted.
    bodies : (B,) rows whose bubble is drawn.
    quadrics_mm2 : (B, 3, 3), Q of the ellipsoid x^T Q^-1 x = 1.
    names : of the axes.
    notes : for the viewer.
    """

    points_mm: Array
    sd_mm: Array
    particle: Ints
    new: Bools
    bodies: Ints
    quadrics_mm2: Array
    names: tuple[str, str, str]
    title: str
    notes: tuple[str, ...]


def film_axes(up: Array) -> Array:
    """Return rows right, forward, up (3, 3) in rig axes; right is x, or z where x is upright."""
    first = np.eye(3)[0 if abs(up[0]) < 0.7 else 2]
    right = first - (first @ up) * up
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(up, right), up])


def read_film_path(folder: Path) -> FilmPath:
    """Return the path that a run's results folder holds: smoothed in the lab frame, or tracks.

    Raises InputError for a folder that cannot be read, or holds no point.
    """
    with reading(folder, ()):
        results = read_track_results(folder)
        smoothing = read_smoothing_results(folder, results.up)
    table, title = _table(results, None if smoothing is None else smoothing.trajectories)
    found = int(np.isfinite(table[_PLACE].to_numpy(float)).all(1).sum())
    if not found:
        raise InputError(
            "no bubble was followed, so there is no path to film", where=str(folder),
            todo="look at the run's report.html for the reasons",
        )  # fmt: skip
    kept = thinned(table, MOST_POINTS).reset_index(drop=True)
    notes = [f"{len(kept)} of {found} positions drawn"] if len(kept) < found else []
    axes = film_axes(results.up)
    rows, quadrics, how = _bodies(results, kept)
    names = tuple(_axis_name(direction) for direction in axes[:2])
    return FilmPath(
        kept[_PLACE].to_numpy(float) @ axes.T,
        np.sqrt(kept[_SD].to_numpy(float) ** 2 @ (axes.T**2)),
        kept["particle"].to_numpy(np.int64),
        kept["new"].to_numpy(bool),
        rows,
        axes @ quadrics @ axes.T,
        (names[0], names[1], "height"),
        f"{results.file.run or folder.name}: {title}",
        (*notes, how),
    )


def _table(results: TrackResults, smoothed: pd.DataFrame | None) -> tuple[pd.DataFrame, str]:
    """Return the rows with frame, particle, place and sd."""
    if smoothed is not None and len(smoothed):
        missing = {name: np.nan for name in _SD if name not in smoothed}
        return smoothed.assign(**missing), "smoothed, lab frame"
    variance = results.tracks[_VARIANCE].to_numpy(float)
    sd = np.sqrt(np.where(variance >= 0, variance, np.nan))
    return results.tracks.assign(**dict(zip(_SD, sd.T))), "triangulated, rig frame"


def _axis_name(direction: Array) -> str:
    axis = int(np.argmax(np.abs(direction)))
    return ("" if direction[axis] > 0 else "-") + "xyz"[axis]


def _bodies(results: TrackResults, kept: pd.DataFrame) -> tuple[Ints, Array, str]:
    """Return the rows of ``kept``, their quadrics in rig axes, and in words what is drawn."""
    here = kept[["frame", "particle"]].assign(row=np.arange(len(kept)))
    shape = [name for name in SHAPE_COLUMNS if name in results.tracks]
    sizes = results.tracks[["frame", "particle", "d_eq_mm", *shape, *_PLACE]].merge(
        here, on=["frame", "particle"]
    )
    sizes = sizes[np.isfinite(sizes["d_eq_mm"].to_numpy(float))].sort_values("row")
    points = kept[_PLACE].to_numpy(float)[sizes["row"].to_numpy(np.int64)]
    particle, diameter = (sizes[name].to_numpy(float) for name in ("particle", "d_eq_mm"))
    sizes = sizes.iloc[spaced(points, particle, diameter, MOST_BODIES)].reset_index(drop=True)
    quadrics, shaped = ellipsoids_of(sizes)
    rows = sizes["row"].to_numpy(np.int64)
    kind = "ellipsoids from their outlines" if shaped.any() else "spheres of equal volume"
    return rows, quadrics, f"bubbles: {kind}"


@dataclass(frozen=True)
class Panel:
    """Where a drawing stands and how it is scaled, in px at 100 dpi.

    low_mm, high_mm : (3,) the box.
    stretch : how much wider than high a mm is drawn.
    band : how much the +-2 sd band is widened, 0 without one.
    words : above it.
    """

    low_mm: Array
    high_mm: Array
    stretch: int
    px_per_mm: float
    centre_px: Array
    band: int
    bodies: bool
    words: str


@dataclass(frozen=True)
class Layout:
    """Size and panels of the film.

    size_px : (width, height) at 100 dpi; multiples of 20, so that they are even, as videos need, at
        other resolutions too.
    """

    size_px: tuple[int, int]
    panels: tuple[Panel, ...]


def film_layout(path: FilmPath) -> Layout:
    """Return a panel in true proportions and, for a slender path, one stretched sideways."""
    reach = np.zeros_like(path.points_mm)
    reach[path.bodies] = np.sqrt(np.diagonal(path.quadrics_mm2, axis1=1, axis2=2))
    low, high = (path.points_mm - reach).min(0), (path.points_mm + reach).max(0)
    margin = 0.02 * float((high - low).max()) + 1e-3
    low, high = low - margin, high + margin
    wide, tall = float(np.hypot(*(high - low)[:2])), float((high - low)[2])
    if tall < _SLENDER * wide:
        width = int(np.clip(_HEIGHT_PX * wide / tall, _NARROW_PX, _WIDE_PX)) // 20 * 20
        panel = _panel(path, low, high, 0.0, width, 1, "", bodies=True)
        return Layout((width, _HEIGHT_PX), (panel,))
    lowest, highest = path.points_mm.min(0), path.points_mm.max(0)
    margins = np.maximum(0.06 * (highest - lowest), 1e-3)
    lowest, highest = lowest - margins, highest + margins
    thin = float(np.hypot(*(highest - lowest)[:2]))
    factor = max(f for f in _FACTORS if f * thin < _STRETCHED * tall or f == 1)
    words = f"horizontally {factor} times wider"
    panels = (
        _panel(path, low, high, 0.0, _LEFT_PX, 1, "true proportions", bodies=True),
        _panel(path, lowest, highest, _LEFT_PX, _RIGHT_PX, factor, words, bodies=False),
    )
    return Layout((_LEFT_PX + _RIGHT_PX, _HEIGHT_PX), panels)


def _panel(
    path: FilmPath, low: Array, high: Array, left_px: float, width_px: float, stretch: int,
    words: str, *, bodies: bool,
) -> Panel:  # fmt: skip
    height_px = _HEIGHT_PX - _ABOVE_PX - _BELOW_PX
    size, tilt = high - low, np.deg2rad(_elevation_deg(stretch))
    wide = stretch * float(np.hypot(*size[:2]))
    tall = float(size[2] * np.cos(tilt) + wide * np.sin(tilt))
    scale = min((width_px - 2 * _SIDE_PX) / wide, height_px / tall)
    centre = np.array([left_px + width_px / 2 + 12, _ABOVE_PX + height_px / 2])
    sd = path.sd_mm[np.isfinite(path.sd_mm).all(1)]
    half = 2 * float(np.median(np.sqrt((sd**2).mean(1)))) * scale * stretch if len(sd) else 0.0
    band = next((f for f in _FACTORS if f * half >= _LEAST_BAND_PX), _FACTORS[-1]) if half else 0
    band = 0 if words and bodies else band
    return Panel(low, high, stretch, scale, centre, band, bodies, words)


def _elevation_deg(stretch: int) -> float:
    """Return how far the view looks down: less where depth is widened."""
    return _ELEVATION_DEG if stretch == 1 else _ELEVATION_STRETCHED_DEG


def view_matrix(angle_deg: float, elevation_deg: float) -> Array:
    """Return rows right, up and away (3, 3) on the screen, in the film's axes right, forward, up.

    180 degrees further on the horizontal coordinates are mirrored.
    """
    turn, tilt = np.deg2rad(angle_deg), np.deg2rad(elevation_deg)
    cos, sin, down, level = np.cos(turn), np.sin(turn), np.sin(tilt), np.cos(tilt)
    away = np.array([-sin, cos, 0.0])
    return np.array([
        [cos, sin, 0.0],
        [*(down * away[:2]), level],
        [*(level * away[:2]), -down],
    ])  # fmt: skip


def screen_of(panel: Panel, angle_deg: float) -> tuple[Array, Array]:
    """Return (3, 3) px per mm: u right, v down, away; and (2,) px of the axes' origin."""
    view = view_matrix(angle_deg, _elevation_deg(panel.stretch))
    view = view * [panel.stretch, panel.stretch, 1]
    matrix = panel.px_per_mm * view * np.array([[1.0], [-1.0], [1.0]])
    return matrix, panel.centre_px - matrix[:2] @ ((panel.low_mm + panel.high_mm) / 2)


def draw_path(path: FilmPath, layout: Layout, angle_deg: float) -> Picture:
    """Return the picture (height, width, 3), RGB."""
    width, height = layout.size_px
    page = _Page(layout.size_px)
    for panel in layout.panels:
        matrix, offset = screen_of(panel, angle_deg)
        _draw_box(page, path.names, panel, matrix, offset)
        _draw_tracks(page, path, panel, matrix, offset)
        lines = [line for line in (panel.words, _band_words(panel)) if line]
        for i, line in enumerate(lines):
            page.write(line, (panel.centre_px[0], 44 + 18 * i), "ma")
    page.write(path.title, (16, 12), "la", _INK, size=17)
    page.write("; ".join(path.notes), (16, height - 14), "ls")
    page.write(f"{angle_deg % 360:3.0f}°", (width - 16, height - 14), "rs")
    return page.picture()


class _Page:
    """A figure without axes, in px at 100 dpi, v down. Pillow writes text ten times as fast."""

    def __init__(self, size_px: tuple[int, int]) -> None:
        from matplotlib.figure import Figure
        from matplotlib.transforms import Affine2D

        width, height = size_px
        self.figure = Figure(figsize=(width / 100, height / 100), dpi=DPI)
        self.px = Affine2D().scale(DPI / 100, -DPI / 100).translate(0, height * DPI / 100)
        self._texts: list[tuple[str, Any, str, str, int]] = []

    def lines(self, lines: Sequence[Array], colours: Any) -> None:
        from matplotlib.collections import LineCollection

        made = LineCollection(lines, colors=colours, linewidths=0.8, transform=self.px)
        self.figure.add_artist(made)

    def polygons(self, polygons: Sequence[Array], **how: Any) -> None:
        from matplotlib.collections import PolyCollection

        self.figure.add_artist(PolyCollection(polygons, transform=self.px, **how))

    def write(
        self, words: str, place: Any, anchor: str, colour: str = _SOFT, size: int = 13
    ) -> None:
        """Write a text at its place; anchor : that of Pillow."""
        self._texts.append((words, place, anchor, colour, size))

    def picture(self) -> Picture:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from PIL import Image, ImageDraw

        canvas = FigureCanvasAgg(self.figure)
        canvas.draw()
        image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
        pen = ImageDraw.Draw(image)
        for words, (u, v), anchor, colour, size in self._texts:
            place = u * DPI / 100, v * DPI / 100
            pen.text(place, words, colour, font(size * DPI / 100), anchor)
        return np.array(image)


@cache
def font(size_px: float) -> Any:
    """Return Matplotlib's own typeface, for Pillow."""
    from matplotlib import get_data_path
    from PIL import ImageFont

    return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", size_px)


def _band_words(panel: Panel) -> str:
    if not panel.band:
        return ""
    return "band: ±2 sd" + (f", drawn {panel.band} times wider" if panel.band > 1 else "")


def _draw_box(
    page: _Page, names: Sequence[str], panel: Panel, matrix: Array, offset: Array
) -> None:
    """Draw the base and the upright edges but the nearest; ticks on two edges below, one up."""
    pick = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    ends = np.array([panel.low_mm, panel.high_mm])
    corners = np.array([[[ends[a, 0], ends[b, 1], h] for a, b in pick] for h in ends[:, 2]])
    uv = corners @ matrix[:2].T + offset
    front = int(np.argmin(corners[0] @ matrix[2]))
    after, before = (front + 1) % 4, (front - 1) % 4
    behind = [after, (front + 2) % 4, before]
    base = uv[0, [*range(4), 0]]
    page.lines([base, uv[1, behind], *(uv[:, i] for i in behind)], _EDGE)
    for other in (after, before):
        axis = 0 if pick[front, 0] != pick[other, 0] else 1
        outwards = np.array([0.25 * np.sign(uv[0, other, 0] - uv[0, front, 0]), 1.0])
        _draw_ticks(page, corners[0, front], axis, panel, matrix, offset, outwards, names[axis])
    side = corners[0, int(np.argmin(uv[0, :, 0]))]
    _draw_ticks(page, side, 2, panel, matrix, offset, np.array([-1.0, 0.0]), names[2])


def _draw_ticks(
    page: _Page, corner: Array, axis: int, panel: Panel, matrix: Array, offset: Array,
    outwards: Array, name: str,
) -> None:  # fmt: skip
    """Draw ticks along an edge of the box through ``corner``, and the axis' name with its unit."""
    from matplotlib.ticker import MaxNLocator

    low, high = panel.low_mm[axis], panel.high_mm[axis]
    length_px = float(np.hypot(*matrix[:2, axis])) * (high - low)
    if length_px < _TICK_PX:
        return
    values = MaxNLocator(max(1, length_px // _TICK_PX), steps=[1, 2, 5, 10]).tick_values(low, high)
    values = values[(values >= low) & (values <= high)]
    points = np.repeat(corner[None], len(values) + 1, 0)
    points[:, axis] = [*values, high if axis == 2 else (low + high) / 2]
    uv = points @ matrix[:2].T + offset
    page.lines([np.array([at, at + 5 * outwards]) for at in uv[:-1]], _SOFT)
    for value, at in zip(values, uv + 9 * outwards):
        page.write(f"{value + 0.0:.10g}", at, "rm" if axis == 2 else "ma")
    where = uv[-1] + ((-16, -8) if axis == 2 else 32 * outwards)
    page.write(f"{name} / mm", where, "ms" if axis == 2 else "ma", _INK, size=14)


def _draw_tracks(page: _Page, path: FilmPath, panel: Panel, matrix: Array, offset: Array) -> None:
    """Draw bubbles, bands, paths and their ends, from back to front."""
    from matplotlib.collections import CircleCollection

    uv, away = path.points_mm @ matrix[:2].T + offset, path.points_mm @ matrix[2]
    if panel.bodies and len(path.bodies):
        order = np.argsort(-away[path.bodies])
        rows, shapes = path.bodies[order], matrix[:2] @ path.quadrics_mm2[order] @ matrix[:2].T
        discs, faces, edges = _shaded(uv[rows], shapes, path.particle[rows])
        page.polygons(list(discs), facecolors=faces, edgecolors=edges, linewidths=0.8)
    pieces = np.split(np.arange(len(uv)), np.flatnonzero(path.new)[1:])
    pieces.sort(key=lambda piece: -float(away[piece].mean()))
    colours = [colour_of(int(path.particle[piece[0]])) for piece in pieces]
    if panel.band:
        bands = [_band(uv[p], path.sd_mm[p], panel.band, matrix[:2]) for p in pieces]
        page.polygons(bands, facecolors=colours, alpha=0.35, linewidths=0)
    page.lines([uv[piece] for piece in pieces], colours)
    last = np.append(np.diff(path.particle) != 0, True)
    ends = np.array([piece[-1] for piece in pieces if last[piece[-1]]])
    colours = [colour_of(int(k)) for k in path.particle[ends]]
    page.figure.add_artist(CircleCollection(
        [19.0], offsets=uv[ends], offset_transform=page.px, facecolors=colours, linewidths=0
    ))  # fmt: skip
    if len(ends) <= _MOST_NAMES:
        for end, colour in zip(ends, colours):
            page.write(f"{path.particle[end]}", uv[end] + (8, 0), "lm", colour)


def _shaded(centres: Array, shapes: Array, particles: Ints) -> tuple[Array, Array, Array]:
    """Return three discs per bubble as polygons (3 B, 48, 2), and their face and edge colours."""
    from matplotlib.colors import to_rgb

    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    squares, axes = np.linalg.eigh(shapes)
    half = np.sqrt(np.maximum(squares, 0.0))[:, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    ring = half @ np.swapaxes(axes, 1, 2)
    light = 0.35 * ring.min(1)[:, None]
    discs = [centres[:, None] + size * ring + (1 - size) * light for size, _ in _SHADES]
    colour = np.array([to_rgb(colour_of(int(k))) for k in particles])
    faces = [
        np.c_[white + (1 - white) * colour, np.full(len(colour), 0.75)] for _, white in _SHADES
    ]
    edges = [np.c_[colour, np.full(len(colour), float(k == 0))] for k in range(len(_SHADES))]
    mixed = (np.stack(parts, 1) for parts in (discs, faces, edges))
    polygons, face, edge = (part.reshape(-1, *part.shape[2:]) for part in mixed)
    return polygons, face, edge


def _band(uv: Array, sd_mm: Array, times: int, matrix: Array) -> Array:
    """Return (2 N, 2) polygon round the line (N, 2) of +-2 sd across it, ``times`` as wide."""
    good = np.isfinite(sd_mm).all(1)
    uv, sd_mm = uv[good], sd_mm[good]
    if len(uv) < 2:
        return uv[:0]
    along = np.gradient(uv, axis=0)
    across = np.stack([-along[:, 1], along[:, 0]], -1)
    across /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    half = 2 * times * np.sqrt((((across @ matrix) * sd_mm) ** 2).sum(1))[:, None]
    return np.concatenate([uv + half * across, (uv - half * across)[::-1]])
