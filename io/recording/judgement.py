"""Readings that cannot be right: those amid garbage, and values far from those of their neighbours.

A line that has lost bytes may still read like a line. Its value is then wrong, often by a factor of
ten; a value that the device measured is near what the readings around it predict.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.io.recording.protocols import Readings
from telerig.io.rig_file.description import DeviceDescription

GAP_INTERVALS = 1.5
"""A step longer than so many usual ones is a gap."""
_NEIGHBOURS = 8
"""Readings on each side from which a value is predicted."""
_FAR_RESIDUALS = 5.0
"""Far from a quartic through the neighbours: more than so many times their largest residual."""
_PAIRS = 5
_CUBICS = ((1, 2), (3, 4), (1, 5), (2, 3), (4, 5))
"""Distances of the four readings, on both sides, of each cubic: every distance twice."""
_PASSES = 4
_REACH = 5
_BLOCK = 32
_QUANTILE = 0.8
_MOTION = 3
"""This many far readings in a row count as true motion, because damage affects single lines."""
_AROUND = 16
"""Garbage is looked for in so many readings' lengths on each side."""


def amid_garbage(spans: Ints, garbage: Ints) -> Bools:
    """Return (N,) which readings are unreliable, because most bytes around them are no readings.

    A reading is True if more than half of the bytes around it belong to no reading.

    spans : (N, 2) first byte and number of bytes of each reading. garbage : (M, 2) the same of each
    stretch of bytes that is no reading. Both are in increasing order.
    """
    if not len(spans) or not len(garbage):
        return np.zeros(len(spans), bool)
    reach = _AROUND * float(np.median(spans[:, 1]) + 1)
    first = min(spans[0, 0], garbage[0, 0])
    last = max(spans[-1].sum(), garbage[-1].sum())
    begin = np.maximum(spans[:, 0] - reach, first)
    end = np.minimum(spans.sum(axis=1) + reach, last)
    edges = np.ravel(np.column_stack([garbage[:, 0], garbage.sum(axis=1)]))
    until = np.cumsum(np.ravel(np.column_stack([0 * garbage[:, 1], garbage[:, 1]])))
    amount = np.interp(end, edges, until) - np.interp(begin, edges, until)
    return np.asarray(amount > 0.5 * (end - begin))


def mostly_garbage(device: DeviceDescription, found: Readings) -> InputError | None:
    """Return the error if most readings of a device stand between bytes that are no readings.

    Returns None for a device whose readings can be used.
    """
    garbage = found.malformed_spans[found.garbage]
    usable = int(np.sum(~amid_garbage(found.spans, garbage)))
    if not len(garbage) or 2 * usable > len(found.spans):
        return None
    shown = f", like {found.samples[0][:40]!r}" if found.samples else ""
    return InputError(
        f"most of what it sent is garbage ({int(garbage[:, 1].sum())} bytes{shown}): only {usable} "
        f"of its {len(found.spans)} readings can be used",
        where=f"devices.{device.name} port {device.port}",
        todo=f"set baud in rig.toml to the device's baud rate (now {device.baud}), check the "
        f"protocol (now {device.protocol}) and the cable",
    )


def far_from_neighbours(t_s: Array, values: Sequence[Array], most: float = 0.0) -> Bools:
    """Return (N,) which readings have a value that is far from what their neighbours predict.

    t_s : (N,) increasing times in s.
    values : one or more arrays (N,) of values.
    most : the largest second derivative in time that the values can have; a value may differ by its
        effect.

    A value is far if it deviates from a quartic through its neighbours by more than
    `_FAR_RESIDUALS` times the largest residual of the neighbours and the resolution. The readings
    that are found are left out and the others are tested again, because wrong readings near each
    other hide each other.
    """
    far = _beyond_reach(t_s, values, most)
    for _ in range(_PASSES):
        left = np.flatnonzero(~far)
        found = _far_at_first(t_s[left], [value[left] for value in values], most)
        if not found.any():
            break
        far[left[found]] = True
    return far


def _beyond_reach(t_s: Array, values: Sequence[Array], most: float) -> Bools:
    """Return (N,) True for a value that nothing gets to and back from within `_REACH` readings."""
    far = np.zeros(len(t_s), bool)
    if not most or len(t_s) < 2 * _REACH + 1:
        return far
    index = np.arange(_REACH, len(t_s) - _REACH)
    around_s = t_s[index + _REACH] - t_s[index - _REACH]
    for value in values:
        step = np.abs(value[index + 1] - value[index])
        off = np.abs(value - median_filter(value, 2 * _REACH + 1))[index]
        far[index] |= off > most / 2 * around_s**2 + _REACH * median_filter(step, 2 * _REACH + 1)
    return far


def _far_at_first(t_s: Array, values: Sequence[Array], most: float) -> Bools:
    """Return `far_from_neighbours` of one pass."""
    far = np.zeros(len(t_s), bool)
    step = np.diff(t_s)
    if step.size < 4 * _NEIGHBOURS:
        return far
    wide = np.flatnonzero(step > GAP_INTERVALS * np.median(step))
    beside = np.zeros(len(t_s), bool)
    if len(wide) < len(t_s) / 10:
        beside[wide] = beside[wide + 1] = True
    before, after = np.append(step[0], step), np.append(step, step[-1])
    allowed = most / 2 * before * after
    for value in values:
        rough = _roughness(t_s, value)
        differences = np.abs(np.diff(value))
        resolution = float(np.min(differences, where=differences > 0, initial=np.inf))
        if not np.isfinite(resolution):
            continue
        limit = np.maximum(_FAR_RESIDUALS * _scale(rough) + 2 * resolution, allowed)
        suspected = rough > limit
        off_value = np.zeros(len(t_s), bool)
        plain = ~(suspected | beside)
        tested = suspected | beside
        tested[:_PAIRS] = tested[-_PAIRS:] = True
        for i in np.flatnonzero(tested).tolist():
            off, residual = _off_quartic(t_s, value, plain, i)
            off_value[i] = abs(off) > max(_FAR_RESIDUALS * max(residual, resolution), allowed[i])
        far |= _few_in_a_row(off_value)
    return far


def _roughness(t_s: Array, value: Array) -> Array:
    """Return (N,) how far each value is, at least, from what the readings around it predict.

    It is the smaller distance to two medians: that of lines through `_PAIRS` pairs of readings,
    which two wrong readings do not spoil, and that of `_CUBICS`, which follow motion.
    """
    inner = slice(_PAIRS, len(value) - _PAIRS)
    out = np.zeros(len(value))
    lines = [_predicted(t_s, value, (-k, k)) for k in range(1, _PAIRS + 1)]
    cubics = [_predicted(t_s, value, (-wide, -near, near, wide)) for near, wide in _CUBICS]
    medians = [np.median(predicted, axis=0) for predicted in (lines, cubics)]
    out[inner] = np.abs(value[inner] - medians).min(0)
    return out


def _predicted(t_s: Array, value: Array, distances: Sequence[int]) -> Array:
    """Return what the polynomial through the readings at some distances predicts (Lagrange)."""
    places = [slice(_PAIRS + k, len(value) - _PAIRS + k) for k in distances]
    times = [t_s[place] - t_s[_PAIRS : len(value) - _PAIRS] for place in places]
    total = np.zeros(len(value) - 2 * _PAIRS)
    for j, place in enumerate(places):
        others = [time for k, time in enumerate(times) if k != j]
        total += value[place] * np.prod([o / (o - times[j]) for o in others], axis=0)
    return total


def _scale(size: Array) -> Array:
    """Return (N,) a high quantile of the sizes in the block of each and the two beside it."""
    count = -(-len(size) // _BLOCK)
    blocks = np.pad(size, (0, count * _BLOCK - len(size)), mode="reflect").reshape(count, _BLOCK)
    place = int(_QUANTILE * _BLOCK)
    high = np.partition(blocks, place, axis=1)[:, place]
    padded = np.concatenate([high[:1], high, high[-1:]])
    most = np.maximum(np.maximum(padded[:-2], high), padded[2:])
    return np.repeat(most, _BLOCK)[: len(size)]


def _few_in_a_row(far: Bools) -> Bools:
    """Return the far readings without those that stand `_MOTION` or more in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], far.astype(np.int8), [0]])))
    out = far.copy()
    for begin, end in edges.reshape(-1, 2).tolist():
        if end - begin >= _MOTION:
            out[begin:end] = False
    return out


def _off_quartic(t_s: Array, value: Array, plain: Bools, i: int) -> tuple[float, float]:
    """Return value i minus a quartic through its plain neighbours, and their largest residual."""
    window = np.arange(max(i - 2 * _NEIGHBOURS, 0), min(i + 2 * _NEIGHBOURS + 1, len(t_s)))
    near = window[plain[window] & (window != i)]
    near = near[np.argsort(np.abs(t_s[near] - t_s[i]), kind="stable")[: 2 * _NEIGHBOURS]]
    if len(near) <= _NEIGHBOURS:
        return 0.0, 0.0
    x, y = t_s[near] - t_s[i], value[near] - value[i]
    powers = np.vander(x / np.max(np.abs(x)), 5)
    found, *_ = np.linalg.lstsq(powers, y, rcond=None)
    return -float(found[-1]), float(np.max(np.abs(powers @ found - y)))
