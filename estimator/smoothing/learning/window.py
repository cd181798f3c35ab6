"""From which frames of a run its hyper-parameters are learned, so that the cost is bounded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.learning.lines_of_sight import MOST_BUBBLES
from telerig.estimator.smoothing.problem.problem import SmoothingProblem
from telerig.estimator.smoothing.problem.window import Window, cut_out

MOST_FRAMES = 1500
"""A run of so many frames is learned from as a whole."""
_PLACES = 8
"""Windows begin at multiples of this part of a window."""


def learning_window(
    problem: SmoothingProblem, weights: tuple[Array, Array] | None = None
) -> Window:
    """Return the `MOST_FRAMES` frames in which the bubbles that learning uses are seen most.

    weights : of the bubbles' and the marks' pixels; those below 0.5 are left out. None for all.
    """
    count = len(problem.t_s)
    if weights is not None:
        seen, marks = problem.observations.of(weights[0] > 0.5), problem.references
        problem = replace(problem, observations=seen, references=marks.of(weights[1] > 0.5))
    if count <= MOST_FRAMES:
        return Window(problem, 0, np.arange(len(problem.bubbles)))
    step = MOST_FRAMES // _PLACES
    firsts = np.unique(np.append(np.arange(0, count - MOST_FRAMES, step), count - MOST_FRAMES))
    seen = problem.observations
    told = [_seen(seen.item[(seen.frame >= a) & (seen.frame < a + MOST_FRAMES)]) for a in firsts]
    first = int(firsts[int(np.argmax(told))])
    return cut_out(problem, first, first + MOST_FRAMES)


def other_windows(problem: SmoothingProblem, used: Window, most: int) -> list[Window]:
    """Return up to ``most`` windows of the same length, spread over the rest of the run."""
    length, count = len(used.problem.t_s), len(problem.t_s)
    before = _spread(0, used.first, length)
    after = _spread(used.first + length, count, length)
    firsts = np.array(before + after, np.int64)
    if not len(firsts):
        return []
    chosen = firsts[np.unique(np.linspace(0, len(firsts) - 1, most).round().astype(np.int64))]
    windows = [cut_out(problem, int(a), int(a) + length) for a in chosen]
    return [w for w in windows if w.problem.bubbles]


def _seen(items: Ints) -> int:
    """Number of pixels of the bubbles that are seen most."""
    return int(np.sort(np.bincount(items))[-MOST_BUBBLES:].sum()) if len(items) else 0


def _spread(first: int, end: int, length: int) -> list[int]:
    return list(range(first, end - length + 1, length))
