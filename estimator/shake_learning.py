"""Hyper-parameters of shake and bubbles from the run itself, by maximum marginal likelihood.

Lines of the spectrum are tried one by one as what they could be (a mode that all cameras share, a
mode of one camera's arm, an oscillation of the bubbles), kept while the Bayesian information
criterion falls (Schwarz, Ann. Stat. 6:461, 1978), and climbed together to the most probable
values; the curvature there (Laplace) says how well they are known. A run of the stage that watches
a target standing still is the best source: there every line is the rig's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.shake_channels import Channel, channels_of, pooled
from telerig.estimator.shake_labels import LineLabel, doubted, is_zigzag, labels, shared
from telerig.estimator.shake_likelihood import Fit, evidence, laplace_sigma, maximise
from telerig.estimator.shake_parameters import FORCE, driven, names_of, value_of, with_values
from telerig.estimator.shake_spectrum import Line, coarsening, coarser, faded, unexplained
from telerig.estimator.smoother.model import (
    CARRIAGE,
    RigMode,
    ShakeModel,
    SmoothingProblem,
    Zigzag,
)

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
Where = int | str

BUBBLE = "bubble"
START_DAMPING = 0.04
START_FORCE_HZ = 60.0
_HARMONIC = 0.12
_TIE_NATS = 2.0
_STRONG = 20.0
_LOW_HZ = 15.0
_ACROSS = 0.5


@dataclass(frozen=True)
class Learning:
    """What may be learned.

    most_modes : lines of one kind (common, each arm, bubble) at most, in the vertical and across.
    hold : patterns of names (see `telerig.estimator.shake_parameters`) that keep the start's
        values, "modes.*" for instance for a rig that is known.
    target : the tracks are those of a target standing still in the lab, not of bubbles.
    force_hz : corner of the modes' force, None for a white one, which images alone call for.
    """

    most_modes: int = 3
    hold: tuple[str, ...] = ()
    target: bool = False
    force_hz: float | None = None


@dataclass(frozen=True)
class Group:
    """Channels learned together.

    pattern : (3,) share of a line's RMS along the rig's axes.  wheres : what a line could be.
    fast : the channels as their likelihood is worked out, see `pooled`.
    """

    channels: tuple[Channel, ...]
    pattern: Triple
    wheres: tuple[Where, ...]
    up: Array

    @cached_property
    def fast(self) -> tuple[Channel, ...]:
        return tuple(part for channel in self.channels for part in pooled(channel))


@dataclass(frozen=True)
class _Step:
    """Where the search stands: the model, its fit, and lines of each kind found in this group."""

    fit: Fit
    found: tuple[Where, ...] = field(default=())


def learn(
    problem: SmoothingProblem, start: ShakeModel, options: Learning = Learning()
) -> ShakeModel:
    """A model whose modes, dampings and intensities are the most probable for the run.

    start : gives what is not learned. Its modes are kept and improved, unless they are the default
    guess (its name is "default"). Returns a model named "learned", with the standard deviations of
    its log-parameters in ``learned``. Sensors are not learned from: with them a default start comes
    back as it is, its broad band needs no modes.
    """
    if start.name == "default" and problem.accelerometers:
        return start
    model = replace(start, modes=()) if start.name == "default" else start
    channels = channels_of(problem, fixed=options.target)
    channels = tuple(c for c in channels if c.samples)
    if options.target:
        model = replace(model, bubble=replace(model.bubble, zigzags=()))
    groups = groups_of(channels, options, problem.up)
    learned: dict[str, float] = {}
    for index, group in enumerate(groups):
        if index and not options.target:
            model, options = _seeded(model, group, options)
        model, sigma = _learn_group(group, model, options, first=index == 0)
        learned |= sigma
    return replace(model, name="learned", learned=learned)


def groups_of(channels: Sequence[Channel], options: Learning, up: Array) -> list[Group]:
    """The shared coordinate, and what lies across it; up : (3,)."""
    if not channels:
        return []
    bubble: tuple[Where, ...] = () if options.target else (BUBBLE,)
    shared = channels[0]
    own: tuple[Where, ...] = shared.cameras if len(shared.cameras) > 1 else ()
    square = shared.direction**2
    groups = [Group((shared,), _pattern(square), (CARRIAGE, *own, *bubble), up)]
    if len(channels) > 1:
        across = np.clip(sum(c.direction**2 for c in channels[1:]), 0, 1)
        groups.append(Group(tuple(channels[1:]), _pattern(across), (CARRIAGE, *bubble), up))
    return groups


def _pattern(square: Array) -> Triple:
    x, y, z = (float(np.sqrt(s)) if s > 1e-3 else 0.0 for s in square)
    return x, y, z


def _learn_group(
    group: Group, model: ShakeModel, options: Learning, *, first: bool
) -> tuple[ShakeModel, dict[str, float]]:
    t_s = group.channels[0].t_s
    factor = coarsening(t_s, _highest(group, model))
    model = _faded(model, factor, t_s)
    coarse = replace(group, channels=tuple(coarser(c, factor) for c in group.channels))
    step = _Step(maximise(coarse.fast, model, _free(model, coarse, options, first), steps=15))
    while True:
        better = _one_more(coarse, step, options, first)
        if better is None:
            break
        step = _coloured(coarse, better, options, first)
    fit = _pruned(coarse, step.fit, options, first)
    names = _free(fit.model, coarse, options, first)
    fit = maximise(coarse.fast, fit.model, names)
    sigma = np.sqrt(np.diag(laplace_sigma(coarse.fast, fit.model, names)))
    model = fit.model
    if not options.target:
        found = labels(coarse.fast, model, group.pattern, group.up)
        model = shared(model, [x for x in found if not _is_held(x, options)])
        if max(int(c.moving.sum()) for c in group.channels) > 1:
            model = doubted(coarse.fast, model, group.pattern, group.up)
    return _faded(model, factor, t_s, back=True), dict(zip(names, sigma.tolist()))


def _seeded(model: ShakeModel, group: Group, options: Learning) -> tuple[ShakeModel, Learning]:
    """The modes found so far, moving across too, their frequencies and dampings held.

    A single camera and bubble cannot show whether they do: a rig that shakes along one axis is
    not taken for still along the others.
    """
    at, rig = len(model.modes), [m for m in model.modes if max(m.rms_mm) > 0]
    added = []
    for mode in rig:
        x, y, z = (_ACROSS * max(mode.rms_mm) * p for p in group.pattern)
        added.append(replace(mode, rms_mm=(x, y, z)))
    held = [f"modes.{at + i}.{f}" for i in range(len(added)) for f in ("frequency_hz", "damping")]
    model = replace(model, modes=(*model.modes, *added))
    return model, replace(options, hold=(*options.hold, *held))


def _is_held(label: LineLabel, options: Learning) -> bool:
    name = f"modes.{label.index}.frequency_hz"
    return label.owner == "rig" and any(fnmatch(name, pattern) for pattern in options.hold)


def _highest(group: Group, model: ShakeModel) -> float:
    """The highest frequency at which something stands out."""
    lines = [
        line
        for channel in group.channels
        for where in group.wheres
        for line in unexplained(channel, model, where, 8)
        if line.excess > _STRONG
    ]
    known = [m.frequency_hz for m in model.modes]
    return max([_LOW_HZ, *known, *(line.frequency_hz for line in lines)])


def _faded(model: ShakeModel, factor: int, t_s: Array, *, back: bool = False) -> ShakeModel:
    """The RMS of lines as they are in means over ``factor`` frames, or back."""
    if factor < 2:
        return model
    lines = [n for n in names_of(model) if n.endswith("rms_mm") and not n.startswith("broad")]
    values = []
    for n in lines:
        fade = faded(value_of(model, n.replace("rms_mm", "frequency_hz")), factor, t_s)
        values.append(value_of(model, n) * (1 / fade if back else fade))
    return with_values(model, lines, values)


def _free(model: ShakeModel, group: Group, options: Learning, first: bool) -> list[str]:
    """Names of what this group determines and nobody holds."""
    names = []
    for name in names_of(model):
        if any(fnmatch(name, pattern) for pattern in options.hold):
            continue
        if name == FORCE:
            names += [name] * first
        elif name.startswith(("modes", "bubble.zigzags", "broad_bands")):
            if _concerns(group, model, name):
                names.append(name)
        elif first and not (options.target and name.startswith("bubble")):
            names.append(name)
    return names


def _concerns(group: Group, model: ShakeModel, name: str) -> bool:
    """Whether a line moves along the group's directions more than along the others."""
    parts = name.split(".")
    lines = model.bubble.zigzags if parts[0] == "bubble" else getattr(model, parts[0])
    rms = np.asarray(lines[int(parts[-2])].rms_mm)
    inside = np.asarray(group.pattern) > 0.7
    if parts[0] == "bubble" and group.channels[0].moving.sum() == 0:
        return False
    return bool(rms[inside].max(initial=0.0) > rms[~inside].max(initial=0.0))


def _one_more(group: Group, step: _Step, options: Learning, first: bool) -> _Step | None:
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
    names = _free(model, group, options, first)
    return _Step(maximise(group.fast, model, names, steps=8), found)


def _coloured(group: Group, step: _Step, options: Learning, first: bool) -> _Step:
    """The modes' forces given a corner, where it brings more than one parameter must."""
    model = step.fit.model
    if not first or not model.modes or model.force_hz is not None:
        return step
    model = driven(model, START_FORCE_HZ, white=True)
    fit = maximise(group.fast, model, _free(model, group, options, first), steps=8)
    gain = fit.log_evidence - step.fit.log_evidence
    return _Step(fit, step.found) if gain > _penalty(group, model) / 3 else step


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
    fastest = max(lines, default=_LOW_HZ)
    return 1.5 * float(np.log(max(2 * fastest * (t[-1] - t[0]), 8.0)))


def _distinct(
    trials: Sequence[tuple[float, Where, ShakeModel]],
) -> list[tuple[float, Where, ShakeModel]]:
    """The best trial of each kind, of the three best kinds."""
    out: dict[Where, tuple[float, Where, ShakeModel]] = {}
    for trial in trials:
        out.setdefault(trial[1], trial)
    return list(out.values())[:3]


def _preference(model: ShakeModel, where: Where, rival: Where, up: Array) -> float:
    """Nats by which a label must win over another that explains the data as well.

    A line that fits equally goes to the rig: a wrong excuse for the rig hides its shake. Only the
    second harmonic of the zigzag is taken for the bubble's own.
    """
    if BUBBLE not in (where, rival) or where == rival:
        return 0.0
    harmonic = _is_harmonic(model, up)
    wins = (where == BUBBLE) == harmonic
    return -_TIE_NATS if wins else _TIE_NATS


def _is_harmonic(model: ShakeModel, up: Array) -> bool:
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


def _pruned(group: Group, fit: Fit, options: Learning, first: bool) -> Fit:
    """Lines taken away again whose absence the criterion does not mind."""
    at = 0
    while True:
        names = [n for n in _free(fit.model, group, options, first) if n.endswith(".frequency_hz")]
        if at >= len(names):
            return fit
        less = _without(fit.model, names[at])
        free = _free(less, group, options, first)
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
