"""Computes how well a run separates the motion of the bubbles from the shake of the rig, by axis.

q is the ratio of a position's standard deviation to the one that it would have if the shake were
known. eta is the share of the shake's variance that the data remove, of the shake that the run
shows; a wide prior would make any shake look removed. In addition, a spectral line can be
ambiguous: an oscillation of the bubbles as well as one of the rig
(`telerig.estimator.smoothing.learning.owners`). And q and eta mean nothing where one or two bubbles
alone show the shake: one's motion and the rig's can be exchanged without changing the likelihood,
two tell them apart too badly, so that both numbers follow from the priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.solve import Options, Solution, solve
from telerig.estimator.smoothing.graph.stage_travel import considered_variance
from telerig.estimator.smoothing.learning.learn import groups_of
from telerig.estimator.smoothing.learning.lines_of_sight import signals_of
from telerig.estimator.smoothing.learning.owners import attributions
from telerig.estimator.smoothing.learning.window import first_of_most_seen
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    FEWEST_BUBBLES,
    CarriageModel,
    Observations,
    ShakeModel,
    SmoothingProblem,
)
from telerig.estimator.smoothing.problem.window import Window, cut_out
from telerig.estimator.smoothing.verdict.evidence import Shake, shake_of
from telerig.factors.motion import start
from telerig.io.results.smoothing import (
    PARTIAL_ETA,
    PARTIAL_Q,
    RESOLVED_ETA,
    RESOLVED_Q,
    AttributedLine,
    AxisVerdict,
    Flag,
    Verdict,
)
from telerig.io.tables.smoothing import AXES

_MOST_FRAMES, _MOST_BUBBLES = 2000, 3
_EDGE = 0.1
_SEEN = 0.25
_MOSTLY = 0.5
"""Share of the frames in which so many bubbles have to be seen."""


class Measured(IntEnum):
    """Name of what part of the rig the shake is measured, by more than one bubble alone.

    CARRIAGE : of the carriage, without the arms' own motion.
    CAMERAS : of the cameras.
    """

    NOTHING = 0
    CARRIAGE = 1
    CAMERAS = 2


def verdicts(
    solution: Solution,
    shake: Shake | None,
    inflation: Sequence[float] = (1.0, 1.0, 1.0),
    *,
    read: bool = True,
) -> dict[str, AxisVerdict]:
    """Return the identifiability along "x", "y" and "z"; {} without bubbles or covariances.

    shake : sums over the run; None without a shake in the model.
    inflation : (3,) factors of the standard deviations because of contradictions.
    read : whether the problem holds readings, in which spectral lines can be looked for; those of a
        planned run are made up.
    """
    if solution.covariances is None or not solution.graph.problem.bubbles:
        return {}
    window = window_of(solution)
    if not window.problem.bubbles:
        return {}
    sigma, known, encoder = _sigmas(solution, window)
    eta, rms = shake_share(solution, shake), shake_rms(solution, shake)
    lines = _lines(window.problem, solution.graph.model) if read else []
    measured, given = measured_shake(solution), solution.graph.model.name == "given"
    return {
        name: axis_verdict(
            sigma[:, axis], known[:, axis], encoder[:, axis], eta[axis], rms[axis],
            tuple(line for part, line in lines if part[axis] > 0.7),
            inflation[axis], measured=measured[axis], given=given,
        )
        for axis, name in enumerate(AXES)
    }  # fmt: skip


def axis_verdict(
    sigma: Array,
    known: Array,
    encoder: Array,
    eta: float | None,
    rms: float,
    lines: tuple[AttributedLine, ...],
    inflation: float = 1.0,
    *,
    measured: Measured = Measured.CAMERAS,
    given: bool = False,
) -> AxisVerdict:
    """Return the identifiability along one axis.

    sigma, known : (n,) standard deviations (mm) of positions, as they are and with known shake.
    encoder : (n,) standard deviations (mm) that the encoder's scale and the travel axis add.
    eta, rms, lines : as in `AxisVerdict`.
    inflation : factor of the standard deviations because of contradictions.
    measured : what but one bubble alone shows the shake. Without anything eta does not count; if
        only the carriage's motion is measured, it cannot make the axis RESOLVED, because the part
        of the arms in it follows from the priors.
    given : whether the user states the shake's prior. If nothing measures the shake and nobody
        states it, q does not count either.
    """
    q, base = float(np.median(sigma / known)), float(np.median(known))
    ambiguous = any(
        line.ambiguous and (line.rms_mm or 0.0) > base and (line.owner == "rig" or bool(measured))
        for line in lines
    )
    agree, known_shake = inflation <= RESOLVED_Q, bool(measured) or given
    arms = measured != Measured.CARRIAGE or given
    flags = []
    if ambiguous:
        flags.append(Flag.LABEL_AMBIGUOUS)
    if rms < base and q <= RESOLVED_Q and agree and known_shake:
        flags.append(Flag.SHAKE_BELOW_NOISE)
    if not known_shake:
        flags.append(Flag.SHAKE_UNMEASURED)
    verdict = Verdict.CONTRADICTED
    if agree and known_shake:
        counted = eta if measured else None
        verdict = rule(q, counted, ambiguous=ambiguous or not arms)
    elif agree:
        verdict = Verdict.UNRESOLVED
    if not arms and verdict == Verdict.PARTIAL:
        flags.append(Flag.ARMS_UNMEASURED)
    return AxisVerdict(
        verdict=verdict, flags=tuple(flags), q=q * inflation, eta=eta,
        sigma_mm=float(np.median(sigma)) * inflation, sigma_shake_known_mm=base,
        sigma_encoder_mm=float(np.median(encoder)) * inflation, shake_rms_mm=float(rms),
        lines=lines,
    )  # fmt: skip


def rule(q: float, eta: float | None, *, ambiguous: bool) -> Verdict:
    """Return the verdict on an axis whose measurements agree.

    q, eta : as in `AxisVerdict`.
    ambiguous : whether a part of the shake may be motion of the bubbles: a spectral line that is
        larger than the noise, or the motion of arms that nothing measures. Then eta alone cannot
        make the axis RESOLVED.
    """
    share = -np.inf if eta is None else eta
    if q <= RESOLVED_Q or (share >= RESOLVED_ETA and not ambiguous):
        return Verdict.RESOLVED
    return Verdict.PARTIAL if q <= PARTIAL_Q or share >= PARTIAL_ETA else Verdict.UNRESOLVED


def measured_shake(solution: Solution) -> tuple[Measured, Measured, Measured]:
    """Return for x, y and z what measures the shake.

    Three bubbles in most frames show that of the cameras along all axes. So do, along the axes
    that a camera sees, marks in its images and an accelerometer on its arm.
    """
    graph, problem = solution.graph, solution.graph.problem
    count = np.bincount(graph.frame_of_row, minlength=len(problem.t_s))
    several = np.count_nonzero(count >= FEWEST_BUBBLES) > _MOSTLY * np.count_nonzero(count)
    carriage = any(sensor.camera == CARRIAGE for sensor in problem.accelerometers)
    seen = [
        direction
        for camera in problem.arms_with_sensor | set(problem.references.camera.tolist())
        for direction in graph.shake.seen[camera]
    ]

    def of(axis: int) -> Measured:
        if several or any(direction[axis] ** 2 > _SEEN for direction in seen):
            return Measured.CAMERAS
        return Measured.CARRIAGE if carriage else Measured.NOTHING

    return of(0), of(1), of(2)


def _sigmas(solution: Solution, window: Window) -> tuple[Array, Array, Array]:
    """Return standard deviations (n, 3) of positions: as they are, with known shake, and what the
    encoder's scale and the travel axis add to the first.

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
    sigma = everything = _position_sigma(solution, same)
    if solution.graph.encoder_flags[0]:
        model = replace(solution.graph.model, encoder_scale_sigma=0.0)
        sigma = _position_sigma(solve(window.problem, model, Options(robust=False)), rows)
    more = everything**2 - sigma**2 + considered_variance(solution)[0][same]
    return sigma, _position_sigma(still, rows), np.sqrt(more.clip(0))


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

    An axis without such a direction, or without shake, gets None.
    """
    least: list[float | None] = [None, None, None]
    if shake is None:
        return least
    for seen, variances, squares in zip(
        solution.graph.shake.seen, shake.variance, shake.square, strict=True
    ):
        for direction, variance, square in zip(seen, variances, squares, strict=True):
            if square <= 0:
                continue
            for axis in np.flatnonzero(direction**2 > _SEEN):
                eta, known = 1 - float(variance / square), least[axis]
                least[axis] = eta if known is None else min(known, eta)
    return least


def expected_shake(solution: Solution) -> Shake | None:
    """Return the sums that a run is expected to show whose readings are still to come.

    The expectation of an estimate's square plus its variance is the variance of the prior. None
    without a shake in the model or covariances.
    """
    shake, graph = shake_of(solution), solution.graph
    if shake is None:
        return None
    prior, _ = start(graph.shake.components)
    rows = [seen @ offset for seen, offset in zip(graph.shake.seen, graph.shake.offset)]
    square = tuple(shake.frames * np.einsum("kd,de,ke->k", r, prior, r) for r in rows)
    return replace(shake, square=square)


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
    for group in groups_of(signals, problem.up):
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
