"""Accelerations of the bubbles: against dense algebra, against the joint graph, against truth."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_lyapunov
from seeds import first_or_all
from shake_learning_data import CAMERAS, UP, run, true_model

from telerig.estimator.smoothing.graph.solve import Options, Solution, drawn, solve
from telerig.estimator.smoothing.learning import low_pass
from telerig.estimator.smoothing.problem.problem import (
    Bubble,
    Observations,
    ShakeModel,
    SmoothingProblem,
)
from telerig.estimator.smoothing.result import _along_path, trajectories
from telerig.estimator.smoothing.verdict.purposes import uses
from telerig.factors.bubble_motion import (
    BubbleModel,
    Inertia,
    Zigzag,
    inertial_bubble_path,
)
from telerig.factors.state_space import distinct_steps
from telerig.io.results.smoothing import Quantity
from telerig.io.tables.smoothing import TRAJECTORIES

Array = NDArray[np.float64]
SIGMA, TAU, RMS, HZ, DAMPING = 10.0, 0.3, 2.0, 6.0, 0.03
PIXEL, SCALE = 0.3, 10.0
PLAIN = Options(robust=False, draws=True)


def model_of(inertia_s: float | None) -> ShakeModel:
    """A rig that stands still, and the bubbles of `axis_process`."""
    zigzag = Zigzag(HZ, DAMPING, (RMS,) * 3)
    inertia = None if inertia_s is None else Inertia((inertia_s,) * 3)
    return ShakeModel(BubbleModel(SIGMA, TAU, zigzags=(zigzag,), inertia=inertia), modes=())


def axis_process(inertia_s: float) -> tuple[Array, Array, Array]:
    """Drift, noise and stationary covariance (position left out) of one axis.

    States: position, velocity, wander before the low-pass, swing and its velocity before it.
    """
    w = 2 * np.pi * HZ
    drift, noise = np.zeros((5, 5)), np.zeros((5, 2))
    drift[0, 1] = drift[3, 4] = 1.0
    drift[1, 1:] = np.array([-1.0, 1.0, 0.0, 1.0]) / inertia_s
    drift[2, 2], drift[4, 3:] = -1 / TAU, (-(w**2), -2 * DAMPING * w)
    noise[2, 0], noise[4, 1] = SIGMA * np.sqrt(2 / TAU), 2 * RMS * np.sqrt(DAMPING * w**3)
    start = np.zeros((5, 5))
    start[1:, 1:] = solve_continuous_lyapunov(drift[1:, 1:], -noise[1:] @ noise[1:].T)
    return drift, noise, start


def stepped(drift: Array, noise: Array, step_s: float) -> tuple[Array, Array]:
    """Transition and noise covariance of a step, by Gauss-Legendre over the impulse response."""
    nodes, weights = np.polynomial.legendre.leggauss(30)
    gains = [expm(drift * step_s * (x + 1) / 2) @ noise for x in nodes]
    covariance = sum(g @ g.T * w * step_s / 2 for g, w in zip(gains, weights))
    return np.asarray(expm(drift * step_s)), np.asarray(covariance)


def drawn_bubbles(
    rng: np.random.Generator, inertia_s: float, frames: int, bubbles: int, step_s: float,
    stated: float = 1.0, steady: bool = False,
) -> tuple[SmoothingProblem, Array]:  # fmt: skip
    """A problem of a still rig, and the true velocities and accelerations (2, bubbles, F, 3).

    stated : standard deviation of the pixels as stated, over the true one.
    steady : whether the rise keeps the speed of each path constant.
    """
    drift, noise, start = axis_process(inertia_s)
    phi, q = stepped(drift, noise, step_s)
    roots = [np.linalg.cholesky(m + 1e-15 * np.eye(len(m))) for m in (start[1:, 1:], q)]
    x = np.zeros((frames, bubbles, 3, 5))
    x[0, ..., 1:] = rng.standard_normal((bubbles, 3, 4)) @ roots[0].T
    for i in range(1, frames):
        x[i] = x[i - 1] @ phi.T + rng.standard_normal((bubbles, 3, 5)) @ roots[1].T
    t = step_s * np.arange(frames)
    lab = x[..., 0].swapaxes(0, 1) + 100 * UP * t[:, None] + rng.uniform(-5, 5, (bubbles, 1, 3))
    truth = np.stack([x[..., 1] + 100 * UP, x @ drift[1]]).swapaxes(1, 2)
    if steady:
        (vx, vz), (ax, az) = truth[..., [0, 2]].transpose(0, 3, 1, 2)
        truth[0, ..., 1] = -np.sqrt(400.0**2 - vx**2 - vz**2)
        truth[1, ..., 1] = -(vx * ax + vz * az) / truth[0, ..., 1]
        v, a = truth[..., 1]
        way = step_s * (v[:, 1:] + v[:, :-1]) / 2 + step_s**2 * (a[:, :-1] - a[:, 1:]) / 12
        lab[:, 1:, 1] = lab[:, :1, 1] + np.cumsum(way, 1)
    item, frame, camera = (
        a.ravel() for a in np.meshgrid(np.arange(bubbles), np.arange(frames), [0, 1], indexing="ij")
    )
    uv = np.stack([c.project(lab) for c in CAMERAS], 2).reshape(-1, 2)
    uv += PIXEL * rng.standard_normal(uv.shape)
    covariance = np.tile((stated * PIXEL) ** 2 * np.eye(2), (len(uv), 1, 1))
    seen = Observations(item, frame, camera, uv, covariance)
    tracks = tuple(Bubble(k, 0, frames - 1, lab[k, 0], lab[k]) for k in range(bubbles))
    return SmoothingProblem(CAMERAS, t, UP, UP, tracks, seen), truth


def solved(problem: SmoothingProblem, model: ShakeModel) -> Solution:
    """As `telerig.smooth` does: the low-pass is learned where it is not given."""
    solution = solve(problem, model, PLAIN)
    if model.bubble.inertia is not None:
        return solution
    bubble = replace(model.bubble, inertia=low_pass.learned_inertia(solution))
    return solve(problem, replace(model, bubble=bubble), PLAIN)


@pytest.mark.parametrize("inertia_s", [0.002, 0.02])
def test_dense_algebra_gives_the_same(inertia_s: float) -> None:
    """The posterior from the covariance of all frames' states, without states in time."""
    frames, step = 40, 0.01
    problem, _ = drawn_bubbles(np.random.default_rng(5), inertia_s, frames, 1, step)
    found = solved(problem, model_of(inertia_s)).accelerations
    assert found is not None
    drift, noise, start = axis_process(inertia_s)
    phi, q = stepped(drift, noise, step)
    start[0, 0] = 100.0**2
    whole = np.zeros((frames, 5, frames, 5))
    now = start
    for i in range(frames):
        ahead = now
        for j in range(i, frames):
            whole[j, :, i], whole[i, :, j] = ahead, ahead.T
            ahead = phi @ ahead
        now = phi @ now @ phi.T + q
    place, force = whole[:, 0, :, 0], np.einsum("a,iajb->ijb", drift[1], whole)
    t = problem.t_s
    height = place + 300.0**2 * np.multiply.outer(t, t)
    for axis, sigma in ((0, PIXEL / SCALE), (1, PIXEL / SCALE / np.sqrt(2))):
        gain = np.linalg.solve(height + sigma**2 * np.eye(frames), force[..., 0].T).T
        variance = np.einsum("iaib,a,b->i", whole, drift[1], drift[1])
        variance -= np.einsum("ij,ij->i", gain, force[..., 0])
        np.testing.assert_allclose(found.sd_mm_s2[:, axis], np.sqrt(variance), rtol=1e-5)
        centre = np.array([512.0, 512.0]) - 0.5
        uv = problem.observations.uv_px.reshape(frames, 2, 2)
        seen = (uv[:, 0, 0] - centre[0]) / SCALE
        if axis == 1:
            seen = ((uv[..., 1] - centre[1]) / SCALE).mean(1)
        mean = gain @ (seen - problem.bubbles[0].start_mm[axis])
        np.testing.assert_allclose(
            found.value_mm_s2[:, axis], mean, atol=0.01 * variance.max() ** 0.5
        )


def check_along_paths(solution: Solution, truth: Array) -> dict[str, float]:
    """Variances along the paths, over those of independent axes: as stated, and as they are."""
    found = solution.accelerations
    assert found is not None
    velocity = truth[0].reshape(-1, 3)
    path = velocity / np.linalg.norm(velocity, axis=-1, keepdims=True)
    stated = _along_path(solution, found)
    for name, value, true, variance in (
        ("velocity", solution.velocities_mm_s, truth[0], solution.velocity_variances()),
        ("acceleration", found.value_mm_s2, truth[1], found.sd_mm_s2**2),
    ):
        square = (((value - true.reshape(-1, 3)) * path).sum(-1) ** 2).mean()
        share = square / (path**2 * variance).sum(-1).mean()
        assert 0.7 < stated[name] / share < 1.5, (name, stated[name], share)
    return stated


def test_standard_deviations_are_true_where_low_pass_and_noise_have_to_be_learned() -> None:
    """Noise that is stated too large, as by what an unknown shape adds, does not widen them."""
    squares, ways, lengths = [], [], []
    for seed, (inertia_s, stated) in enumerate(((0.004, 4.0), (0.01, 1.0), (0.02, 4.0))):
        rng = np.random.default_rng(seed)
        problem, truth = drawn_bubbles(rng, inertia_s, 200, 3, 0.005, stated)
        solution = solved(problem, model_of(None))
        found = solution.accelerations
        assert found is not None
        assert all(0.5 * inertia_s < t < 2 * inertia_s for t in found.inertia.time_s)
        assert 0.4 < min(found.inertia.forces) <= max(found.inertia.forces) < 2.5
        np.testing.assert_allclose(found.inertia.noise, 1 / stated, rtol=0.15)
        assert ((found.bandwidth_hz > HZ) & (found.bandwidth_hz < 100)).all()
        value = np.stack([solution.velocities_mm_s, found.value_mm_s2])
        variance = [solution.velocity_variances(), found.sd_mm_s2**2]
        squares.append((value - truth.reshape(2, -1, 3)) ** 2 / np.array(variance))
        place = (solution.state.bubbles @ solution.graph.bubble.position.T).reshape(3, -1, 3)
        known = np.array([b.guess_mm[-1] - b.guess_mm[0] for b in problem.bubbles])
        assert solution.ways is not None
        ways.append((place[:, -1] - place[:, 0] - known) ** 2 / solution.ways[0])
        moved = solution.velocities_mm_s.reshape(place.shape)
        along = moved / np.linalg.norm(moved, axis=-1, keepdims=True)
        faster = ((moved - truth[0].reshape(place.shape)) * along).sum(-1)
        length = np.trapezoid(faster, problem.t_s)
        lengths.append(length**2 / solution.ways[1])
        assert min(check_along_paths(solution, truth).values()) > 0.7
    mean = np.mean(squares, axis=(0, 2, 3))
    assert ((mean > 0.8) & (mean < 1.25)).all()
    assert 0.4 < np.mean(ways) < 1.8  # 27 of them
    assert 0.3 < np.mean(lengths) < 2.2  # 9 of them


def test_a_low_pass_that_the_vertical_does_not_show_is_taken_from_across(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Pixels of 2 px hide it there: the prior alone gives a fifth of it."""
    monkeypatch.setattr(sys.modules[__name__], "PIXEL", 2.0)
    problem, _ = drawn_bubbles(np.random.default_rng(4), 0.01, 250, 4, 0.004)
    found = low_pass.learned_inertia(solve(problem, model_of(None), PLAIN))
    assert found is not None and found.time_s[0] == pytest.approx(0.01, rel=0.2)
    assert found.time_s[1] > 0.3 * found.time_s[0]


def test_errors_along_paths_of_a_steady_speed_are_smaller() -> None:
    """Forces are across them there."""
    problem, truth = drawn_bubbles(np.random.default_rng(4), 0.01, 250, 4, 0.004, steady=True)
    assert max(check_along_paths(solved(problem, model_of(None)), truth).values()) < 0.7


@pytest.mark.parametrize("stated", first_or_all(4.0, 1.0))
def test_no_velocity_is_stated_too_well_where_no_low_pass_can_be_seen(stated: float) -> None:
    """Bubbles that white noise drives, of which the images show no more than the zigzag."""
    problem, truth = drawn_bubbles(np.random.default_rng(0), 1e-5, 150, 6, 0.01, stated)
    solution = solved(problem, model_of(None))
    error = solution.velocities_mm_s - truth[0].reshape(-1, 3)
    assert 0.8 < np.mean(error**2 / solution.velocity_variances()) < 1.25


def test_the_filters_likelihood_is_that_of_dense_algebra() -> None:
    """Of a series with unequal steps and a gap."""
    rng, sigma = np.random.default_rng(3), 0.02
    process = inertial_bubble_path(model_of(None).bubble, UP, Inertia((0.01,) * 3))
    t = np.cumsum(rng.choice([0.004, 0.01], 12))
    values, variance = rng.normal(size=(12, 2)), np.full(12, sigma**2)
    variance[4] = np.inf
    dt_s, index = distinct_steps(np.diff(t))
    found = low_pass.log_likelihood(
        low_pass.moves_of(process, 300.0, dt_s),
        [low_pass.Series(index, values, variance / 4)], 2.0,
    )  # fmt: skip
    size = process.size + 1
    drift, gain = np.zeros((size, size)), np.zeros((size, process.noise.shape[1]))
    drift[:-1, :-1], drift[:-1, -1:], gain[:-1] = process.drift, process.input, process.noise
    begin = np.zeros((size, size))
    begin[:-1, :-1] = process.start_covariance
    both = np.append(process.start_from_input, 1.0)
    begin += 300.0**2 * np.outer(both, both)
    whole, now = np.zeros((12, 12)), begin
    for i in range(12):
        ahead = now
        for j in range(i, 12):
            whole[i, j] = whole[j, i] = ahead[0, 0]
            if j < 11:
                ahead = expm(drift * (t[j + 1] - t[j])) @ ahead
        if i < 11:
            phi, q = stepped(drift, gain, t[i + 1] - t[i])
            now = phi @ now @ phi.T + q
    kept = np.delete(np.arange(12), 4)
    whole = whole[np.ix_(kept, kept)] + sigma**2 * np.eye(11)
    squares = (values[kept] * np.linalg.solve(whole, values[kept])).sum(0)
    assert found == pytest.approx(-np.linalg.slogdet(whole)[1] / 2 - squares.sum() / 2, rel=1e-6)


def test_tables_and_uses_name_accelerations() -> None:
    problem, _ = drawn_bubbles(np.random.default_rng(1), 0.01, 60, 2, 0.005)
    solution = solved(problem, model_of(0.01))
    found = solution.accelerations
    assert found is not None and found.inertia.time_s == pytest.approx((0.01,) * 3)
    names = [f"{kind}a{axis}_mm_s2" for kind in ("", "s") for axis in "xyz"]
    table = trajectories(solution, None, (1.0, 2.0, 1.0))
    assert list(table.columns[-6:]) == names
    assert set(names) <= set(TRAJECTORIES.names())
    np.testing.assert_allclose(table["say_mm_s2"], 2 * found.sd_mm_s2[:, 1])
    used: Any = {u.axis: u for u in uses(solution, drawn(solution)) if u.quantity == "acceleration"}
    assert set(used) == {"x", "y", "z"} and Quantity.ACCELERATION == "acceleration"
    assert used["x"].unit == "mm/s^2"
    assert used["x"].below_hz == pytest.approx(found.bandwidth_hz[0])
    assert used["x"].sd == pytest.approx(np.sqrt((found.sd_mm_s2[:, 0] ** 2).mean()), rel=0.1)
    bare = solve(problem, model_of(None), PLAIN)
    assert "ax_mm_s2" not in trajectories(bare, None)


def test_bubbles_of_one_frame_and_without_pixels_have_wide_accelerations() -> None:
    problem, _ = drawn_bubbles(np.random.default_rng(2), 0.01, 30, 2, 0.01)
    seen = problem.observations
    kept = seen.of((seen.item == 0) | ((seen.item == 1) & (seen.frame == 7)))
    once = replace(problem.bubbles[1], first=7, last=7, guess_mm=problem.bubbles[1].guess_mm[7:8])
    problem = replace(problem, bubbles=(problem.bubbles[0], once), observations=kept)
    found = solved(problem, model_of(0.01)).accelerations
    assert found is not None
    assert np.isfinite(found.value_mm_s2).all() and np.isfinite(found.sd_mm_s2).all()
    assert (found.sd_mm_s2[-1] > found.sd_mm_s2[15]).all()
    alone = replace(problem, bubbles=(once,), observations=kept.of(kept.item == 1))
    alone = replace(alone, observations=replace(alone.observations, item=0 * kept.item[-2:]))
    model = model_of(0.01)
    assert low_pass.learned_inertia(solve(alone, model, PLAIN)) is model.bubble.inertia
    still, _, _ = run(np.random.default_rng(0), seconds=0.2, marks=2)
    seen = Observations.none()
    empty = solve(replace(still, bubbles=(), observations=seen), true_model(), PLAIN)
    assert low_pass.learned_inertia(empty) is None and empty.accelerations is None
