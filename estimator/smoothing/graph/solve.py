"""Solve the smoothing graph: Gauss-Newton passes, robust weights, covariances, evidence."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from telerig.arrays import Array, Ints
from telerig.errors import CalibrationError
from telerig.estimator.smoothing.graph.accelerations import (
    Accelerations,
    accelerations_of,
    add_slow_noise,
)
from telerig.estimator.smoothing.graph.bubble_chains import bubble_chains
from telerig.estimator.smoothing.graph.crowd import (
    EliminatedCrowd,
    add_own_calibration,
    eliminated,
)
from telerig.estimator.smoothing.graph.draws import Draws, draws_of
from telerig.estimator.smoothing.graph.elimination import EliminatedGraph, starts_of
from telerig.estimator.smoothing.graph.known_rig import way_variances
from telerig.estimator.smoothing.graph.layout import (
    GraphLayout,
    State,
    first_guess,
    graph_layout,
    moved,
    variances,
)
from telerig.estimator.smoothing.graph.linear import (
    SampleWeights,
    all_factors,
    pixel_residuals,
    sample_residuals,
    sample_weights,
)
from telerig.estimator.smoothing.graph.outliers import SampleRejection, Truncation
from telerig.estimator.smoothing.problem.problem import ShakeModel, SmoothingProblem
from telerig.factors.linear_factors import AT_ONCE, LinearFactors, product
from telerig.io.machine.parallel import give_back_freed_memory
from telerig.live import due, publish
from telerig.rig.lens_parameters import INDEX

Progress = Callable[[str, float], None]
T = TypeVar("T")

_CLOCK_PASSES, _LAST_PASSES = 6, 4
_DELAY_STEP_S, _DELAY_LEAP_S = 3e-5, 2e-3
_LARGEST_STEP_PX = 5.0
_ROUNDING = 1e-9
_STACK_BYTES = 512 << 20
_COLUMNS_AT_ONCE = 4


@dataclass(frozen=True)
class Options:
    """Hold the settings of the solver.

    passes : largest number of linearisations; some more are allowed while a sensor's delay changes.
    robust : whether pixels that do not fit get less weight.
    covariances : whether the covariances of the states are computed.
    tolerance_px : the passes end when no bubble moved by more than this in the last one. Affine
        cameras with constants that are not estimated need only one pass.
    draws : whether `Draws` are made, too, which costs less than afterwards (`drawn`).
    constants : whether the joint covariance of all constants is computed.
    frames : of a piece of a run that `telerig.smooth` smooths in pieces; None for as many as fit
        into memory.
    """

    passes: int = 6
    robust: bool = True
    covariances: bool = True
    tolerance_px: float = 0.05
    draws: bool = False
    constants: bool = False
    frames: int | None = None


@dataclass(frozen=True)
class Covariances:
    """Hold the posterior covariances of the states and of the estimated constants.

    shake : (F, Ds, Ds) for the F frames, with Ds states of carriage and cameras.
    bubbles : (rows, Db, Db), one row per bubble and frame, with Db states of a bubble.
    means : (K, 3, 3) for the mean velocities of K bubbles.
    sensors, encoder, calibration, marks, clocks : for the constants of `State` with the same names.
    by_scale : (rows, 3) what the encoder's uncertain scale adds to the variances of the bubbles'
        positions; None if the scale is no variable.
    """

    shake: Array
    bubbles: Array
    means: Array
    sensors: Array
    encoder: Array
    calibration: Array
    marks: Array
    clocks: Array
    by_scale: Array | None = None


@dataclass(frozen=True)
class Solution:
    """Hold the posterior of a smoothing problem.

    graph : layout of the variables.
    state : their estimates.
    covariances : None if they were not asked for.
    weights : (M,) weights of the bubbles' pixels and (R,) of the marks' pixels; 0 for outliers.
    residuals : whitened residuals (M, 2) of the bubbles' pixels and (R, 2) of the marks' pixels.
    log_evidence : natural logarithm of the marginal likelihood; exact for affine cameras, otherwise
        at the last linearisation.
    passes : number of linearisations that were made.
    sample_weights : weights (N,) of each accelerometer's samples, None where all are 1.
    draws : None if they were not asked for.
    ways : what `way_variances` returns; None without draws, or without a low-pass of the bubbles'
        forces.
    constants : joint covariance of the constants in the order of their keys (sensors, encoder and
        calibration, marks, clocks); None if it was not asked for.
    """

    graph: GraphLayout
    state: State
    covariances: Covariances | None
    weights: tuple[Array, Array]
    residuals: tuple[Array, Array]
    log_evidence: float
    passes: int
    sample_weights: SampleWeights = ()
    draws: Draws | None = None
    ways: tuple[Array, Array] | None = None
    constants: Array | None = None

    @property
    def delays_s(self) -> Array:
        """Delays (A,) of the A accelerometers."""
        delays = self.graph.delays_s
        if self.graph.sensor_flags[1] and len(delays):
            return np.asarray(delays + self.state.clocks[self.graph.clock_of, 0])
        return delays

    @property
    def velocities_mm_s(self) -> Array:
        """Velocities (rows, 3) of the bubbles in the laboratory frame."""
        return np.asarray(self.state.bubbles @ self.graph.bubble.velocity.T)

    def velocity_variances(self) -> Array:
        """Return their variances (rows, 3), with what a shorter low-pass of the forces would add;
        NaN without covariances."""
        rows, found = self.graph.bubble.velocity, self.covariances
        if found is None:
            return np.full((self.graph.rows, 3), np.nan)
        inertia = self.graph.model.bubble.inertia
        unseen = (0.0,) * 3 if inertia is None else inertia.unseen
        return np.asarray(variances(rows, found.bubbles).clip(0) + unseen)

    @cached_property
    def accelerations(self) -> Accelerations | None:
        """The bubbles' accelerations; None without covariances, or without a low-pass."""
        if self.covariances is None:
            return None
        return accelerations_of(self.graph, self.state, self.covariances.bubbles)


def solve(
    problem: SmoothingProblem,
    model: ShakeModel,
    options: Options | None = None,
    progress: Progress | None = None,
    start: Solution | None = None,
) -> Solution:
    """Return the solution of a smoothing problem.

    model : the hyper-parameters.
    progress : function that is called with the name of the step and the share (0 to 1) that is
        done.
    start : solution of the same measurements under another model, from which the first guess is
        taken; None to start from the triangulated positions.

    Raises CalibrationError when the measurements leave something undetermined, and when the passes
    do not converge.
    """
    chosen = options or Options()
    report = progress or (lambda _what, _share: None)
    return in_large_stack(lambda: _solve(problem, model, chosen, report, start))


def _solve(
    problem: SmoothingProblem,
    model: ShakeModel,
    options: Options,
    progress: Progress,
    start: Solution | None,
) -> Solution:
    delays = np.array([a.delay_s for a in problem.accelerometers])
    graph = graph_layout(problem, model, delays if start is None else start.graph.delays_s)
    state = first_guess(graph)
    weights = (np.ones(len(problem.observations)), np.ones(len(problem.references)))
    if start is not None:
        weights, state = start.weights, _warm(graph, state, start)
    samples = sample_weights(problem)
    times = tuple(a.t_s for a in problem.accelerometers)
    robust, rejection = Truncation(options.robust), SampleRejection(options.robust, times)
    last: _Pass | None = None
    exact = _is_linear(problem, model)
    done, leap = 0, 0.0
    for done in range(1, options.passes + _CLOCK_PASSES + 1):
        moving = delays_have_moved(graph, state) or leap > _LARGEST_STEP_PX
        if done > options.passes + rejection.rounds and not moving:
            break
        progress("smoothing", min((done - 1) / (options.passes + 1), 0.95))
        last = None  # two passes at a time would double the memory
        last = _linear_solve(graph, state, weights, samples)
        leap = 0.0 if exact else last.largest_px
        state = moved(graph, state, last.done.vector)
        if due("shake"):
            names = (camera.name for camera in problem.cameras)
            offsets = graph.offsets(state.shake).swapaxes(0, 1)
            publish("shake", t_s=problem.t_s, shake_mm=dict(zip(names, offsets)))
        residuals = pixel_residuals(graph, state)
        samples, changed = rejection.update(samples, sample_residuals(graph, state))
        fresh = weights
        if not changed:
            fresh, changed = robust.update(weights, residuals)
        still = last.largest_px < options.tolerance_px and not delays_have_moved(graph, state)
        if (still or exact) and not changed and (done > 1 or start is not None or exact):
            break
        weights = fresh
        graph, state, again = with_moved_nodes(graph, state)
        last = None if again or changed else last
    if last is None:
        for _ in range(_LAST_PASSES):
            weights, last = robust.decided(weights, residuals), None
            last = _linear_solve(graph, state, weights, samples)
            state = moved(graph, state, last.done.vector)
            residuals = pixel_residuals(graph, state)
            if last.largest_px < options.tolerance_px:
                break
    assert last is not None
    _check_converged(graph, state, 0.0 if exact else last.largest_px)
    found = _finish(graph, state, (weights, residuals), last, options, done, progress)
    _check_variances(found.covariances)
    return replace(found, sample_weights=samples)


def _check_converged(graph: GraphLayout, state: State, largest_px: float) -> None:
    """Raise CalibrationError if the last pass still moved a bubble or a clock by much."""
    if not all(np.all(np.isfinite(values)) for values in vars(state).values()):
        raise CalibrationError("the smoother's solution is not finite", todo="check the inputs")
    late = np.abs(state.clocks[:, 0]) if state.clocks.size else np.zeros(0)
    if np.any(late >= _DELAY_LEAP_S):
        clock = int(late.argmax())
        name = graph.problem.accelerometers[int(np.argmax(graph.clock_of == clock))].name
        raise CalibrationError(
            f"the delay of accelerometer {name} does not converge: the last pass moved it by "
            f"{1e3 * late[clock]:.3g} ms",
            where="smooth",
            todo="check the times, axes and unit of this sensor, or smooth without it",
        )
    if largest_px > _LARGEST_STEP_PX:
        raise CalibrationError(
            f"the smoother does not converge: the last pass moved a bubble by {largest_px:.3g} px",
            where="smooth",
            todo="check calibration, encoder and sensors; to find the cause leave out the encoder, "
            "then one sensor after the other",
        )


def _check_variances(found: Covariances | None) -> None:
    """Raise CalibrationError if rounding has left a state without a positive variance."""
    if found is None:
        return
    for what, covariance in (("bubble", found.bubbles), ("rig", found.shake)):
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        if variance.size and not np.all(variance >= -_ROUNDING * variance.max(axis=0)):
            raise CalibrationError(
                f"a state of a {what} has a negative variance because of rounding: the data hardly "
                "determine it",
                where="smooth",
                todo="look for short or broken tracks in tracking's report and drop them in "
                "corrections.csv, or smooth with other sensors",
            )


def _warm(graph: GraphLayout, state: State, start: Solution) -> State:
    """Return the first guess with the values of another solution where they have one meaning."""
    same = {
        name: value
        for name, value in vars(start.state).items()
        if value.shape == getattr(state, name).shape and name not in ("shake", "clocks")
    }
    alike = graph.shake.labels == start.graph.shake.labels
    if alike and graph.shake.size == start.graph.shake.size:
        t = start.graph.nodes.t_s
        columns = [np.interp(graph.nodes.t_s, t, c) for c in start.state.shake.T]
        same["shake"] = np.stack(columns, -1) if columns else state.shake
    return replace(state, **same)


def _is_linear(problem: SmoothingProblem, model: ShakeModel) -> bool:
    """Return whether one pass is exact: affine cameras, no bilinear constants."""
    lens = slice(INDEX["kappa_per_mm"], INDEX["wall_x_rad"])
    flat = all(not np.any(c.intrinsics[lens]) for c in problem.cameras)
    held = (
        model.encoder_scale_sigma,
        model.accelerometer_scale_sigma,
        model.accelerometer_delay_sigma_s,
    )
    return flat and not any(held)


@dataclass(frozen=True)
class _Pass:
    factors: list[LinearFactors]
    done: EliminatedGraph | EliminatedCrowd
    largest_px: float
    log_norm: float
    squared: float


def _linear_solve(
    graph: GraphLayout, state: State, weights: tuple[Array, Array], samples: SampleWeights
) -> _Pass:
    """Do one Gauss-Newton pass."""
    factors = all_factors(graph, state, weights, samples)
    done = eliminated(graph, factors)
    if not np.all(np.isfinite(done.vector)):
        raise CalibrationError("the smoother's solution is not finite", todo="check the inputs")
    largest = _largest_shift_px(graph, done.vector)
    fitted = product(factors, starts_of(graph), done.vector[:, None])
    squared = sum(float(((f.rhs - a[..., 0]) ** 2).sum()) for f, a in zip(factors, fitted))
    return _Pass(factors, done, largest, _log_norm(graph, factors), squared)


def _log_norm(graph: GraphLayout, factors: list[LinearFactors]) -> float:
    """Return the log of the joint density's normalisation, including the change of bases."""
    shake, bubble = graph.shake_motion, graph.bubble_motion
    of_nodes = np.linalg.slogdet(shake.basis)[1][graph.node_basis]
    of_rows = np.linalg.slogdet(bubble.basis)[1][graph.row_basis]
    return float(of_nodes.sum() + of_rows.sum()) + sum(f.log_norm() for f in factors)


def _largest_shift_px(graph: GraphLayout, vector: Array) -> float:
    """Return how far bubbles moved in this pass, in pixels of the finest camera."""
    states = vector[graph.columns().bubbles].reshape(-1, graph.bubble.size)
    moves = graph.bubbles_moved(states) @ graph.bubble.position.T
    scale = max(c["scale_px_per_mm"] for c in graph.problem.cameras)
    return float(np.max(np.abs(moves), initial=0.0) * scale)


def _finish(
    graph: GraphLayout,
    state: State,
    fitted: tuple[tuple[Array, Array], tuple[Array, Array]],
    last: _Pass,
    options: Options,
    done: int,
    progress: Progress,
) -> Solution:
    """Covariances and evidence from the last pass, whose linearisation is within the tolerance.

    fitted : weights and residuals, of bubbles and of marks.
    """
    evidence = last.log_norm - last.squared / 2
    evidence += len(last.done.vector) / 2 * np.log(2 * np.pi)
    evidence -= last.done.log_det()
    draws = draws_of(graph, last.factors, last.done) if options.draws else None
    constants = _joint_covariance(last.done, graph.columns()[3:]) if options.constants else None
    ways = shared = None
    if draws is not None and graph.rows and graph.model.bubble.inertia is not None:
        if isinstance(last.done, EliminatedCrowd):
            chains = last.done.chains
        else:
            chains = bubble_chains(graph, last.factors)
        ways = way_variances(graph, state, last.factors, chains, draws)
    if isinstance(last.done, EliminatedCrowd) and options.covariances and graph.share_size:
        shared = _joint_covariance(last.done, [graph.columns().constants])
    by_scale = None
    if options.covariances and graph.encoder_size and graph.rows:
        by_scale = _scale_variances(graph, last.done)
    last.factors.clear()
    give_back_freed_memory()
    found = None
    if options.covariances:
        progress("covariances", 0.0)
        found = replace(_covariances(graph, last.done.blocks()), by_scale=by_scale)
        if shared is not None:
            encoder, rig = np.split(np.arange(len(shared)), [graph.encoder_size])
            of_encoder, of_rig = (shared[np.ix_(mine, mine)] for mine in (encoder, rig))
            found = replace(found, encoder=of_encoder, calibration=of_rig)
            add_own_calibration(graph, state, found.bubbles, found.calibration)
        add_slow_noise(graph, state, found.bubbles)
    progress("smoothing", 1.0)
    return Solution(
        graph, state, found, *fitted, float(evidence), done, draws=draws, ways=ways,
        constants=constants,
    )  # fmt: skip


def _joint_covariance(done: EliminatedGraph | EliminatedCrowd, columns: Sequence[slice]) -> Array:
    """Return the joint covariance of some families of variables, such as what does not change along
    a run.  columns : the place of each in the vector of all variables."""
    rows = np.r_[tuple(columns)]
    out = np.zeros((len(rows), len(rows)))
    for first in range(0, len(rows), _COLUMNS_AT_ONCE):
        mine = np.arange(first, min(first + _COLUMNS_AT_ONCE, len(rows)))
        out[:, mine] = done.columns(rows[mine])[rows]
    return (out + out.T) / 2


def _scale_variances(graph: GraphLayout, done: EliminatedGraph | EliminatedCrowd) -> Array:
    """Return what the encoder's uncertain scale adds to the variances (rows, 3) of positions.

    It is the square of their covariance with the scale over the variance of the scale.
    """
    columns = graph.columns()
    at = columns.constants.start
    column = done.columns(np.array([at]))[:, 0]
    states = column[columns.bubbles].reshape(-1, graph.bubble.size)
    moves = graph.bubbles_moved(states) @ graph.bubble.position.T
    return np.asarray(moves**2 / column[at])


def drawn(solution: Solution, draws: int | None = None) -> Draws:
    """Return draws at a solution: those that it has, or by one more elimination.

    draws : their number; None for as many as `draws_of` makes.
    """
    if solution.draws is not None and draws is None:
        return solution.draws
    graph, samples = solution.graph, solution.sample_weights or None
    factors = all_factors(graph, solution.state, solution.weights, samples)
    return in_large_stack(lambda: draws_of(graph, factors, eliminated(graph, factors), draws))


def _covariances(graph: GraphLayout, own: list[Array]) -> Covariances:
    """Marginals in physical units."""
    shake, bubbles = own[:2]
    for mine in _parts(len(shake)):
        basis = graph.shake_basis(graph.nodes.of_frame[mine])
        if graph.to_frames is not None:
            basis = graph.to_frames[mine] @ basis
        shake[mine] = basis @ shake[mine] @ np.swapaxes(basis, -1, -2)
    graph.bubble_covariances(bubbles)
    encoder = graph.encoder_size
    return Covariances(
        shake, bubbles, own[2], own[3], own[4][0, :encoder, :encoder],
        own[4][0, encoder:, encoder:], *own[5:],
    )  # fmt: skip


def _parts(count: int) -> list[Ints]:
    """Yield parts of some thousand numbers, to limit the memory for intermediate results."""
    return [np.arange(i, min(i + AT_ONCE, count)) for i in range(0, count, AT_ONCE)]


def delays_have_moved(graph: GraphLayout, state: State) -> bool:
    """Return whether an accelerometer's delay has changed so much that its samples belong to other
    times.
    """
    if not (graph.sensor_flags[1] and graph.problem.accelerometers):
        return False
    return bool(np.max(np.abs(state.clocks)) >= _DELAY_STEP_S)


def with_moved_nodes(graph: GraphLayout, state: State) -> tuple[GraphLayout, State, bool]:
    """Place the states of accelerometers, whose delay has changed, at the new times.

    Returns the layout, the state, and whether anything was changed.
    """
    if not delays_have_moved(graph, state):
        return graph, state, False
    leap = np.clip(state.clocks[graph.clock_of, 0], -_DELAY_LEAP_S, _DELAY_LEAP_S)
    fresh = graph_layout(graph.problem, graph.model, graph.delays_s + leap)
    shake = np.stack(
        [np.interp(fresh.nodes.t_s, graph.nodes.t_s, column) for column in state.shake.T], -1
    )
    clocks = np.zeros_like(state.clocks)
    return fresh, replace(state, shake=shake, clocks=clocks), True


def in_large_stack(task: Callable[[], T]) -> T:
    """Run a task in a thread with a large stack and return its result.

    GTSAM's recursion is as deep as the run is long. Python's cycle collector is switched off
    meanwhile, because it would examine a million small arrays again and again, although none is in
    a cycle.
    """
    result: list[T] = []
    fault: list[BaseException] = []

    def run() -> None:
        try:
            result.append(task())
        except BaseException as error:  # noqa: BLE001 - raised again in the caller's thread
            fault.append(error)

    give_back_freed_memory()  # of this thread, which the other one cannot use
    collecting = gc.isenabled()
    gc.disable()
    before = threading.stack_size(_STACK_BYTES)
    try:
        thread = threading.Thread(target=run, name="telerig-smoother")
        thread.start()
        threading.stack_size(before)
        thread.join()
    finally:
        threading.stack_size(before)
        if collecting:
            gc.enable()
    give_back_freed_memory()
    if fault:
        raise fault[0]
    return result[0]
