"""From which frames of a run its hyper-parameters are learned, so that the cost is bounded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.learning.lines_of_sight import MOST_BUBBLES, PRESENT
from telerig.estimator.smoothing.problem.problem import SmoothingProblem
from telerig.estimator.smoothing.problem.window import Window, cut_out

MOST_FRAMES = 1500
"""A run of so many frames is learned from as a whole."""
_PLACES = 8
"""Windows begin at multiples of this part of a window."""
_SHORTER, _ENOUGH_BUBBLES, _FEW_BUBBLES = (0.7, 0.5), 3, 2


def learning_window(
    problem: SmoothingProblem, weights: tuple[Array, Array] | None = None
) -> Window:
    """Return the `MOST_FRAMES` frames in which the bubbles that learning uses are seen most.

    Fewer frames where tracks are shorter: bubbles that are seen nearly all of the time are learned
    from as one (`pooled`), at a fraction of the cost.

    weights : of the bubbles' and the marks' pixels; those below 0.5 are left out. None for all.
    """
    count = len(problem.t_s)
    if weights is not None:
        seen, marks = problem.observations.of(weights[0] > 0.5), problem.references
        problem = replace(problem, observations=seen, references=marks.of(weights[1] > 0.5))
    if count <= MOST_FRAMES:
        return Window(problem, 0, np.arange(len(problem.bubbles)))
    for length in (MOST_FRAMES, *(int(share * MOST_FRAMES) for share in _SHORTER)):
        first, there = _best(problem, length)
        if there >= _ENOUGH_BUBBLES:
            return cut_out(problem, first, first + length, least_share=PRESENT)
    first, _ = _best(problem, MOST_FRAMES, share=0.0)
    return cut_out(problem, first, first + MOST_FRAMES)


def _best(problem: SmoothingProblem, length: int, share: float = PRESENT) -> tuple[int, int]:
    """First frame of the window in which most is seen of the bubbles that learning uses, and how
    many of them are seen in a share of its frames."""
    count, step = len(problem.t_s), max(length // _PLACES, 1)
    firsts = np.unique(np.append(np.arange(0, count - length, step), count - length))
    seen, cameras = problem.observations, len(problem.cameras)
    most, found, there = -1, 0, 0
    for first in firsts.tolist():
        inside = seen.item[(seen.frame >= first) & (seen.frame < first + length)]
        each = np.sort(np.bincount(inside))[::-1][:MOST_BUBBLES]
        each = each[each >= share * cameras * length]
        if each.sum() > most:
            most, found, there = int(each.sum()), first, len(each)
    return found, there


def other_windows(problem: SmoothingProblem, used: Window, most: int) -> list[Window]:
    """Return up to ``most`` windows of the same length, spread over the rest of the run."""
    length, count = len(used.problem.t_s), len(problem.t_s)
    before = _spread(0, used.first, length)
    after = _spread(used.first + length, count, length)
    firsts = np.array(before + after, np.int64)
    if not len(firsts):
        return []
    chosen = firsts[np.unique(np.linspace(0, len(firsts) - 1, most).round().astype(np.int64))]
    windows = []
    for first in chosen.tolist():
        window = cut_out(problem, first, first + length, least_share=PRESENT)
        if not window.problem.bubbles:
            window = cut_out(problem, first, first + length, most_bubbles=_FEW_BUBBLES)
        windows.append(window)
    return [w for w in windows if w.problem.bubbles]


def _spread(first: int, end: int, length: int) -> list[int]:
    return list(range(first, end - length + 1, length))
