"""Solve the smoothing graph: Gauss-Newton passes, robust weights, covariances, evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import CalibrationError
from telerig.estimator.smoother.blocks import Linear
from telerig.estimator.smoother.clocks import late, restamped
from telerig.estimator.smoother.linear import all_factors, pixel_residuals
from telerig.estimator.smoother.marginals import marginal_covariances
from telerig.estimator.smoother.model import ShakeModel, SmoothingProblem
from telerig.estimator.smoother.state import Frame, State, first_guess, frame_of, moved, times
from telerig.estimator.smoother.threads import in_large_stack
from telerig.estimator.smoother.truncation import Truncation
from telerig.factors.motion import add_linear_factors
from telerig.rig.projection import INDEX

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_NOTHING = np.zeros(0, np.int64)
_CLOCK_PASSES = 6


@dataclass(frozen=True)
class Options:
    """passes : relinearisations at most, some more while a sensor's clock moves.

    robust : down-weight pixels that do not fit.
    covariances : of states ("frames"), or none (False) when only the evidence is asked.
    tolerance_px : passes end when no bubble moved more in the last. Affine cameras and held
        constants need one pass.
    """

    passes: int = 6
    robust: bool = True
    covariances: bool = True
    tolerance_px: float = 0.05


@dataclass(frozen=True)
class Covariances:
    """shake : (F, Ds, Ds) at the frames.  bubbles : (rows, Db, Db).  Constants one each.

    cross : (rows, Ds, Db) of the shake with each bubble at the same frame.
    """

    shake: Array
    bubbles: Array
    cross: Array
    means: Array
    sensors: Array
    encoder: Array
    calibration: Array
    marks: Array
    clocks: Array


@dataclass(frozen=True)
class Solution:
    """The posterior.

    weights : of the bubbles' pixels (M,) and of the marks' (R,), 0 for outliers.
    residuals : whitened, (M, 2) and (R, 2).  log_evidence : exact for linear cameras, else at the
    last linearisation.  delays_s : (A,) the accelerometers'.
    """

    frame: Frame
    state: State
    covariances: Covariances | None
    weights: tuple[Array, Array]
    residuals: tuple[Array, Array]
    log_evidence: float
    passes: int

    @property
    def delays_s(self) -> Array:
        delays = self.frame.delays_s
        if self.frame.sensor_flags[1] and len(delays):
            return np.asarray(delays + self.state.clocks[self.frame.clock_of, 0])
        return delays


def solve(
    problem: SmoothingProblem,
    model: ShakeModel,
    options: Options | None = None,
    progress: Progress | None = None,
    start: Solution | None = None,
) -> Solution:
    """Smooth. ``start``: a solution of the same measurements under another model.

    Raises CalibrationError when the measurements leave something undetermined.
    """
    chosen = options or Options()
    return in_large_stack(lambda: _solve(problem, model, chosen, progress or _silent, start))


def _silent(_what: str, _share: float) -> None:
    return None


def _solve(
    problem: SmoothingProblem,
    model: ShakeModel,
    options: Options,
    progress: Progress,
    start: Solution | None,
) -> Solution:
    delays = np.array([a.delay_s for a in problem.accelerometers])
    frame = frame_of(problem, model, delays if start is None else start.frame.delays_s)
    state = first_guess(frame)
    weights = (np.ones(len(problem.observations)), np.ones(len(problem.references)))
    if start is not None:
        weights, state = start.weights, _warm(frame, state, start)
    robust = Truncation(options.robust)
    last: _Pass | None = None
    exact = _is_linear(problem, model)
    done = 0
    for done in range(1, options.passes + _CLOCK_PASSES + 1):
        if done > options.passes and not late(frame, state):
            break
        progress("smoothing", min((done - 1) / (options.passes + 1), 0.95))
        last = made = _linear_solve(frame, state, weights)
        state = moved(frame, state, made.step)
        fresh, changed = robust.update(weights, pixel_residuals(frame, state))
        settled = (made.largest_px < options.tolerance_px and not late(frame, state)) or exact
        if settled and not changed and (done > 1 or start is not None or exact):
            break
        weights = fresh
        frame, state, again = restamped(frame, state)
        last = None if again or changed else last
    if last is None:
        weights = ((weights[0] > 0.5).astype(float), (weights[1] > 0.5).astype(float))
        last = _linear_solve(frame, state, weights)
        state = moved(frame, state, last.step)
    return _finish(frame, state, weights, last, options, done, progress)


def _warm(frame: Frame, state: State, start: Solution) -> State:
    """The first guess with whatever of another solution has the same meaning here."""
    same = {
        name: value
        for name, value in vars(start.state).items()
        if value.shape == getattr(state, name).shape and name not in ("shake", "clocks")
    }
    if frame.shake.labels == start.frame.shake.labels:
        t = start.frame.nodes.t_s
        columns = [np.interp(frame.nodes.t_s, t, c) for c in start.state.shake.T]
        same["shake"] = np.stack(columns, -1) if columns else state.shake
    return replace(state, **same)


def _is_linear(problem: SmoothingProblem, model: ShakeModel) -> bool:
    """Whether one pass is exact: affine cameras, no bilinear constants."""
    lens = slice(INDEX["kappa_per_mm"], INDEX["wall_x_rad"])
    flat = all(not np.any(c.intrinsics[lens]) for c in problem.cameras)
    held = (
        model.encoder_scale_sigma,
        model.encoder_delay_sigma_s,
        model.accelerometer_scale_sigma,
        model.accelerometer_delay_sigma_s,
    )
    return flat and not any(held) and model.bubble.speed_sigma_mm_s is None and not model.pitches


@dataclass(frozen=True)
class _Pass:
    net: Any
    step: Array
    largest_px: float
    log_norm: float
    squared: float


def _linear_solve(frame: Frame, state: State, weights: tuple[Array, Array]) -> _Pass:
    import gtsam

    factors = all_factors(frame, state, weights)
    graph = gtsam.GaussianFactorGraph()
    for linear in factors:
        add_linear_factors(graph, linear.keys, linear.blocks, linear.rhs)
    _add_bonds(graph, frame)
    net, solution = _eliminated(graph, frame)
    vector = solution.vector()
    if not np.all(np.isfinite(vector)):
        raise CalibrationError("the smoother's solution is not finite", todo="check the inputs")
    largest = _largest_shift_px(factors, frame, vector)
    return _Pass(net, vector, largest, _log_norm(frame, factors), 2 * graph.error(solution))


def _add_bonds(graph: Any, frame: Frame) -> None:
    """Empty factors between shake and bubbles where no image joins them.

    Their cross covariance is read from a clique that holds both, and a bubble that is unseen from
    its first row on would share none.
    """
    size = frame.counts()[0][1]
    seen = frame.row(frame.problem.observations.item, frame.problem.observations.frame)
    alone = np.setdiff1d(np.arange(frame.rows), seen)
    if not size or not len(alone):
        return
    keys = (frame.node_of_row[alone], frame.base()[1] + alone)
    blocks = tuple(np.zeros((len(alone), 1, d)) for d in (size, frame.bubble.size))
    add_linear_factors(graph, keys, blocks, np.zeros((len(alone), 1)))


def _eliminated(graph: Any, frame: Frame) -> tuple[Any, Any]:
    """Bayes net and solution: by Cholesky, or by QR, four times slower, where digits are short.

    The normal equations of a broad band's smooth prior lose ten digits at 500 Hz (covariances are
    good to 3e-6), and more than double precision has with steps as short as a sensor's. Else QR
    is for what Cholesky refuses.
    """
    import gtsam

    ordering = _ordering(frame)
    try:
        if len(frame.nodes.t_s) == len(frame.problem.t_s) and not frame.model.broad_bands:
            try:
                net = graph.eliminateSequential(ordering)
                return net, net.optimize()
            except RuntimeError:
                pass
        net = graph.eliminateSequential(ordering, gtsam.EliminateQR)
        return net, net.optimize()
    except RuntimeError as error:
        raise CalibrationError(
            f"the graph cannot be solved: {str(error).strip().splitlines()[0]}",
            todo="check the priors: every component needs a positive intensity",
        ) from error


def _log_norm(frame: Frame, factors: list[Linear]) -> float:
    """log of the joint density's normalisation, the change to whitening bases included."""
    shake, bubble = frame.shake_motion, frame.bubble_motion
    of_nodes = np.linalg.slogdet(shake.basis)[1][np.append(shake.index, -1)]
    of_rows = np.linalg.slogdet(bubble.basis)[1][frame.row_basis]
    return float(of_nodes.sum() + of_rows.sum()) + sum(f.log_norm() for f in factors)


def _ordering(frame: Frame) -> Any:
    """Time order; what ends (a bubble's mean, a mark) right after it was last seen; rest last."""
    import gtsam

    base, problem = frame.base(), frame.problem
    nodes = np.arange(len(frame.nodes.t_s)) if frame.shake.size else np.zeros(0, np.int64)
    rows = np.arange(frame.rows)
    last_row = frame.node_of_row[frame.first_row[1:] - 1] if len(problem.bubbles) else _NOTHING
    last_mark = np.zeros(len(problem.marks), np.int64)
    seen = frame.nodes.of_frame[problem.references.frame]
    np.maximum.at(last_mark, problem.references.item, seen)
    keys = [nodes, base[1] + rows, base[2] + np.arange(len(problem.bubbles))]
    when = [nodes, frame.node_of_row, last_row]
    keys.append(base[5] + np.arange(len(problem.marks)))
    when.append(last_mark)
    rank = np.repeat(np.arange(4), [len(k) for k in keys])
    joined = np.concatenate(keys).astype(np.int64)
    order = np.lexsort((joined, rank, np.concatenate(when)))
    out = gtsam.Ordering()
    for key in joined[order].tolist():
        out.push_back(key)
    counts = frame.counts()
    for family in (3, 4, 6):
        number, size = counts[family]
        for key in range(base[family], base[family] + number * (size > 0)):
            out.push_back(key)
    return out


def _largest_shift_px(factors: list[Linear], frame: Frame, vector: Array) -> float:
    """How far bubbles moved in this pass, in pixels of the finest camera."""
    layout, (nodes, size) = frame.bubble, frame.counts()[0]
    start = nodes * size
    states = vector[start : start + frame.rows * layout.size].reshape(-1, layout.size)
    moves = times(frame.bubble_basis(np.arange(frame.rows)), states) @ layout.position.T
    scale = max(c["scale_px_per_mm"] for c in frame.problem.cameras)
    return float(np.max(np.abs(moves), initial=0.0) * scale)


def _finish(
    frame: Frame,
    state: State,
    weights: tuple[Array, Array],
    last: _Pass,
    options: Options,
    done: int,
    progress: Progress,
) -> Solution:
    """Covariances and evidence from the last pass, whose linearisation is within the tolerance."""
    dimension = sum(n * d for n, d in frame.counts())
    evidence = last.log_norm - last.squared / 2 + dimension / 2 * np.log(2 * np.pi)
    found = None
    if options.covariances:
        found, log_det = _covariances(frame, last.net, progress)
    else:
        log_det = _log_det(last.net)
    evidence -= log_det
    progress("smoothing", 1.0)
    return Solution(
        frame, state, found, weights, pixel_residuals(frame, state), float(evidence), done
    )


def _log_det(net: Any) -> float:
    """log |R|; QR leaves signs on the diagonal."""
    diagonals = (np.diagonal(net.at(i).R()) for i in range(net.size()))
    return float(sum(np.log(np.abs(d)).sum() for d in diagonals))


def _covariances(frame: Frame, net: Any, progress: Progress) -> tuple[Covariances, float]:
    """Marginals in physical units, and log |R| of the net."""
    base, counts = frame.base(), frame.counts()
    progress("covariances", 0.0)
    families = [range(base[i], base[i] + n * (d > 0)) for i, (n, d) in enumerate(counts)]
    at_frames = frame.nodes.of_frame.tolist() if counts[0][1] else []
    wanted = set(at_frames).union(*families[1:])
    sizes = [d for n, d in counts for _ in range(n)]
    rows = base[1] + np.arange(frame.rows)
    pairs = list(zip(frame.node_of_row.tolist(), rows.tolist())) if counts[0][1] else []
    marginals = marginal_covariances(net, sizes, wanted, pairs)
    found, crossed = marginals.own, marginals.cross

    def of(keys: Sequence[int], i: int) -> Array:
        number, size = len(problem_frames) if i == 0 else counts[i][0], counts[i][1]
        return np.array([found[key] for key in keys]).reshape(number, size, size)

    problem_frames = frame.nodes.of_frame
    blocks = [of(keys, i) for i, keys in enumerate([at_frames, *families[1:]])]
    shake_basis = frame.shake_basis(problem_frames)
    if frame.to_frames is not None:
        shake_basis = frame.to_frames @ shake_basis
    bubble_basis = frame.bubble_basis(np.arange(frame.rows))
    shake = shake_basis @ blocks[0] @ np.swapaxes(shake_basis, -1, -2)
    bubbles = bubble_basis @ blocks[1] @ np.swapaxes(bubble_basis, -1, -2)
    cross = np.array([crossed[pair] for pair in pairs])
    cross = cross.reshape(frame.rows, counts[0][1], counts[1][1])
    cross = shake_basis[frame.frame_of_row] @ cross @ np.swapaxes(bubble_basis, -1, -2)
    covariances = Covariances(
        shake,
        bubbles,
        cross,
        blocks[2],
        blocks[3],
        blocks[4][0, : frame.encoder_size, : frame.encoder_size],
        blocks[4][0, frame.encoder_size :, frame.encoder_size :],
        *blocks[5:],
    )
    return covariances, marginals.log_det
