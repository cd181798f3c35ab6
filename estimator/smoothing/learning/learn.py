"""Hyper-parameters of shake and bubbles from the run itself, by maximum marginal likelihood.

Lines of the spectrum are tried one by one as what they could be (a mode that all cameras share, a
mode of one camera's arm, an oscillation of the bubbles), kept while the Bayesian information
criterion falls (Schwarz, Ann. Stat. 6:461, 1978), and climbed together to the most probable
values; the curvature there (Laplace) says how well they are known. A run of the stage that watches
a target standing still is the best source: there every line is the rig's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoothing.learning.groups import (
    Group,
    Learning,
    free_names,
    groups_of,
    is_held,
)
from telerig.estimator.smoothing.learning.likelihood import evidence, laplace_sigma, maximise
from telerig.estimator.smoothing.learning.lines_of_sight import Channel, channels_of
from telerig.estimator.smoothing.learning.mode_labels import LineLabel, doubted, labels, shared
from telerig.estimator.smoothing.learning.mode_search import (
    LOW_HZ,
    Step,
    coloured,
    one_more,
    pruned,
    whitened,
)
from telerig.estimator.smoothing.learning.parameters import FORCE, names_of, value_of, with_values
from telerig.estimator.smoothing.learning.spectrum import coarsening, coarser, faded, unexplained
from telerig.estimator.smoothing.problem.problem import ShakeModel, SmoothingProblem

Array = NDArray[np.float64]

_STRONG = 20.0
_ACROSS, _ACROSS_LOG_SIGMA = 0.5, 1.0
_VAGUE_LOG_SIGMA = 0.3
_LOG_RATIOS = np.linspace(-3.0, 2.0, 11)


def learn(
    problem: SmoothingProblem, start: ShakeModel, options: Learning | None = None
) -> ShakeModel:
    """A model whose modes, dampings and intensities are the most probable for the run.

    start : gives what is not learned. Its modes are kept and improved, unless they are the default
    guess (its name is "default"). Returns a model named "learned", with the standard deviations of
    its log-parameters in ``learned``. Sensors are not learned from: with them a default start comes
    back as it is, its broad band needs no modes.
    """
    options = options or Learning()
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


def _learn_group(
    group: Group, model: ShakeModel, options: Learning, *, first: bool
) -> tuple[ShakeModel, dict[str, float]]:
    t_s = group.channels[0].t_s
    factor = coarsening(t_s, _highest(group, model))
    model = _faded(model, factor, t_s)
    coarse = replace(group, channels=tuple(coarser(c, factor) for c in group.channels))
    seeds = {} if first else _seeds(model, options)
    given = len(model.modes)
    begun_white = model.force_hz is None and options.force_hz is None
    step = Step(maximise(coarse.fast, model, free_names(model, coarse, options, first), steps=15))
    step = coloured(coarse, step, options, first)
    while True:
        better = one_more(coarse, step, options, first)
        if better is None:
            break
        step = coloured(coarse, better, options, first)
    fit = pruned(coarse, step.fit, options, first, given)
    if first and begun_white:
        fit = whitened(coarse, fit, options)
    names = free_names(fit.model, coarse, options, first)
    fit = maximise(coarse.fast, fit.model, names)
    sigma = np.sqrt(np.diag(laplace_sigma(coarse.fast, fit.model, names)))
    model = fit.model
    if not options.target:
        found = labels(coarse.fast, model, group.pattern, group.up)
        model = shared(model, [x for x in found if not _is_kept(x, model, options)])
        vague = [n for n, s in zip(names, sigma) if n in seeds and s > _VAGUE_LOG_SIGMA]
        likely = [as_likely(coarse.fast, model, n, seeds[n]) for n in vague]
        model = with_values(model, vague, likely)
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
    held += [FORCE] if added else []
    model = replace(model, modes=(*model.modes, *added))
    return model, replace(options, hold=(*options.hold, *held))


def _seeds(model: ShakeModel, options: Learning) -> dict[str, float]:
    """Names of the RMS of modes across that others began, and what those expect of it."""
    return {
        f"modes.{i}.rms_mm": max(mode.rms_mm)
        for i, mode in enumerate(model.modes)
        if f"modes.{i}.frequency_hz" in options.hold
    }


def as_likely(channels: Sequence[Channel], model: ShakeModel, name: str, median: float) -> float:
    """An RMS that the data hardly determine as the root of its posterior's mean square.

    The most probable of a line that bubbles' wide swings hide is next to none, and would say that
    the rig stands still. median : of the log-normal prior.
    """
    values = median * np.exp(_LOG_RATIOS)
    found = np.array([evidence(channels, with_values(model, [name], [v])) for v in values])
    found -= 0.5 * (_LOG_RATIOS / _ACROSS_LOG_SIGMA) ** 2
    weight = np.exp(found - found.max())
    return float(np.sqrt(weight @ values**2 / weight.sum()))


def _is_kept(label: LineLabel, model: ShakeModel, options: Learning) -> bool:
    name = f"modes.{label.index}.frequency_hz"
    return label.owner == "rig" and is_held(name, model, options)


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
    return max([LOW_HZ, *known, *(line.frequency_hz for line in lines)])


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
