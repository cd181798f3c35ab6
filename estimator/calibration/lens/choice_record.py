"""The choice of the lens models as `calibration.json` holds it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.rig.lens_models import joint_name, name_of

if TYPE_CHECKING:
    from telerig.estimator.calibration.lens.choice import Choice, Step
    from telerig.estimator.calibration.solver.problem import Problem


def model_rows(
    problem: Problem, models: tuple[str, ...], words: str, choice: Choice | None
) -> dict[str, Any]:
    """The chosen model, why, and a row for each step of the ladder, taken or not."""
    cameras = [c.name for c in problem.cameras]
    steps = choice.steps if choice is not None else ()
    return {
        "name": joint_name(models, cameras),
        "by_camera": dict(zip(cameras, models)),
        "words": words,
        "ladder": [_step(step, steps[max(k - 1, 0)], cameras) for k, step in enumerate(steps)],
    }


def _step(step: Step, before: Step, cameras: list[str]) -> dict[str, Any]:
    """What was not fitted, or did not have to predict, is None."""
    row: dict[str, Any] = {
        "model": joint_name([name_of(lens) for lens in step.lenses], cameras),
        "camera": cameras[step.camera] if step.camera >= 0 else "",
        "added": list(step.added),
        "taken": step.taken,
        "chi2_gain": _finite(step.gain),
        "bic_gain": _finite(step.worth),
        "p_value": _finite(step.p_value),
        "words": step.words,
    }
    fit, earlier = step.fit, before.fit
    if fit is None:
        return row
    return row | {
        "parameters": fit.parameters, "chi2_dof": 2 * fit.cost / fit.rows,
        "bic": 2 * fit.cost + fit.parameters * float(np.log(fit.rows)), "rms_px": fit.rms_px,
        "held_out": _finite(fit.held_out),
        "held_out_before": None if earlier is None else _finite(earlier.held_out),
    }  # fmt: skip


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
