"""How the dots of a self-calibration are best laid out as GTSAM variables and factors.

Usage: python benchmarks/factor_layouts.py [--repeat 7] [--out FILE.md]

The preset `paper` (12 views, 2 cameras, 15 dots) with every dot a variable of the graph, from the
closed-form start to a relative decrease of 1e-9, in CPU milliseconds of one core (the best of
several runs). "Shared": the residuals of all images are evaluated at once in NumPy and every
factor takes its rows; "own": every factor evaluates its own. Loops: ours (GTSAM linearises, the
dense normal equations are damped and solved here) and GTSAM's LevenbergMarquardtOptimizer.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from calibration_scene import make_scene
from numpy.typing import NDArray

from telerig.estimator.calibration.solver import levenberg_marquardt as product
from telerig.estimator.calibration.solver.problem import (
    GAUGE_SIGMA_MM,
    Problem,
    parameter_unit,
    prior_sigma,
)
from telerig.estimator.calibration.start import known_target
from telerig.factors.priors import (
    custom_factor,
    depth_gauge_residual,
    diagonal_prior,
    distance_residual,
)
from telerig.factors.projection import Observations, State, whitened_residuals
from telerig.io.simulation.presets import preset

Array = NDArray[np.float64]

TARGET_MS = 20.0
LAYOUTS = {
    "one factor a dot, a key a dot": ("dot", True),
    "one factor an image, a key a dot": ("image", True),
    "one factor an image, one key for all dots": ("image", False),
    "a single factor, a key a dot": ("all", True),
    "a single factor, one key for all dots": ("all", False),
}


@dataclass
class Layout:
    """A graph of the problem in one layout; keys in the order of elimination, with their sizes."""

    problem: Problem
    start: State
    split: str
    key_per_dot: bool
    shared: bool

    def __post_init__(self) -> None:
        p = self.problem
        self.obs = p.observations()
        self.keys = p.keys()
        count = len(p.dot_ids)
        if self.key_per_dot:
            self.dot_keys = [gtsam.symbol("d", i) for i in range(count)]
        else:
            self.dot_keys = [self.keys.dots]
        self.sizes = {k: len(f) for k, f in zip(self.keys.intrinsics, self.keys.free)}
        self.sizes |= {self.keys.camera[1]: 6} | dict.fromkeys(self.keys.view, 6)
        self.sizes |= dict.fromkeys(self.dot_keys, 3 if self.key_per_dot else 3 * count)
        self.poses = {*self.keys.view, *self.keys.camera}
        self.seen: dict[int, bytes] = {}
        self.full: Any = None

    # --- values <-> arrays

    def values(self) -> Any:
        values = gtsam.Values()
        for key, pose in zip(self.keys.view, self.start.rig_from_target):
            values.insert(key, gtsam.Pose3(pose))
        for key, free in zip(self.keys.intrinsics, self.keys.free):
            values.insert(key, np.zeros(len(free)))
        values.insert(self.keys.camera[1], gtsam.Pose3(self.start.rig_from_camera[1]))
        for key, dots in zip(self.dot_keys, self._blocks(self.start.dots_mm)):
            values.insert(key, dots.ravel())
        return values

    def _blocks(self, dots: Array) -> list[Array]:
        return list(dots) if self.key_per_dot else [dots]

    def _bytes(self, values: Any, key: int) -> bytes:
        if key in self.poses:
            return bytes(values.atPose3(key).matrix().tobytes())
        return bytes(values.atVector(key).tobytes())

    def state(self, values: Any) -> State:
        intrinsics = self.start.intrinsics.copy()
        for c, free in enumerate(self.keys.free):
            step = values.atVector(self.keys.intrinsics[c]) * self.keys.unit[c]
            intrinsics[c, free] += step
        cameras = np.array([np.eye(4), values.atPose3(self.keys.camera[1]).matrix()])
        views = np.array([values.atPose3(k).matrix() for k in self.keys.view])
        dots = np.concatenate([values.atVector(k) for k in self.dot_keys]).reshape(-1, 3)
        return State(intrinsics, cameras, views, dots)

    # --- factors

    def graph(self) -> Any:
        p, out = self.problem, gtsam.NonlinearFactorGraph()
        for rows in self._groups():
            out.add(self._projection(rows))
        sigmas = self._blocks(np.broadcast_to(p.dot_sigma_mm, p.nominal_mm.shape))
        for key, place, sigma in zip(self.dot_keys, self._blocks(p.nominal_mm), sigmas):
            out.add(diagonal_prior(key, place.ravel(), sigma.ravel()))
        out.add(self._distance())
        for c, (key, free) in enumerate(zip(self.keys.intrinsics, self.keys.free)):
            nominal = p.cameras[c]
            unit = parameter_unit(nominal)[free]
            mean = (nominal.intrinsics - self.start.intrinsics[c])[free] / unit
            out.add(diagonal_prior(key, mean, prior_sigma(nominal)[free] / unit))
        out.add(self._gauge())
        noise = gtsam.noiseModel.Isotropic.Sigma(3, 10 * max(p.rho_mm))
        for key in self.keys.view:
            out.add(gtsam.PoseTranslationPrior3D(key, gtsam.Pose3(), noise))
        return out

    def _groups(self) -> list[Any]:
        every = np.arange(len(self.obs))
        if self.split == "all":
            return [every]
        if self.split == "dot":
            return [np.array([i]) for i in every]
        image = self.obs.view * 2 + self.obs.camera
        return [np.flatnonzero(image == k) for k in np.unique(image)]

    def _projection(self, rows: Any) -> Any:
        columns = self._columns(rows)
        keys, size = list(columns), 2 * len(rows)
        part = _rows(self.obs, rows)

        def residual(values: Any) -> tuple[Array, list[Array]]:
            if self.shared:
                full = self._evaluate(values, keys)
                take = rows
            else:
                full = whitened_residuals(self.state(values), part, self.problem.rho_mm)
                take = np.arange(len(rows))
            blocks = [columns[k](full, take).reshape(size, -1) for k in keys]
            return full.value[take].ravel(), blocks

        return custom_factor(keys, size, [self.sizes[k] for k in keys], residual)

    def _evaluate(self, values: Any, keys: list[int]) -> Any:
        if self.full is None or any(self.seen[k] != self._bytes(values, k) for k in keys):
            self.full = whitened_residuals(self.state(values), self.obs, self.problem.rho_mm)
            self.seen = {k: self._bytes(values, k) for k in self.sizes}
        return self.full

    def _columns(self, rows: Any) -> dict[int, Callable[[Any, Any], Array]]:
        """Per key of a factor: its Jacobian's block from residuals and the rows to take."""
        obs, keys = self.obs, self.keys
        views, cameras, dots = obs.view[rows], obs.camera[rows], obs.dot[rows]
        out: dict[int, Callable[[Any, Any], Array]] = {}

        def only(mine: Any, block: Callable[[Any], Array]) -> Callable[[Any, Any], Array]:
            if mine.all():
                return lambda full, take: block(full)[take]
            return lambda full, take: np.where(mine[:, None, None], block(full)[take], 0.0)

        for c in np.unique(cameras):
            free, unit = keys.free[c], keys.unit[c]
            out[keys.intrinsics[c]] = only(
                cameras == c, lambda f, i=free, u=unit: f.by_intrinsics[..., i] * u
            )
        if cameras.any():
            out[keys.camera[1]] = only(cameras == 1, lambda f: f.by_camera)
        for v in np.unique(views):
            out[keys.view[v]] = only(views == v, lambda f: f.by_view)
        if self.key_per_dot:
            for d in np.unique(dots):
                out[self.dot_keys[d]] = only(dots == d, lambda f: f.by_dot)
        else:
            out[keys.dots] = lambda full, take: self._scattered(full.by_dot[take], dots)
        return out

    def _scattered(self, by_dot: Array, dots: Any) -> Array:
        block = np.zeros((len(dots), 2, len(self.problem.dot_ids), 3))
        block[np.arange(len(dots)), :, dots] = by_dot
        return block

    def _distance(self) -> Any:
        assert self.problem.scale is not None
        (a, b), distance, sigma = self.problem.scale
        if not self.key_per_dot:
            key = self.keys.dots

            def of_all(values: Any) -> tuple[Array, list[Array]]:
                dots = values.atVector(key).reshape(-1, 3)
                value, jac = distance_residual(dots, (a, b), distance, sigma)
                return value, [jac]

            return custom_factor([key], 1, [self.sizes[key]], of_all)
        pair = [self.dot_keys[a], self.dot_keys[b]]

        def of_two(values: Any) -> tuple[Array, list[Array]]:
            dots = np.array([values.atVector(k) for k in pair])
            value, jac = distance_residual(dots, (0, 1), distance, sigma)
            return value, [jac[:, :3], jac[:, 3:]]

        return custom_factor(pair, 1, [3, 3], of_two)

    def _gauge(self) -> Any:
        key = self.keys.camera[1]

        def residual(values: Any) -> tuple[Array, list[Array]]:
            value, jac = depth_gauge_residual(values.atPose3(key).matrix(), GAUGE_SIGMA_MM)
            return value, [jac]

        return custom_factor([key], 2, [6], residual)

    # --- solvers

    def ours(self) -> tuple[float, int]:
        """The product's loop (`telerig.estimator.calibration.solver.graph.solve`) for any keys."""
        factors, values = self.graph(), self.values()
        ordering = gtsam.Ordering()
        for key in self.sizes:
            ordering.push_back(key)
        cost, damping = factors.error(values), 1e-4
        information, gradient = factors.linearize(values).hessian(ordering)
        iteration = 0
        while iteration < 60:
            iteration += 1
            step, promised = product._damped_step(information, gradient, damping)
            if promised <= 1e-9 * cost and damping <= product.NEARLY_UNDAMPED:
                break
            delta, at = gtsam.VectorValues(), 0
            for key, size in self.sizes.items():
                delta.insert(key, step[at : at + size])
                at += size
            trial = values.retract(delta)
            trial_cost = factors.error(trial)
            gained = cost - trial_cost
            if gained < -1e-13 * cost:
                damping *= 10
                continue
            values, cost, damping = trial, trial_cost, max(damping / 10, 1e-12)
            information, gradient = factors.linearize(values).hessian(ordering)
            if promised <= 1e-9 * cost and gained <= 1e-9 * cost:
                break
        return cost, iteration

    def gtsams(self) -> tuple[float, int]:
        params = gtsam.LevenbergMarquardtParams()
        params.setRelativeErrorTol(1e-9)
        params.setAbsoluteErrorTol(0.0)
        optimizer = gtsam.LevenbergMarquardtOptimizer(self.graph(), self.values(), params)
        optimizer.optimize()
        return optimizer.error(), optimizer.iterations()


def _rows(obs: Observations, rows: Any) -> Observations:
    fields = {k: getattr(obs, k)[rows] for k in ("view", "camera", "dot", "uv_px", "whitener")}
    return replace(obs, **fields)


def best_ms(solve: Callable[[], tuple[float, int]], repeat: int) -> tuple[float, float, int]:
    best, cost, iterations = np.inf, 0.0, 0
    for _ in range(repeat):
        began = time.process_time()
        cost, iterations = solve()
        best = min(best, time.process_time() - began)
    return 1e3 * best, cost, iterations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    problem = make_scene(preset("paper"), np.random.default_rng(1)).problem().with_model("radial")
    start = known_target.stereo_states(problem, problem.nominal_mm)[0]

    def solved() -> tuple[float, int]:
        solution = product.solve(problem, start, relative=1e-9)
        return solution.cost, solution.iterations

    ms, cost, iterations = best_ms(solved, options.repeat)
    lines = [
        "# Layouts of the self-calibration graph",
        "",
        *(__doc__ or "").strip().splitlines()[4:],
        "",
        f"**The product: {ms:.1f} ms** ({iterations} iterations; target {TARGET_MS:g} ms), one "
        "factor an image, one key for all dots, shared.",
        "",
        "| factors and keys | residuals | our loop ms (iterations) | GTSAM's ms (iterations) |",
        "|---|---|---|---|",
    ]
    for name, (split, key_per_dot) in LAYOUTS.items():
        for shared in (True, False) if split != "all" else (True,):
            layout = Layout(problem, start, split, key_per_dot, shared)
            cells = []
            for solve in (layout.ours, layout.gtsams):
                ms, found, iterations = best_ms(solve, options.repeat if shared else 2)
                same = abs(found / cost - 1) < 1e-8
                cells.append(f"{ms:.1f} ({iterations})" + ("" if same else f" cost {found:.9g}"))
            lines.append(f"| {name} | {'shared' if shared else 'own'} | {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    text = "\n".join(lines) + "\n"
    print(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
