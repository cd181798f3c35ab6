"""Compiled loops over the pairs and larger groups of a frame's detections."""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.compiled import compiled

GATE_SIGMA, NEVER = 5.0, -1e6
"""Limit of a true pair's gap in standard deviations of its wide part, and the log odds beyond."""

LARGEST_MAHALANOBIS2 = 60.0

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
    """Return the posterior probability (E,) of each group; see `groups.marginals`."""
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
    """Estimate the shift that all gaps of a frame share; see `matching.common_shift`.

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


@compiled
def ratio_log_odds(
    ratio: Array,
    total: Array,
    axes: Array,
    alike: Array,
    wrong: Array,
    rare: float,
    freedom: float,
) -> Array:
    """Return log odds (E,) from K properties; see `matching`.

    ratio, total : (E, K) differences and sums of the logarithms, less their means. NaN where
        unknown: such pairs get 0.
    axes, alike : (K, K), (K,) as in `LogRatioModel.uncorrelated`.
    wrong : (E,) probability that a measurement is unrelated to the bubble.
    rare : limit of the bubble's rareness (standard deviations)
    freedom : that of the tails.
    """
    pairs, many = ratio.shape
    out = np.zeros(pairs)
    constant = 0.0
    for k in range(many):
        constant += np.log1p(-alike[k] * alike[k])
    for i in range(pairs):
        odds, tails, known = 0.0, 0.0, True
        for k in range(many):
            apart = own = 0.0
            for c in range(many):
                known = known and abs(ratio[i, c]) < np.inf
                apart += ratio[i, c] * axes[c, k]
                own += total[i, c] * axes[c, k]
            own = min(max(0.5 * own, -rare), rare)
            odds += own * own * alike[k] / (1.0 + alike[k]) + apart * apart / 4.0
            tails += apart * apart * 0.5 / (1.0 - alike[k])
        if not known:
            continue
        odds -= 0.5 * (freedom + many) * np.log1p(tails / freedom) + 0.5 * constant
        odds += np.log1p(-wrong[i])
        floor = np.log(wrong[i])
        high, low = max(odds, floor), min(odds, floor)
        out[i] = high + np.log1p(np.exp(low - high))
    return out


@compiled
def track_density(
    points: Array,
    added: Array,
    log_size: Array,
    expected: Array,
    variances: Array,
    axes: Array,
    log_expected: Array,
    size_sd: float,
    size_factor: float,
) -> Array:
    """Return (E,) the density of a pair's point and size, summed over K tracks.

    points : (E, 3) points (mm)
    added : (E,) variance in every direction (mm^2).
    log_size, log_expected : (E,), (K,) logarithms of the radii (mm); NaN where unknown.
    expected, variances, axes : (K, 3), (K, 3), (K, 3, 3) the tracks' positions (mm), and the
        variances (mm^2) of these along axes, which are the columns of matrices.
    size_sd, size_factor : standard deviation of the logarithms' difference, and the density where
        it is 0. The densities are not below those at the largest Mahalanobis distance.
    """
    out = np.zeros(added.size)
    for i in range(added.size):
        for k in range(expected.shape[0]):
            distance2, determinant = 0.0, 1.0
            for axis in range(3):
                along = 0.0
                for c in range(3):
                    along += (points[i, c] - expected[k, c]) * axes[k, c, axis]
                own = variances[k, axis] + added[i]
                distance2 += along * along / own
                determinant *= own
            off = (log_size[i] - log_expected[k]) / size_sd
            factor = 1.0
            exponent = min(distance2, LARGEST_MAHALANOBIS2)
            if abs(off) < np.inf:
                exponent += off * off
                factor = size_factor
            out[i] += factor * np.exp(-0.5 * exponent) / np.sqrt(determinant)
    out *= (2.0 * np.pi) ** -1.5
    return out


@compiled
def pixel_density(uv: Array, covariance: Array, expected: Array, spread: Array) -> Array:
    """Return (N, K) the density (1/px^2) of N detections at K expected pixels.

    uv, expected : (N, 2), (K, 2) px; covariance, spread : (N, 2, 2), (K, 2, 2) px^2.
    """
    out = np.empty((uv.shape[0], expected.shape[0]))
    for n in range(out.shape[0]):
        for k in range(out.shape[1]):
            uu = covariance[n, 0, 0] + spread[k, 0, 0]
            uv_ = covariance[n, 0, 1] + spread[k, 0, 1]
            vv = covariance[n, 1, 1] + spread[k, 1, 1]
            du, dv = uv[n, 0] - expected[k, 0], uv[n, 1] - expected[k, 1]
            determinant = uu * vv - uv_ * uv_
            distance2 = (vv * du * du - 2.0 * uv_ * du * dv + uu * dv * dv) / determinant
            near = np.exp(-0.5 * min(distance2, LARGEST_MAHALANOBIS2))
            out[n, k] = near / (2.0 * np.pi * np.sqrt(determinant))
    return out
