"""Cross-validates learned hyper-parameters in parts of the run that they were not learned from.

In each part the mean squared whitened prediction error is computed, which is 1 if the model is
right, and the frequencies of the modes are fitted again. A frequency that differs by more than its
uncertainty drifts along the run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from telerig.estimator.smoothing.learning.evidence import Factor
from telerig.estimator.smoothing.learning.learn import free_names, groups_of
from telerig.estimator.smoothing.learning.likelihood import laplace_covariance, maximise
from telerig.estimator.smoothing.learning.lines_of_sight import signals_of
from telerig.estimator.smoothing.learning.parameters import value_of
from telerig.estimator.smoothing.learning.window import learning_parts, other_windows
from telerig.estimator.smoothing.problem.problem import ShakeModel, SmoothingProblem
from telerig.estimator.smoothing.problem.window import Window, cut_out

_MOST_WINDOWS = 3
_STEPS = 5
_SURE, _LEAST_DRIFT = 4.0, 0.02
_LARGEST_SQUARE = 1.3


@dataclass(frozen=True)
class OtherWindow:
    """Cross-validation in one part of a run.

    from_s, to_s : times of its first and last frame.
    square : mean squared whitened prediction error of a sample; 1 if the model is right.
    frequencies : {hyper-parameter: (frequency in this part (Hz), standard deviation of the
        logarithm of its ratio to the learned one)}.
    """

    from_s: float
    to_s: float
    square: float
    frequencies: dict[str, tuple[float, float]]

    def drifted(self, model: ShakeModel) -> dict[str, float]:
        """Return {hyper-parameter: Hz} of the frequencies that differ significantly from the
        learned ones.
        """
        out = {}
        for name, (value, sigma) in self.frequencies.items():
            shift = abs(float(np.log(value / value_of(model, name))))
            if shift > max(_SURE * sigma, _LEAST_DRIFT):
                out[name] = value
        return out


def cross_validate(problem: SmoothingProblem, model: ShakeModel) -> list[OtherWindow]:
    """Compare a learned model with up to three windows that it was not learned from."""
    used = _used(problem)
    found = [_compared(w, model) for w in other_windows(problem, used, _MOST_WINDOWS)]
    return [one for one in found if one is not None]


def _used(problem: SmoothingProblem) -> Window:
    """Return the run from the first to the last frame that was learned from."""
    parts = learning_parts(problem)
    if len(parts) == 1:
        return parts[0]
    return cut_out(problem, parts[0].first, parts[-1].first + len(parts[-1].problem.t_s))


def _compared(window: Window, model: ShakeModel) -> OtherWindow | None:
    problem, t = window.problem, window.problem.t_s
    signals = tuple(s for s in signals_of(problem) if s.samples)
    if not signals:
        return None
    group = groups_of(signals)[0]
    parts = group.fast
    found = [Factor(part, model) for part in parts]
    count = sum(one.count * int((one.weight > 0).sum()) for one in found)
    square = sum(one.square for one in found) / max(count, 1)
    free = free_names(model, group)
    names = [n for n in free if n.startswith("modes.") and n.endswith("frequency_hz")]
    fit = maximise(parts, model, names, steps=_STEPS)
    here = np.diag(laplace_covariance(parts, fit.model, names)) if names else np.zeros(0)
    frequencies = {
        name: (value_of(fit.model, name), float(np.hypot(np.sqrt(v), model.learned.get(name, 0.0))))
        for name, v in zip(names, here)
    }
    return OtherWindow(float(t[0]), float(t[-1]), float(square), frequencies)


def learning_record(
    problem: SmoothingProblem, model: ShakeModel
) -> tuple[dict[str, Any], list[str]]:
    """Cross-validate a learned model.

    Returns the entry of smoothing.json about the data it was learned from and the prediction errors
    elsewhere, and warnings if these are too large or a frequency drifts.
    """
    t = _used(problem).problem.t_s
    frames = sum(len(part.problem.t_s) for part in learning_parts(problem))
    record: dict[str, Any] = {
        "from_s": float(t[0]), "to_s": float(t[-1]), "frames": frames, "held_out": [],
    }  # fmt: skip
    warnings: list[str] = []
    drifts: dict[str, tuple[float, OtherWindow]] = {}
    for one in cross_validate(problem, model):
        record["held_out"].append(
            {"from_s": one.from_s, "to_s": one.to_s, "square_per_sample": one.square}
        )
        for name, value in one.drifted(model).items():
            learned, before = value_of(model, name), drifts.get(name)
            if before is None or abs(value - learned) > abs(before[0] - learned):
                drifts[name] = value, one
        if one.square > _LARGEST_SQUARE:
            warnings.append(
                f"the shake learned from {t[0]:.4g} to {t[-1]:.4g} s does not describe the run "
                f"from {one.from_s:.4g} to {one.to_s:.4g} s: the squared distance per sample is "
                f"{one.square:.3g} there, and 1 for a right model. Smooth the run in parts"
            )
    for name, (value, one) in drifts.items():
        warnings.append(
            f"a mode of the rig drifts along the run: {value_of(model, name):.4g} Hz from "
            f"{t[0]:.4g} to {t[-1]:.4g} s, from which it was learned, and {value:.4g} Hz from "
            f"{one.from_s:.4g} to {one.to_s:.4g} s. Smooth the run in parts, or with "
            "accelerometers or marks"
        )
    return record, warnings
