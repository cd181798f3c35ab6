"""The table of measured bodies: size, aspect ratio and pole of each bubble in each frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.estimator.bubbles.shape.spheroid import (
    Deviations,
    Spheroids,
    fit_spheroids,
    paired_outlines,
)
from telerig.io.results.bubbles import BODY_COLUMNS
from telerig.rig.camera import Camera

_KEYS = ["frame", "particle"]


def bodies_table(
    tracks: Any, cameras: tuple[Camera, ...], up: Array
) -> tuple[pd.DataFrame, Deviations]:
    """Return size and shape of each bubble in each frame of a run.

    tracks : `Tracks`; or a table with the columns of tracks.csv, for which only the diameters are
        known.
    up : (3,) unit vector against gravity in the rig frame.

    Returns a table with the columns `BODY_COLUMNS`, without rows for frames in which an outline is
    missing, cut or covered; and how the outlines of this run deviate from those of spheroids.
    """
    table = getattr(tracks, "table", tracks)
    detections = getattr(tracks, "detections", None)
    if detections is None or not {"particle", "a_px"} <= set(detections) or len(cameras) != 2:
        return _diameters_alone(table), Deviations()
    points = table[[*_KEYS, "x_mm", "y_mm", "z_mm"]]
    seen = detections[detections["particle"].notna()]
    sides = [
        _numbered(seen[seen["camera"] == camera.name]).merge(points[_KEYS], on=_KEYS)
        for camera in cameras
    ]
    both = points.merge(sides[0][_KEYS], on=_KEYS).merge(sides[1][_KEYS], on=_KEYS)
    if not len(both):
        return _diameters_alone(table), Deviations()
    first, second = (both[_KEYS].merge(side, on=_KEYS) for side in sides)
    outlines = paired_outlines(first, second, (cameras[0], cameras[1]))
    bodies, known = fit_spheroids(
        outlines, both[["x_mm", "y_mm", "z_mm"]].to_numpy(float), (cameras[0], cameras[1]), up
    )
    out = pd.DataFrame({**both[_KEYS], **_columns(bodies, up)})[BODY_COLUMNS]
    return out[out["d_eq_mm"].notna()].reset_index(drop=True), known


def _numbered(rows: pd.DataFrame) -> pd.DataFrame:
    numbers = rows["particle"].to_numpy(float).astype(np.int64)
    return rows.assign(particle=numbers).drop_duplicates(_KEYS)


def _diameters_alone(table: pd.DataFrame) -> pd.DataFrame:
    out = table[_KEYS].copy().reindex(columns=BODY_COLUMNS)
    if "d_eq_mm" in table:
        out["d_eq_mm"] = table["d_eq_mm"]
        out["sd_eq_mm"] = table.get("sd_eq_mm", pd.Series(np.nan, table.index))
    return out[out["d_eq_mm"].notna()].astype(dict.fromkeys(_KEYS, np.int64)).reset_index(drop=True)


def _columns(bodies: Spheroids, up: Array) -> dict[str, Array]:
    covariance = bodies.covariance
    size_sd, aspect_sd = np.sqrt(covariance[:, 0, 0]), np.sqrt(covariance[:, 1, 1])
    shared = covariance[:, 0, 1]

    def log_sd(of_aspect: float) -> Array:
        """Of log size plus a multiple of log aspect."""
        variance = size_sd**2 + (of_aspect * aspect_sd) ** 2 + 2 * of_aspect * shared
        return np.asarray(np.sqrt(np.maximum(variance, 0)))

    pole = bodies.pole * np.where(bodies.pole @ up < 0, -1.0, 1.0)[:, None]
    tilt, tilt_sd = _tilt(bodies, up)
    equator, polar = bodies.equator_mm, bodies.polar_mm
    return {
        "d_eq_mm": bodies.d_eq_mm,
        "sd_eq_mm": bodies.d_eq_mm * size_sd,
        "aspect": bodies.aspect,
        "s_aspect": bodies.aspect * aspect_sd,
        "tilt_deg": np.degrees(tilt),
        "s_tilt_deg": np.degrees(tilt_sd),
        "equator_mm": equator,
        "s_equator_mm": equator * log_sd(1 / 3),
        "polar_mm": polar,
        "s_polar_mm": polar * log_sd(-2 / 3),
        "pole_x": pole[:, 0],
        "pole_y": pole[:, 1],
        "pole_z": pole[:, 2],
        "r_size_aspect": shared / (size_sd * aspect_sd),
        "spheroid_chi2": bodies.chi2,
    }


def _tilt(bodies: Spheroids, up: Array) -> tuple[Array, Array]:
    """Return the angle (M,) between pole and vertical in rad, 0 to pi/2, and its sd."""
    along = (bodies.frame.mT @ up[:, None])[..., 0]
    across = np.linalg.norm(along[:, :2], axis=-1, keepdims=True)
    tilt = np.arctan2(across[:, 0], np.abs(along[:, 2]))
    # an upright pole has no direction of its tilt: the mean over all of them
    toward = along[:, :2] / np.maximum(across, 1e-12)
    lean = bodies.covariance[:, 2:4, 2:4]
    variance = np.einsum("mi,mij,mj->m", toward, lean, toward)
    mean = np.trace(lean, axis1=1, axis2=2) / 2
    upright = across[:, 0] ** 2 < mean
    return tilt, np.sqrt(np.where(upright, mean, variance))
