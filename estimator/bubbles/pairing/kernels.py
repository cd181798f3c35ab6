"""Sums over the pairs and larger groups of a frame's detections, where they are many in compiled
loops."""

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
