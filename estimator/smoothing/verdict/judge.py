"""The verdict part of smoothing.json: numbers and codes, and the sentences made from them.

A smoother that always answers is wrong: where shake and bubble motion cannot be separated, the
remedy is a mark fixed to the tank or an accelerometer on each camera arm.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.problem.problem import ShakeModel, SmoothingProblem
from telerig.estimator.smoothing.verdict.identifiability import AxisVerdict, verdicts
from telerig.estimator.smoothing.verdict.modes import Place, ShakeMode, shake_modes
from telerig.io.results.smoothing import AXES, Flag, Verdict
from telerig.io.results.verdict_words import VERDICT_WORDS
from telerig.rig.camera import Camera

_STRIP = "fix a strip of dots to the tank inside both views"
_ARMS = "mount one accelerometer on each camera arm"
_LONGER = "take a longer record, or one with more bubbles in view"
_REMEDIES = {
    Place.SERVO: "Tune the stage's controller: more damping, a softer ramp, less gain at this "
    "frequency.",
    Place.ONE_VIEW: "Only one camera sees this axis, so it is unknown whether its arm or the whole "
    "rig swings. An accelerometer on the carriage would show it.",
    Place.COMMON: "All cameras move alike: stiffen the mount between carriage and camera bridge, "
    "or lighten what hangs on it.",
    Place.ARM: "The arm of camera {camera} swings by itself: shorten or brace it, or counterweight "
    "its camera.",
}
_WEAK_DAMPING, _SLOW_HZ = 0.02, 5.0


def judge(problem: SmoothingProblem, model: ShakeModel, solution: Solution) -> dict[str, Any]:
    """The verdict part of smoothing.json: ``verdict``, ``flags``, ``axes``, ``words``, ``modes``.

    solution : of the problem under the model; without covariances the answer is empty. Without
        bubbles there is nothing to judge, and only the modes are listed.
    """
    if solution.covariances is None:
        return {}
    found = verdicts(solution) if problem.bubbles else {}
    modes = [_mode_json(mode) for mode in shake_modes(solution)]
    if not found:
        return {"modes": modes}
    upright = AXES[int(np.abs(problem.up).argmax())]
    sentences = {name: _of_axis(name, axis, name == upright) for name, axis in found.items()}
    worst = max((a.verdict for a in found.values()), key=list(Verdict).index)
    return {
        "verdict": str(worst),
        "flags": [str(flag) for flag in _flags(found)],
        "axes": {
            name: _axis_json(axis) | {"words": sentences[name]} for name, axis in found.items()
        },
        "words": " ".join([*sentences.values(), *_advice(problem, model, found)]),
        "remedy": "" if worst == Verdict.RESOLVED else remedy_of_verdict(problem),
        "left_out": [_unseen(camera) for camera in problem.cameras],
        "modes": modes,
    }


def _flags(found: dict[str, AxisVerdict]) -> list[Flag]:
    """Ambiguous if any axis is; below noise only if all are."""
    flags = []
    if any(Flag.LABEL_AMBIGUOUS in axis.flags for axis in found.values()):
        flags.append(Flag.LABEL_AMBIGUOUS)
    if all(Flag.SHAKE_BELOW_NOISE in axis.flags for axis in found.values()):
        flags.append(Flag.SHAKE_BELOW_NOISE)
    return flags


def _axis_json(axis: AxisVerdict) -> dict[str, Any]:
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
    numbers = ("q", "eta", "sigma_mm", "sigma_shake_known_mm", "shake_rms_mm")
    return {
        "verdict": str(axis.verdict),
        "flags": [str(flag) for flag in axis.flags],
        **{name: getattr(axis, name) for name in numbers},
        "lines": lines,
    }


def _mode_json(mode: ShakeMode) -> dict[str, Any]:
    return {
        "where": mode.where,
        "frequency_hz": mode.frequency_hz,
        "damping": mode.damping,
        "rms_mm": mode.rms_mm,
        "source": mode.source,
        "remedy": remedy_of_mode(mode),
    }


def _advice(
    problem: SmoothingProblem, model: ShakeModel, found: dict[str, AxisVerdict]
) -> list[str]:
    parts = []
    if any(axis.verdict != Verdict.RESOLVED for axis in found.values()):
        parts.append(f"To resolve it, {remedy_of_verdict(problem)}.")
    if model.name == "learned":
        parts.append("The shake's modes were learned from this run.")
    return parts


def _of_axis(name: str, axis: AxisVerdict, upright: bool) -> str:
    title = f"{name} (vertical)" if upright else name
    meaning = VERDICT_WORDS[axis.verdict].of_axis.format(q=axis.q)
    text = (
        f"{title}: {meaning} (standard deviation of a position "
        f"{1e3 * axis.sigma_mm:.3g} µm; {1e3 * axis.sigma_shake_known_mm:.3g} µm if the shake were "
        "known)."
    )
    if Flag.SHAKE_BELOW_NOISE in axis.flags:
        text += f" The shake ({1e3 * axis.shake_rms_mm:.3g} µm RMS) is below the noise."
    if Flag.LABEL_AMBIGUOUS in axis.flags:
        which = ", ".join(sorted({f"{x.frequency_hz:.3g} Hz" for x in axis.ambiguous_lines}))
        text += f" The oscillation at {which} could be the bubble's as well as the rig's."
    return text


def remedy_of_verdict(problem: SmoothingProblem) -> str:
    """The measurement that would separate shake and motion better, of those that the run lacks."""
    has_arms = len(problem.arms_with_sensor) == len(problem.cameras)
    if len(problem.references):
        return _LONGER if has_arms else _ARMS
    return _STRIP if has_arms else f"{_STRIP}, or {_ARMS}"


def remedy_of_mode(mode: ShakeMode) -> str:
    """What would make this mode smaller."""
    text = _REMEDIES[mode.place].format(camera=mode.camera)
    if mode.place == Place.SERVO:
        return text
    if mode.damping < _WEAK_DAMPING:
        text += " It rings: a layer of damping helps as much as stiffness."
    if mode.frequency_hz < _SLOW_HZ:
        text += " So slow a swing is also driven by the travel: ramp the stage up more softly."
    return text


def _unseen(camera: Camera) -> str:
    depth = ", ".join(f"{v:.2f}" for v in camera.camera_from_rig.rotation[2])
    return f"Shake of camera {camera.name} along its own depth ({depth}) cannot be seen."
