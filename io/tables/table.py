"""What a declaration of a table is, and the columns that many tables share."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.io.files.csv_table import Column, no_rows, read_part, read_table
from telerig.io.files.frame_table import Read

CAMERA = "{camera}"
"""Stands in the name of a column that a table has once for each camera."""


@dataclass(frozen=True)
class Table:
    """Declare a CSV table.

    file : its name, or the names of several.
    row : what a row is, in words.
    columns : its columns in order; one with `CAMERA` in its name stands for one of each camera.
    """

    file: str
    row: str
    columns: tuple[Column, ...]

    def of(
        self,
        cameras: Sequence[str] = (),
        *,
        need: Collection[str] | None = None,
        ids: Literal["id", "name"] = "id",
    ) -> list[Column]:
        """Return the columns for these cameras.

        need : those that a table of another program must have; None for all that telerig writes.
        ids : as what ids of bubbles are read.
        """
        out = []
        for one in self.columns:
            kind = ids if one.kind == "id" else one.kind
            names = [one.name]
            if CAMERA in one.name:
                names = [one.name.replace(CAMERA, camera) for camera in cameras]
            must = one.required if need is None else one.name in need
            out += [replace(one, name=name, kind=kind, required=must) for name in names]
        return out

    def names(self, cameras: Sequence[str] = ()) -> list[str]:
        """Return the names of `of`."""
        return [column.name for column in self.of(cameras)]

    def column(self, name: str) -> Column | None:
        """Return the declaration of the column of this name, of any camera, or None."""
        for one in self.columns:
            pattern = re.escape(one.name).replace(re.escape(CAMERA), ".+")
            if one.name == name or (CAMERA in one.name and re.fullmatch(pattern, name)):
                return one
        return None

    def read(
        self, file: Path, cameras: Sequence[str] = (), *, need: Collection[str] | None = None,
        optional: bool = False,
    ) -> pd.DataFrame:  # fmt: skip
        """Read the table with all columns of the file, also unknown ones; it may have no rows.

        need : as for `of`. optional : a missing file is a table without rows. Raises InputError as
        `read_table` does.
        """
        columns = self.of(cameras, need=need)
        if optional and not file.is_file():
            return no_rows(columns)
        return read_table(file, columns, extra=True, empty=True).reset_index(drop=True)

    def reader_of_parts(self, file: Path, *, need: Collection[str] | None = None) -> Read:
        """Return the function that reads some of a file's rows, for a `FrameTable`.

        Columns are checked and converted as by `read`. need : as for `read`.
        """

        def read(content: bytes, row: int) -> pd.DataFrame | None:
            table = read_part(file, content, row, self.of(need=need))
            return None if table is None else table.reset_index(drop=True)

        return read

    def rows_of_words(self) -> Iterator[tuple[list[str], str, str]]:
        """Yield names, unit and meaning of columns; those of one meaning that follow each other are
        together."""
        names: list[str] = []
        for one, after in zip(self.columns, (*self.columns[1:], None)):
            names.append(one.name)
            if after is None or (after.what, after.unit) != (one.what, one.unit):
                yield names, one.unit, one.what
                names = []


def whole(name: str, what: str, **more: Any) -> Column:
    """Declare a column of whole numbers."""
    return Column(name, "whole", what=what, **more)


def named(name: str, what: str, **more: Any) -> Column:
    """Declare a column of names, which follow the rule of `telerig.io.files.names`."""
    return Column(name, "name", what=what, **more)


def text(name: str, what: str) -> Column:
    """Declare a column of text, which a table may lack and whose cells may be blank."""
    return Column(name, "text", required=False, blank=True, what=what)


def sure(names: str | Sequence[str], unit: str, what: str) -> list[Column]:
    """Declare columns of numbers that a table must have, without blank cells."""
    names = [names] if isinstance(names, str) else names
    return [Column(name, unit=unit, what=what) for name in names]


def known(
    names: str | Sequence[str], unit: str, what: str, *, required: bool = True
) -> list[Column]:
    """Declare columns of numbers whose cells are blank where a number is not known."""
    return [replace(one, blank=True, required=required) for one in sure(names, unit, what)]


def may(names: str | Sequence[str], unit: str, what: str) -> list[Column]:
    """Declare columns of numbers that a table may lack, and whose cells may be blank."""
    return known(names, unit, what, required=False)


def sd(names: str | Sequence[str], unit: str, what: str = "its standard deviation") -> list[Column]:
    """Declare columns of standard deviations, or parts of one, as `may` does."""
    return [replace(one, kind="sd") for one in may(names, unit, what)]


def xyz(pattern: str) -> list[str]:
    """Return the names of three columns, with x, y and z in place of {}."""
    return [pattern.format(axis) for axis in "xyz"]


FRAME = whole("frame", "index of the frame, from 0")
TIME = sure("t_s", "s", "middle of the exposure on the clock of the record")[0]
PARTICLE = Column("particle", "id", what="id of the bubble")
CAMERA_NAME = named("camera", "name of the camera")
VIEW = named("view", "name of the view")
PIXEL = ("u_px", "v_px")
PIXEL_COVARIANCE = ("suu_px2", "suv_px2", "svv_px2")
EDGE_COVARIANCE = ("edge_suu_px2", "edge_suv_px2", "edge_svv_px2")
"""The part of `PIXEL_COVARIANCE` that is the same in all images of a dot."""
POINT = ("x_mm", "y_mm", "z_mm")
SILHOUETTES = tuple(f"silhouettes_{axis}_mm" for axis in "xyz")
COVARIANCE = ("sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2")

OF_PIXELS = (
    Column("sigma_px", "sd", required=False, unit="px", what="standard deviation of u and v"),
    *(
        Column(name, required=False, unit="px2", what="covariance of u and v, else from sigma_px")
        for name in PIXEL_COVARIANCE
    ),
)
"""How the noise of a measured pixel is stated."""

CALIBRATION_SHARE = tuple(xyz("calibration_s{}_mm"))
EXTRAPOLATED = "extrapolated"
OF_CALIBRATION = (
    *sd(CALIBRATION_SHARE, "mm", "standard deviation of the position by the errors of the "
       "calibration, which are common to the run; missing where they are not known"),
    *may(EXTRAPOLATED, "", "1 where the position lies beyond the dots of the calibration in an "
         "image, else 0"),
)  # fmt: skip
"""What the calibration adds to a position."""

OF_SIZE = (
    *may("d_eq_mm", "mm", "diameter of the sphere of equal volume"),
    *sd("sd_eq_mm", "mm"),
)
OF_SHAPE = (
    *may("aspect", "", "equatorial over polar semi-axis of a spheroid: above 1 if flat (oblate)"),
    *sd("s_aspect", ""),
    *may("tilt_deg", "deg", "angle between the polar axis and the vertical, 0 to 90"),
    *sd("s_tilt_deg", "deg"),
    *may("equator_mm", "mm", "equatorial semi-axis"),
    *sd("s_equator_mm", "mm"),
    *may("polar_mm", "mm", "polar semi-axis"),
    *sd("s_polar_mm", "mm"),
    *may(["pole_x", "pole_y", "pole_z"], "", "unit vector along the polar axis, pointing upwards"),
    *may("r_size_aspect", "", "correlation of the errors of the logarithms of d_eq_mm and aspect"),
    *may("spheroid_chi2", "", "how far a spheroid misses the outlines: chi-square with 2 degrees "
         "of freedom for two views, 5 for three"),
    *sd("noise_eq_mm", "mm", "part of sd_eq_mm by the noise of the outlines, which is independent "
       "from frame to frame"),
    *sd("fixed_eq_mm", "mm", "part of sd_eq_mm by modes on the rims and by the mean square of the "
       "unseen shape"),
    *sd("noise_aspect", "", "part of s_aspect by the noise of the outlines"),
    *sd("fixed_aspect", "", "part of s_aspect by the mean square of the unseen shape"),
    *may("stretch", "", "difference of the logarithms of two horizontal extents beyond those of a "
         "spheroid (across the first camera's line of sight, minus along it)"),
    *sd("noise_stretch", "", "part of its standard deviation by the noise of the outlines"),
)  # fmt: skip
"""What outlines tell of a bubble's shape; blank where one is missing, cut or covered."""


def covariance_of_image(dots: pd.DataFrame) -> NDArray[np.float64]:
    """Return uu, uv and vv (N, 3) in px^2 of dots, without the part that all their images share."""
    whole = dots[list(PIXEL_COVARIANCE)].to_numpy(float)
    if not set(EDGE_COVARIANCE) <= set(dots):
        return whole
    shared: NDArray[np.float64] = dots[list(EDGE_COVARIANCE)].fillna(0.0).to_numpy(float)
    return whole - shared
