"""Learns the hyper-parameters of shake and bubbles from a run by maximum marginal likelihood.

The structure is fixed: a mode that all cameras share (two where the evidence clearly asks for it),
a mode of each camera's arm, one low-pass of the force that drives them, and the motion of the
bubbles. Its hyper-parameters are optimised from a few starts, of which the most probable end
counts, and Laplace's approximation gives their covariance. Which of them are the rig's is told by
bubbles: what several have in common is the rig's, how they differ is their own. Fewer than three do
not tell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import cached_property

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.learning.likelihood import (
    Fit,
    evidence,
    laplace_covariance,
    maximise,
)
from telerig.estimator.smoothing.learning.lines_of_sight import Signal, pooled
from telerig.estimator.smoothing.learning.parameters import (
    FORCE,
    names_of,
    prior_of,
    with_values,
)
from telerig.estimator.smoothing.learning.window import learning_signals
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    FEWEST_BUBBLES,
    RigMode,
    ShakeModel,
    SmoothingProblem,
)
from telerig.factors.bubble_motion import Triple
from telerig.io.machine.parallel import keep_freed_memory

_STARTS_HZ = ((9.0, 20.0), (20.0, 9.0), (40.0, 40.0))
"""Frequencies of the common mode and of the arms' modes at the starts."""
_START_DAMPING, _START_RMS_MM, _START_FORCE_HZ = 0.15, 0.1, 60.0
"""Of the modes at the starts: so much damping that the optimiser finds lines that are far away."""
_FEW_STEPS = 12
_FALSE_LINE, _PARAMETERS = 1e-3, 3
"""Of runs, the share in which a further mode of so many parameters is added for nothing."""
_ACROSS, _ACROSS_LOG_SIGMA = 0.5, 1.0
_VAGUE_LOG_SIGMA = 0.3
_LOG_RATIOS = np.linspace(-3.0, 2.0, 11)


def learn(
    problem: SmoothingProblem,
    start: ShakeModel,
    progress: Callable[[str, float], None] | None = None,
) -> ShakeModel:
    """Return the model with the most probable modes, dampings and noise intensities for a run.

    problem : of a long run only the frames of `learning_signals` are used.
    start : the default model, which supplies what is not learned; its guessed modes do not count.
        It is returned unchanged with accelerometers, since its broad band needs no modes, and where
        fewer than `FEWEST_BUBBLES` bubbles are seen, which do not tell their motion from the rig's.
    progress : called with a text and the completed share, from 0 to 1.

    In the returned model ``name`` is "learned", and ``learned`` contains the standard deviation of
    the logarithm of each learned parameter.
    """
    if problem.accelerometers:
        return start
    signals = learning_signals(problem)
    if max((int(s.moving.sum()) for s in signals), default=0) < FEWEST_BUBBLES:
        return start
    keep_freed_memory()
    tell = progress or (lambda _what, _share: None)
    along, *across = groups_of(signals)
    tell("the shared axis", 0.0)
    model = _best_of_starts(replace(start, modes=()), along).model
    model, learned = _with_deviations(model, along, free_names(model, along), {})
    for group in across:
        tell("across", 0.5)
        model, names, medians = _repeated(model, group)
        model = maximise(group.fast, model, names).model
        model, found = _with_deviations(model, group, names, medians)
        learned |= found
    return replace(model, name="learned", learned=learned)


def _with_modes(model: ShakeModel, group: Group, common_hz: float, arm_hz: float) -> ShakeModel:
    """Return the model with a mode of each possible owner along the directions of a group."""
    x, y, z = (_START_RMS_MM * p for p in group.pattern)
    modes = [
        RigMode(
            common_hz if where == CARRIAGE else arm_hz, _START_DAMPING, (x, y, z), where,
            _START_FORCE_HZ,
        )
        for where in group.owners
    ]  # fmt: skip
    return replace(model, modes=(*model.modes, *modes))


def _best_of_starts(model: ShakeModel, group: Group) -> Fit:
    """Return the most probable fit of the modes of all possible owners.

    model : without modes.
    """
    starts = [_with_modes(model, group, *each) for each in _STARTS_HZ]
    names = free_names(starts[0], group)
    fits = [maximise(group.fast, one, names, steps=_FEW_STEPS) for one in starts]
    fit = maximise(group.fast, max(fits, key=lambda fit: fit.log_posterior).model, names)
    others = [maximise(group.fast, one, names) for one in overlooked(fit.model, group)]
    return _with_shared_line(group, max((fit, *others), key=lambda fit: fit.log_posterior))


def _with_deviations(
    model: ShakeModel, group: Group, names: Sequence[str], medians: dict[str, float]
) -> tuple[ShakeModel, dict[str, float]]:
    """Return the model with likely RMS where the data hardly determine them, and {hyper-parameter:
    standard deviation of its logarithm}.

    names : of what was learned.
    medians : {name of a mode's RMS: its prior median}, where it is not that of `prior_of`.
    """
    sigma = np.sqrt(np.diag(laplace_covariance(group.fast, model, names)))
    found = dict(zip(names, sigma.tolist()))
    medians = {n: prior_of(n).median for n in names if fnmatch(n, "modes.*.rms_mm")} | medians
    vague = [n for n in medians if found[n] > _VAGUE_LOG_SIGMA]
    likely = [posterior_rms(group.fast, model, n, medians[n]) for n in vague]
    return with_values(model, vague, likely), found


def _with_shared_line(group: Group, fit: Fit) -> Fit:
    """Return the fit with one more common mode, at the frequency of an arm's, where the evidence is
    clearly larger.

    What shakes both arms at one frequency, but not alike, is a common mode and one of an arm. With
    a second frequency there are more lines than modes, and the bubbles would take the rest.
    """
    from scipy.stats import chi2

    trials = []
    for mode in fit.model.modes:
        if mode.camera != CARRIAGE:
            shared = replace(mode, camera=CARRIAGE, damping=_START_DAMPING)
            model = replace(fit.model, modes=(*fit.model.modes, shared))
            names = free_names(model, group)
            trials.append(maximise(group.fast, model, names))
    best = max(trials, key=lambda trial: trial.log_posterior, default=fit)
    clear = best.log_posterior - fit.log_posterior > chi2.isf(_FALSE_LINE, _PARAMETERS) / 2
    return best if clear else fit


def overlooked(model: ShakeModel, group: Group) -> list[ShakeModel]:
    """Return starts that no start of another frequency leads to, from the end of one.

    What moves one camera against the other may be one arm or both: here both are like the stronger
    one. A common mode may be hidden by an oscillation of the bubbles at its frequency.
    """
    out = list[ShakeModel]()
    arms = [i for i, mode in enumerate(model.modes) if mode.camera != CARRIAGE]
    if len(arms) > 1:
        strongest = max((model.modes[i] for i in arms), key=lambda mode: max(mode.rms_mm))
        rms = np.sqrt(np.mean([np.square(model.modes[i].rms_mm) for i in arms], axis=0))
        alike = replace(strongest, rms_mm=(float(rms[0]), float(rms[1]), float(rms[2])))
        modes = [
            replace(alike, camera=m.camera) if i in arms else m for i, m in enumerate(model.modes)
        ]
        out.append(replace(model, modes=tuple(modes)))
    for i, own in enumerate(model.bubble.zigzags):
        if _concerns(group, model, f"bubble.zigzags.{i}.rms_mm"):
            modes = [
                replace(m, frequency_hz=own.frequency_hz) if m.camera == CARRIAGE else m
                for m in model.modes
            ]
            out.append(replace(model, modes=tuple(modes)))
    return out


def _repeated(model: ShakeModel, group: Group) -> tuple[ShakeModel, list[str], dict[str, float]]:
    """Return the model with each mode of the first group repeated along the second group's
    directions, the names of what is learned there, and {name of each mode's RMS: its prior median
    in mm}.

    The first group has the strongest shake, which shows frequencies, dampings and the corner of the
    force. One camera and one bubble cannot show whether the rig vibrates across, too.
    """
    at, rig = len(model.modes), [m for m in model.modes if max(m.rms_mm) > 0]
    added = []
    for mode in rig:
        x, y, z = (_ACROSS * max(mode.rms_mm) * p for p in group.pattern)
        added.append(replace(mode, rms_mm=(x, y, z)))
    medians = {f"modes.{at + i}.rms_mm": max(mode.rms_mm) for i, mode in enumerate(added)}
    model = replace(model, modes=(*model.modes, *added))
    swings = [n for n in free_names(model, group) if n.startswith("bubble.zigzags")]
    return model, [*medians, *swings], medians


def posterior_rms(signals: Sequence[Signal], model: ShakeModel, name: str, median: float) -> float:
    """Return the posterior root mean square of an RMS parameter that the data hardly determine.

    The most probable value would be almost 0 where wide swings of the bubbles hide the line.

    name : of the parameter.
    median : of its log-normal prior, mm.
    """
    values = median * np.exp(_LOG_RATIOS)
    found = np.array([evidence(signals, with_values(model, [name], [v])) for v in values])
    found -= 0.5 * (_LOG_RATIOS / _ACROSS_LOG_SIGMA) ** 2
    weight = np.exp(found - found.max())
    return float(np.sqrt(weight @ values**2 / weight.sum()))


@dataclass(frozen=True)
class Group:
    """Line-of-sight signals from which hyper-parameters are learned together.

    pattern : (3,) relative RMS of a line along each axis of the rig.
    owners : what of the rig moves along these directions: all cameras together, one camera's arm.
    """

    signals: tuple[Signal, ...]
    pattern: Triple
    owners: tuple[int, ...]

    @cached_property
    def fast(self) -> tuple[Signal, ...]:
        """Return the signals as means and differences of their bubbles, which are quicker."""
        return tuple(part for signal in self.signals for part in pooled(signal))


def groups_of(signals: Sequence[Signal]) -> list[Group]:
    """Return two groups of signals: those of the shared coordinate, and the others."""
    if not signals:
        return []
    shared = signals[0]
    own = shared.cameras if len(shared.cameras) > 1 else ()
    square = shared.direction**2
    groups = [Group((shared,), _pattern(square), (CARRIAGE, *own))]
    if len(signals) > 1:
        directions = np.array([c.direction for c in signals[1:]])
        across = np.diagonal(np.linalg.pinv(directions) @ directions)
        groups.append(Group(tuple(signals[1:]), _pattern(across), (CARRIAGE,)))
    return groups


def _pattern(square: Array) -> Triple:
    x, y, z = (float(np.sqrt(s)) if s > 1e-3 else 0.0 for s in square)
    return x, y, z


def free_names(model: ShakeModel, group: Group) -> list[str]:
    """Return the names of the hyper-parameters that a group determines."""
    names = []
    for name in names_of(model):
        if name == FORCE:
            low = (i for i, mode in enumerate(model.modes) if mode.force_hz is not None)
            if any(_concerns(group, model, f"modes.{i}.rms_mm") for i in low):
                names.append(name)
        elif not name.startswith(("modes", "bubble.zigzags")) or _concerns(group, model, name):
            names.append(name)
    return names


def _concerns(group: Group, model: ShakeModel, name: str) -> bool:
    """Return whether a line's largest RMS lies along the group's directions."""
    parts = name.split(".")
    lines = model.bubble.zigzags if parts[0] == "bubble" else getattr(model, parts[0])
    rms = np.asarray(lines[int(parts[-2])].rms_mm)
    inside = np.asarray(group.pattern) > 0.7
    return bool(rms[inside].max(initial=0.0) > rms[~inside].max(initial=0.0))
