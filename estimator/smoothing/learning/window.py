"""Chooses the frames of a run from which hyper-parameters are learned, to limit the cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.learning.lines_of_sight import (
    MOST_BUBBLES,
    PRESENT,
    Signal,
    signals_of,
    stacked,
)
from telerig.estimator.smoothing.problem.problem import FEWEST_BUBBLES, SmoothingProblem
from telerig.estimator.smoothing.problem.window import Window, cut_out

MOST_FRAMES = 1500
"""A run of so many frames is learned from as a whole."""
_PLACES = 8
"""Windows begin at multiples of this part of a window."""
_SHORTER, _FEW_BUBBLES = (0.7, 0.5), 2
_LONG, _SHORTEST, _UNEVEN = 750, 32, 0.01
"""Frames of a window from which on pieces of it are learned from, and of the shortest piece; by how
much the steps of frames may differ then."""


def learning_signals(
    problem: SmoothingProblem, weights: tuple[Array, Array] | None = None
) -> tuple[Signal, ...]:
    """Return the signals of `learning_parts`; several parts become replicates of one signal.

    weights : of the observations of bubbles and of marks; those below 0.5 are left out.
    """
    parts = [part.problem for part in learning_parts(problem, weights)]
    if len(parts) > 1:
        return tuple(stacked(some) for some in zip(*map(signals_of, parts)))
    return tuple(c for c in signals_of(parts[0]) if c.samples)


def learning_parts(
    problem: SmoothingProblem, weights: tuple[Array, Array] | None = None
) -> list[Window]:
    """Return the parts of a run that hyper-parameters are learned from, in order of time.

    This is `learning_window`; or, if tracks are short, several pieces of the run in each of which
    some bubbles are always seen. Arguments as for `learning_signals`.

    Frames outside the encoder's record are left out: what the carriage moves there would be taken
    for shake.
    """
    first, end = _record(problem)
    if end - first == len(problem.t_s):
        window = learning_window(problem, weights)
        return _pieces(problem, weights, window) or [window]
    read = cut_out(problem, first, end, weights)
    parts = learning_parts(read.problem)
    return [Window(p.problem, first + p.first, read.bubbles[p.bubbles]) for p in parts]


def _record(problem: SmoothingProblem) -> tuple[int, int]:
    """Return the frames within the encoder's record, from the first to before the end; all frames
    if there are not two."""
    inside = np.flatnonzero(problem.in_encoder_record)
    if len(inside) < 2:
        return 0, len(problem.t_s)
    return int(inside[0]), int(inside[-1]) + 1


def _pieces(
    problem: SmoothingProblem, weights: tuple[Array, Array] | None, window: Window
) -> list[Window]:
    """Return the longest pieces of a run in which at least three bubbles are always seen.

    The list is empty if ``window`` is such a piece, for short runs, and for runs with marks.
    """
    length, end = len(window.problem.t_s), window.first + len(window.problem.t_s)
    firsts, lasts = (np.array([getattr(b, n) for b in problem.bubbles]) for n in ("first", "last"))
    lasting = np.count_nonzero((firsts <= window.first) & (lasts >= end - 1))
    if length < _LONG or len(problem.marks) or lasting >= FEWEST_BUBBLES:
        return []
    most = min(int((lasts - firsts).max(initial=0)) + 1, length)
    steps = np.diff(problem.t_s)
    if np.ptp(steps) > _UNEVEN * float(np.median(steps)):
        return []
    for size in range(most, _SHORTEST - 1, -max(most // _PLACES, 1)):
        found, first = list[Window](), 0
        while first + size <= len(problem.t_s) and len(found) * size < 2 * MOST_FRAMES:
            lasting = np.count_nonzero((firsts <= first) & (lasts >= first + size - 1))
            if lasting >= FEWEST_BUBBLES:
                piece = cut_out(
                    problem, first, first + size, weights, MOST_BUBBLES,
                    least_share=PRESENT, throughout=True,
                )  # fmt: skip
                if len(piece.problem.bubbles) >= FEWEST_BUBBLES and _all_see(piece.problem):
                    found.append(piece)
                    first += size
                    continue
            first += max(size // _PLACES, 1)
        least = min(len(f.problem.bubbles) for f in found) if found else 0
        if len(found) * size >= min(MOST_FRAMES, len(problem.t_s) // 2):
            return [_with_fewer(piece, least) for piece in found]
    return []


def _all_see(problem: SmoothingProblem) -> bool:
    """Return whether every camera sees every bubble in 75 % of the frames."""
    seen = np.zeros((len(problem.cameras), len(problem.bubbles)), np.int64)
    np.add.at(seen, (problem.observations.camera, problem.observations.item), 1)
    return bool(seen.min() >= PRESENT * len(problem.t_s))


def _with_fewer(piece: Window, count: int) -> Window:
    """Return the piece with its ``count`` longest tracks."""
    fewer = cut_out(piece.problem, 0, len(piece.problem.t_s), most_bubbles=count)
    return Window(fewer.problem, piece.first, piece.bubbles[fewer.bubbles])


def learning_window(
    problem: SmoothingProblem, weights: tuple[Array, Array] | None = None
) -> Window:
    """Return the window of up to `MOST_FRAMES` frames in which the longest tracks are seen most.

    It is shorter if three bubbles are nearly always seen in a shorter window: these can be
    `pooled`, which is faster.

    weights : of the observations of bubbles and of marks; those below 0.5 are left out.
    """
    count = len(problem.t_s)
    if weights is not None:
        seen, marks = problem.observations.of(weights[0] > 0.5), problem.references
        problem = replace(problem, observations=seen, references=marks.of(weights[1] > 0.5))
    if count <= MOST_FRAMES:
        return Window(problem, 0, np.arange(len(problem.bubbles)))
    for length in (MOST_FRAMES, *(int(share * MOST_FRAMES) for share in _SHORTER)):
        first, there = _best(problem, length)
        if there >= FEWEST_BUBBLES:
            return cut_out(problem, first, first + length, least_share=PRESENT)
    first, _ = _best(problem, MOST_FRAMES, share=0.0)
    return cut_out(problem, first, first + MOST_FRAMES)


def _best(problem: SmoothingProblem, length: int, share: float = PRESENT) -> tuple[int, int]:
    """Return the first frame of the best window, and the number of bubbles that are seen in it.

    share : of the frames in which a bubble has to be seen to count.
    """
    count, step = len(problem.t_s), max(length // _PLACES, 1)
    firsts = np.unique(np.append(np.arange(0, count - length, step), count - length))
    seen, cameras = problem.observations, len(problem.cameras)
    most, found, there = -1, 0, 0
    for first in firsts.tolist():
        inside = seen.between(first, first + length).item
        each = np.sort(np.bincount(inside))[::-1][:MOST_BUBBLES]
        each = each[each >= share * cameras * length]
        if each.sum() > most:
            most, found, there = int(each.sum()), first, len(each)
    return found, there


def most_seen(observations: Ints) -> int:
    """Return the index of the largest count, or of the middle one if it is at least half as large.

    What a run's middle says is kept where it can, so that it does not depend on chance.
    """
    middle, most = len(observations) // 2, int(np.argmax(observations))
    return most if observations[most] > 2 * observations[middle] else middle


def first_of_most_seen(problem: SmoothingProblem, length: int) -> int:
    """Return the first frame of a window in which much is seen, by the rule of `most_seen`."""
    free = max(len(problem.t_s) - length, 0)
    firsts = np.linspace(0, free, 2 * _PLACES + 1).astype(np.int64)
    frames = np.sort(frames_of_observations(problem))
    begin, end = np.searchsorted(frames, firsts), np.searchsorted(frames, firsts + length)
    return int(firsts[most_seen(end - begin)])


def frames_of_observations(problem: SmoothingProblem) -> Ints:
    """Return the frame of each observation of a bubble within the encoder's record."""
    frames = problem.observations.frame
    return frames[problem.in_encoder_record[frames]]


def other_windows(problem: SmoothingProblem, used: Window, most: int) -> list[Window]:
    """Return up to ``most`` windows outside the used one, of its length or `MOST_FRAMES`, within
    the encoder's record."""
    end = used.first + len(used.problem.t_s)
    length = min(end - used.first, MOST_FRAMES)
    begin, last = _record(problem)
    before, after = _spread(begin, used.first, length), _spread(end, last, length)
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
