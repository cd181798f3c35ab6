"""Poses in which the target could be held next: a table of tilts, rolls and places."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.solver.problem import Problem
from telerig.factors.projection import Observations, State, pixels

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

TILT_LIMIT_DEG = 62.0
"""To either camera: beyond, a dot is too flat an ellipse to be found safely."""
TURNS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
"""Of the plate's normal from where it faces the cameras alike."""
DIRECTIONS = 8
ROLLS_DEG = (0.0, 45.0, 90.0, 135.0)
PLACES = np.array([(0.0, 0.0, 0.0), *product((-1.0, 1.0), repeat=3)])
"""Of the target's middle: in the middle of the volume, or at the corners of a cube round it."""
PLACE_SHARE = 0.2
"""Of the smaller field: half the side of that cube."""
BORDER_SHARE = 0.03
SEEN_SHARE = 0.9
"""Of the dots that an image shows so far (median): a candidate shows as many in two cameras."""
CELLS = 6
"""Parts of an image, each way, of which it is asked whether a dot has been there."""
FEW_DOTS = 25
_EDGE_ON = 0.1


@dataclass(frozen=True)
class Candidates:
    """K poses that two cameras or more of C see.

    rig_from_target : (K, 4, 4).  tilt : (K,) number of the plate's normal in the table.
    facing : (K, C) +1 where a camera sees the side of negative z, else -1.
    sees : (K, C) whether the plate's side and tilt let a camera see it.
    pair : (K, 2) the cameras between which the plate is held.
    """

    rig_from_target: Array
    facing: Array
    tilt: Ints
    sees: Bools
    pair: Ints

    def __len__(self) -> int:
        return len(self.tilt)

    def some(self, index: Ints | Bools | slice) -> Candidates:
        """A choice of them."""
        return Candidates(
            self.rig_from_target[index], self.facing[index], self.tilt[index], self.sees[index],
            self.pair[index],
        )  # fmt: skip


def candidates(problem: Problem, state: State) -> Candidates:
    """Every pose of the table in which two cameras see enough of the target, marks included."""
    normals, facing, sees, pair = _normals(problem, state)
    places = volume_centre_mm(problem, state) + PLACE_SHARE * field_mm(problem) * PLACES
    size = (len(normals), len(ROLLS_DEG), len(places))
    tilt, roll, place = (index.ravel() for index in np.indices(size))
    poses = np.tile(np.eye(4), (len(tilt), 1, 1))
    poses[:, :3, :3] = _rotations(normals[tilt], np.radians(ROLLS_DEG)[roll])
    poses[:, :3, 3] = places[place] - poses[:, :3, :3] @ middle_mm(state)
    found = Candidates(poses, facing[tilt], tilt, sees[tilt], pair[tilt])
    return found.some(_enough_seen(problem, state, found))


def middle_mm(state: State) -> Array:
    """(3,) middle of the dots in the target's frame."""
    return np.asarray((state.dots_mm.min(0) + state.dots_mm.max(0)) / 2)


def field_mm(problem: Problem) -> float:
    """The smaller side of the smaller image, in object space."""
    return float(min(min(c.image_size_px) / c["scale_px_per_mm"] for c in problem.cameras))


def volume_centre_mm(problem: Problem, state: State) -> Array:
    """(3,) the rig's origin; where the target was, when the optical axes meet far from there."""
    seen = np.unique(problem.view[problem.weight > 0])
    poses = state.rig_from_target[seen]
    mean = np.mean(poses[:, :3, :3] @ middle_mm(state) + poses[:, :3, 3], 0)
    return mean if np.linalg.norm(mean) > field_mm(problem) / 2 else np.zeros(3)


def optical_axes(state: State) -> Array:
    """(C, 3) in the rig frame, away from the cameras."""
    return np.asarray(state.rig_from_camera[:, :3, 2])


def bases(axes: Array, facing: Array) -> tuple[Array, Array, Array]:
    """Unit vectors: the plate's z when it faces both cameras alike, in the axes' plane, across.

    axes : (2, 3), facing : (2,) of the two cameras.
    """
    a, b = facing[:, None] * axes
    alike = (a + b) / np.linalg.norm(a + b)
    across = np.cross(a, b)
    if np.linalg.norm(across) < _EDGE_ON:
        across = np.array([0.0, -1.0, 0.0])
    across = across - (across @ alike) * alike
    across /= np.linalg.norm(across)
    return alike, np.cross(across, alike), across


def _normals(problem: Problem, state: State) -> tuple[Array, Array, Bools, Ints]:
    """(T, 3) the plate's z in the rig, and `Candidates.facing`, ``sees`` and ``pair`` for it."""
    axes = optical_axes(state)
    seen = np.ones(len(axes)) if problem.target.two_sided else _sides_seen(problem, state)
    both = (1.0, -1.0) if problem.target.two_sided else (1.0,)
    normals, facing, sees, pairs = [], [], [], []
    for pair in combinations(range(len(axes)), 2):
        for signs in product(both, repeat=2):
            side = np.array(signs) * seen[list(pair)]
            a, b = side[:, None] * axes[list(pair)]
            if np.linalg.norm(a + b) < _EDGE_ON:
                continue
            # where the cameras stand far apart, no plate is tilted by less than half their angle
            half = np.arccos(np.clip(a @ b, -1, 1)) / 2
            limit = np.cos(min(max(np.radians(TILT_LIMIT_DEG), half + 0.15), 1.3))
            alike, along, across = bases(axes[list(pair)], side)
            for turn in np.radians(TURNS_DEG):
                for way in 2 * np.pi * np.arange(DIRECTIONS if turn else 1) / DIRECTIONS:
                    aside = np.cos(way) * along + np.sin(way) * across
                    normal = np.cos(turn) * alike + np.sin(turn) * aside
                    if min(normal @ a, normal @ b) < limit:
                        continue
                    sides = np.sign(axes @ normal) if problem.target.two_sided else seen.copy()
                    sides[list(pair)] = side
                    see = sides * (axes @ normal) >= np.cos(np.radians(TILT_LIMIT_DEG))
                    see[list(pair)] = True
                    normals.append(normal)
                    facing.append(sides)
                    sees.append(see)
                    pairs.append(pair)
    count = len(axes)
    return (
        np.array(normals).reshape(-1, 3),
        np.array(facing).reshape(-1, count),
        np.array(sees, bool).reshape(-1, count),
        np.array(pairs, np.int64).reshape(-1, 2),
    )


def _sides_seen(problem: Problem, state: State) -> Array:
    """(C,) which side of the plate each camera has seen most: +1 that of negative z, else -1."""
    used = problem.weight > 0
    signs = np.sign(np.einsum("ci,vi->vc", optical_axes(state), state.rig_from_target[:, :3, 2]))
    cameras = range(len(problem.cameras))
    total = [signs[problem.view[used & (problem.camera == c)], c].sum() for c in cameras]
    return np.where(np.array(total) < 0, -1.0, 1.0)


def _rotations(normal: Array, roll_rad: Array) -> Array:
    """(K, 3, 3) with z the normal and, before the roll, x as near to the rig's x as can be."""
    start = np.where(np.abs(normal[:, :1]) < 0.95, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    x = start - normal * np.sum(start * normal, -1, keepdims=True)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    y = np.cross(normal, x)
    cosine, sine = np.cos(roll_rad)[:, None], np.sin(roll_rad)[:, None]
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, normal], -1)


def predicted(
    problem: Problem, state: State, poses: Candidates, dots: Ints, whitener: Array
) -> tuple[State, Observations]:
    """K views of ``dots`` in all C images, view by view and camera by camera; no pixels measured.

    whitener : (C,) 1 / px, of each camera.
    """
    cameras = np.arange(len(problem.cameras))
    view, camera, dot = (
        a.ravel() for a in np.meshgrid(np.arange(len(poses)), cameras, dots, indexing="ij")
    )
    white = whitener[camera][:, None, None] * np.eye(2)
    plate = (problem.target.plate_thickness_mm, problem.target.plate_index)
    views = State(state.intrinsics, state.rig_from_camera, poses.rig_from_target, state.dots_mm)
    return views, Observations(
        view, camera, dot, np.zeros((len(view), 2)), white, _plate_shift(problem, poses.facing),
        plate, tuple(c.wall for c in problem.cameras),
    )  # fmt: skip


def _plate_shift(problem: Problem, facing: Array) -> Array:
    """(K, C) through the plate where the views so far say that this side is seen through it."""
    shifts = problem.plate_shift[problem.plate_shift != 0]
    if not len(shifts):
        return np.zeros_like(facing)
    return np.where(facing == -shifts[0], shifts[0], 0.0)


def dots_seen(problem: Problem, state: State, poses: Candidates, dots: Ints) -> tuple[Bools, Array]:
    """(K, C, n) which of ``dots`` are in the images, off the border, (K, C, n, 2) pixels."""
    count = len(problem.cameras)
    views, obs = predicted(problem, state, poses, dots, np.ones(count))
    uv = pixels(views, obs, problem.rho_mm).reshape(len(poses), count, len(dots), 2)
    diameter = problem.target.diameter_mm(problem.dot_ids[dots])
    inside = np.empty(uv.shape[:-1], bool)
    for c, camera in enumerate(problem.cameras):
        size = np.array(camera.image_size_px)
        border = diameter * camera["scale_px_per_mm"] / 2 + BORDER_SHARE * size.min()
        inside[:, c] = np.minimum(uv[:, c], size - 1 - uv[:, c]).min(-1) >= border
    return inside & poses.sees[..., None], uv


def spread_dots(problem: Problem, count: int = FEW_DOTS) -> Ints:
    """Up to ``count`` dots, spread over the list of all."""
    whole = len(problem.dot_ids)
    return np.unique(np.linspace(0, whole - 1, min(count, whole)).round().astype(np.int64))


def _enough_seen(problem: Problem, state: State, poses: Candidates) -> Bools:
    """(K,) whether two cameras see as many dots as images do so far, and all marks.

    The two between which the plate is held; what others see of it is used as it is.
    """
    image = (len(problem.cameras) * problem.view + problem.camera)[problem.weight > 0]
    counts = np.bincount(image)
    share = SEEN_SHARE * np.median(counts[counts > 0]) / len(problem.dot_ids)
    some = spread_dots(problem)
    marks = np.flatnonzero(problem.target.is_mark(problem.dot_ids))
    visible, _ = dots_seen(problem, state, poses, np.r_[some, marks])
    visible = np.take_along_axis(visible, poses.pair[..., None], 1)
    enough = visible[..., : len(some)].mean(-1) >= share
    return np.asarray(np.all(enough, -1) & np.all(visible[..., len(some) :], axis=(-1, -2)))


def new_cells(problem: Problem, visible: Bools, uv_px: Array) -> Bools:
    """(C, CELLS, CELLS) parts of the images, (columns, rows), that no dot has reached so far.

    visible : (C, n); uv_px : (C, n, 2), of the view that would reach them.
    """
    out = []
    for c, camera in enumerate(problem.cameras):
        edges = [np.linspace(-0.5, size - 0.5, CELLS + 1) for size in camera.image_size_px]
        mine = (problem.weight > 0.5) & (problem.camera == c)
        before, then = (
            np.histogram2d(uv[:, 0], uv[:, 1], bins=edges)[0] > 0
            for uv in (problem.uv_px[mine], uv_px[c][visible[c]])
        )
        out.append(then & ~before)
    return np.array(out)
