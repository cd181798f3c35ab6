"""Learns the hyper-parameters of shake and bubbles from a run by maximum marginal likelihood.

Peaks of the spectrum are added one by one, each with the owner that fits best: a mode common to all
cameras, a mode of one camera's arm, or an oscillation of the bubbles. A line is kept if it lowers
the Bayesian information criterion (Schwarz, Ann. Stat. 6:461, 1978). Finally all parameters are
optimised together, and Laplace's approximation gives their covariance. The best source is a run in
which the stage moves in front of a target at rest: there every line belongs to the rig.
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
    value_of,
    with_low_pass_force,
    with_values,
)
from telerig.estimator.smoothing.learning.spectral_lines import (
    Attribution,
    Line,
    attributions,
    averaged,
    averaging_factor,
    averaging_loss,
    is_zigzag,
    unexplained,
    with_hidden_modes,
    with_split_lines,
)
from telerig.estimator.smoothing.learning.window import learning_signals
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    RigMode,
    ShakeModel,
    SmoothingProblem,
)
from telerig.factors.bubble_motion import Triple, Zigzag
from telerig.io.machine.parallel import keep_freed_memory

_STRONG = 20.0
_ACROSS, _ACROSS_LOG_SIGMA = 0.5, 1.0
_VAGUE_LOG_SIGMA = 0.3
_LOG_RATIOS = np.linspace(-3.0, 2.0, 11)
_START_DAMPING = 0.04
_START_FORCE_HZ = 60.0
LOW_HZ = 15.0
_HARMONIC = 0.12
_TIE_LOG_RATIO = 2.0
_NEEDED_LOG_RATIO = 150.0
"""A line without which the log evidence falls by more is not taken out and the rest fitted anew."""


def learn(
    problem: SmoothingProblem,
    start: ShakeModel,
    options: Learning | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> ShakeModel:
    """Return the model with the most probable modes, dampings and noise intensities for a run.

    problem : of a long run only the frames of `learning_signals` are used.
    start : the model to begin from, which also supplies what is not learned. Its modes are kept and
        optimised, except the guessed ones of the model named "default". With accelerometers a
        default start is returned unchanged, since its broad band needs no modes.
    options : what to learn.
    progress : called with a text and the completed share, from 0 to 1.

    In the returned model ``name`` is "learned", and ``learned`` contains the standard deviation of
    the logarithm of each learned parameter.
    """
    options = options or Learning()
    if start.name == "default" and problem.accelerometers:
        return start
    keep_freed_memory()
    model = replace(start, modes=()) if start.name == "default" else start
    signals = learning_signals(problem, fixed=options.target)
    if options.target:
        model = replace(model, bubble=replace(model.bubble, zigzags=()))
    groups = groups_of(signals, options, problem.up)
    learned: dict[str, float] = {}
    for index, group in enumerate(groups):
        if index and not options.target:
            model, options = _seeded(model, group, options)

        def report(found: int, at: int = index) -> None:
            if progress is not None:
                where = "across" if at else "the shared axis"
                words = f"{where}, {found} modes so far"
                progress(words, (at + found / (found + 2)) / len(groups))

        model, sigma = _learn_group(group, model, options, report, first=index == 0)
        learned |= sigma
    return replace(model, name="learned", learned=learned)


def _learn_group(
    group: Group,
    model: ShakeModel,
    options: Learning,
    report: Callable[[int], None],
    *,
    first: bool,
) -> tuple[ShakeModel, dict[str, float]]:
    t_s = group.signals[0].t_s
    factor = averaging_factor(t_s, _highest(group, model))
    model = _averaged_rms(model, factor, t_s)
    coarse = replace(group, signals=tuple(averaged(c, factor) for c in group.signals))
    seeds = {} if first else _seeds(model, options)
    given = len(model.modes)
    report(0)
    begun_white = model.force_hz is None and options.force_hz is None
    step = Step(maximise(coarse.fast, model, free_names(model, coarse, options, first), steps=15))
    step = try_low_pass_force(coarse, step, options, first)
    while True:
        better = with_one_more_mode(coarse, step, options, first)
        if better is None:
            break
        step = try_low_pass_force(coarse, better, options, first)
        report(len(step.found))
    fit = pruned(coarse, step.fit, options, first, given)
    if first and begun_white:
        fit = try_white_force(coarse, fit, options)
    names = free_names(fit.model, coarse, options, first)
    fit = maximise(coarse.fast, fit.model, names)
    sigma = np.sqrt(np.diag(laplace_covariance(coarse.fast, fit.model, names)))
    model = fit.model
    if not options.target:
        found = attributions(coarse.fast, model, group.pattern, group.up)
        model = with_split_lines(model, [x for x in found if not _is_kept(x, model, options)])
        vague = [n for n, s in zip(names, sigma) if n in seeds and s > _VAGUE_LOG_SIGMA]
        likely = [posterior_rms(coarse.fast, model, n, seeds[n]) for n in vague]
        model = with_values(model, vague, likely)
        if max(int(c.moving.sum()) for c in group.signals) > 1:
            model = with_hidden_modes(coarse.fast, model, group.pattern, group.up)
    return _averaged_rms(model, factor, t_s, back=True), dict(zip(names, sigma.tolist()))


def _seeded(model: ShakeModel, group: Group, options: Learning) -> tuple[ShakeModel, Learning]:
    """Return the model with each mode of the first group repeated along the second group's
    directions.

    Frequencies and dampings are held, the RMS is learned. One camera and one bubble cannot show
    whether the rig vibrates there, too.
    """
    at, rig = len(model.modes), [m for m in model.modes if max(m.rms_mm) > 0]
    added = []
    for mode in rig:
        x, y, z = (_ACROSS * max(mode.rms_mm) * p for p in group.pattern)
        added.append(replace(mode, rms_mm=(x, y, z)))
    held = [f"modes.{at + i}.{f}" for i in range(len(added)) for f in ("frequency_hz", "damping")]
    held += [FORCE] if added else []
    model = replace(model, modes=(*model.modes, *added))
    return model, replace(options, hold=(*options.hold, *held))


def _seeds(model: ShakeModel, options: Learning) -> dict[str, float]:
    """Return the modes that `_seeded` added: {name of the RMS: its prior median in mm}."""
    return {
        f"modes.{i}.rms_mm": max(mode.rms_mm)
        for i, mode in enumerate(model.modes)
        if f"modes.{i}.frequency_hz" in options.hold
    }


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


def _is_kept(label: Attribution, model: ShakeModel, options: Learning) -> bool:
    name = f"modes.{label.index}.frequency_hz"
    return label.owner == "rig" and is_held(name, model, options)


def _highest(group: Group, model: ShakeModel) -> float:
    """Return the highest frequency with a significant spectral line, at least `LOW_HZ`."""
    lines = [
        line
        for signal in group.signals
        for where in group.owners
        for line in unexplained(signal, model, where, 8)
        if line.excess > _STRONG
    ]
    known = [m.frequency_hz for m in model.modes]
    return max([LOW_HZ, *known, *(line.frequency_hz for line in lines)])


def _averaged_rms(model: ShakeModel, factor: int, t_s: Array, *, back: bool = False) -> ShakeModel:
    """Return the model with the RMS of lines as they are after averaging over frames, or back."""
    if factor < 2:
        return model
    lines = [n for n in names_of(model) if n.endswith("rms_mm") and not n.startswith("broad")]
    values = []
    for n in lines:
        fade = averaging_loss(value_of(model, n.replace("rms_mm", "frequency_hz")), factor, t_s)
        values.append(value_of(model, n) * (1 / fade if back else fade))
    return with_values(model, lines, values)


@dataclass(frozen=True)
class Step:
    """State of the search for spectral lines.

    fit : the model and its fit.
    found : owner of each line that was added.
    """

    fit: Fit
    found: tuple[Owner, ...] = ()


def with_one_more_mode(group: Group, step: Step, options: Learning, first: bool) -> Step | None:
    """Return the search with the spectral line added that improves the fit most.

    first : whether the group is the first one.

    Returns None if no line improves the evidence by more than its penalty.
    """
    tried = []
    for where in group.owners:
        if step.found.count(where) < options.most_modes:
            tried += _trials(group, step.fit.model, where, options)
    still = [c for c in group.fast if not c.shaken]
    shaken, rest = [c for c in group.fast if c.shaken], evidence(still, step.fit.model)
    trials = [
        (evidence(group.fast, m) if where == BUBBLE else evidence(shaken, m) + rest, where, m)
        for where, m in tried
    ]
    trials.sort(key=lambda trial: -trial[0])
    best: tuple[float, Owner, Fit] | None = None
    for _, where, model in _distinct(trials):
        fit = maximise(group.fast, model, _last_line(model, where), steps=8)
        lead = 0.0 if best is None else _preference(model, where, best[1], group.up)
        if best is None or fit.log_evidence > best[0] + lead:
            best = (fit.log_evidence, where, fit)
    if best is None or best[0] < step.fit.log_evidence + _bic_penalty(group, best[2].model):
        return None
    model, found = _with_other_arms(group, best[2].model, best[1]), (*step.found, best[1])
    names = free_names(model, group, options, first)
    return Step(maximise(group.fast, model, names, steps=8), found)


def try_low_pass_force(group: Group, step: Step, options: Learning, first: bool) -> Step:
    """Replace the modes' white forces by low-pass filtered ones if the BIC prefers them."""
    model = step.fit.model
    white = bool(model.modes) and all(m.force_hz is None for m in model.modes)
    if not first or not white or is_held(FORCE, model, options) or step.found[-1:] == (BUBBLE,):
        return step
    low_pass = with_low_pass_force(model, _START_FORCE_HZ)
    fits = [
        maximise(group.fast, m, free_names(m, group, options, first), steps=8)
        for m in (model, low_pass)
    ]
    gain = fits[1].log_evidence - fits[0].log_evidence
    return Step(fits[gain > _bic_penalty(group, model) / 3], step.found)


def try_white_force(group: Group, fit: Fit, options: Learning) -> Fit:
    """Replace low-pass filtered forces by white ones unless the BIC prefers the former."""
    names = free_names(fit.model, group, options, True)
    if FORCE not in names:
        return fit
    white = with_low_pass_force(fit.model, None)
    quick = maximise(group.fast, white, [n for n in names if n != FORCE], steps=8)
    worth = _bic_penalty(group, fit.model) / 3
    return quick if quick.log_evidence > fit.log_evidence - worth else fit


def _with_other_arms(group: Group, model: ShakeModel, where: Owner) -> ShakeModel:
    """Copy an arm's first mode to the other arms, which are built alike."""
    cameras = group.signals[0].cameras
    have = {m.camera for m in model.modes[:-1] if m.camera != CARRIAGE}
    if where not in cameras or have:
        return model
    last = model.modes[-1]
    copies = tuple(replace(last, camera=c) for c in cameras if c != last.camera)
    return replace(model, modes=(*model.modes, *copies))


def _bic_penalty(group: Group, model: ShakeModel) -> float:
    """Return the increase of log evidence that a new line must bring: 3/2 log n.

    n is two samples per period of the fastest line; more frames carry information on the noise
    only.
    """
    span_s = group.signals[0].span_s
    lines = [mode.frequency_hz for mode in model.modes]
    lines += [line.frequency_hz for line in model.bubble.zigzags]
    fastest = max(lines, default=LOW_HZ)
    return 1.5 * float(np.log(max(2 * fastest * span_s, 8.0)))


def _distinct(
    trials: Sequence[tuple[float, Owner, ShakeModel]],
) -> list[tuple[float, Owner, ShakeModel]]:
    """Return the best trial of each owner, for up to three owners."""
    out: dict[Owner, tuple[float, Owner, ShakeModel]] = {}
    for trial in trials:
        out.setdefault(trial[1], trial)
    return list(out.values())[:3]


def _preference(model: ShakeModel, where: Owner, rival: Owner, up: Array) -> float:
    """Return the log-likelihood ratio by which an owner must win over a rival.

    If both fit equally, the line belongs to the rig; the second harmonic of a zigzag belongs to the
    bubbles.
    """
    if BUBBLE not in (where, rival) or where == rival:
        return 0.0
    harmonic = _is_harmonic(model, up)
    wins = (where == BUBBLE) == harmonic
    return -_TIE_LOG_RATIO if wins else _TIE_LOG_RATIO


def _is_harmonic(model: ShakeModel, up: Array) -> bool:
    lateral = [z for z in model.bubble.zigzags if is_zigzag(z, up)]
    lines = [m.frequency_hz for m in model.modes[-1:]]
    lines += [z.frequency_hz for z in model.bubble.zigzags[-1:]]
    return any(abs(f / (2 * z.frequency_hz) - 1) < _HARMONIC for z in lateral for f in lines)


def _trials(
    group: Group, model: ShakeModel, where: Owner, options: Learning
) -> list[tuple[Owner, ShakeModel]]:
    out = []
    lines: list[Line] = []
    for signal in group.signals:
        lines += unexplained(signal, model, where)
    for line in sorted(lines, key=lambda item: -item.excess)[:3]:
        for share in (0.6, 1.2):
            out.append((where, _with_line(model, group, where, line, share, options)))
    return out


def _with_line(
    model: ShakeModel, group: Group, where: Owner, line: Line, share: float, options: Learning
) -> ShakeModel:
    x, y, z = (float(np.clip(share * line.rms_mm, 0.003, 4.0)) * p for p in group.pattern)
    if where == BUBBLE:
        added = Zigzag(line.frequency_hz, _START_DAMPING, (x, y, z))
        zigzags = (*model.bubble.zigzags, added)
        return replace(model, bubble=replace(model.bubble, zigzags=zigzags))
    force_hz = model.force_hz or options.force_hz
    mode = RigMode(line.frequency_hz, _START_DAMPING, (x, y, z), int(where), force_hz)
    return replace(model, modes=(*model.modes, mode))


def _last_line(model: ShakeModel, where: Owner) -> list[str]:
    stem = f"modes.{len(model.modes) - 1}"
    if where == BUBBLE:
        stem = f"bubble.zigzags.{len(model.bubble.zigzags) - 1}"
    return [f"{stem}.{field_}" for field_ in ("frequency_hz", "damping", "rms_mm")]


def pruned(group: Group, fit: Fit, options: Learning, first: bool, given: int = 0) -> Fit:
    """Remove lines without which the BIC is lower; the first ``given`` modes stay."""
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
        if evidence(group.fast, less) < fit.log_evidence - _NEEDED_LOG_RATIO:
            at += 1
            continue
        free = free_names(less, group, options, first)
        quick = maximise(group.fast, less, free, steps=6)
        own = names[at].startswith("modes") and _owner(fit.model, names[at]) != CARRIAGE
        worth = 0.0 if own else _bic_penalty(group, fit.model)
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


Owner = int | str

BUBBLE = "bubble"


@dataclass(frozen=True)
class Learning:
    """Options of learning.

    most_modes : largest number of spectral lines per owner (common mode, each arm, bubbles).
    hold : patterns of names of hyper-parameters (see ``parameters``) that keep their start values,
        for example "modes.*" for a known rig. If all parameters of a mode are held, so is the
        cut-off of the forces.
    target : whether the tracks are those of a target at rest.
    force_hz : initial cut-off frequency of the modes' low-pass filtered force. None begins with a
        white force, which is low-pass filtered if the BIC prefers that.
    """

    most_modes: int = 3
    hold: tuple[str, ...] = ()
    target: bool = False
    force_hz: float | None = None


@dataclass(frozen=True)
class Group:
    """Line-of-sight signals from which hyper-parameters are learned together.

    pattern : (3,) relative RMS of a line along each axis of the rig.
    owners : possible owners of a spectral line: all cameras, one camera's arm, or the bubbles.
    up : (3,) unit vector against gravity.
    """

    signals: tuple[Signal, ...]
    pattern: Triple
    owners: tuple[Owner, ...]
    up: Array

    @cached_property
    def fast(self) -> tuple[Signal, ...]:
        return tuple(part for signal in self.signals for part in pooled(signal))


def groups_of(signals: Sequence[Signal], options: Learning, up: Array) -> list[Group]:
    """Return two groups of signals: those of the shared coordinate, and the others.

    up : (3,) unit vector against gravity.
    """
    if not signals:
        return []
    bubble: tuple[Owner, ...] = () if options.target else (BUBBLE,)
    shared = signals[0]
    own: tuple[Owner, ...] = shared.cameras if len(shared.cameras) > 1 else ()
    square = shared.direction**2
    groups = [Group((shared,), _pattern(square), (CARRIAGE, *own, *bubble), up)]
    if len(signals) > 1:
        directions = np.array([c.direction for c in signals[1:]])
        across = np.diagonal(np.linalg.pinv(directions) @ directions)
        groups.append(Group(tuple(signals[1:]), _pattern(across), (CARRIAGE, *bubble), up))
    return groups


def _pattern(square: Array) -> Triple:
    x, y, z = (float(np.sqrt(s)) if s > 1e-3 else 0.0 for s in square)
    return x, y, z


def free_names(model: ShakeModel, group: Group, options: Learning, first: bool) -> list[str]:
    """Return the names of the free hyper-parameters that a group determines.

    first : whether it is the first group.
    """
    names = []
    for name in names_of(model):
        if is_held(name, model, options):
            continue
        if name == FORCE:
            if any(_concerns(group, model, f"modes.{i}.rms_mm") for i in _low_pass_modes(model)):
                names.append(name)
        elif name.startswith(("modes", "bubble.zigzags", "broad_bands")):
            if _concerns(group, model, name):
                names.append(name)
        elif first and not (options.target and name.startswith("bubble")):
            names.append(name)
    return names


def is_held(name: str, model: ShakeModel, options: Learning) -> bool:
    """Return whether a hyper-parameter is held at its start value."""
    names = [name]
    if name == FORCE:
        names += [f"modes.{i}.force_hz" for i in range(len(model.modes))]
    return any(fnmatch(n, pattern) for n in names for pattern in options.hold)


def _low_pass_modes(model: ShakeModel) -> list[int]:
    return [i for i, mode in enumerate(model.modes) if mode.force_hz is not None]


def _concerns(group: Group, model: ShakeModel, name: str) -> bool:
    """Return whether a line's largest RMS lies along the group's directions."""
    parts = name.split(".")
    lines = model.bubble.zigzags if parts[0] == "bubble" else getattr(model, parts[0])
    rms = np.asarray(lines[int(parts[-2])].rms_mm)
    inside = np.asarray(group.pattern) > 0.7
    if parts[0] == "bubble" and group.signals[0].moving.sum() == 0:
        return False
    return bool(rms[inside].max(initial=0.0) > rms[~inside].max(initial=0.0))
