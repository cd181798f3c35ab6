"""Cuts a window out of a run: some frames, with the bubbles that are seen most in them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.problem.problem import (
    Bubble,
    Observations,
    SmoothingProblem,
)
from telerig.estimator.smoothing.problem.sensor_records import near_frames, stage_near


@dataclass(frozen=True)
class Window:
    """A part of a run.

    problem : of the frames from ``first`` on, with complete sensor records.
    first : the run's frame that is frame 0 here.
    bubbles : indices of its bubbles in the run.
    """

    problem: SmoothingProblem
    first: int
    bubbles: Ints


def cut_out(
    problem: SmoothingProblem,
    first: int,
    end: int,
    weights: tuple[Array, Array] | None = None,
    most_bubbles: int | None = None,
    least_share: float = 0.0,
    throughout: bool = False,
) -> Window:
    """Return the frames ``first`` to ``end`` - 1, with the bubbles that are seen more than once.

    weights : of the pixels of bubbles and of marks; those below 0.5 are left out.
    most_bubbles : largest number of bubbles; those seen in most frames are taken.
    least_share : share of the frames in which all cameras together have to see a bubble.
    throughout : take only tracks from the first to the last frame.
    """
    seen, marks = problem.observations, problem.references
    if weights is not None:
        seen, marks = seen.of(weights[0] > 0.5), marks.of(weights[1] > 0.5)
    seen, marks = seen.between(first, end), marks.between(first, end)
    often = np.bincount(seen.item, minlength=len(problem.bubbles))
    if throughout:
        often *= [b.first <= first and b.last >= end - 1 for b in problem.bubbles]
    chosen = np.sort(np.argsort(-often, kind="stable")[:most_bubbles])
    least = least_share * len(problem.cameras) * (end - first)
    chosen = chosen[often[chosen] > max(1, least - 1)]
    known = np.unique(marks.item)
    cut = replace(
        problem,
        t_s=problem.t_s[first:end],
        bubbles=tuple(_cut(problem.bubbles[b], first, end) for b in chosen),
        observations=_renumbered(seen, chosen),
        marks=tuple(problem.marks[m] for m in known),
        references=_renumbered(marks, known),
        known=(),
    )
    return Window(cut, first, chosen)


def all_of(problem: SmoothingProblem, first: int, end: int) -> Window:
    """Return the frames ``first`` to ``end`` - 1 with everything that was measured in them.

    Accelerometers are cut to a quarter of a second about the frames; the encoder also keeps one
    reading on each side.
    """
    seen, marks = problem.observations.between(first, end), problem.references.between(first, end)
    t_s = problem.t_s[first:end]
    lasting = [b.last >= first and b.first < end for b in problem.bubbles]
    chosen, known = np.flatnonzero(lasting), np.unique(marks.item)
    sensors = (near_frames(sensor, t_s) for sensor in problem.accelerometers)
    cut = replace(
        problem,
        t_s=t_s,
        bubbles=tuple(_cut(problem.bubbles[b], first, end) for b in chosen),
        observations=_renumbered(seen, chosen),
        stage=None if problem.stage is None else stage_near(problem.stage, t_s),
        accelerometers=tuple(sensor for sensor in sensors if len(sensor.t_s) > 1),
        marks=tuple(problem.marks[m] for m in known),
        references=_renumbered(marks, known),
    )
    return Window(cut, first, chosen)


def _renumbered(obs: Observations, chosen: Ints) -> Observations:
    kept = obs.of(np.isin(obs.item, chosen))
    return replace(kept, item=np.searchsorted(chosen, kept.item))


def _cut(bubble: Bubble, first: int, end: int) -> Bubble:
    low, high = max(bubble.first, first), min(bubble.last, end - 1)
    guess = bubble.guess_mm[low - bubble.first : high - bubble.first + 1]
    return Bubble(bubble.particle, low - first, high - first, guess[0], guess)
