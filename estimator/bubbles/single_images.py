"""Bubbles of images that belong to no run: tables, outlines of clusters, overlays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.estimator.bubbles.detect import (
    COVERED_LIMIT_EVERYWHERE,
    Bubbles,
    find_bubbles,
    is_crowded,
    outline_points,
)
from telerig.estimator.bubbles.field import described_field
from telerig.estimator.bubbles.lighting import NOT_BACKLIT_WORDS
from telerig.estimator.bubbles.outline.ellipse_geometry import DETECTION_COLUMNS
from telerig.io.files.csv_table import write_table
from telerig.io.images.read import Image, read_image
from telerig.short_text import counted

CLUSTER_COLUMNS = ("image", "cluster", "u_px", "v_px")
_MOST_NAMED = 12
"""More clusters are only drawn: their words would hide the bubbles."""
_OUTLINE_POINTS = 64
_BUBBLE, _CLUSTER = (90, 220, 90), (250, 160, 50)


@dataclass(frozen=True)
class Found:
    """Hold what was found in one image.

    detections : rows with the columns "image" and DETECTION_COLUMNS.
    clusters : corners of the outlines of clusters, with CLUSTER_COLUMNS.
    words : a summary in one line.
    """

    detections: pd.DataFrame
    clusters: pd.DataFrame
    words: str


def write_bubbles(
    files: Sequence[Path],
    folder: Path,
    *,
    min_diameter_px: float = 8.0,
    min_contrast: float = 0.3,
    region_px: Sequence[Sequence[float]] | None = None,
    mask: Path | None = None,
    progress: Callable[[int, int], None] = lambda _done, _all: None,
) -> list[str]:
    """Find the bubbles of images and write detections.csv, clusters.csv and overlays/NAME.jpg.

    files : grey images; their names without ending are the names in the tables.
    region_px : corners (u, v) of a polygon, and ``mask`` an image that is not 0 where bubbles are
        looked for. Without both, a dark surround is found in each image and left out.
    min_diameter_px, min_contrast : as for `detect_bubbles`.
    progress : is called with the number of images that are done, and of all.

    Returns a summary of each image in one line. Raises InputError for what is no grey image, for
    two images of one name, and for a region or mask that does not fit.
    """
    twice = [name for name, count in Counter(f.stem for f in files).items() if count > 1]
    if twice:
        raise InputError(
            f"two images are called {twice[0]}", where="IMAGE", todo="rename one of them"
        )
    words, found = [], []
    for index, file in enumerate(files):
        progress(index, len(files))
        image = read_image(file)
        shape = (image.shape[0], image.shape[1])
        field = described_field(shape, region_px, mask, f"--region, {file.name}")
        try:
            bubbles = find_bubbles(
                image, field=field, min_diameter_px=min_diameter_px, min_contrast=min_contrast
            )
        except InputError as error:
            where = str(file) if error.where == "image" else error.where
            raise InputError(error.what, where=where, todo=error.todo) from error
        _draw(image, bubbles, folder / "overlays" / f"{file.stem}.jpg")
        found.append(_found(file.stem, bubbles))
        words.append(found[-1].words)
    progress(len(files), len(files))
    for name in ("detections", "clusters"):
        table = pd.concat([getattr(one, name) for one in found], ignore_index=True)
        write_table(table, folder / f"{name}.csv")
    return words


def _found(name: str, bubbles: Bubbles) -> Found:
    single, clusters = bubbles.accepted.copy(), bubbles.clusters
    single.insert(0, "image", name)
    corners = [
        pd.DataFrame({"image": name, "cluster": number, "u_px": line[:, 0], "v_px": line[:, 1]})
        for number, line in enumerate(_closed(outline) for outline in clusters)
    ]
    table = pd.concat(corners) if corners else pd.DataFrame(columns=list(CLUSTER_COLUMNS))
    words = f"{name}: {_how_many(bubbles)}"
    if bubbles.reason and not len(single):
        words += f" ({bubbles.reason})"
    found = len(single) + len(clusters)
    if is_crowded(bubbles.covered, found, COVERED_LIMIT_EVERYWHERE):
        words += (
            f"; warning: bubbles cover {bubbles.covered:.0%} of the image, and beyond "
            f"{COVERED_LIMIT_EVERYWHERE:.0%} more than one in five is missed"
        )
    if bubbles.bright_spots:
        words += (
            f"; warning: {counted(bubbles.bright_spots, 'outline')} left out as {NOT_BACKLIT_WORDS}"
        )
    if bubbles.field is not None:
        words += f"; {bubbles.field.mean():.0%} of the image was searched"
    return Found(single[["image", *DETECTION_COLUMNS]], table, words)


def _closed(outline: Array) -> Array:
    """Corners of the outline, about 2 px apart, to 0.01 px."""
    known = outline[np.isfinite(outline).all(axis=1)]
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(known, axis=0), axis=1))]
    first = np.unique(np.floor(length / 2.0), return_index=True)[1]
    return np.round(known[first], 2)


def _how_many(bubbles: Bubbles) -> str:
    """Number of bubbles and of clusters; the ellipse of a region of several counts as none."""
    single = ~bubbles.accepted["flags"].astype(str).str.contains("merged")
    bubble = counted(int(single.sum()), "bubble")
    return f"{bubble}, {counted(len(bubbles.clusters), 'cluster')}"


def _draw(image: Image, bubbles: Bubbles, path: Path) -> None:
    import cv2

    from telerig.io.report.overlays import draw_bubble_overlay, write_picture

    outlines, words, colours = [], [], []
    for _, row in bubbles.accepted.iterrows():
        outlines.append(outline_points(row, _OUTLINE_POINTS))
        words.append("")
        colours.append(_BUBBLE)
    outlines += bubbles.clusters
    few = len(bubbles.clusters) <= _MOST_NAMED
    words += ["not resolved" if few else ""] * len(bubbles.clusters)
    colours += [_CLUSTER] * len(bubbles.clusters)
    places = bubbles.rejected[["u_px", "v_px", "radius_px"]].to_numpy(float).tolist()
    marks = [(u, v, r, str(why)) for (u, v, r), why in zip(places, bubbles.rejected["reason"])]
    if bubbles.field is not None:
        edges, _ = cv2.findContours(
            bubbles.field.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        outlines += [np.asarray(edge[:, 0], float) for edge in edges]
        words += ["the field"] * len(edges)
        colours += [(90, 160, 250)] * len(edges)
    found = f"{_how_many(bubbles)} not resolved"
    picture = draw_bubble_overlay(image, outlines, words, colours, rejected=marks, found=found)
    write_picture(picture, path)
