"""The overlays of all views and cameras, within the bytes that a page may carry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from telerig.errors import InputError
from telerig.io.report.page.figures import data_uri
from telerig.io.report.page.page import link_to

BUDGET_BYTES = 1_500_000
"""Of JPEG: with the page's other parts a report stays below 5 MB."""

SMALL_WIDTH_PX = 420
_SMALL_QUALITY = 70
_PNG = b"\x89PNG"


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


def picture_sheet(
    rows: Sequence[str],
    columns: Sequence[str],
    files: Mapping[tuple[str, str], Path],
    *,
    small_width_px: int = SMALL_WIDTH_PX,
    budget_bytes: int | None = None,
    page_folder: Path | None = None,
) -> ContactSheet:
    """Return pictures as they are if they fit; else smaller; else the last rows linked only.

    files : JPEG or PNG by (column, row), <results>/<kind>/<folder>/<name>. page_folder : where the
    page will lie; None for <results>. Raises InputError for a picture that cannot be read.
    """
    pictures = {key: read_picture(file) for key, file in files.items()}
    left = BUDGET_BYTES if budget_bytes is None else budget_bytes
    shrunk = sum(map(len, pictures.values())) > left
    if shrunk:
        pictures = {key: _smaller(p, files[key], small_width_px) for key, p in pictures.items()}
    views = []
    for row in rows:
        cells = []
        for column in columns:
            picture = pictures.get((column, row), b"")
            left -= len(picture)
            kind = "image/png" if picture.startswith(_PNG) else "image/jpeg"
            source = data_uri(kind, picture) if picture and left >= 0 else ""
            link = ""
            if picture:
                file = files[column, row]
                link = link_to(file, page_folder or file.parents[2])
            cells.append(Cell(column, source, link))
        views.append((row, tuple(cells)))
    return ContactSheet(tuple(views), shrunk)


def _smaller(picture: bytes, file: Path, width_px: int) -> bytes:
    from PIL import Image, UnidentifiedImageError

    small = BytesIO()
    try:
        with Image.open(BytesIO(picture)) as image:
            image.thumbnail((width_px, image.height))
            image.save(small, image.format, quality=_SMALL_QUALITY)
    except (UnidentifiedImageError, OSError) as error:
        raise InputError(
            "is no JPEG or PNG picture", where=str(file), todo="remove this file, or make it again"
        ) from error
    return min(small.getvalue(), picture, key=len)


def read_picture(file: Path) -> bytes:
    """Raises InputError for a file that cannot be read."""
    try:
        return file.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(file)) from error
