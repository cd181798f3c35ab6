"""Finds which detections of all cameras show the same bubble: groups of at most one of each.

A group's log odds say how much better "one bubble" explains its detections than "each by itself".
Those of two detections are in `matching`. A larger group is grown from pairs that agree. Its
evidence is the density of its pixels' deviations from those of one point, of which n views have
2 n - 3 dimensions, against pixels anywhere in the images, and the mean of its pairs' evidence by
size and contrast over all trees that connect the views. The best set of disjoint groups is then
exact, and each group has a posterior probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtrc, chdtri

from telerig.arrays import Array, Bools, Ints, Rows
from telerig.estimator.bubbles.outline.ellipse_geometry import (
    CENTRE_COLUMNS,
    centre_covariances,
    columns,
)
from telerig.estimator.bubbles.pairing.evidence import (
    DETECTION_PROBABILITY,
    Prediction,
    evidence,
)
from telerig.estimator.bubbles.pairing.matching import (
    NEGLIGIBLE,
    Cameras,
    PairGeometry,
    PairModel,
    View,
    appearance_log_odds,
    bias_basis,
    near_pairs,
    prior_log_odds,
    shared_axis,
    unbiased,
    view_of,
)
from telerig.rig.camera import Camera
from telerig.rig.triangulation import UNKNOWN_MM, on_rays, stacked_jacobian, triangulate_views

SAFE_LOG_ODDS = 3.0
"""Posterior log odds (20 to 1) below which a group is ambiguous."""

_NEW_SHARE = 0.1
"""Share of the bubbles of a frame that no track expects."""

_SILHOUETTE_SIZE_SD = 0.1
"""Relative standard deviation of a silhouette's mean diameter about the body's diameter."""

Pixels = tuple[Array, Array]
"""Centres (N, 2) and covariances (N, 2, 2) of the N detections of one camera."""


@dataclass(frozen=True)
class RigModel:
    """Describe how the images of one bubble agree in C cameras; `learn_rig` learns it from a run.

    pairs : the model of each pair of cameras (indices, in ascending order) whose lines of sight are
        not parallel.
    offset_px : (2 C, B) systematic deviations of u and v of each camera from the pixels of a common
        point, as coefficients of `bias_basis`. A part that a shift of all points explains has no
        effect. Pairs have their own bias instead.
    origin_mm, reach_mm : (3,) for `bias_basis`.
    misplaced : if one camera's images lie elsewhere than the calibration says, beyond chance and
        half a pixel: its index, and by how much in u and v (px).
    """

    cameras: tuple[Camera, ...]
    pairs: dict[tuple[int, int], PairModel]
    offset_px: Array
    origin_mm: Array
    reach_mm: Array
    misplaced: tuple[int, float, float] | None = None

    @staticmethod
    def of(cameras: Sequence[Camera], pairs: dict[tuple[int, int], PairModel]) -> RigModel:
        """Return a model without offsets of larger groups."""
        one = next(iter(pairs.values()))
        none = np.zeros((2 * len(cameras), 1))
        return RigModel(tuple(cameras), pairs, none, one.origin_mm, one.reach_mm)

    def offset(self, points_mm: Array) -> Array:
        """Return the systematic deviations (..., C, 2) in px at points (..., 3)."""
        terms = bias_basis(points_mm, self.origin_mm, self.reach_mm, self.offset_px.shape[1])
        shape = (*points_mm.shape[:-1], len(self.cameras), 2)
        return np.asarray(terms @ self.offset_px.T).reshape(shape)

    def mean(self, name: str, camera: int | None = None) -> float:
        """Return the RMS over the pairs (of a camera) of a field of their models."""
        values = [getattr(m, name) for p, m in self.pairs.items() if camera is None or camera in p]
        return float(np.sqrt(np.mean(np.square(values))))

    def unmatched_share(self, camera: int) -> float:
        """Return the mean share of a camera's detections without a partner in another camera."""
        shares = [m.unmatched_share[p.index(camera)] for p, m in self.pairs.items() if camera in p]
        return float(np.mean(shares))

    def volume_mm3(self, a: int, b: int) -> float:
        """Return the volume that a pair of cameras sees."""
        span = self.pairs[a, b].span_px / self.cameras[a]["scale_px_per_mm"]
        widths = [min(c.image_size_px) / c["scale_px_per_mm"] for c in self.cameras]
        return widths[a] * widths[b] * span

    @property
    def areas_px2(self) -> Array:
        """Return the areas (C,) of the images."""
        return np.array([float(np.prod(c.image_size_px)) for c in self.cameras])


@dataclass(frozen=True)
class Places(Rows):
    """Points of G groups of detections in C cameras.

    points_mm, covariance_mm2 : (G, 3), (G, 3, 3) triangulated from all detections of a group.
    expected_px : (G, C, 2) pixels of the points, also where a camera has no detection.
    left_px : (G, C, 2) measured pixels less those of the points; NaN without a detection.
    by_point : (G, C, 2, 3) derivatives of the pixels by the points.
    """

    points_mm: Array
    covariance_mm2: Array
    expected_px: Array
    left_px: Array
    by_point: Array


def places_of(cameras: Sequence[Camera], pixels: Sequence[Pixels], rows: Ints) -> Places:
    """Triangulate groups of detections.

    pixels : of all detections of each camera. rows : (G, C) their rows, -1 for none.
    """
    seen = rows >= 0
    uv = np.full((*rows.shape, 2), np.nan)
    noise = np.tile(np.eye(2), (*rows.shape, 1, 1))
    for c, (centre, covariance) in enumerate(pixels):
        mine = seen[:, c]
        uv[mine, c], noise[mine, c] = centre[rows[mine, c]], covariance[rows[mine, c]]
    count = range(len(cameras))
    found = triangulate_views(
        tuple(cameras), [uv[:, c] for c in count], tuple(noise[:, c] for c in count)
    )
    expected, by_point = stacked_jacobian(tuple(cameras), found.points_mm)
    expected = expected.reshape(uv.shape)
    return Places(
        found.points_mm, found.covariance_mm2, expected, uv - expected,
        by_point.reshape(*uv.shape, 3),
    )  # fmt: skip


@dataclass(frozen=True)
class Groups(Rows):
    """G possible groups of the detections of one frame, or of several; C cameras.

    rows : (G, C) row of the detection of each camera, -1 for none.
    pair : (G,) which pair of the model's cameras it is; -1 for more than two detections.
    appearance : (G,) log odds from everything but the gaps, the positions and the tracks.
    gap_px, variance_px2 : (G,) gaps of pairs less the model's bias, and their variances.
    log_radius : (G,) mean logarithm of the radius in all views (mm); NaN if unknown.
    places : the points, triangulated.
    noise_px2 : (G, C, 2, 2) covariances of the pixels, with the scatter of true groups.
    """

    rows: Ints
    pair: Ints
    appearance: Array
    gap_px: Array
    variance_px2: Array
    log_radius: Array
    places: Places
    noise_px2: Array

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Candidates:
    """The possible groups of one frame, and all its detections by camera.

    rays : of each camera points (N, 3) and covariances (N, 3, 3) of its detections (`on_rays`).
    """

    rays: tuple[Pixels, ...]
    groups: Groups

    def __len__(self) -> int:
        return len(self.groups)


@dataclass(frozen=True)
class Matches:
    """Hold the M groups of one frame that are the most probable ones as a whole.

    candidate : (M,) positions of the groups among the frame's `Candidates`.
    rows : (M, C) row in the table of each camera, -1 for none.
    confidence : (M,) posterior probability of the group.
    ambiguous : (M,) whether the group's posterior log odds are below ``SAFE_LOG_ODDS``.
    """

    candidate: Ints
    rows: Ints
    confidence: Array
    ambiguous: Bools

    def __len__(self) -> int:
        return len(self.candidate)


def candidates_of(
    frames: Sequence[Sequence[pd.DataFrame]], model: RigModel, unsure_px: float = 0.0
) -> tuple[list[pd.DataFrame], Ints, list[Candidates]]:
    """Return the detections of all frames by camera, their numbers (F, C), and `candidates`.

    frames : for each frame the tables of `detect_bubbles` for all cameras.

    Raises InputError for tables without centres or covariances.
    """
    tables = [pd.concat(own, ignore_index=True) for own in zip(*frames)]
    pixels = [(columns(t, CENTRE_COLUMNS), centre_covariances(t)) for t in tables]
    counts = np.array([[len(table) for table in one] for one in frames])
    return tables, counts, candidates(tables, pixels, counts, model, unsure_px)


def candidates(
    tables: Sequence[pd.DataFrame],
    pixels: Sequence[Pixels],
    counts: Ints,
    model: RigModel,
    unsure_px: float = 0.0,
    barred: Sequence[Bools] | None = None,
) -> list[Candidates]:
    """Return the possible groups of F frames.

    tables, pixels : of all detections of each camera, which follow each other frame by frame.
    counts : (F, C) number of detections in each frame and camera.
    unsure_px : standard deviation of the model's offsets.
    barred : for each camera, which detections take part in no group; None for none.

    A gap may be twice as large as that of a pair, because all gaps of a frame shift together.
    """
    views: dict[int, View] = {}
    edges: list[_Edges] = []
    for k, (a, b) in enumerate(model.pairs):
        cameras = model.cameras[a], model.cameras[b]
        axis = shared_axis(cameras)
        both = view_of(tables[a], cameras[0], axis), view_of(tables[b], cameras[1], axis)
        views |= {c: v for c, v in zip((a, b), both) if c not in views}
        own = _edges(k, cameras, both, counts[:, [a, b]], model)
        if barred is not None:
            own = own.take(~(barred[a][own.rows[:, 0]] | barred[b][own.rows[:, 1]]))
        edges.append(own)
    starts = np.cumsum(counts, axis=0) - counts
    groups, frame = _grown(edges, pixels, views, counts, model, unsure_px)
    order = np.argsort(frame, kind="stable")
    groups, frame = groups.take(order), frame[order]
    groups.rows[:] = np.where(groups.rows >= 0, groups.rows - starts[frame], -1)
    cuts = np.searchsorted(frame, np.arange(len(counts) + 1)).tolist()
    rays = [_rays(model, c, views[c]) for c in range(len(model.cameras))]
    of_frame = [
        tuple((x[s : s + n], p[s : s + n]) for (x, p), s, n in zip(rays, first, many))
        for first, many in zip(starts.tolist(), counts.tolist())
    ]
    return [
        Candidates(own, groups.take(slice(low, high)))
        for own, (low, high) in zip(of_frame, pairwise(cuts))
    ]


def _rays(model: RigModel, c: int, view: View) -> Pixels:
    """Return the detections of a camera as points of unknown depth, with all errors of the model
    that they do not share with tracks."""
    bias = [m.bias_px[0] for pair, m in model.pairs.items() if c in pair]
    common = model.mean("scatter_px", c) ** 2 + model.mean("frame_px", c) ** 2
    common += float(np.mean(np.square(bias))) / 4
    points, covariances, _ = on_rays(
        model.cameras[c], view.uv_px, view.covariance_px2 + common * np.eye(2)
    )
    return points, covariances


@dataclass(frozen=True)
class _Edges(Rows):
    """E candidate pairs of two cameras; fields as in `Groups`.

    rows : (E, 2) among all detections of both cameras, ascending by the first.
    alike : (E,) log odds by size and contrast alone; prior : (E,) those of the frame.
    """

    pair: Ints
    frame: Ints
    rows: Ints
    alike: Array
    prior: Array
    gap_px: Array
    variance_px2: Array
    log_radius: Array


def _edges(
    k: int, cameras: Cameras, views: tuple[View, View], counts: Ints, model: RigModel
) -> _Edges:
    """Return the candidate pairs of F frames.

    counts : (F, 2) detections of the frames in both views.
    """
    from telerig.estimator.bubbles.pairing import kernels

    own = list(model.pairs.values())[k]

    def near(every: PairGeometry) -> Bools:
        gap, variance = unbiased(every, own)
        wide = variance + own.frame_px**2 + kernels.MOST_TAIL_PX2
        return np.asarray(gap**2 < 4 * kernels.GAP_GATE2 * wide)

    pairs, rows, frame = near_pairs(cameras, views, counts, near)
    return _Edges(
        np.full(len(rows), k), frame, rows, appearance_log_odds(pairs, own),
        prior_log_odds(counts[frame], own.unmatched_share), *unbiased(pairs, own),
        0.25 * pairs.size_sum.sum(-1),
    )  # fmt: skip


def _grown(
    edges: list[_Edges],
    pixels: Sequence[Pixels],
    views: dict[int, View],
    counts: Ints,
    model: RigModel,
    unsure_px: float,
) -> tuple[Groups, Ints]:
    """Return all groups that the candidate pairs form, with rows among all detections, and the
    frame of each."""
    pairs, every = list(model.pairs), _Edges.concat(edges)
    size = len(model.cameras)
    own = np.array(pairs)[every.pair]
    rows = np.full((len(own), size), -1)
    np.put_along_axis(rows, own, every.rows, 1)
    likely = [e.take(e.alike + e.prior > 2 * NEGLIGIBLE) for e in edges]
    used = np.full((len(rows), len(pairs)), -1)
    used[np.arange(len(rows)), every.pair] = np.arange(len(rows))
    first = np.cumsum([0, *map(len, (e.frame for e in edges))])
    place = [f + np.flatnonzero(e.alike + e.prior > 2 * NEGLIGIBLE) for f, e in zip(first, edges)]
    members, links = [rows], [used]
    places, frame = [places_of(model.cameras, pixels, rows)], [every.frame]
    noise = [_noise(model, pixels, views, rows)]
    for c in range(1, size) if size > 2 else ():
        base, chain = np.concatenate(members), np.concatenate(links)
        ends = _may_grow(base, c, pairs)
        grown, own_links = _extended(base[ends], chain[ends], c, pairs, likely, place)
        at = places_of(model.cameras, pixels, grown)
        spread = _noise(model, pixels, views, grown)
        near = deviation(at, spread, model, model.mean("frame_px") ** 2 / 2 + unsure_px**2)[3]
        members.append(grown[near])
        links.append(own_links[near])
        places.append(at.take(near))
        noise.append(spread[near])
        frame.append(every.frame[own_links[near].max(1)])
    rows, used, of_frame = (np.concatenate(parts) for parts in (members, links, frame))
    at, spread = Places.concat(places), np.concatenate(noise)
    total = (rows >= 0).sum(1)
    known = used >= 0

    def mean(values: Array) -> Array:
        """Over a group's pairs."""
        return np.asarray(np.where(known, values[used], 0.0).sum(1) / known.sum(1))

    alike = mean(every.alike) * np.where(total > 2, total - 1, 1)
    prior = np.where(total > 2, 0.0, every.prior[used.max(1)])
    if size > 2:
        prior = _prior(rows, prior, at, counts[of_frame], model)
    two = total == 2
    of_pair = np.where(two, used.max(1), 0)
    blank = np.where(two, 0.0, np.nan)
    return Groups(
        rows, np.where(two, every.pair[of_pair], -1), alike + prior,
        every.gap_px[of_pair] + blank, every.variance_px2[of_pair] + blank,
        mean(every.log_radius), at, spread,
    ), of_frame  # fmt: skip


def _may_grow(rows: Ints, c: int, pairs: Sequence[tuple[int, int]]) -> Bools:
    """Return which groups (G, C) get one more detection, of camera c, so that each larger group
    grows once: those of earlier cameras, and a pair with a later one of which the earlier one looks
    along the same line as c."""
    many, last, first = (rows >= 0).sum(1), (rows[:, c:] >= 0).any(1), (rows[:, :c] >= 0).sum(1)
    blind = np.array([(a, c) not in pairs for a in range(c)] + [False] * (rows.shape[1] - c))
    lost = ((rows >= 0) & blind).any(1) & (rows[:, c] < 0)
    return np.asarray(~last | ((many == 2) & (first == 1) & lost))


def _extended(
    base: Ints,
    chain: Ints,
    c: int,
    pairs: Sequence[tuple[int, int]],
    likely: Sequence[_Edges],
    place: Sequence[Ints],
) -> tuple[Ints, Ints]:
    """Return the groups (G, C) that have one more detection, of camera c, than ``base`` (N, C), and
    their pairs (G, P) among all, -1 where cameras are parallel.

    chain : (N, P) pairs of the groups. All pairs with the new detection have to be likely.
    """
    grown, links = [base[:0]], [chain[:0]]
    with_c = [(k, sum(pair) - c, pair.index(c)) for k, pair in enumerate(pairs) if c in pair]
    anchor = np.full(len(base), -1)
    for k, a, _ in with_c:
        anchor[base[:, a] >= 0] = k
    for k, a, column in with_c:
        mine = np.flatnonzero(anchor == k)
        order = np.argsort(likely[k].rows[:, 1 - column], kind="stable")
        known = likely[k].rows[order, 1 - column]
        low = np.searchsorted(known, base[mine, a])
        many = np.searchsorted(known, base[mine, a], "right") - low
        edge = order[np.arange(many.sum()) - np.repeat(np.cumsum(many) - many - low, many)]
        new, own = base[np.repeat(mine, many)], chain[np.repeat(mine, many)]
        new[:, c], own[:, k] = likely[k].rows[edge, column], place[k][edge]
        good = np.ones(len(new), bool)
        for other, o, _ in with_c:
            if other != k:
                found = _lookup(likely[other].rows, new[:, list(pairs[other])])
                own[:, other] = np.append(place[other], -1)[found]
                good &= (found >= 0) | (new[:, o] < 0)
        grown.append(new[good])
        links.append(own[good])
    return np.concatenate(grown), np.concatenate(links)


def _lookup(rows: Ints, wanted: Ints) -> Ints:
    """Return where pairs of rows (N, 2) stand among others (E, 2), -1 for nowhere."""
    if not len(rows):
        return np.full(len(wanted), -1)
    base = max(int(rows.max(initial=0)), int(wanted.max(initial=0))) + 2
    keys, asked = (values @ [base, 1] for values in (rows, wanted))
    order = np.argsort(keys, kind="stable")
    at = order[np.minimum(np.searchsorted(keys[order], asked), len(keys) - 1)]
    return np.where((keys[at] == asked) & (wanted >= 0).all(1), at, -1)


def _noise(model: RigModel, pixels: Sequence[Pixels], views: dict[int, View], rows: Ints) -> Array:
    """Return the covariances (G, C, 2, 2) of the groups' pixels."""
    out = np.zeros((*rows.shape, 2, 2))
    for c, (_, covariance) in enumerate(pixels):
        mine, at = rows[:, c] >= 0, rows[rows[:, c] >= 0, c]
        scatter = model.mean("scatter_px", c) * views[c].scatter_factor[at]
        # of the difference between two views
        out[mine, c] = covariance[at] + scatter[:, None, None] ** 2 / 2 * np.eye(2)
    return out


def _prior(rows: Ints, of_pairs: Array, at: Places, counts: Ints, model: RigModel) -> Array:
    """Return the prior log odds (G,) of groups: how many bubbles the same cameras see alone, over
    how many of their detections have no partner. A camera whose image shows the place should see
    the bubble as well.

    of_pairs : (G,) as two cameras alone have them. counts : (G, C) detections of the frame.
    """
    unmatched = np.array([model.unmatched_share(c) for c in range(len(model.cameras))])
    seen = rows >= 0
    alone = np.log(np.maximum(counts * unmatched, 1e-3))
    there = np.log(np.maximum(counts * (1 - unmatched), 1e-3))
    larger = (np.where(seen, there, 0).sum(1) / seen.sum(1)) - np.where(seen, alone, 0).sum(1)
    limit = np.array([c.image_size_px for c in model.cameras]) - 1.0
    inside = ((at.expected_px >= 0) & (at.expected_px <= limit)).all(-1)
    missed = (inside & ~seen).sum(1)
    found = np.where(seen.sum(1) > 2, larger, of_pairs) + missed * np.log(
        1 / DETECTION_PROBABILITY - 1
    )
    return np.asarray(found)


def deviation(
    at: Places, noise_px2: Array, model: RigModel, unsure_px2: float, shift_px: Any = 0.0
) -> tuple[Array, Array, Array, Bools, Array]:
    """Compare the pixels of G groups with those of one point each.

    unsure_px2 : variance of an unknown shift of each camera. shift_px : (C, 2) known shift.

    Returns chi-square (G,) with 2 n - 3 degrees of freedom, its information about shifts of the
    cameras (G, 2 C, 2 C), the pull of that (G, 2 C), whether the deviation is possible (G,), and
    the log odds (G,) of the pixels being those of one point.
    """
    from telerig.estimator.bubbles.pairing import kernels

    seen = np.asarray(np.isfinite(at.left_px).all(-1))
    count = seen.sum(1)
    left = np.where(seen[..., None], at.left_px - model.offset(at.points_mm) - shift_px, 0.0)
    noise = noise_px2 + (unsure_px2 + ~seen)[..., None, None] * np.eye(2)
    weight = np.linalg.inv(noise) * seen[..., None, None]
    weighted = weight @ at.by_point
    information = (np.swapaxes(at.by_point, -1, -2) @ weighted).sum(1)
    size = 2 * left.shape[1]
    flat, pixels = weighted.reshape(-1, size, 3), left.reshape(-1, size)
    own = np.zeros((len(left), size, size))
    for c in range(left.shape[1]):
        own[:, 2 * c : 2 * c + 2, 2 * c : 2 * c + 2] = weight[:, c]
    own -= flat @ np.linalg.solve(information, np.swapaxes(flat, -1, -2))
    pull = (own @ pixels[..., None])[..., 0]
    chi2 = (pull * pixels).sum(1)
    free = 2 * count - 3
    typical = (np.trace(noise, axis1=-2, axis2=-1) * seen).sum(1) / (2 * count)
    wide = 1 + np.clip(3 * typical, kernels.LEAST_TAIL_PX2, kernels.MOST_TAIL_PX2) / typical
    possible = chi2 < wide * chdtri(free, chdtrc(1, kernels.GAP_GATE2))
    core = (1 - kernels.TAIL) * np.exp(-chi2 / 2)
    tail = kernels.TAIL * wide ** (-free / 2) * np.exp(-chi2 / wide / 2)
    determinants = np.where(seen, np.log(np.linalg.det(noise)), 0.0).sum(1)
    determinants += np.log(np.linalg.det(information)) + free * np.log(2 * np.pi)
    pairs = list(model.pairs)
    a, b = pairs[0]
    sine = np.linalg.norm(np.cross(*(model.cameras[c].camera_from_rig.rotation[2] for c in (a, b))))
    areas = np.where(seen, np.log(model.areas_px2), 0.0).sum(1)
    span = model.pairs[a, b].span_px
    scale = model.cameras[a]["scale_px_per_mm"]
    volume = np.log(model.areas_px2[[a, b]].prod() / span / scale**3 / sine)
    odds = np.log(np.maximum(core + tail, 1e-300)) - determinants / 2 + areas - volume
    return chi2, own, pull, np.asarray(possible), np.where(possible, odds, kernels.NEVER)


def match(found: Candidates, model: RigModel, predicted: Prediction | None = None) -> Matches:
    """Find the most probable groups among the possible ones of a frame.

    predicted : where tracks are expected; None if there are no tracks.
    """
    from telerig.estimator.bubbles.pairing import kernels

    groups = found.groups
    counts = np.array([len(points) for points, _ in found.rays])
    odds = groups.appearance
    if predicted is not None and len(predicted.ids) and len(found):
        odds = odds + track_log_odds(found, model, predicted)
    total = odds.copy()
    for k, ((a, b), own) in enumerate(model.pairs.items()):
        mine = np.flatnonzero(groups.pair == k)
        total[mine], _, _ = kernels.common_shift(
            groups.gap_px[mine], groups.variance_px2[mine], odds[mine],
            np.ascontiguousarray(groups.rows[mine][:, [a, b]]), counts[[a, b]],
            own.frame_px, own.span_px, NEGLIGIBLE,
        )  # fmt: skip
    larger = np.flatnonzero(groups.pair < 0)
    if len(larger):
        total[larger] = _larger(groups.take(larger), odds[larger], counts, model)
    chosen = best_groups(total, groups.rows)
    confidence = kernels.marginals(total, groups.rows, counts, NEGLIGIBLE)[chosen]
    ambiguous = confidence < (1 - confidence) * np.exp(SAFE_LOG_ODDS)
    return Matches(chosen, groups.rows[chosen], confidence, ambiguous)


def _larger(groups: Groups, odds: Array, counts: Ints, model: RigModel) -> Array:
    """Return the log odds (G,) of groups of more than two, with the shifts that all groups of the
    frame share; odds : without the positions."""
    from telerig.estimator.bubbles.pairing import kernels

    prior = model.mean("frame_px") ** 2 / 2
    shift, unsure = np.zeros((len(model.cameras), 2)), prior
    passes = kernels.SHIFT_PASSES if prior > 0 else 0
    for last in range(passes + 1):
        chi2, own, pull, _, position = deviation(
            groups.places, groups.noise_px2, model, unsure, shift
        )
        total = odds + position
        if last == passes:
            break
        free = 2.0 * (groups.rows >= 0).sum(1) - 3
        weight = kernels.marginals(total, groups.rows, counts, NEGLIGIBLE) / (1 + chi2 / free / 4)
        matrix = np.eye(own.shape[1]) / prior + np.einsum("g,gij->ij", weight, own)
        right = weight @ pull + np.einsum("g,gij,j->i", weight, own, shift.ravel())
        shift = np.linalg.solve(matrix, right).reshape(shift.shape)
        known = (weight * np.trace(own, axis1=1, axis2=2) / free).sum()
        unsure = 1 / (1 / prior + known)
    return total


def best_groups(log_odds: Array, rows: Ints) -> Ints:
    """Find the most probable set of disjoint groups.

    log_odds : (G,) log odds of the groups. rows : (G, C) their detections, -1 for none.

    Returns the positions of the groups of the set. Of two cameras they are ordered by the rows of
    the first.
    """
    good = np.flatnonzero(log_odds > 0)
    if not len(good):
        return good
    if rows.shape[1] == 2:
        from scipy.optimize import linear_sum_assignment

        gain = np.zeros(rows[good].max(0) + 1)
        where = np.full(gain.shape, -1)
        gain[tuple(rows[good].T)], where[tuple(rows[good].T)] = log_odds[good], good
        found = where[linear_sum_assignment(gain, maximize=True)]
        return np.asarray(found[found >= 0])
    return np.sort(_packed(log_odds, rows, good))


def _packed(log_odds: Array, rows: Ints, good: Ints) -> Ints:
    """Return the best set of disjoint groups among ``good``.

    A group that no other one contests belongs to it; the rest is a set packing, solved by SciPy's
    mixed-integer solver.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import coo_array

    wide = np.cumsum([0, *(rows.max(0) + 1)])
    group, camera = np.nonzero(rows[good] >= 0)
    used = rows[good][group, camera] + wide[camera]
    contested = np.zeros(len(good), bool)
    contested[group[np.bincount(used)[used] > 1]] = True
    if not contested.any():
        return good
    shape = (int(wide[-1]), len(good))
    packing = LinearConstraint(coo_array((np.ones(len(used)), (used, group)), shape), ub=1.0)
    found = milp(
        -log_odds[good], integrality=contested.astype(int), bounds=Bounds(0, 1), constraints=packing
    )
    return np.asarray(good[found.x > 0.5])


def track_log_odds(found: Candidates, model: RigModel, predicted: Prediction) -> Array:
    """Return the log odds (G,) that the predicted tracks add.

    Without tracks groups lie anywhere in the volume that the cameras see. With them most lie where
    a track is expected, and so do the detections of bubbles that only one camera found; one track
    cannot be the unmatched detection of two cameras.
    """
    groups, at = found.groups, found.groups.places
    scales = np.array([camera["scale_px_per_mm"] for camera in model.cameras])
    blur_px2 = model.mean("scatter_px") ** 2 + model.mean("frame_px") ** 2
    blurred = at.covariance_mm2 + blur_px2 / np.mean(scales) ** 2 * np.eye(3)
    ends = np.cumsum([len(groups), *(len(points) for points, _ in found.rays)])
    sizes = np.full(ends[-1], np.nan)
    sizes[: len(groups)] = 2 * np.exp(groups.log_radius)
    near = evidence(
        predicted,
        np.concatenate([at.points_mm, *(points for points, _ in found.rays)]),
        np.concatenate([blurred, *(covariances for _, covariances in found.rays)]),
        sizes,
        size_sd=_SILHOUETTE_SIZE_SD,
    )
    every = np.zeros((ends[-1], len(predicted.ids)))
    every[near.column, near.row] = np.exp(near.scores(np.zeros(3)))
    density, *of_rays, _ = np.split(every, ends)
    volumes = np.array([model.volume_mm3(*pair) for pair in model.pairs])
    volume = np.where(groups.pair >= 0, volumes[groups.pair], volumes.mean())
    expected = (1 - _NEW_SHARE) * DETECTION_PROBABILITY**2 * volume * density.mean(1)
    total = np.log(expected + _NEW_SHARE)
    depths = model.areas_px2 / scales**2 * np.sqrt(2 * np.pi) * UNKNOWN_MM
    alone = []
    for c, own in enumerate(of_rays):
        usual = max(len(own) * model.unmatched_share(c), 1e-3)
        relative = DETECTION_PROBABILITY * (1 - DETECTION_PROBABILITY) * depths[c] / usual
        none = np.zeros((1, own.shape[1]))
        alone.append(np.concatenate([relative * own, none])[groups.rows[:, c]])
    sums = [1 + one.sum(1) for one in alone]
    for c, one in enumerate(alone):
        total -= np.log(sums[c])
        for d in range(c):
            both = (one * alone[d]).sum(1) / (sums[c] * sums[d])
            total -= np.log1p(-both)
    return np.asarray(total)
