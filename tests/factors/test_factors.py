"""Residuals against central differences; the graph against pure functions and GTSAM's own LM."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from telerig.estimator.calibration.solver import robust_least_squares as graph
from telerig.estimator.calibration.solver.nonlinear_graph import nonlinear_graph
from telerig.estimator.calibration.solver.problem import (
    GAUGE_SIGMA_MM,
    Problem,
    prior_sigma,
    problem_from_dots,
)
from telerig.estimator.calibration.solver.system import System
from telerig.estimator.calibration.start import known_target
from telerig.factors.calibration import (
    Observations,
    State,
    apparent_shift_mm,
    depth_gauge_residual,
    distance_residual,
    whitened_error,
    whitened_residuals,
)
from telerig.factors.custom_factors import Keys, custom_factor
from telerig.rig.lens_parameters import (
    INDEX,
    PARAMETERS,
)
from telerig.rig.pose import rotation_from_rotvec

RHO_MM = (30.0, 28.0)
RICH = {
    "aspect": 1.02, "skew": 0.01, "kappa_per_mm": 2e-3, "k1": 0.03, "k2": -0.01, "k3": 0.004,
    "p1": 0.002, "p2": -0.003, "s1": 0.001, "s2": 0.002, "s3": -0.001, "s4": 0.0005,
    "tilt_x": 0.15, "tilt_y": -0.1, "image_convergence_per_mm": 1 / 300,
}  # fmt: skip


def intrinsics(**parameters: float) -> Any:
    values = dict.fromkeys(PARAMETERS, 0.0) | {
        "scale_px_per_mm": 10.0, "aspect": 1.0, "centre_u_px": 250.0, "centre_v_px": 260.0,
    } | parameters  # fmt: skip
    return np.array([values[p] for p in PARAMETERS])


def pose(rotvec: Any, translation: Any) -> Any:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation_from_rotvec(rotvec), translation
    return out


def random_state(rng: np.random.Generator, rich: dict[str, float], tilt: float = 1.0) -> State:
    cameras = np.array([np.eye(4), pose([0.1, 1.3, -0.2], rng.normal(0, 2, 3))])
    views = np.array([pose(tilt * rng.normal(0, 0.6, 3), rng.normal(0, 5, 3)) for _ in range(3)])
    dots = np.c_[rng.uniform(-12, 12, (5, 2)), rng.normal(0, 0.3, 5)]
    return State(np.array([intrinsics(**rich), intrinsics(**rich)]), cameras, views, dots)


def observations(rng: np.random.Generator, plate: float = 0.0) -> Observations:
    view, camera, dot = (
        a.ravel() for a in np.meshgrid(range(3), range(2), range(5), indexing="ij")
    )
    whitener = rng.normal(0, 1, (30, 2, 2)) + 3 * np.eye(2)
    shift = rng.choice([-1.0, 0.0, 1.0], (3, 2)) if plate else np.zeros((3, 2))
    uv = rng.uniform(100, 400, (30, 2))
    return Observations(view, camera, dot, uv, whitener, shift, (plate, 1.52))


def moved(state: State, block: str, index: int, step: Any) -> State:
    """GTSAM's retraction for poses, plain addition elsewhere."""
    array = getattr(state, block).copy()
    if block in ("rig_from_camera", "rig_from_target"):
        array[index] = gtsam.Pose3(array[index]).retract(step).matrix()
    else:
        array[index] = array[index] + step
    return replace(state, **{block: array})


def central_difference(function: Callable[[Any], Any], size: int, step: Any) -> Any:
    """Fourth order: (8 (f(h) - f(-h)) - (f(2h) - f(-2h))) / 12 h."""
    columns = []
    for k in range(size):
        e = np.zeros(size)
        e[k] = np.broadcast_to(step, size)[k]
        near, far = function(e) - function(-e), function(2 * e) - function(-2 * e)
        columns.append((8 * near - far) / (12 * e[k]))
    return np.stack(columns, -1)


def assert_same_derivatives(state: State, obs: Observations) -> None:
    full = whitened_residuals(state, obs, RHO_MM)
    np.testing.assert_allclose(full.value, whitened_error(state, obs, RHO_MM), atol=1e-10)
    steps = 1e-4 * np.array([parameter_like(p) for p in PARAMETERS])
    for name, owner, block, step in (
        ("by_dot", obs.dot, "dots_mm", 1e-2),
        ("by_view", obs.view, "rig_from_target", 1e-3),
        ("by_camera", obs.camera, "rig_from_camera", 1e-3),
        ("by_intrinsics", obs.camera, "intrinsics", steps),
    ):
        analytic = getattr(full, name)
        first = 0
        if name == "by_camera":  # the first camera's frame is the rig's
            first = 1
            assert not analytic[obs.camera == 0].any()
        for index in range(first, owner.max() + 1):
            expected = central_difference(
                lambda e, b=block, i=index: whitened_error(moved(state, b, i, e), obs, RHO_MM),
                analytic.shape[-1],
                step,
            )
            mine = owner == index
            scale = np.abs(expected[mine]).max((0, 1))
            close = np.abs(analytic[mine] - expected[mine]) / np.maximum(scale, 1e-3 * scale.max())
            assert close.max() < 1e-7, (name, index, close.max())
            assert np.abs(expected[~mine]).max(initial=0.0) < 1e-9


def parameter_like(name: str) -> float:
    special = {"scale_px_per_mm": 10.0, "centre_u_px": 10.0, "centre_v_px": 10.0}
    return special.get(name, 0.01 if name.endswith("per_mm") else 1.0)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("plate_mm", [0.0, 3.0])
def test_projection_jacobians_at_random_points(seed: int, plate_mm: float) -> None:
    rng = np.random.default_rng(seed)
    assert_same_derivatives(random_state(rng, RICH), observations(rng, plate_mm))


@pytest.mark.parametrize("plate_mm", [0.0, 3.0])
def test_projection_jacobians_near_singular_points(plate_mm: float) -> None:
    """Ideal lens (no distortion, tilt, kappa), frontal views, a dot on the optical axis."""
    rng = np.random.default_rng(9)
    state = random_state(rng, {}, tilt=0.0)
    state.dots_mm[0] = 0.0
    views = state.rig_from_target.copy()
    views[0] = np.eye(4)
    # a plate seen edge on has no shift; keep the second camera 20 degrees off that
    cameras = np.array([np.eye(4), pose([0.0, 1.2, 0.0], [0.0, 0.0, 0.0])])
    state = replace(state, rig_from_target=views, rig_from_camera=cameras)
    assert_same_derivatives(state, observations(rng, plate_mm))


def test_projection_jacobians_of_a_long_perspective_lens() -> None:
    rng = np.random.default_rng(3)
    state = random_state(rng, RICH | {"kappa_per_mm": 1 / 150})
    assert_same_derivatives(state, observations(rng))


def test_plate_shift_is_that_of_a_ray_traced_through_the_plate() -> None:
    """Snell by hand: a ray enters at angle i; how deep does its exit point seem to lie?"""
    for angle_deg in (0.01, 20.0, 45.0, 70.0):
        i = np.radians(angle_deg)
        r = np.arcsin(np.sin(i) / 1.52)
        lateral_in_glass = 2.5 * np.tan(r)
        apparent_depth = lateral_in_glass / np.tan(i)
        shift, _ = apparent_shift_mm(np.array(np.cos(i)), 2.5, 1.52)
        assert shift == pytest.approx(2.5 - apparent_depth, abs=1e-9)


def test_distance_residual() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.normal(0, 10, (2, 3))
    value, by_first = distance_residual(first, second, 12.0, 0.01)
    assert value == pytest.approx((np.linalg.norm(first - second) - 12) / 0.01)
    for sign, function in (
        (1, lambda e: distance_residual(first + e, second, 12.0, 0.01)[0]),
        (-1, lambda e: distance_residual(first, second + e, 12.0, 0.01)[0]),
    ):
        expected = central_difference(function, 3, 1e-2)
        np.testing.assert_allclose(sign * by_first, expected, atol=1e-7)


@pytest.mark.parametrize("rotvec", [[0.1, 1.5, -0.3], [0.0, 1e-9, 0.0], [0.0, np.pi - 1e-6, 0.0]])
def test_depth_gauge_residual(rotvec: list[float]) -> None:
    start = pose(rotvec, [0.4, -0.2, 0.7])
    value, jacobian = depth_gauge_residual(start, 1e-2)
    axis = start[:3, 2]
    np.testing.assert_allclose(value, np.array([0.7, start[:3, 3] @ axis]) / 1e-2)
    expected = central_difference(
        lambda e: depth_gauge_residual(gtsam.Pose3(start).retract(e).matrix(), 1e-2)[0], 6, 1e-3
    )
    np.testing.assert_allclose(jacobian, expected, atol=1e-6)


@pytest.fixture(scope="module")
def problem(scene: Any) -> tuple[Problem, State]:
    made = scene("near_telecentric", 4, views=6)
    problem = problem_from_dots(made.dots, made.cameras, made.target).with_model("kappa+brown")
    weight = np.random.default_rng(0).uniform(0.2, 1.0, len(problem.weight))
    weight[7] = 0.0
    problem = replace(problem, weight=weight)
    state = known_target.stereo_states(problem, problem.nominal_mm)[0]
    return problem, state


def cost_by_hand(problem: Problem, state: State) -> float:
    """Half the sum of squares, written out without the graph's residual functions for priors."""
    total = 0.0
    residual = whitened_error(state, problem.unweighted(), problem.rho_mm)
    total += (problem.weight[:, None] * residual**2).sum()
    total += (((state.dots_mm - problem.nominal_mm) / problem.dot_sigma_mm) ** 2).sum()
    assert problem.scale is not None
    (a, b), distance, sigma = problem.scale
    total += ((np.linalg.norm(state.dots_mm[a] - state.dots_mm[b]) - distance) / sigma) ** 2
    for c, camera in enumerate(problem.cameras):
        free = problem.free_indices(c)
        gap = (state.intrinsics[c] - camera.intrinsics) / prior_sigma(camera)
        total += (gap[free] ** 2).sum()
    second = state.rig_from_camera[1]
    total += (second[2, 3] / GAUGE_SIGMA_MM) ** 2
    total += (second[:3, 3] @ second[:3, 2] / GAUGE_SIGMA_MM) ** 2
    total += ((state.rig_from_target[:, :3, 3] / (10 * max(problem.rho_mm))) ** 2).sum()
    return 0.5 * float(total)


def perturbed(state: State, rng: np.random.Generator) -> State:
    intrinsics = state.intrinsics.copy()
    intrinsics[:, INDEX["k1"]] += rng.normal(0, 1e-3, 2)
    intrinsics[:, INDEX["kappa_per_mm"]] += rng.normal(0, 1e-4, 2)
    views = state.rig_from_target.copy()
    views[:, :3, 3] += rng.normal(0, 0.01, (len(views), 3))
    cameras = state.rig_from_camera.copy()
    cameras[1, :3, 3] += rng.normal(0, 1e-4, 3)
    dots = state.dots_mm + rng.normal(0, 0.01, state.dots_mm.shape)
    return State(intrinsics, cameras, views, dots)


def test_the_graph_has_the_cost_of_the_pure_functions(problem: tuple[Problem, State]) -> None:
    made, state = problem
    factors, _, keys = nonlinear_graph(made, state)
    for seed in range(3):
        at = perturbed(state, np.random.default_rng(seed))
        expected = cost_by_hand(made, at)
        assert System(made).gaussian(at).cost == pytest.approx(expected, rel=1e-12)
        assert factors.error(values_of(at, state, keys)) == pytest.approx(expected, rel=1e-9)


def values_of(state: State, start: State, keys: Keys) -> Any:
    values = gtsam.Values()
    for c, (free, unit) in enumerate(zip(keys.free, keys.unit)):
        moved = (state.intrinsics[c] - start.intrinsics[c])[free] / unit
        values.insert(keys.intrinsics[c], moved)
        if c:
            values.insert(keys.camera[c], gtsam.Pose3(state.rig_from_camera[c]))
    for key, view in zip(keys.view, state.rig_from_target):
        values.insert(key, gtsam.Pose3(view))
    for key, dot in zip(keys.dots, state.dots_mm):
        values.insert(key, dot)
    return values


def test_the_graph_gradient_is_the_slope_of_its_cost(problem: tuple[Problem, State]) -> None:
    made, state = problem
    state = perturbed(state, np.random.default_rng(11))
    factors, values, _ = nonlinear_graph(made, state)
    gradient = factors.linearize(values).gradientAtZero()
    slope = gradient.vector()
    direction = np.random.default_rng(2).normal(0, 1, len(slope))
    direction /= np.sqrt((np.abs(slope) * direction**2).sum())
    ends = []
    for sign in (1, -1):
        step, at = gtsam.VectorValues(), 0
        for key in values.keys():  # noqa: SIM118
            size = len(gradient.at(key))
            step.insert(key, sign * 1e-6 * direction[at : at + size])
            at += size
        ends.append(factors.error(values.retract(step)))
    assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(slope @ direction, rel=1e-5)


def test_gtsams_own_optimizer_reaches_the_same_cost(problem: tuple[Problem, State]) -> None:
    made, state = problem
    ours = graph.solve(made, state)
    factors, values, _ = nonlinear_graph(made, state)
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(0.0)
    params.setMaxIterations(200)
    theirs = gtsam.LevenbergMarquardtOptimizer(factors, values, params)
    theirs.optimize()
    assert theirs.error() == pytest.approx(ours.cost, rel=1e-9)


@pytest.mark.parametrize(("rows", "widths"), [(3, [2]), (2, [3]), (2, []), (2, [2, 2]), (1, [2])])
def test_factors_of_wrong_shape_raise(rows: int, widths: list[int]) -> None:
    """GTSAM crashes on a wrong number of rows, and takes a wrong number of columns in silence."""
    key = gtsam.symbol("x", 0)
    values = gtsam.Values()
    values.insert(key, np.zeros(2))
    blocks = [np.zeros((rows, w)) for w in widths]
    factor = custom_factor([key], [2], 2, lambda _: (np.zeros(2), blocks))
    with pytest.raises(AssertionError, match="factor of"):
        factor.linearize(values)
    longer = custom_factor([key], [2], 2, lambda _: (np.zeros(3), [np.zeros((2, 2))]))
    with pytest.raises(AssertionError, match="factor of 2 rows"):
        longer.linearize(values)
