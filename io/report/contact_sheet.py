"""The overlays of all views and cameras, within the bytes that a page may carry."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from telerig.errors import InputError
from telerig.io.report.calibration_results import CalibrationResults
from telerig.io.report.figures_common import data_uri

BUDGET_BYTES = 1_500_000
"""Of JPEG: with the page's other parts a report stays below 8 MB."""

SMALL_WIDTH_PX = 420
_SMALL_QUALITY = 70


@dataclass(frozen=True)
class Cell:
    """One picture: ``source`` a data URI, "" when it is only linked; ``link`` "" without a file."""

    camera: str
    source: str
    link: str


@dataclass(frozen=True)
class ContactSheet:
    """views : (view, its cells by camera); ``shrunk`` when the pictures were made smaller."""

    views: tuple[tuple[str, tuple[Cell, ...]], ...]
    shrunk: bool

    @property
    def linked(self) -> int:
        """How many pictures the page links to instead of carrying them."""
        return sum(bool(c.link and not c.source) for _, cells in self.views for c in cells)


def contact_sheet(results: CalibrationResults) -> ContactSheet:
    """As they are if they fit; else smaller; else those of the last views linked only.

    Raises InputError for a picture that cannot be read.
    """
    pictures = {key: _read(file) for key, file in results.overlays.items()}
    shrunk = sum(map(len, pictures.values())) > BUDGET_BYTES
    if shrunk:
        pictures = {key: _smaller(p, results.overlays[key]) for key, p in pictures.items()}
    left = BUDGET_BYTES
    views = []
    for view in results.views if pictures else ():
        cells = []
        for camera in results.camera_names:
            picture = pictures.get((camera, view), b"")
            left -= len(picture)
            source = data_uri("image/jpeg", picture) if picture and left >= 0 else ""
            link = f"overlays/{camera}/{view}.jpg" if picture else ""
            cells.append(Cell(camera, source, link))
        views.append((view, tuple(cells)))
    return ContactSheet(tuple(views), shrunk)


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(file)) from error


def _smaller(picture: bytes, file: Path) -> bytes:
    import cv2

    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(
            "is no JPEG picture", where=str(file), todo="calibrate again, or remove this file"
        )
    factor = SMALL_WIDTH_PX / image.shape[1]
    if factor < 1:
        image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    _, small = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _SMALL_QUALITY])
    return min(small.tobytes(), picture, key=len)
