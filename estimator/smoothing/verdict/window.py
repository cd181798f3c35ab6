"""Part of a smoothing problem: the frames and bubbles that a question needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.problem.problem import Bubble, Observations, SmoothingProblem

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_FRAMES = 2000
MOST_BUBBLES = 3


@dataclass(frozen=True)
class Window:
    """problem : of frames ``first`` on.  bubbles : which of the whole problem's it holds."""

    problem: SmoothingProblem
    first: int
    bubbles: Ints


def window_of(solution: Solution) -> Window:
    """The middle of a solved run, outliers left out, with the bubbles seen longest there."""
    problem = solution.frame.problem
    count = len(problem.t_s)
    first = max(0, (count - MOST_FRAMES) // 2)
    end = min(count, first + MOST_FRAMES)
    seen = _between(problem.observations.of(solution.weights[0] > 0.5), first, end)
    marks = _between(problem.references.of(solution.weights[1] > 0.5), first, end)
    often = np.bincount(seen.item, minlength=len(problem.bubbles))
    chosen = np.sort(np.argsort(-often, kind="stable")[:MOST_BUBBLES])
    chosen = chosen[often[chosen] > 1]
    known = np.unique(marks.item)
    cut = replace(
        problem,
        t_s=problem.t_s[first:end],
        bubbles=tuple(_cut(problem.bubbles[b], first, end) for b in chosen),
        observations=_renumbered(seen, chosen),
        marks=tuple(problem.marks[m] for m in known),
        references=_renumbered(marks, known),
    )
    return Window(cut, first, chosen)


def _between(obs: Observations, first: int, end: int) -> Observations:
    inside = obs.of((obs.frame >= first) & (obs.frame < end))
    return replace(inside, frame=inside.frame - first)


def _renumbered(obs: Observations, chosen: Ints) -> Observations:
    kept = obs.of(np.isin(obs.item, chosen))
    return replace(kept, item=np.searchsorted(chosen, kept.item))


def _cut(bubble: Bubble, first: int, end: int) -> Bubble:
    low, high = max(bubble.first, first), min(bubble.last, end - 1)
    guess = bubble.guess_mm[low - bubble.first : high - bubble.first + 1]
    return Bubble(bubble.particle, low - first, high - first, guess[0], guess)
