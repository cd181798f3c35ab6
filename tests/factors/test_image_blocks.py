"""Normal equations from padded chunks against those of the full Jacobian, and their solution.

The reference multiplies out `whitened_residuals`, which test_factors.py proves by itself.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from telerig.estimator.calibration.solver import array_system, covariance
from telerig.estimator.calibration.solver.array_system import ArraySystem
from telerig.estimator.calibration.solver.covariance import joint_covariance
from telerig.estimator.calibration.solver.graph import Solution, slots
from telerig.estimator.calibration.solver.problem import Problem, nominal_state, whitening
from telerig.factors import image_rows
from telerig.factors.image_blocks import Scratch
from telerig.factors.image_rows import in_chunks
from telerig.factors.projection import State, whitened_residuals
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.projection import PARAMETERS
from telerig.rig.target import Target
from telerig.rig.windows import Wall

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
    free: tuple[str, ...], rng: Any, seen: float = 0.9, walls: tuple[Any, ...] = (None, None)
) -> Problem:
    """Two cameras, five views, twelve dots of which a share is seen; random measurements."""
    views, dots = 5, 12
    second = Pose.from_rotvec((0.1, np.deg2rad(60), 0.0), (1.0, -2.0, 3.0))
    cameras = [
        Camera.create("left", (1024, 768), 20.0),
        Camera.create("right", (1024, 768), 21.0, camera_from_rig=second),
    ]
    cameras = [replace(c, wall=w) for c, w in zip(cameras, walls)]
    view, camera, dot = np.nonzero(rng.random((views, 2, dots)) < seen)
    factor = rng.normal(size=(len(view), 2, 2)) + 3 * np.eye(2)
    target = Target(rows=3, columns=4, pitch_mm=(5.0, 5.0))
    columns, rows = np.meshgrid(np.arange(4), np.arange(3))
    nominal = np.stack([5.0 * columns.ravel(), 5.0 * rows.ravel(), 0 * rows.ravel()], -1)
    return Problem(
        tuple(cameras), target, tuple(f"{v:02}" for v in range(views)), np.arange(dots),
        nominal, np.full((dots, 3), 0.02), view, camera, dot, rng.uniform(0, 900, (len(view), 2)),
        0.01 * factor @ np.swapaxes(factor, -1, -2), rng.uniform(0.1, 1, len(view)),
        (("scale_px_per_mm", *free), ("scale_px_per_mm", *free[: 1 + len(free) // 2])),
        ((0, 11), 18.0, 0.001), np.zeros((views, 2)),
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


def of_images(problem: Problem, state: State) -> tuple[Any, Any, float]:
    """J^T J, -J^T r and r^T r of the images, from the whole Jacobian."""
    system, obs = ArraySystem(problem, state), problem.observations()
    full = whitened_residuals(state, obs, problem.rho_mm)
    first = int(system.edges[-1])
    dots = first + 6 * len(problem.views)
    out = np.zeros((len(obs), 2, dots + problem.nominal_mm.size))
    for m, (v, c, d) in enumerate(zip(obs.view, obs.camera, obs.dot)):
        lens = full.by_intrinsics[m][:, system.free[c]] * system.unit[c]
        out[m][:, system.intrinsics_of(int(c))] = lens
        if c:
            out[m][:, system.pose_of(int(c))] = full.by_camera[m]
        out[m][:, first + 6 * v : first + 6 * v + 6] = full.by_view[m]
        out[m][:, dots + 3 * d : dots + 3 * d + 3] = full.by_dot[m]
    jacobian, value = out.reshape(-1, out.shape[-1]), full.value.ravel()
    return jacobian.T @ jacobian, -jacobian.T @ value, float(value @ value)


def without_images(problem: Problem, state: State) -> ArraySystem:
    """Priors and gauge alone: every measurement is left out but for one of no weight at all."""
    vague = 1e30 * np.broadcast_to(np.eye(2), problem.covariance_px2.shape)
    return ArraySystem(replace(problem, covariance_px2=vague), state)


def check(problem: Problem, state: State) -> None:
    """Arrays, and compiled loops where there are any."""
    check_system(problem, state, ArraySystem(problem, state))
    looped = ArraySystem(problem, state)
    looped.loops = array_system.compiled_loops()
    if looped.loops is not None:
        check_system(problem, state, looped)


def check_system(problem: Problem, state: State, system: ArraySystem) -> None:
    information, right, twice = of_images(problem, state)
    ours = system.linearised(state)
    priors = without_images(problem, state).linearised(state)
    information = information + priors.information()
    length = np.sqrt(np.maximum(np.diag(information), 1e-30))
    difference = (ours.information() - information) / np.outer(length, length)
    assert np.abs(difference).max() < 1e-11
    expected = (right + priors.right) / length
    np.testing.assert_allclose(ours.right / length, expected, atol=1e-11 * np.abs(expected).max())
    assert ours.cost == pytest.approx(0.5 * twice + priors.cost, rel=1e-12)
    assert system.cost(state) == pytest.approx(ours.cost, rel=1e-12)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("seen", [1.0, 0.9, 0.4])
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


@pytest.mark.parametrize("seen", [1.0, 0.4])
def test_chunks_of_any_size(seen: float, rng: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of(("k1",), rng, seen)
    state = state_of(problem, {"k1": 0.02}, rng)
    whole = ArraySystem(problem, state).linearised(state)
    monkeypatch.setattr(image_rows, "CHUNK", 15)
    system = ArraySystem(problem, state)
    assert len(system.chunks) >= 3
    np.testing.assert_allclose(system.linearised(state).right, whole.right, rtol=1e-9, atol=1e-6)
    check(problem, state)


def test_chunks_share_the_work_alike(rng: Any) -> None:
    """None is a small rest, and their arrays lie in the same memory whatever their shape."""
    problem = problem_of(("k1",), rng, 1.0)
    obs = problem.observations()
    images = len(np.unique(obs.view * 2 + obs.camera))
    for parts in (2, 3):
        size = int(1.1 * len(obs) / parts)
        sizes = [len(rows.view) for rows in in_chunks(obs, len(problem.dot_ids), size)]
        assert sum(sizes) == images and len(sizes) == parts
        assert max(sizes) - min(sizes) <= parts
    scratch = Scratch()
    large = scratch.empty("columns", 4, 6)
    small = scratch.empty("columns", 5, 2)
    assert np.shares_memory(large, small) and small.flags.c_contiguous
    assert not np.shares_memory(small, scratch.empty("other", 5, 2))
    assert scratch.empty("columns", 4, 6).shape == (4, 6)


def test_every_measurement_is_in_one_chunk(rng: Any) -> None:
    problem = problem_of((), rng, 0.3)
    obs = problem.observations()
    chunks = in_chunks(obs, len(problem.dot_ids), 40)
    assert len(chunks) > 1
    assert sum(int((rows.whitener[0, 0] > 0).sum()) for rows in chunks) == len(obs)
    assert all(rows.dot.size <= 40 or len(rows.view) == 1 for rows in chunks)
    assert set(PARAMETERS) >= set(problem.free[0])


def test_compiled_loops_are_taken_for_many_dots(rng: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("numba")
    problem = problem_of(("k1",), rng)
    state = state_of(problem, {"k1": 0.02}, rng)
    assert ArraySystem(problem, state).loops is None
    monkeypatch.setattr(array_system, "MANY", 10)
    assert ArraySystem(problem, state).loops is not None


def test_whitening_is_the_inverse_cholesky_factor(rng: Any) -> None:
    factor = rng.normal(size=(20, 2, 2))
    covariance = factor @ np.swapaxes(factor, -1, -2) + 0.1 * np.eye(2)
    expected = np.linalg.inv(np.linalg.cholesky(covariance))
    np.testing.assert_allclose(whitening(covariance), expected, rtol=1e-12, atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        whitening(np.array([[[1.0, 2.0], [2.0, 1.0]]]))


@pytest.mark.parametrize("scale", [True, False])
def test_either_side_may_be_eliminated(scale: bool, rng: Any) -> None:
    problem = problem_of(("k1",), rng)
    if not scale:
        problem = replace(problem, scale=None)
    state = state_of(problem, {"k1": 0.02}, rng)
    ours = ArraySystem(problem, state).linearised(state)
    right = np.stack([ours.right, rng.normal(size=len(ours.right))], -1)
    one, other = (r.solve(right) for r in (ours.without_dots(0.1), ours.without_views(0.1)))
    np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-9 * np.abs(one).max())


@pytest.mark.parametrize("scale", [True, False])
def test_posterior_in_blocks_and_whole(scale: bool, rng: Any) -> None:
    problem = problem_of(("k1",), rng)
    if not scale:
        problem = replace(problem, scale=None)
    state = state_of(problem, {"k1": 0.02}, rng)
    ours = ArraySystem(problem, state).linearised(state)
    information = ours.information()
    length = np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information / np.outer(length, length)) / np.outer(length, length)
    sd = np.sqrt(np.diag(inverse))
    whole, parts = ours.posterior(True), ours.posterior(False)
    assert whole.whole is not None
    assert parts.whole is None
    for found in (whole.whole, parts.common):
        n = len(found)
        assert np.abs((found - inverse[:n, :n]) / np.outer(sd[:n], sd[:n])).max() < 1e-6
    for found in (whole.dots, parts.dots):
        for d, block in enumerate(found):
            at = ours.common + 3 * d + np.arange(3)
            expected = inverse[np.ix_(at, at)]
            np.testing.assert_allclose(block, expected, atol=1e-6 * sd[at].max() ** 2)
    across = inverse[: ours.common, ours.common :] / np.outer(sd[: ours.common], sd[ours.common :])
    for found in (whole.cross, parts.cross):
        mine = found.reshape(ours.common, -1) / np.outer(sd[: ours.common], sd[ours.common :])
        assert np.abs(mine - across).max() < 1e-6


def test_degrees_of_freedom_are_the_trace_of_the_residuals(rng: Any) -> None:
    problem = problem_of(("k1",), rng)
    state = state_of(problem, {"k1": 0.02}, rng)
    of_these, _, _ = of_images(problem, state)
    system = ArraySystem(problem, state)
    equations = system.linearised(state)
    solution = Solution(state, equations.cost, 0, equations, slots(problem))
    found = joint_covariance(problem, solution).effective_dof
    inverse = np.linalg.inv(equations.information())
    assert found == pytest.approx(2 * len(problem.view) - np.trace(inverse @ of_these), rel=1e-6)


def test_a_large_calibration_keeps_cameras_and_views(
    rng: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = problem_of(("k1",), rng)
    state = state_of(problem, {"k1": 0.02}, rng)
    equations = ArraySystem(problem, state).linearised(state)
    solution = Solution(state, equations.cost, 0, equations, slots(problem))
    whole = joint_covariance(problem, solution)
    monkeypatch.setattr(covariance, "WHOLE", 10)
    parts = joint_covariance(problem, solution)
    n = len(parts.names)
    assert parts.names == whole.names[:n]
    assert n == slots(problem)["dots"][0].start
    sd = np.sqrt(np.diag(whole.matrix)[:n])
    difference = (parts.matrix - whole.matrix[:n, :n]) / np.outer(sd, sd)
    assert np.abs(difference).max() < 1e-7
    np.testing.assert_allclose(parts.dots, whole.dots, rtol=1e-6, atol=1e-12)
    assert parts.effective_dof == pytest.approx(whole.effective_dof, rel=1e-9)


def test_dots_seen_by_few_views_are_eliminated_in_groups(
    rng: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A strip of which every view sees a part: the same solution and inverse, less work."""
    problem = problem_of(("k1",), rng, 1.0)
    problem = problem.subset(np.abs(problem.dot - 2.5 * problem.view) < 2)
    state = state_of(problem, {"k1": 0.02}, rng)
    dense = ArraySystem(problem, state).linearised(state)
    assert dense.groups == ()
    monkeypatch.setattr(array_system, "TOGETHER", 3)
    grouped = ArraySystem(problem, state).linearised(state)
    assert len(grouped.groups) == 4
    assert sorted(np.concatenate([g.blocks for g in grouped.groups])) == list(range(12))
    one, other = (e.without_dots(0.1).solve(e.right) for e in (dense, grouped))
    np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-10 * np.abs(one).max())
    for whole in (True, False):
        first, second = dense.posterior(whole), grouped.posterior(whole)
        sd = np.sqrt(np.diag(first.common))
        assert np.abs((first.common - second.common) / np.outer(sd, sd)).max() < 1e-6
        np.testing.assert_allclose(first.dots, second.dots, rtol=1e-5, atol=1e-12)
