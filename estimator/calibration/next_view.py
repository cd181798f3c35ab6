"""The next best view: how to hold the target so that the calibration gains most.

For every candidate pose the covariance that the calibration would have with that view is exact to
first order: the view's information, its own pose eliminated, joins the joint covariance of cameras
and dots (Haner and Heyden, Optimal view path planning for visual SLAM, SCIA 2011, choose views by
the same trace). What is minimised is the calibration's share of the variance of triangulated
points over the working volume. The candidates are a fixed table of poses: a search between its
entries was measured to gain 1 % more, less than a hand holding the target loses.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.calibration.solver.covariance import JointCovariance
from telerig.estimator.calibration.solver.gaussian import Estimate
from telerig.estimator.calibration.solver.print_stretch import stretch_sigma
from telerig.estimator.calibration.solver.problem import Problem, cameras_from_state
from telerig.estimator.calibration.thresholds import (
    ENOUGH_SHARE,
    PARALLEL_DEG,
    RECOMMENDED_VIEWS,
)
from telerig.factors.calibration import Observations, State, pixels, whitened_residuals
from telerig.io.results.calibration import NextPose
from telerig.rig.triangulation import aligned_shift, working_volume
from telerig.short_text import number

ALIKE_SHARE = 0.9
"""Among candidates with at least this share of the best gain, the one that fills most of the empty
parts of the images is taken."""


@dataclass(frozen=True)
class NextView:
    """Advice on the next view of the target.

    views : number of views so far.
    before_um : standard deviation per axis of points over the working volume, due to the
        calibration and without a rigid motion that is common to all points.
    poses : ways to hold the target, the best first; none if two cameras see none of the candidates.
    size_um : the part of before_um that no view can lower, because the size of the target is not
        known better.
    marks : ids of the target's marks.
    """

    views: int
    before_um: float
    poses: tuple[NextPose, ...]
    size_um: float = 0.0
    marks: tuple[int, ...] = ()

    @property
    def after_um(self) -> float:
        """Return what ``before_um`` becomes with the best pose."""
        return self.poses[0].after_um if self.poses else self.before_um

    @property
    def gain(self) -> float:
        """Return the share by which the best view lowers the standard deviation."""
        return 1 - self.after_um / self.before_um

    def enough(self) -> bool:
        """Return whether there are enough views and one more would lower the errors only little."""
        many = self.views >= RECOMMENDED_VIEWS
        return many and bool(self.poses) and self.gain < ENOUGH_SHARE

    def verdict(self) -> str:
        """Return a sentence on how much one more view would reduce the errors."""
        if not self.poses:
            good = number(self.before_um, 2)
            return (
                f"{self.views} views; the calibration's share of the errors of points is {good} "
                "µm; no further pose was found in which two cameras see the target"
            )
        worth = ": these views are enough" if self.enough() else ""
        both = self.before_um, self.after_um
        digits = 2 if number(both[0], 2) != number(both[1], 2) else 3
        before, after = (number(um, digits) for um in both)
        return (
            f"{self.views} views; one more would reduce the calibration's share of the errors of "
            f"points from {before} to {after} µm{self._floor(digits)}{worth}"
        )

    def _floor(self, digits: int) -> str:
        if 2 * self.size_um**2 < self.before_um**2:
            return ""
        return (
            f" ({number(self.size_um, digits)} µm remain with any number of views, because the "
            "target's size is not known better)"
        )

    def words(self) -> str:
        """Return the verdict and, if one more view is worthwhile, how to hold the target."""
        if not self.poses or self.enough():
            return self.verdict()
        best = self.poses[0]
        because = f" ({'; '.join(best.reasons)})" if best.reasons else ""
        return f"{self.verdict()}. Next: {best.words}{because}"

    def as_dict(self) -> dict[str, Any]:
        """Return the content for `Calibration.diagnostics`."""
        return {
            "words": self.words(), "verdict": self.verdict(), "views": self.views,
            "before_um": self.before_um, "after_um": self.after_um, "enough": self.enough(),
            "size_um": self.size_um, "marks": list(self.marks),
            "poses": [
                p.content() | {"rig_from_target": np.round(p.rig_from_target, 6).tolist()}
                for p in self.poses
            ],
        }  # fmt: skip


def next_view(problem: Problem, state: State, joint: JointCovariance) -> NextView | None:
    """Return the best ways to hold the target next.

    joint : covariance of the calibration with the views so far. The noise of a new view is taken as
    the median of the dots so far. If the target has many dots, some of them represent all, so that
    the predicted gain is slightly too small.
    Returns None for a single camera, or if the covariance is not finite.
    """
    if len(problem.cameras) < 2 or not np.isfinite(joint.rig_block()[1]).all():
        return None
    some = spread_dots(problem)
    gain = ViewGain.of(problem, state, joint, some)
    kept = problem.kept
    images = np.unique(np.stack([problem.view[kept], problem.camera[kept]], 1), axis=0)
    views = int((np.bincount(images[:, 0]) > 1).sum())
    found = candidates(problem, state)
    if not len(found):
        return NextView(views, gain.before_um, (), gain.size_um)
    after_um = gain.after_um(found, some)
    best = _preferred(problem, state, found, gain.before_um - after_um, some)
    chosen = found.some(best)
    poses = tuple(
        NextPose(
            words=hold_words(problem, state, chosen.some(slice(i, i + 1))),
            reasons=reason_words(problem, state, chosen.some(slice(i, i + 1))),
            after_um=float(after_um[k]),
            rig_from_target=chosen.rig_from_target[i],
        )
        for i, k in enumerate(best)
    )
    marks = problem.dot_ids[problem.target.is_mark(problem.dot_ids)]
    return NextView(views, gain.before_um, poses, gain.size_um, tuple(int(m) for m in marks))


def _preferred(
    problem: Problem, state: State, found: Candidates, gained_um: Array, dots: Ints
) -> Ints:
    """Return up to three candidates of different tilts, the best first.

    The lens model may lack what acts where no dot has been: among those nearly as good, the one
    that fills most of the empty image is preferred.
    """
    order = np.argsort(-gained_um, kind="stable")
    alike = order[gained_um[order] >= ALIKE_SHARE * gained_um[order[0]]]
    seen = dots_seen(problem, state, found.some(alike), dots)
    fills = np.array([new_cells(problem, v, uv).sum() for v, uv in zip(*seen)])
    ranked = np.r_[alike[np.argsort(-fills, kind="stable")], order[len(alike) :]]
    _, first = np.unique(found.tilt[ranked], return_index=True)
    return np.asarray(ranked[np.sort(first)[:3]])


TILT_LIMIT_DEG = 62.0
"""Largest angle between the plate's normal and a camera's axis: with more, a dot is too flat an
ellipse to be found safely."""
TURNS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
"""Angles by which candidates turn the plate's normal away from the middle between two cameras."""
ROLLS_DEG = (0.0, 45.0, 90.0, 135.0)
PLACES = np.array([(0.0, 0.0, 0.0), *product((-1.0, 1.0), repeat=3)])
"""Places of the target's middle: the middle of the volume and the corners of a cube round it."""
PLACE_SHARE = 0.2
"""Half the side of this cube, as a share of the smallest field of view."""
BORDER_SHARE = 0.03
SEEN_SHARE = 0.9
"""A candidate must show at least this share of the dots that an image shows so far (median), in two
cameras."""
CELLS = 6
"""An image is divided into this many parts along u and along v, to see where no dot has been."""
_EDGE_ON = 0.1


@dataclass(frozen=True)
class Candidates:
    """K poses of the target, each of which at least two of the C cameras see.

    rig_from_target : (K, 4, 4).
    tilt : (K,) index of the direction of the plate's normal.
    facing : (K, C) +1 if the side of negative z faces the camera, else -1.
    sees : (K, C) whether side and tilt let the camera see the target.
    pair : (K, 2) indices of the two cameras between which the plate is held.
    """

    rig_from_target: Array
    facing: Array
    tilt: Ints
    sees: Bools
    pair: Ints

    def __len__(self) -> int:
        return len(self.tilt)

    def some(self, index: Ints | Bools | slice) -> Candidates:
        """Return the candidates with these indices."""
        return Candidates(
            self.rig_from_target[index], self.facing[index], self.tilt[index], self.sees[index],
            self.pair[index],
        )  # fmt: skip


def candidates(problem: Problem, state: State) -> Candidates:
    """Return every pose in which two cameras see enough of the target, marks included."""
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
    """Return the middle (3,) of the dots in the target's frame."""
    return np.asarray((state.dots_mm.min(0) + state.dots_mm.max(0)) / 2)


def field_mm(problem: Problem) -> float:
    """Return the smallest side of all cameras' fields of view, in mm in object space."""
    return float(min(min(c.image_size_px) / c["scale_px_per_mm"] for c in problem.cameras))


def volume_centre_mm(problem: Problem, state: State) -> Array:
    """Return the middle (3,) of the volume in which the target is held, in the rig frame.

    It is the origin of the rig frame, or the mean position of the target so far if this is far from
    the origin.
    """
    seen = np.unique(problem.view[problem.kept])
    poses = state.rig_from_target[seen]
    mean = np.mean(poses[:, :3, :3] @ middle_mm(state) + poses[:, :3, 3], 0)
    return mean if np.linalg.norm(mean) > field_mm(problem) / 2 else np.zeros(3)


def optical_axes(state: State) -> Array:
    """Return the optical axes (C, 3) in the rig frame, away from the cameras."""
    return np.asarray(state.rig_from_camera[:, :3, 2])


def bases(axes: Array, facing: Array) -> tuple[Array, Array, Array]:
    """Return three orthonormal vectors (3,) for two cameras.

    axes : (2, 3) optical axes. facing : (2,) as in `Candidates`.
    The first vector is the z axis of a plate at the same angle to both cameras, the second lies in
    the plane of both optical axes, and the third is perpendicular to this plane.
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
    """Return the plate's z in the rig (T, 3), and `Candidates.facing`, ``sees`` and ``pair``."""
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
                for way in 2 * np.pi * np.arange(len(_WAYS) if turn else 1) / len(_WAYS):
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
    """Return the side (C,) that each camera has seen most: +1 that of negative z, else -1."""
    used = problem.kept
    signs = np.sign(np.einsum("ci,vi->vc", optical_axes(state), state.rig_from_target[:, :3, 2]))
    cameras = range(len(problem.cameras))
    total = [signs[problem.view[used & (problem.camera == c)], c].sum() for c in cameras]
    return np.where(np.array(total) < 0, -1.0, 1.0)


def _rotations(normal: Array, roll_rad: Array) -> Array:
    """Return (K, 3, 3) with z the normal and, before the roll, x as near to the rig's as can be."""
    start = np.where(np.abs(normal[:, :1]) < 0.95, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    x = start - normal * np.sum(start * normal, -1, keepdims=True)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    y = np.cross(normal, x)
    cosine, sine = np.cos(roll_rad)[:, None], np.sin(roll_rad)[:, None]
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, normal], -1)


def predicted(
    problem: Problem, state: State, poses: Candidates, dots: Ints, whitener: Array
) -> tuple[State, Observations]:
    """Return the state and the observations of K new views, without measured pixels.

    poses : of the target in the new views.
    dots : (n,) indices of the dots, which all C cameras observe.
    whitener : (C,) reciprocal of the standard deviation of a pixel, in 1/px.
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
    """Return the shift (K, C) through the plate where views so far see this side through it."""
    shifts = problem.plate_shift[problem.plate_shift != 0]
    if not len(shifts):
        return np.zeros_like(facing)
    return np.where(facing == -shifts[0], shifts[0], 0.0)


def dots_seen(problem: Problem, state: State, poses: Candidates, dots: Ints) -> tuple[Bools, Array]:
    """Return which of n dots each of C cameras would see in K poses of the target.

    dots : (n,) indices. Returns booleans (K, C, n) and the dots' pixels (K, C, n, 2).
    """
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


def spread_dots(problem: Problem, count: int = 25) -> Ints:
    """Return the indices of up to ``count`` dots, evenly spread over the list of all dots."""
    whole = len(problem.dot_ids)
    return np.unique(np.linspace(0, whole - 1, min(count, whole)).round().astype(np.int64))


def _enough_seen(problem: Problem, state: State, poses: Candidates) -> Bools:
    """Return (K,) whether the pair of cameras sees as many dots as images so far, and all marks."""
    image = (len(problem.cameras) * problem.view + problem.camera)[problem.kept]
    counts = np.bincount(image)
    share = SEEN_SHARE * np.median(counts[counts > 0]) / len(problem.dot_ids)
    some = spread_dots(problem)
    marks = np.flatnonzero(problem.target.is_mark(problem.dot_ids))
    visible, _ = dots_seen(problem, state, poses, np.r_[some, marks])
    visible = np.take_along_axis(visible, poses.pair[..., None], 1)
    enough = visible[..., : len(some)].mean(-1) >= share
    return np.asarray(np.all(enough, -1) & np.all(visible[..., len(some) :], axis=(-1, -2)))


def new_cells(problem: Problem, visible: Bools, uv_px: Array) -> Bools:
    """Return which parts of the images a new view would be the first to fill.

    visible : (C, n) which of n dots each camera sees. uv_px : (C, n, 2) their pixels.
    Returns booleans (C, CELLS, CELLS), by column and row of the parts.
    """
    out = []
    for c, camera in enumerate(problem.cameras):
        edges = [np.linspace(-0.5, size - 0.5, CELLS + 1) for size in camera.image_size_px]
        mine = problem.kept & (problem.camera == c)
        before, then = (
            np.histogram2d(uv[:, 0], uv[:, 1], bins=edges)[0] > 0
            for uv in (problem.uv_px[mine], uv_px[c][visible[c]])
        )
        out.append(then & ~before)
    return np.array(out)


@dataclass(frozen=True)
class ViewGain:
    """Computes by how much further views would lower the uncertainty of points in space.

    now : the errors of the P parameters of the cameras and of n dots (3 n).
    dots : (n,) sorted indices of these dots.
    root : (P, R); the trace of root^T C root is the summed variance of points in space if the
        cameras' parameters have the covariance C.
    whitener : (C,) for each camera the reciprocal of the standard deviation of a pixel, in 1/px.
    points_mm : the points over the working volume, (N, 3).
    """

    problem: Problem
    state: State
    now: Estimate
    dots: Ints
    root: Array
    whitener: Array
    points_mm: Array

    @staticmethod
    def of(problem: Problem, state: State, joint: JointCovariance, dots: Ints) -> ViewGain:
        """Return the gain of views from the covariance of a calibration.

        dots : indices of the dots of the target that the views may show.
        """
        cameras = cameras_from_state(problem, state)
        points = working_volume(cameras)
        shift = aligned_shift(cameras, problem.free, points)
        covariance, dots = joint.of_rig_and(np.unique(dots)), np.unique(dots)
        now = Estimate(np.zeros(len(covariance)), covariance)
        triangle = np.asarray(np.linalg.qr(shift, mode="r")).T
        noise = [_noise_px(problem, c) for c in range(len(cameras))]
        return ViewGain(problem, state, now, dots, triangle, 1 / np.array(noise), points)

    @property
    def before_um(self) -> float:
        """Return the standard deviation per axis of points, in µm, with the views so far."""
        return float(self._um(np.zeros(1))[0])

    @property
    def size_um(self) -> float:
        """Standard deviation per axis of points, in µm, that the uncertainty of the target's size
        alone causes. It scales all points by a common factor.
        """
        problem = self.problem
        plane = ((problem.nominal_mm - problem.middle_mm) / problem.dot_sigma_mm)[:, :2]
        known = 1 / (1 / float((plane**2).sum()) + stretch_sigma(problem) ** 2)
        if problem.scale is not None:
            known += (problem.scale[1] / problem.scale[2]) ** 2
        spread = (self.points_mm - self.points_mm.mean(0)).std()
        return float(1e3 * spread / np.sqrt(known))

    def _um(self, less: Array) -> Array:
        rig = len(self.root)
        whole = np.sum((self.now.covariance[:rig, :rig] @ self.root) * self.root)
        return np.asarray(1e3 * np.sqrt(np.maximum(whole - less, 0) / self.points_mm.size))

    def after_um(self, poses: Candidates, dots: Ints) -> Array:
        """Return the standard deviation (K,) per axis, in µm, of points after each of K views.

        Each view is added alone, its pose projected out. dots : indices of the dots that it shows.
        """
        rows, by_pose = self._rows(poses, dots)
        rig = len(self.root)
        place = rig + (3 * np.searchsorted(self.dots, dots)[:, None] + np.arange(3)).ravel()
        index = np.r_[np.arange(rig), place]
        basis, _ = np.linalg.qr(by_pose)
        rows = rows - basis @ (basis.mT @ rows)
        of_points = np.zeros((len(index), self.root.shape[1]))
        of_points[:rig] = self.root
        some = Estimate(self.now.value[index], self.now.covariance[np.ix_(index, index)])
        return self._um(some.saved_by(rows, of_points))

    def _rows(self, poses: Candidates, dots: Ints) -> tuple[Array, Array]:
        """Return whitened derivatives of K views by rig and dots (K, 2 C n, P + 3 n) and pose."""
        count, problem, rig = len(self.problem.cameras), self.problem, len(self.root)
        stand_for = np.sqrt(len(problem.dot_ids) / len(dots))
        state, obs = predicted(problem, self.state, poses, dots, stand_for * self.whitener)
        visible, _ = dots_seen(problem, self.state, poses, dots)
        obs.whitener[~visible.ravel()] = 0.0
        found = whitened_residuals(state, obs, problem.rho_mm)
        shape = (len(poses), count, len(dots), 2)
        rows = np.zeros((*shape, rig + 3 * len(dots)))
        by_intrinsics = found.by_intrinsics.reshape(*shape, -1)
        at = 0
        for c in range(count):
            free = problem.free_indices(c)
            rows[:, c, ..., at : at + len(free)] = by_intrinsics[:, c][..., free]
            at += len(free)
        by_camera = found.by_camera.reshape(*shape, 6)
        for c in range(1, count):
            rows[:, c, ..., at : at + 6] = by_camera[:, c]
            at += 6
        by_dot = found.by_dot.reshape(*shape, 3)
        for i, start in enumerate(range(rig, rows.shape[-1], 3)):
            rows[:, :, i, :, start : start + 3] = by_dot[:, :, i]
        by_view = found.by_view.reshape(len(poses), -1, 6)
        return rows.reshape(len(poses), 2 * count * len(dots), -1), by_view


def _noise_px(problem: Problem, camera: int) -> float:
    kept = problem.kept & (problem.camera == camera)
    rows = problem.covariance_px2[kept if kept.any() else slice(None)]
    return float(np.sqrt(np.median(np.trace(rows, axis1=-2, axis2=-1)) / 2))


_WAYS = ("to the right", "to the lower right", "down", "to the lower left",
         "to the left", "to the upper left", "up", "to the upper right")  # fmt: skip


def hold_words(problem: Problem, state: State, one: Candidates) -> str:
    """Return in words how to hold the target in a pose: turn, lean, roll and place.

    They are relative to the pair of cameras between which the target is held.
    """
    pair, rig_from_target = one.pair[0], one.rig_from_target[0]
    axes, facing = optical_axes(state)[pair], one.facing[0][pair]
    alike, along, across = bases(axes, facing)
    first, second = (problem.cameras[c].name for c in pair)
    # the side that the first camera sees looks against its axis
    looks = -facing[0] * rig_from_target[:3, 2]
    middle = -facing[0] * alike
    to_first = -axes[0] - (-axes[0] @ middle) * middle
    to_first = to_first / max(np.linalg.norm(to_first), 1e-9)
    if np.linalg.norm(np.cross(axes[0], axes[1])) < _EDGE_ON:
        to_first = along
    turn = np.degrees(np.arctan2(looks @ to_first, looks @ middle))
    upright = abs(across[1]) >= abs(across[0])
    across = across * np.sign(-across[1] if upright else across[0])
    lean = np.degrees(np.arcsin(np.clip(looks @ across, -1, 1)))
    parts = [_start_words(problem, facing, (first, second))]
    if abs(turn) >= PARALLEL_DEG:
        way = "towards" if facing[0] == facing[1] else "squarer to"
        parts.append(
            f"turn it {abs(turn):.0f} degrees {way} camera {first if turn > 0 else second}"
        )
    if abs(lean) >= PARALLEL_DEG:
        edge = "top" if upright else "right edge"
        parts.append(f"tilt its {edge} {abs(lean):.0f} degrees {'back' if lean > 0 else 'forward'}")
    parts.append(_roll_words(problem, rig_from_target))
    parts.append(_place_words(problem, state, rig_from_target))
    return ", ".join(parts)


def _start_words(problem: Problem, facing: Array, pair: tuple[str, str]) -> str:
    first, second = pair
    side = {1.0: "front", -1.0: "back"}
    if facing[0] != facing[1]:
        return (
            f"hold the plate with its {side[facing[0]]} towards camera {first} and its "
            f"{side[facing[1]]} towards camera {second}, at the same angle to both cameras"
        )
    between = "the cameras"
    if len(problem.cameras) > 2:
        between = f"cameras {first} and {second}"
    which = f"'s {side[facing[0]]}" if problem.target.two_sided else ""
    return f"face the plate{which} midway between {between}"


def _roll_words(problem: Problem, rig_from_target: Array) -> str:
    """Return words on where the first row points in the first camera's image."""
    u, v = -rig_from_target[:2, 1]
    way = _WAYS[int(np.round(np.arctan2(v, u) / (np.pi / 4))) % 8]
    if problem.target.layout == "points":
        return f"its smaller y {way}"
    return f"row 0 {way}"


def _place_words(problem: Problem, state: State, rig_from_target: Array) -> str:
    place = rig_from_target[:3, :3] @ middle_mm(state) + rig_from_target[:3, 3]
    x, y, z = place - volume_centre_mm(problem, state)
    camera = problem.cameras[0].name
    parts = [
        f"{abs(value):.0f} mm {ways[int(value > 0)]}"
        for value, ways in (
            (y, ("above", "below")), (x, ("left of", "right of")), (z, ("nearer than", "beyond")),
        )
        if round(value)
    ]  # fmt: skip
    if not parts:
        return "its middle in the middle of the field"
    joined = parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]
    return f"its middle {joined} the middle of the field as camera {camera} sees it"


def reason_words(problem: Problem, state: State, one: Candidates) -> tuple[str, ...]:
    """Return phrases on what a pose adds to the views so far: a tilt, filled parts of an image."""
    out = []
    seen = np.unique(problem.view[problem.kept])
    cosine = np.abs(optical_axes(state) @ state.rig_from_target[seen, :3, 2].T)
    then = np.abs(optical_axes(state) @ one.rig_from_target[0, :3, 2])
    visible, uv = dots_seen(problem, state, one, np.arange(len(state.dots_mm)))
    new = new_cells(problem, visible[0], uv[0])
    for c, camera in enumerate(problem.cameras):
        most, tilt = (float(np.degrees(np.arccos(np.clip(v, 0, 1)))) for v in
                      (cosine[c].min(), then[c]))  # fmt: skip
        if one.sees[0, c] and tilt > most + PARALLEL_DEG:
            out.append(
                f"a tilt of {tilt:.0f} degrees to camera {camera.name}, so far {most:.0f} at most"
            )
        if new[c].any():
            out.append(f"fills {_where(new[c])} of camera {camera.name}'s image")
    return tuple(out)


def _where(cells: Array) -> str:
    """Return words on the empty parts (columns, rows) that are filled."""
    near, far = slice(0, CELLS // 3), slice(-(CELLS // 3), None)
    names = [
        f"{upper} {left}"
        for v, upper in ((near, "upper"), (far, "lower"))
        for u, left in ((near, "left"), (far, "right"))
        if cells[u, v].any()
    ]
    if not names:
        return "empty parts"
    return "the empty " + " and ".join(names)


def first_views(
    first: str, second: str, angle_deg: float, *, alone: bool = True
) -> tuple[str, ...]:
    """Return instructions for the first views, which are needed before any calibration.

    first, second : names of two cameras.
    angle_deg : angle between their axes.
    alone : whether the rig has no further cameras.
    """
    between = "the cameras" if alone else f"cameras {first} and {second}"
    turn = max(0, min(20, int(TILT_LIMIT_DEG - angle_deg / 2 - 5) // 5 * 5))
    aside = {
        c: f"turn it {turn} degrees towards camera {c}, " if turn else "" for c in (first, second)
    }
    start = f"face the plate midway between {between}, "
    return (
        start + "its middle in the middle of the field",
        start + "tilt its top 30 degrees back, hold it towards the upper left",
        start + "tilt its top 30 degrees forward, roll it a quarter turn, towards the lower right",
        start + aside[first] + "hold it towards the lower left, nearer",
        start + aside[second] + "roll it half a turn, towards the upper right, farther away",
        start + aside[first] + "tilt its top 40 degrees back, roll it by 45 degrees",
    )
