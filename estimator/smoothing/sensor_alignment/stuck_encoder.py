"""An encoder whose reading stays while the carriage moves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.sensors.image_motion import directions, seen_of
from telerig.estimator.smoothing.problem.problem import Observations, SmoothingProblem
from telerig.estimator.smoothing.sensor_alignment.mark_motion import LEAST_TRAVEL_MM

_STUCK_S = 0.05
_MOVING_MM_S = 20.0
_COMPARED_S, _LEAST_SEEN, _FOLLOWED = 0.3, 5, 0.5
"""Longest time before and after the carriage comes to rest in which images are compared with the
encoder, fewest sightings in it, and least share of the encoder's change of speed that they show."""

_BEHIND = 0.2
"""An encoder is stuck if so large a share of all marks' sightings moves without it."""


def stuck(problem: SmoothingProblem) -> list[Finding]:
    """Return a finding if the encoder's reading stays while the carriage must be moving.

    It stays if it changes by noise only in the whole run, or not at all in a part of it. A carriage
    that comes to rest there, or starts, changes the motion in the images by as much as the reading
    says.
    """
    stage = problem.stage
    if stage is None:
        return []
    t, x = stage.t_s, stage.position_mm
    inside = (t >= problem.t_s[0]) & (t <= problem.t_s[-1])
    t, x = t[inside], x[inside]
    if len(t) < 20:
        return []
    trend = np.polyval(np.polyfit(t - t[0], x, 1), t - t[0])
    if np.ptp(x) < LEAST_TRAVEL_MM and np.ptp(trend) <= np.ptp(x - trend):
        if not _sweeps(problem):
            return []
        words = f"the encoder reads {np.median(x):.6g} mm and changes by {np.ptp(x):.2g} mm in all"
        return [_finding(f"{words}, while the carriage moves: it is stuck")]
    ends = np.r_[-1, np.flatnonzero(np.diff(x) != 0), len(x) - 1]
    longest = int(np.argmax(np.diff(ends)))
    first, last = int(ends[longest]) + 1, int(ends[longest + 1])
    around = np.r_[np.diff(x[: first + 1])[-10:], np.diff(x[last:])[:10]]
    if t[last] - t[first] < _STUCK_S or last - first < 10 or not len(around):
        return []
    if np.median(np.abs(around)) / float(np.median(np.diff(t))) <= _MOVING_MM_S:
        return []
    if _rests(problem, float(t[first]), float(t[last])):
        return []
    return [
        _finding(
            f"the encoder reads {x[first]:.6g} mm from {t[first]:.6g} to {t[last]:.6g} s without "
            "any change, while the carriage moves: it is stuck"
        )
    ]


def _rests(problem: SmoothingProblem, begin_s: float, end_s: float) -> bool:
    """Return whether images show that the carriage rests while its reading stays: what is seen
    changes its speed as the encoder does where the rest begins, or where it ends.

    It does not if nothing is seen on both sides of an end.
    """
    length = min(end_s - begin_s, _COMPARED_S)
    followed = []
    for observed in (problem.references, problem.observations):
        for at in (begin_s, end_s):
            sides = [(problem.t_s >= a) & (problem.t_s <= a + length) for a in (at - length, at)]
            followed += _followed(problem, observed, sides)
        if followed:
            return float(np.median(followed)) > _FOLLOWED
    return False


def _followed(problem: SmoothingProblem, observed: Observations, sides: list[Bools]) -> list[float]:
    """Return by marks or bubbles of each camera which share of the encoder's change of speed from
    one side to the other (F,) the images show."""
    out = []
    for frame, item, place in _along_travel(problem, observed):
        for one in np.unique(item):
            parts = [(item == one) & side[frame] for side in sides]
            if min(map(np.count_nonzero, parts)) < _LEAST_SEEN:
                continue
            speeds = []
            for part in parts:
                t, read = problem.t_s[frame[part]], problem.encoder_mm[frame[part]]
                speeds.append(np.polyfit(t - t[0], np.column_stack([place[part], read]), 1)[0])
            seen, told = speeds[1] - speeds[0]
            if abs(told) > _MOVING_MM_S / 2:
                out.append(float(-seen / told))
    return out


def _along_travel(
    problem: SmoothingProblem, observed: Observations
) -> Iterator[tuple[Ints, Ints, Array]]:
    """Yield frames, items and places (n,) along the travel axis (mm) of what each camera sees
    within the encoder's record, of the cameras that see the axis."""
    observed = problem.read(observed)
    for c, camera in enumerate(problem.cameras):
        mine = np.flatnonzero(observed.camera == c)
        weights = seen_of(camera, problem.axis)
        if len(mine) and weights is not None:
            place = camera.unproject(observed.uv_px[mine])[0] @ directions(camera).T @ weights
            yield observed.frame[mine], observed.item[mine], place


def unfollowed(problem: SmoothingProblem) -> list[Finding]:
    """Return a finding if marks sweep through the images and the encoder hardly moves meanwhile.

    The reading of an encoder that is stuck may still change, by noise or a count to and fro.
    """
    seen, read, count = _speeds(problem, problem.references).T
    behind = (seen > _MOVING_MM_S) & (read < seen / 2)
    if not count[behind].sum() > _BEHIND * count.sum():
        return []
    fast, slow = (float(np.median(speed[behind])) for speed in (seen, read))
    return [
        _finding(
            f"marks move at {fast:.3g} mm/s, and the encoder at {slow:.3g} mm/s in the same "
            "frames: it is stuck"
        )
    ]


def _finding(words: str) -> Finding:
    todo = (
        "leave those rows out or repair the encoder; without the stage's positions, positions "
        "and velocities are relative to the carriage"
    )
    return Finding(words, "stage", todo, Code.ENCODER_STUCK)


def _sweeps(problem: SmoothingProblem) -> bool:
    """Return whether the carriage moves according to the images, although the encoder stands.

    It does if marks move through the images, or if there are none and all bubbles rest in them.
    """
    for observed in (problem.references, problem.observations):
        speeds = _speeds(problem, observed)
        if len(speeds):
            fast = float(np.median(speeds[:, 0])) > _MOVING_MM_S
            return fast if observed is problem.references else not fast
    return False


def _speeds(problem: SmoothingProblem, observed: Observations) -> Array:
    """Return the mean speeds (mm/s) along the travel axis of up to 50 marks or bubbles of each
    camera, of the encoder in the same frames, and the number of these, as rows (n, 3).
    """
    rows = []
    for frame, item, place in _along_travel(problem, observed):
        for one in np.unique(item)[:50]:
            mine = item == one
            if mine.sum() > 10:
                t, read = problem.t_s[frame[mine]], problem.encoder_mm[frame[mine]]
                both = np.column_stack([place[mine], read])
                rows.append([*np.abs(np.polyfit(t - t[0], both, 1)[0]), len(t)])
    return np.array(rows).reshape(-1, 3)
