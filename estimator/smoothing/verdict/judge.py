"""Makes the verdict part of smoothing.json: numbers and codes, and the sentences made from them.

Where shake and motion of the bubbles cannot be separated, the verdict names the measurement that
would separate them.
"""

from __future__ import annotations

from typing import Any

from telerig.estimator.smoothing.graph.solve import Solution, drawn
from telerig.estimator.smoothing.problem.problem import ShakeModel, SmoothingProblem
from telerig.estimator.smoothing.verdict.contradiction import contradictions
from telerig.estimator.smoothing.verdict.evidence import Evidence
from telerig.estimator.smoothing.verdict.identifiability import verdicts
from telerig.estimator.smoothing.verdict.modes import shake_modes
from telerig.estimator.smoothing.verdict.purposes import uses
from telerig.io.results.smoothing import (
    AxisVerdict,
    Flag,
    Remedy,
    Verdict,
    vertical_axis,
    worst_of,
)
from telerig.io.results.verdict_words import (
    contradiction_words,
    mode_remedy,
    number_words,
    remedy_words,
    to_resolve,
    unseen_words,
    words_of_axis,
)


def judge(
    problem: SmoothingProblem,
    model: ShakeModel,
    solution: Solution,
    evidence: Evidence | None = None,
) -> dict[str, Any]:
    """Return the verdict part of smoothing.json: ``verdict``, ``flags``, ``axes``, ``words``, ...

    Without covariances it is empty; without bubbles it has the modes alone.

    problem, model, solution : of the run; of its middle piece if the run was solved in pieces.
    evidence : sums over all pieces; None for a run that was solved as a whole.
    """
    if solution.covariances is None:
        return {}
    draws = drawn(solution)
    evidence = evidence or Evidence.of(solution, draws)
    disagree = contradictions(solution, evidence)
    found = verdicts(solution, evidence.shake, disagree.inflation) if problem.bubbles else {}
    modes = [mode.content() | {"remedy": mode_remedy(mode)} for mode in shake_modes(solution)]
    out: dict[str, Any] = {"modes": modes}
    if disagree.found:
        out |= {
            "verdict": str(Verdict.CONTRADICTED),
            "contradictions": [one.content() for one in disagree.found],
            "inflation": list(disagree.inflation),
            "words": contradiction_words(disagree.found),
        }
    if not found:
        return out
    usable = [use.content() for use in uses(solution, draws, disagree.inflation)]
    vertical = vertical_axis(problem.up)
    axes = {
        name: axis.content() | {"words": words_of_axis(name, axis, vertical=name == vertical)}
        for name, axis in found.items()
    }
    worst = Verdict.CONTRADICTED if disagree.found else worst_of(found)
    remedies = remedies_of(problem) if worst in (Verdict.PARTIAL, Verdict.UNRESOLVED) else ()
    words = [number_words(found, vertical, worst), contradiction_words(disagree.found)]
    words += [axis["words"] for axis in axes.values()]
    words += [to_resolve(remedy_words(remedies))]
    words += ["The shake's modes were learned from this run."] if model.name == "learned" else []
    depths = {camera.name: camera.camera_from_rig.rotation[2] for camera in problem.cameras}
    return {
        "verdict": str(worst),
        **out,
        "usable_for": usable,
        "flags": [str(flag) for flag in _flags(found)],
        "axes": axes,
        "words": " ".join(word for word in words if word),
        "remedy": remedy_words(remedies),
        "remedies": [str(remedy) for remedy in remedies],
        "vertical": vertical,
        "left_out": [unseen_words(name, axis) for name, axis in depths.items()],
    }


def _flags(found: dict[str, AxisVerdict]) -> list[Flag]:
    """Return the flags of the run: those of any axis, but below noise only if all axes are."""
    flags = [flag for flag in Flag if any(flag in axis.flags for axis in found.values())]
    if not all(Flag.SHAKE_BELOW_NOISE in axis.flags for axis in found.values()):
        flags = [flag for flag in flags if flag != Flag.SHAKE_BELOW_NOISE]
    return flags


def remedies_of(problem: SmoothingProblem) -> tuple[Remedy, ...]:
    """Return the missing measurements that would separate shake and motion better."""
    arms, every = problem.arms_with_sensor, set(range(len(problem.cameras)))
    missing = []
    if set(problem.references.camera.tolist()) != every:
        missing.append(Remedy.STRIP)
    if arms != every:
        missing.append(Remedy.BARE_ARMS if arms else Remedy.ARMS)
    return tuple(missing) or (Remedy.LONGER,)
