"""The self-calibration against a second implementation: own camera model, own variables, SciPy.

Nothing below the table of measurements is shared with the product: the projection is written from
its definition, rotations are left perturbations of camera_from_rig and rig_from_target (the
product: right ones of rig_from_camera), derivatives are complex steps, the solver is SciPy's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from telerig.estimator.calibration.solver import robust_least_squares as graph
from telerig.estimator.calibration.solver.covariance import joint_covariance
from telerig.estimator.calibration.solver.problem import Problem, problem_from_dots
from telerig.estimator.calibration.start import known_target
from telerig.factors.calibration import State

pytestmark = pytest.mark.usefixtures("without_advice")

GAUGE_MM = 1e-4
PRIOR = {"scale": 0.5, "kappa": 0.5, "k1": 0.5, "k2": 0.5, "p1": 0.2, "p2": 0.2}
NAMES = {
    "scale": "scale_px_per_mm", "kappa": "kappa_per_mm", "k1": "k1", "k2": "k2", "p1": "p1",
    "p2": "p2",
}  # fmt: skip


def small_rotation(w: Any) -> Any:
    """exp of a rotation vector below one radian, by its power series: safe for complex steps."""
    k = np.array([[0 * w[0], -w[2], w[1]], [w[2], 0 * w[0], -w[0]], [-w[1], w[0], 0 * w[0]]])
    total = term = np.eye(3, dtype=w.dtype)
    for n in range(1, 25):
        term = term @ k / n
        total = total + term
    return total


def project(points: Any, lens: dict[str, Any], centre: Any, rho: float) -> Any:
    """Design, section 2: perspective, distortion about the centre, affine map."""
    depth = 1 + lens.get("kappa", 0.0) * points[:, 2]
    x, y = points[:, 0] / depth / rho, points[:, 1] / depth / rho
    r2 = x * x + y * y
    radial = 1 + lens.get("k1", 0.0) * r2 + lens.get("k2", 0.0) * r2 * r2
    p1, p2 = lens.get("p1", 0.0), lens.get("p2", 0.0)
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([lens["scale"] * rho * xd + centre[0], lens["scale"] * rho * yd + centre[1]], 1)


@dataclass
class Reference:
    """Variables: per camera the lens, then w, t of camera 2, w, t per view, dots."""

    problem: Problem
    start: State
    lens: tuple[str, ...]

    def __post_init__(self) -> None:
        p, n = self.problem, len(self.lens)
        self.size = 2 * n + 6 + 6 * len(p.views) + p.nominal_mm.size
        self.views = 2 * n + 6
        self.dots = self.views + 6 * len(p.views)
        second = np.linalg.inv(self.start.rig_from_camera[1])
        self.second_rotation, self.second_place = second[:3, :3], second[:3, 3]
        self.whiten = [np.linalg.inv(np.linalg.cholesky(c)) for c in p.covariance_px2]
        self.scales = [c["scale_px_per_mm"] for c in p.cameras]

    def initial(self) -> Any:
        x = np.zeros(self.size)
        for c in range(2):
            x[c * len(self.lens)] = self.start.intrinsics[c, 0]
        x[self.views - 3 : self.views] = self.second_place
        for v, view in enumerate(self.start.rig_from_target):
            x[self.views + 6 * v + 3 : self.views + 6 * v + 6] = view[:3, 3]
        x[self.dots :] = self.start.dots_mm.ravel()
        return x

    def unpack(self, x: Any) -> Any:
        n = len(self.lens)
        lenses = [dict(zip(self.lens, x[c * n : (c + 1) * n])) for c in range(2)]
        turn = small_rotation(x[2 * n : 2 * n + 3]) @ self.second_rotation
        views = []
        for v, start in enumerate(self.start.rig_from_target):
            at = self.views + 6 * v
            views.append((small_rotation(x[at : at + 3]) @ start[:3, :3], x[at + 3 : at + 6]))
        return lenses, (turn, x[2 * n + 3 : self.views]), views, x[self.dots :].reshape(-1, 3)

    def residuals(self, x: Any) -> Any:
        p = self.problem
        lenses, (turn, place), views, dots = self.unpack(x)
        out = []
        for c, camera in enumerate(p.cameras):
            centre = (np.array(camera.image_size_px) - 1) / 2
            for v, (rotation, shift) in enumerate(views):
                rows = np.flatnonzero((p.view == v) & (p.camera == c))
                points = dots[p.dot[rows]] @ rotation.T + shift
                if c:
                    points = points @ turn.T + place
                uv = project(points, lenses[c], centre, camera.rho_mm) - p.uv_px[rows]
                out += [self.whiten[r] @ d for r, d in zip(rows, uv)]
            for name, value in lenses[c].items():
                nominal = self.scales[c] if name == "scale" else 0.0
                sigma = PRIOR[name]
                sigma *= {"scale": self.scales[c], "kappa": 1 / camera.rho_mm}.get(name, 1.0)
                out.append(np.atleast_1d((value - nominal) / sigma))
        out.append(((dots - p.nominal_mm) / p.dot_sigma_mm).ravel())
        assert p.scale is not None
        (a, b), distance, sigma = p.scale
        gap = dots[a] - dots[b]
        out.append(np.atleast_1d((np.sqrt((gap * gap).sum()) - distance) / sigma))
        # the second camera's origin in the rig is -turn^T place; its axis there turn^T z
        out.append(np.array([-(turn[:, 2] * place).sum(), -place[2]]) / GAUGE_MM)
        out += [shift / (10 * max(p.rho_mm)) for _, shift in views]
        return np.concatenate(out)

    def jacobian(self, x: Any) -> Any:
        columns = []
        for k in range(self.size):
            moved = x.astype(complex)
            moved[k] += 1e-30j
            columns.append(self.residuals(moved).imag / 1e-30)
        return np.stack(columns, 1)

    def recentred(self, x: Any) -> tuple[Reference, Any]:
        """The same place with every rotation vector zero, where it is the tangent vector."""
        _, (turn, place), views, dots = self.unpack(x)
        second, poses = np.eye(4), np.tile(np.eye(4), (len(views), 1, 1))
        second[:3, :3], second[:3, 3] = turn, place
        for pose, (rotation, shift) in zip(poses, views):
            pose[:3, :3], pose[:3, 3] = rotation, shift
        cameras = np.array([np.eye(4), np.linalg.inv(second)])
        state = State(self.start.intrinsics, cameras, poses, dots)
        out = Reference(self.problem, state, self.lens)
        at = out.initial()
        at[: 2 * len(self.lens)] = x[: 2 * len(self.lens)]
        return out, at

    def product_from_own(self, x: Any) -> Any:
        """Linear map from small changes of these variables to those of the product's tangent."""
        n = len(self.lens)
        out = np.eye(self.size)
        place = x[2 * n + 3 : self.views].real
        cross = np.array(
            [[0, -place[2], place[1]], [place[2], 0, -place[0]], [-place[1], place[0], 0]]
        )
        # camera_from_rig = exp(w) R, t + dt; its inverse moves by (-w, -t x w - dt)
        out[2 * n : self.views, 2 * n : self.views] = np.block(
            [[-np.eye(3), np.zeros((3, 3))], [-cross, -np.eye(3)]]
        )
        _, _, views, _ = self.unpack(x)
        for v, (rotation, _) in enumerate(views):
            for block in (0, 3):
                at = slice(self.views + 6 * v + block, self.views + 6 * v + block + 3)
                out[at, at] = rotation.T
        return out


def solved(scene: Any, preset: str, model: str, lens: tuple[str, ...]) -> Any:
    made = scene(preset, 7, views=5)
    problem = problem_from_dots(made.dots, made.cameras, made.target).with_model(model)
    start = known_target.stereo_states(problem, problem.nominal_mm)[0]
    ours = graph.solve(problem, start)
    reference = Reference(problem, start, lens)
    fit = least_squares(
        reference.residuals, reference.initial(), reference.jacobian, method="lm",
        x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15, max_nfev=300,
    )  # fmt: skip
    return problem, ours, reference, fit


@pytest.fixture(
    scope="module",
    params=[
        ("paper", "radial", ("scale", "k1")),
        ("near_telecentric", "kappa+tangential", ("scale", "kappa", "k1", "p1", "p2")),
    ],
    ids=["paper", "near_telecentric"],
)
def both(request: Any, scene: Any) -> Any:
    return solved(scene, *request.param)


def test_cost(both: Any) -> None:
    _, ours, _, fit = both
    assert fit.cost > 100
    assert ours.cost == pytest.approx(fit.cost, rel=1e-9)


def test_parameters(both: Any) -> None:
    """Equal to a thousandth of their standard deviation."""
    problem, ours, reference, fit = both
    lenses, (turn, place), views, dots = reference.unpack(fit.x)
    sd = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
    for c in range(2):
        for i, name in enumerate(reference.lens):
            at = c * len(reference.lens) + i
            index = problem.free_indices(c)[problem.free[c].index(NAMES[name])]
            found = ours.state.intrinsics[c, index]
            assert found == pytest.approx(lenses[c][name], abs=1e-3 * sd[at])
    second = np.linalg.inv(ours.state.rig_from_camera[1])
    np.testing.assert_allclose(
        second[:3, :3], turn, atol=1e-3 * sd[reference.views - 6 :][:3].min()
    )
    np.testing.assert_allclose(second[:3, 3], place, atol=1e-7)
    for v, (rotation, shift) in enumerate(views):
        at = reference.views + 6 * v
        found = ours.state.rig_from_target[v]
        np.testing.assert_allclose(found[:3, :3], rotation, atol=1e-3 * sd[at : at + 3].min())
        np.testing.assert_allclose(found[:3, 3], shift, atol=1e-3 * sd[at + 3 : at + 6].min())
    np.testing.assert_allclose(ours.state.dots_mm, dots, atol=1e-3 * sd[reference.dots :].min())


def test_covariance(both: Any) -> None:
    """Every entry, to 1e-6 of the two standard deviations that belong to it."""
    problem, ours, reference, fit = both
    joint = joint_covariance(problem, ours)
    reference, at = reference.recentred(fit.x)
    jacobian = reference.jacobian(at)
    scale = 1 / np.linalg.norm(jacobian, axis=0)
    own = np.linalg.inv((jacobian * scale).T @ (jacobian * scale)) * np.outer(scale, scale)
    carry = reference.product_from_own(at)
    order = product_order(reference, joint.names)
    expected = (carry @ own @ carry.T)[np.ix_(order, order)]
    sd = np.sqrt(np.diag(expected))
    assert np.abs((joint.matrix - expected) / np.outer(sd, sd)).max() < 1e-6


def product_order(reference: Reference, names: tuple[str, ...]) -> list[int]:
    """Where each of the product's components stands among the reference's variables."""
    lens, order = len(reference.lens), []
    back = {v: k for k, v in NAMES.items()}
    for i, name in enumerate(names):
        owner, component = name.split(".")
        if owner in ("left", "right") and component in back:
            c = int(owner == "right")
            order.append(c * lens + reference.lens.index(back[component]))
        else:
            order.append(i)
    return order
