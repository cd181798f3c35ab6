"""Compiled loops over the pairs and larger groups of a frame's detections."""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.compiled import compiled

GATE_SIGMA, NEVER = 5.0, -1e6
"""Limit of a true pair's gap in standard deviations of its wide part, and the log odds beyond."""

TAIL, _LEAST_TAIL_PX2, MOST_TAIL_PX2 = 0.02, 0.25, 1.0
_EXACT_SIDE = 11
_LARGEST_EXPONENT = 600.0
"""Of the product of all rows' odds to have no partner: exp(-745) is 0."""
SHIFT_PASSES = 4


@compiled
def gap_log_odds(
    gap: Array, variance: Array, shift: float, uncertainty: float, span_px: float, out: Array
) -> None:
    """Write into ``out`` (E,) log odds from gaps (px), less their shift (px), and variances
    (px^2), to which the shift's is added.

    The density of a true pair's gap is normal with wider tails (for disturbed outlines), and 0
    beyond a limit. It is compared with a uniform density over the span that both images cover.
    """
    for e in range(gap.size):
        own = variance[e] + uncertainty
        square = (gap[e] - shift) ** 2
        wide = own + min(max(3.0 * own, _LEAST_TAIL_PX2), MOST_TAIL_PX2)
        if not square < GATE_SIGMA**2 * wide:
            out[e] = NEVER
            continue
        core = np.exp(-0.5 * square / own)
        tail = np.exp(-0.5 * square / wide) * np.sqrt(own / wide)
        density = ((1.0 - TAIL) * core + TAIL * tail) / np.sqrt(2.0 * np.pi * own)
        out[e] = np.log(max(density * span_px, 1e-300))


@compiled
def _components(rows: Ints, counts: Ints, possible: Bools) -> Ints:
    """Return for each group (E,) a number that all possible groups have in common which
    detections connect; -1 for others."""
    first = np.cumsum(counts) - counts
    parent = np.arange(counts.sum())
    out = np.full(len(rows), -1)
    for turn in range(2):
        for e in range(len(rows)):
            if not possible[e]:
                continue
            root = -1
            for c in range(rows.shape[1]):
                if rows[e, c] < 0:
                    continue
                own = first[c] + rows[e, c]
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
    n = alone.size
    forward, backward = np.zeros((n + 1, 1 << columns)), np.ones((n + 1, 1 << columns))
    forward[0, 0] = 1.0
    ends = np.searchsorted(choice, np.arange(n + 1))
    for i in range(n):
        last = n - 1 - i
        for taken in range(1 << columns):
            forward[i + 1, taken] += alone[i] * forward[i, taken]
            for e in range(ends[i], ends[i + 1]):
                if forward[i, taken] > 0.0 and not taken & mask[e]:
                    forward[i + 1, taken | mask[e]] += weight[e] * forward[i, taken]
            total = alone[last] * backward[last + 1, taken]
            for e in range(ends[last], ends[last + 1]):
                if not taken & mask[e]:
                    total += weight[e] * backward[last + 1, taken | mask[e]]
            backward[last, taken] = total
    out = np.zeros(weight.size)
    for e in range(weight.size):
        total, i = 0.0, choice[e]
        for taken in range(1 << columns):
            if not taken & mask[e]:
                total += forward[i, taken] * backward[i + 1, taken | mask[e]]
        out[e] = weight[e] * total / backward[0, 0]
    return out


@compiled
def marginals(log_odds: Array, rows: Ints, counts: Ints, negligible: float) -> Array:
    """Return the posterior probability (E,) of each group.

    log_odds : (E,) of the groups; those below ``negligible`` get the probability 0.
    rows, counts : (E, C) detections of each camera, -1 for none, and (C,) numbers of detections.

    Probabilities are exact per connected component with up to 11 detections beside those of the
    camera with the most (sum over all sets by dynamic programming over subsets). Of a larger
    component the least likely groups are left out, one unit of log odds after the other, until it
    falls apart.
    """
    out = np.zeros(log_odds.size)
    waiting = np.ones(log_odds.size, dtype=np.bool_)
    first = np.cumsum(counts) - counts
    place = np.empty(counts.sum(), dtype=np.int64)
    while waiting.any():
        possible = waiting & (log_odds > negligible)
        waiting[:] = False
        component = _components(rows, counts, possible)
        order = np.argsort(component, kind="mergesort")
        low = np.searchsorted(component[order], 0)
        while low < order.size:
            high = low + 1
            while high < order.size and component[order[high]] == component[order[low]]:
                high += 1
            mine = order[low:high]
            low = high
            if mine.size == 1:
                out[mine[0]] = 1.0 / (1.0 + np.exp(-log_odds[mine[0]]))
                continue
            seen = np.zeros(counts.size, dtype=np.int64)
            for e in mine:
                for c in range(counts.size):
                    if rows[e, c] >= 0:
                        place[first[c] + rows[e, c]] = -1
            for e in mine:
                for c in range(counts.size):
                    if rows[e, c] >= 0 and place[first[c] + rows[e, c]] < 0:
                        place[first[c] + rows[e, c]] = seen[c]
                        seen[c] += 1
            leading = np.argmax(seen)
            columns = seen.sum() - seen[leading]
            if columns > _EXACT_SIDE:
                waiting[mine] = True
                continue
            bit = np.cumsum(seen) - seen
            bit[leading + 1 :] -= seen[leading]
            choice, mask = np.empty(mine.size, np.int64), np.zeros(mine.size, np.int64)
            count = seen[leading]
            for k in range(mine.size):
                choice[k] = -1
                for c in range(counts.size):
                    if rows[mine[k], c] >= 0:
                        at = place[first[c] + rows[mine[k], c]]
                        if c == leading:
                            choice[k] = at
                        else:
                            mask[k] |= 1 << (bit[c] + at)
                if choice[k] < 0:  # it is in no group of the leading camera: a row of its own
                    choice[k] = count
                    count += 1
            peak = np.zeros(count)
            for k in range(mine.size):
                peak[choice[k]] = max(peak[choice[k]], log_odds[mine[k]])
            peak = np.minimum(peak, _LARGEST_EXPONENT / count)
            by_row = np.argsort(choice, kind="mergesort")
            mine, choice, mask = mine[by_row], choice[by_row], mask[by_row]
            weight = np.exp(log_odds[mine] - peak[choice])
            out[mine] = _exact(weight, np.exp(-peak), choice, mask, columns)
        negligible += 1.0
    return out


@compiled
def common_shift(
    gap: Array,
    variance: Array,
    appearance: Array,
    rows: Ints,
    counts: Ints,
    frame_px: float,
    span_px: float,
    least: float,
) -> tuple[Array, float, float]:
    """Estimate the shift that all gaps of a frame share; see `groups.match`.

    gap, variance : (E,) gaps less their bias (px), and variances (px^2).
    appearance : (E,) log odds from everything but the gaps
    rows, counts, least : see `marginals`.

    Returns the log odds (E,) of all pairs, the shift (px) and its variance (px^2).
    """
    shift, uncertainty = 0.0, frame_px * frame_px
    odds = np.empty(gap.shape)
    gap_log_odds(gap, variance, shift, uncertainty, span_px, odds)
    odds += appearance
    for _ in range(SHIFT_PASSES if frame_px > 0.0 else 0):
        probability = marginals(odds, rows, counts, least)
        total, pull = 1.0 / (frame_px * frame_px), 0.0
        for e in range(gap.size):
            if probability[e] > 0.0:
                off = (gap[e] - shift) ** 2
                weight = probability[e] / variance[e]
                weight /= 1.0 + off / (4.0 * (variance[e] + uncertainty))
                total += weight
                pull += weight * gap[e]
        shift, uncertainty = pull / total, 1.0 / total
        gap_log_odds(gap, variance, shift, uncertainty, span_px, odds)
        odds += appearance
    return odds, shift, uncertainty
