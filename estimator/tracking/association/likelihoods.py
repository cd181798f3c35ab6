"""Which measurement may continue which track, and the likelihood of each way of pairing them.

A pairing's score is its log-likelihood ratio against "the track was missed and the measurement is
new": log P_D / (1 - P_D) + log N(innovation) - log(density of new ones) + log ratio of the sizes.
Measurements are points in space, or pixels of one camera alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from scipy.special import chdtri

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.tracking.filter.motion import POSITION
from telerig.estimator.tracking.filter.state import Common, Track
from telerig.estimator.tracking.filter.types import FrameMeasurements, TrackerSettings
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian

_LOG_2PI = float(np.log(2 * np.pi))
_SIZE_SPAN_MM = 5.0
_SHIFT_ROUNDS = 5
_MAX_NODES = 4000


@dataclass(frozen=True)
class Pairs:
    """Hold E possible pairings of tracks with measurements, all inside the widest gate.

    row, column : (E,) index of the track and index of the measurement.
    innovation_mm : (E, 3) measured minus predicted position, without the shift common to all
        bubbles.
    covariance_mm2 : (E, 3, 3) covariance of the innovation.
    information : (E, 3, 3) inverse of the covariance, in 1/mm^2.
    constant : (E,) score (log-likelihood ratio) without the part that depends on the distance.
    """

    row: Ints
    column: Ints
    innovation_mm: Array
    covariance_mm2: Array
    information: Array
    constant: Array

    def __len__(self) -> int:
        return len(self.row)

    def distance2(self, shift_mm: Array) -> Array:
        """(E,) squared Mahalanobis distances, the common shift removed."""
        left = self.innovation_mm - shift_mm
        return np.asarray(np.einsum("ei,eij,ej->e", left, self.information, left))

    def scores(self, shift_mm: Array) -> Array:
        return self.constant - self.distance2(shift_mm) / 2


@lru_cache(maxsize=64)
def gate2(settings: TrackerSettings, dimensions: int = 3) -> float:
    """Largest squared Mahalanobis distance inside the gate."""
    return float(chdtri(dimensions, 1 - settings.gate_probability))


def gated_pairs(
    tracks: Sequence[Track],
    measured: FrameMeasurements,
    columns: Ints,
    common: Common,
    settings: TrackerSettings,
) -> Pairs:
    """Pairings of tracks with the measurements ``columns`` inside the gate, the common shift
    unknown."""
    if not len(tracks) or not len(columns):
        none = np.zeros(0, np.int64)
        return Pairs(none, none, *(np.zeros((0, 3, 3)[:k]) for k in (2, 3, 3, 1)))
    x = np.array([t.point_mm for t in tracks])
    p = np.array([t.point_covariance_mm2 for t in tracks])
    z, r = measured.points_mm[columns], measured.covariance_mm2[columns]
    between = z[None] - x[:, None]
    spread = np.trace(p, axis1=1, axis2=2)[:, None] + np.trace(r, axis1=1, axis2=2)[None]
    reach2 = gate2(settings) * (spread + np.trace(common.covariance_mm2))
    row, local = np.nonzero(((between - common.shift_mm) ** 2).sum(-1) <= reach2)
    innovation, covariance = between[row, local], p[row] + r[local]
    total = np.linalg.inv(covariance + common.covariance_mm2)
    left = innovation - common.shift_mm
    near = np.einsum("ei,eij,ej->e", left, total, left) <= gate2(settings)
    row, local, innovation, covariance = (a[near] for a in (row, local, innovation, covariance))
    column = columns[local]
    seen = settings.detection_probability
    density = -1.5 * _LOG_2PI - np.log(np.linalg.det(covariance)) / 2
    base = np.log(seen / (1 - seen) / settings.new_per_mm3)
    sure = np.log(np.clip(measured.confidence[column], 1e-3, 1.0))
    expected = np.array([t.d_eq_mm for t in tracks])[row]
    alive = _alive_score(np.array([t.misses for t in tracks]), settings)[row]
    size = size_score(expected, measured.d_eq_mm[column], settings)
    constant = base + density + sure + alive + size
    return Pairs(row, column, innovation, covariance, np.linalg.inv(covariance), constant)


def _alive_score(misses: Ints, settings: TrackerSettings) -> Array:
    """(K,) log probability that a track not seen for so many frames is only missed, not gone."""
    missed = (1 - settings.detection_probability) * settings.missed_again_probability ** (
        np.maximum(misses, 1) - 1.0
    )
    return -np.log1p(misses * settings.end_probability / missed)


def size_score(expected_mm: Array, measured_mm: Array, settings: TrackerSettings) -> Array:
    """Log-likelihood ratio of sizes against a uniform density over 5 mm; 0 for an unknown size."""
    sigma = settings.size_scatter * expected_mm
    off = np.minimum(((measured_mm - expected_mm) / sigma) ** 2 / 2, settings.size_cap_log_ratio)
    score = np.log(_SIZE_SPAN_MM / sigma) - _LOG_2PI / 2 - off
    return np.where(np.isfinite(score), score, 0.0)


def best_assignment(rows: int, row: Ints, column: Ints, score: Array) -> Ints:
    """(rows,) column of each row, -1 for none, with the largest total score."""
    out = np.full(rows, -1)
    if not len(row):
        return out
    cost = np.zeros((rows, int(column.max()) + 1))
    cost[row, column] = np.minimum(-score, 0.0)
    at, to = linear_sum_assignment(cost)
    good = cost[at, to] < 0
    out[at[good]] = to[good]
    return out


def assigned_with_shift(
    pairs: Pairs, rows: int, best_rows: Bools, common: Common
) -> tuple[Common, Ints]:
    """The common shift and the assignment (rows,), estimated by turns.

    best_rows : (rows,) which tracks take part.
    """
    now, chosen = common, np.full(rows, -1)
    usable = np.flatnonzero(best_rows[pairs.row])
    for turn in range(_SHIFT_ROUNDS):
        score = pairs.scores(now.shift_mm)[usable]
        if turn == 0:
            # before the shift is known its covariance belongs to the distance
            left = pairs.innovation_mm[usable] - now.shift_mm
            total = np.linalg.inv(pairs.covariance_mm2[usable] + now.covariance_mm2)
            wide = np.einsum("ei,eij,ej->e", left, total, left) / 2
            score = score + pairs.distance2(now.shift_mm)[usable] / 2 - wide
        found = best_assignment(rows, pairs.row[usable], pairs.column[usable], score)
        if turn and np.array_equal(found, chosen):
            break
        chosen = found
        picked = usable[chosen[pairs.row[usable]] == pairs.column[usable]]
        now = common.informed(pairs.innovation_mm[picked], pairs.covariance_mm2[picked])
    return now, chosen


def unrivalled(
    row: Ints, column: Ints, score: Array, chosen: Ints, margin_log_ratio: float
) -> Ints:
    """(K,) chosen, and no other pairing of its track or its measurement is within the margin."""
    out = chosen >= 0
    for r in np.flatnonzero(out):
        mine = (row == r) & (column == chosen[r])
        rival = ((row == r) | (column == chosen[r])) & ~mine
        best_rival = np.max(score[rival], initial=-np.inf)
        out[r] = best_rival < score[mine].max() - margin_log_ratio
    return np.asarray(out)


def joint_score(pairs: Pairs, edges: Ints, common: Common) -> float:
    """Log-likelihood ratio of some pairings together, the common shift integrated out."""
    if not len(edges):
        return 0.0
    left = pairs.innovation_mm[edges] - common.shift_mm
    pull = np.einsum("eij,ej->i", pairs.information[edges], left)
    total = pairs.information[edges].sum(0)
    mixed = np.eye(3) + common.covariance_mm2 @ total
    gained = pull @ np.linalg.solve(mixed, common.covariance_mm2 @ pull) / 2
    own = pairs.scores(common.shift_mm)[edges].sum()
    return float(own + gained - np.log(np.linalg.det(mixed)) / 2)


def alternatives(
    options: Sequence[Sequence[tuple[int, float]]], within_log_ratio: float
) -> list[tuple[tuple[int, ...], float]]:
    """Every way to give each row one of its (column, score) options or none, near the best.

    Depth-first branch and bound; the columns of each row (-1: none) and the total score.
    """
    ordered = [sorted(o, key=lambda item: -item[1]) for o in options]
    bound = np.cumsum([max([0.0, *(s for _, s in o)]) for o in ordered[::-1]])[::-1].tolist() + [0]
    found: list[tuple[tuple[int, ...], float]] = []
    best, nodes = -np.inf, 0
    stack: list[tuple[tuple[int, ...], float]] = [((), 0.0)]
    while stack and nodes < _MAX_NODES:
        taken, score = stack.pop()
        nodes += 1
        depth = len(taken)
        if score + bound[depth] < best - within_log_ratio:
            continue
        if depth == len(ordered):
            best = max(best, score)
            found.append((taken, score))
            continue
        stack.append(((*taken, -1), score))
        free = [(c, s) for c, s in ordered[depth] if c not in taken]
        stack.extend(((*taken, c), score + s) for c, s in reversed(free))
    return [(taken, score) for taken, score in found if score >= best - within_log_ratio]


@dataclass(frozen=True)
class Projected:
    """Hold K points as projected into one camera.

    uv_px : (K, 2) pixels.
    by_point : (K, 2, 3) derivatives of the pixels by the point, in px/mm.
    covariance_px2 : (K, 2, 2) covariances of the pixels that follow from those of the points.
    """

    uv_px: Array
    by_point: Array
    covariance_px2: Array


def projected(camera: Camera, points_mm: Array, covariance_mm2: Array) -> Projected:
    """Return K points of the rig frame (K, 3) with covariances (K, 3, 3), projected into a
    camera.
    """
    uv, by_point = stacked_jacobian((camera,), points_mm)
    return Projected(uv, by_point, by_point @ covariance_mm2 @ np.swapaxes(by_point, -1, -2))


def px_per_mm(by_point: Array) -> Array:
    """Return the scale (K,) in px/mm across the line of sight.

    by_point : (K, 2, 3) derivatives of the pixels by the point, in px/mm.
    """
    return np.asarray(np.linalg.det(by_point @ np.swapaxes(by_point, -1, -2)) ** 0.25)


def pair_pixels(
    expected: Projected,
    uv_px: Array,
    covariance_px2: Array,
    settings: TrackerSettings,
    *,
    size_score: ArrayLike = 0.0,
    allowed: ArrayLike = True,
) -> list[int]:
    """For each expected track the detection that continues it, -1 for none or with a rival.

    uv_px (L, 2), covariance_px2 (L, 2, 2) : the detections.
    size_score, allowed : (K, L) or less, log-likelihood ratio of the sizes, and pairings to try.
    """
    between = uv_px[None] - expected.uv_px[:, None]
    covariance = expected.covariance_px2[:, None] + covariance_px2[None]
    distance2 = np.einsum("kli,klij,klj->kl", between, np.linalg.inv(covariance), between)
    row, column = np.nonzero((distance2 <= gate2(settings, 2)) & allowed)
    seen = settings.detection_probability
    base = np.log(seen / (1 - seen) / settings.new_per_px2) - np.log(2 * np.pi)
    ratio = base - np.log(np.linalg.det(covariance)) / 2 - distance2 / 2 + size_score
    score = ratio[row, column]
    chosen = best_assignment(len(between), row, column, score)
    safe = unrivalled(row, column, score, chosen, settings.margin_log_ratio)
    return [int(c) if ok else -1 for c, ok in zip(chosen, safe)]


def update_pixels(
    track: Track, uv_px: Array, covariance_px2: Array, expected_px: Array, by_point: Array
) -> None:
    """filterpy's update with a pixel (2,), linearised where the track is expected."""
    h = np.zeros((2, len(track.filter.x)))
    h[:, POSITION] = by_point
    linear = uv_px - expected_px + h @ track.filter.x
    track.filter.update(linear.reshape(-1), R=covariance_px2, H=h)
