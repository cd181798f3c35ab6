"""The search for lines: each tried as what it could be, kept while the criterion falls.

The criterion is Schwarz's (Ann. Stat. 6:461, 1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoothing.learning.groups import (
    BUBBLE,
    Group,
    Learning,
    Where,
    free_names,
    is_held,
)
from telerig.estimator.smoothing.learning.likelihood import Fit, evidence, maximise
from telerig.estimator.smoothing.learning.mode_labels import is_zigzag
from telerig.estimator.smoothing.learning.parameters import FORCE, forced
from telerig.estimator.smoothing.learning.spectrum import Line, unexplained
from telerig.estimator.smoothing.problem.problem import CARRIAGE, RigMode, ShakeModel, Zigzag

START_DAMPING = 0.04
START_FORCE_HZ = 60.0
LOW_HZ = 15.0
_HARMONIC = 0.12
_TIE_NATS = 2.0


@dataclass(frozen=True)
class Step:
    """Where the search stands: the model, its fit, and lines of each kind found in this group."""

    fit: Fit
    found: tuple[Where, ...] = ()


def one_more(group: Group, step: Step, options: Learning, first: bool) -> Step | None:
    """The model with the line added that helps most; None when none is worth its parameters."""
    tried = []
    for where in group.wheres:
        if step.found.count(where) < options.most_modes:
            tried += _trials(group, step.fit.model, where, options)
    still = [c for c in group.fast if not c.shaken]
    shaken, rest = [c for c in group.fast if c.shaken], evidence(still, step.fit.model)
    trials = [
        (evidence(group.fast, m) if where == BUBBLE else evidence(shaken, m) + rest, where, m)
        for where, m in tried
    ]
    trials.sort(key=lambda trial: -trial[0])
    best: tuple[float, Where, Fit] | None = None
    for _, where, model in _distinct(trials):
        fit = maximise(group.fast, model, _last_line(model, where), steps=8)
        lead = 0.0 if best is None else _preference(model, where, best[1], group.up)
        if best is None or fit.log_evidence > best[0] + lead:
            best = (fit.log_evidence, where, fit)
    if best is None or best[0] < step.fit.log_evidence + _penalty(group, best[2].model):
        return None
    model, found = _alike(group, best[2].model, best[1]), (*step.found, best[1])
    names = free_names(model, group, options, first)
    return Step(maximise(group.fast, model, names, steps=8), found)


def coloured(group: Group, step: Step, options: Learning, first: bool) -> Step:
    """The modes' white forces given a corner, where it brings more than one parameter must.

    Both ways get as many steps more.
    """
    model = step.fit.model
    white = bool(model.modes) and all(m.force_hz is None for m in model.modes)
    if not first or not white or is_held(FORCE, model, options) or step.found[-1:] == (BUBBLE,):
        return step
    with_corner = forced(model, START_FORCE_HZ)
    fits = [
        maximise(group.fast, m, free_names(m, group, options, first), steps=8)
        for m in (model, with_corner)
    ]
    gain = fits[1].log_evidence - fits[0].log_evidence
    return Step(fits[gain > _penalty(group, model) / 3], step.found)


def whitened(group: Group, fit: Fit, options: Learning) -> Fit:
    """The forces' corner taken away again where the criterion does not mind."""
    names = free_names(fit.model, group, options, True)
    if FORCE not in names:
        return fit
    white = forced(fit.model, None)
    quick = maximise(group.fast, white, [n for n in names if n != FORCE], steps=8)
    worth = _penalty(group, fit.model) / 3
    return quick if quick.log_evidence > fit.log_evidence - worth else fit


def _alike(group: Group, model: ShakeModel, where: Where) -> ShakeModel:
    """After an arm's first mode, the other arms given one like it, to be found smaller if it is.

    Arms are built alike: one that shakes unseen would be taken for a shake of the whole rig.
    """
    cameras = group.channels[0].cameras
    have = {m.camera for m in model.modes[:-1] if m.camera != CARRIAGE}
    if where not in cameras or have:
        return model
    last = model.modes[-1]
    copies = tuple(replace(last, camera=c) for c in cameras if c != last.camera)
    return replace(model, modes=(*model.modes, *copies))


def _penalty(group: Group, model: ShakeModel) -> float:
    """Nats that a line's three numbers must bring: half of Schwarz's 3 log n.

    n : two samples for each cycle of the fastest line. Frames beyond tell of noise, not of lines.
    """
    t = group.channels[0].t_s
    lines = [mode.frequency_hz for mode in model.modes]
    lines += [line.frequency_hz for line in model.bubble.zigzags]
    fastest = max(lines, default=LOW_HZ)
    return 1.5 * float(np.log(max(2 * fastest * (t[-1] - t[0]), 8.0)))


def _distinct(
    trials: Sequence[tuple[float, Where, ShakeModel]],
) -> list[tuple[float, Where, ShakeModel]]:
    """The best trial of each kind, of the three best kinds."""
    out: dict[Where, tuple[float, Where, ShakeModel]] = {}
    for trial in trials:
        out.setdefault(trial[1], trial)
    return list(out.values())[:3]


def _preference(model: ShakeModel, where: Where, rival: Where, up: NDArray[np.float64]) -> float:
    """Nats by which a label must win over another that explains the data as well.

    A line that fits equally goes to the rig: a wrong excuse for the rig hides its shake. Only the
    second harmonic of the zigzag is taken for the bubble's own.
    """
    if BUBBLE not in (where, rival) or where == rival:
        return 0.0
    harmonic = _is_harmonic(model, up)
    wins = (where == BUBBLE) == harmonic
    return -_TIE_NATS if wins else _TIE_NATS


def _is_harmonic(model: ShakeModel, up: NDArray[np.float64]) -> bool:
    lateral = [z for z in model.bubble.zigzags if is_zigzag(z, up)]
    lines = [m.frequency_hz for m in model.modes[-1:]]
    lines += [z.frequency_hz for z in model.bubble.zigzags[-1:]]
    return any(abs(f / (2 * z.frequency_hz) - 1) < _HARMONIC for z in lateral for f in lines)


def _trials(
    group: Group, model: ShakeModel, where: Where, options: Learning
) -> list[tuple[Where, ShakeModel]]:
    out = []
    lines: list[Line] = []
    for channel in group.channels:
        lines += unexplained(channel, model, where)
    for line in sorted(lines, key=lambda item: -item.excess)[:3]:
        for share in (0.6, 1.2):
            out.append((where, _with_line(model, group, where, line, share, options)))
    return out


def _with_line(
    model: ShakeModel, group: Group, where: Where, line: Line, share: float, options: Learning
) -> ShakeModel:
    x, y, z = (float(np.clip(share * line.rms_mm, 0.003, 4.0)) * p for p in group.pattern)
    if where == BUBBLE:
        added = Zigzag(line.frequency_hz, START_DAMPING, (x, y, z))
        zigzags = (*model.bubble.zigzags, added)
        return replace(model, bubble=replace(model.bubble, zigzags=zigzags))
    force_hz = model.force_hz or options.force_hz
    mode = RigMode(line.frequency_hz, START_DAMPING, (x, y, z), int(where), force_hz)
    return replace(model, modes=(*model.modes, mode))


def _last_line(model: ShakeModel, where: Where) -> list[str]:
    stem = f"modes.{len(model.modes) - 1}"
    if where == BUBBLE:
        stem = f"bubble.zigzags.{len(model.bubble.zigzags) - 1}"
    return [f"{stem}.{field_}" for field_ in ("frequency_hz", "damping", "rms_mm")]


def pruned(group: Group, fit: Fit, options: Learning, first: bool, given: int = 0) -> Fit:
    """Lines taken away again whose absence the criterion does not mind.

    given : so many modes were there before the search, and stay, so that their names do.
    """
    at = 0
    while True:
        names = [
            n
            for n in free_names(fit.model, group, options, first)
            if n.endswith(".frequency_hz")
            and not (n.startswith("modes") and int(n.split(".")[1]) < given)
        ]
        if at >= len(names):
            return fit
        less = _without(fit.model, names[at])
        free = free_names(less, group, options, first)
        quick = maximise(group.fast, less, free, steps=6)
        own = names[at].startswith("modes") and _owner(fit.model, names[at]) != CARRIAGE
        worth = 0.0 if own else _penalty(group, fit.model)
        if quick.log_evidence > fit.log_evidence - worth:
            fit = quick
        else:
            at += 1


def _owner(model: ShakeModel, name: str) -> int:
    return model.modes[int(name.split(".")[1])].camera


def _without(model: ShakeModel, name: str) -> ShakeModel:
    parts = name.split(".")
    index = int(parts[-2])
    if parts[0] == "bubble":
        zigzags = tuple(z for i, z in enumerate(model.bubble.zigzags) if i != index)
        return replace(model, bubble=replace(model.bubble, zigzags=zigzags))
    modes = tuple(m for i, m in enumerate(model.modes) if i != index)
    return replace(model, modes=modes)
