"""The shapes of the bubbles of a tracked run, from the outlines in detections.csv."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.io.files.csv_table import Column, read_columns
from telerig.rig.camera import Camera
from telerig.rig.silhouette import ellipsoids_from_outlines

_ELLIPSE = ["a_px", "b_px", "angle_rad"]
_PLACE = ["x_mm", "y_mm", "z_mm"]


def spheres_of(rows: pd.DataFrame) -> Array:
    """Return Q (N, 3, 3) in mm^2 of the spheres x^T Q^-1 x = 1 with the diameters ``d_eq_mm``."""
    radius = rows["d_eq_mm"].to_numpy(float) / 2
    return np.asarray(radius[:, None, None] ** 2 * np.eye(3))


def ellipsoids_of(folder: Path, rows: pd.DataFrame, cameras: tuple[Camera, Camera]) -> Array | None:
    """Return Q (N, 3, 3) in mm^2 and rig axes of the ellipsoids x^T Q^-1 x = 1.

    folder : results folder of the run, with detections.csv.
    rows : N rows of tracks.csv with frame, particle and the position in the rig frame.

    A row whose bubble does not have an outline in both views is NaN. Returns None if the file is
    missing or has no outlines.
    """
    names = [Column(n, required=False, blank=True) for n in _ELLIPSE]
    key = [
        Column("frame", "whole"),
        Column("camera", "text"),
        Column("particle", "text", blank=True),
    ]
    table = read_columns(folder / "detections.csv", [*key, *names], optional=True)
    if not len(table) or any(name not in table for name in _ELLIPSE):
        return None
    table = table[table["particle"] != ""]
    table = table.assign(particle=table["particle"].str.removesuffix(".0"))
    wanted = rows[["frame"]].assign(particle=rows["particle"].astype(str))
    views = []
    for camera in cameras:
        mine = table[table["camera"] == camera.name].drop_duplicates(["frame", "particle"])
        joined = wanted.merge(mine, how="left", on=["frame", "particle"])
        views.append(joined[_ELLIPSE].to_numpy(float))
    ellipses, points = np.stack(views, axis=1), rows[_PLACE].to_numpy(float)
    out = np.full((len(rows), 3, 3), np.nan)
    seen = np.isfinite(ellipses).all((1, 2)) & np.isfinite(points).all(1)
    if seen.any():
        out[seen] = ellipsoids_from_outlines(cameras, points[seen], ellipses[seen])
    return out
