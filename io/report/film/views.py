"""The film of all cameras' images side by side, with outlines, numbers and tails drawn in."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.machine.parallel import ordered_map, quick_workers
from telerig.io.report.film.mp4 import write_film
from telerig.io.report.overlays import (
    INK,
    PAPER,
    draw_line,
    grey_levels,
    in_grey,
    shrunk,
    write_label,
)
from telerig.io.report.plot.axes import NO_TRACK, colour_of, rgb
from telerig.io.results.folders.tracking import TrackResults, read_track_results
from telerig.progress import Progress
from telerig.rig.outline import HARMONICS, points_on

Picture = NDArray[np.uint8]
Images = Callable[[str, int], NDArray[Any] | None]

MOST_FRAMES = 1_000
TAIL_FRAMES = 24
WIDTH_PX = 640
_RATE_HZ = 25.0
_STRIP_PX, _GAP_PX, _NAME_PX = 30, 4, 13
_SHAPE = [f"{part}{k}_px" for k in HARMONICS for part in "cs"]
_ELLIPSE = ["u_px", "v_px", "a_px", "b_px", "angle_rad"]
_LOOKED_AT = 5
_BARE_PX = 6.0
"""Radius of the circle round a bubble without semi-axes."""


@dataclass(frozen=True)
class Found:
    """A bubble in an image: its outline (N, 2) px, its track's number or None, its tail (M, 2)."""

    outline_px: Array
    particle: int | None
    tail_px: Array


@dataclass(frozen=True)
class ViewFrame:
    """One frame: time in s (None: not known) and, per camera, what was found."""

    frame: int
    t_s: float | None
    found: tuple[tuple[Found, ...], ...]


def write_views_film(
    results_folder: Path,
    file: Path,
    *,
    images: Images,
    image_sizes_px: Mapping[str, tuple[int, int]],
    frame_count: int,
    t_s: Array | None = None,
    stage: Progress | None = None,
) -> tuple[str, ...]:
    """Film the cameras' images with what was found in them; return remarks in words.

    images : gives the grey image (H, W) of a camera and frame, or None; it is called from several
    processes. t_s : (frame_count,). Of a run of more than 1,000 frames every k-th is shown. Raises
    InputError for a folder without detections.csv, and a file that cannot be written.
    """
    cameras = tuple(image_sizes_px)
    table = found_outlines(read_track_results(Path(results_folder)), cameras)
    step = -(-frame_count // MOST_FRAMES)
    frames = list(view_frames(table, cameras, range(0, frame_count, step), t_s))
    shades = {name: _shades(images, name, frame_count) for name in cameras}
    draw = partial(draw_views, images, dict(image_sizes_px), shades)
    pictures = ordered_map(draw, frames, quick_workers(len(frames)))
    write_film(pictures, len(frames), file, rate_hz=_RATE_HZ, what="both views", stage=stage)
    return (f"both views: every {step}. of {frame_count} frames is shown",) if step > 1 else ()


def found_outlines(results: TrackResults, cameras: Sequence[str]) -> pd.DataFrame:
    """Return the outlines of a tracked run, as `outlines_of` does.

    Raises InputError for a folder without detections.csv.
    """
    if not results.has("detections.csv"):
        raise InputError(
            "is not there, so nothing can be drawn into the images",
            where=str(results.folder / "detections.csv"),
            todo="track the run again (`telerig track`)",
        )
    return outlines_of(results.detections, cameras)


def outlines_of(table: pd.DataFrame, cameras: Sequence[str]) -> pd.DataFrame:
    """Return rows of detections.csv with a place, with the columns of the outlines.

    Blank shape coefficients are 0.
    """
    absent: dict[str, Any] = {name: 0.0 for name in _SHAPE if name not in table}
    absent |= {name: np.nan for name in _ELLIPSE if name not in table}
    absent |= {} if "flags" in table else {"flags": ""}
    table = table.assign(**absent)
    table[_SHAPE] = table[_SHAPE].fillna(0.0)
    seen = np.isfinite(table[["u_px", "v_px"]].to_numpy(float)).all(1)
    found: pd.DataFrame = table.loc[seen & table["camera"].isin(cameras).to_numpy(bool)]
    return found.reset_index(drop=True)


def outlines_px(table: pd.DataFrame, points: int = 72) -> Array:
    """Return outlines (N, points, 2) as docs/files.md defines them; circles without semi-axes."""
    ellipse = table[_ELLIPSE].to_numpy(float, copy=True)
    ellipse[~np.isfinite(ellipse).all(axis=1), 2:] = [_BARE_PX, _BARE_PX, 0.0]
    phi = np.linspace(0, 2 * np.pi, points, endpoint=False)
    return points_on(ellipse, table[_SHAPE].to_numpy(float), phi)


def view_frames(
    table: pd.DataFrame, cameras: Sequence[str], frames: Sequence[int], t_s: Array | None
) -> Iterator[ViewFrame]:
    """Return what to draw, frame by frame. A tail is the bubble's last `TAIL_FRAMES` places."""
    outlines = outlines_px(table)
    where = {
        key: np.asarray(rows) for key, rows in table.groupby(["frame", "camera"]).indices.items()
    }
    centres = table[["u_px", "v_px"]].to_numpy(float)
    number, names = table["frame"].to_numpy(np.int64), table["particle"].to_numpy()
    order = np.argsort(number, kind="stable")
    tracks = table.iloc[order].groupby(["camera", "particle"]).indices
    paths = {key: order[rows] for key, rows in tracks.items()}
    for frame in frames:
        views = []
        for camera in cameras:
            found = []
            for row in where.get((frame, camera), np.zeros(0, np.int64)):
                tail, tracked = np.zeros((0, 2)), not np.isnan(names[row])
                if tracked:
                    path = paths[camera, names[row]]
                    late = path[(number[path] <= frame) & (number[path] >= frame - TAIL_FRAMES)]
                    tail = centres[late]
                found.append(Found(outlines[row], int(names[row]) if tracked else None, tail))
            views.append(tuple(found))
        yield ViewFrame(frame, None if t_s is None else float(t_s[frame]), tuple(views))


def draw_views(
    images: Images,
    sizes_px: Mapping[str, tuple[int, int]],
    shades: Mapping[str, tuple[float, float]],
    frame: ViewFrame,
) -> Picture:
    """Return one picture of the film, (h, w, 3) RGB: the views side by side below a line of words.

    h and w are even, as video codecs need.
    """
    parts = []
    for camera, found in zip(sizes_px, frame.found):
        image = images(camera, frame.frame)
        parts.append(_view(image, sizes_px[camera], shades[camera], found, camera))
    height = max(part.shape[0] for part in parts)
    width = sum(part.shape[1] for part in parts) + _GAP_PX * (len(parts) - 1)
    page = np.full((height + height % 2, width + width % 2, 3), 255, np.uint8)
    left = 0
    for part in parts:
        page[: part.shape[0], left : left + part.shape[1]] = part
        left += part.shape[1] + _GAP_PX
    time = "" if frame.t_s is None else f", {frame.t_s:.3f} s"
    place = np.array([left - _GAP_PX - 90.0, _STRIP_PX / 2])
    write_label(page, f"frame {frame.frame}{time}", place, INK)
    return page


def _view(
    image: NDArray[Any] | None,
    size_px: tuple[int, int],
    shades: tuple[float, float],
    found: Sequence[Found],
    camera: str,
) -> Picture:
    """Return one camera's image with its bubbles, (h, w, 3), below a strip with its name."""
    import cv2
    from PIL import Image, ImageDraw  # OpenCV 4 writes ASCII alone

    factor = min(1.0, WIDTH_PX / size_px[0])
    width, height = round(size_px[0] * factor), round(size_px[1] * factor)
    picture = np.full((height, width, 3), 128, np.uint8)
    if image is None:
        write_label(picture, "no image", np.array([width / 2, height / 2]), PAPER)
    else:
        picture = in_grey(shrunk(image, factor), *shades)
    for bubble in found:
        colour = rgb(NO_TRACK if bubble.particle is None else colour_of(bubble.particle))
        tail, ring = ((p + 0.5) * factor - 0.5 for p in (bubble.tail_px, bubble.outline_px))
        draw_line(picture, tail, colour, closed=False)
        for u, v in np.rint(16 * tail).astype(int):
            cv2.circle(picture, (int(u), int(v)), 24, colour, -1, cv2.LINE_AA, 4)
        draw_line(picture, ring, colour, closed=True)
        if bubble.particle is not None:
            beside = np.array([ring[:, 0].max() + 10, ring[:, 1].mean()])
            write_label(picture, str(bubble.particle), beside, colour)
    strip = Image.new("RGB", (width, _STRIP_PX), PAPER)
    ImageDraw.Draw(strip).text((8, _STRIP_PX / 2), camera, INK, font(_NAME_PX), "lm")
    return np.concatenate([np.array(strip), picture])


def _shades(images: Images, camera: str, frame_count: int) -> tuple[float, float]:
    """Return black and white levels for the whole film, from a few of its images."""
    some = np.unique(np.linspace(0, frame_count - 1, _LOOKED_AT).astype(int)).tolist()
    return grey_levels([i for f in some if (i := images(camera, f)) is not None])


def font(size_px: float) -> Any:
    """Return Matplotlib's own typeface, for Pillow."""
    from matplotlib import get_data_path
    from PIL import ImageFont

    return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", size_px)
