"""The calibration as a flat vector with a sparse Jacobian, and SciPy's least_squares on it.

Same variables, units, priors and gauge as the product; poses are tangent vectors at the start.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import block_diag, csr_array

from telerig.estimator.calibration.solver.array_system import ArraySystem
from telerig.estimator.calibration.solver.problem import GAUGE_SIGMA_MM, Problem
from telerig.factors.priors import depth_gauge_residual, distance_residual
from telerig.factors.projection import State, whitened_residuals
from telerig.rig.pose import hat

Array = NDArray[np.float64]


def right_jacobian(w: Array) -> Array:
    """(..., 3, 3): exp(w + dw) = exp(w) exp(J dw) to first order."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    small = np.maximum(angle, 1e-4)
    near = angle < 1e-4
    one = np.where(near, 0.5 - angle**2 / 24, (1 - np.cos(small)) / small**2)
    two = np.where(near, 1 / 6 - angle**2 / 120, (small - np.sin(small)) / small**3)
    k = hat(w)
    return np.asarray(np.eye(3) - one * k + two * (k @ k))


@dataclass
class Flat:
    """Residuals and Jacobian of a problem of two cameras."""

    problem: Problem
    start: State

    def __post_init__(self) -> None:
        problem = self.problem
        self.system = ArraySystem(problem, self.start)
        self.system.chunks = []
        self.obs = problem.observations()
        self.views_at = int(self.system.edges[-1])
        self.dots_at = self.views_at + 6 * len(problem.views)
        self.size = self.dots_at + problem.nominal_mm.size
        self.rows = [np.flatnonzero(self.obs.camera == c) for c in range(2)]
        self.columns = [self._columns(c, rows) for c, rows in enumerate(self.rows)]

    def _columns(self, camera: int, rows: Any) -> Any:
        """(m, k) variables that each measurement of a camera depends on."""
        lens = np.arange(self.size)[self.system.intrinsics_of(camera)]
        pose = np.arange(self.size)[self.system.pose_of(1)] if camera else lens[:0]
        shared = np.broadcast_to(np.r_[lens, pose], (len(rows), len(lens) + len(pose)))
        view = self.views_at + 6 * self.obs.view[rows, None] + np.arange(6)
        dot = self.dots_at + 3 * self.obs.dot[rows, None] + np.arange(3)
        return np.concatenate([shared, view, dot], 1)

    def state(self, x: Array) -> State:
        return self.system.moved(self.start, x)

    def residuals(self, x: Array) -> Array:
        state = self.state(x)
        from telerig.factors.projection import whitened_error

        images = whitened_error(state, self.obs, self.problem.rho_mm)
        parts = [images[rows].ravel() for rows in self.rows]
        return np.concatenate([*parts, *self._priors(state)])

    def _priors(self, state: State) -> list[Array]:
        problem, system = self.problem, self.system
        assert problem.scale is not None
        return [
            *(system.intrinsic_pull(state, c)[0] for c in range(2)),
            depth_gauge_residual(state.rig_from_camera[1], GAUGE_SIGMA_MM)[0],
            state.rig_from_target[:, :3, 3].ravel() / system.loose_mm,
            ((state.dots_mm - problem.nominal_mm) / problem.dot_sigma_mm).ravel(),
            distance_residual(state.dots_mm, *problem.scale)[0],
        ]

    def jacobian(self, x: Array) -> Any:
        """Sparse (R, D): by the perturbation at the state, then by the tangent at the start."""
        problem, system, state = self.problem, self.system, self.state(x)
        full = whitened_residuals(state, self.obs, problem.rho_mm)
        blocks = []
        for c, rows in enumerate(self.rows):
            lens = full.by_intrinsics[rows][..., system.free[c]] * system.unit[c]
            parts = [lens, full.by_view[rows], full.by_dot[rows]]
            if c:
                parts.insert(1, full.by_camera[rows])
            values = np.concatenate(parts, -1)
            blocks.append((values.reshape(-1, values.shape[-1]), np.repeat(self.columns[c], 2, 0)))
        data = np.concatenate([v.ravel() for v, _ in blocks])
        index = np.concatenate([i.ravel() for _, i in blocks])
        width = np.concatenate([np.full(len(v), v.shape[1]) for v, _ in blocks])
        start = np.concatenate([[0], np.cumsum(width)])
        images = csr_array((data, index, start), shape=(len(width), self.size))
        return _stack([images, self._prior_jacobian(state)]) @ self._chain(x)

    def _prior_jacobian(self, state: State) -> Any:
        problem, system = self.problem, self.system
        assert problem.scale is not None
        lens = [np.diag(system.intrinsic_pull(state, c)[1]) for c in range(2)]
        gauge = depth_gauge_residual(state.rig_from_camera[1], GAUGE_SIGMA_MM)[1]
        turn = state.rig_from_target[:, :3, :3] / system.loose_mm
        views = block_diag([np.concatenate([np.zeros((3, 3)), r], 1) for r in turn])
        dots = block_diag([np.diag(1 / problem.dot_sigma_mm.ravel())]) if False else None
        del dots
        weight = 1 / problem.dot_sigma_mm.ravel()
        of_dots = csr_array(
            (weight, (np.arange(len(weight)), np.arange(len(weight)))), shape=(len(weight),) * 2
        )
        far = csr_array(distance_residual(state.dots_mm, *problem.scale)[1])
        common = block_diag([*lens, gauge, views, of_dots], format="csr")
        pad = csr_array((1, self.dots_at))
        from scipy.sparse import hstack

        return _stack([csr_array(common), csr_array(hstack([pad, far]))])

    def _chain(self, x: Array) -> Any:
        """Block diagonal: right perturbation at the state per tangent at the start."""
        from telerig.rig.pose import rotation_from_rotvec

        first = self.views_at - 6
        tangent = x[first : self.dots_at].reshape(-1, 6)
        blocks = np.zeros((len(tangent), 6, 6))
        blocks[:, :3, :3] = right_jacobian(tangent[:, :3])
        blocks[:, 3:, 3:] = np.swapaxes(rotation_from_rotvec(tangent[:, :3]), -1, -2)
        ones = [csr_array(np.eye(first))]
        rest = self.size - self.dots_at
        tail = csr_array((np.ones(rest), (np.arange(rest), np.arange(rest))), shape=(rest, rest))
        return csr_array(block_diag([*ones, *blocks, tail], format="csr"))


def _stack(parts: list[Any]) -> Any:
    from scipy.sparse import vstack

    return csr_array(vstack(parts, format="csr"))


def solve(problem: Problem, start: State, inner: float = 1e-12) -> tuple[State, int]:
    """trf with lsmr, ended when nothing more is gained; the state and the Jacobians evaluated."""
    flat = Flat(problem, start)
    found: Any = least_squares(
        flat.residuals, np.zeros(flat.size), flat.jacobian, method="trf", tr_solver="lsmr",
        x_scale="jac", ftol=1e-11, xtol=1e-14, gtol=1e-14, max_nfev=100,
        tr_options={"atol": inner, "btol": inner, "maxiter": 20 * flat.size},
    )  # fmt: skip
    return replace(flat.state(found.x)), int(found.njev)
