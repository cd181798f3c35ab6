"""Computes how well a run separates the motion of the bubbles from the shake of the rig, by axis.

q is the ratio of a position's standard deviation to the one that it would have if the shake were
known. eta is the share of the shake's variance that the data remove, of the shake that the run
shows; a wide prior would make any shake look removed. Both are read from the solution. They mean
nothing where one or two bubbles alone show the shake: one's motion and the rig's can be exchanged
without changing the likelihood, two tell them apart too badly, so that both numbers follow from the
priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.smoothing.graph.known_rig import shake_known_variances
from telerig.estimator.smoothing.graph.layout import GraphLayout, variances
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.graph.stage_travel import considered_variance, offset_sigma
from telerig.estimator.smoothing.problem.problem import CARRIAGE, FEWEST_BUBBLES
from telerig.estimator.smoothing.verdict.evidence import EDGE, Shake, shake_of
from telerig.factors.motion import start
from telerig.io.results.smoothing import (
    PARTIAL_ETA,
    PARTIAL_Q,
    RESOLVED_ETA,
    RESOLVED_Q,
    AxisVerdict,
    Flag,
    Verdict,
)
from telerig.io.tables.smoothing import AXES

_SEEN = 0.25
_MOSTLY = 0.5
"""Share of the frames in which so many bubbles have to be seen."""


class Measured(IntEnum):
    """Name of what part of the rig the shake is measured, by more than one or two bubbles alone.

    CARRIAGE : of the carriage, without the arms' own motion.
    CAMERAS : of the cameras.
    """

    NOTHING = 0
    CARRIAGE = 1
    CAMERAS = 2


def verdicts(
    solution: Solution, shake: Shake | None, inflation: Sequence[float] = (1.0, 1.0, 1.0)
) -> dict[str, AxisVerdict]:
    """Return the identifiability along "x", "y" and "z"; {} without bubbles or covariances.

    shake : sums over the run; None without a shake in the model.
    inflation : (3,) factors of the standard deviations because of contradictions.
    """
    if solution.covariances is None or not solution.graph.rows:
        return {}
    sigma, known, encoder = _sigmas(solution)
    offset = offset_sigma(solution)
    eta, rms = shake_share(solution, shake), shake_rms(solution, shake)
    measured, given = measured_shake(solution), solution.graph.model.name == "given"
    return {
        name: axis_verdict(
            sigma[:, axis], known[:, axis], encoder[:, axis], eta[axis], rms[axis],
            inflation[axis], measured=measured[axis], given=given,
        ).model_copy(update={"sigma_offset_mm": float(offset[axis])})
        for axis, name in enumerate(AXES)
    }  # fmt: skip


def axis_verdict(
    sigma: Array,
    known: Array,
    encoder: Array,
    eta: float | None,
    rms: float,
    inflation: float = 1.0,
    *,
    measured: Measured = Measured.CAMERAS,
    given: bool = False,
) -> AxisVerdict:
    """Return the identifiability along one axis.

    sigma, known : (n,) standard deviations (mm) of positions, as they are and with known shake.
    encoder : (n,) standard deviations (mm) that the encoder's scale and the travel axis add.
    eta, rms : as in `AxisVerdict`.
    inflation : factor of the standard deviations because of contradictions.
    measured : what but one or two bubbles alone shows the shake. Without anything eta does not
        count; if only the carriage's motion is measured, it cannot make the axis RESOLVED, because
        the part of the arms in it follows from the priors.
    given : whether the user states the shake's prior. If nothing measures the shake and nobody
        states it, q does not count either.
    """
    q, base = float(np.median(sigma / known)), float(np.median(known))
    agree, known_shake = inflation <= RESOLVED_Q, bool(measured) or given
    arms = measured != Measured.CARRIAGE or given
    flags = []
    if rms < base and q * inflation <= RESOLVED_Q and agree and known_shake:
        flags.append(Flag.SHAKE_BELOW_NOISE)
    if not known_shake:
        flags.append(Flag.SHAKE_UNMEASURED)
    verdict = Verdict.CONTRADICTED
    if agree and known_shake:
        counted = eta if measured else None
        verdict = rule(q * inflation, counted, arms=arms)
    elif agree:
        verdict = Verdict.UNRESOLVED
    if not arms and verdict == Verdict.PARTIAL:
        flags.append(Flag.ARMS_UNMEASURED)
    return AxisVerdict(
        verdict=verdict, flags=tuple(flags), q=q * inflation, eta=eta,
        sigma_mm=float(np.median(sigma)) * inflation, sigma_shake_known_mm=base,
        sigma_encoder_mm=float(np.median(encoder)) * inflation, shake_rms_mm=float(rms),
    )  # fmt: skip


def rule(q: float, eta: float | None, *, arms: bool) -> Verdict:
    """Return the verdict on an axis whose measurements agree.

    q, eta : as in `AxisVerdict`.
    arms : whether the motion of the cameras' arms is measured. If not, part of what is taken for it
        may be motion of the bubbles, and eta alone cannot make the axis RESOLVED.
    """
    share = -np.inf if eta is None else eta
    if q <= RESOLVED_Q or (share >= RESOLVED_ETA and arms):
        return Verdict.RESOLVED
    return Verdict.PARTIAL if q <= PARTIAL_Q or share >= PARTIAL_ETA else Verdict.UNRESOLVED


def measured_shake(solution: Solution) -> tuple[Measured, Measured, Measured]:
    """Return for x, y and z what measures the shake.

    Three bubbles in most frames show that of the cameras along all axes. So do, in most frames and
    along the axes that a camera sees, marks in its images and an accelerometer on its arm, by the
    axes of it that are used.
    """
    graph, problem = solution.graph, solution.graph.problem
    t_s, marks = problem.t_s, problem.references.of(solution.weights[1] > 0.5)
    there = np.bincount(graph.frame_of_row, minlength=len(t_s)) > 0
    kept = problem.observations.of(solution.weights[0] > 0.5)
    once = np.unique(kept.item * len(t_s) + kept.frame)  # for all cameras
    bubbles = np.bincount(once % len(t_s), minlength=len(t_s))

    def mostly(shown: Bools) -> bool:
        return bool(np.count_nonzero(shown & there) > _MOSTLY * np.count_nonzero(there))

    several, seen, felt = mostly(bubbles >= FEWEST_BUBBLES), list[Array](), list[Array]()
    for camera, directions in enumerate(graph.shake.seen):
        if mostly(np.isin(np.arange(len(t_s)), marks.frame[marks.camera == camera])):
            seen.extend(directions)
    for sensor in problem.accelerometers:
        if not mostly((t_s >= sensor.t_s[0]) & (t_s <= sensor.t_s[-1])):
            continue
        whole = sensor.camera == CARRIAGE
        (felt if whole else seen).extend(
            direction
            for direction in (np.eye(3) if whole else graph.shake.seen[sensor.camera])
            if ((sensor.axes[list(sensor.unused_axes)] @ direction) ** 2).sum() < _SEEN
        )

    def along(axis: int, directions: list[Array]) -> bool:
        return any(direction[axis] ** 2 > _SEEN for direction in directions)

    def of(axis: int) -> Measured:
        if several or along(axis, seen):
            return Measured.CAMERAS
        return Measured.CARRIAGE if along(axis, felt) else Measured.NOTHING

    return of(0), of(1), of(2)


def _sigmas(solution: Solution) -> tuple[Array, Array, Array]:
    """Return standard deviations (n, 3) of positions: as they are, with known shake, and what the
    encoder's scale and the travel axis add to the first.

    Frames outside the encoder's record do not count: there both contain a carriage whose position
    is not known, so that their ratio says nothing about the shake.
    """
    graph, found = solution.graph, solution.covariances
    assert found is not None
    rows = _inner_rows(graph)
    inside = graph.problem.in_encoder_record[graph.frame_of_row[rows]]
    rows = rows[inside] if inside.any() else rows
    samples = solution.sample_weights or None
    known = shake_known_variances(graph, solution.state, solution.weights, samples)[rows]
    at = graph.bubble.position
    whole = variances(at, found.bubbles[rows])
    by_scale = np.zeros_like(whole) if found.by_scale is None else found.by_scale[rows]
    own = np.maximum(whole - by_scale, np.minimum(known, whole))
    more = whole - own + considered_variance(solution)[0][rows]
    return np.sqrt(own), np.sqrt(known), np.sqrt(more)


def _inner_rows(graph: GraphLayout) -> Ints:
    """Return the rows of the bubbles' states, without a tenth of each track at both ends."""
    lengths = np.diff(graph.first_row)[graph.bubble_of_row]
    age = np.arange(graph.rows) - graph.first_row[graph.bubble_of_row]
    edge = (EDGE * lengths).astype(np.int64)
    return np.flatnonzero((age >= edge) & (age < lengths - edge))


def shake_share(solution: Solution, shake: Shake | None) -> list[float | None]:
    """Return eta along x, y and z: the least over the directions near the axis that a camera sees.

    An axis without such a direction, or without shake, gets None.
    """
    least: list[float | None] = [None, None, None]
    if shake is None:
        return least
    for seen, *sums in zip(solution.graph.shake.seen, shake.variance, shake.square, strict=True):
        for direction, variance, square in zip(seen, *sums, strict=True):
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
