"""Poses in which the target could be held next: a grid of tilts, rolls and places."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.solver.problem import Problem
from telerig.factors.projection import Observations, State, pixels
from telerig.rig.pose import rotation_from_rotvec

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

TILT_LIMIT_DEG = 62.0
"""To either camera: beyond, a dot is too flat an ellipse to be found safely."""
TURNS_DEG = (0.0, 12.0, 24.0, 36.0, 48.0, 60.0)
"""Of the plate's normal from where it faces the cameras alike."""
DIRECTIONS = 8
ROLLS_DEG = (0.0, 90.0, 180.0, 270.0)
PLACE_SHARE = 0.2
"""Of the smaller field: how far from the middle of the volume the target is held, each way."""
BORDER_SHARE = 0.03
SEEN_SHARE = 0.9
"""Of the dots that an image shows so far (median): a candidate shows as many in both cameras."""
CELLS = 6
"""Parts of an image, each way, of which it is asked whether a dot has been there."""
OUTLINE_DOTS = 24
"""Dots, the outermost first, that decide whether an image shows enough of the target."""
_EDGE_ON = 0.1


@dataclass(frozen=True)
class Candidates:
    """K poses that both cameras see.

    rig_from_target : (K, 4, 4).  plate_shift : (K, 2).
    facing : (K, 2) +1 where a camera sees the side of negative z, else -1.
    cell : (K, 3) number of the tilt, roll and place in their grids.
    """

    rig_from_target: Array
    plate_shift: Array
    facing: Array
    cell: Ints

    def __len__(self) -> int:
        return len(self.cell)

    def some(self, index: Ints | Bools | slice) -> Candidates:
        """A choice of them."""
        return Candidates(
            self.rig_from_target[index],
            self.plate_shift[index],
            self.facing[index],
            self.cell[index],
        )


def candidates(problem: Problem, state: State) -> Candidates:
    """Every pose of the grid in which both cameras see enough of the target, marks included."""
    normals, facing = _normals(problem, state)
    rolls = np.radians(ROLLS_DEG)
    steps = PLACE_SHARE * field_mm(problem) * np.array([0.0, -1.0, 1.0])
    places = volume_centre_mm(problem, state) + np.array(list(product(steps, repeat=3)))
    cell = np.stack(
        np.meshgrid(*(np.arange(len(a)) for a in (normals, rolls, places)), indexing="ij"), -1
    ).reshape(-1, 3)
    rotation = _rotations(normals[cell[:, 0]], rolls[cell[:, 1]])
    poses = np.tile(np.eye(4), (len(cell), 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = places[cell[:, 2]] - rotation @ middle_mm(state)
    facing = facing[cell[:, 0]]
    found = Candidates(poses, _plate_shift(problem, facing), facing, cell)
    return found.some(_enough_seen(problem, state, found))


def joined(first: Candidates, second: Candidates) -> Candidates:
    """The candidates of both."""
    return Candidates(
        np.concatenate([first.rig_from_target, second.rig_from_target]),
        np.concatenate([first.plate_shift, second.plate_shift]),
        np.concatenate([first.facing, second.facing]),
        np.concatenate([first.cell, second.cell]),
    )


def neighbours(
    problem: Problem, state: State, one: Candidates, step_mm: float, step_deg: float
) -> Candidates:
    """One candidate moved along, and turned about its middle about, each axis, both ways."""
    steps = np.concatenate([np.eye(3), -np.eye(3)])
    still = np.zeros((6, 3))
    turn = rotation_from_rotvec(np.radians(step_deg) * np.r_[still, steps])
    move = step_mm * np.r_[steps, still]
    pose = one.rig_from_target[0]
    middle = middle_mm(state)
    poses = np.tile(pose, (len(turn), 1, 1))
    poses[:, :3, :3] = turn @ pose[:3, :3]
    place = pose[:3, :3] @ middle + pose[:3, 3] + move
    poses[:, :3, 3] = place - poses[:, :3, :3] @ middle
    each = np.zeros(len(turn), np.int64)
    found = Candidates(poses, one.plate_shift[each], one.facing[each], one.cell[each])
    cosine = found.facing * (poses[:, :3, 2] @ optical_axes(state).T)
    upright = np.all(cosine >= _least_cosine(optical_axes(state), one.facing[0]), -1)
    return found.some(upright & _enough_seen(problem, state, found))


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


def sides_seen(problem: Problem, state: State) -> Array:
    """(2,) which side of the plate each camera has seen most: +1 that of negative z, else -1."""
    used = problem.weight > 0
    signs = np.sign(np.einsum("ci,vi->vc", optical_axes(state), state.rig_from_target[:, :3, 2]))
    total = [signs[problem.view[used & (problem.camera == c)], c].sum() for c in range(2)]
    return np.where(np.array(total) < 0, -1.0, 1.0)


def bases(axes: Array, facing: Array) -> tuple[Array, Array, Array]:
    """Unit vectors: the plate's z when it faces both cameras alike, in the axes' plane, across."""
    a, b = facing[:, None] * axes
    alike = (a + b) / np.linalg.norm(a + b)
    across = np.cross(a, b)
    if np.linalg.norm(across) < _EDGE_ON:
        across = np.array([0.0, -1.0, 0.0])
    across = across - (across @ alike) * alike
    across /= np.linalg.norm(across)
    return alike, np.cross(across, alike), across


def _normals(problem: Problem, state: State) -> tuple[Array, Array]:
    """(T, 3) the plate's z in the rig, (T, 2) the sides that the cameras then see."""
    axes = optical_axes(state)
    usual = sides_seen(problem, state)
    sides = [usual]
    if problem.target.two_sided:
        sides = [np.array(s) for s in product((1.0, -1.0), repeat=2)]
    normals, facing = [], []
    for side in sides:
        a, b = side[:, None] * axes
        if np.linalg.norm(a + b) < _EDGE_ON:
            continue
        limit = _least_cosine(axes, side)
        alike, along, across = bases(axes, side)
        for turn in np.radians(TURNS_DEG):
            for way in 2 * np.pi * np.arange(DIRECTIONS if turn else 1) / DIRECTIONS:
                aside = np.cos(way) * along + np.sin(way) * across
                normal = np.cos(turn) * alike + np.sin(turn) * aside
                if min(normal @ a, normal @ b) >= limit:
                    normals.append(normal)
                    facing.append(side)
    return np.array(normals).reshape(-1, 3), np.array(facing).reshape(-1, 2)


def _least_cosine(axes: Array, facing: Array) -> float:
    """Of the angle between each axis and the plate's normal; more tilt where it cannot be less."""
    half = np.arccos(np.clip(np.prod(facing) * (axes[0] @ axes[1]), -1, 1)) / 2
    return float(np.cos(min(max(np.radians(TILT_LIMIT_DEG), half + 0.15), 1.3)))


def _rotations(normal: Array, roll_rad: Array) -> Array:
    """(K, 3, 3) with z the normal and, before the roll, x as near to the rig's x as can be."""
    start = np.where(np.abs(normal[:, :1]) < 0.95, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    x = start - normal * np.sum(start * normal, -1, keepdims=True)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    y = np.cross(normal, x)
    cosine, sine = np.cos(roll_rad)[:, None], np.sin(roll_rad)[:, None]
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, normal], -1)


def _plate_shift(problem: Problem, facing: Array) -> Array:
    """(K, 2) through the plate where the views so far say that this side is seen through it."""
    shifts = problem.plate_shift[problem.plate_shift != 0]
    if not len(shifts):
        return np.zeros_like(facing)
    return np.where(facing == -shifts[0], shifts[0], 0.0)


def dots_seen(problem: Problem, state: State, found: Candidates, dots: Ints) -> tuple[Bools, Array]:
    """(K, 2, n) which of ``dots`` are in the images with room to spare, (K, 2, n, 2) pixels."""
    obs = observations(problem, found.plate_shift, dots, np.ones(2))
    whole = State(state.intrinsics, state.rig_from_camera, found.rig_from_target, state.dots_mm)
    uv = pixels(whole, obs, problem.rho_mm).reshape(len(found), 2, len(dots), 2)
    diameter = problem.target.diameter_mm(problem.dot_ids[dots])
    inside = np.empty(uv.shape[:-1], bool)
    for c, camera in enumerate(problem.cameras):
        size = np.array(camera.image_size_px)
        border = diameter * camera["scale_px_per_mm"] / 2 + BORDER_SHARE * size.min()
        inside[:, c] = np.minimum(uv[:, c], size - 1 - uv[:, c]).min(-1) >= border
    return inside, uv


def observations(problem: Problem, shift: Array, dots: Ints, whitener: Array) -> Observations:
    """Each of ``dots`` in both images of K views, whitened per camera; no pixels measured."""
    view, camera, dot = (
        a.ravel() for a in np.meshgrid(np.arange(len(shift)), [0, 1], dots, indexing="ij")
    )
    white = whitener[camera][:, None, None] * np.eye(2)
    plate = (problem.target.plate_thickness_mm, problem.target.plate_index)
    return Observations(
        view, camera, dot, np.zeros((len(view), 2)), white, shift, plate,
        tuple(c.wall for c in problem.cameras),
    )  # fmt: skip


def _enough_seen(problem: Problem, state: State, found: Candidates) -> Bools:
    """(K,) whether both cameras see as many dots as images do so far, and all marks."""
    image = (2 * problem.view + problem.camera)[problem.weight > 0]
    counts = np.bincount(image)
    share = SEEN_SHARE * np.median(counts[counts > 0]) / len(problem.dot_ids)
    outer = _outermost(state.dots_mm[:, :2], OUTLINE_DOTS)
    marks = np.flatnonzero(problem.target.is_mark(problem.dot_ids))
    visible, _ = dots_seen(problem, state, found, np.r_[outer, marks])
    enough = visible[..., : len(outer)].mean(-1) >= share
    return np.asarray(np.all(enough, -1) & np.all(visible[..., len(outer) :], axis=(-1, -2)))


def _outermost(points_mm: Array, count: int) -> Ints:
    """Up to ``count`` points, each the farthest from those before it: the outline comes first."""
    chosen = [int(np.argmin(points_mm.sum(-1)))]
    distance = np.full(len(points_mm), np.inf)
    while len(chosen) < min(count, len(points_mm)):
        step = np.linalg.norm(points_mm - points_mm[chosen[-1]], axis=-1)
        distance = np.minimum(distance, step)
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)


def filled_cells(problem: Problem, camera: int, uv_px: Array) -> Bools:
    """(CELLS, CELLS) parts of the image, columns then rows, in which some of (N, 2) pixels lie."""
    size = np.array(problem.cameras[camera].image_size_px)
    cell = np.clip(np.floor((uv_px + 0.5) / size * CELLS), 0, CELLS - 1).astype(int)
    out = np.zeros((CELLS, CELLS), bool)
    out[cell[:, 0], cell[:, 1]] = True
    return out


def new_cells(problem: Problem, visible: Bools, uv_px: Array) -> Bools:
    """(2, CELLS, CELLS) parts of both images that no dot has reached yet, and one view would.

    visible : (2, n); uv_px : (2, n, 2), of that view.
    """
    out = []
    for c in (0, 1):
        mine = (problem.weight > 0.5) & (problem.camera == c)
        before = filled_cells(problem, c, problem.uv_px[mine])
        out.append(filled_cells(problem, c, uv_px[c][visible[c]]) & ~before)
    return np.array(out)
