"""What the film of a path shows: points, their sd and the bubbles' bodies, in axes of the film."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.io.files.csv_table import Column
from telerig.io.report.page.results_tables import optional_columns
from telerig.io.report.run.smoothing.results import read_smoothing_results
from telerig.io.report.run.tracking.results import TrackResults, read_track_results
from telerig.io.report.run.tracking.scene import thinned
from telerig.rig.camera import Camera

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

MOST_POINTS = 3_000
MOST_BODIES = 120
_SPACING = 1.7
_STEP_MM = 0.01
_THINNEST = 0.05
_PLACE, _SD = ["x_mm", "y_mm", "z_mm"], ["sx_mm", "sy_mm", "sz_mm"]
_VARIANCE = ["sxx_mm2", "syy_mm2", "szz_mm2"]
_ELLIPSE = ["a_px", "b_px", "angle_rad"]


@dataclass(frozen=True)
class FilmPath:
    """Paths in the film's axes: right and forward (away from the viewer) at angle 0, and up.

    points_mm, sd_mm : (N, 3), by particle and frame. particle : (N,). new : (N,), rows before
    which the line is interrupted. bodies : (B,) rows of the points whose bubble is drawn.
    quadrics_mm2 : (B, 3, 3), Q of the ellipsoid x^T Q^-1 x = 1. names : of the three axes.
    notes : what a viewer must know.
    """

    points_mm: Array
    sd_mm: Array
    particle: NDArray[np.int64]
    new: NDArray[np.bool_]
    bodies: NDArray[np.int64]
    quadrics_mm2: Array
    names: tuple[str, str, str]
    title: str
    notes: tuple[str, ...]


def film_axes(up: Array) -> Array:
    """(3, 3) rows right, forward, up in rig axes; (right, up, -forward) is right-handed.

    right is the rig axis x, or z where x is upright.
    """
    first = np.eye(3)[0 if abs(up[0]) < 0.7 else 2]
    right = first - (first @ up) * up
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(up, right), up])


def read_film_path(folder: Path, cameras: tuple[Camera, Camera] | None) -> FilmPath:
    """The path that a run's results folder holds: smoothed in the lab frame, else the tracks.

    cameras : for the bubbles' bodies from both outlines; without them they are spheres.
    Raises InputError for a folder that cannot be read, or holds no point.
    """
    results = read_track_results(folder)
    smoothing = read_smoothing_results(folder, results.up)
    table, title = _table(results, None if smoothing is None else smoothing.trajectories)
    found = int(np.isfinite(table[_PLACE].to_numpy(float)).all(1).sum())
    if not found:
        raise InputError(
            "no bubble was followed, so there is no path to film", where=str(folder),
            todo="look at the run's report.html for the reasons",
        )  # fmt: skip
    kept = thinned(table, MOST_POINTS).reset_index(drop=True)
    notes = [f"{len(kept)} of {found} positions drawn"] if len(kept) < found else []
    axes = film_axes(results.up)
    rows, quadrics, how = _bodies(folder, results, kept, cameras)
    names = tuple(_axis_name(direction) for direction in axes[:2])
    return FilmPath(
        kept[_PLACE].to_numpy(float) @ axes.T,
        np.sqrt(kept[_SD].to_numpy(float) ** 2 @ (axes.T**2)),
        kept["particle"].to_numpy(np.int64),
        kept["new"].to_numpy(bool),
        rows,
        axes @ quadrics @ axes.T,
        (names[0], names[1], "height"),
        f"{results.content.get('run') or folder.name}: {title}",
        (*notes, how),
    )


def _table(results: TrackResults, smoothed: pd.DataFrame | None) -> tuple[pd.DataFrame, str]:
    """Rows with frame, particle, place and sd."""
    if smoothed is not None and len(smoothed):
        missing = {name: np.nan for name in _SD if name not in smoothed}
        return smoothed.assign(**missing), "smoothed, lab frame"
    variance = results.tracks[_VARIANCE].to_numpy(float)
    sd = np.sqrt(np.where(variance >= 0, variance, np.nan))
    return results.tracks.assign(**dict(zip(_SD, sd.T))), "triangulated, rig frame"


def _axis_name(direction: Array) -> str:
    axis = int(np.argmax(np.abs(direction)))
    return ("" if direction[axis] > 0 else "-") + "xyz"[axis]


def _bodies(
    folder: Path,
    results: TrackResults,
    kept: pd.DataFrame,
    cameras: tuple[Camera, Camera] | None,
) -> tuple[NDArray[np.int64], Array, str]:
    """Rows of ``kept``, their quadrics in rig axes, and in words what is drawn."""
    here = kept[["frame", "particle"]].assign(row=np.arange(len(kept)))
    sizes = results.tracks[["frame", "particle", "d_eq_mm", *_PLACE]].merge(
        here, on=["frame", "particle"]
    )
    sizes = sizes[np.isfinite(sizes["d_eq_mm"].to_numpy(float))].sort_values("row")
    sizes = sizes.iloc[_apart(kept, sizes)].reset_index(drop=True)
    radius = sizes["d_eq_mm"].to_numpy(float) / 2
    quadrics = radius[:, None, None] ** 2 * np.eye(3)
    rows = sizes["row"].to_numpy(np.int64)
    ellipses = _ellipses(folder, sizes, cameras)
    if cameras is None or ellipses is None:
        return rows, quadrics, "bubbles: spheres of equal volume"
    seen = np.isfinite(ellipses).all((1, 2))
    if seen.any():
        points = sizes.loc[seen, _PLACE].to_numpy(float)
        quadrics[seen] = ellipsoids_from_outlines(cameras, points, ellipses[seen])
    return rows, quadrics, "bubbles: ellipsoids from both outlines"


def _apart(kept: pd.DataFrame, sizes: pd.DataFrame) -> list[int]:
    """Rows of ``sizes`` so far apart along their tracks that bubbles do not hide each other."""
    points = kept[_PLACE].to_numpy(float)[sizes["row"].to_numpy(np.int64)]
    particle, diameter = sizes["particle"].to_numpy(), sizes["d_eq_mm"].to_numpy(float)
    chosen: list[int] = []
    for i in range(len(sizes)):
        last = chosen[-1] if chosen else -1
        far = np.linalg.norm(points[i] - points[last]) > _SPACING * diameter[i]
        if last < 0 or particle[i] != particle[last] or far:
            chosen.append(i)
    return chosen[:: len(chosen) // MOST_BODIES + 1]


def _ellipses(
    folder: Path, sizes: pd.DataFrame, cameras: tuple[Camera, Camera] | None
) -> Array | None:
    """(B, cameras, 3) semi-axes and angle; NaN where a bubble was not seen."""
    names = [Column(n, required=False, blank=True) for n in _ELLIPSE]
    key = [
        Column("frame", "whole"),
        Column("camera", "text"),
        Column("particle", "text", blank=True),
    ]
    table: pd.DataFrame = optional_columns(folder / "detections.csv", [*key, *names])
    if cameras is None or not len(table) or any(name not in table for name in _ELLIPSE):
        return None
    table = table[table["particle"] != ""]
    table = table.assign(particle=table["particle"].astype(float).astype("int64"))
    views = []
    for camera in cameras:
        mine = table[table["camera"] == camera.name].drop_duplicates(["frame", "particle"])
        joined = sizes[["frame", "particle"]].merge(mine, how="left", on=["frame", "particle"])
        views.append(joined[_ELLIPSE].to_numpy(float))
    return np.stack(views, axis=1)


def ellipsoids_from_outlines(
    cameras: tuple[Camera, Camera], points_mm: Array, ellipses: Array
) -> Array:
    """(N, 3, 3) in rig axes, Q of x^T Q^-1 x = 1, from the outlines in two views.

    points_mm : (N, 3). ellipses : (N, 2, 3) semi-axes in px and angle in rad.
    A parallel projection P maps an ellipsoid Q to the ellipse P Q P^T, so the two outlines are six
    linear equations. They leave one number open, a shear that neither camera sees: of all that
    fit, the body of largest volume is taken (the determinant is quadratic along that direction).
    """
    upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(upper):
        basis[k, i, j] = basis[k, j, i] = 1.0
    rows, targets = [], []
    for index, camera in enumerate(cameras):
        steps = _STEP_MM * np.eye(3)
        plus, minus = (camera.project(points_mm[:, None] + s * steps) for s in (1, -1))
        by_point = np.swapaxes(plus - minus, 1, 2) / (2 * _STEP_MM)
        seen = by_point[:, None] @ basis @ np.swapaxes(by_point, 1, 2)[:, None]
        rows.append(seen[..., [0, 0, 1], [0, 1, 1]].swapaxes(1, 2))
        targets.append(_ellipse_matrix(ellipses[:, index])[..., [0, 0, 1], [0, 1, 1]])
    system, target = np.concatenate(rows, 1), np.concatenate(targets, 1)
    fitted = (np.linalg.pinv(system, rcond=1e-3) @ target[..., None])[..., 0]
    open_direction = np.linalg.svd(system)[2][:, -1]
    body = np.einsum("nk,kij->nij", fitted, basis)
    return _proper(_largest(body, np.einsum("nk,kij->nij", open_direction, basis)))


def _ellipse_matrix(ellipse: Array) -> Array:
    cos, sin = np.cos(ellipse[:, 2]), np.sin(ellipse[:, 2])
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    return np.asarray(turn * ellipse[:, None, :2] ** 2 @ np.swapaxes(turn, 1, 2))


def _largest(body: Array, direction: Array) -> Array:
    """body + t direction where its determinant, a parabola in t, is largest."""
    unit = np.trace(body, axis1=1, axis2=2)[:, None, None] / 3 * direction
    down, here, up = (np.linalg.det(body + t * unit) for t in (-1.0, 0.0, 1.0))
    bend = up + down - 2 * here
    t = np.where(bend < 0, (down - up) / (2 * np.where(bend < 0, bend, -1.0)), 0.0)
    return np.asarray(body + t[:, None, None] * unit)


def _proper(body: Array) -> Array:
    """Outlines that do not fit together may leave no body: the thinnest axis is limited."""
    squares, axes = np.linalg.eigh(body)
    squares = np.maximum(squares, _THINNEST**2 * np.abs(squares).max(1, keepdims=True))
    return np.asarray(axes * squares[:, None] @ np.swapaxes(axes, 1, 2))
