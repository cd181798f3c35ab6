"""Computes how well a run separates the motion of the bubbles from the shake of the rig, by axis.

q is the ratio of a position's standard deviation to the one that it would have if the shake were
known. eta is the share of the shake's prior variance that the data remove. In addition, a spectral
line can be ambiguous: an oscillation of the bubbles as well as one of the rig
(`telerig.estimator.smoothing.learning.spectral_lines`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.solve import Options, Solution, solve
from telerig.estimator.smoothing.learning.learn import Learning, groups_of
from telerig.estimator.smoothing.learning.lines_of_sight import signals_of
from telerig.estimator.smoothing.learning.spectral_lines import attributions
from telerig.estimator.smoothing.learning.window import first_of_most_seen
from telerig.estimator.smoothing.problem.problem import (
    CarriageModel,
    Observations,
    ShakeModel,
    SmoothingProblem,
)
from telerig.estimator.smoothing.problem.window import Window, cut_out
from telerig.estimator.smoothing.verdict.evidence import Shake
from telerig.factors.motion import start
from telerig.io.results.smoothing import AXES, AttributedLine, AxisVerdict, Flag, Verdict

RESOLVED_Q, PARTIAL_Q, RESOLVED_ETA = 1.25, 2.0, 0.99
_MOST_FRAMES, _MOST_BUBBLES = 2000, 3
_EDGE = 0.1
_SEEN = 0.25


def verdicts(
    solution: Solution,
    shake: Shake | None,
    inflation: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> dict[str, AxisVerdict]:
    """Return the identifiability along "x", "y" and "z"; {} without bubbles or covariances.

    shake : sums over the run; None without a shake in the model.
    inflation : factors of the standard deviations because of contradictions.
    """
    if solution.covariances is None or not solution.graph.problem.bubbles:
        return {}
    window = window_of(solution)
    if not window.problem.bubbles:
        return {}
    sigma, known = _sigmas(solution, window)
    eta, rms = shake_share(solution, shake), shake_rms(solution, shake)
    resolved = all(e is not None and e >= RESOLVED_ETA for e in eta)
    lines = [] if resolved else _lines(window.problem, solution.graph.model)
    out = {}
    for axis, name in enumerate(AXES):
        mine = tuple(line for part, line in lines if part[axis] > 0.7)
        out[name] = axis_verdict(
            sigma[:, axis], known[:, axis], eta[axis], rms[axis], mine, inflation[axis]
        )
    return out


def axis_verdict(
    sigma: Array,
    known: Array,
    eta: float | None,
    rms: float,
    lines: tuple[AttributedLine, ...],
    inflation: float = 1.0,
) -> AxisVerdict:
    """Return the identifiability along one axis.

    sigma, known : (n,) standard deviations (mm) of positions, as they are and with known shake.
    eta, rms, lines : as in `AxisVerdict`.
    inflation : factor of the standard deviations because of contradictions.
    """
    q, base = float(np.median(sigma / known)), float(np.median(known))
    verdict = Verdict.UNRESOLVED
    if q <= RESOLVED_Q or (eta is not None and eta >= RESOLVED_ETA):
        verdict = Verdict.RESOLVED
    elif q <= PARTIAL_Q:
        verdict = Verdict.PARTIAL
    agree = inflation <= RESOLVED_Q
    flags = []
    if any(x.owner == "rig" and x.ambiguous and (x.rms_mm or 0.0) > base for x in lines):
        flags.append(Flag.LABEL_AMBIGUOUS)
    if rms < base and q <= RESOLVED_Q and agree:
        flags.append(Flag.SHAKE_BELOW_NOISE)
    return AxisVerdict(
        verdict=verdict if agree else Verdict.CONTRADICTED, flags=tuple(flags), q=q * inflation,
        eta=eta, sigma_mm=float(np.median(sigma)) * inflation, sigma_shake_known_mm=base,
        shake_rms_mm=float(rms), lines=lines,
    )  # fmt: skip


def _sigmas(solution: Solution, window: Window) -> tuple[Array, Array]:
    """Return standard deviations (n, 3) of positions: as they are, and with known shake.

    Frames outside the encoder's record do not count: there both contain a carriage whose position
    is not known, so that their ratio says nothing about the shake.
    """
    still = solve(
        without_sensors(window.problem),
        replace(
            solution.graph.model.without_shake(), carriage=CarriageModel(), encoder_scale_sigma=0.0
        ),
        Options(robust=False),
    )
    assert still.covariances is not None and solution.covariances is not None
    ours, whole = still.graph, solution.graph
    rows = _inner_rows(window)
    inside = whole.problem.in_encoder_record[ours.frame_of_row[rows] + window.first]
    rows = rows[inside] if inside.any() else rows
    bubble, frame = ours.bubble_of_row[rows], ours.frame_of_row[rows] + window.first
    same = whole.row(window.bubbles[bubble], frame)
    known = _position_sigma(still, rows)
    if solution.graph.encoder_flags[0]:
        model = replace(solution.graph.model, encoder_scale_sigma=0.0)
        return _position_sigma(solve(window.problem, model, Options(robust=False)), rows), known
    return _position_sigma(solution, same), known


def without_sensors(problem: SmoothingProblem) -> SmoothingProblem:
    """Return the problem without accelerometers and marks: detections of bubbles and encoder
    remain.
    """
    return replace(problem, accelerometers=(), marks=(), references=Observations.none(), known=())


def _inner_rows(window: Window) -> Ints:
    """Return the rows of the bubbles' states, without a tenth of each track at both ends."""
    at, out = 0, []
    for bubble in window.problem.bubbles:
        edge = int(_EDGE * len(bubble))
        out.append(np.arange(at + edge, at + len(bubble) - edge))
        at += len(bubble)
    return np.concatenate(out)


def _position_sigma(solution: Solution, rows: Ints) -> Array:
    assert solution.covariances is not None
    at, covariance = solution.graph.bubble.position, solution.covariances.bubbles[rows]
    return np.asarray(np.sqrt(np.einsum("id,nde,ie->ni", at, covariance, at, optimize=True)))


def shake_share(solution: Solution, shake: Shake | None) -> list[float | None]:
    """Return eta along x, y and z: the least over the directions near the axis that a camera sees.

    An axis without such a direction gets None.
    """
    graph = solution.graph
    least: list[float | None] = [None, None, None]
    if shake is None:
        return least
    before, _ = start(graph.shake.components)
    for camera, seen in enumerate(graph.shake.seen):
        for direction, variance in zip(seen, shake.variance[camera]):
            row = direction @ graph.shake.offset[camera]
            prior = float(row @ before @ row)
            if prior <= 0:
                continue
            for axis in np.flatnonzero(direction**2 > _SEEN):
                eta, known = 1 - float(variance) / shake.frames / prior, least[axis]
                least[axis] = eta if known is None else min(known, eta)
    return least


def shake_rms(solution: Solution, shake: Shake | None) -> Array:
    """Return the shake's RMS (3,) in mm, uncertainty included, largest over the cameras."""
    out = np.zeros(3)
    if shake is None:
        return out
    for seen, squares in zip(solution.graph.shake.seen, shake.square):
        for direction, square in zip(seen, squares):
            near = direction**2 > _SEEN
            out[near] = np.maximum(out[near], float(np.sqrt(square / shake.frames)))
    return out


def _lines(
    problem: SmoothingProblem, model: ShakeModel
) -> list[tuple[Sequence[float], AttributedLine]]:
    """Return spectral lines with direction and owner; none if accelerometers measure the shake."""
    if problem.arms_with_sensor:
        return []
    signals = [c for c in signals_of(problem) if c.samples]
    out: list[tuple[Sequence[float], AttributedLine]] = []
    for group in groups_of(signals, Learning(), problem.up):
        found = attributions(group.fast, model, group.pattern, problem.up)
        out += [
            (
                group.pattern,
                AttributedLine(
                    owner=line.owner, frequency_hz=line.frequency_hz, rms_mm=line.rms_mm,
                    other_owner_costs_nats=line.log_likelihood_ratio, ambiguous=line.ambiguous,
                ),
            )
            for line in found
        ]  # fmt: skip
    return out


def window_of(solution: Solution) -> Window:
    """Return a part of a solved run with its longest tracks, without outliers.

    It is the middle of the run, unless far more is seen elsewhere.
    """
    problem = solution.graph.problem
    count, first = len(problem.t_s), first_of_most_seen(problem, _MOST_FRAMES)
    return cut_out(
        problem, first, min(count, first + _MOST_FRAMES), solution.weights, _MOST_BUBBLES
    )
