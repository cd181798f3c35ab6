"""The calibration by pyceres with one Python residual for each measured dot.

The residual is written for its own sake, in plain Python numbers with a few small products, as
somebody would who knows the solver; the model is `solver_problem.MODEL`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from solver_scipy import right_jacobian

from telerig.estimator.calibration.solver.problem import GAUGE_SIGMA_MM, Problem, parameter_unit
from telerig.estimator.calibration.solver.system import System
from telerig.factors.calibration import State, depth_gauge_residual, distance_residual
from telerig.rig.lens_parameters import INDEX
from telerig.rig.pose import rotation_from_rotvec

Array = NDArray[np.float64]

LENS = ("scale_px_per_mm", "kappa_per_mm", "k1", "p1", "p2")
_ORDER = [INDEX[name] for name in LENS]


class Dotwise:
    """What both solvers share: start, units, and the residual of one dot."""

    def __init__(self, problem: Problem, start: State) -> None:
        self.problem, self.start = problem, start
        self.system = System(problem)
        for free in self.system.free:
            assert free.tolist() == _ORDER
        self.unit = [parameter_unit(camera)[_ORDER] for camera in problem.cameras]
        centre = [INDEX["centre_u_px"], INDEX["centre_v_px"]]
        self.centre = start.intrinsics[:, centre].tolist()
        self.begin = [start.intrinsics[c, _ORDER] for c in range(2)]
        self.obs = problem.observations()

    def lens(self, camera: int, moved: Array) -> list[float]:
        values: list[float] = (self.begin[camera] + moved * self.unit[camera]).tolist()
        return values

    def dot(
        self, m: int, camera: int, lens: list[float], turn: Array, place: Array, point: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Whitened residual (2,), by camera point (2, 3), by lens (2, 5) and the point there."""
        scale, kappa, k1, p1, p2 = lens
        rho = self.problem.rho_mm[camera]
        in_camera = turn @ point + place
        a, b, c = in_camera.tolist()
        depth = 1 / (1 + kappa * c)
        x, y = a * depth / rho, b * depth / rho
        r2 = x * x + y * y
        radial, s = 1 + k1 * r2, scale * rho
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        xx = s * (radial + 2 * k1 * x * x + 2 * p1 * y + 6 * p2 * x)
        xy = s * (2 * k1 * x * y + 2 * p1 * x + 2 * p2 * y)
        yy = s * (radial + 2 * k1 * y * y + 6 * p1 * y + 2 * p2 * x)
        u, v = self.obs.uv_px[m].tolist()
        pull_u, pull_v = (xx * x + xy * y) * depth, (xy * x + yy * y) * depth
        f = depth / rho
        white = self.obs.whitener[m]
        rows = [
            [s * xd + self.centre[camera][0] - u, xx * f, xy * f, -kappa * pull_u,
             rho * xd, -c * pull_u, s * x * r2, s * 2 * x * y, s * (r2 + 2 * x * x)],
            [s * yd + self.centre[camera][1] - v, xy * f, yy * f, -kappa * pull_v,
             rho * yd, -c * pull_v, s * y * r2, s * (r2 + 2 * y * y), s * 2 * x * y],
        ]  # fmt: skip
        every = white @ np.array(rows)
        return every[:, 0], every[:, 1:4], every[:, 4:] * self.unit[camera], in_camera


def _cross_and_one(point: Array, sign: float) -> Array:
    """(3, 6) [sign hat(point), -sign I]."""
    a, b, c = (sign * point).tolist()
    return np.array([[0, -c, b, -sign, 0, 0], [c, 0, -a, 0, -sign, 0], [-b, a, 0, 0, 0, -sign]])


# --- pyceres


def solve(problem: Problem, start: State) -> tuple[State, int]:
    """One Python cost per measured dot, dots eliminated (DENSE_SCHUR); poses as tangents."""
    import pyceres

    class Cost(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self, rows: int, sizes: list[int], function: Any) -> None:
            super().__init__()
            self.set_num_residuals(rows)
            self.set_parameter_block_sizes(sizes)
            self.function = function

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
            value, blocks = self.function(*parameters)
            residuals[:] = value
            if jacobians is not None:
                for out, block in zip(jacobians, blocks()):
                    if out is not None:
                        out[:] = block.ravel()
            return True

    model = Dotwise(problem, start)
    lens = [np.zeros(len(LENS)) for _ in range(2)]
    second, views = np.zeros(6), [np.zeros(6) for _ in problem.views]
    dots = [dot.copy() for dot in start.dots_mm]
    made, costs = pyceres.Problem(), []

    def add(rows: int, blocks: list[Array], function: Any) -> None:
        costs.append(Cost(rows, [len(b) for b in blocks], function))
        made.add_residual_block(costs[-1], None, blocks)

    poses = Poses(start)
    for m, (v, c, d) in enumerate(zip(model.obs.view, model.obs.camera, model.obs.dot)):
        blocks = [views[v], dots[d], lens[c], *([second] if c else [])]
        add(2, blocks, poses.of_dot(model, m, int(v), int(c)))
    for view, function in zip(views, poses.loose(model)):
        add(3, [view], function)
    for c in range(2):
        value, jacobian = model.system.priors(start).cameras[c]
        size = len(LENS)
        add(size, [lens[c]], _linear(value[:size], np.diag(jacobian)[:size] * model.unit[c]))
    for dot, nominal, sigma in zip(dots, problem.nominal_mm, problem.dot_sigma_mm):
        add(3, [dot], _linear(-nominal / sigma, 1 / sigma))
    add(2, [second], poses.gauge)
    assert problem.scale is not None
    (a, b), distance, sigma = problem.scale
    add(1, [dots[a], dots[b]], _far(distance, sigma))
    options, summary = pyceres.SolverOptions(), pyceres.SolverSummary()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR
    options.num_threads, options.max_num_iterations = 1, 100
    options.function_tolerance, options.gradient_tolerance = 1e-11, 1e-14
    options.parameter_tolerance = 1e-14
    options.logging_type = pyceres.LoggingType.SILENT
    pyceres.solve(options, made, summary)
    lens = [values * unit for values, unit in zip(lens, model.unit)]
    step = np.concatenate([*lens, second, *views, (np.array(dots) - start.dots_mm).ravel()])
    iterations = summary.num_successful_steps + summary.num_unsuccessful_steps
    return model.system.moved(start, step), int(iterations)


def _linear(offset: Array, weight: Array) -> Any:
    return lambda x: (offset + weight * x, lambda: [np.diag(weight)])


def _far(distance: float, sigma: float) -> Any:
    def function(a: Array, b: Array) -> Any:
        value, by_first = distance_residual(a, b, distance, sigma)
        return value[None], lambda: [by_first[None], -by_first[None]]

    return function


class Poses:
    """Poses from tangents at the start, computed once a point: (4, 4), chain (6, 6)."""

    def __init__(self, start: State) -> None:
        self.start = start
        self.known: dict[int, tuple[bytes, Array, Array]] = {}

    def at(self, which: int, tangent: Array) -> tuple[Array, Array]:
        """which : a view, or -1 for the second camera."""
        seen = tangent.tobytes()
        if which not in self.known or self.known[which][0] != seen:
            first = (
                self.start.rig_from_camera[1] if which < 0 else self.start.rig_from_target[which]
            )
            turn = rotation_from_rotvec(tangent[:3])
            pose, chain = first.copy(), np.zeros((6, 6))
            pose[:3, :3] = first[:3, :3] @ turn
            pose[:3, 3] += first[:3, :3] @ tangent[3:]
            chain[:3, :3], chain[3:, 3:] = right_jacobian(tangent[:3]), turn.T
            self.known[which] = (seen, pose, chain)
        return self.known[which][1:]

    def of_dot(self, model: Dotwise, m: int, view: int, camera: int) -> Any:
        def function(of_view: Array, point: Array, moved: Array, *second: Array) -> Any:
            pose, chain = self.at(view, of_view)
            turn, place = pose[:3, :3], pose[:3, 3]
            if camera:
                other, other_chain = self.at(-1, second[0])
                back = other[:3, :3].T
                turn, place = back @ turn, back @ (place - other[:3, 3])
            lens = model.lens(camera, moved)
            value, by_point, by_lens, in_camera = model.dot(m, camera, lens, turn, place, point)

            def blocks() -> list[Array]:
                by_dot = by_point @ turn
                out = [by_dot @ _cross_and_one(point, -1.0) @ chain, by_dot, by_lens]
                if camera:
                    out.append(by_point @ _cross_and_one(in_camera, 1.0) @ other_chain)
                return out

            return value, blocks

        return function

    def gauge(self, second: Array) -> Any:
        pose, chain = self.at(-1, second)
        value, jacobian = depth_gauge_residual(pose, GAUGE_SIGMA_MM)
        return value, lambda: [jacobian @ chain]

    def loose(self, model: Dotwise) -> list[Any]:
        """Each view's place, linear in its tangent."""
        out = []
        for pose in self.start.rig_from_target:
            gain = np.concatenate([np.zeros((3, 3)), pose[:3, :3]], 1) / model.system.place_sigma_mm
            at = pose[:3, 3] / model.system.place_sigma_mm
            out.append(lambda x, g=gain, a=at: (a + g @ x, lambda: [g]))
        return out
