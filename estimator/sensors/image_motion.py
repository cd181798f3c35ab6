"""The accelerations of the cameras that the images show: of marks, or of bubbles together.

A mark is fixed to the tank, so its image moves against the camera's own motion. Bubbles move by
themselves; what they have in common is the camera's motion, and the rest is noise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.sensors.accelerations import Accelerations, Grid, of_positions
from telerig.rig.camera import Camera
from telerig.statistics import robust_sd

_COARSEST_STEP_S = 0.004
_WIDTHS_S = (0.006, 0.01, 0.016, 0.025, 0.04, 0.06)
_LEAST_FRAMES = 2.0
_NOISE_SHARE = 0.5
_MOST_TRACKS = 100
_SPIKE_SDS = 8.0
_LEAST_SAMPLES = 8
LEAST_SEEN = 0.1
"""Squared share of the travel axis that a camera has to see across its line of sight."""


def directions(camera: Camera) -> Array:
    """Return the unit vectors (2, 3) in the rig frame along which a camera sees motion."""
    return np.asarray(camera.camera_from_rig.rotation[:2])


def seen_of(camera: Camera, axis: Array) -> Array | None:
    """Return weights (2,) that give motion along an axis (3,) from that along both directions.

    None for a camera that looks along the axis.
    """
    seen = directions(camera) @ axis
    size = float(seen @ seen)
    return np.asarray(seen / size) if size > LEAST_SEEN else None


def frame_grid(t_s: Array, noise_mm: float, sensed_rms: Callable[[Grid], float] | None) -> Grid:
    """Return the grid on which images and sensors are compared.

    Its smoothing kernel is the narrowest one with which the images' noise is below half the
    acceleration that the sensors measure.

    t_s : (F,) times of the frames.
    noise_mm : standard deviation of the mean position in a frame.
    sensed_rms : function from a grid to the RMS (mm/s^2) of the sensors' readings, smoothed with
        the grid's kernel; None without sensors, for a kernel of medium width.
    """
    pace = float(np.median(np.diff(t_s)))
    steps = int(np.ceil(pace / _COARSEST_STEP_S - 1e-9))
    step = pace / steps
    count = int((t_s[-1] - t_s[0]) / step + 1e-6) + 1
    least = max(2, round(_LEAST_FRAMES * pace / step))
    knots = sorted({max(round(width / step), least) for width in _WIDTHS_S})
    grids = [Grid(float(t_s[0]), step, count, k, steps) for k in knots]
    if sensed_rms is None:
        return grids[len(grids) // 2]
    for grid in grids:
        if noise_mm * grid.noise_gain < _NOISE_SHARE * sensed_rms(grid):
            return grid
    return grids[-1]


def accelerations(
    grid: Grid, t_s: Array, camera: Camera, item: Ints, frame: Ints, uv_px: Array
) -> Accelerations:
    """Return the camera's accelerations (n, 2) along its two directions, in mm/s^2.

    item, frame, uv_px : (M,), (M,), (M, 2) index, frame and pixel of each of M sightings of a mark
    or a bubble.
    """
    total, count = np.zeros((grid.count, 2)), np.zeros(grid.count)
    if len(item):
        origin, _ = camera.unproject(uv_px)
        place = origin @ directions(camera).T
        names, sizes = np.unique(item, return_counts=True)
        for one in names[np.argsort(-sizes, kind="stable")][:_MOST_TRACKS]:
            mine = np.flatnonzero(item == one)
            mine = mine[np.argsort(frame[mine], kind="stable")]
            mine = mine[_without_spikes(place[mine])]
            if len(mine) < _LEAST_SAMPLES:
                continue
            found = _of_track(grid, t_s[frame[mine]], place[mine])
            if found is not None:
                at, values, known = found
                total[at] += values
                count[at] += known
    mean = -total / np.maximum(count, 1)[:, None]
    return Accelerations(grid, mean, count > 0)


def _of_track(grid: Grid, t: Array, place: Array) -> tuple[slice, Array, Array] | None:
    part = grid.covering(t)
    first = round((part.start_s - grid.start_s) / grid.step_s)
    if part.count < 4 * grid.knots or first < 0:
        return None
    found = of_positions(part, t, place)
    size = min(part.count, grid.count - first)
    return slice(first, first + size), found.values[:size], found.known[:size].astype(float)


def _without_spikes(place: Array) -> Array:
    """Return which of the positions (m, 2) are not far from the middle of their neighbours."""
    keep = np.ones(len(place), bool)
    if len(place) >= _LEAST_SAMPLES:
        off = place[1:-1] - (place[:-2] + place[2:]) / 2
        sd = np.array([max(robust_sd(column), 1e-9) for column in off.T])
        keep[1:-1] = (np.abs(off) < _SPIKE_SDS * sd).all(1)
    return keep
