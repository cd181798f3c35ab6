"""The same least-squares problem as the graph's, as normal equations with the dots eliminated.

For many dots GTSAM's dense Hessian is what costs (2 s a step for 400 dots). Here every image adds
its few columns, the dots form 3 x 3 blocks, and a step solves the Schur complement on cameras and
views (Triggs et al., Bundle Adjustment, 1999, section 6). Cost, information and minimum are the
graph's; tests/test_schur.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from telerig.estimator.problem import GAUGE_SIGMA_MM, Problem, parameter_unit, prior_sigma
from telerig.factors.priors import depth_gauge_residual, distance_residual
from telerig.factors.projection import (
    Residuals,
    State,
    whitened_residuals,
)
from telerig.rig.pose import rotation_from_rotvec

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class NormalEquations:
    """J^T J and -J^T r in parts. Common: intrinsics, camera poses, views, in the graph's order.

    common : (C, C).  cross : (C, N, 3).  dots : (N, 3, 3).  right_common : (C,); right_dots :
    (N, 3).  distance : (3 N,) row of the known distance, which couples two dots, or None; its
    share is in ``right_dots`` but not in ``dots``.
    """

    cost: float
    common: Array
    cross: Array
    dots: Array
    right_common: Array
    right_dots: Array
    distance: Array | None

    def information(self) -> Array:
        """(C + 3 N, C + 3 N) dense J^T J."""
        size, width = len(self.common), 3 * len(self.dots)
        out = np.zeros((size + width, size + width))
        out[:size, :size] = self.common
        out[:size, size:] = self.cross.reshape(size, width)
        out[size:, :size] = out[:size, size:].T
        at = size + 3 * np.arange(len(self.dots))[:, None] + np.arange(3)
        out[at[:, :, None], at[:, None, :]] = self.dots
        if self.distance is not None:
            out[size:, size:] += np.outer(self.distance, self.distance)
        return out

    def step(self, damping: float) -> tuple[Array, float]:
        """(C + 3 N,) damped step, and the decrease of the cost that it promises."""
        right = np.r_[self.right_common, self.right_dots.ravel()]
        solve = self._solver(damping)
        step = solve(right)
        if self.distance is not None:
            row = np.r_[np.zeros(len(self.common)), self.distance]
            along = solve(row)
            step = step - along * (row @ step) / (1 + row @ along)
        return step, float(0.5 * step @ right)

    def _solver(self, damping: float) -> Callable[[Array], Array]:
        """Solves with the damped matrix, the distance left out."""
        size = len(self.common)
        common, dots = _damped(self.common, damping), _damped(self.dots, damping)
        inverse = np.linalg.inv(dots)
        gain = np.einsum("cni,nij->cnj", self.cross, inverse)
        width = 3 * len(dots)
        reduced = common - gain.reshape(size, width) @ self.cross.reshape(size, width).T
        scale = 1 / np.sqrt(np.diag(common))
        factor = cho_factor(reduced * scale[:, None] * scale, check_finite=False)

        def solve(right: Array) -> Array:
            of_dots = right[size:].reshape(-1, 3)
            rest = right[:size] - np.einsum("cni,ni->c", gain, of_dots)
            first = scale * cho_solve(factor, scale * rest, check_finite=False)
            second = of_dots - np.einsum("cni,c->ni", self.cross, first)
            last: Array = np.einsum("nij,nj->ni", inverse, second).ravel()
            return np.concatenate([first, last])

        return solve


def _damped(matrix: Array, damping: float) -> Array:
    """Marquardt's damping; what nothing touches (a view left out) stays where it is."""
    out = matrix.copy()
    i = np.arange(matrix.shape[-1])
    diagonal = matrix[..., i, i]
    out[..., i, i] = np.where(diagonal > 0, diagonal * (1 + damping), 1.0)
    return out


class ArraySystem:
    """A problem without a graph; points are states. The interface is `graph.GraphSystem`'s."""

    def __init__(self, problem: Problem, start: State) -> None:
        self.problem, self.start = problem, start
        self.obs, self.keys = problem.observations(), problem.keys()
        self._last: tuple[State, NormalEquations] | None = None
        image = self.obs.view * len(problem.cameras) + self.obs.camera
        edges = np.r_[0, np.flatnonzero(np.diff(image)) + 1, len(image)]
        self.images = [slice(int(a), int(b)) for a, b in pairwise(edges)]
        sizes = [len(f) for f in problem.free] + [6] * (len(problem.cameras) - 1)
        self.edges = np.r_[0, np.cumsum(sizes + [6] * len(problem.views))]

    def first(self) -> State:
        return self.start

    def cost(self, state: State) -> float:
        return self.linearised(state).cost

    def linearised(self, state: State) -> NormalEquations:
        """The normal equations, kept for the state that was asked last."""
        if self._last is None or self._last[0] is not state:
            self._last = (state, self.normal_equations(state))
        return self._last[1]

    def state(self, state: State) -> State:
        return state

    def _intrinsics(self, camera: int) -> Ints:
        return np.arange(self.edges[camera], self.edges[camera + 1])

    def _camera(self, camera: int) -> Ints:
        first = self.edges[len(self.problem.cameras) + camera - 1]
        return np.arange(first, first + 6)

    def _view(self, view: int | Ints) -> Ints:
        first = self.edges[2 * len(self.problem.cameras) - 1] + 6 * np.asarray(view)
        return np.asarray(first[..., None] + np.arange(6))

    def normal_equations(self, state: State) -> NormalEquations:
        """Everything at one state: images, then priors and gauge."""
        problem, size, count = self.problem, int(self.edges[-1]), len(self.problem.dot_ids)
        full = whitened_residuals(state, self.obs, problem.rho_mm)
        common, cross = np.zeros((size, size)), np.zeros((size, count, 3))
        right = np.zeros(size)
        for rows in self.images:
            columns = self._columns(full, rows)
            _add_image(common, cross, right, full, columns, self.obs.dot[rows], rows)
        dots, right_dots = np.zeros((count, 3, 3)), np.zeros((count, 3))
        by_dot = full.by_dot
        np.add.at(dots, self.obs.dot, np.swapaxes(by_dot, -1, -2) @ by_dot)
        np.add.at(right_dots, self.obs.dot, -np.einsum("mij,mi->mj", by_dot, full.value))
        twice = float((full.value**2).sum())
        twice += self._add_priors(state, common, right)
        off = (state.dots_mm - problem.nominal_mm) / problem.dot_sigma_mm
        twice += float((off**2).sum())
        dots[:, np.arange(3), np.arange(3)] += problem.dot_sigma_mm**-2.0
        right_dots -= off / problem.dot_sigma_mm
        row = None
        if problem.scale is not None:
            value, jacobian = distance_residual(state.dots_mm, *problem.scale)
            row, twice = jacobian[0], twice + float(value @ value)
            right_dots -= (row * value[0]).reshape(-1, 3)
        return NormalEquations(0.5 * twice, common, cross, dots, right, right_dots, row)

    def _columns(self, full: Residuals, rows: slice) -> tuple[Array, Ints]:
        """(m, 2, p) Jacobian of an image by its intrinsics, camera and view, and their places."""
        view, camera = int(self.obs.view[rows.start]), int(self.obs.camera[rows.start])
        free, unit = self.keys.free[camera], self.keys.unit[camera]
        parts = [full.by_intrinsics[rows][..., free] * unit, full.by_view[rows]]
        places = [self._intrinsics(camera), self._view(view)]
        if camera:
            parts.append(full.by_camera[rows])
            places.append(self._camera(camera))
        return np.concatenate(parts, -1), np.concatenate(places)

    def _add_priors(self, state: State, common: Array, right: Array) -> float:
        """Intrinsics, depth gauge and view places; returns twice their cost."""
        problem, twice = self.problem, 0.0
        for c, nominal in enumerate(problem.cameras):
            free, unit = self.keys.free[c], parameter_unit(nominal)[self.keys.free[c]]
            sigma = prior_sigma(nominal)[free] / unit
            off = (state.intrinsics[c] - nominal.intrinsics)[free] / unit / sigma
            at = self._intrinsics(c)
            common[at, at] += sigma**-2.0
            right[at] -= off / sigma
            twice += float(off @ off)
        for c in range(1, len(problem.cameras)):
            value, jacobian = depth_gauge_residual(state.rig_from_camera[c], GAUGE_SIGMA_MM)
            at = self._camera(c)
            common[np.ix_(at, at)] += jacobian.T @ jacobian
            right[at] -= jacobian.T @ value
            twice += float(value @ value)
        loose = 10 * max(problem.rho_mm)
        place, turn = state.rig_from_target[:, :3, 3] / loose, state.rig_from_target[:, :3, :3]
        at = self._view(np.arange(len(problem.views)))[:, 3:]
        common[at, at] += loose**-2.0
        right[at] -= np.einsum("vji,vj->vi", turn, place) / loose
        return twice + float((place**2).sum())

    def moved(self, state: State, step: Array) -> State:
        """The state after a step: poses R exp(w), t + R v."""
        problem, intrinsics = self.problem, state.intrinsics.copy()
        for c, (free, unit) in enumerate(zip(self.keys.free, self.keys.unit)):
            intrinsics[c, free] += step[self._intrinsics(c)] * unit
        cameras = state.rig_from_camera.copy()
        for c in range(1, len(problem.cameras)):
            cameras[c] = _retracted(cameras[c], step[self._camera(c)])
        views = self._view(np.arange(len(problem.views)))
        dots = state.dots_mm + step[self.edges[-1] :].reshape(-1, 3)
        return replace(
            state, intrinsics=intrinsics, rig_from_camera=cameras,
            rig_from_target=_retracted(state.rig_from_target, step[views]), dots_mm=dots,
        )  # fmt: skip


def _add_image(
    common: Array,
    cross: Array,
    right: Array,
    full: Residuals,
    columns: tuple[Array, Ints],
    dots: Ints,
    rows: slice,
) -> None:
    jacobian, at = columns
    flat = jacobian.reshape(-1, len(at))
    common[np.ix_(at, at)] += flat.T @ flat
    right[at] -= flat.T @ full.value[rows].ravel()
    # a dot is seen once in an image, so that no two rows add to the same place
    cross[at[:, None], dots] += np.einsum("mip,mij->pmj", jacobian, full.by_dot[rows])


def _retracted(pose: Array, tangent: Array) -> Array:
    """(..., 4, 4) poses moved by (..., 6) tangents (rotation, translation)."""
    out = pose.copy()
    turn = pose[..., :3, :3]
    out[..., :3, :3] = turn @ rotation_from_rotvec(tangent[..., :3])
    out[..., :3, 3] += np.einsum("...ij,...j->...i", turn, tangent[..., 3:])
    return out
