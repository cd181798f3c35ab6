"""One frame of the confirmed tracks: pair, keep several hypotheses where pairings conflict, update.

Tracks that compete for measurements form a cluster; each of its branches is one way to continue
all of them, with its log weight relative to the best. Branches with the same recent pairings are
merged (weights added, the better past kept), improbable ones dropped. A track on which all
branches agree leaves the cluster. When the window is over, the best branch is taken if the
runner-up is far enough behind; else the tracks that differ are broken.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from telerig.arrays import Array, Ints
from telerig.estimator.tracking.association.likelihoods import (
    Pairs,
    alternatives,
    assigned_with_shift,
    gate2,
    gated_pairs,
    joint_score,
)
from telerig.estimator.tracking.filter.motion import POSITION
from telerig.estimator.tracking.filter.state import Common, Track
from telerig.estimator.tracking.filter.types import FrameMeasurements, TrackerSettings

_MERGE_FRAMES = 2

History = dict[int, list[tuple[int, int]]]
"""Per particle: (frame, column) since the conflict opened, column -1 where it was missed."""


@dataclass
class Branch:
    """weight : log, 0 for the best of a cluster; tracks : in the same order in every branch."""

    weight: float
    tracks: list[Track]
    history: History = field(default_factory=dict)


@dataclass
class Cluster:
    """branches : best first; a track without conflict is a cluster of one branch, no history."""

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
class Broken:
    """track : its best continuation, with all its entries; kept : the certain ones before the
    conflict; new : those that stay together after it; entries between belong to no track."""

    track: Track
    entries: list[tuple[int, int]]
    kept: list[tuple[int, int]]
    new: list[tuple[int, int]]


@dataclass(frozen=True)
class Decision:
    """still : the cluster that stays open, if any; free : tracks that leave it, with their
    entries; broken : tracks that cannot be continued; runner_up_log_ratio : how close it was."""

    still: Cluster | None
    free: list[tuple[Track, list[tuple[int, int]]]]
    broken: list[Broken]
    runner_up_log_ratio: float


def recent(entries: Sequence[tuple[int, int]], depth: int) -> list[tuple[int, int]]:
    """The last ``depth`` entries in which the track was seen."""
    return [e for e in entries if e[1] >= 0][-depth:]


def merged(
    scored: Iterable[tuple[float, tuple[object, ...], int]], settings: TrackerSettings
) -> list[tuple[float, int]]:
    """(weight, what it came from) of (weight, key, index): equal keys as one, best first, 0 on top.

    Improbable ones and those beyond the largest number allowed are left out.
    """
    groups: dict[tuple[object, ...], list[tuple[float, int]]] = {}
    for weight, key, index in scored:
        groups.setdefault(key, []).append((weight, index))
    out = []
    for members in groups.values():
        weights = np.array([w for w, _ in members])
        top = int(weights.argmax())
        total = weights[top] + np.log(np.exp(weights - weights[top]).sum())
        out.append((float(total), members[top][1]))
    out.sort(key=lambda item: -item[0])
    best = out[0][0]
    kept = [(w - best, i) for w, i in out if w >= best - settings.prune_log_ratio]
    return kept[: settings.max_hypotheses]


def merge_key(histories: Iterable[Sequence[tuple[int, int]]]) -> tuple[object, ...]:
    """The recent pairings, by which branches are merged."""
    return tuple(tuple(h[-_MERGE_FRAMES:]) for h in histories)


def disputed(branches: Sequence[Branch], depth: int) -> set[int]:
    """Particles that two branches give different measurements, or one measurement in turn."""
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
) -> Decision:
    """Which tracks leave the cluster in this frame; at_once: all, as if its window were over."""
    branches = cluster.branches
    if not cluster.open:
        return Decision(None, _leave(branches[0], cluster.tracks), [], np.inf)
    runner_up = -branches[1].weight
    over = frame - cluster.since_frame + 1 >= settings.window_frames
    if not (over or at_once):
        open_ids = disputed(branches, _MERGE_FRAMES)
        still = _remaining(cluster, open_ids, settings)
        open_ids = open_ids if still else set()
        free = _leave(branches[0], [t for t in cluster.tracks if t.particle not in open_ids])
        return Decision(still, free, [], runner_up)
    close = [b for b in branches if b.weight >= -settings.margin_log_ratio]
    open_ids = disputed(close, 1)
    free = _leave(branches[0], [t for t in cluster.tracks if t.particle not in open_ids])
    broken = _break(close, [t for t in cluster.tracks if t.particle in open_ids])
    return Decision(None, free, broken, runner_up)


def _leave(best: Branch, tracks: list[Track]) -> list[tuple[Track, list[tuple[int, int]]]]:
    return [(t, best.history.get(t.particle, [])) for t in tracks]


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


def _break(close: list[Branch], tracks: list[Track]) -> list[Broken]:
    if not tracks:
        return []
    particles = [t.particle for t in tracks]
    paths = [[b.history[p] for p in particles] for b in close]
    start = _agreed_links_from(paths)
    out = []
    for i, track in enumerate(tracks):
        mine = [path[i] for path in paths]
        kept = []
        for entries in zip(*mine):
            if len(set(entries)) > 1:
                break
            kept.append(entries[0])
        new = [e for e in paths[0][i] if e[0] >= start and e[1] >= 0]
        out.append(Broken(track, paths[0][i], [e for e in kept if e[0] < start], new))
    return out


def _agreed_links_from(paths: list[list[list[tuple[int, int]]]]) -> int:
    """The first frame from which all branches tie the same measurements together."""
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


@dataclass(frozen=True)
class Scan:
    """A frame: its time, its measurements, and those of them (columns) that are free."""

    frame: int
    t_s: float
    measured: FrameMeasurements
    columns: Ints
    settings: TrackerSettings


@dataclass(frozen=True)
class Child:
    """A way to continue ``parents``: per track the index into the pairs, -1 where it is missed."""

    score: float
    parents: tuple[Branch, ...]
    edges: tuple[int, ...]


class Association:
    """The pairings of one frame, and the common shift that goes with the best of them."""

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
        pairs = gated_pairs(self.tracks, scan.measured, scan.columns, common, scan.settings)
        self.common, self.chosen = assigned_with_shift(pairs, len(rows), first, common)
        self.pairs, self.owner = pairs, self.cluster_of[pairs.row]
        self.picked = np.flatnonzero(first[pairs.row] & (self.chosen[pairs.row] == pairs.column))
        self.edges = self._allowed()

    def mean_gain(self, others: Sequence[Array]) -> Array | None:
        """(n, 3) mean filter gain of the bubbles that are updated; None if there are none."""
        p = [self.tracks[i].filter.P[:, POSITION] for i in self.pairs.row[self.picked]]
        gains = [a @ b for a, b in zip(p, self.pairs.information[self.picked])]
        return np.mean([*others, *gains], axis=0) if others or gains else None

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
        near = np.einsum("ei,eij,ej->e", off, total, off) <= gate2(self.scan.settings)
        return np.flatnonzero(near)

    def components(self) -> list[tuple[list[int], list[int]]]:
        """Clusters that share a measurement, each with its edges (indices into the pairs)."""
        owner, many = self.owner[self.edges], len(self.clusters)
        column, size = self.pairs.column[self.edges], many + len(self.scan.measured)
        graph = coo_array((np.ones(len(owner)), (owner, many + column)), (size, size))
        labels = connected_components(graph, directed=False)[1][:many]
        groups: dict[int, tuple[list[int], list[int]]] = {int(g): ([], []) for g in labels}
        for cluster, group in enumerate(labels.tolist()):
            groups[group][0].append(cluster)
        for edge, group in zip(self.edges.tolist(), labels[owner].tolist()):
            groups[group][1].append(edge)
        return list(groups.values())

    def outside(self, members: Sequence[int]) -> Common:
        """The common shift, estimated from the bubbles outside some clusters."""
        others = self.picked[~np.isin(self.owner[self.picked], members)]
        return self.prior.informed(
            self.pairs.innovation_mm[others], self.pairs.covariance_mm2[others]
        )


def children(found: Association, members: Sequence[int], edges: Sequence[int]) -> list[Child]:
    """The likely ways to continue some clusters together, equal recent pasts merged, best first."""
    settings, pairs = found.scan.settings, found.pairs
    outside = found.outside(members)
    score = pairs.scores(outside.shift_mm)
    by_row: dict[int, list[int]] = {}
    for e in edges:
        by_row.setdefault(int(pairs.row[e]), []).append(e)
    raw: list[Child] = []
    every = product(*(found.clusters[m].branches for m in members))
    ranked = sorted(every, key=lambda branches: -sum(b.weight for b in branches))
    for parents in ranked[: settings.max_hypotheses]:
        rows = [found.row_of[id(t)] for b in parents for t in b.tracks]
        options = [
            [(int(pairs.column[e]), float(score[e])) for e in by_row.get(r, [])] for r in rows
        ]
        start = sum(b.weight for b in parents)
        for taken, _ in alternatives(options, settings.prune_log_ratio + _SLACK_LOG_RATIO):
            chosen = tuple(
                next((e for e in by_row.get(r, []) if pairs.column[e] == c), -1)
                for r, c in zip(rows, taken)
            )
            used = np.array([e for e in chosen if e >= 0], int)
            raw.append(Child(start + joint_score(pairs, used, outside), parents, chosen))
    histories = (_histories(c, pairs, found.scan.frame) for c in raw)
    scored = ((c.score, merge_key(h.values()), i) for i, (c, h) in enumerate(zip(raw, histories)))
    return [Child(w, raw[i].parents, raw[i].edges) for w, i in merged(scored, settings)]


def _histories(child: Child, pairs: Pairs, frame: int) -> History:
    tracks = [(b, t) for b in child.parents for t in b.tracks]
    return {
        t.particle: [
            *b.history.get(t.particle, []),
            (frame, int(pairs.column[e]) if e >= 0 else -1),
        ]
        for (b, t), e in zip(tracks, child.edges)
    }


def grow(found: Association, members: Sequence[int], child: Child, mean_gain: Array) -> Branch:
    """The branch of a child, its tracks updated with the common shift that its pairings imply."""
    pairs, scan = found.pairs, found.scan
    used = np.array([e for e in child.edges if e >= 0], int)
    common = found.outside(members).informed(pairs.innovation_mm[used], pairs.covariance_mm2[used])
    tracks = [t.copy() for b in child.parents for t in b.tracks]
    for track, e in zip(tracks, child.edges):
        column = int(pairs.column[e]) if e >= 0 else -1
        continue_track(track, column, scan, common, mean_gain)
    return Branch(child.score, tracks, _histories(child, pairs, scan.frame))


def continue_track(track: Track, column: int, scan: Scan, common: Common, mean_gain: Array) -> None:
    """Update in place with a measurement's column, or -1."""
    if column < 0:
        track.missed(common.shift, mean_gain, common.covariance_mm2)
        return
    measured = scan.measured
    track.update(
        measured.points_mm[column],
        measured.covariance_mm2[column],
        common.shift,
        mean_gain,
        common.covariance_mm2,
    )
    track.saw(scan.frame, scan.t_s, float(measured.d_eq_mm[column]))


def advance(
    clusters: Sequence[Cluster], scan: Scan, common: Common, other_gains: Sequence[Array] = ()
) -> tuple[list[Cluster], Common, Array | None]:
    """The clusters after this frame (not decided yet), the common part, the mean gain.

    other_gains : (n, 3) each, of the bubbles that were updated already. Tracks without a rival are
    updated in place. A cluster whose history is not empty is open.
    """
    found = Association(clusters, scan, common)
    mean_gain = found.mean_gain(other_gains)
    gain = np.zeros((len(common.shift), 3)) if mean_gain is None else mean_gain
    out = []
    for members, edges in found.components():
        first = clusters[members[0]]
        if len(members) == 1 and not first.open and len(first.tracks) == 1 and len(edges) < 2:
            track = first.tracks[0]
            column = int(found.chosen[found.row_of[id(track)]]) if edges else -1
            continue_track(track, column, scan, found.common, gain)
            out.append(Cluster([Branch(0.0, [track], {track.particle: [(scan.frame, column)]})]))
            continue
        every = children(found, members, edges)
        out.append(Cluster([grow(found, members, child, gain) for child in every]))
    return out, found.common, mean_gain


def follow_labelled(
    tracks: Sequence[Track], scan: Scan, common: Common
) -> tuple[Common, list[Array], list[int]]:
    """Update tracks whose ids came with the measurements, in place: no association is needed.

    Returns the common shift that they imply, their gains, and the columns without a track yet.
    """
    columns = {int(scan.measured.particle[c]): int(c) for c in scan.columns}
    at = [columns.pop(t.particle, -1) for t in tracks]
    seen = [(t, c) for t, c in zip(tracks, at) if c >= 0]
    fresh = sorted(columns.values())
    if not seen:
        return common, [], fresh
    innovations = np.array([scan.measured.points_mm[c] - t.point_mm for t, c in seen])
    noise = np.array([scan.measured.covariance_mm2[c] for _, c in seen])
    p = np.array([t.filter.P[:, POSITION] for t, _ in seen])
    covariance = p[:, POSITION] + noise
    common = common.informed(innovations, covariance)
    gains = p @ np.linalg.inv(covariance)
    for track, column in zip(tracks, at):
        continue_track(track, column, scan, common, gains.mean(0))
    return Common(covariance=common.covariance), list(gains), fresh
