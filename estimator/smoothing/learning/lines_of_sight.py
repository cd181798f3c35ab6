"""Line-of-sight signals: the measurements of all cameras, one coordinate at a time.

For small shake a pixel is a linear function of the bubble's position across the line of sight.
Along a direction d that camera j sees, it measures d . (bubble - offset_j), plus the encoder
position. The coordinate that two cameras share (along their common perpendicular) is one signal,
each camera's other coordinate is another. A signal has a few states where the graph has dozens, so
that learning is fast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.smoothing.problem.problem import Observations, SmoothingProblem
from telerig.factors.measurements import image_of_point

MOST_BUBBLES = 6
"""So many bubbles, those seen longest, are what the rig's shake is learned from, or all that are
seen nearly always: their mean and their differences cost as much as two bubbles."""
_PARALLEL = 0.02
_ACROSS = 0.2
PRESENT = 0.75
"""Share of the frames in which bubbles have to be seen to be pooled."""


@dataclass(frozen=True)
class Signal:
    """Measurements of one coordinate by J cameras: F frames, I items (bubbles, marks), P pairs.

    direction : (3,) unit vector in the rig frame.
    cameras : (J,) indices of the cameras that see it.
    t_s : (F,).
    value_mm : (F, P) d . (item - offset) less where the item is first seen or, at rest, stated to
        be; or (F, P, R) for R replicates, which share all other fields: differences of bubbles, or
        pieces of a run (`stacked`).
    weight : (F, P) 1 / variance; 0 where nothing was seen.
    item, camera : (P,) of each pair, as indices into the items and into ``cameras``.
    moving : (I,) False for items at rest in the tank.
    first : (I,) frame in which it was first seen.
    start_sigma_mm : (I,) prior sd of an item at rest.
    pooled : number of bubbles whose mean the moving item is.
    shaken : False for differences of bubbles, in which the shake cancels.
    """

    direction: Array
    cameras: tuple[int, ...]
    t_s: Array
    value_mm: Array
    weight: Array
    item: Ints
    camera: Ints
    moving: Bools
    first: Ints
    start_sigma_mm: Array
    pooled: int = 1
    shaken: bool = True

    @property
    def samples(self) -> int:
        """Return the number of samples that count."""
        return int((self.weight > 0).sum())


def sight_directions(problem: SmoothingProblem) -> list[tuple[Array, tuple[int, ...]]]:
    """Return the measured directions (3,) and the cameras that see each; the shared one first."""
    depths = np.array([c.camera_from_rig.rotation[2] for c in problem.cameras])
    cross = np.cross(depths[0], depths[-1])
    length = float(np.linalg.norm(cross))
    if length < _PARALLEL:
        rotation = problem.cameras[0].camera_from_rig.rotation
        every = tuple(range(len(depths)))
        return [(_signed(rotation[1]), every), (_signed(rotation[0]), every)]
    shared = cross / length
    out = [(_signed(shared), tuple(np.flatnonzero(np.abs(depths @ shared) < _ACROSS).tolist()))]
    for j, depth in enumerate(depths):
        lateral = np.cross(depth, shared)
        out.append((_signed(lateral / np.linalg.norm(lateral)), (j,)))
    return out


def _signed(direction: Array) -> Array:
    """Return the direction with the sign that makes its largest component positive."""
    return np.asarray(direction * np.sign(direction[np.abs(direction).argmax()]))


def signals_of(problem: SmoothingProblem) -> tuple[Signal, ...]:
    """Return the signals of a problem, from its marks and up to `MOST_BUBBLES` bubbles."""
    chosen, position = _chosen(problem), problem.encoder_mm
    out = []
    for direction, cameras in sight_directions(problem):
        parts = [
            _bubble_rows(problem, problem.observations, chosen, position, direction, cameras),
            _mark_rows(problem, problem.references, len(chosen), position, direction, cameras),
        ]
        out.append(_signal(problem, direction, cameras, parts, chosen))
    return tuple(out)


def _chosen(problem: SmoothingProblem) -> Ints:
    """Return the indices of the bubbles that are seen longest, or of all that can be `pooled`."""
    seen = np.zeros((len(problem.bubbles), len(problem.cameras)), np.int64)
    np.add.at(seen, (problem.observations.item, problem.observations.camera), 1)
    present = np.flatnonzero(seen.min(1) >= PRESENT * len(problem.t_s))
    if len(present) > MOST_BUBBLES and not problem.marks:
        return present
    return np.sort(np.argsort(-seen.sum(1), kind="stable")[:MOST_BUBBLES])


_Rows = tuple[Ints, Ints, Ints, Array, Array]
"""Item, frame, camera (as index into the signal's), value (mm), variance (mm^2)."""


def _bubble_rows(
    problem: SmoothingProblem, obs: Observations, chosen: Ints, position: Array, direction: Array,
    cameras: tuple[int, ...],
) -> _Rows:  # fmt: skip
    number = np.full(len(problem.bubbles), -1)
    number[chosen] = np.arange(len(chosen))
    obs = obs.of(number[obs.item] >= 0)
    firsts = np.array([b.first for b in problem.bubbles], np.int64)
    lengths = np.array([len(b) for b in problem.bubbles], np.int64)
    guesses = np.concatenate([*(b.guess_mm for b in problem.bubbles), np.zeros((0, 3))])
    begin = np.r_[0, np.cumsum(lengths)]
    points = guesses[begin[obs.item] + obs.frame - firsts[obs.item]]
    rows = _along(problem, obs, points, position, direction, cameras)
    return (number[rows[0]], *rows[1:])


def _mark_rows(
    problem: SmoothingProblem, obs: Observations, offset: int, position: Array, direction: Array,
    cameras: tuple[int, ...],
) -> _Rows:  # fmt: skip
    places = np.array([m.guess_mm for m in problem.marks]).reshape(-1, 3)
    rows = _along(problem, obs, places[obs.item], position, direction, cameras)
    return (rows[0] + offset, *rows[1:])


def _along(
    problem: SmoothingProblem, obs: Observations, points: Array, position: Array, direction: Array,
    cameras: tuple[int, ...],
) -> _Rows:  # fmt: skip
    """Convert pixels to laboratory coordinates along a direction, linearised at ``points``."""
    parts: list[_Rows] = []
    for index, c in enumerate(cameras):
        mine = np.flatnonzero(obs.camera == c)
        if not len(mine):
            continue
        s = position[obs.frame[mine]]
        seen = image_of_point(problem.cameras[c], points[mine], s, problem.axis, np.zeros(3))
        back = direction @ np.linalg.pinv(seen.by_point)
        off = obs.uv_px[mine] - seen.uv_px
        value = points[mine] @ direction + (back * off).sum(-1)
        variance = ((back[:, None] @ obs.covariance_px2[mine])[:, 0] * back).sum(-1)
        camera = np.full(len(mine), index)
        parts.append((obs.item[mine], obs.frame[mine], camera, value, variance))
    if not parts:
        none = np.zeros(0, np.int64)
        return none, none, none, np.zeros(0), np.zeros(0)
    item, frame, camera, value, variance = (np.concatenate(p) for p in zip(*parts))
    return item, frame, camera, value, variance


def _signal(
    problem: SmoothingProblem, direction: Array, cameras: tuple[int, ...], parts: list[_Rows],
    chosen: Ints,
) -> Signal:  # fmt: skip
    item, frame, camera, value, variance = (np.concatenate(p) for p in zip(*parts))
    count = len(chosen) + len(problem.marks)
    pair = item * len(cameras) + camera
    pairs = np.unique(pair)
    place = np.searchsorted(pairs, pair)
    first = np.full(count, len(problem.t_s))
    np.minimum.at(first, item, frame)
    start = [problem.bubbles[b].start_mm for b in chosen] + [m.guess_mm for m in problem.marks]
    values = np.zeros((len(problem.t_s), len(pairs)))
    weight = np.zeros_like(values)
    values[frame, place] = value - (np.array(start) @ direction)[item]
    weight[frame, place] = 1 / variance
    sigma = np.r_[np.full(len(chosen), 100.0), [m.sigma_mm for m in problem.marks]]
    moving = np.arange(count) < len(chosen)
    return Signal(
        direction, cameras, problem.t_s, values, weight, pairs // len(cameras),
        pairs % len(cameras), moving, np.minimum(first, len(problem.t_s) - 1), sigma,
    )  # fmt: skip


def pooled(signal: Signal) -> tuple[Signal, ...]:
    """Split a signal of several bubbles into their mean and their differences.

    For equal noise in all frames the two are independent, so that the likelihood costs as much as
    that of two bubbles. Short gaps are interpolated. A signal with marks or with bubbles that are
    often unseen is returned as it is.
    """
    movers = np.flatnonzero(signal.moving)
    cameras, count = len(signal.cameras), len(movers)
    pairs = np.flatnonzero(signal.moving[signal.item])
    seen = signal.weight[:, pairs] > 0
    if count < 2 or len(movers) < len(signal.moving) or len(pairs) != count * cameras:
        return (signal,)
    if seen.mean(0).min() < PRESENT:
        return (signal,)
    whole, weight = signal.value_mm[:, pairs], signal.weight[:, pairs]
    if whole.ndim == 2:
        whole, weight = _bridged(signal.t_s, whole, weight)
    value = whole.reshape(len(whole), count, cameras, -1)
    each = weight.reshape(-1, count, cameras).mean(1)
    one = np.zeros(cameras, np.int64)
    alike = replace(
        signal, item=one, camera=np.arange(cameras), moving=np.array([True]),
        first=signal.first[movers].min(keepdims=True),
        start_sigma_mm=signal.start_sigma_mm[movers[:1]],
    )  # fmt: skip
    mean = replace(alike, value_mm=value.mean(1), weight=each * count, pooled=count)
    apart = np.einsum("rk,fkcs->fcrs", contrasts(count), value)
    apart = apart.reshape(*apart.shape[:2], -1)
    return mean, replace(alike, value_mm=apart, weight=each, shaken=False)


def stacked(pieces: Sequence[Signal]) -> Signal:
    """Return equally long pieces of a run as one signal with replicates (F, P, R)."""
    parts = [_bridged(p.t_s, p.value_mm, p.weight) for p in pieces]
    value = np.stack([v for v, _ in parts], -1)
    weight = np.mean([w for _, w in parts], axis=0)
    return replace(pieces[0], value_mm=value, weight=weight, first=np.zeros_like(pieces[0].first))


def contrasts(count: int) -> Array:
    """Return Helmert contrasts (count - 1, count): orthonormal rows, orthogonal to the mean."""
    full = np.linalg.qr(np.c_[np.ones(count), np.eye(count)[:, : count - 1]])[0]
    return np.asarray(full[:, 1:].T)


def _bridged(t_s: Array, value: Array, weight: Array) -> tuple[Array, Array]:
    """Return values (F, P) with gaps interpolated, and weights (F, P), constant in time."""
    out = value.copy()
    for column in range(value.shape[1]):
        good = weight[:, column] > 0
        out[:, column] = np.interp(t_s, t_s[good], value[good, column])
    return out, np.broadcast_to(weight.mean(0), weight.shape)
