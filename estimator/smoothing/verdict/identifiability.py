"""Can this run tell the bubbles' motion from the rig's shake? The verdict, in numbers and words.

Per axis of the rig: q, by how much not knowing the shake widens the bubbles' positions; eta, how
much of the shake's variance the data take away; and whether a spectral line could be the bubble's
as well as the rig's (see `telerig.estimator.smoothing.learning.attribution`).
A smoother that always answers is wrong: where these say no, the remedy is a mark fixed to the tank
or an accelerometer on each arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoothing.graph.solve import Options, Solution, solve
from telerig.estimator.smoothing.learning.attribution import Attribution, attributions
from telerig.estimator.smoothing.learning.groups import Learning, groups_of
from telerig.estimator.smoothing.learning.lines_of_sight import signals_of
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    CarriageModel,
    Observations,
    ShakeModel,
    SmoothingProblem,
)
from telerig.estimator.smoothing.verdict.modes import shake_modes
from telerig.estimator.smoothing.verdict.window import Window, window_of
from telerig.factors.motion import start

Array = NDArray[np.float64]

RESOLVED, PARTIAL, UNRESOLVED = "RESOLVED", "PARTIAL", "UNRESOLVED"
LABEL_AMBIGUOUS, SHAKE_BELOW_NOISE = "LABEL_AMBIGUOUS", "SHAKE_BELOW_NOISE"
AXES = ("x", "y", "z")

RESOLVED_Q, PARTIAL_Q, RESOLVED_ETA = 1.25, 2.0, 0.99
_STRIP = "fix a strip of dots to the tank inside both views"
_ARMS = "one accelerometer on each camera arm"
_MORE = "a longer record, more bubbles in view"
_EDGE = 0.1
_SEEN = 0.25


@dataclass(frozen=True)
class AxisVerdict:
    """One axis of the rig.

    q : sigma(position) over sigma(position | shake known).  eta : share of the shake's prior
    variance that the data take away, None without a shake in the model.
    shake_rms_mm : of the camera that shakes most.  lines : attributions that could be swapped.
    """

    verdict: str
    flags: tuple[str, ...]
    q: float
    eta: float | None
    sigma_mm: float
    sigma_shake_known_mm: float
    shake_rms_mm: float
    lines: tuple[Attribution, ...] = ()


def judge(problem: SmoothingProblem, model: ShakeModel, solution: Solution) -> dict[str, Any]:
    """The verdict part of smoothing.json: ``verdict``, ``flags``, ``axes``, ``words``, ``modes``.

    solution : of the problem under the model, with covariances (else the answer is empty).
    """
    found = verdicts(solution)
    if not found:
        return {}
    worst = max((a.verdict for a in found.values()), key=(RESOLVED, PARTIAL, UNRESOLVED).index)
    return {
        "verdict": worst,
        "flags": _flags(found),
        "axes": {name: _as_json(axis) for name, axis in found.items()},
        "words": words(problem, model, found),
        "remedy": "" if worst == RESOLVED else remedy_of_verdict(problem),
        "left_out": _left_out(problem),
        "modes": shake_modes(solution),
    }


def verdicts(solution: Solution) -> dict[str, AxisVerdict]:
    """By axis; empty without bubbles or covariances."""
    if solution.covariances is None or not solution.frame.problem.bubbles:
        return {}
    window = window_of(solution)
    if not window.problem.bubbles:
        return {}
    sigma, known = _sigmas(solution, window)
    eta, rms = shake_share(solution), shake_rms(solution)
    settled = all(e is not None and e >= RESOLVED_ETA for e in eta)
    lines = [] if settled else _lines(window.problem, solution.frame.model)
    out = {}
    for axis, name in enumerate(AXES):
        mine = tuple(line for part, line in lines if part[axis] > 0.7)
        out[name] = _axis(sigma[:, axis], known[:, axis], eta[axis], rms[axis], mine)
    return out


def _axis(
    sigma: Array, known: Array, eta: float | None, rms: float, lines: tuple[Attribution, ...]
) -> AxisVerdict:
    q, base = float(np.median(sigma / known)), float(np.median(known))
    verdict = UNRESOLVED
    if q <= RESOLVED_Q or (eta is not None and eta >= RESOLVED_ETA):
        verdict = RESOLVED
    elif q <= PARTIAL_Q:
        verdict = PARTIAL
    flags = []
    if any(_matters(line) and line.rms_mm > base for line in lines):
        flags.append(LABEL_AMBIGUOUS)
    if rms < base and q <= RESOLVED_Q:
        flags.append(SHAKE_BELOW_NOISE)
    return AxisVerdict(
        verdict, tuple(flags), q, eta, float(np.median(sigma)), base, float(rms), lines
    )


def _matters(line: Attribution) -> bool:
    return line.owner == "rig" and line.ambiguous


def _flags(found: dict[str, AxisVerdict]) -> list[str]:
    """Ambiguous if any axis is; below noise only if all are."""
    flags = []
    if any(LABEL_AMBIGUOUS in axis.flags for axis in found.values()):
        flags.append(LABEL_AMBIGUOUS)
    if all(SHAKE_BELOW_NOISE in axis.flags for axis in found.values()):
        flags.append(SHAKE_BELOW_NOISE)
    return flags


def _sigmas(solution: Solution, window: Window) -> tuple[Array, Array]:
    """(n, 3) sd of positions, and what they would be were the shake known, away from the ends.

    What the encoder's scale leaves open is in neither.
    """
    still = solve(
        without_sensors(window.problem),
        replace(
            solution.frame.model.without_shake(), carriage=CarriageModel(), encoder_scale_sigma=0.0
        ),
        Options(robust=False),
    )
    assert still.covariances is not None and solution.covariances is not None
    ours, whole = still.frame, solution.frame
    rows = _inner_rows(window)
    bubble, frame = ours.bubble_of_row[rows], ours.frame_of_row[rows] + window.first
    same = whole.row(window.bubbles[bubble], frame)
    known = _position_sigma(still, rows)
    if solution.frame.encoder_flags[0]:
        model = replace(solution.frame.model, encoder_scale_sigma=0.0)
        return _position_sigma(solve(window.problem, model, Options(robust=False)), rows), known
    return _position_sigma(solution, same), known


def without_sensors(problem: SmoothingProblem) -> SmoothingProblem:
    """Images of the bubbles and the encoder alone."""
    return replace(problem, accelerometers=(), marks=(), references=Observations.none())


def _inner_rows(window: Window) -> NDArray[np.int64]:
    """Rows of the bubbles' states, a tenth of each track left out at both ends."""
    at, out = 0, []
    for bubble in window.problem.bubbles:
        edge = int(_EDGE * len(bubble))
        out.append(np.arange(at + edge, at + len(bubble) - edge))
        at += len(bubble)
    return np.concatenate(out)


def _position_sigma(solution: Solution, rows: NDArray[np.int64]) -> Array:
    assert solution.covariances is not None
    at, covariance = solution.frame.bubble.position, solution.covariances.bubbles[rows]
    return np.asarray(np.sqrt(np.einsum("id,nde,ie->ni", at, covariance, at, optimize=True)))


def shake_share(solution: Solution) -> list[float | None]:
    """eta by axis: the least over the directions near the axis that a camera sees."""
    frame, found = solution.frame, solution.covariances
    assert found is not None
    least: list[float | None] = [None, None, None]
    if not frame.shake.size:
        return least
    before, _ = start(frame.shake.components)
    inner = _inner_frames(solution)
    for camera, seen in enumerate(frame.shake.seen):
        for direction in seen:
            row = direction @ frame.shake.offset[camera]
            prior = float(row @ before @ row)
            if prior <= 0:
                continue
            after = float(np.mean(np.einsum("d,fde,e->f", row, found.shake[inner], row)))
            for axis in np.flatnonzero(direction**2 > _SEEN):
                eta, known = 1 - after / prior, least[axis]
                least[axis] = eta if known is None else min(known, eta)
    return least


def shake_rms(solution: Solution) -> Array:
    """(3,) RMS of the cameras' offsets, uncertainty included, of the camera that shakes most."""
    frame, found = solution.frame, solution.covariances
    assert found is not None
    out = np.zeros(3)
    if not frame.shake.size:
        return out
    inner = _inner_frames(solution)
    states = solution.state.shake[frame.nodes.of_frame[inner]]
    for camera, seen in enumerate(frame.shake.seen):
        for direction in seen:
            row = direction @ frame.shake.offset[camera]
            variance = np.einsum("d,fde,e->f", row, found.shake[inner], row)
            rms = float(np.sqrt(np.mean((states @ row) ** 2 + variance)))
            near = direction**2 > _SEEN
            out[near] = np.maximum(out[near], rms)
    return out


def _inner_frames(solution: Solution) -> NDArray[np.int64]:
    count = len(solution.frame.problem.t_s)
    edge = int(_EDGE * count)
    return np.arange(edge, count - edge)


def _lines(
    problem: SmoothingProblem, model: ShakeModel
) -> list[tuple[Sequence[float], Attribution]]:
    """What swapping each line would cost, with the directions it moves along.

    Sensors on the cameras' arms settle the question by themselves.
    """
    if any(a.camera != CARRIAGE for a in problem.accelerometers):
        return []
    signals = [c for c in signals_of(problem) if c.samples]
    out: list[tuple[Sequence[float], Attribution]] = []
    for group in groups_of(signals, Learning(), problem.up):
        found = attributions(group.fast, model, group.pattern, problem.up)
        out += [(group.pattern, line) for line in found]
    return out


def words(problem: SmoothingProblem, model: ShakeModel, found: dict[str, AxisVerdict]) -> str:
    """The verdict for a reader."""
    upright = AXES[int(np.abs(problem.up).argmax())]
    parts = [_sentence(name, axis, name == upright) for name, axis in found.items()]
    if any(axis.verdict != RESOLVED for axis in found.values()):
        parts.append(f"To resolve it: {remedy_of_verdict(problem)}.")
    if model.name == "learned":
        parts.append("The shake's modes were learned from this run.")
    return " ".join(parts)


def remedy_of_verdict(problem: SmoothingProblem) -> str:
    """What would tell more, of what this run does not have."""
    arms = {a.camera for a in problem.accelerometers} - {CARRIAGE}
    has_arms = len(arms) == len(problem.cameras)
    if len(problem.references) and has_arms:
        return _MORE
    if len(problem.references):
        return _ARMS
    return _STRIP if has_arms else f"{_STRIP}, or {_ARMS}"


def _sentence(name: str, axis: AxisVerdict, upright: bool) -> str:
    title = f"{name} (vertical)" if upright else name
    sizes = f"{1e3 * axis.sigma_mm:.3g} um where {1e3 * axis.sigma_shake_known_mm:.3g} um "
    text = {
        RESOLVED: f"{title}: bubble motion and shake are told apart ({sizes}would be possible).",
        PARTIAL: f"{title}: shake widens the positions {axis.q:.2g} times ({sizes}"
        "would be possible).",
        UNRESOLVED: f"{title}: bubble motion and shake cannot be told apart ({sizes}"
        "would be possible with the shake known).",
    }[axis.verdict]
    if SHAKE_BELOW_NOISE in axis.flags:
        text += f" The shake ({1e3 * axis.shake_rms_mm:.3g} um RMS) is below the noise."
    if LABEL_AMBIGUOUS in axis.flags:
        lines = [x for x in axis.lines if _matters(x)]
        which = ", ".join(sorted({f"{x.frequency_hz:.3g} Hz" for x in lines}))
        text += f" The oscillation at {which} could be the bubble's as well as the rig's."
    return text


def _left_out(problem: SmoothingProblem) -> list[str]:
    out = []
    for camera in problem.cameras:
        depth = ", ".join(f"{v:.2f}" for v in camera.camera_from_rig.rotation[2])
        out.append(f"shake of {camera.name} along its own depth ({depth}): it cannot be seen")
    return out


def _as_json(axis: AxisVerdict) -> dict[str, Any]:
    lines = [
        {
            "owner": line.owner,
            "frequency_hz": line.frequency_hz,
            "rms_mm": line.rms_mm,
            "other_owner_costs_nats": line.log_likelihood_ratio,
            "ambiguous": line.ambiguous,
        }
        for line in axis.lines
    ]
    return {
        "verdict": axis.verdict,
        "flags": list(axis.flags),
        "q": axis.q,
        "eta": axis.eta,
        "sigma_mm": axis.sigma_mm,
        "sigma_shake_known_mm": axis.sigma_shake_known_mm,
        "shake_rms_mm": axis.shake_rms_mm,
        "lines": lines,
    }
