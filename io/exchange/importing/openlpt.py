"""OpenLPT's camera text files (`cam1.txt`, ...) as cameras of this library, exactly.

OpenLPT's images are often left-handed with respect to its world (fy < 0 with a proper R): then the
world is mirrored, see `telerig.io.exchange.importing.pinhole`.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.exchange.importing.pinhole import ImportedCameras, Pinhole, cameras_from_pinholes
from telerig.io.files.text import LARGEST_NUMBER, read_text

_LINES = ("calibration error", "pose error", "image size", "camera matrix", "camera matrix",
          "camera matrix", "distortion coefficients", "rotation vector", "rotation matrix",
          "rotation matrix", "rotation matrix", "inverse rotation", "inverse rotation",
          "inverse rotation", "translation vector")  # fmt: skip
_WIDTHS = {"image size": 2, "camera matrix": 3, "rotation matrix": 3, "translation vector": 3}


def read_openlpt_cameras(
    paths: Sequence[str | PathLike[str]], names: Sequence[str] | None = None
) -> ImportedCameras:
    """Read the pinhole cameras of OpenLPT text files; names default to the files' names.

    Raises InputError for files that cannot be read or contain another camera model, and as
    `cameras_from_pinholes` does.
    """
    files = [_read(Path(p)) for p in paths]
    if not files:
        raise InputError("no camera files", todo="name at least one, such as cam1.txt")
    labels = [Path(p).stem for p in paths] if names is None else list(names)
    return cameras_from_pinholes(files, labels)


def _read(path: Path) -> Pinhole:
    numbered = [(i, line.strip()) for i, line in enumerate(read_text(path).splitlines(), 1)]
    lines = [(i, line) for i, line in numbered if line and not line.startswith("#")]
    if not lines or lines[0][1] != "PINHOLE":
        kind = lines[0][1] if lines else "nothing"
        raise InputError(
            f"holds {kind[:40]!r} where 'PINHOLE' is expected",
            where=str(path),
            todo="only OpenLPT's pinhole cameras can be imported; calibrate others with telerig",
        )
    if len(lines) <= len(_LINES):
        raise InputError(
            f"ends after {len(lines)} lines of values; the next would be the "
            f"{_LINES[len(lines) - 1]}",
            where=str(path),
            todo="export it again with OpenLPT 2 (with the image's size)",
        )
    found: dict[str, list[Array]] = {}
    for what, (row, line) in zip(_LINES, lines[1:]):
        if what in _WIDTHS or what == "distortion coefficients":
            found.setdefault(what, []).append(_numbers(line, what, f"{path}:{row}"))
    rows, columns = (int(v) for v in found["image size"][0])
    distortion = found["distortion coefficients"][0]
    if len(distortion) > 5 and np.any(distortion[5:]):
        raise InputError(
            "distortion coefficients beyond k1 k2 p1 p2 k3 have no exact counterpart here",
            where=str(path),
            todo="calibrate with these five, or with telerig",
        )
    return Pinhole(
        str(path),
        (columns, rows),
        np.array(found["camera matrix"]),
        np.array(found["rotation matrix"]),
        found["translation vector"][0],
        distortion,
    )


def _numbers(line: str, what: str, where: str) -> Array:
    try:
        values = np.array([float(word) for word in line.split(",")])
    except ValueError:
        values = np.array([np.nan])
    if not (np.abs(values) <= LARGEST_NUMBER).all() or len(values) != _WIDTHS.get(
        what, len(values)
    ):
        raise InputError(
            f"{line[:60]!r} is not the {what}: {_WIDTHS.get(what, 'some')} numbers with commas "
            "between them",
            where=where,
            todo="export the camera again",
        )
    return values
