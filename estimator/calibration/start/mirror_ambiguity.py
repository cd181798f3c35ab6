"""The mirror ambiguity: two rigs, mirror images of each other in depth, give the same pixels.

What decides between them: the nominal rotations of the cameras, the sign of strong perspective
(farther dots are smaller), or the refraction in a two-sided plate. Of three cameras or more, where
no view is seen by three at once, each pair has mirror images of its own, which only the relief of
the dots and the nominal rotations tell apart: `consistent_start` decides them together.

A view that one telecentric camera sees alone has a mirror image of its own: the sign of its tilt
must agree with the relief of the dots (how far they are from a plane) that the other views show.
`with_tilt_signs` decides it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Ints
from telerig.errors import CalibrationError
from telerig.estimator.calibration.solver.problem import HELD_MM, Problem
from telerig.estimator.calibration.solver.robust_least_squares import robust_solve, solve
from telerig.estimator.calibration.solver.system import System
from telerig.estimator.calibration.start.known_target import angle_between, mirrored
from telerig.estimator.calibration.thresholds import STRONG_PERSPECTIVE, TIE_DEG
from telerig.factors.calibration import State, whitened_residuals
from telerig.io.results.findings import Code, Finding
from telerig.rig.lens_parameters import INDEX
from telerig.rig.pose import rotation_from_rotvec

_KAPPA = INDEX["kappa_per_mm"]
_D = np.diag([1.0, 1.0, -1.0, 1.0])

Nominal = Mapping[int, Array]
"""Nominal rotation vectors (3,) in degrees from the first camera's frame to that of other cameras,
by the camera's index, as far as they are known."""

ALIKE_FACTOR, ALIKE_COST = 1.5, 20.0
"""A start fits as well as the best one if its cost is below this factor times the cost of the best
one plus this constant."""

BY_PLATE = "refraction in the plate"
"""``decided_by`` for a two-sided target when no nominal rotation is given."""


@dataclass(frozen=True)
class MirrorChoice:
    """Holds which of the two mirror-image solutions is kept.

    state : the kept solution.
    decided_by, words : what decided, as a short phrase and as a sentence for calibration.json.
    """

    state: State
    decided_by: str
    words: str


def mirrored_state(state: State) -> State:
    """Return the mirror image of a state, which has the same pixels in telecentric cameras.

    With D = diag(1, 1, -1), poses (R, t) become (D R D, D t), dots X become D X, and kappa changes
    its sign.
    """
    intrinsics = state.intrinsics.copy()
    intrinsics[:, _KAPPA] *= -1
    cameras, views = (_D @ m @ _D for m in (state.rig_from_camera, state.rig_from_target))
    return State(intrinsics, cameras, views, state.dots_mm * [1.0, 1.0, -1.0])


def angle_to_nominal_deg(state: State, nominal_rotvec_deg: Nominal) -> float:
    """Return the largest angle between the inter-camera rotations and the nominal ones."""
    nominal = rotation_from_rotvec(np.radians([*nominal_rotvec_deg.values()]))
    turns = np.swapaxes(state.rig_from_camera[[*nominal_rotvec_deg], :3, :3], -1, -2)
    return float(np.degrees(angle_between(turns, nominal).max()))


def far_rotations(state: State, problem: Problem, nominal_rotvec_deg: Nominal) -> list[Finding]:
    """Return a finding for each camera whose rotation is far from the nominal one."""
    first, found = problem.cameras[0].name, []
    for c, rotvec_deg in nominal_rotvec_deg.items():
        angle, name = angle_to_nominal_deg(state, {c: rotvec_deg}), problem.cameras[c].name
        if angle > Code.ROTATION_FAR.limit:
            key = f"{name}_from_{first}_rotvec_deg"
            found.append(Code.ROTATION_FAR.found(cameras=name, names=key, angle_deg=angle))
    return found


def consistent_start(
    states: Sequence[State], costs: Sequence[float], problem: Problem, nominal: Nominal
) -> State:
    """Return the best of several roughly fitted starts; its mirror image is not considered here.

    Among starts that fit equally well it is the one nearest to the nominal rotations. Raises
    CalibrationError if the nominal rotations do not distinguish these starts.

    costs : cost of each of the starts ``states``.
    """
    best = int(np.argmin(costs))
    if len(problem.cameras) == 2:
        return states[best]
    alike = [i for i, cost in enumerate(costs) if cost < ALIKE_FACTOR * costs[best] + ALIKE_COST]
    different = [best]
    for i in alike:
        apart = [_apart_deg(states[i], states[j], range(len(problem.cameras))) for j in different]
        if i != best and min(apart) > TIE_DEG:
            different.append(i)
    if len(different) == 1:
        return states[best]
    angles = []
    for i in different:
        both = (states[i], mirrored_state(states[i]))
        angles.append(min(angle_to_nominal_deg(s, nominal) for s in both) if nominal else 0.0)
    order = np.argsort(angles)
    other = different[order[1]]
    if angles[order[1]] - angles[order[0]] < TIE_DEG:
        chosen = states[different[order[0]]]
        unsure = [
            c
            for c in range(1, len(problem.cameras))
            if _apart_deg(chosen, states[other], [c]) > TIE_DEG
        ] or list(range(1, len(problem.cameras)))
        names = " and ".join(repr(problem.cameras[c].name) for c in unsure)
        raise CalibrationError(
            f"{len(different)} rigs fit these views equally well; they are mirror images of each "
            f"other in camera {names}, because at most two cameras see each view",
            where="rig.toml [stereo]",
            todo=f"add {_lines(problem, unsure)}, with your own angles (x, y, z of the rotation "
            "vector from the first camera's frame to this camera's; an error of up to 20 degrees "
            "is allowed), or add views in which any three of the cameras see the target at the "
            "same time",
        )
    return states[different[int(order[0])]]


def _apart_deg(a: State, b: State, cameras: Sequence[int] | range) -> float:
    """Return the largest angle between the cameras of two states, one mirrored if nearer."""
    chosen = np.array(cameras)
    ours, theirs = (state.rig_from_camera[chosen, :3, :3] for state in (a, b))
    either = np.stack([theirs, mirrored(theirs)])
    return float(np.degrees(angle_between(ours, either).max(-1).min()))


def _lines(problem: Problem, cameras: Sequence[int]) -> str:
    """Return the lines of `[stereo]` that give the nominal rotations of some cameras."""
    first, names = problem.cameras[0].name, [problem.cameras[c].name for c in cameras]
    return " and ".join(f"{n}_from_{first}_rotvec_deg = [0.0, 90.0, 0.0]" for n in names)


def perspective_sign(state: State, problem: Problem) -> int:
    """Return the sign of kappa if the perspective of all lenses is strong, else 0.

    A true kappa is positive, so a strong negative one shows that the state is the mirror image.
    """
    strength = state.intrinsics[:, _KAPPA] * np.array(problem.rho_mm)
    if np.all(strength > STRONG_PERSPECTIVE):
        return 1
    if np.all(strength < -STRONG_PERSPECTIVE):
        return -1
    return 0


def choose_start(state: State, problem: Problem, nominal_rotvec_deg: Nominal) -> MirrorChoice:
    """Return which of a state and its mirror image the final fit starts from.

    With one camera nothing decides, and the state is returned. The refraction in a two-sided plate,
    by which the state was chosen, decides if no nominal rotation is given, otherwise
    `choose_solution`, whose errors are raised.
    """
    if len(problem.cameras) == 1:
        words = (
            "one camera: a solution and its mirror image have the same pixels, so nothing decides "
            "between them"
        )
        return MirrorChoice(state, "mono", words)
    if nominal_rotvec_deg or not np.any(problem.plate_shift):
        return choose_solution(state, problem, nominal_rotvec_deg)
    words = "the plate's refraction, which has the opposite sign in the mirrored solution"
    return MirrorChoice(state, BY_PLATE, words)


def choose_solution(state: State, problem: Problem, nominal_rotvec_deg: Nominal) -> MirrorChoice:
    """Return which of a state and its mirror image is right.

    The nominal rotations decide, or strong perspective. Raises CalibrationError if there is neither
    or if they contradict each other.
    """
    other = mirrored_state(state)
    perspective = perspective_sign(state, problem)
    stated = [
        f"{problem.cameras[c].name}_from_{problem.cameras[0].name}_rotvec_deg"
        for c in nominal_rotvec_deg
    ]
    if nominal_rotvec_deg:
        angles = [angle_to_nominal_deg(s, nominal_rotvec_deg) for s in (state, other)]
        margin = abs(angles[0] - angles[1])
        nearest = int(np.argmin(angles))
        if max(angles) < TIE_DEG and perspective == 0:
            raise CalibrationError(
                "the optical axes are nearly parallel: both mirror solutions lie within "
                f"{max(angles):.0f} degrees of the nominal rotation, which therefore cannot choose "
                "between them, and the lenses' perspective is too weak to do so",
                where="rig.toml [stereo]",
                todo="turn one camera by 20 degrees or more: nearly parallel telecentric cameras "
                "do not see depth; if the lenses are ordinary ones, state telecentricity_per_mm = "
                "1 / working distance in [cameras.NAME]",
            )
        if margin < TIE_DEG and perspective == 0:
            raise CalibrationError(
                f"the two mirror solutions are {angles[0]:.0f} and {angles[1]:.0f} degrees from "
                "the nominal rotation, which is too similar to choose one of them",
                where="rig.toml [stereo]",
                todo=f"correct {' and '.join(stated)} to within 20 degrees",
            )
        words = (
            f"the nominal rotation in rig.toml: {angles[nearest]:.1f} degrees from the solution "
            f"that is kept, {angles[1 - nearest]:.1f} degrees from the mirrored one"
        )
        if perspective and margin >= TIE_DEG and (perspective > 0) != (nearest == 0):
            raise CalibrationError(
                "the nominal rotation puts the second camera on one side, the perspective of the "
                f"lenses on the other ({words}); farther dots are smaller only in the solution "
                "that the nominal rotation rejects",
                where="rig.toml [stereo]",
                todo=f"check the sign of {' and '.join(stated)}, and that the cameras' folders are "
                "not exchanged",
            )
        if not perspective:
            words += (
                ". If the folders of the cameras were exchanged, the images would fit as well and "
                "every depth would be mirrored: make sure once that each folder holds the images "
                "of its own camera"
            )
            return MirrorChoice((state, other)[nearest], "nominal rotation", words)
    if perspective:
        kept = state if perspective > 0 else other
        return MirrorChoice(
            kept, "perspective", "the lenses' perspective: farther dots are smaller"
        )
    raise CalibrationError(
        "both mirror solutions fit equally well, and rig.toml does not state on which side of the "
        "first camera the second one stands",
        where="rig.toml [stereo]",
        todo=f"add {_lines(problem, [1])} with your own angles; an error of up to 20 degrees is "
        "allowed",
    )


def mirrored_cost(problem: Problem, state: State, cost: float) -> float:
    """Return the cost of the mirror image of a solution.

    Without a plate, refractive windows and a known relief of the target the mirror image is a
    minimum as well, so it is only evaluated.

    state, cost : the solution. Raises CalibrationError if the mirror image fits far better, because
    the refraction in the plate then contradicts the nominal rotation.
    """
    if len(problem.cameras) == 1:
        return cost
    broken = np.any(problem.plate_shift) or np.ptp(problem.nominal_mm[:, 2]) > 0
    mirror = mirrored_state(state)
    if not broken and all(c.wall is None for c in problem.cameras):
        return System(problem).gaussian(mirror).cost
    other = solve(problem, mirror, max_iterations=20).cost
    if np.any(problem.plate_shift) and other < 0.5 * cost - 10:
        raise CalibrationError(
            "the nominal rotation puts the second camera on one side, the refraction in the "
            f"two-sided plate on the other (cost {cost:.4g} against {other:.4g})",
            where="rig.toml [stereo]",
            todo="check the sign of the nominal rotation, and plate_thickness_mm and plate_index "
            "in [target]",
        )
    return other


_MODEL = "tangential"


def views_seen_alone(problem: Problem) -> tuple[Ints, Ints]:
    """Return the views with dots in exactly one camera, and the index of that camera."""
    counts = np.zeros((len(problem.views), len(problem.cameras)), int)
    np.add.at(counts, (problem.view, problem.camera), problem.kept)
    alone = np.flatnonzero((counts > 0).sum(1) == 1)
    return alone, counts[alone].argmax(1)


def with_tilt_signs(problem: Problem, state: State) -> State:
    """Return the state in which views with dots in one camera only have the right tilt.

    One camera alone does not show the sign of the target's tilt. The signs are set such that these
    views show the relief of the dots (their deviations from a plane) that the other views show.
    With one camera every view is of this kind, and the mirror image of the whole state remains
    possible.
    """
    alone, cameras = views_seen_alone(problem)
    relief = float(problem.dot_sigma_mm[:, 2].max())
    if len(alone) == 0 or relief <= HELD_MM:
        return state
    problem = problem.with_model(_MODEL)
    rough = robust_solve(_tolerant(problem, alone), state)
    problem, state = replace(problem, weight=rough.problem.weight), rough.solution.state
    wrong = _tilt_signs(problem, state, alone) < 0
    for c in range(len(problem.cameras)):
        state = _flipped(state, alone[wrong & (cameras == c)], c)
    return state


def _tolerant(problem: Problem, views: Ints) -> Problem:
    """Return the problem with covariances of some views enlarged by the effect of the relief."""
    scale = np.array([c["scale_px_per_mm"] for c in problem.cameras])[problem.camera]
    relief_px = 2 * scale * problem.dot_sigma_mm[:, 2].max() * np.isin(problem.view, views)
    extra = relief_px[:, None, None] ** 2 * np.eye(2)
    return replace(problem, covariance_px2=problem.covariance_px2 + extra)


def _tilt_signs(problem: Problem, state: State, alone: Ints) -> Array:
    """Return the signs (len(alone),) with which the relief in views fits that of the other views.

    Fitted with flat dots, view v leaves residuals of the relief s_v z_i: a matrix of rank one.
    """
    sigma = problem.dot_sigma_mm.copy()
    sigma[:, 2] = HELD_MM
    flat = replace(problem, dot_sigma_mm=sigma)
    fitted = solve(flat, state, max_iterations=20, relative=1e-5).state
    obs = flat.observations()
    jac = whitened_residuals(fitted, obs, flat.rho_mm)
    by_relief = jac.by_dot[..., 2]
    seen = np.zeros((len(flat.views), len(flat.dot_ids)))
    weight = np.zeros_like(seen)
    np.add.at(seen, (obs.view, obs.dot), -(by_relief * jac.value).sum(-1))
    np.add.at(weight, (obs.view, obs.dot), (by_relief**2).sum(-1))
    seen = _without_plane(seen / np.maximum(weight, 1e-12), weight > 0, flat.nominal_mm)
    seen, weight = seen[alone], weight[alone]
    if len(alone) < len(flat.views):
        return np.asarray(np.sign(np.sum(weight * seen * state.dots_mm[:, 2], axis=1)))
    relief = np.linalg.svd(seen, full_matrices=False)[2][0]
    for _ in range(10):
        signs = np.sign(np.sum(weight * seen * relief, axis=1))
        relief = (signs[:, None] * weight * seen).sum(0) / np.maximum(weight.sum(0), 1e-12)
    return np.asarray(signs)


def _without_plane(relief: Array, seen: NDArray[np.bool_], nominal_mm: Array) -> Array:
    """Return the reliefs (V, N) minus the plane through each view's dots, which is its pose."""
    plane = np.c_[nominal_mm[:, :2], np.ones(len(nominal_mm))]
    out = np.zeros_like(relief)
    for row, values, mine in zip(out, relief, seen):
        fit, *_ = np.linalg.lstsq(plane[mine], values[mine], rcond=None)
        row[mine] = values[mine] - plane[mine] @ fit
    return out


def _flipped(state: State, views: Ints, camera: int) -> State:
    """Return the state with some views in the pose that is mirrored for one camera."""
    rig_from_camera = state.rig_from_camera[camera]
    mirror = rig_from_camera @ _D @ np.linalg.inv(rig_from_camera)
    poses = state.rig_from_target.copy()
    poses[views] = mirror @ poses[views] @ _D
    return replace(state, rig_from_target=poses)
