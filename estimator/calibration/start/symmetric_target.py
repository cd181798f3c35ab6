"""A target without marks looks the same after a turn: one numbering for all images.

Within a view, the numberings of two cameras must agree with one inter-camera rotation. Between
views, only the print errors of the dots differ after a turn, and they must be alike in all views.
Where cameras and dots are calibrated, these decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.errors import CalibrationError, GeometryError
from telerig.estimator.calibration.solver.problem import HELD_MM, Problem, known_scale
from telerig.estimator.calibration.solver.robust_least_squares import robust_solve
from telerig.estimator.calibration.start import known_target
from telerig.estimator.calibration.start.known_target import angle_between
from telerig.estimator.calibration.start.mirror_ambiguity import Nominal
from telerig.estimator.calibration.thresholds import TURN_TIE_DEG
from telerig.factors.calibration import State, whitened_residuals
from telerig.io.results.findings import Code, Finding
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.target import Target
from telerig.rig.triangulation import midpoint


def number_consistently(
    problem: Problem, nominal_rotvec_deg: Nominal
) -> tuple[Problem, list[Finding]]:
    """Renumber the dots of a symmetric target such that all cameras and views agree.

    Returns the problem with the new numbers, and findings on how they were decided.
    Raises CalibrationError if two numberings explain the images of two cameras equally well, and
    for an unbounded target: how its dots change places is not known, as its grid has no middle.
    """
    if not problem.target.bounded:
        raise CalibrationError(
            f"the marks look the same after a turn ({problem.target.symmetry_order()}-fold "
            "symmetry), and on an unbounded grid nothing else tells how the target is turned",
            where="rig.toml [target]",
            todo="use three or more marks that look different after every turn, such as "
            "marks = [[0, 0], [0, 5], [3, 0]]",
        )
    labels = problem.target.turns()
    if len(problem.cameras) > 1:
        problem = _numbered_alike_in_cameras(problem, labels, nominal_rotvec_deg)
    problem, contrast = _numbered_alike_in_views(problem, labels)
    problem = replace(problem, scale=known_scale(problem.target, problem.dot_ids))
    problem, about_scale = _scale_of_any_turn(problem, labels)
    code = Code.TURNS_KNOWN if contrast > Code.TURNS_UNKNOWN.limit else Code.TURNS_UNKNOWN
    return problem, [code.found(turns=len(labels), contrast_sd=contrast), *about_scale]


def _scale_of_any_turn(problem: Problem, labels: list[Ints]) -> tuple[Problem, list[Finding]]:
    """Return the known distance, less certain where a turn puts other dots in place of its two."""
    if problem.scale is None:
        return problem, []
    pair, distance, sigma = problem.scale
    ends = problem.dot_ids[list(pair)]
    if all(set(label[ends]) == set(ends) for label in labels):
        return problem, []
    either = float(np.hypot(sigma, np.sqrt(2) * problem.target.print_sigma_mm))
    first, second = (int(end) for end in ends)
    finding = Code.TURNED_DISTANCE.found(first=first, second=second, sd_um=1e3 * either)
    return replace(problem, scale=(pair, distance, either)), [finding]


def _relabel(problem: Problem, choice: dict[tuple[int, int], Ints]) -> Problem:
    """Return the problem with turned numbers in some images, and without a known distance."""
    ids = problem.dot_ids[problem.dot]
    for (v, c), label in choice.items():
        rows = (problem.view == v) & (problem.camera == c)
        ids[rows] = label[ids[rows]]
    return problem.renumbered(ids)


def _numbered_alike_in_cameras(
    problem: Problem, labels: list[Ints], nominal_rotvec_deg: Nominal
) -> Problem:
    """Return the numberings of all cameras, turned to that of the first that sees the view."""
    images = set(known_target.image_maps(problem, problem.nominal_mm))
    tree = known_target.overlap_tree(problem, images)
    order = [0, *(c for _, c in tree)]
    every = [(a, b) for i, a in enumerate(order) for b in order[i + 1 :]]
    pairs = [*tree, *(pair for pair in every if pair not in tree)]
    numbered = {(v, min(seen, key=order.index)) for v, seen in _cameras_of(images).items()}
    for a, b in pairs:
        both = [v for v, c in sorted(numbered) if c == a and {(v, b)} <= images - numbered]
        if both:
            problem = _numbered_alike_in_pair(
                problem, labels, both, (a, b), _nominal_of_pair(nominal_rotvec_deg, a, b)
            )
            numbered |= {(v, b) for v in both}
    return problem


def _cameras_of(images: set[tuple[int, int]]) -> dict[int, list[int]]:
    """Return the cameras that see each view, by view."""
    out: dict[int, list[int]] = {}
    for v, c in images:
        out.setdefault(v, []).append(c)
    return out


def _nominal_of_pair(nominal_rotvec_deg: Nominal, a: int, b: int) -> Array | None:
    """Return (3, 3) nominal rotation b_from_a, where both are known."""
    known = {0: np.zeros(3), **nominal_rotvec_deg}
    if not {a, b} <= set(known):
        return None
    of_a, of_b = (rotation_from_rotvec(np.radians(known[c])) for c in (a, b))
    return of_b @ of_a.T if a else of_b


def _numbered_alike_in_pair(
    problem: Problem,
    labels: list[Ints],
    both: list[int],
    pair: tuple[int, int],
    nominal: Array | None,
) -> Problem:
    """Return the turn of one camera's numbering that one rotation against the other explains."""
    first, second = pair
    maps = known_target.image_maps(problem, problem.nominal_mm)
    rotation = {k: known_target.rotation_from_jacobian(m.jacobian)[0] for k, m in maps.items()}
    spin = [_spin(k, len(labels)) for k in range(len(labels))]
    firsts = np.array([rotation[v, first] for v in both])
    seconds = np.array([[rotation[v, second] @ s for s in spin] for v in both])
    # (signs of the tilts, turns, views)
    options = known_target.either_tilt(firsts, np.swapaxes(seconds, 0, 1))
    every = options.reshape(-1, len(both), 3, 3)
    hypotheses = []
    for candidate in every.reshape(-1, 3, 3):
        refined, cost = known_target.refined(candidate, every)
        either = np.array([refined, known_target.mirrored(refined)])
        distance = 0.0 if nominal is None else np.degrees(angle_between(either, nominal).min())
        hypotheses.append((cost / np.radians(2) ** 2 + (distance / 60) ** 2, refined))
    best = min(hypotheses, key=lambda h: h[0])[1]
    angles = angle_between(options, best).min(0).T
    ranked = np.sort(angles, 1)
    close = np.flatnonzero(ranked[:, 1] - ranked[:, 0] < np.radians(TURN_TIE_DEG))
    if len(close):
        raise CalibrationError(
            "the target has no orientation marks and looks the same after a turn, and in view "
            f"{problem.views[both[int(close[0])]]!r} two ways to number its dots fit the images "
            f"of {_names(problem, pair)} equally well",
            todo="leave this view out, or use a target with orientation marks (marks in rig.toml "
            "[target])",
        )
    # image v of the second camera agrees once turned by spin k: its ids follow the turn back
    choice = {(v, second): labels[-int(k)] for v, k in zip(both, angles.argmin(1))}
    return _relabel(problem, choice)


def _names(problem: Problem, pair: tuple[int, int]) -> str:
    if len(problem.cameras) == 2:
        return "both cameras"
    return "cameras " + " and ".join(repr(problem.cameras[c].name) for c in pair)


def _spin(k: int, order: int) -> Array:
    return rotation_from_rotvec([0.0, 0.0, 2 * np.pi * k / order])


def _numbered_alike_in_views(problem: Problem, labels: list[Ints]) -> tuple[Problem, float]:
    """Turn whole views until their print errors look like those of the others."""
    held = replace(problem, dot_sigma_mm=np.full_like(problem.dot_sigma_mm, HELD_MM))
    start = known_target.stereo_states(held, held.nominal_mm, count=1)[0]
    rough = robust_solve(held.with_model("tangential"), start)
    marks = _print_errors(rough.problem, rough.solution.state, len(labels[0]))
    turned = np.array([_turned(marks, label, k, len(labels)) for k, label in enumerate(labels)])
    choice = _most_alike_turns(turned)
    contrast = _contrast(turned, choice)
    picks = {
        (v, c): labels[k] for v, k in enumerate(choice) for c in range(len(problem.cameras)) if k
    }
    return _relabel(problem, picks), contrast


def _most_alike_turns(turned: Array) -> Ints:
    """Return turns (V,) that make views' print errors most alike: to one view, then to the mean."""
    views = np.arange(turned.shape[1])
    starts = [_misfits(turned, turned[0, v][None]).argmin(0) for v in views]
    choice = min(starts, key=lambda c: _scatter(turned[c, views]))
    for _ in range(10):
        chosen = turned[choice, views]
        others = np.array([_mean(np.delete(chosen, v, 0)) for v in views])
        before, choice = choice, _misfits(turned, others).argmin(0)
        if np.array_equal(before, choice):
            break
    return np.asarray(choice, np.int64)


def _misfits(turned: Array, others: Array) -> Array:
    """Return mean square differences (T, V) of views' turns from print errors (V or 1, N, 2).

    They are infinite where the two have no dot in common.
    """
    squares = (turned - others) ** 2
    many = np.isfinite(squares).sum((2, 3))
    return np.where(many > 0, np.nansum(squares, (2, 3)) / np.maximum(many, 1), np.inf)


def _mean(marks: Array) -> Array:
    """Return the mean (N, 2) over the views that see a dot; NaN for a dot that none sees."""
    many = np.isfinite(marks).sum(0)
    return np.where(many > 0, np.nansum(marks, 0) / np.maximum(many, 1), np.nan)


def _scatter(marks: Array) -> float:
    """Return the variance of print errors (V, N, 2) between the views."""
    seen = np.isfinite(marks).sum(0)
    freedom = np.maximum(seen - 1, 0).sum()
    return float(np.nansum((marks - _mean(marks)) ** 2) / max(freedom, 1))


def _print_errors(problem: Problem, state: State, count: int) -> Array:
    """Return (V, N, 2) where views see the target's N dots, minus nominal, in its plane (mm).

    NaN for a dot that a view does not show.
    """
    obs = problem.observations()
    jac = whitened_residuals(state, obs, problem.rho_mm)
    normal = np.zeros((len(problem.views), count, 2, 2))
    right = np.zeros((*normal.shape[:2], 2))
    plane, dot = jac.by_dot[..., :2], problem.dot_ids[obs.dot]
    np.add.at(normal, (obs.view, dot), np.swapaxes(plane, -1, -2) @ plane)
    np.add.at(right, (obs.view, dot), -np.einsum("mij,mi->mj", plane, jac.value))
    unseen = np.linalg.det(normal) <= 0
    normal[unseen] = np.eye(2)
    errors = np.linalg.solve(normal, right[..., None])[..., 0]
    errors[unseen] = np.nan
    return np.asarray(errors - np.nanmean(errors, 1, keepdims=True))


def _turned(marks: Array, label: Ints, k: int, order: int) -> Array:
    out = np.empty_like(marks)
    out[:, label] = marks @ _spin(k, order)[:2, :2].T
    return out


def _contrast(turned: Array, choice: Ints) -> float:
    """Return by how many sd the chosen turn beats the next, in the least certain view."""
    chosen = turned[choice, np.arange(len(choice))]
    worst = np.inf
    for v in range(len(choice)):
        others = np.delete(chosen, v, 0)
        squares = (turned[:, v] - _mean(others)) ** 2 / (_scatter(others) + 1e-18)
        costs = np.sort(np.nansum(squares, (1, 2)))
        worst = min(worst, np.sqrt(max(0.0, costs[1] - costs[0])))
    return float(worst)


_CLEARLY, _ROUNDING_MM = 1.5, 1e-6
"""Other turns than the given ones are taken if the dots then fit so many times as well, and better
by more than rounding."""


def numbered_as_calibrated(
    view: Ints,
    camera: Ints,
    ids: Ints,
    uv_px: Array,
    cameras: Sequence[Camera],
    target: Target,
    places_mm: dict[int, Array],
) -> Ints:
    """Return the ids (M,) of dots of a symmetric target at rest, numbered as in a calibration.

    Of one camera all images are turned alike; of all turns of the cameras those are taken with
    which the triangulated dots have the shape that the calibration found.

    view, camera, ids, uv_px : (M,), (M, 2) of the measured dots. cameras : calibrated.
    places_mm : (3,) of each dot in the target's frame, by its id.
    """
    labels = np.array(target.turns())
    order, seen = len(labels), np.unique(camera).tolist()
    turn = _turns_alike(view, camera, ids, uv_px, labels, target)
    turned = labels[(turn + np.arange(order)[:, None]) % order, ids]
    every = list(product(range(order), repeat=len(seen)))
    misfit_mm = np.zeros(len(every))
    for one, other in combinations(range(len(seen)), 2):
        images = [(cameras[seen[k]], camera == seen[k]) for k in (one, other)]
        of_turns = {
            turns: _shape_misfit_mm(view, uv_px, images, turned[list(turns)], places_mm)
            for turns in product(range(order), repeat=2)
        }
        misfit_mm += [of_turns[choice[one], choice[other]] for choice in every]
    best = int(np.argmin(misfit_mm))
    if misfit_mm[0] < _CLEARLY * misfit_mm[best] + _ROUNDING_MM:
        best = 0
    out = ids.copy()
    for c, k in zip(seen, every[best]):
        out[camera == c] = turned[k, camera == c]
    return out


def _turns_alike(
    view: Ints, camera: Ints, ids: Ints, uv_px: Array, labels: Ints, target: Target
) -> Ints:
    """Return turns (M,) with which all images of a camera show the target turned alike."""
    out = np.zeros(len(ids), np.int64)
    for c in np.unique(camera):
        first = None
        for v in np.unique(view[camera == c]):
            mine = (camera == c) & (view == v)
            maps = []
            for label in labels:
                plane = target.nominal_mm(label[ids[mine]])[:, :2]
                map_, *_ = np.linalg.lstsq(
                    plane - plane.mean(0), uv_px[mine] - uv_px[mine].mean(0), rcond=None
                )
                maps.append(map_)
            first = maps[0] if first is None else first
            out[mine] = np.argmin(np.linalg.norm(np.array(maps) - first, axis=(1, 2)))
    return out


def _shape_misfit_mm(
    view: Ints,
    uv_px: Array,
    images: Sequence[tuple[Camera, Bools]],
    ids: Ints,
    places_mm: dict[int, Array],
) -> float:
    """Return the median distance of dots that two cameras see from the calibrated shape.

    It is 0 if they see none together, or look in the same direction.

    images : for each of the cameras, which of the M dots are its own. ids : (2, M) for each.
    """
    rows = [
        {(int(view[i]), int(own[i])): i for i in np.flatnonzero(mine)}
        for (_, mine), own in zip(images, ids)
    ]
    both = [key for key in rows[0] if key in rows[1] and key[1] in places_mm]
    if not both:
        return 0.0
    rays = [
        camera.unproject(uv_px[[row[key] for key in both]])
        for (camera, _), row in zip(images, rows)
    ]
    try:
        points, _ = midpoint(*rays[0], *rays[1])
    except GeometryError:
        return 0.0
    of_view, dots = np.array(both).T
    places, off = np.array([places_mm[dot] for dot in dots.tolist()]), np.zeros(len(both))
    for v in np.unique(of_view):
        mine = of_view == v
        moved = Pose.aligning(places[mine], points[mine]).apply(places[mine])
        off[mine] = np.linalg.norm(points[mine] - moved, axis=-1)
    return float(np.median(off))
