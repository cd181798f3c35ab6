"""The tables of a calibration."""

from __future__ import annotations

from dataclasses import replace

from telerig.io.files.csv_table import Column
from telerig.io.tables.table import (
    CAMERA_NAME,
    EDGE_COVARIANCE,
    OF_PIXELS,
    PIXEL,
    VIEW,
    Table,
    known,
    may,
    sure,
    text,
    whole,
)

_DOT = whole("dot", "number of the dot, row * columns + column; opaque on a target without bounds")
_PLACE = (
    whole("row", "row of the dot on the target, from 0 at the first or at the origin mark"),
    whole("column", "column of the dot on the target"),
)

DOTS = Table(
    "calibration/dots.csv, stage_axis/dots.csv, results/calibration/dots.csv",
    "a dot in one image of the target",
    (
        VIEW, CAMERA_NAME, _DOT, *(replace(one, required=False) for one in _PLACE),
        *sure(PIXEL, "px", "centre of the dot's image, as measured"), *OF_PIXELS,
        *may("chi2_dof", "", "chi-square per degree of freedom of the luminance fit"),
        *may(EDGE_COVARIANCE, "px2", "part of the covariance from rough edges of the dots: it is "
             "the same in all images of a dot, so it counts as an error of its place"),
    ),
)  # fmt: skip

RESIDUALS = Table(
    "results/calibration/residuals.csv",
    "a dot in one image of the target",
    (
        VIEW, CAMERA_NAME, _DOT, *_PLACE,
        *sure(PIXEL, "px", "centre of the dot's image, as measured"),
        *sure(["du_px", "dv_px"], "px", "measured less predicted centre"),
        *sure("weight", "", "weight in the fit; a dot of 0.5 or less is left out"),
        replace(text("reason", "why it is left out"), required=True),
    ),
)  # fmt: skip

REJECTED = Table(
    "results/calibration/rejected.csv",
    "a thing like a dot that was not used",
    (
        VIEW, CAMERA_NAME, *known(PIXEL, "px", "its centre"),
        *known(["a_px", "b_px"], "px", "its semi-axes"),
        *known("angle_rad", "rad", "direction of the long one, from +u towards +v"),
        Column("reason", "text", what="why it was not used"),
    ),
)  # fmt: skip

POSITIONS = Table(
    "stage_axis/positions.csv",
    "a stop of the stage",
    (VIEW, *sure("position_mm", "mm", "reading of the encoder")),
)
