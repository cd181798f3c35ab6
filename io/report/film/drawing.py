"""One picture of a path seen from an angle, by an orthographic projection of our own."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.film.geometry import FilmPath
from telerig.io.report.run.tracking.scene import track_colour

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

HEIGHT_PX = 960
_NARROW_PX, _WIDE_PX = 560, 960
_MARGIN_PX = (112, 92)
_SIDE_PX = 74
_ELEVATION_DEG, _ELEVATION_WIDENED_DEG = 14.0, 4.0
_SLENDER = 3.5
_LEFT_PX, _RIGHT_PX, _WIDENED = 300, 500, 0.6
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_LEAST_BAND_PX = 2.5
_BITS = 4
_INK, _SOFT, _EDGE = (28, 31, 36), (91, 98, 109), (196, 201, 209)
_MOST_NAMES = 12
_TICK_PX = 46


@dataclass(frozen=True)
class Panel:
    """Where a drawing stands and how it is scaled.

    low_mm, high_mm : (3,) the box. stretch : how much wider than high a mm is drawn.
    px_per_mm : of the vertical. centre_px : (2,), where the box's middle is. band : how much the
    +-2 sd band is widened.
    """

    low_mm: Array
    high_mm: Array
    stretch: int
    px_per_mm: float
    centre_px: Array
    band: int
    bodies: bool
    words: str

    @property
    def elevation_deg(self) -> float:
        """How far the view looks down: less where depth is widened."""
        return _ELEVATION_DEG if self.stretch == 1 else _ELEVATION_WIDENED_DEG


@dataclass(frozen=True)
class Layout:
    """size_px : (width, height), even numbers, as videos need them."""

    size_px: tuple[int, int]
    panels: tuple[Panel, ...]


def view_matrix(angle_deg: float, elevation_deg: float) -> Array:
    """(3, 3) rows: right, up and away on the screen, in the film's axes right, forward, up.

    The viewer walks round the vertical and looks down a little; 180 degrees further on every
    point of the axis' height has its horizontal coordinate mirrored.
    """
    turn, tilt = np.deg2rad(angle_deg), np.deg2rad(elevation_deg)
    cos, sin, down, level = np.cos(turn), np.sin(turn), np.sin(tilt), np.cos(tilt)
    away = np.array([-sin, cos, 0.0])
    return np.array([
        [cos, sin, 0.0],
        [*(down * away[:2]), level],
        [*(level * away[:2]), -down],
    ])  # fmt: skip


def film_layout(path: FilmPath) -> Layout:
    """A panel in true proportions and, for a slender path, one that is stretched sideways."""
    reach = np.zeros_like(path.points_mm)
    reach[path.bodies] = np.sqrt(np.diagonal(path.quadrics_mm2, axis1=1, axis2=2))
    low, high = (path.points_mm - reach).min(0), (path.points_mm + reach).max(0)
    room = 0.02 * float((high - low).max()) + 1e-3
    low, high = low - room, high + room
    wide, tall = float(np.hypot(*(high - low)[:2])), float((high - low)[2])
    if tall < _SLENDER * wide:
        width = int(np.clip(HEIGHT_PX * wide / tall, _NARROW_PX, _WIDE_PX)) // 2 * 2
        return Layout((width, HEIGHT_PX), (_panel(path, low, high, 0.0, width, 1, "", True),))
    slim = _padded(path.points_mm.min(0), path.points_mm.max(0))
    thin = float(np.hypot(*(slim[1] - slim[0])[:2]))
    factor = max(f for f in _FACTORS if f * thin < _WIDENED * tall or f == 1)
    words = f"horizontally {factor} times wider"
    panels = (
        _panel(path, low, high, 0.0, _LEFT_PX, 1, "true proportions", True),
        _panel(path, *slim, float(_LEFT_PX), _RIGHT_PX, factor, words, False),
    )
    return Layout((_LEFT_PX + _RIGHT_PX, HEIGHT_PX), panels)


def _padded(low: Array, high: Array) -> tuple[Array, Array]:
    room = np.maximum(0.06 * (high - low), 1e-3)
    return low - room, high + room


def _panel(
    path: FilmPath, low: Array, high: Array, left_px: float, width_px: float, stretch: int,
    words: str, bodies: bool,
) -> Panel:  # fmt: skip
    above, below = _MARGIN_PX
    size = high - low
    wide = stretch * float(np.hypot(*size[:2]))
    tilt = np.deg2rad(_ELEVATION_DEG if stretch == 1 else _ELEVATION_WIDENED_DEG)
    tall = float(size[2] * np.cos(tilt) + wide * np.sin(tilt))
    scale = min((width_px - 2 * _SIDE_PX) / wide, (HEIGHT_PX - above - below) / tall)
    centre = np.array([left_px + width_px / 2 + 12, above + (HEIGHT_PX - above - below) / 2])
    sd = path.sd_mm[np.isfinite(path.sd_mm).all(1)]
    half = 2 * float(np.median(np.sqrt((sd**2).mean(1)))) * scale * stretch if len(sd) else 0.0
    band = next((f for f in _FACTORS if f * half >= _LEAST_BAND_PX), _FACTORS[-1]) if half else 0
    band = 0 if words and bodies else band
    return Panel(low, high, stretch, scale, centre, band, bodies, words)


def draw_path(path: FilmPath, layout: Layout, angle_deg: float) -> Picture:
    """(height, width, 3) RGB."""
    width, height = layout.size_px
    picture = np.full((height, width, 3), 255, np.uint8)
    texts: list[_Text] = [(path.title, (16.0, 12.0), 17, _INK, "la")]
    for panel in layout.panels:
        matrix, offset = _screen(panel, angle_deg)
        texts += _draw_box(picture, path, panel, matrix, offset, angle_deg)
        texts += _draw_tracks(picture, path, panel, matrix, offset)
        x = float(panel.centre_px[0])
        lines = [line for line in (panel.words, _band_words(panel)) if line]
        texts += [(line, (x, 44.0 + 18 * i), 13, _SOFT, "ma") for i, line in enumerate(lines)]
    texts += [("; ".join(path.notes), (16.0, height - 14.0), 13, _SOFT, "ls")]
    texts += [(f"{angle_deg % 360:3.0f}°", (width - 16.0, height - 14.0), 13, _SOFT, "rs")]
    return _written(picture, texts)


def project_px(panel: Panel, points_mm: Array, angle_deg: float) -> Array:
    """(N, 2) pixels of the picture for points in the film's axes."""
    matrix, offset = _screen(panel, angle_deg)
    return np.asarray(points_mm @ matrix[:2].T + offset)


_Text = tuple[str, tuple[float, float], int, tuple[int, int, int], str]


def _band_words(panel: Panel) -> str:
    if not panel.band:
        return ""
    return "band: ±2 sd" + (f", drawn {panel.band} times wider" if panel.band > 1 else "")


def _screen(panel: Panel, angle_deg: float) -> tuple[Array, Array]:
    """(3, 3) px per mm: u right, v down, away; and (2,) px of the axes' origin."""
    view = view_matrix(angle_deg, panel.elevation_deg) * [panel.stretch, panel.stretch, 1]
    matrix = panel.px_per_mm * view * np.array([[1.0], [-1.0], [1.0]])
    return matrix, panel.centre_px - matrix[:2] @ ((panel.low_mm + panel.high_mm) / 2)


def _draw_box(
    picture: Picture, path: FilmPath, panel: Panel, matrix: Array, offset: Array, angle: float
) -> list[_Text]:
    """The base, the upright edges, ticks; what stands at them."""
    pick = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    ends = np.array([panel.low_mm, panel.high_mm])
    corners = np.array([[[ends[a, 0], ends[b, 1], h] for a, b in pick] for h in ends[:, 2]])
    uv, away = corners @ matrix[:2].T + offset, corners[0] @ matrix[2]
    front = int(np.argmin(away))
    for i in range(4):
        _line(picture, uv[0, [i, (i + 1) % 4]], _EDGE)
        if i != front:
            _line(picture, uv[:, i], _EDGE)
        if front not in (i, (i + 1) % 4):
            _line(picture, uv[1, [i, (i + 1) % 4]], _EDGE)
    texts: list[_Text] = []
    for other in ((front + 1) % 4, (front - 1) % 4):
        axis = 0 if pick[front, 0] != pick[other, 0] else 1
        outwards = np.array([0.25 * np.sign(uv[0, other, 0] - uv[0, front, 0]), 1.0])
        texts += _ticks(picture, corners[0, front], axis, panel, matrix, offset, outwards,
                        path.names[axis])  # fmt: skip
    side = int(np.argmin(uv[0, :, 0]))
    texts += _ticks(picture, corners[0, side], 2, panel, matrix, offset, np.array([-1.0, 0.0]),
                    path.names[2])  # fmt: skip
    return texts


def _ticks(
    picture: Picture, corner: Array, axis: int, panel: Panel, matrix: Array, offset: Array,
    outwards: Array, name: str,
) -> list[_Text]:  # fmt: skip
    """Ticks along an edge of the box through ``corner``, and the axis' name with its unit."""
    per_mm = float(np.hypot(*matrix[:2, axis]))
    low, high = panel.low_mm[axis], panel.high_mm[axis]
    if per_mm * (high - low) < _TICK_PX:
        return []
    step = _nice(_TICK_PX / per_mm)
    values = np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step
    points = np.repeat(corner[None], len(values) + 1, 0)
    points[:, axis] = [*values, (low + high) / 2]
    uv = points @ matrix[:2].T + offset
    upright = axis == 2
    decimals = max(0, int(np.ceil(-np.log10(step) - 1e-9)))
    texts: list[_Text] = []
    for value, at in zip(values, uv):
        _line(picture, np.array([at, at + 5 * outwards]), _SOFT)
        place = at + 9 * outwards
        words = f"{value + 0.0:.{decimals}f}"
        texts.append((words, (place[0], place[1]), 13, _SOFT, "rm" if upright else "ma"))
    end = uv[-1] + 32 * outwards
    if upright:
        top = corner.copy()
        top[2] = high
        end = top @ matrix[:2].T + offset + (-16.0, -8.0)
    texts.append((f"{name} / mm", (end[0], end[1]), 14, _INK, "ms" if upright else "ma"))
    return texts


def _nice(least: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is not below ``least``."""
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(k * power for k in (1, 2, 5, 10) if k * power >= least * (1 - 1e-9)))


def _draw_tracks(
    picture: Picture, path: FilmPath, panel: Panel, matrix: Array, offset: Array
) -> list[_Text]:
    import cv2

    uv, away = path.points_mm @ matrix[:2].T + offset, path.points_mm @ matrix[2]
    if panel.bodies:
        _draw_bodies(picture, path, uv, away, matrix)
    starts = np.flatnonzero(path.new)
    pieces = np.split(np.arange(len(uv)), starts[1:])
    veil = picture.copy()
    for piece in pieces if panel.band else ():
        _fill_band(veil, uv[piece], path.sd_mm[piece], panel.band, matrix,
                   _rgb(int(path.particle[piece[0]])))  # fmt: skip
    cv2.addWeighted(veil, 0.35, picture, 0.65, 0, picture)
    texts: list[_Text] = []
    ends = set(np.flatnonzero(np.append(np.diff(path.particle) != 0, True)).tolist())
    names = len(set(path.particle.tolist())) <= _MOST_NAMES
    for piece in sorted(pieces, key=lambda p: -float(away[p].mean())):
        colour = _rgb(int(path.particle[piece[0]]))
        cv2.polylines(picture, [_fixed(uv[piece])], False, colour, 1, cv2.LINE_AA, _BITS)
        last = uv[piece[-1]]
        if piece[-1] not in ends:
            continue
        cv2.circle(
            picture, tuple(_fixed(last)[0].tolist()), 3 << _BITS, colour, -1, cv2.LINE_AA, _BITS
        )
        if names:
            texts.append((f"{path.particle[piece[0]]}", (last[0] + 8, last[1]), 13, colour, "lm"))
    return texts


def _draw_bodies(picture: Picture, path: FilmPath, uv: Array, away: Array, matrix: Array) -> None:
    """Ellipsoids, the farthest first: their outlines, filled with a veil of their colour."""
    import cv2

    shapes = matrix[:2] @ path.quadrics_mm2 @ matrix[:2].T
    for k in np.argsort(-away[path.bodies]):
        row = path.bodies[k]
        squares, axes = np.linalg.eigh(shapes[k])
        half = np.sqrt(np.maximum(squares, 0.0))
        turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
        ring = uv[row] + np.stack([half[0] * np.cos(turn), half[1] * np.sin(turn)], -1) @ axes.T
        _shaded(picture, ring, _rgb(int(path.particle[row])))
        cv2.polylines(picture, [_fixed(ring)], True, _rgb(int(path.particle[row])), 1,
                      cv2.LINE_AA, _BITS)  # fmt: skip


def _shaded(picture: Picture, ring: Array, colour: tuple[int, int, int]) -> None:
    """Lighter towards the upper left, like a ball; mixed with what is behind."""
    import cv2

    low = np.maximum(np.floor(ring.min(0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(ring.max(0)).astype(int) + 2, picture.shape[1::-1])
    if np.any(high <= low):
        return
    part = picture[low[1] : high[1], low[0] : high[0]]
    veil = part.copy()
    middle = ring.mean(0)
    for size, white in ((1.0, 0.62), (0.72, 0.74), (0.42, 0.86)):
        inner = middle + size * (ring - middle) + (1 - size) * 0.35 * (ring.min(0) - middle)
        shade = [round(white * 255 + (1 - white) * c) for c in colour]
        cv2.fillPoly(veil, [_fixed(inner - low)], shade, cv2.LINE_AA, _BITS)
    cv2.addWeighted(veil, 0.75, part, 0.25, 0, part)


def _fill_band(
    picture: Picture, uv: Array, sd_mm: Array, band: int, matrix: Array, colour: tuple[int, ...]
) -> None:
    """The strip of +-2 sd across the line, times ``band``."""
    import cv2

    good = np.isfinite(sd_mm).all(1)
    uv, sd_mm = uv[good], sd_mm[good]
    if len(uv) < 2:
        return
    along = np.gradient(uv, axis=0)
    length = np.hypot(*along.T)[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], -1) / np.maximum(length, 1e-9)
    half = 2 * band * np.sqrt((((across @ matrix[:2]) * sd_mm) ** 2).sum(1))
    sides = uv + half[:, None] * across, uv - half[:, None] * across
    for i in range(len(uv) - 1):
        quad = np.array([sides[0][i], sides[0][i + 1], sides[1][i + 1], sides[1][i]])
        cv2.fillConvexPoly(picture, _fixed(quad), colour, cv2.LINE_8, _BITS)


def _line(picture: Picture, uv: Array, colour: tuple[int, int, int]) -> None:
    import cv2

    cv2.polylines(picture, [_fixed(uv)], False, colour, 1, cv2.LINE_AA, _BITS)


def _fixed(uv: Array) -> NDArray[np.int32]:
    return np.round(np.atleast_2d(uv) * (1 << _BITS)).astype(np.int32)


def _rgb(particle: int) -> tuple[int, int, int]:
    colour = track_colour(particle).lstrip("#")
    return int(colour[:2], 16), int(colour[2:4], 16), int(colour[4:], 16)


@cache
def font(size: int) -> Any:
    from matplotlib import get_data_path
    from PIL import ImageFont

    return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)


def _written(picture: Picture, texts: list[_Text]) -> Picture:
    from PIL import Image, ImageDraw

    page = Image.fromarray(picture)
    pen = ImageDraw.Draw(page)
    for words, place, size, colour, anchor in texts:
        pen.text(place, words, fill=colour, font=font(size), anchor=anchor)
    return np.array(page)
