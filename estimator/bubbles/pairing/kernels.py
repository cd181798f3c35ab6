"""Compiled loops over the pairs of a frame's detections; see `matching`."""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array, Bools
from telerig.compiled import compiled

GATE_SIGMA, NEVER = 5.0, -1e6
"""Limit of a true pair's gap in standard deviations of its wide part, and the log odds beyond."""

LARGEST_MAHALANOBIS2 = 60.0

_TAIL, _LEAST_TAIL_PX2, MOST_TAIL_PX2 = 0.02, 0.25, 1.0
_EXACT_SIDE = 11
_LARGEST_EXPONENT = 600.0
"""Of the product of all rows' odds to have no partner: exp(-745) is 0."""
_SHIFT_PASSES = 4


@compiled
def gap_log_odds(
    gap: Array, variance: Array, shift: float, uncertainty: float, span_px: float, out: Array
) -> None:
    """Write into ``out`` (N1, N2) log odds from gaps (px), less their shift (px), and variances
    (px^2), to which the shift's is added.

    The density of a true pair's gap is normal with wider tails (for disturbed outlines), and 0
    beyond a limit. It is compared with a uniform density over the span that both images cover.
    """
    for i in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            own = variance[i, j] + uncertainty
            square = (gap[i, j] - shift) ** 2
            wide = own + min(max(3.0 * own, _LEAST_TAIL_PX2), MOST_TAIL_PX2)
            if not square < GATE_SIGMA**2 * wide:
                out[i, j] = NEVER
                continue
            core = np.exp(-0.5 * square / own)
            tail = np.exp(-0.5 * square / wide) * np.sqrt(own / wide)
            density = ((1.0 - _TAIL) * core + _TAIL * tail) / np.sqrt(2.0 * np.pi * own)
            out[i, j] = np.log(max(density * span_px, 1e-300))


@compiled
def _component(possible: Bools, first: int, rows: Bools, columns: Bools) -> None:
    """Mark the rows and columns that possible pairs connect with the row ``first``."""
    rows[:], columns[:] = False, False
    waiting = np.empty(rows.size, dtype=np.int64)
    waiting[0], left = first, 1
    rows[first] = True
    while left > 0:
        left -= 1
        i = waiting[left]
        for j in range(columns.size):
            if possible[i, j] and not columns[j]:
                columns[j] = True
                for k in range(rows.size):
                    if possible[k, j] and not rows[k]:
                        rows[k] = True
                        waiting[left] = k
                        left += 1


@compiled
def _exact(weight: Array, alone: Array, out: Array) -> None:
    """Write into ``out`` (n, m) the probabilities of pairs, by a sum over all assignments.

    weight : (n, m) odds of the pairs; alone : (n,) those of a row without a partner. Dynamic
    programming over the subsets of columns that the first rows, and the last ones, have taken.
    """
    n, m = weight.shape
    forward, backward = np.zeros((n + 1, 1 << m)), np.ones((n + 1, 1 << m))
    forward[0, 0] = 1.0
    for i in range(n):
        last = n - 1 - i
        for taken in range(1 << m):
            forward[i + 1, taken] += alone[i] * forward[i, taken]
            backward[last, taken] = alone[last] * backward[last + 1, taken]
            for j in range(m):
                if not (taken >> j) & 1:
                    forward[i + 1, taken | (1 << j)] += weight[i, j] * forward[i, taken]
                    backward[last, taken] += weight[last, j] * backward[last + 1, taken | (1 << j)]
    for i in range(n):
        for j in range(m):
            total = 0.0
            if weight[i, j] > 0.0:
                for taken in range(1 << m):
                    if not (taken >> j) & 1:
                        total += forward[i, taken] * backward[i + 1, taken | (1 << j)]
            out[i, j] = weight[i, j] * total / backward[0, 0]


@compiled
def marginals(log_odds: Array, negligible: float) -> Array:
    """Return the posterior probability (N1, N2) of each pair; see `matching.marginals`."""
    n, m = log_odds.shape
    out = np.zeros((n, m))
    possible, waiting = np.empty((n, m), dtype=np.bool_), np.ones((n, m), dtype=np.bool_)
    rows, columns = np.empty(n, dtype=np.bool_), np.empty(m, dtype=np.bool_)
    again = True
    while again:
        again = False
        for i in range(n):
            for j in range(m):
                possible[i, j] = waiting[i, j] and log_odds[i, j] > negligible
                waiting[i, j] = False
        for first in range(n):
            if not possible[first].any():
                continue
            _component(possible, first, rows, columns)
            mine, others = np.flatnonzero(rows), np.flatnonzero(columns)
            large = min(mine.size, others.size) > _EXACT_SIDE
            again = again or large
            turned = others.size > mine.size
            if turned:
                mine, others = others, mine
            weight, found = np.zeros((mine.size, others.size)), np.empty((mine.size, others.size))
            alone = np.empty(mine.size)
            for a in range(mine.size):
                peak = 0.0
                for turn in range(2):
                    for b in range(others.size):
                        i, j = (others[b], mine[a]) if turned else (mine[a], others[b])
                        if possible[i, j] and turn == 0:
                            peak = max(peak, log_odds[i, j])
                        elif possible[i, j]:
                            peak = min(peak, _LARGEST_EXPONENT / mine.size)
                            weight[a, b] = np.exp(log_odds[i, j] - peak)
                alone[a] = np.exp(-peak)
            if not large:
                _exact(weight, alone, found)
            for a in range(mine.size):
                for b in range(others.size):
                    i, j = (others[b], mine[a]) if turned else (mine[a], others[b])
                    if large:
                        waiting[i, j] = possible[i, j]
                    elif possible[i, j]:
                        out[i, j] = found[a, b]
                    possible[i, j] = False
        negligible += 1.0
    return out


@compiled
def common_shift(
    gap: Array, variance: Array, appearance: Array, frame_px: float, span_px: float, least: float
) -> tuple[Array, float, float]:
    """Estimate the shift that all gaps of a frame share; see `matching.common_shift`.

    gap, variance : (N1, N2) gaps less their bias (px), and variances (px^2).
    appearance : (N1, N2) log odds from everything but the gaps
    least : see `marginals`.

    Returns the log odds (N1, N2) of all pairs, the shift (px) and its variance (px^2).
    """
    shift, uncertainty = 0.0, frame_px * frame_px
    odds = np.empty(gap.shape)
    gap_log_odds(gap, variance, shift, uncertainty, span_px, odds)
    odds += appearance
    for _ in range(_SHIFT_PASSES if frame_px > 0.0 else 0):
        probability = marginals(odds, least)
        total, pull = 1.0 / (frame_px * frame_px), 0.0
        for i in range(gap.shape[0]):
            for j in range(gap.shape[1]):
                if probability[i, j] > 0.0:
                    off = (gap[i, j] - shift) ** 2
                    weight = probability[i, j] / variance[i, j]
                    weight /= 1.0 + off / (4.0 * (variance[i, j] + uncertainty))
                    total += weight
                    pull += weight * gap[i, j]
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
