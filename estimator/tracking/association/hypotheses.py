"""Conflicts that stay open: several ways to continue a few tracks, until one is left.

Tracks that compete for measurements form a cluster; each of its branches is one way to continue
all of them, with its log weight relative to the best. Branches with the same recent pairings are
merged (weights added, the better past kept), improbable ones dropped. A track on which all
branches agree leaves the cluster. When the window is over, the best branch is taken if the
runner-up is far enough behind; else the tracks that differ are broken.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from telerig.estimator.tracking.filter.state import Track
from telerig.estimator.tracking.filter.types import TrackerSettings

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
    entries; broken : tracks that cannot be continued; runner_up_nats : how close it was."""

    still: Cluster | None
    free: list[tuple[Track, list[tuple[int, int]]]]
    broken: list[Broken]
    runner_up_nats: float


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
    kept = [(w - best, i) for w, i in out if w >= best - settings.prune_nats]
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
    close = [b for b in branches if b.weight >= -settings.margin_nats]
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
