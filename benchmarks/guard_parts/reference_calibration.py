"""A bundle adjustment written by itself in NumPy: the Cramer-Rao bound, and a peer for the clock.

It knows a dataset by its files: `truth/truth.json`, `rig.toml` and a table of dots. Unknown are the
lens parameters named, the poses of all cameras but the first, those of all views, and the dots in
three dimensions, with the print's tolerance and one known distance as what is known. Derivatives
are differences, for all dots at once; the dots are eliminated (Schur complement).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

LENS = ("scale_px_per_mm", "aspect", "skew", "centre_u_px", "centre_v_px", "kappa_per_mm", "k1",
        "k2", "p1", "p2", "tilt_x", "tilt_y", "image_convergence_per_mm")  # fmt: skip
STEPS = dict.fromkeys(LENS, 1e-6) | {"scale_px_per_mm": 1e-4, "centre_u_px": 1e-3,
                                     "centre_v_px": 1e-3, "kappa_per_mm": 1e-7}  # fmt: skip
LOOSE = 1e-9
"""Information, relative to the largest of a block, that holds what no image tells (the gauge)."""


@dataclass(frozen=True)
class State:
    """lens (C, 13) in the order of `LENS`; rotations and places of the cameras (camera from rig)
    and of the views (rig from target); dots (D, 3) in mm."""

    lens: Array
    camera_turn: Array
    camera_mm: Array
    view_turn: Array
    view_mm: Array
    dots_mm: Array


@dataclass(frozen=True)
class Problem:
    """Measured dots, and what is known of them.

    free : lens parameters that are unknown, by camera. view, camera, dot : (M,) indices.
    white : (M, 2, 2) inverse square roots of the covariances. nominal_mm,
    sigma_mm : (D, 3) of the dots. ends, distance_mm, distance_sigma_mm : of the known distance.
    rho_mm : (C,).
    """

    free: tuple[tuple[int, ...], ...]
    rho_mm: Array
    view: Ints
    camera: Ints
    dot: Ints
    uv_px: Array
    white: Array
    nominal_mm: Array
    sigma_mm: Array
    ends: tuple[int, int]
    distance_mm: float
    distance_sigma_mm: float

    @property
    def shared(self) -> int:
        """The number of unknowns that are not dots."""
        views = int(self.view.max()) + 1
        return sum(map(len, self.free)) + 6 * (len(self.rho_mm) - 1) + 6 * views


def project(lens: Array, rho_mm: Array, in_camera: Array) -> Array:
    """(M, 2) pixels; lens (M, 13), rho_mm (M,), in_camera (M, 3)."""
    s, aspect, skew, cu, cv, kappa, k1, k2, p1, p2, qx, qy, w = lens.T
    near = 1 / (1 + kappa * in_camera[:, 2]) / rho_mm
    x, y = in_camera[:, 0] * near, in_camera[:, 1] * near
    r2 = x * x + y * y
    radial = 1 + (k1 + k2 * r2) * r2
    xd = rho_mm * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x))
    yd = rho_mm * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    along = xd * qx + yd * qy
    stretch, far = along / (1 + np.sqrt(1 + qx * qx + qy * qy)), 1 - w * along
    xs, ys = (xd + stretch * qx) / far, (yd + stretch * qy) / far
    return np.stack([s * (xs + skew * ys) + cu, s * aspect * ys + cv], -1)


def pixels(problem: Problem, state: State, rows: slice | None = None) -> Array:
    every = slice(None) if rows is None else rows
    v, c, d = (a[every] for a in (problem.view, problem.camera, problem.dot))
    rig = np.einsum("mij,mj->mi", state.view_turn[v], state.dots_mm[d]) + state.view_mm[v]
    seen = np.einsum("mij,mj->mi", state.camera_turn[c], rig) + state.camera_mm[c]
    return project(state.lens[c], problem.rho_mm[c], seen)


def turned(turns: Array, by_rad: Array) -> Array:
    return turns @ Rotation.from_rotvec(by_rad).as_matrix()


def blocks(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    """Pixels (M, 2), derivatives by lens, camera and view (M, 2, 25), and by the dots (M, 2, 3)."""

    def slope(plus: State, minus: State, step: float) -> Array:
        return (pixels(problem, plus) - pixels(problem, minus)) / (2 * step)

    columns = []
    for k, name in enumerate(LENS):
        move = np.zeros(len(LENS))
        move[k] = STEPS[name]
        ends = (replace(state, lens=state.lens + sign * move) for sign in (1, -1))
        columns.append(slope(*ends, STEPS[name]))
    for turn, place in (("camera_turn", "camera_mm"), ("view_turn", "view_mm")):
        for k in range(3):
            move = 1e-6 * np.eye(3)[k]
            now = getattr(state, turn)
            ends = (replace(state, **{turn: turned(now, sign * move)}) for sign in (1, -1))
            columns.append(slope(*ends, 1e-6))
        for k in range(3):
            move = 1e-4 * np.eye(3)[k]
            now = getattr(state, place)
            ends = (replace(state, **{place: now + sign * move}) for sign in (1, -1))
            columns.append(slope(*ends, 1e-4))
    by_dot = []
    for k in range(3):
        move = 1e-4 * np.eye(3)[k]
        ends = (replace(state, dots_mm=state.dots_mm + sign * move) for sign in (1, -1))
        by_dot.append(slope(*ends, 1e-4))
    return pixels(problem, state), np.stack(columns, -1), np.stack(by_dot, -1)


def columns_of(problem: Problem) -> Ints:
    """(M, 25) the unknown of each column of `blocks`, -1 for none."""
    many = len(problem.view)
    place = np.full((many, len(LENS) + 12), -1)
    begin = 0
    for c, free in enumerate(problem.free):
        mine = problem.camera == c
        for k in free:
            place[mine, k] = begin
            begin += 1
    for c in range(1, len(problem.free)):
        place[np.ix_(problem.camera == c, range(len(LENS), len(LENS) + 6))] = begin + np.arange(6)
        begin += 6
    place[:, len(LENS) + 6 :] = begin + 6 * problem.view[:, None] + np.arange(6)
    return place


def normal_equations(problem: Problem, state: State) -> tuple[Array, Array, Array, Array, float]:
    """Information of the shared unknowns (P, P), of both (P, 3 D), of the dots (3 D, 3 D), the
    gradient (P + 3 D,), and half the cost."""
    uv, shared, by_dot = blocks(problem, state)
    residual = np.einsum("mij,mj->mi", problem.white, uv - problem.uv_px)
    shared = problem.white @ shared
    by_dot = problem.white @ by_dot
    place = columns_of(problem)
    size, dots = problem.shared, len(problem.nominal_mm)
    whole = size + 3 * dots
    at_dot = size + 3 * problem.dot[:, None] + np.arange(3)
    place = np.concatenate([place, at_dot], axis=1)
    jacobian = np.concatenate([shared, by_dot], axis=2)
    place = np.where(place < 0, whole, place)
    rows = np.zeros((2 * len(uv), whole + 1))
    for i in range(2):
        np.put_along_axis(rows[i::2], place, jacobian[:, i], axis=1)
    rows = rows[:, :whole]
    flat = residual.ravel()
    information, gradient = rows.T @ rows, rows.T @ flat
    at = np.arange(size, whole)
    pull = (state.dots_mm - problem.nominal_mm) / problem.sigma_mm
    information[at, at] += 1 / problem.sigma_mm.ravel() ** 2
    gradient[size:] += (pull / problem.sigma_mm).ravel()
    a, b = problem.ends
    apart = state.dots_mm[a] - state.dots_mm[b]
    far = float(np.linalg.norm(apart))
    row = np.zeros(whole)
    row[size + 3 * a : size + 3 * a + 3] = apart / far / problem.distance_sigma_mm
    row[size + 3 * b : size + 3 * b + 3] = -apart / far / problem.distance_sigma_mm
    miss = (far - problem.distance_mm) / problem.distance_sigma_mm
    information += np.outer(row, row)
    gradient += row * miss
    cost = 0.5 * float(flat @ flat + (pull**2).sum() + miss**2)
    split = information[:size, :size], information[:size, size:], information[size:, size:]
    return *split, gradient, cost


def reduced(problem: Problem, state: State) -> tuple[Array, Array, Array, float]:
    """The shared unknowns' information without the dots, its right-hand side, what gives the dots'
    step (3 D, P + 1), and half the cost."""
    shared, both, dots, gradient, cost = normal_equations(problem, state)
    size = len(shared)
    back = np.linalg.solve(dots, np.c_[both.T, gradient[size:]])
    information = shared - both @ back[:, :-1]
    return information, gradient[:size] - both @ back[:, -1], back, cost


def solved(problem: Problem, state: State, most: int = 30) -> tuple[State, float, int]:
    """Gauss-Newton steps with Levenberg's damping to the minimum: state, half the cost, steps."""
    damping, at = 1e-6, reduced(problem, state)
    for step in range(1, most + 1):
        information, right, back, cost = at
        scale = np.diag(information) + LOOSE * np.abs(np.diag(information)).max()
        move = np.linalg.solve(information + damping * np.diag(scale), -right)
        trial = moved(problem, state, np.r_[move, -back[:, -1] - back[:, :-1] @ move])
        new = reduced(problem, trial)
        if new[3] < cost:
            state, at, damping = trial, new, damping / 10
            if cost - new[3] < 1e-9 * cost:
                return state, new[3], step
        elif cost - new[3] > -1e-9 * cost:
            return state, cost, step
        else:
            damping *= 10
    return state, at[3], most


def moved(problem: Problem, state: State, step: Array) -> State:
    lens, begin = state.lens.copy(), 0
    for c, free in enumerate(problem.free):
        lens[c, list(free)] += step[begin : begin + len(free)]
        begin += len(free)
    cameras = len(problem.free) - 1
    own = np.r_[np.zeros((1, 6)), step[begin : begin + 6 * cameras].reshape(-1, 6)]
    begin += 6 * cameras
    views = step[begin : problem.shared].reshape(-1, 6)
    return State(
        lens, turned(state.camera_turn, own[:, :3]), state.camera_mm + own[:, 3:],
        turned(state.view_turn, views[:, :3]), state.view_mm + views[:, 3:],
        state.dots_mm + step[problem.shared :].reshape(-1, 3),
    )  # fmt: skip


def truth_of(truth: Mapping[str, Any], table: pd.DataFrame) -> State:
    """The true state; of the views and dots that the table has."""
    cameras = truth["cameras"].values()
    lens = [[c["parameters"][name] for name in LENS] for c in cameras]
    views = [truth["views"][v]["rig_from_target"] for v in sorted(set(table["view"]))]
    dots = dict(zip(truth["target"]["dot"], truth["target"]["points_mm"]))
    seen = sorted(set(table["dot"]))
    return State(
        np.array(lens),
        np.array([c["camera_from_rig"]["rotation"] for c in cameras]),
        np.array([c["camera_from_rig"]["translation_mm"] for c in cameras], float),
        np.array([v["rotation"] for v in views]),
        np.array([v["translation_mm"] for v in views], float),
        np.array([dots[d] for d in seen]),
    )


def problem_of(
    truth: Mapping[str, Any], rig: Mapping[str, Any], table: pd.DataFrame, free: Sequence[str]
) -> Problem:
    """rig : content of rig.toml. table : dots.csv. free : names of the lens parameters."""
    names = list(truth["cameras"])
    views, dots = sorted(set(table["view"])), sorted(set(table["dot"]))
    target = rig["target"]
    pitch = np.broadcast_to(np.asarray(target["pitch_mm"], float), 2)
    grid = {d: (r, c) for d, r, c in zip(*(truth["target"][k] for k in ("dot", "row", "column")))}
    nominal = [[grid[d][1] * pitch[0], grid[d][0] * pitch[1], 0.0] for d in dots]
    sigma = [target["print_sigma_mm"], target["print_sigma_mm"], target["flatness_sigma_mm"]]
    if "suu_px2" in table:
        s = table[["suu_px2", "suv_px2", "suv_px2", "svv_px2"]].to_numpy(float).reshape(-1, 2, 2)
    else:
        s = table["sigma_px"].to_numpy(float)[:, None, None] ** 2 * np.eye(2)
    white = np.swapaxes(np.linalg.cholesky(np.linalg.inv(s)), -1, -2)
    return Problem(
        tuple(tuple(LENS.index(name) for name in free) for _ in names),
        np.array([truth["cameras"][n]["rho_mm"] for n in names]),
        np.array([views.index(v) for v in table["view"]]),
        np.array([names.index(c) for c in table["camera"]]),
        np.array([dots.index(d) for d in table["dot"]]),
        table[["u_px", "v_px"]].to_numpy(float), white, np.array(nominal),
        np.tile(sigma, (len(dots), 1)),
        (dots.index(target["scale_dots"][0]), dots.index(target["scale_dots"][1])),
        target["scale_distance_mm"], target["scale_sigma_mm"],
    )  # fmt: skip


def cube() -> Array:
    """(125, 3) points of 30 mm round the rig's origin."""
    axis = np.linspace(-15.0, 15.0, 5)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def seen_points(state: State, rho_mm: Array, points: Array) -> list[Array]:
    """Pixels (N, 2) of points in the rig frame, of each camera."""
    out = []
    for lens, turn, place, rho in zip(state.lens, state.camera_turn, state.camera_mm, rho_mm):
        many = np.broadcast_to(lens, (len(points), len(LENS)))
        out.append(project(many, np.full(len(points), rho), points @ turn.T + place))
    return out


def bound_um(problem: Problem, truth: State) -> float:
    """The Cramer-Rao bound on the RMS error per axis of the points of `cube`, triangulated from
    their true pixels; their common rigid motion is set aside."""
    information, *_ = reduced(problem, truth)
    cameras = sum(map(len, problem.free)) + 6 * (len(problem.free) - 1)
    size = np.sqrt(np.diag(information))
    size[size == 0] = 1.0  # a telecentric camera's own depth
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    kept = values > 1e-12 * values[-1]
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(size, size)
    points = cube()
    exact = seen_points(truth, problem.rho_mm, points)
    steps = [STEPS[LENS[k]] for free in problem.free for k in free]
    steps += (len(problem.free) - 1) * ([1e-6] * 3 + [1e-4] * 3)
    columns = []
    for k, step in enumerate(steps):
        ends = []
        for sign in (1.0, -1.0):
            move = np.zeros(problem.shared + 3 * len(problem.nominal_mm))
            move[k] = sign * step
            ends.append(placed(moved(problem, truth, move), problem.rho_mm, exact, points))
        columns.append((ends[0] - ends[1]).ravel() / (2 * step))
    shift = without_motion(points) @ np.array(columns).T
    covariance = shift @ inverse[:cameras, :cameras] @ shift.T
    return 1e3 * float(np.sqrt(np.trace(covariance) / len(covariance)))


def placed(state: State, rho_mm: Array, uv_px: Sequence[Array], start: Array) -> Array:
    """(N, 3) points of least squared distance of their pixels from the given ones."""
    points = start.copy()
    for _ in range(3):
        now = np.concatenate(seen_points(state, rho_mm, points), axis=1)
        slopes = []
        for k in range(3):
            move = 1e-3 * np.eye(3)[k]
            ends = (seen_points(state, rho_mm, points + sign * move) for sign in (1, -1))
            plus, minus = (np.concatenate(uv, axis=1) for uv in ends)
            slopes.append((plus - minus) / 2e-3)
        jacobian = np.stack(slopes, -1)
        miss = np.concatenate(list(uv_px), axis=1) - now
        square = np.swapaxes(jacobian, 1, 2) @ jacobian
        pull = np.einsum("nij,ni->nj", jacobian, miss)[..., None]
        points = points + np.linalg.solve(square, pull)[..., 0]
    return points


def without_motion(points: Array) -> Array:
    """(3 N, 3 N) projector that removes small rigid motions."""
    x = points - points.mean(0)
    turns = [np.cross(axis, x).ravel() for axis in np.eye(3)]
    shifts = [np.tile(axis, len(x)) for axis in np.eye(3)]
    basis, _ = np.linalg.qr(np.array(turns + shifts).T)
    return np.eye(3 * len(x)) - basis @ basis.T


def aligned(points: Array, onto: Array) -> Array:
    """Points after the rotation and shift that bring them nearest."""
    a, b = points - points.mean(0), onto - onto.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    return np.asarray(a @ u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt + onto.mean(0))
