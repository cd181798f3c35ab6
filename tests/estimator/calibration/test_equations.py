"""The Gaussian at a state, eliminated by GTSAM and by NumPy, against the multiplied-out Jacobian.

The reference multiplies out `whitened_residuals`, which test_factors.py proves by itself, and adds
priors that are written down here once more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.solver import covariance
from telerig.estimator.calibration.solver import robust_least_squares as lm
from telerig.estimator.calibration.solver import system as systems
from telerig.estimator.calibration.solver.covariance import joint_covariance
from telerig.estimator.calibration.solver.gaussian import Estimate, Gaussian
from telerig.estimator.calibration.solver.problem import (
    GAUGE_SIGMA_MM,
    Problem,
    nominal_state,
    prior_sigma,
    problem_from_dots,
    whitening,
)
from telerig.estimator.calibration.solver.system import System, images_of, slots
from telerig.estimator.calibration.start import known_target
from telerig.factors.calibration import State, whitened_error, whitened_residuals
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.target import Target
from telerig.rig.windows import Wall

pytestmark = pytest.mark.usefixtures("without_advice")

SOLVERS = ("gtsam", "numpy")

MODELS = {
    "scale": {"scale_px_per_mm": 20.4},
    "radial": {"k1": 0.02, "k2": -0.01, "k3": 0.004},
    "one power": {"k1": 0.02},
    "tangential": {"p1": 0.003, "p2": -0.002},
    "prism": {"s1": 0.004, "s2": 0.002, "s3": -0.003, "s4": 0.005},
    "affine": {"aspect": 1.01, "skew": -0.004, "k1": 0.01},
    "kappa": {"kappa_per_mm": 2e-3, "k1": 0.01, "centre_u_px": 520.0, "centre_v_px": 380.0},
    "tilt": {"tilt_x": 0.05, "tilt_y": -0.03, "image_convergence_per_mm": 1e-3, "p1": 0.002},
}


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def problem_of(
    free: tuple[str, ...],
    rng: Any,
    seen: float = 0.9,
    walls: tuple[Any, ...] = (None, None),
    cameras: int = 2,
) -> Problem:
    """Five views, twelve dots of which a share is seen; random measurements."""
    views, dots = 5, 12
    turns = [Pose.from_rotvec((0.1 * c, np.deg2rad(60 * c), 0.0), (c, -2.0 * c, 3.0 * c))
             for c in range(cameras)]  # fmt: skip
    made = [
        Camera.create("abcd"[c], (1024, 768), 20.0 + c, camera_from_rig=turns[c])
        for c in range(cameras)
    ]
    made = [replace(c, wall=w) for c, w in zip(made, (*walls, None, None))]
    view, camera, dot = np.nonzero(rng.random((views, cameras, dots)) < seen)
    factor = rng.normal(size=(len(view), 2, 2)) + 3 * np.eye(2)
    target = Target(rows=3, columns=4, pitch_mm=(5.0, 5.0))
    columns, rows = np.meshgrid(np.arange(4), np.arange(3))
    nominal = np.stack([5.0 * columns.ravel(), 5.0 * rows.ravel(), 0 * rows.ravel()], -1)
    of_camera = (("scale_px_per_mm", *free), ("scale_px_per_mm", *free[: 1 + len(free) // 2]))
    return Problem(
        tuple(made), target, tuple(f"{v:02}" for v in range(views)), np.arange(dots),
        nominal, np.full((dots, 3), 0.02), view, camera, dot, rng.uniform(0, 900, (len(view), 2)),
        np.zeros((len(view), 2)), 0.01 * factor @ np.swapaxes(factor, -1, -2),
        rng.uniform(0.1, 1, len(view)),
        (*of_camera, *of_camera)[:cameras], ((0, 11), 18.0, 0.001), np.zeros((views, cameras)),
    )  # fmt: skip


def state_of(problem: Problem, values: dict[str, float], rng: Any) -> State:
    state = nominal_state(problem)
    cameras = [c.with_parameters(**values) for c in problem.cameras]
    intrinsics = np.array([c.intrinsics for c in cameras])
    intrinsics[1] *= 1.01
    views = np.tile(np.eye(4), (len(problem.views), 1, 1))
    views[:, :3, :3] = rotation_from_rotvec(0.4 * rng.normal(size=(len(views), 3)))
    views[:, :3, 3] = rng.uniform(-6, 6, (len(views), 3)) + [0, 0, 60]
    dots = problem.nominal_mm + 0.1 * rng.normal(size=problem.nominal_mm.shape)
    return replace(state, intrinsics=intrinsics, rig_from_target=views, dots_mm=dots)


def of_images(problem: Problem, state: State) -> tuple[Any, Any]:
    """(R, D) whole Jacobian of the images, and (R,) their residual."""
    obs, place = problem.observations(), slots(problem)
    full = whitened_residuals(state, obs, problem.rho_mm)
    out = np.zeros((len(obs), 2, place["dots"][0].stop))
    for m, (v, c, d) in enumerate(zip(obs.view, obs.camera, obs.dot)):
        free = problem.free_indices(c)
        out[m][:, place["intrinsics"][c]] = full.by_intrinsics[m][:, free]
        if c:
            out[m][:, place["camera"][c]] = full.by_camera[m]
        out[m][:, place["view"][v]] = full.by_view[m]
        dot = place["dots"][0].start + 3 * d
        out[m][:, dot : dot + 3] = full.by_dot[m]
    return out.reshape(-1, out.shape[-1]), full.value.ravel()


def of_priors(problem: Problem, state: State) -> tuple[Any, Any]:
    """(R, D) and (R,) of everything else, written down here, by fourth-order differences."""
    system = System(problem)

    def residual(at: State) -> Any:
        parts = []
        for c, camera in enumerate(problem.cameras):
            free = problem.free_indices(c)
            gap = (at.intrinsics[c] - camera.intrinsics) / prior_sigma(camera)
            parts.append(gap[free])
            pose = at.rig_from_camera[c]
            if c == 1:
                parts.append([pose[2, 3] / GAUGE_SIGMA_MM])
            if c:
                parts.append([pose[:3, 3] @ pose[:3, 2] / GAUGE_SIGMA_MM])
        parts.append(at.rig_from_target[:, :3, 3].ravel() / (10 * max(problem.rho_mm)))
        parts.append(((at.dots_mm - problem.nominal_mm) / problem.dot_sigma_mm).ravel())
        if problem.scale is not None:
            (a, b), distance, sigma = problem.scale
            length = np.linalg.norm(at.dots_mm[a] - at.dots_mm[b])
            parts.append([(length - distance) / sigma])
        return np.concatenate(parts)

    columns = []
    for k in range(system.size):
        step = np.zeros(system.size)
        step[k] = 1e-3
        near, far = (
            residual(system.moved(state, n * step)) - residual(system.moved(state, -n * step))
            for n in (1, 2)
        )
        columns.append((8 * near - far) / 12e-3)
    return np.stack(columns, -1), residual(state)


def dense(gaussian: Gaussian) -> Any:
    """The information matrix (D, D)."""
    size, at = len(gaussian.common), gaussian.of_blocks
    out = np.zeros((len(gaussian.right),) * 2)
    out[:size, :size] = gaussian.common
    out[:size, at] = gaussian.cross.swapaxes(1, 2)
    out[at, :size] = gaussian.cross.transpose(2, 1, 0)
    out[at[:, :, None], at[:, None]] = gaussian.blocks
    if gaussian.distance is not None:
        row = np.zeros(len(out))
        for dot, sign in zip(gaussian.distance[0], (1, -1)):
            row[at[dot]] = sign * gaussian.distance[1]
        out += np.outer(row, row)
    return out


def check(problem: Problem, state: State) -> None:
    """Cost, information, right side, damped step and inverse, by either solver."""
    parts = zip(of_images(problem, state), of_priors(problem, state))
    jacobian, value = (np.concatenate(pair) for pair in parts)
    information, right = jacobian.T @ jacobian, -jacobian.T @ value
    length = np.sqrt(np.maximum(np.diag(information), 1e-30))
    unit = np.outer(length, length)
    correlation = np.linalg.inv(information / unit)
    sd = np.sqrt(np.diag(correlation))
    for solver in SOLVERS:
        ours = System(replace(problem, solver=solver)).gaussian(state)
        assert ours.cost == pytest.approx(0.5 * value @ value, rel=1e-12)
        assert np.abs((dense(ours) - information) / unit).max() < 1e-9
        np.testing.assert_allclose(ours.diagonal, np.diag(information), rtol=1e-9)
        given = ours.right[: len(right)]
        np.testing.assert_allclose(given / length, right / length, rtol=1e-5, atol=1e-6)
        for damping in (1e-6, 1e-3, 1.0):
            damped = dense(ours) + damping * np.diag(np.diag(information))
            step, promised = ours.step(damping)
            expected = np.linalg.solve(damped / unit, given / length)
            off = np.abs(step * length - expected).max()
            assert off < 1e-6 * np.abs(expected).max()
            assert promised == pytest.approx(0.5 * step @ given)
        some = np.arange(0, len(right), 3)
        bound = np.outer(sd, sd) / unit
        off = ours.marginal(some) - (correlation / unit)[np.ix_(some, some)]
        assert np.abs(off / bound[np.ix_(some, some)]).max() < 2e-5
        for whole in (True, False):
            common, cross, blocks, every = ours.covariance(whole=whole)
            assert (every is not None) or not whole
            size = len(common)
            inverse = correlation / unit
            near = np.outer(sd, sd) / unit
            wanted, bound = inverse[:size, :size], near[:size, :size]
            assert np.abs((common - wanted) / bound).max() < 2e-5
            wanted, bound = inverse[:size, size:], near[:size, size:]
            assert np.abs((cross.reshape(size, -1) - wanted) / bound).max() < 2e-5
            for d, block in enumerate(blocks):
                at = size + 3 * d + np.arange(3)
                assert np.abs((block - inverse[np.ix_(at, at)]) / near[np.ix_(at, at)]).max() < 2e-5


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("seen", [1.0, 0.6])
def test_every_lens(model: str, seen: float, rng: Any) -> None:
    free = tuple(n for n in MODELS[model] if n != "scale_px_per_mm")
    problem = problem_of(free, rng, seen)
    check(problem, state_of(problem, MODELS[model], rng))


@pytest.mark.parametrize("model", ["scale", "tilt", "kappa"])
def test_free_but_zero(model: str, rng: Any) -> None:
    """Steps that do nothing yet are left out of the value, not of the derivatives."""
    free = tuple(n for n in MODELS[model] if n != "scale_px_per_mm")
    problem = problem_of(free, rng)
    check(problem, state_of(problem, {}, rng))


@pytest.mark.parametrize("both", [False, True])
@pytest.mark.parametrize("kappa", [0.0, 2e-3])
def test_behind_walls(kappa: float, both: bool, rng: Any) -> None:
    normal = np.array([0.05, -0.02, 1.0])
    wall = Wall(normal / np.linalg.norm(normal), 20.0, 8.0, (1.0, 1.5, 1.33), 0.01)
    walls = (wall if both else None, wall)
    problem = problem_of(("wall_x_rad", "wall_y_rad", "kappa_per_mm"), rng, walls=walls)
    values = {"kappa_per_mm": kappa, "wall_x_rad": 0.01, "wall_y_rad": -0.02, "k1": 0.01}
    check(problem, state_of(problem, values, rng))


def test_through_a_plate(rng: Any) -> None:
    problem = problem_of(("k1",), rng)
    target = replace(problem.target, plate_thickness_mm=3.0, plate_index=1.5)
    shift = rng.choice([-1.0, 0.0, 1.0], (5, 2))
    problem = replace(problem, target=target, plate_shift=shift)
    check(problem, state_of(problem, {"k1": 0.02}, rng))


@pytest.mark.parametrize("cameras", [3, 4])
def test_more_cameras(cameras: int, rng: Any) -> None:
    problem = problem_of(("k1", "p1"), rng, cameras=cameras)
    check(problem, state_of(problem, {"k1": 0.02}, rng))


def test_without_a_known_distance_and_with_one_inside_a_group(rng: Any) -> None:
    problem = problem_of(("k1",), rng)
    state = state_of(problem, {"k1": 0.02}, rng)
    check(replace(problem, scale=None), state)
    check(replace(problem, scale=((0, 3), 15.0, 0.001)), state)


def test_views_are_eliminated_where_dots_are_fewer(rng: Any) -> None:
    problem = problem_of(("k1",), rng)
    problem = problem.subset(problem.dot < 6)
    problem = replace(
        problem, dot_ids=np.arange(6), nominal_mm=problem.nominal_mm[:6],
        dot_sigma_mm=problem.dot_sigma_mm[:6], scale=((0, 5), 7.0, 0.001),
    )  # fmt: skip
    assert 6 * len(problem.views) > 3 * 6
    check(problem, state_of(problem, {"k1": 0.02}, rng))


@pytest.mark.parametrize("blocks", [True, False], ids=["with dots", "dots held"])
def test_parameters_are_held_and_rows_added(blocks: bool, rng: Any) -> None:
    """Against the dense information matrix; one view is seen by one camera alone."""
    problem = problem_of(("k1", "p1"), rng)
    problem = problem.subset((problem.view > 0) | (problem.camera == 0))
    whole = System(problem).gaussian(state_of(problem, {"k1": 0.02}, rng))
    held = np.r_[1, 3, [] if blocks else whole.of_blocks.ravel()].astype(int)
    gaussian = whole.hold(held)
    stay = np.setdiff1d(np.arange(len(whole.right)), held)
    usual = np.eye(len(whole.right))
    for at, axes in whole.turned:
        usual[np.ix_(at, at)] = axes
    information = usual @ dense(whole) @ usual.T
    own = information[np.ix_(stay, stay)]
    right = (usual @ whole.right)[stay]
    length = np.sqrt(np.diag(own))

    def alike(found: Any, wanted: Any) -> None:
        assert np.abs((found - wanted) * length).max() < 1e-6 * np.abs(wanted * length).max()

    alike(gaussian.step()[0], np.linalg.solve(own, right))
    if blocks:
        moved = whole.moved_by(held)
        wanted = -np.linalg.solve(own, information[np.ix_(stay, held)])
        for column, other in zip(moved.T, wanted.T):
            alike(column, other)
        return
    matrix, rows = rng.normal(size=(len(stay), 4)), rng.normal(size=(3, 4))
    other = gaussian.in_terms_of(matrix).add_rows(rows, np.array([1.0, 2.0, 3.0]))
    mapped = matrix.T @ own @ matrix + rows.T @ rows
    np.testing.assert_allclose(other.common, mapped, rtol=1e-9)
    expected = np.linalg.solve(mapped, matrix.T @ right - rows.T @ [1.0, 2.0, 3.0])
    np.testing.assert_allclose(other.step()[0], expected, rtol=1e-6)
    assert other.cost == pytest.approx(whole.cost + 7.0)


def test_a_number_is_held_and_others_are_measured(rng: Any) -> None:
    root = rng.normal(size=(5, 5))
    found = Estimate(rng.normal(size=5), root @ root.T)
    information = np.linalg.inv(found.covariance)
    held = found.hold([1, 3])
    free = [0, 2, 4]
    own = information[np.ix_(free, free)]
    np.testing.assert_allclose(held.covariance[np.ix_(free, free)], np.linalg.inv(own))
    pull = information[free][:, [1, 3]] @ found.value[[1, 3]]
    moved = found.value[free] + np.linalg.solve(own, pull)
    np.testing.assert_allclose(held.value[free], moved)
    np.testing.assert_allclose(held.value[[1, 3]], 0, atol=1e-12)
    whole, part = (x.value @ information @ x.value for x in (found, held))
    assert found.chi_square([1, 3]) == pytest.approx(whole - part)
    rows, onto = rng.normal(size=(2, 3, 5)), rng.normal(size=(5, 2))
    after = [np.linalg.inv(information + a.T @ a) for a in rows]
    saved = [np.trace(onto.T @ (found.covariance - c) @ onto) for c in after]
    np.testing.assert_allclose(found.saved_by(rows, onto), saved)


def test_a_view_that_is_left_out_stays_and_is_infinitely_uncertain(rng: Any) -> None:
    problem = problem_of(("k1",), rng)
    problem = replace(problem, weight=np.where(problem.view == 2, 0.0, problem.weight))
    state = state_of(problem, {"k1": 0.02}, rng)
    place = slots(problem)["view"][2]
    for solver in SOLVERS:
        made = replace(problem, solver=solver)
        equations = System(made).gaussian(state)
        step, _ = equations.step(1e-3)
        assert not step[place][:3].any()
        found = joint_covariance(made, lm.Solution(state, equations, 0))
        assert np.isinf(np.diag(found.matrix)[place][:3]).all()


def test_a_view_of_one_camera_has_the_variance_of_its_weak_prior(rng: Any) -> None:
    """Its depth is 1e7 times less certain than its other places: beyond Cholesky's digits along the
    target's axes.

    The reference is QR of the whole Jacobian, columns of unit length.
    """
    problem = problem_of(("k1",), rng, 1.0)
    problem = problem.subset((problem.view != 2) | (problem.camera == 1))
    tight = replace(problem, covariance_px2=1e-4 * problem.covariance_px2)
    state = state_of(tight, {"k1": 0.02}, rng)
    parts = zip(of_images(tight, state), of_priors(tight, state))
    jacobian, _ = (np.concatenate(pair) for pair in parts)
    length = np.linalg.norm(jacobian, axis=0)
    root = np.linalg.inv(np.linalg.qr(jacobian / length, mode="r")) / length[:, None]
    expected = (root**2).sum(1)
    for solver in SOLVERS:
        *_, found = System(replace(tight, solver=solver)).gaussian(state).covariance(whole=True)
        assert found is not None
        np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(expected), rtol=1e-4)
        off = (found - root @ root.T) / np.sqrt(np.outer(expected, expected))
        assert np.abs(off).max() < 1e-4
    place = slots(tight)["view"][2]
    assert np.sqrt(expected[place][3:]).max() > 0.1 * 10 * max(tight.rho_mm)


def test_chunks_of_any_size(rng: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of(("k1",), rng, 0.6)
    state = state_of(problem, {"k1": 0.02}, rng)
    system = System(problem)
    for size in (1, 15, 40, 10_000):
        monkeypatch.setattr(systems, "CHUNK", size)
        for obs in system.images:
            chunks = systems._in_chunks(images_of(obs))
            assert [i for chunk in chunks for i in chunk] == images_of(obs)
        assert len(chunks) > 1 or size > 15
        check(problem, state)


def test_whitening_is_the_inverse_cholesky_factor(rng: Any) -> None:
    factor = rng.normal(size=(20, 2, 2))
    covariance = factor @ np.swapaxes(factor, -1, -2) + 0.1 * np.eye(2)
    expected = np.linalg.inv(np.linalg.cholesky(covariance))
    np.testing.assert_allclose(whitening(covariance), expected, rtol=1e-12, atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        whitening(np.array([[[1.0, 2.0], [2.0, 1.0]]]))


def solved(problem: Problem, state: State) -> lm.Solution:
    return lm.Solution(state, System(problem).gaussian(state), 0)


def test_degrees_of_freedom_are_the_trace_of_the_residuals(rng: Any) -> None:
    problem = problem_of(("k1",), rng)
    state = state_of(problem, {"k1": 0.02}, rng)
    jacobian, _ = of_images(problem, state)
    solution = solved(problem, state)
    found = joint_covariance(problem, solution).effective_dof
    inverse = np.linalg.inv(dense(solution.gaussian))
    absorbed = np.trace(inverse @ jacobian.T @ jacobian)
    assert found == pytest.approx(2 * len(problem.view) - absorbed, rel=1e-6)


def test_a_large_calibration_keeps_cameras_and_views(
    rng: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = replace(problem_of(("k1",), rng), solver="numpy")
    solution = solved(problem, state_of(problem, {"k1": 0.02}, rng))
    whole = joint_covariance(problem, solution)
    monkeypatch.setattr(covariance, "MANY_PARAMETERS", 10)
    parts = joint_covariance(problem, solution)
    n = len(parts.names)
    assert parts.names == whole.names[:n]
    assert n == slots(problem)["dots"][0].start
    sd = np.sqrt(np.diag(whole.matrix)[:n])
    difference = (parts.matrix - whole.matrix[:n, :n]) / np.outer(sd, sd)
    assert np.abs(difference).max() < 1e-7
    np.testing.assert_allclose(parts.dots, whole.dots, rtol=1e-6, atol=1e-12)
    assert parts.effective_dof == pytest.approx(whole.effective_dof, rel=1e-9)


def test_a_direction_that_nothing_determines_is_an_error(rng: Any) -> None:
    """Dots without a prior and no known distance: the target's own frame is free."""
    problem = replace(problem_of((), rng), scale=None)
    problem = replace(problem, dot_sigma_mm=np.full((12, 3), 1e12))
    state = state_of(problem, {}, rng)
    for solver in SOLVERS:
        equations = System(replace(problem, solver=solver)).gaussian(state)
        with pytest.raises(CalibrationError, match="do not determine all parameters"):
            equations.covariance(whole=True)


def test_moves_are_gtsams_retraction_to_first_order(rng: Any) -> None:
    problem = problem_of(("k1",), rng, cameras=3)
    start, system = state_of(problem, {"k1": 0.02}, rng), System(problem)
    step = 1e-5 * rng.standard_normal(system.size)
    mine, place = system.moved(start, step), slots(problem)
    poses: list[tuple[Any, Any, slice]] = []
    poses += zip(start.rig_from_camera[1:], mine.rig_from_camera[1:], place["camera"][1:])
    poses += zip(start.rig_from_target, mine.rig_from_target, place["view"])
    for before, after, at in poses:
        theirs = gtsam.Pose3(before).retract(step[at]).matrix()
        np.testing.assert_allclose(after, theirs, atol=1e-8)


def case(made: Any, model: str) -> tuple[Problem, State]:
    problem = problem_from_dots(made.dots, made.cameras, made.target).with_model(model)
    return problem, known_target.stereo_states(problem, problem.nominal_mm)[0]


def test_arrays_are_taken_for_many_dots(scene: Callable[..., Any]) -> None:
    small, start = case(scene("paper", 1), "radial")
    assert System(small).gaussian(start).by_gtsam
    large, start = case(scene("dense", 1, views=8), "radial")
    assert len(large.view) > systems.MANY_DOTS
    assert not System(large).gaussian(start).by_gtsam


def test_gtsam_and_numpy_find_the_same_minimum_and_covariance(scene: Callable[..., Any]) -> None:
    problem, start = case(scene("paper", 2), "radial")
    found = [lm.solve(replace(problem, solver=solver), start) for solver in SOLVERS]
    assert found[0].cost == pytest.approx(found[1].cost, rel=1e-9)
    sd = [np.sqrt(np.diag(joint_covariance(problem, each).matrix)) for each in found]
    np.testing.assert_allclose(sd[0], sd[1], rtol=1e-8)


def test_the_whole_calibration_with_either_solver(
    scene: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = scene("paper", 2, outlier_share=0.05)
    one = made.calibrate("radial")
    monkeypatch.setattr(systems, "MANY_DOTS", 0)
    other = replace(made).calibrate("radial")
    assert one.statistics["cost"] == pytest.approx(other.statistics["cost"], rel=1e-9)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-4, atol=1e-16)


def test_a_camera_that_cannot_see_a_dot_stops_the_start_alone(rng: Any) -> None:
    """A window seen edge on: no finite cost at the start."""
    wall = Wall(np.array([1.0, 0.0, 0.0]), 20.0, 8.0, (1.0, 1.5, 1.33), 0.01)
    problem = problem_of(("kappa_per_mm",), rng, walls=(None, wall))
    state = state_of(problem, {"kappa_per_mm": 1e-3}, rng)
    with pytest.raises(CalibrationError, match="no ray of a camera reaches"):
        lm.solve(problem, state)
    assert np.isfinite(whitened_error(state, problem.subset(problem.camera == 0).observations(),
                                      problem.rho_mm)).all()  # fmt: skip


def test_what_rough_edges_do_counts_as_an_error_of_the_dots_places(scene: Any) -> None:
    made = scene("paper", 3, views=3)
    plain = problem_from_dots(made.dots, made.cameras, made.target)
    dots = made.dots.assign(edge_suu_px2=0.04, edge_suv_px2=0.01, edge_svv_px2=0.04)
    dots["suu_px2"], dots["svv_px2"] = dots["suu_px2"] + 0.04, dots["svv_px2"] + 0.04
    dots["suv_px2"] = dots["suv_px2"] + 0.01
    rough = problem_from_dots(dots, made.cameras, made.target)
    np.testing.assert_allclose(rough.covariance_px2, plain.covariance_px2, rtol=1e-9)
    scale = np.median([camera["scale_px_per_mm"] for camera in made.cameras])
    expected = np.hypot(made.target.print_sigma_mm, np.sqrt(0.05) / scale)
    np.testing.assert_allclose(rough.dot_sigma_mm[:, :2], expected, rtol=0.05)
    np.testing.assert_array_equal(rough.dot_sigma_mm[:, 2], plain.dot_sigma_mm[:, 2])
    dots["edge_suu_px2"] = dots["suu_px2"] * 1.01
    with pytest.raises(InputError, match="no positive definite covariance"):
        problem_from_dots(dots, made.cameras, made.target)
