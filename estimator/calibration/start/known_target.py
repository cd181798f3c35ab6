"""Closed-form initialisation of a self-calibration: no guess but the nominal side of a camera.

Each image gives an affine (or local) map of the target plane, whose singular values are the scale
and the cosine of the tilt, up to the sign of the tilt. The signs come from the one inter-camera
rotation that fits all views; `mirror_ambiguity` decides between the two mirror solutions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.solver.problem import Problem, nominal_state
from telerig.estimator.dots.grid.lattice import apply_homography, fit_homography
from telerig.factors.projection import State
from telerig.rig.pose import nearest_rotation
from telerig.rig.projection import INDEX

Array = NDArray[np.float64]
STRONG_PERSPECTIVE = 0.01
"""kappa * rho above which the start takes the perspective that the views show."""
_FLIP = np.array([1.0, 1.0, -1.0])
_MIRROR = np.outer(_FLIP, _FLIP)


@dataclass(frozen=True)
class ImageMap:
    """The map of the target's plane in one image, at the point imaged to the image centre.

    jacobian : (2, 2) px/mm; offset_px : (2,) pixels of the target origin minus the image centre;
    perspective : (2,) relative change of scale per mm of the target's x and y (0 if affine);
    misfit : RMS distance of the dots from the map, over their RMS distance from their mean.
    """

    jacobian: Array
    offset_px: Array
    perspective: Array
    misfit: float


def image_maps(problem: Problem, dots_mm: Array) -> dict[tuple[int, int], ImageMap]:
    """The map of every image that has at least four dots, keyed by (view, camera)."""
    out = {}
    for v in range(len(problem.views)):
        for c, camera in enumerate(problem.cameras):
            rows = (problem.view == v) & (problem.camera == c) & (problem.weight > 0)
            if np.sum(rows) >= 4:
                centre = (np.array(camera.image_size_px) - 1) / 2
                out[v, c] = _image_map(dots_mm[problem.dot[rows], :2], problem.uv_px[rows] - centre)
    return out


def _image_map(xy_mm: Array, uv_px: Array) -> ImageMap:
    """Affine map, or the homography where it fits better by far more than its two parameters."""
    middle = xy_mm.mean(0)
    size = np.sqrt(((xy_mm - middle) ** 2).sum(1).mean())
    design = np.c_[(xy_mm - middle) / size, np.ones(len(xy_mm))]
    affine: Array = np.asarray(np.linalg.lstsq(design, uv_px, rcond=None)[0], np.float64)
    misfit = ((uv_px - design @ affine) ** 2).sum()
    bend = np.zeros(2)
    if len(xy_mm) >= 8:
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


def rotation_from_jacobian(jacobian: Array) -> tuple[Array, float]:
    """(2, 2) map -> (3, 3) camera_from_target up to its mirror image, and the scale in px/mm."""
    _, singular, vt = np.linalg.svd(jacobian)
    top = jacobian / singular[0]
    sine = np.sqrt(max(0.0, 1 - (singular[1] / singular[0]) ** 2))
    rotation = np.empty((3, 3))
    rotation[:2, :2] = top
    rotation[2, :2] = sine * vt[1]
    rotation[:, 2] = np.cross(rotation[:, 0], rotation[:, 1])
    return nearest_rotation(rotation), float(singular[0])


def mirrored(rotation: Array) -> Array:
    """(..., 3, 3) D R D: the rotation in the mirrored solution."""
    return rotation * _MIRROR


def angle_between(a: Array, b: Array) -> Array:
    """(...,) angle of a^T b in radians."""
    chord = np.linalg.norm(a - b, axis=(-2, -1)) / np.sqrt(8)
    return np.asarray(2 * np.arcsin(np.minimum(1.0, chord)))


def rotation_hypotheses(first: Array, second: Array, count: int = 3) -> list[Array]:
    """Inter-camera rotations second_from_first that one choice of signs per view can explain.

    first, second : (V, 3, 3) camera_from_target, each up to its own mirror image. The best
    ``count`` hypotheses, best first, none the mirror image of another (both explain the same). Each
    pair of candidates of every view is tried and refined by averaging.
    """
    plain = second @ np.swapaxes(first, -1, -2)
    crossed = mirrored(second) @ np.swapaxes(first, -1, -2)
    candidates = np.concatenate([plain, crossed])
    found: list[tuple[float, Array]] = []
    for candidate in candidates:
        rotation, cost = _refined(candidate, plain, crossed)
        same = [
            min(angle_between(rotation, r), angle_between(mirrored(rotation), r)) for _, r in found
        ]
        if not same or min(same) > np.radians(3):
            found.append((cost, rotation))
    return [rotation for _, rotation in sorted(found, key=lambda x: x[0])[:count]]


def _refined(rotation: Array, plain: Array, crossed: Array) -> tuple[Array, float]:
    options = np.stack([plain, crossed, mirrored(plain), mirrored(crossed)])
    cap = np.radians(20)
    for _ in range(5):
        angles = angle_between(options, rotation)
        choice = np.argmin(angles, 0)
        best = np.take_along_axis(options, choice[None, :, None, None], 0)[0]
        weight = 1 / (np.radians(1) ** 2 + angles.min(0) ** 2)
        rotation = nearest_rotation((weight[:, None, None] * best).sum(0))
    angles = np.minimum(angle_between(options, rotation).min(0), cap)
    return rotation, float((angles**2).mean())


def stereo_states(problem: Problem, dots_mm: Array, count: int = 2) -> list[State]:
    """Starting states of a stereo problem, best first; which mirror solution each is, is open."""
    maps = image_maps(problem, dots_mm)
    both = [v for v in range(len(problem.views)) if (v, 0) in maps and (v, 1) in maps]
    rotations = {k: rotation_from_jacobian(m.jacobian)[0] for k, m in maps.items()}
    first = np.array([rotations[v, 0] for v in both])
    second = np.array([rotations[v, 1] for v in both])
    states = []
    for second_from_first in rotation_hypotheses(first, second, count):
        chosen = _signs(rotations, second_from_first, problem)
        states.append(_assemble(problem, dots_mm, maps, chosen, second_from_first))
    return states


def _signs(
    rotations: dict[tuple[int, int], Array], second_from_first: Array, problem: Problem
) -> dict[int, Array]:
    """rig_from_target rotation of each view, with the tilt signs that agree with both cameras."""
    out = {}
    for v in range(len(problem.views)):
        a, b = rotations.get((v, 0)), rotations.get((v, 1))
        if a is None and b is None:
            continue
        if a is None or b is None:
            out[v] = second_from_first.T @ b if b is not None else rotations[v, 0]
            continue
        left = [a, mirrored(a)]
        pairs = [(second_from_first @ x, y, x) for x in left for y in (b, mirrored(b))]
        agreed = min(pairs, key=lambda p: float(angle_between(p[0], p[1])))
        back = second_from_first.T @ agreed[1]
        out[v] = nearest_rotation(agreed[2] + back)
    return out


def mono_state(problem: Problem, dots_mm: Array) -> State:
    """The starting state of a single camera: the sign of each view's tilt is arbitrary."""
    maps = image_maps(problem, dots_mm)
    chosen = {v: rotation_from_jacobian(m.jacobian)[0] for (v, _), m in maps.items()}
    return _assemble(problem, dots_mm, maps, chosen, None)


def _assemble(
    problem: Problem,
    dots_mm: Array,
    maps: dict[tuple[int, int], ImageMap],
    rotations: dict[int, Array],
    second_from_first: Array | None,
) -> State:
    """Scales, view positions and baseline that go with the rotations."""
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
    if second_from_first is None:
        for (v, _), shift in shifts.items():
            views[v, :2, 3] = shift
    else:
        baseline = _place_views(views, shifts, second_from_first)
        cameras[1, :3, :3] = second_from_first.T
        cameras[1, :3, 3] = -second_from_first.T @ np.r_[baseline, 0]
    start = State(intrinsics, cameras, views, dots_mm.copy())
    for c, camera in enumerate(problem.cameras):
        kappa = perspective_from_maps(maps, start, c)
        if abs(kappa) * camera.rho_mm > STRONG_PERSPECTIVE:
            intrinsics[c, INDEX["kappa_per_mm"]] = kappa
    return start


def perspective_from_maps(
    maps: dict[tuple[int, int], ImageMap], state: State, camera: int
) -> float:
    """kappa of one camera (1/mm) from how the scale changes over each tilted view.

    The weighted median over the views, so that one with wrong dots does not decide.
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


def _place_views(
    views: Array, shifts: dict[tuple[int, int], Array], second_from_first: Array
) -> Array:
    """Write each view's translation; return the second camera's (2,) offset, gauge-fixed.

    Along the image of the first axis in the second camera the offset trades with every depth and
    is held at zero; across it, it is the mean disagreement.
    """
    along = second_from_first[:2, 2]
    length = np.linalg.norm(along)
    along = along / length
    across = np.array([-along[1], along[0]])
    both = [v for v in range(len(views)) if (v, 0) in shifts and (v, 1) in shifts]
    gap = {v: shifts[v, 1] - second_from_first[:2, :2] @ shifts[v, 0] for v in both}
    offset = float(np.median([g @ across for g in gap.values()])) if both else 0.0
    for v in range(len(views)):
        if (v, 0) in shifts:
            depth = gap[v] @ along / length if v in gap else 0.0
            views[v, :3, 3] = np.r_[shifts[v, 0], depth]
        elif (v, 1) in shifts:
            views[v, :3, 3] = second_from_first.T @ np.r_[shifts[v, 1] - offset * across, 0]
    return offset * across
