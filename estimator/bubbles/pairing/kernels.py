"""Compiled loops over the pairs and larger groups of a frame's detections, and over the pairings of
tracks with them."""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.compiled import compiled

_EXACT_SIDE = 11
"""Columns of a component with exact probabilities: 2**11 subsets."""

_LARGEST_EXPONENT = 600.0
"""Of the product of all rows' odds to have no partner: exp(-745) is 0."""


@compiled
def _linked(keys: Ints, many: int) -> tuple[Ints, Ints]:
    """Return lists (many,), (E,) of the items with each key: the first of them, and after each item
    the next one; -1 at the end. Items with the key -1 are in none."""
    head, following = np.full(many, -1), np.full(keys.size, -1)
    for e in range(keys.size - 1, -1, -1):
        if keys[e] >= 0:
            following[e] = head[keys[e]]
            head[keys[e]] = e
    return head, following


@compiled
def _components(places: Ints, possible: Bools, many: int) -> Ints:
    """Return for each group (E,) a detection that all possible groups have in common which
    detections connect; -1 for others.

    places : (E, C) positions of the groups' detections among all ``many``; -1 for none.
    """
    parent, out = np.arange(many), np.full(possible.size, -1)
    for turn in range(2):
        for e in range(possible.size):
            if not possible[e]:
                continue
            root = -1
            for c in range(places.shape[1]):
                own = places[e, c]
                if own < 0:
                    continue
                while parent[own] != own:
                    parent[own] = parent[parent[own]]
                    own = parent[own]
                if root < 0:
                    root = own
                parent[own] = root
            if turn == 1:
                out[e] = root
    return out


@compiled
def _exact(weight: Array, alone: Array, choice: Ints, mask: Ints, columns: int) -> Array:
    """Return the probabilities (E,) of groups, by a sum over all sets of disjoint ones.

    weight, mask : (E,) odds of the groups, and bits of the columns that they take.
    choice : (E,) which of the n rows a group belongs to; a row takes one of its groups or none.
    alone : (n,) odds of a row that takes none. Dynamic programming over the subsets of columns that
    the first rows have taken.
    """
    n, sets = alone.size, 1 << columns
    forward, backward = np.zeros((n + 1, sets)), np.ones((n + 1, sets))
    forward[0, 0] = 1.0
    head, following = _linked(choice, n)
    for i in range(n):
        last = n - 1 - i
        for taken in range(sets):
            forward[i + 1, taken] += alone[i] * forward[i, taken]
            e = head[i]
            while e >= 0:
                if forward[i, taken] > 0.0 and not taken & mask[e]:
                    forward[i + 1, taken | mask[e]] += weight[e] * forward[i, taken]
                e = following[e]
            total = alone[last] * backward[last + 1, taken]
            e = head[last]
            while e >= 0:
                if not taken & mask[e]:
                    total += weight[e] * backward[last + 1, taken | mask[e]]
                e = following[e]
            backward[last, taken] = total
    out = np.zeros(weight.size)
    for e in range(weight.size):
        total, i = 0.0, choice[e]
        for taken in range(sets):
            if not taken & mask[e]:
                total += forward[i, taken] * backward[i + 1, taken | mask[e]]
        out[e] = weight[e] * total / backward[0, 0]
    return out


@compiled
def _joint(log_odds: Array, places: Ints, own: Ints, many: int, out: Array) -> bool:
    """Write the probabilities of the groups ``own`` (n,) of a component into ``out`` (E,).

    places : (E, C) positions of the groups' detections among all ``many``; -1 for none.
    Returns whether the component is small enough.
    """
    if own.size == 1:
        out[own[0]] = 1.0 / (1.0 + np.exp(-log_odds[own[0]]))
        return True
    cameras = places.shape[1]
    seen, number = np.zeros(cameras, np.int64), np.full(many, -1)
    for e in own:
        for c in range(cameras):
            if places[e, c] >= 0 and number[places[e, c]] < 0:
                number[places[e, c]] = seen[c]
                seen[c] += 1
    leading = columns = 0
    for c in range(cameras):
        columns += seen[c]
        if seen[c] > seen[leading]:
            leading = c
    columns -= seen[leading]
    if columns > _EXACT_SIDE:
        return False
    choice, mask = np.empty(own.size, np.int64), np.zeros(own.size, np.int64)
    rows = seen[leading]
    for k in range(own.size):
        first_bit = 0
        for c in range(cameras):
            if c != leading:
                if places[own[k], c] >= 0:
                    mask[k] |= 1 << (first_bit + number[places[own[k], c]])
                first_bit += seen[c]
        choice[k] = rows
        if places[own[k], leading] >= 0:
            choice[k] = number[places[own[k], leading]]
        else:  # it is in no group of the leading camera: a row of its own
            rows += 1
    peak, weight = np.zeros(rows), np.empty(own.size)
    for k in range(own.size):
        limit = _LARGEST_EXPONENT / rows
        peak[choice[k]] = min(max(peak[choice[k]], log_odds[own[k]]), limit)
    for k in range(own.size):
        weight[k] = np.exp(log_odds[own[k]] - peak[choice[k]])
    for i in range(rows):
        peak[i] = np.exp(-peak[i])
    found = _exact(weight, peak, choice, mask, columns)
    for k in range(own.size):
        out[own[k]] = found[k]
    return True


@compiled
def _marginals(log_odds: Array, places: Ints, many: int, negligible: float, out: Array) -> None:
    waiting, left = np.ones(log_odds.size, np.bool_), log_odds.size
    buffer = np.empty(log_odds.size, np.int64)
    while left > 0:
        for e in range(log_odds.size):
            waiting[e] = waiting[e] and log_odds[e] > negligible
        head, following = _linked(_components(places, waiting, many), many)
        left = 0
        for root in range(many):
            size, e = 0, head[root]
            while e >= 0:
                buffer[size] = e
                size += 1
                e = following[e]
            if size > 0:
                small = _joint(log_odds, places, buffer[:size], many, out)
                for k in range(size):
                    waiting[buffer[k]] = not small
                left += 0 if small else size
        negligible += 1.0


def marginals(log_odds: Array, rows: Ints, counts: Ints, negligible: float) -> Array:
    """Return the posterior probability (E,) of each group.

    log_odds : (E,) of the groups; those below ``negligible`` get the probability 0.
    rows, counts : (E, C) detections of each camera, -1 for none, and (C,) numbers of detections.

    Probabilities are exact per connected component with up to 11 detections beside those of the
    camera with the most (sum over all sets by dynamic programming over subsets). Of a larger
    component the least likely groups are left out, one unit of log odds after the other, until it
    falls apart.
    """
    counts = np.asarray(counts, np.int64)
    out, first = np.zeros(log_odds.size), np.cumsum(counts) - counts
    places = np.ascontiguousarray(np.where(rows < 0, -1, rows + first), np.int64)
    _marginals(np.ascontiguousarray(log_odds), places, int(counts.sum()), negligible, out)
    return out


@compiled
def _lower(matrix: Array, out: Array) -> None:
    """Write the inverse of the Cholesky factor of a matrix (3, 3) into ``out``."""
    a = np.sqrt(matrix[0, 0])
    b, c = matrix[1, 0] / a, matrix[2, 0] / a
    d = np.sqrt(matrix[1, 1] - b * b)
    e = (matrix[2, 1] - b * c) / d
    f = np.sqrt(matrix[2, 2] - c * c - e * e)
    out[0, 0], out[1, 1], out[2, 2] = 1 / a, 1 / d, 1 / f
    out[1, 0] = -b / (a * d)
    out[2, 1] = -e / (d * f)
    out[2, 0] = -(c / a + e * out[1, 0]) / f


@compiled
def inside_gate(
    expected: Array,
    spread: Array,
    unsure: Array,
    points: Array,
    noise: Array,
    allowed: Bools,
    certain: Bools,
    gate2: float,
) -> tuple[Ints, Ints, Array, Array, Array, Array]:
    """Return the pairings of K predictions with M measurements inside the gate.

    expected, spread : (K, 3), (K, 3, 3). unsure : (3, 3) is added to the covariances for the gate.
    points, noise : (M, 3), (M, 3, 3) measured. allowed : (K, M). certain : (M,) at any distance.

    Returns of E pairings the prediction and the measurement (E,), the innovation (E, 3), its
    covariance (E, 3, 3) without ``unsure``, the inverse, and the log of the determinant (E,).
    """
    tracks, many = allowed.shape
    inside, count = np.zeros((tracks, many), np.bool_), 0
    total, lower, left = np.empty((3, 3)), np.zeros((3, 3)), np.empty(3)
    for k in range(tracks):
        for m in range(many):
            if not allowed[k, m]:
                continue
            for i in range(3):
                left[i] = points[m, i] - expected[k, i]
                for j in range(3):
                    total[i, j] = spread[k, i, j] + unsure[i, j] + noise[m, i, j]
            _lower(total, lower)
            distance2 = 0.0
            for i in range(3):
                own = 0.0
                for j in range(i + 1):
                    own += lower[i, j] * left[j]
                distance2 += own * own
            inside[k, m] = certain[m] or distance2 <= gate2
            count += inside[k, m]
    row, column = np.empty(count, np.int64), np.empty(count, np.int64)
    innovation, log_det = np.empty((count, 3)), np.empty(count)
    covariance, information = np.empty((count, 3, 3)), np.empty((count, 3, 3))
    e = 0
    for k in range(tracks):
        for m in range(many):
            if not inside[k, m]:
                continue
            row[e], column[e] = k, m
            for i in range(3):
                innovation[e, i] = points[m, i] - expected[k, i]
                for j in range(3):
                    covariance[e, i, j] = spread[k, i, j] + noise[m, i, j]
            _lower(covariance[e], lower)
            log_det[e] = -2 * np.log(lower[0, 0] * lower[1, 1] * lower[2, 2])
            for i in range(3):
                for j in range(3):
                    own = 0.0
                    for c in range(3):
                        own += lower[c, i] * lower[c, j]
                    information[e, i, j] = own
            e += 1
    return row, column, innovation, covariance, information, log_det
