"""Closed-form initialisation of a self-calibration: no guess but the nominal side of a camera.

Each image gives an affine (or local) map of the target plane, whose singular values are the scale
and the cosine of the tilt, up to the sign of the tilt. The signs come from the one inter-camera
rotation that fits all views, for each pair of cameras along a tree of cameras that share views;
`mirror_ambiguity` decides between the two mirror solutions.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np

from telerig.arrays import Array, Bools
from telerig.errors import CalibrationError
from telerig.estimator.calibration.solver.problem import Problem, nominal_state, on_a_line
from telerig.estimator.calibration.thresholds import LEAST_DOTS, STRONG_PERSPECTIVE
from telerig.estimator.dots.grid.lattice import apply_homography, fit_homography
from telerig.factors.calibration import State
from telerig.io.results.findings import Code
from telerig.rig.lens_parameters import INDEX
from telerig.rig.pose import nearest_rotation

NEAR_PARALLEL = float(np.sin(np.radians(Code.NEAR_PARALLEL.limit)))
"""Sine of the angle between two optical axes below which they are nearly parallel."""
_FOR_HOMOGRAPHY = 8
"""Dots of an image from which a homography is fitted to them: it needs four."""
_FLIP = np.array([1.0, 1.0, -1.0])
_MIRROR = np.outer(_FLIP, _FLIP)


@dataclass(frozen=True)
class ImageMap:
    """The map from the target's plane to one image, about the point that is seen in its centre.

    jacobian : (2, 2) px/mm.
    offset_px : (2,) offset of the target's origin from the image centre.
    perspective : (2,) relative change of the scale per mm along the target's x and y.
    misfit : RMS distance of the dots from the map, divided by the dots' spread.
    """

    jacobian: Array
    offset_px: Array
    perspective: Array
    misfit: float


def image_maps(problem: Problem, dots_mm: Array) -> dict[tuple[int, int], ImageMap]:
    """Return the maps by (view, camera) of images with four dots or more that are not in one row.

    dots_mm : (N, 3) positions of the target's dots.
    """
    out = {}
    for v in range(len(problem.views)):
        for c, camera in enumerate(problem.cameras):
            rows = (problem.view == v) & (problem.camera == c) & problem.kept
            seen = dots_mm[problem.dot[rows], :2]
            if len(seen) >= LEAST_DOTS and not on_a_line(seen):
                centre = (np.array(camera.image_size_px) - 1) / 2
                out[v, c] = _image_map(seen, problem.uv_px[rows] - centre)
    return out


def without_wrong_dots(problem: Problem, dots_mm: Array) -> Problem:
    """Return the problem with weight 0 for dots that are far from where most of their image are.

    A start is a least-squares fit, which a few wrong dots turn or decide. Those are left out that
    are ten times as far from the homography of their image as half of the dots, and 0.1 % of the
    dots' spread; strong distortion costs some sound ones, of the start alone. If they are more than
    a third of their image, nothing is left out: the others may be rows that fit by themselves.

    dots_mm : (N, 3) positions of the target's dots.
    """
    weight = problem.weight.copy()
    for v in range(len(problem.views)):
        for c in range(len(problem.cameras)):
            rows = np.flatnonzero((problem.view == v) & (problem.camera == c) & problem.kept)
            seen, uv = dots_mm[problem.dot[rows], :2], problem.uv_px[rows]
            near = _near_one_homography(seen, uv)
            few = len(seen) < _FOR_HOMOGRAPHY or 3 * np.sum(near) < 2 * len(near)
            if not few and not on_a_line(seen[near]):
                weight[rows[~near]] = 0.0
    return replace(problem, weight=weight)


def _near_one_homography(xy_mm: Array, uv_px: Array) -> Bools:
    """Return which dots (N,) are near the homography that half of them fit best.

    By the least median of squares (Rousseeuw, JASA 79:871, 1984), and a fit to what is near it.
    """
    near = np.ones(len(xy_mm), bool)
    if len(xy_mm) < _FOR_HOMOGRAPHY:
        return near
    homography, _ = cv2.findHomography(xy_mm, uv_px, cv2.LMEDS)
    spread = np.sqrt(((uv_px - uv_px.mean(0)) ** 2).sum(1).mean())
    for _ in range(2):
        if homography is None:
            break
        away = np.linalg.norm(uv_px - apply_homography(homography, xy_mm), axis=1)
        near = np.asarray(away <= max(10 * np.median(away), 1e-3 * spread))
        homography = fit_homography(xy_mm[near], uv_px[near])
    return near


def _image_map(xy_mm: Array, uv_px: Array) -> ImageMap:
    """Return an affine map, or the homography where that has less than half the squared misfit."""
    middle = xy_mm.mean(0)
    size = np.sqrt(((xy_mm - middle) ** 2).sum(1).mean())
    design = np.c_[(xy_mm - middle) / size, np.ones(len(xy_mm))]
    affine: Array = np.asarray(np.linalg.lstsq(design, uv_px, rcond=None)[0], np.float64)
    misfit = ((uv_px - design @ affine) ** 2).sum()
    bend = np.zeros(2)
    if len(xy_mm) >= _FOR_HOMOGRAPHY:
        homography = fit_homography(design[:, :2], uv_px)
        better = ((uv_px - apply_homography(homography, design[:, :2])) ** 2).sum()
        if better < 0.5 * misfit:
            homography = homography / homography[2, 2]
            affine, bend, misfit = homography[:2].T, homography[2, :2], better
    spread = max(((uv_px - uv_px.mean(0)) ** 2).sum(), 1e-12)
    # the target point imaged to the image centre: there the off-axis terms vanish
    at = np.linalg.solve(affine[:2].T, -affine[2]) if np.any(bend) else np.zeros(2)
    depth = 1 + at @ bend
    value = (affine[:2].T @ at + affine[2]) / depth
    jacobian = (affine[:2].T - np.outer(value, bend)) / depth / size
    offset = value - jacobian @ (middle + at * size)
    return ImageMap(jacobian, offset, bend / depth / size, float(np.sqrt(misfit / spread)))


def plate_sides(problem: Problem) -> list[Problem]:
    """Return the problem for either side of a two-sided plate that may carry the dots.

    In each, the views through the plate are marked as such. For other targets, and for a single
    camera, it is the problem as it is.
    """
    target = problem.target
    if not target.two_sided or target.plate_thickness_mm == 0 or len(problem.cameras) < 2:
        return [problem]
    hands = np.zeros((len(problem.views), len(problem.cameras)))
    for image, found in image_maps(problem, problem.nominal_mm).items():
        hands[image] = np.sign(np.linalg.det(found.jacobian))
    return [replace(problem, plate_shift=np.where(hands == h, -hands, 0.0)) for h in (1, -1)]


def rotation_from_jacobian(jacobian: Array) -> tuple[Array, float]:
    """Return the rotation camera_from_target (3, 3) and the scale (px/mm) that explain a map.

    jacobian : (2, 2) px/mm. The mirror image of the rotation explains the map equally well.
    """
    _, singular, vt = np.linalg.svd(jacobian)
    top = jacobian / singular[0]
    sine = np.sqrt(max(0.0, 1 - (singular[1] / singular[0]) ** 2))
    rotation = np.empty((3, 3))
    rotation[:2, :2] = top
    rotation[2, :2] = sine * vt[1]
    rotation[:, 2] = np.cross(rotation[:, 0], rotation[:, 1])
    return nearest_rotation(rotation), float(singular[0])


def mirrored(rotation: Array) -> Array:
    """Return rotations (..., 3, 3) in the mirror image of the scene, D R D with D = diag(1, 1, -1).

    A telecentric camera gives the same image of both.
    """
    return rotation * _MIRROR


def angle_between(a: Array, b: Array) -> Array:
    """Return the angles (...) in rad between rotations a and b (..., 3, 3)."""
    chord = np.linalg.norm(a - b, axis=(-2, -1)) / np.sqrt(8)
    return np.asarray(2 * np.arcsin(np.minimum(1.0, chord)))


def rotation_hypotheses(first: Array, second: Array, count: int = 3) -> list[Array]:
    """Return rotations (3, 3) second_from_first between two cameras, best first.

    In each view either rotation may be mirrored; a result is a rotation that one choice per view
    explains. The candidates of all views are tried and refined by averaging.

    first, second : (V, 3, 3) rotations camera_from_target, each up to its mirror image.
    count : largest number of results; none of them is the mirror image of another.
    """
    options = either_tilt(first, second)
    found: list[tuple[float, Array]] = []
    for candidate in np.concatenate(options[:2]):
        rotation, cost = refined(candidate, options)
        same = [
            min(angle_between(rotation, r), angle_between(mirrored(rotation), r)) for _, r in found
        ]
        if not same or min(same) > np.radians(3):
            found.append((cost, rotation))
    return [rotation for _, rotation in sorted(found, key=lambda x: x[0])[:count]]


def refined(rotation: Array, options: Array) -> tuple[Array, float]:
    """Return the rotation (3, 3) near a given one that one option of each view explains best.

    options : (K, V, 3, 3) the K rotations that are possible in each of V views.
    Returns also the mean squared angle in rad^2 to the nearest options, each at most 20 degrees.
    """
    cap = np.radians(20)
    for _ in range(5):
        angles = angle_between(options, rotation)
        choice = np.argmin(angles, 0)
        best = np.take_along_axis(options, choice[None, :, None, None], 0)[0]
        weight = 1 / (np.radians(1) ** 2 + angles.min(0) ** 2)
        rotation = nearest_rotation((weight[:, None, None] * best).sum(0))
    angles = np.minimum(angle_between(options, rotation).min(0), cap)
    return rotation, float((angles**2).mean())


def either_tilt(first: Array, second: Array) -> Array:
    """Return the rotations (4, ..., 3, 3) second_from_first for both signs of both tilts.

    first, second : (..., 3, 3) rotations camera_from_target, each up to its mirror image.
    """
    plain = second @ np.swapaxes(first, -1, -2)
    crossed = mirrored(second) @ np.swapaxes(first, -1, -2)
    return np.stack([plain, crossed, mirrored(plain), mirrored(crossed)])


def stereo_states(problem: Problem, dots_mm: Array, count: int = 2) -> list[State]:
    """Return starting states for any number of cameras, best first.

    The mirror image of each state is an equally good start; with one camera the sign of each view's
    tilt is arbitrary. dots_mm : (N, 3) positions of the dots. count : number of rotations that are
    tried for each pair of cameras. Raises CalibrationError if no chain of shared views connects all
    cameras.
    """
    maps = image_maps(problem, dots_mm)
    rotations = {k: rotation_from_jacobian(m.jacobian)[0] for k, m in maps.items()}
    states = []
    for cameras in _camera_rotations(rotations, problem, count):
        chosen, _ = _signs(rotations, cameras, problem)
        states.append(_assemble(problem, dots_mm, maps, chosen, cameras))
    return states


def _camera_rotations(
    rotations: dict[tuple[int, int], Array], problem: Problem, count: int
) -> list[Array]:
    """Return camera_from_rig (C, 3, 3) of every start worth trying, best first.

    Along a tree of cameras that share views, each pair has ``count`` rotations, and either may be
    mirrored. Views of three cameras rank the combinations; the best 2^(C - 1) are kept.
    """
    edges = overlap_tree(problem, set(rotations))
    hypotheses: list[list[Array]] = []
    for a, b in edges:
        both = [v for v in range(len(problem.views)) if {(v, a), (v, b)} <= set(rotations)]
        first = np.array([rotations[v, a] for v in both])
        second = np.array([rotations[v, b] for v in both])
        found = rotation_hypotheses(first, second, count)
        first_pair = not hypotheses
        hypotheses.append(found if first_pair else [*found, *(mirrored(r) for r in found)])
    out = []
    for choice in itertools.product(*hypotheses):
        cameras = np.tile(np.eye(3), (len(problem.cameras), 1, 1))
        for (a, b), b_from_a in zip(edges, choice):
            cameras[b] = b_from_a @ cameras[a] if a else b_from_a
        out.append(cameras)
    if len(edges) > 1:
        costs = [_signs(rotations, cameras, problem)[1] for cameras in out]
        out = [out[i] for i in np.argsort(costs, kind="stable")[: 2 ** len(edges)]]
    return out


def overlap_tree(problem: Problem, images: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the pairs (parent, child) of camera indices that connect all cameras to the first one.

    They form the tree of pairs that share most views. images : the (view, camera) that can be used.
    Raises CalibrationError if the cameras fall into groups without a common view.
    """
    count = len(problem.cameras)
    seen = np.zeros((len(problem.views), count))
    seen[tuple(np.array(sorted(images), int).reshape(-1, 2).T)] = 1
    shared = np.triu(seen.T @ seen, 1)
    if count == 1 or (count == 2 and shared[0, 1]):
        return [(0, 1)][: count - 1]
    from scipy.sparse import csr_matrix  # here, since two cameras do without
    from scipy.sparse.csgraph import (
        breadth_first_order,
        connected_components,
        minimum_spanning_tree,
    )

    groups, group = connected_components(csr_matrix(shared), directed=False)
    if groups > 1:
        names = [
            " and ".join(c.name for c, of in zip(problem.cameras, group) if of == g)
            for g in range(groups)
        ]
        raise CalibrationError(
            f"cameras {', and cameras '.join(names)} have no view in common, so the pose of one "
            "group relative to the other is not determined",
            todo="add views of the target that cameras of both groups see, each with "
            "4 dots or more",
        )
    tree = minimum_spanning_tree(csr_matrix(-shared))
    order, parent = breadth_first_order(tree, 0, directed=False)
    return [(int(parent[c]), int(c)) for c in order[1:]]


def _signs(
    rotations: dict[tuple[int, int], Array], cameras: Array, problem: Problem
) -> tuple[dict[int, Array], float]:
    """Return rig_from_target rotations with tilt signs that agree, and the squared angles' sum."""
    out, cost = {}, 0.0
    for v in range(len(problem.views)):
        seen = [c for c in range(len(cameras)) if (v, c) in rotations]
        if not seen:
            continue
        first, others = seen[0], seen[1:]
        back = cameras[first].T
        if not others:
            out[v] = back @ rotations[v, first] if first else rotations[v, first]
            continue
        best = np.inf
        for sign in (rotations[v, first], mirrored(rotations[v, first])):
            rotation = back @ sign if first else sign
            total, together = 0.0, rotation
            for c in others:
                either = [rotations[v, c], mirrored(rotations[v, c])]
                angles = [float(angle_between(cameras[c] @ rotation, y)) for y in either]
                nearest = int(np.argmin(angles))
                total += angles[nearest] ** 2
                together = together + cameras[c].T @ either[nearest]
            if total < best:
                best, out[v] = total, nearest_rotation(together)
        cost += best
    return out, cost


def _assemble(
    problem: Problem,
    dots_mm: Array,
    maps: dict[tuple[int, int], ImageMap],
    rotations: dict[int, Array],
    camera_from_rig: Array,
) -> State:
    """Return a state: scales, view positions and baselines that go with the rotations."""
    state = nominal_state(problem)
    intrinsics, views, cameras = (
        state.intrinsics.copy(), state.rig_from_target.copy(), state.rig_from_camera.copy(),
    )  # fmt: skip
    for c in range(len(problem.cameras)):
        scales = [rotation_from_jacobian(m.jacobian)[1] for (_, k), m in maps.items() if k == c]
        if scales:
            intrinsics[c, INDEX["scale_px_per_mm"]] = np.median(scales)
    scale = intrinsics[:, INDEX["scale_px_per_mm"]]
    for v, rotation in rotations.items():
        views[v, :3, :3] = rotation
    shifts = {k: m.offset_px / scale[k[1]] for k, m in maps.items()}
    baselines = _place_views(views, shifts, camera_from_rig)
    for c in range(1, len(cameras)):
        cameras[c, :3, :3] = camera_from_rig[c].T
        cameras[c, :3, 3] = -camera_from_rig[c].T @ np.r_[baselines[c], 0]
    start = State(intrinsics, cameras, views, dots_mm.copy())
    for c, camera in enumerate(problem.cameras):
        kappa = perspective_from_maps(maps, start, c)
        if abs(kappa) * camera.rho_mm > STRONG_PERSPECTIVE:
            intrinsics[c, INDEX["kappa_per_mm"]] = kappa
    if len(problem.cameras) == 2:
        kappas = intrinsics[:, INDEX["kappa_per_mm"]]
        parallel = np.linalg.norm(camera_from_rig[1][:2, 2]) < NEAR_PARALLEL
        if parallel and np.all(kappas != 0):
            _place_by_scales(start, maps, shifts)
    return start


def _place_by_scales(
    state: State, maps: dict[tuple[int, int], ImageMap], shifts: dict[tuple[int, int], Array]
) -> None:
    """Place views and the second camera by how large the target looks, in place (perspective)."""
    scale, kappa = (state.intrinsics[:, INDEX[n]] for n in ("scale_px_per_mm", "kappa_per_mm"))
    seen: dict[tuple[int, int], Array] = {}
    for (v, c), m in maps.items():
        enlarged = float(scale[c]) / rotation_from_jacobian(m.jacobian)[1]
        seen[v, c] = np.r_[shifts[v, c] * enlarged, (enlarged - 1.0) / kappa[c]]
    turn = state.rig_from_camera[1, :3, :3]
    both = [v for v in range(len(state.rig_from_target)) if (v, 0) in seen and (v, 1) in seen]
    base = np.median([seen[v, 0] - turn @ seen[v, 1] for v in both], axis=0)
    state.rig_from_camera[1, :3, 3] = base
    for v, c in seen:
        if c == 0 or (v, 0) not in seen:
            state.rig_from_target[v, :3, 3] = seen[v, 0] if c == 0 else base + turn @ seen[v, 1]


def perspective_from_maps(
    maps: dict[tuple[int, int], ImageMap], state: State, camera: int
) -> float:
    """Return a first estimate of a camera's kappa, the relative change of scale with depth in 1/mm.

    It is the weighted median over the views in which the target is tilted; 0 if none is.

    maps : homographies from the target's plane to the image, by (view, camera).
    state : the poses of cameras and targets.
    camera : index of the camera.
    """
    turn = state.rig_from_camera[camera, :3, :3].T
    kappas, weights = [], []
    for (v, c), m in maps.items():
        if c == camera:
            depth_slope = (turn @ state.rig_from_target[v, :3, :3])[2, :2]
            steepness = float(depth_slope @ depth_slope)
            kappas.append(float(m.perspective @ depth_slope) / max(steepness, 1e-12))
            weights.append(steepness)
    if not weights or sum(weights) == 0:
        return 0.0
    order = np.argsort(kappas)
    share = np.cumsum(np.array(weights)[order]) / sum(weights)
    return float(kappas[order[int(np.searchsorted(share, 0.5))]])


def origin_camera(camera_from_rig: Array) -> int:
    """Return the index of the camera whose axis fixes, with the first one's, the rig's origin.

    It is the second camera, unless its optical axis is nearly parallel to the first one's and that
    of a further camera is less so. camera_from_rig : (C, 3, 3).
    """
    sines = np.linalg.norm(camera_from_rig[:, :2, 2], axis=-1)
    return 1 if len(sines) < 3 or sines[1] > NEAR_PARALLEL else 1 + int(sines[1:].argmax())


def offset_freedom(camera_from_rig: Array) -> Array:
    """Return the offsets (C, 2, 2 C - 3) in mm of C telecentric cameras by each free number.

    The offset of the `origin_camera` along the image of the first axis is held at zero.
    camera_from_rig : (C, 3, 3). Of one camera no number is free.
    """
    count = len(camera_from_rig)
    if count == 1:
        return np.zeros((1, 2, 0))
    origin = origin_camera(camera_from_rig)
    along = camera_from_rig[origin][:2, 2] / np.linalg.norm(camera_from_rig[origin][:2, 2])
    freedom = np.zeros((count, 2, 2 * count - 3))
    freedom[origin, :, 0] = -along[1], along[0]
    others = [c for c in range(1, count) if c != origin]
    for at, c in enumerate(others):
        freedom[c, :, 2 * at + 1 : 2 * at + 3] = np.eye(2)
    return freedom


def _place_views(views: Array, shifts: dict[tuple[int, int], Array], cameras: Array) -> Array:
    """Write each view's translation; return the cameras' (C, 2) offsets, gauge-fixed.

    Along the image of the first axis in the `origin_camera` the offset is held at zero.
    """
    freedom = offset_freedom(cameras)
    at = 3 * len(views)
    design = np.zeros((len(shifts), 2, at + freedom.shape[-1]))
    for row, (v, c) in zip(design, shifts):
        row[:, 3 * v : 3 * v + 3] = cameras[c][:2]
        row[:, at:] = freedom[c]
    right = np.array(list(shifts.values())).ravel()
    found, *_ = np.linalg.lstsq(design.reshape(len(right), -1), right, rcond=1e-9)
    views[:, :3, 3] = found[:at].reshape(-1, 3)
    return np.asarray(freedom @ found[at:])
