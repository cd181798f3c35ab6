"""Links the measurements of one frame to tracks, and keeps several hypotheses where pairings
conflict.

A pairing's score is its log-likelihood ratio against "the track was missed and the measurement is
new": log P_D / (1 - P_D) + log N(innovation) - log(density of new ones) + log ratio of the sizes.
It is the same for points that several cameras see, for what one camera alone sees (a point whose
depth is unknown), and for predictions from smoothed tracks.

The shift of a frame, which all bubbles share, is expected to be as large as those of the last
frames or as the settings say, and is looked for where the tracks agree on it. If half of them are
left without a measurement and it is more probable that the rig has moved unusually far than that
they were missed beside new bubbles, the rig has moved so far in this frame.

Confirmed tracks that compete for what several cameras see are in conflict: hypotheses say how all
of them continue, each with its log weight relative to the best. Those with the same recent pairings
are merged (weights added, the better past kept), improbable ones dropped. A track on which all
hypotheses agree leaves the conflict. When the window is over, the best hypothesis is taken if the
runner-up is far enough behind; else the tracks that differ are broken.

Every other pairing has to be clear, or it is not made: those of tracks that are not confirmed, with
what no confirmed track may have, and those of confirmed tracks with what one camera alone sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
from telerig.estimator.tracking.linking.filter import (
    POSITION,
    STATES,
    Common,
    Scan,
    States,
    TrackerSettings,
)
from telerig.estimator.tracking.linking.frames import NO_PARTICLE, Bubbles
from telerig.estimator.tracking.linking.ranked_ways import alternatives

_SHIFT_ROUNDS = 5
"""Largest number of assignments and common shifts in turn."""

_JOINTLY_SCORED = 10
"""For each hypothesis that is kept, so many ways to continue are scored with the common shift."""

_JUMP_SHARE = 1e-3
"""Share of frames in which the rig moves farther than shake and stage usually do."""

_CERTAIN = 1e12
"""Score of a pairing by an id that came with the data."""


def expected(states: States) -> Prediction:
    """Return where tracks are expected, without the error that all bubbles have in common."""
    spread = states.p[:, POSITION, POSITION]
    return Prediction(states.track, states.points_mm, spread, states.sizes_mm[:, 0])


def gated_pairs(
    predicted: Prediction,
    measured: Bubbles,
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
    given = measured.given != NO_PARTICLE
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
    if max(np.bincount(row).max(), np.bincount(column).max()) < 2:  # nothing competes
        out[row[score > 0]] = column[score > 0]
        return out
    cost = np.zeros((rows, int(column.max()) + 1))
    cost[row, column] = np.minimum(-score, 0.0)
    at, to = linear_sum_assignment(cost)
    good = cost[at, to] < 0
    out[at[good]] = to[good]
    return out


def likeliest_shift(pairs: Evidence, common: Common) -> Array:
    """Return the innovation (3,) which, as the shift that all bubbles share, explains most.

    The shift may be larger than the distance of two bubbles: it is where tracks agree on it.
    """
    if not len(pairs.row):
        return common.shift_mm
    pull = (pairs.information @ pairs.innovation_mm[..., None])[..., 0]
    square = (pairs.innovation_mm * pull).sum(1)
    flat = (pairs.innovation_mm[:, :, None] * pairs.innovation_mm[:, None]).reshape(-1, 9)
    distance2 = (
        square + flat @ pairs.information.reshape(-1, 9).T - 2 * pairs.innovation_mm @ pull.T
    )
    starts = np.flatnonzero(np.diff(pairs.row, prepend=-1))  # pairings are in the order of tracks
    each = np.maximum(np.maximum.reduceat(pairs.constant - distance2 / 2, starts, axis=1), 0.0)
    left = pairs.innovation_mm - common.shift_mm
    total = np.linalg.inv(common.covariance_mm2 + pairs.covariance_mm2)
    prior = np.einsum("ei,eij,ej->e", left, total, left) / 2
    return np.asarray(pairs.innovation_mm[np.argmax(each.sum(1) - prior)])


def picked_with_shift(pairs: Evidence, rows: int, common: Common) -> Evidence:
    """Return the best assignment of so many rows; the common shift is estimated with it in turn."""
    shift, chosen, picked = likeliest_shift(pairs, common), np.full(rows, -1), np.zeros(0, np.int64)
    for turn in range(_SHIFT_ROUNDS):
        found = best_assignment(rows, pairs.row, pairs.column, pairs.scores(shift))
        if turn and np.array_equal(found, chosen):
            break
        chosen, picked = found, np.flatnonzero(found[pairs.row] == pairs.column)
        shift = common.informed(pairs.innovation_mm[picked], pairs.information[picked]).shift_mm
    return pairs.take(picked)


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

_SLACK_LOG_RATIO = 6.0
"""What the common shift of a frame may change of the order of hypotheses."""

_BEFORE = -2
"""Stands in a hypothesis for a frame in which a track was not yet in the conflict."""


@dataclass(frozen=True)
class Conflict:
    """B hypotheses about T tracks that compete for the same measurements, best first.

    weight : (B,) log-likelihood ratios to the best hypothesis.
    rows : (B, T) the tracks' states.
    frames : (F,) since the conflict began.
    taken : (B, T, F) the tracks' measurements in these frames, -1 for none.
    """

    weight: Array
    rows: Ints
    frames: Ints
    taken: Ints

    def of(self, hypotheses: Ints | Bools, tracks: Bools) -> Conflict:
        """Return some of the hypotheses about some of the tracks."""
        rows, taken = self.rows[hypotheses][:, tracks], self.taken[hypotheses][:, tracks]
        known = (taken != _BEFORE).any((0, 1))
        return Conflict(self.weight[hypotheses], rows, self.frames[known], taken[..., known])

    def disputed(self, depth: int) -> Bools:
        """Return about which tracks (T,) the hypotheses disagree, by their last measurements.

        Two hypotheses give such a track different measurements, or give one measurement to it and
        to another track. depth : number of last measurements that count.
        """
        seen = self.taken >= 0
        recent = seen & (np.cumsum(seen[..., ::-1], axis=2)[..., ::-1] <= depth)
        largest = np.where(recent, self.taken, -1).max(0)
        least = np.where(recent, self.taken, np.iinfo(np.int64).max).min(0)
        out = (recent.any(0) & (largest != least)).any(1)
        _, track, frame = np.nonzero(recent)
        claims = np.unique(np.stack([frame, self.taken[recent], track]), axis=1)
        _, first, many = np.unique(claims[:2], axis=1, return_inverse=True, return_counts=True)
        out[claims[2, many[first.ravel()] > 1]] = True
        return np.asarray(out)

    def merged(self, settings: TrackerSettings) -> Conflict:
        """Return the hypotheses with those joined whose recent measurements are equal.

        Of the joined ones the most probable is kept, with the weight of all. There are
        ``max_hypotheses``, best first, and those that alone give a track one of its measurements;
        improbable ones are left out.
        """
        recent = self.taken[:, :, -_MERGE_FRAMES:].reshape(len(self.weight), -1)
        _, group = np.unique(recent, axis=0, return_inverse=True)
        order = np.lexsort([-self.weight, group.ravel()])
        top = order[np.unique(group.ravel()[order], return_index=True)[1]]
        peak = self.weight[top]
        joint = np.bincount(group.ravel(), np.exp(self.weight - peak[group.ravel()]))
        total = peak + np.log(joint)
        total, best = total - total.max(), np.argsort(-total, kind="stable")
        kept, seen = list[int](), np.zeros((recent.shape[1], recent[top].max() + 3), bool)
        place = np.arange(recent.shape[1])
        for k in best[total[best] >= -settings.prune_log_ratio].tolist():
            own = recent[top[k]] - _BEFORE
            if len(kept) < settings.max_hypotheses or not seen[place, own].all():
                kept.append(k)
                seen[place, own] = True
        found = self.of(top[kept], np.ones(self.rows.shape[1], bool))
        return replace(found, weight=total[kept])

    def decided(
        self, frame: int, settings: TrackerSettings, *, at_once: bool
    ) -> tuple[Conflict | None, Conflict, Conflict]:
        """Return what remains undecided in this frame, None if there is nothing; the tracks that
        are safe; and those that have to be cut.

        at_once : decide about all tracks.
        """
        every, still = np.ones(len(self.weight), bool), None
        unsure, close = np.zeros(self.rows.shape[1], bool), every
        if len(self.weight) > 1:
            if at_once or frame - self.frames[0] + 1 >= settings.window_frames:
                close = self.weight >= -settings.margin_log_ratio
                unsure = self.of(close, ~unsure).disputed(1)
            else:
                unsure = self.disputed(_MERGE_FRAMES)
                still = self.of(every, unsure).merged(settings) if unsure.any() else None
                still = still if still is not None and len(still.weight) > 1 else None
                unsure &= still is not None
        return still, self.of(every, ~unsure), self.of(close, unsure & (still is None))

    def broken(self) -> tuple[Ints, int]:
        """Return for each track (T,) the number of frames in which all hypotheses agree, and the
        frame from which on they tie the same measurements together."""
        if not self.taken.size:
            return np.zeros(0, np.int64), 0
        taken = np.maximum(self.taken, -1)
        links = np.sort(taken[..., :-1] * (taken.max() + 2) + taken[..., 1:], axis=1)
        alike = (links == links[0]).all((0, 1))
        start = len(alike) - int(np.append(alike[::-1], False).argmin())
        agreed = np.append((taken == taken[0]).all(0), np.zeros((taken.shape[1], 1), bool), axis=1)
        return np.minimum(agreed.argmin(1), start), start


@dataclass(frozen=True)
class Advanced:
    """Hold the tracks after a frame.

    states, columns : (K,) of the tracks that go on, with their measurements in the frame, -1 for
        none. Those of the conflicts follow those of tracks without rivals.
    single : number of tracks without rivals.
    conflicts : the groups of tracks that compete, which may have one hypothesis.
    free : (M,) measurements of several cameras that no track may have.
    shift : the shift of this frame, which the states contain. common : the error that is left.
    """

    states: States
    columns: Ints
    single: int
    conflicts: list[Conflict]
    free: Bools
    shift: Common
    common: Common


@dataclass(frozen=True)
class _Pairings:
    """Hold the possible pairings of tracks with the measurements of one frame.

    pairs : of confirmed tracks with what several cameras see. weak : all others.
    owner : (K,) for each state the conflict of its track, or a number of its own.
    picked : the best pairings, by which the common shift is known. prior : what it was before.
    """

    states: States
    scan: Scan
    pairs: Evidence
    weak: Evidence
    owner: Ints
    picked: Evidence
    prior: Common

    @staticmethod
    def of(states: States, scan: Scan, owner: Ints, best: Bools, common: Common) -> _Pairings:
        """best : (K,) which states are those of the best hypotheses."""
        measured, confirmed = scan.measured, states.track > NO_PARTICLE
        ids = np.where(states.given, states.track, NO_PARTICLE)
        allowed = ids[:, None] == measured.given
        allowed &= confirmed[:, None] | ~measured.alone
        misses = scan.frame - states.seen_frame - 1
        pairs = gated_pairs(expected(states), measured, allowed, common, scan.settings, misses)
        sure = confirmed[pairs.row] & ~measured.alone[pairs.column]
        firm, weak = pairs.take(sure), pairs.take(~sure)
        picked = picked_with_shift(firm.take(best[firm.row]), len(states), common)
        if not len(picked.row):
            some = weak.take(~measured.alone[weak.column] & best[weak.row])
            picked = picked_with_shift(some, len(states), common)
        return _Pairings(states, scan, firm, weak, owner, picked, common)

    @property
    def now(self) -> Common:
        """The shift of this frame that all bubbles share."""
        return self.prior.informed(self.picked.innovation_mm, self.picked.information)

    @property
    def score(self) -> float:
        """Log-likelihood ratio of the best pairings, over all shifts."""
        return float(joint_scores(self.picked, [range(len(self.picked.row))], self.prior)[0])

    @property
    def gain(self) -> Array:
        """Mean Kalman gain (12, 3) of the bubbles that are measured."""
        if not len(self.picked.row):
            return np.zeros((STATES, 3))
        own = self.states.p[self.picked.row][:, :, POSITION] @ self.picked.information
        return np.asarray(own.mean(0))

    def near(self) -> Evidence:
        """Return those inside the gate when the shift is estimated from other tracks alone."""
        pairs, many = self.pairs, int(self.owner.max(initial=-1)) + 1
        of_picked, owner = self.owner[self.picked.row], self.owner[pairs.row]
        information, pull = np.zeros((many, 3, 3)), np.zeros((many, 3))
        np.add.at(information, of_picked, self.picked.information)
        left = self.picked.innovation_mm - self.prior.shift_mm
        np.add.at(pull, of_picked, (self.picked.information @ left[..., None])[..., 0])
        prior = self.prior.covariance_mm2
        outside = prior @ np.linalg.inv(np.eye(3) + (information.sum(0) - information) @ prior)
        shift = (outside @ (pull.sum(0) - pull)[..., None])[..., 0][owner]
        off = pairs.innovation_mm - self.prior.shift_mm - shift
        total = np.linalg.inv(pairs.covariance_mm2 + outside[owner])
        inside = np.einsum("ei,eij,ej->e", off, total, off) <= gate2(3)
        return pairs.take(inside | (pairs.constant == _CERTAIN))

    def outside(self, members: Sequence[int]) -> Common:
        """Return the shift of this frame that all bubbles share, without those of some owners."""
        others = self.picked.take(~np.isin(self.owner[self.picked.row], members))
        return self.prior.informed(others.innovation_mm, others.information)

    def grown(
        self, before: Sequence[Conflict], pairs: Evidence, outside: Common
    ) -> tuple[Conflict, list[Common]]:
        """Return the likely ways to continue some groups of tracks together, and the shift of the
        frame in each of them.

        pairs : their possible pairings. outside : the shift without them. The rows of the result
        are those of the states before the frame.
        """
        settings = self.scan.settings
        score = pairs.scores(outside.shift_mm)
        options: dict[int, list[tuple[int, float]]] = {}
        edge_of = {}
        for e, at in enumerate(zip(pairs.row.tolist(), pairs.column.tolist())):
            options.setdefault(at[0], []).append((at[1], float(score[e])))
            edge_of[at] = e
        old = joined(before, settings.max_hypotheses)
        tables = [(weight, [options.get(row, []) for row in rows])
                  for weight, rows in zip(old.weight.tolist(), old.rows.tolist())]  # fmt: skip
        within = settings.prune_log_ratio + _SLACK_LOG_RATIO
        ways = alternatives(tables, within, _JOINTLY_SCORED * settings.max_hypotheses)
        came, now = np.array([k for k, *_ in ways]), np.array([taken for _, taken, _ in ways])
        rows = old.rows[came]
        used = [[edge_of[at] for at in zip(own, taken) if at[1] >= 0]
                for own, taken in zip(rows.tolist(), now.tolist())]  # fmt: skip
        weight = old.weight[came] + joint_scores(pairs, used, outside)
        frames = np.append(old.frames, self.scan.frame)
        taken = np.concatenate([old.taken[came], now[..., None]], axis=2)
        # the rows are the numbers of the ways, until it is known which of them are kept
        places = np.arange(rows.size).reshape(rows.shape)
        found = Conflict(weight, places, frames, taken).merged(settings)
        kept = found.rows[:, 0] // rows.shape[1]
        commons = []
        for own in (used[k] for k in kept):
            commons.append(outside.informed(pairs.innovation_mm[own], pairs.information[own]))
        return replace(found, rows=rows[kept]), commons


def joined(groups: Sequence[Conflict], most: int) -> Conflict:
    """Return the ``most`` likely joint hypotheses of groups of tracks, one of each group.

    A hypothesis of a group that is in none of them follows with the best ones of the others.
    """
    every, weight = np.zeros((1, 0), np.int64), np.zeros(1)
    for group in groups:  # what is not among the first of some groups cannot be with further ones
        many = len(group.weight)
        total = (weight[:, None] + group.weight).ravel()
        order = np.argsort(-total, kind="stable")[:most]
        every = np.column_stack([every[order // many], order % many])
        weight = total[order]
    unused = [
        (g, b)
        for g, group in enumerate(groups)
        for b in np.setdiff1d(np.arange(len(group.weight)), every[:, g]).tolist()
    ]
    more = np.zeros((len(unused), len(groups)), np.int64)
    for row, (g, b) in zip(more, unused):
        row[g] = b
    every = np.concatenate([every, more])
    frames = np.unique(np.concatenate([group.frames for group in groups]))
    taken = []
    for group, own in zip(groups, every.T):
        padded = np.full((*group.rows[own].shape, len(frames)), _BEFORE)
        padded[..., np.searchsorted(frames, group.frames)] = group.taken[own]
        taken.append(padded)
    return Conflict(
        sum((group.weight[own] for group, own in zip(groups, every.T)), np.zeros(len(every))),
        np.concatenate([group.rows[own] for group, own in zip(groups, every.T)], axis=1),
        frames, np.concatenate(taken, axis=1),
    )  # fmt: skip


def _components(owner: Ints, column: Ints, conflicts: int) -> list[tuple[list[int], list[int]]]:
    """Return the groups of tracks that compete for measurements of a frame, each given by owners
    and by the indices of its pairings; owners below ``conflicts`` compete already."""
    label = {one: one for one in [*range(conflicts), *owner.tolist()]}
    first: dict[int, int] = {}
    for one, to in zip(owner.tolist(), column.tolist()):
        low, high = sorted((label[one], label[first.setdefault(to, one)]))
        if low != high:
            label = {own: low if group == high else group for own, group in label.items()}
    groups: dict[int, tuple[list[int], list[int]]] = {}
    for one, group in label.items():
        groups.setdefault(group, ([], []))[0].append(one)
    for edge, one in enumerate(owner.tolist()):
        groups[label[one]][1].append(edge)
    return list(groups.values())


def advance(states: States, conflicts: Sequence[Conflict], scan: Scan, common: Common) -> Advanced:
    """Continue all tracks with the measurements of a frame, without deciding conflicts.

    states : where tracks are expected; those that are in no conflict have no rivals.
    common : what is known of the shift that all bubbles share.
    """
    many, measured, settings = len(states), scan.measured, scan.settings
    owner, best = np.arange(many) + len(conflicts), np.ones(many, bool)
    for c, conflict in enumerate(conflicts):
        owner[conflict.rows], best[conflict.rows[1:]] = c, False
    confirmed, single = states.track > NO_PARTICLE, owner >= len(conflicts)
    found = _Pairings.of(states, scan, owner, best, common)
    if 2 * len(found.picked.row) <= min((best & confirmed).sum(), (~measured.alone).sum()):
        jump = _Pairings.of(states, scan, owner, best, common.jumped(settings))
        least = found.score - np.log(_JUMP_SHARE)
        found = jump if jump.score > least else found
    now, weak, gain = found.now, found.weak, found.gain
    near = found.near()
    columns = np.full(many, -1)
    rival = ~single[near.row] | (np.bincount(near.row, minlength=many)[near.row] > 1)
    rival |= np.bincount(near.column, minlength=len(measured))[near.column] > 1
    good = ~rival & (near.scores(now.shift_mm) > 0)
    columns[near.row[good]] = near.column[good]
    near = near.take(rival)
    free = ~measured.alone & (measured.given == NO_PARTICLE)
    free[columns[columns >= 0]] = False
    later, commons = list[Conflict](), list[list[Common]]()
    for members, edges in _components(owner[near.row], near.column, len(conflicts)):
        before = [conflicts[m] if m < len(conflicts) else _alone(m - len(conflicts))
                  for m in members]  # fmt: skip
        one, shifts = found.grown(before, near.take(edges), found.outside(members))
        later.append(one)
        commons.append(shifts)
        single[one.rows] = False
        taken = one.taken[..., -1]
        free[taken[taken >= 0]] = False
    open_ = np.where(confirmed[weak.row], columns[weak.row] < 0, free[weak.column])
    weak = weak.take(open_ & single[weak.row])
    given, clear = clear_assignment(weak, many, now.shift_mm, settings)
    columns = np.where(clear, given, columns)
    free[given[clear]] = False
    alone = np.flatnonzero(single & (confirmed | clear | (given < 0)))
    parents = np.concatenate([alone, *(one.rows.ravel() for one in later)])
    taken = np.concatenate([columns[alone], *(one.taken[..., -1].ravel() for one in later)])
    every = [now, *(own for shifts in commons for own in shifts)]
    tracks = [one.rows.shape[1] for one, shifts in zip(later, commons) for _ in shifts]
    which = np.repeat(np.arange(len(every)), [len(alone), *tracks])
    shift, unsure = (np.array([getattr(own, name) for own in every])[which]
                     for name in ("shift", "covariance_mm2"))  # fmt: skip
    states = states.take(parents).updated(scan, taken, shift, unsure, gain)
    at = len(alone)
    for k, one in enumerate(later):
        places = at + np.arange(one.rows.size).reshape(one.rows.shape)
        later[k], at = replace(one, rows=places), at + one.rows.size
    return Advanced(states, taken, len(alone), later, free, now, now.applied(gain))


def _alone(row: int) -> Conflict:
    """Return a track without rivals as a conflict with one hypothesis and no past."""
    none = np.zeros(0, np.int64)
    return Conflict(np.zeros(1), np.array([[row]]), none, np.zeros((1, 1, 0), np.int64))
