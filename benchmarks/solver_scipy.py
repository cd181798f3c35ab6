"""The calibration by SciPy's least_squares, with a sparse analytic Jacobian.

Same variables, units, priors and gauge as the product; poses are tangent vectors at the start. The
sparsity pattern is made once, values are written into one CSR array.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import csr_array

from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.solver.system import System
from telerig.factors.calibration import State, whitened_error
from telerig.rig.pose import hat, rotation_from_rotvec

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


class Flat:
    """Residuals and Jacobian of a problem of two cameras as functions of a flat vector."""

    def __init__(self, problem: Problem, start: State) -> None:
        self.system, self.start = System(problem), start
        system = self.system
        index, width = [], []
        for own, obs in zip(system.camera_places, system.images):
            view = system.views_at + 6 * obs.view[:, None] + np.arange(6)
            dot = system.dots_at + 3 * obs.dot[:, None] + np.arange(3)
            shared = np.broadcast_to(own, (len(obs), len(own)))
            index.append(np.repeat(np.concatenate([shared, view, dot], 1), 2, 0).ravel())
            width.append(np.full(2 * len(obs), len(own) + 9))
        priors = system.priors(start)
        for own, (value, _) in zip(system.camera_places, priors.cameras):
            index.append(np.tile(own, len(value)))
            width.append(np.full(len(value), len(own)))
        views = np.arange(system.views_at, system.dots_at).reshape(-1, 6)
        dots = np.arange(system.dots_at, system.size)
        index += [np.repeat(views, 3, 0).ravel(), dots]
        width += [np.full(3 * len(views), 6), np.ones(len(dots), int)]
        assert priors.distance is not None
        pair = np.array(priors.distance[0])
        index.append((system.dots_at + 3 * pair[:, None] + np.arange(3)).ravel())
        width.append(np.array([6]))
        self.index = np.concatenate(index)
        self.edges = np.r_[0, np.cumsum(np.concatenate(width))]

    def state(self, x: Array) -> State:
        return self.system.moved(self.start, x)

    def residuals(self, x: Array) -> Array:
        state, system = self.state(x), self.system
        rho_mm = system.problem.rho_mm
        images = [whitened_error(state, obs, rho_mm).ravel() for obs in system.images]
        priors = system.priors(state)
        assert priors.distance is not None
        own = [value for value, _ in priors.cameras]
        far = np.array([priors.distance[1]])
        return np.concatenate([*images, *own, priors.views[0].ravel(), priors.dots[0].ravel(), far])

    def jacobian(self, x: Array) -> Any:
        """By the perturbation at the state, times that per tangent at the start."""
        state, system = self.state(x), self.system
        camera = self._chain(x[system.camera_places[1][-6:]])
        views = self._chain(x[system.views_at : system.dots_at].reshape(-1, 6))
        parts = []
        for c, obs in enumerate(system.images):
            columns = system.columns(state, c)[:-1].transpose(2, 1, 0)
            shared, by_view = columns[..., :-6], columns[..., -6:]
            if c:
                shared = np.concatenate([shared[..., :-6], shared[..., -6:] @ camera], -1)
            parts.append(np.concatenate([shared, by_view @ views[obs.view], by_view[..., 3:]], -1))
        priors = system.priors(state)
        assert priors.distance is not None
        for c, (_, jacobian) in enumerate(priors.cameras):
            if c:
                jacobian = np.concatenate([jacobian[:, :-6], jacobian[:, -6:] @ camera], -1)
            parts.append(jacobian)
        by_first = priors.distance[2]
        parts += [priors.views[1] @ views, priors.dots[1], np.r_[by_first, -by_first]]
        data = np.concatenate([part.ravel() for part in parts])
        return csr_array((data, self.index, self.edges), shape=(len(self.edges) - 1, system.size))

    @staticmethod
    def _chain(tangent: Array) -> Array:
        """(..., 6, 6) right perturbation at the state per tangent at the start."""
        out = np.zeros((*tangent.shape, 6))
        out[..., :3, :3] = right_jacobian(tangent[..., :3])
        out[..., 3:, 3:] = np.swapaxes(rotation_from_rotvec(tangent[..., :3]), -1, -2)
        return out


def solve(problem: Problem, start: State, inner: float = 1e-10) -> tuple[State, int]:
    """trf with lsmr, ended when nothing more is gained; the state and the Jacobians evaluated."""
    flat = Flat(problem, start)
    found: Any = least_squares(
        flat.residuals, np.zeros(flat.system.size), flat.jacobian, method="trf", tr_solver="lsmr",
        x_scale="jac", ftol=1e-11, xtol=1e-14, gtol=1e-14, max_nfev=100,
        tr_options={"atol": inner, "btol": inner, "maxiter": 20 * flat.system.size},
    )  # fmt: skip
    return flat.state(found.x), int(found.njev)
