"""Links the measurements of one frame to tracks, and keeps several hypotheses where pairings
conflict.

A pairing's score is its log-likelihood ratio against "the track was missed and the measurement is
new": log P_D / (1 - P_D) + log N(innovation) - log(density of new ones) + log ratio of the sizes.
It is the same for points that several cameras see, for what one camera alone sees (a point whose
depth is unknown), and for predictions from smoothed tracks.

Tracks that compete for measurements form a cluster; each of its branches is one way to continue
all of them, with its log weight relative to the best. Branches with the same recent pairings are
merged (weights added, the better past kept), improbable ones dropped. A track on which all
branches agree leaves the cluster. When the window is over, the best branch is taken if the
runner-up is far enough behind; else the tracks that differ are broken.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.bubbles.pairing.evidence import (
    DETECTION_PROBABILITY,
    Evidence,
    Prediction,
    evidence,
    gate2,
)
from telerig.estimator.tracking.filter import (
    NO_PARTICLE,
    POSITION,
    Common,
    FrameMeasurements,
    Track,
    TrackerSettings,
    update_tracks,
)
from telerig.estimator.tracking.ranked_ways import alternatives

_SHIFT_ROUNDS = 5
"""Largest number of assignments and common shifts in turn."""

_JOINTLY_SCORED = 10
"""For each hypothesis that is kept, so many ways to continue are scored with the common shift."""

_CERTAIN = 1e12
"""Score of a pairing by an id that came with the data."""


def expected(tracks: Sequence[Track]) -> Prediction:
    """Return where tracks are expected, without the error that all bubbles have in common."""
    ids = np.array([t.particle for t in tracks], np.int64)
    points = np.array([t.x[POSITION] for t in tracks]).reshape(-1, 3)
    spread = np.array([t.p[POSITION, POSITION] for t in tracks]).reshape(-1, 3, 3)
    return Prediction(ids, points, spread, np.array([t.d_eq_mm for t in tracks], float))


def gated_pairs(
    predicted: Prediction,
    measured: FrameMeasurements,
    allowed: Bools,
    common: Common,
    settings: TrackerSettings,
    misses: Ints | None = None,
) -> Evidence:
    """Return the pairings of tracks with measurements inside the gate, for an unknown common shift.

    allowed : (K, M) which pairings may be made; those with a measurement whose id came with the
        data are certain.
    misses : (K,) number of frames for which each track has not been seen; None for 0.
    """
    given = measured.particle != NO_PARTICLE
    pairs = evidence(
        predicted, measured.points_mm, measured.covariance_mm2, measured.d_eq_mm, allowed=allowed,
        certain=given, shift_mm=common.shift_mm, unsure_mm2=common.covariance_mm2,
    )  # fmt: skip
    seen = DETECTION_PROBABILITY
    prior = np.log(np.clip(measured.confidence[pairs.column], 1e-3, 1.0))
    prior += np.log(seen / (1 - seen) / settings.new_per_mm3)
    if misses is not None:
        prior += _alive_score(misses, settings)[pairs.row]
    constant = np.where(given[pairs.column], _CERTAIN, pairs.constant + prior)
    return replace(pairs, constant=constant)


def _alive_score(misses: Ints, settings: TrackerSettings) -> Array:
    """Return the log probability (K,) that a track unseen for so many frames is not gone."""
    missed = (1 - DETECTION_PROBABILITY) * settings.missed_again_probability ** (
        np.maximum(misses, 1) - 1.0
    )
    return -np.log1p(misses * settings.end_probability / missed)


def best_assignment(rows: int, row: Ints, column: Ints, score: Array) -> Ints:
    """Return the assignment with the largest total score: columns (rows,), -1 for none."""
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
    pairs: Evidence, rows: int, best_rows: Bools, common: Common
) -> tuple[Common, Ints]:
    """Return the common shift and the assignment (rows,), estimated in turn.

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


def clear_assignment(
    pairs: Evidence, rows: int, shift_mm: Array, settings: TrackerSettings
) -> tuple[Ints, Bools]:
    """Return the best assignment (rows,), -1 for none, and which rows have a measurement and no
    other pairing of the track or of this measurement that is nearly as likely."""
    row, column, score = pairs.row, pairs.column, pairs.scores(shift_mm)
    chosen = best_assignment(rows, row, column, score)
    clear = chosen >= 0
    for r in np.flatnonzero(clear):
        mine = (row == r) & (column == chosen[r])
        rival = ((row == r) | (column == chosen[r])) & ~mine
        best_rival = np.max(score[rival], initial=-np.inf)
        clear[r] = best_rival < score[mine].max() - settings.margin_log_ratio
    return chosen, clear


def joint_scores(pairs: Evidence, ways: Sequence[Sequence[int]], common: Common) -> Array:
    """Return the joint log-likelihood ratio (W,) of the pairings of each way, marginal over the
    common shift.

    ways : the indices of the pairings of each of the W ways.
    """
    used = np.unique(np.concatenate([np.array(way, int) for way in ways]))
    chosen = np.array([np.isin(used, way) for way in ways], float)
    information = pairs.information[used]
    left = pairs.innovation_mm[used] - common.shift_mm
    pull = chosen @ np.einsum("eij,ej->ei", information, left)
    total = (chosen @ information.reshape(-1, 9)).reshape(-1, 3, 3)
    mixed = np.eye(3) + common.covariance_mm2 @ total
    moved = np.linalg.solve(mixed, (pull @ common.covariance_mm2)[..., None])[..., 0]
    gained = (pull * moved).sum(-1) / 2
    own = chosen @ pairs.scores(common.shift_mm)[used]
    return np.asarray(own + gained - np.log(np.linalg.det(mixed)) / 2)


_MERGE_FRAMES = 2
"""Hypotheses that agree on so many last frames are one."""

Entry = tuple[int, int]
"""A frame, and the column of a track's measurement in it, -1 for none."""

Recent = tuple[tuple[Entry, ...], ...]
"""For each track of a conflict, its last entries."""

History = dict[int, list[Entry]]
"""For each track, by its id, the entries since the conflict began."""


@dataclass
class Branch:
    """Holds one hypothesis about tracks that compete for the same measurements.

    weight : log-likelihood ratio to the best hypothesis, 0 for the best one itself.
    tracks : the tracks as they are under this hypothesis, in the same order in every hypothesis.
    history : the measurements of each track.
    """

    weight: float
    tracks: list[Track]
    history: History = field(default_factory=dict)


@dataclass
class Cluster:
    """Holds a group of tracks that compete for the same measurements (a conflict).

    branches : the hypotheses, best first. A track without competitors forms a group of its own,
        with one hypothesis and no history.
    """

    branches: list[Branch]

    @staticmethod
    def of(track: Track) -> Cluster:
        return Cluster([Branch(0.0, [track])])

    @property
    def tracks(self) -> list[Track]:
        return self.branches[0].tracks

    @property
    def open(self) -> bool:
        return len(self.branches) > 1

    @property
    def since_frame(self) -> int:
        starts = [h[0][0] for h in self.branches[0].history.values() if h]
        return min(starts, default=np.iinfo(np.int64).max)


@dataclass(frozen=True)
class Decided:
    """Hold a track about which a conflict is decided.

    A conflict is a run of frames in which several tracks compete for the same measurements.

    kept : its measurements in the conflict; of a track that is cut those before it is ambiguous.
    new : of a track that is cut, the measurements at the end that unambiguously belong together and
        form a new track, which this one becomes; those in between belong to no track. None for a
        track that goes on.
    """

    track: Track
    kept: list[Entry]
    new: list[Entry] | None = None


def recent(entries: Sequence[Entry], depth: int) -> list[Entry]:
    """Return the last ``depth`` of a track's entries (frame, column) with a measurement."""
    return [e for e in entries if e[1] >= 0][-depth:]


def merged(
    scored: Iterable[tuple[float, Recent, int]], settings: TrackerSettings
) -> list[tuple[float, int]]:
    """Merge hypotheses with equal keys, and leave out improbable ones.

    scored : (log weight, key, index) of each hypothesis.
    Returns (log weight, index of the most probable of the merged ones), best first; the weight of
    the best one is 0. There are ``max_hypotheses`` of them, and those that alone give a track one
    of its measurements.
    """
    groups: dict[Recent, list[tuple[float, int]]] = {}
    for weight, key, index in scored:
        groups.setdefault(key, []).append((weight, index))
    out = []
    for key, members in groups.items():
        weights = np.array([w for w, _ in members])
        top = int(weights.argmax())
        total = weights[top] + np.log(np.exp(weights - weights[top]).sum())
        out.append((float(total), members[top][1], key))
    out.sort(key=lambda item: -item[0])
    best = out[0][0]
    kept, seen = list[tuple[float, int]](), set[tuple[int, Entry]]()
    for weight, index, key in out:
        own = {(track, entry) for track, entries in enumerate(key) for entry in entries}
        if weight < best - settings.prune_log_ratio:
            break
        if len(kept) < settings.max_hypotheses or not own <= seen:
            kept.append((weight - best, index))
            seen |= own
    return kept


def merge_key(histories: Iterable[Sequence[Entry]]) -> Recent:
    """Return the most recent measurements of all tracks of a hypothesis.

    Hypotheses with equal recent measurements are merged.
    """
    return tuple(tuple(h[-_MERGE_FRAMES:]) for h in histories)


def disputed(branches: Sequence[Branch], depth: int) -> set[int]:
    """Return the ids of tracks about whose last measurements the hypotheses disagree.

    Two hypotheses give such a track different measurements, or give one measurement to it and to
    another track. depth : number of last measurements that count.
    """
    columns: dict[tuple[int, int], set[int]] = {}
    claims: dict[tuple[int, int], set[int]] = {}
    for branch in branches:
        for particle, entries in branch.history.items():
            for frame, column in recent(entries, depth):
                columns.setdefault((particle, frame), set()).add(column)
                claims.setdefault((frame, column), set()).add(particle)
    out = {particle for (particle, _), found in columns.items() if len(found) > 1}
    return out.union(*(found for found in claims.values() if len(found) > 1))


def decide(
    cluster: Cluster, frame: int, settings: TrackerSettings, *, at_once: bool = False
) -> tuple[Cluster | None, list[Decided]]:
    """Decide which tracks of a conflict are safe in this frame; all of them if ``at_once``.

    Returns the tracks that remain undecided, None if there are none, and the others.
    """
    branches, still = cluster.branches, None
    over = at_once or frame - cluster.since_frame + 1 >= settings.window_frames
    open_ids, close = set[int](), branches
    if cluster.open and not over:
        open_ids = disputed(branches, _MERGE_FRAMES)
        still = _remaining(cluster, open_ids, settings)
        open_ids = open_ids if still else set()
    elif cluster.open:
        close = [b for b in branches if b.weight >= -settings.margin_log_ratio]
        open_ids = disputed(close, 1)
    safe = [
        Decided(t, branches[0].history.get(t.particle, []))
        for t in cluster.tracks
        if t.particle not in open_ids
    ]
    if still is not None:
        return still, safe
    return None, safe + _break(close, [t for t in cluster.tracks if t.particle in open_ids])


def _remaining(cluster: Cluster, open_ids: set[int], settings: TrackerSettings) -> Cluster | None:
    if not open_ids:
        return None
    branches = [
        Branch(
            b.weight,
            [t for t in b.tracks if t.particle in open_ids],
            {p: h for p, h in b.history.items() if p in open_ids},
        )
        for b in cluster.branches
    ]
    scored = (
        (b.weight, merge_key([b.history[t.particle] for t in b.tracks]), i)
        for i, b in enumerate(branches)
    )
    out = []
    for weight, index in merged(scored, settings):
        branches[index].weight = weight
        out.append(branches[index])
    return Cluster(out) if len(out) > 1 else None


def _break(close: list[Branch], tracks: list[Track]) -> list[Decided]:
    if not tracks:
        return []
    paths = [[b.history[t.particle] for t in tracks] for b in close]
    start = _agreed_links_from(paths)
    out = []
    for track, best, mine in zip(tracks, paths[0], zip(*paths)):
        same = [len(set(entries)) == 1 for entries in zip(*mine)]
        agreed = best[: same.index(False)] if False in same else best
        kept = [e for e in agreed if e[0] < start]
        out.append(Decided(track, kept, [e for e in best if e[0] >= start and e[1] >= 0]))
    return out


def _agreed_links_from(paths: list[list[list[Entry]]]) -> int:
    """Return the first frame from which all branches tie the same measurements together."""
    frames = sorted({frame for path in paths for h in path for frame, _ in h})
    by_frame = [[dict(h) for h in path] for path in paths]
    start = frames[-1]
    for earlier, later in zip(frames[-2::-1], frames[:0:-1]):
        links = [sorted((h.get(earlier, -1), h.get(later, -1)) for h in path) for path in by_frame]
        if any(link != links[0] for link in links):
            break
        start = earlier
    return start


_SLACK_LOG_RATIO = 6.0
"""What the common shift of a frame may change of the order of hypotheses."""


@dataclass(frozen=True)
class Scan:
    """One frame: its number, its time and its measurements."""

    frame: int
    t_s: float
    measured: FrameMeasurements
    settings: TrackerSettings


class Association:
    """The possible pairings of tracks and measurements in one frame.

    It also holds the shift of all bubbles that follows from the best pairings. A track that has no
    measurement of several cameras in these may have one of a camera alone, if no other pairing of
    them is nearly as likely.
    """

    def __init__(self, clusters: Sequence[Cluster], scan: Scan, common: Common) -> None:
        self.clusters, self.scan, self.prior = clusters, scan, common
        rows = [
            (c, b, t)
            for c, cluster in enumerate(clusters)
            for b, branch in enumerate(cluster.branches)
            for t in branch.tracks
        ]
        self.cluster_of = np.array([c for c, _, _ in rows], int)
        first = np.array([b == 0 for _, b, _ in rows], bool)
        self.row_of = {id(t): i for i, (_, _, t) in enumerate(rows)}
        self.tracks = [t for _, _, t in rows]
        measured, where = scan.measured, expected(self.tracks)
        misses = np.array([t.misses for t in self.tracks], int)
        ids = [t.particle if t.given else NO_PARTICLE for t in self.tracks]
        own = np.array(ids, int)[:, None] == measured.particle
        pairs = gated_pairs(where, measured, own & ~measured.alone, common, scan.settings, misses)
        self.common, chosen = assigned_with_shift(pairs, len(rows), first, common)
        self.picked = np.flatnonzero(first[pairs.row] & (chosen[pairs.row] == pairs.column))
        closed = np.array([not c.open for c in clusters], bool)[self.cluster_of]
        missed = own & measured.alone & (closed & (chosen < 0))[:, None]
        if missed.any():
            alone = gated_pairs(where, measured, missed, self.common, scan.settings, misses)
            best, clear = clear_assignment(alone, len(rows), self.common.shift_mm, scan.settings)
            given = clear[alone.row] & (best[alone.row] == alone.column)
            pairs = Evidence.concat([pairs, alone.take(given)])
        self.pairs = pairs
        self.owner = self.cluster_of[self.pairs.row]
        self.edges = self._allowed()

    def mean_gain(self) -> Array | None:
        """Return the mean Kalman gain (12, 3) of all bubbles that several cameras measure; None if
        there is none."""
        if not len(self.picked):
            return None
        p = np.array([self.tracks[i].p for i in self.pairs.row[self.picked].tolist()])
        gains = p[..., POSITION] @ self.pairs.information[self.picked]
        return np.asarray(gains.mean(0))

    def _allowed(self) -> Ints:
        """Pairings inside their gate, the common shift estimated from the other clusters alone."""
        pairs, owner = self.pairs, self.owner
        information = np.zeros((len(self.clusters), 3, 3))
        np.add.at(information, owner[self.picked], pairs.information[self.picked])
        pull = np.zeros((len(self.clusters), 3))
        left = pairs.innovation_mm - self.prior.shift_mm
        pulls = np.einsum("eij,ej->ei", pairs.information, left)
        np.add.at(pull, owner[self.picked], pulls[self.picked])
        prior = self.prior.covariance_mm2
        others = information.sum(0) - information
        outside = prior @ np.linalg.inv(np.eye(3) + others @ prior)
        shift = np.einsum("cij,cj->ci", outside, pull.sum(0) - pull)[owner]
        total = np.linalg.inv(pairs.covariance_mm2 + outside[owner])
        off = left - shift
        near = np.einsum("ei,eij,ej->e", off, total, off) <= gate2(3)
        return np.flatnonzero(near | (pairs.constant == _CERTAIN))

    def components(self) -> list[tuple[list[int], list[int]]]:
        """Return the groups of tracks that compete for measurements of this frame.

        Each is given by the indices of the earlier groups that it joins, and the indices of its
        pairings.
        """
        owner, columns = self.owner[self.edges].tolist(), self.pairs.column[self.edges].tolist()
        label, first = list(range(len(self.clusters))), dict[int, int]()
        for cluster, column in zip(owner, columns):
            low, high = sorted((label[cluster], label[first.setdefault(column, cluster)]))
            if low != high:
                label = [low if own == high else own for own in label]
        groups: dict[int, tuple[list[int], list[int]]] = {}
        for cluster, group in enumerate(label):
            groups.setdefault(group, ([], []))[0].append(cluster)
        for edge, cluster in zip(self.edges.tolist(), owner):
            groups[label[cluster]][1].append(edge)
        return list(groups.values())

    def outside(self, members: Sequence[int]) -> Common:
        """Return the shift of this frame that all bubbles share, without those of some clusters.

        members : indices of the clusters (bubbles whose pairings compete) to leave out.
        """
        others = self.picked[~np.isin(self.owner[self.picked], members)]
        return self.prior.informed(
            self.pairs.innovation_mm[others], self.pairs.covariance_mm2[others]
        )


def grown(
    found: Association, members: Sequence[int], edges: Sequence[int], mean_gain: Array
) -> list[Branch]:
    """Return the likely ways to continue some groups of tracks together, best first.

    Those with the same recent measurements are merged. The tracks are updated with their
    measurements, and with the shift of all bubbles that follows from them and from the others.

    members : indices of the groups. edges : indices of the pairings that are possible for them.
    mean_gain : (12, 3) mean Kalman gain of the bubbles.
    """
    scan, settings, pairs = found.scan, found.scan.settings, found.pairs
    outside = found.outside(members)
    score = pairs.scores(outside.shift_mm)
    options: dict[int, list[tuple[int, float]]] = {}
    edge_of = {}
    for e in edges:
        row, column = int(pairs.row[e]), int(pairs.column[e])
        options.setdefault(row, []).append((column, float(score[e])))
        edge_of[row, column] = e
    every = _joint([found.clusters[m].branches for m in members], settings.max_hypotheses)
    of_rows = [[found.row_of[id(t)] for b in parents for t in b.tracks] for parents in every]
    start = [sum(b.weight for b in parents) for parents in every]
    tables = [(own, [options.get(r, []) for r in rows]) for own, rows in zip(start, of_rows)]
    within = settings.prune_log_ratio + _SLACK_LOG_RATIO
    ways = alternatives(tables, within, _JOINTLY_SCORED * settings.max_hypotheses)
    used = [[edge_of[at] for at in zip(of_rows[k], taken) if at[1] >= 0] for k, taken, _ in ways]
    joint = joint_scores(pairs, used, outside).tolist()
    raw = []
    for (k, taken, _), score_of in zip(ways, joint):
        before = [(t.particle, b.history.get(t.particle, [])) for b in every[k] for t in b.tracks]
        history = {p: [*old, (scan.frame, c)] for (p, old), c in zip(before, taken)}
        raw.append((start[k] + score_of, history))
    scored = ((weight, merge_key(h.values()), i) for i, (weight, h) in enumerate(raw))
    out = []
    for weight, i in merged(scored, settings):
        (k, taken, _), own = ways[i], used[i]
        common = outside.informed(pairs.innovation_mm[own], pairs.covariance_mm2[own])
        tracks = [t.copy() for b in every[k] for t in b.tracks]
        continue_tracks(tracks, taken, scan, common, mean_gain)
        out.append(Branch(weight, tracks, raw[i][1]))
    return out


def _joint(groups: Sequence[Sequence[Branch]], most: int) -> list[tuple[Branch, ...]]:
    """Return the ``most`` likely joint hypotheses of groups of tracks, one of each group.

    A hypothesis of a group that is in none of them follows with the best ones of the others.
    """
    every: list[tuple[Branch, ...]] = [()]
    for group in groups:  # what is not among the first of some groups cannot be with further ones
        joined = ((*branches, branch) for branches in every for branch in group)
        every = sorted(joined, key=lambda branches: -sum(b.weight for b in branches))[:most]
    used = {id(branch) for branches in every for branch in branches}
    best = tuple(group[0] for group in groups)
    return every + [
        (*best[:g], branch, *best[g + 1 :])
        for g, group in enumerate(groups)
        for branch in group
        if id(branch) not in used
    ]


def continue_tracks(
    tracks: Sequence[Track], columns: Sequence[int], scan: Scan, common: Common, mean_gain: Array
) -> None:
    """Update tracks in place with their measurements in a frame.

    columns : for each track the index of its measurement, -1 for none.
    common : the shift that all bubbles share.
    mean_gain : (n, 3) mean Kalman gain of the bubbles.
    """
    measured, at = scan.measured, np.array(columns, np.int64)
    points, covariances = np.full((len(at), 3), np.nan), np.full((len(at), 3, 3), np.nan)
    points[at >= 0] = measured.points_mm[at[at >= 0]]
    covariances[at >= 0] = measured.covariance_mm2[at[at >= 0]]
    update_tracks(tracks, points, covariances, common.shift, mean_gain, common.covariance_mm2)
    for track, column in zip(tracks, columns):
        if column >= 0:
            d_eq = float("nan") if measured.alone[column] else float(measured.d_eq_mm[column])
            track.saw(scan.frame, scan.t_s, d_eq)


def advance(
    clusters: Sequence[Cluster], scan: Scan, common: Common
) -> tuple[list[Cluster], Common, Array | None]:
    """Continue all tracks with the measurements of a frame, without deciding conflicts.

    Tracks that compete with no other track are updated in place.

    common : what is known of the shift that all bubbles share.

    Returns the groups of tracks after this frame, the shift that all bubbles share, and the mean
    gain (n, 3) or None.
    """
    found = Association(clusters, scan, common)
    mean_gain = found.mean_gain()
    gain = np.zeros((len(common.shift), 3)) if mean_gain is None else mean_gain
    score = found.pairs.scores(found.common.shift_mm)
    out, alone, columns = [], [], []
    for members, edges in found.components():
        first = clusters[members[0]]
        if len(members) == 1 and not first.open and len(edges) < 2:
            (track,) = first.tracks
            good = [e for e in edges if score[e] > 0]
            column = int(found.pairs.column[good[0]]) if good else -1
            alone.append(track)
            columns.append(column)
            out.append(Cluster([Branch(0.0, [track], {track.particle: [(scan.frame, column)]})]))
            continue
        out.append(Cluster(grown(found, members, edges, gain)))
    continue_tracks(alone, columns, scan, found.common, gain)
    return out, found.common, mean_gain
