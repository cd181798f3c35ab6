"""Bubbles followed through time in the rig frame, frame by frame, from birth to death.

A track is born tentative and confirmed after some hits; it ends when it was not seen for too long.
The ids of a frame stay open while a conflict or a birth may change them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.estimator.bubbles.pairing.evidence import Prediction
from telerig.estimator.tracking.linking.association import Conflict, advance, expected
from telerig.estimator.tracking.linking.filter import (
    POSITION,
    STATES,
    VELOCITY,
    Common,
    FrameIds,
    FrameResult,
    Scan,
    StageMotion,
    States,
    TrackerSettings,
    TrackEvent,
    Transition,
    transition,
)
from telerig.estimator.tracking.linking.frames import NO_PARTICLE, Bubbles, Motion
from telerig.estimator.tracking.linking.lifetimes import FIRST_SEEN, not_seen_since


class OpenFrames:
    """Hold the track ids of the undecided frames."""

    def __init__(self) -> None:
        self._frames: dict[int, Ints] = {}

    def begin(self, frame: int, count: int) -> None:
        """Add a frame; count : number of its measurements, which have no track yet."""
        self._frames[frame] = np.full(count, NO_PARTICLE)

    def give(self, tracks: Ints | int, frames: Ints | int, columns: Ints) -> None:
        """Set the ids of measurements; the arguments are broadcast. columns : -1 for none."""
        every = np.broadcast_arrays(tracks, frames, columns)
        for track, frame, column in zip(*(one.tolist() for one in every)):
            if column >= 0:
                self._frames[frame][column] = track

    def rename(self, old: int, new: int) -> None:
        """Replace the id of a track."""
        for track in self._frames.values():
            track[track == old] = new

    def close(self, before_frame: int) -> tuple[FrameIds, ...]:
        """Return and forget the ids of all frames before ``before_frame``."""
        done = [f for f in self._frames if f < before_frame]
        return tuple(FrameIds(f, np.maximum(self._frames.pop(f), NO_PARTICLE)) for f in done)


_TOUCHING = 1.5
"""Largest distance of two centres, in diameters, of bubbles that may have been one."""

Beside = tuple[int, float] | None
"""Id and diameter (mm), before its last measurement, of the track beside another one."""


def beside(states: States, points_mm: Array, own: Ints) -> list[Beside]:
    """Return for each point (N, 3) the nearest of some tracks whose bubble could touch one there.

    own : (N,) ids of tracks that do not count.
    """
    known = states.take(np.isfinite(states.sizes_mm[:, 0]))
    if not len(known) or not len(points_mm):
        return [None] * len(points_mm)
    away = np.linalg.norm(known.points_mm - points_mm[:, None], axis=2)
    away[known.track == own[:, None]] = np.inf
    nearest = away.argmin(1)
    size, before, _ = known.sizes_mm[nearest].T
    before = np.where(np.isfinite(before), before, size)
    touching = away.min(1) <= _TOUCHING * size
    found = zip(known.track[nearest].tolist(), before.tolist(), touching.tolist())
    return [(track, d_mm) if near else None for track, d_mm, near in found]


def related(
    kind: str, noted: Beside, one: States, confirmed: States, scan: Scan
) -> list[TrackEvent]:
    """Return a "split" event if a newly confirmed track is a part of the track beside which it was
    born, or a "merge" event if a lost track is a part of the one beside which it was lost.

    There is none unless the volumes before and after agree within the tolerance.

    one : the track. noted : the track beside it.
    """
    if noted is None or not (mine := confirmed.track == noted[0]).any():
        return []
    mean, _, last = one.sizes_mm[0].tolist()
    other = float(confirmed.sizes_mm[mine.argmax(), 2])
    whole, *parts = (noted[1], other, last) if kind == "split" else (other, noted[1], mean)
    off = abs(parts[0] ** 3 + parts[1] ** 3 - whole**3)
    if not off <= scan.settings.balance_tolerance * whole**3:
        return []
    both, single = f"{parts[0]:.2f} and {parts[1]:.2f} mm", f"{whole:.2f} mm"
    before, after = (single, both) if kind == "split" else (both, single)
    ids = noted[0], int(one.track[0])
    return [TrackEvent(kind, scan.frame, scan.t_s, ids, f"d_eq {before} became {after}")]


def _unit(direction: ArrayLike, name: str) -> tuple[float, float, float]:
    """Return a direction (3,) with unit length. Raises InputError when it is none."""
    given = np.asarray(direction, float)
    if given.shape != (3,) or not np.linalg.norm(given) > 0:
        raise InputError(f"{name} = {given.tolist()}", todo="give a direction of three numbers")
    x, y, z = (given / np.linalg.norm(given)).tolist()
    return x, y, z


class Tracker:
    """Follow bubbles: take the measurements of one frame after another and return track ids.

    axis_rig : (3,) the stage's travel direction in the rig frame. It need not have unit length.
    up : (3,) direction along which bubbles rise; None for the same.
    settings : None for the defaults.
    first_id : id of the first track; it has to be larger than any id given with the measurements.

    Take the ids for tables from `FrameResult.final` and from `finish`. A frame stays undecided
    while a conflict or a birth in it is undecided, at most for ``window_frames`` or
    ``confirm_frames`` frames. The memory that is needed does not grow with the length of the run.

    Raises InputError when axis_rig or up is no direction.
    """

    def __init__(
        self,
        axis_rig: ArrayLike = (0.0, -1.0, 0.0),
        settings: TrackerSettings | None = None,
        *,
        first_id: int = 0,
        up: ArrayLike | None = None,
    ) -> None:
        self.axis = _unit(axis_rig, "axis_rig")
        self.up = self.axis if up is None else _unit(up, "up")
        self.settings = TrackerSettings() if settings is None else settings
        self.next_id = first_id
        none = np.zeros(0, np.int64)
        places = np.zeros((0, 3)), np.zeros((0, 3, 3))
        nothing = Bubbles.of(np.zeros((0, 2), np.int64), *places, none, np.zeros(0))
        self._nothing = Scan(0, 0.0, nothing, self.settings)
        self.states = States.born(self._nothing, none, none, np.zeros(3), True)
        self.conflicts: list[Conflict] = []
        self.common = Common()
        self.stage = StageMotion()
        self.frames = OpenFrames()
        self.last: tuple[int, float] | None = None
        self.events: list[TrackEvent] = []
        self._unconfirmed = NO_PARTICLE
        self._parents: dict[int, Beside] = {}
        self._lost: dict[int, Beside] = {}

    def predict(self, t_s: float, position_mm: float | None = None) -> Prediction:
        """Return the expected positions of the confirmed tracks in the rig frame; the tracker is
        unchanged.

        t_s : time of the frame.
        position_mm : encoder position of the stage at that time; None if it has to be extrapolated.

        Raises InputError when t_s is not later than the last frame's time.
        """
        tracks = self._confirmed()
        if not len(tracks) or self.last is None:
            return expected(tracks)
        step, control, found = self._motion(replace(self.stage), t_s, position_mm)
        both = replace(tracks, p=tracks.p + self.common.covariance).predicted(step, found, control)
        noise = self.common.excess * step.common_noise[POSITION, POSITION]
        return replace(expected(both), covariance_mm2=both.p[:, POSITION, POSITION] + noise)

    def update(
        self,
        frame: int,
        t_s: float,
        measured: Bubbles,
        position_mm: float | None = None,
    ) -> FrameResult:
        """Take in the measurements of one frame and return what is final.

        frame, t_s : number and time of the frame; both have to increase.
        measured : the bubbles of the frame.
        position_mm : encoder position of the stage; None or NaN if there is none.

        Raises InputError when frame or t_s do not increase, and for an id that occurs twice.
        """
        self._check(frame, t_s)
        given = measured.given[measured.given != NO_PARTICLE]
        if len(np.unique(given)) < len(given):
            raise InputError(
                "a particle id occurs twice", where=f"frame {frame}", todo="give each id once"
            )
        motion = self._predict_all(t_s, position_mm)
        self.last = (frame, t_s)
        self.frames.begin(frame, len(measured))
        self.events = []
        scan = Scan(frame, t_s, measured, self.settings)
        found = advance(self.states, self.conflicts, scan, self.common)
        moved = (
            None
            if motion is None
            else motion.shifted(found.shift.shift, found.shift.covariance_mm2)
        )
        self.states, self.conflicts, self.common = found.states, found.conflicts, found.common
        self.frames.give(self.states.track[: found.single], frame, found.columns[: found.single])
        self._decide(scan, self._single)
        self._births(scan, np.flatnonzero(found.free))
        self._deaths(scan)
        final = self.frames.close(self._open_since(frame))
        return FrameResult(tuple(self.events), final, moved)

    def finish(self) -> FrameResult | None:
        """Decide everything that is undecided at the end of the run; conflicts end as if their
        window ended.

        Returns the last result, whose ``final`` holds the remaining frames; None if there was no
        frame.
        """
        if self.last is None:
            return None
        self.events = []
        scan = replace(self._nothing, frame=self.last[0], t_s=self.last[1])
        self._decide(scan, self._single, at_once=True)
        final = self.frames.close(scan.frame + 1)
        return FrameResult(tuple(self.events), final)

    @property
    def _single(self) -> Bools:
        """Which states are those of tracks without rivals (K,)."""
        out = np.ones(len(self.states), bool)
        for conflict in self.conflicts:
            out[conflict.rows] = False
        return out

    def _confirmed(self) -> States:
        """Return the confirmed tracks, by the best hypothesis."""
        best = self._single & (self.states.track > NO_PARTICLE)
        for conflict in self.conflicts:
            best[conflict.rows[0]] = True
        return self.states.take(best)

    def _open_since(self, frame: int) -> int:
        born = self.states.born_frame[self.states.track < NO_PARTICLE]
        starts = [conflict.frames[0] for conflict in self.conflicts]
        return int(min([frame + 1, *starts, *born]))

    def _check(self, frame: int, t_s: float) -> None:
        if not np.isfinite(t_s):
            raise InputError(f"time {t_s}", where=f"frame {frame}", todo="give a time in s")
        if self.last is not None and not (frame > self.last[0] and t_s > self.last[1]):
            raise InputError(
                f"frame {frame} at {t_s} s follows frame {self.last[0]} at {self.last[1]} s",
                todo="give frames in order, with times that increase",
            )

    def _motion(
        self, stage: StageMotion, t_s: float, position_mm: float | None
    ) -> tuple[Transition, Array, Array]:
        """Return the transition to the next frame, the stage's effect on the states (12,), and the
        vector (3,) in mm/s that has to be added to all velocities before the step.
        """
        assert self.last is not None
        dt = t_s - self.last[1]
        if not dt > 0:
            raise InputError(f"time {t_s} s after {self.last[1]} s", todo="times must increase")
        moved_mm, known, found_mm_s = stage.step(position_mm, t_s, dt)
        axis = np.array(self.axis)
        step = transition(self.settings, self.up, round(dt, 12), known)
        control = np.zeros(STATES)
        control[POSITION] -= axis * moved_mm
        return step, control, axis * found_mm_s

    def _predict_all(self, t_s: float, position_mm: float | None) -> Motion | None:
        if self.last is None:
            self.stage.step(position_mm, t_s, 0.0)
            return None
        step, control, found = self._motion(self.stage, t_s, position_mm)
        self.common = self.common.predicted(step) if len(self.states) else Common()
        self.states = self.states.predicted(step, found, control)
        return Motion(step.matrix, step.noise, step.matrix[:, VELOCITY] @ found + control)

    def _event(self, kind: str, scan: Scan, particles: Sequence[int], reason: str) -> None:
        self.events.append(TrackEvent(kind, scan.frame, scan.t_s, tuple(particles), reason))

    def _take_id(self) -> int:
        self.next_id += 1
        return self.next_id - 1

    def _keep(self, kept: Bools) -> None:
        """Forget the other states (K,), of which none is in a conflict."""
        if kept.all():
            return
        places = np.cumsum(kept) - 1
        self.states = self.states.take(kept)
        self.conflicts = [replace(c, rows=places[c.rows]) for c in self.conflicts]

    def _decide(self, scan: Scan, kept: Bools, *, at_once: bool = False) -> None:
        """Decide which tracks of the conflicts are safe in this frame; all of them if ``at_once``.

        kept : (K,) states of the tracks without rivals.
        """
        conflicts, self.conflicts, track = self.conflicts, [], self.states.track
        for conflict in conflicts:
            still, best, close = conflict.decided(scan.frame, self.settings, at_once=at_once)
            waited, old, new = list[int](), list[int](), list[int]()
            kept[best.rows[0]] = True
            for row, taken in zip(best.rows[0].tolist(), best.taken[0]):
                self.frames.give(int(track[row]), best.frames, taken)
                waited += [int(track[row])] if (taken >= NO_PARTICLE).sum() > 1 else []
            agreed, start = close.broken()
            for row, taken, many in zip(close.rows[0].tolist(), close.taken[0], agreed.tolist()):
                self.frames.give(int(track[row]), close.frames[:many], taken[:many])
                old.append(int(track[row]))
                if (taken[start:] >= 0).any():
                    track[row], kept[row] = self._take_id(), True
                    self.frames.give(int(track[row]), close.frames[start:], taken[start:])
                    new.append(int(track[row]))
            if waited:
                reason = f"conflict of {len(best.frames)} frames decided"
                self._event("resolved", scan, waited, reason)
            if old:
                behind = -conflict.weight[1]
                reason = (
                    f"continuation not safe: the log-likelihood ratio to the runner-up is "
                    f"{behind:.1f}, less than {self.settings.margin_log_ratio:g}"
                )
                self._event("break", scan, [*old, *new], reason)
            if still is not None:
                kept[still.rows] = True
                self.conflicts.append(still)
        self._keep(kept)

    def _births(self, scan: Scan, free: Ints) -> None:
        """Start tracks at free measurements; those that were seen often enough are confirmed, and
        those that were missed too often are given up."""
        given = scan.measured.given
        known = self.states.track[self.states.given]
        named = np.flatnonzero((given != NO_PARTICLE) & ~np.isin(given, known))
        self._unconfirmed -= len(free)
        new = self._unconfirmed + np.arange(len(free))[::-1]
        columns, tracks = np.concatenate([free, named]), np.concatenate([new, given[named]])
        if len(columns):
            in_lab = self.stage.in_lab
            velocity = np.array(self.up) * (self.settings.rise_mm_s if in_lab else 0.0)
            born = States.born(scan, columns, tracks, velocity, in_lab)
            found = beside(self._confirmed(), born.points_mm, tracks)
            self._parents |= zip(tracks.tolist(), found)
            self.frames.give(tracks, scan.frame, columns)
            self.states = States.concat([self.states, born])
        now_named = self.states.given & np.isin(self.states.track, given[named])
        for row in np.flatnonzero(now_named).tolist():
            self.next_id = max(self.next_id, int(self.states.track[row]) + 1)
            self._confirm(scan, row, "id given with the data")
        states, settings = self.states, self.settings
        tentative = states.track < NO_PARTICLE
        for row in np.flatnonzero(tentative & (states.hits >= settings.confirm_hits)).tolist():
            old, states.track[row] = int(states.track[row]), self._take_id()
            self.frames.rename(old, int(states.track[row]))
            self._parents[int(states.track[row])] = self._parents[old]
            self._confirm(scan, row, f"{FIRST_SEEN} {states.born_frame[row]}")
        missed = scan.frame - states.born_frame + 1 - states.hits
        spare = settings.confirm_frames - settings.confirm_hits
        self._keep((states.track > NO_PARTICLE) | (missed <= spare))
        waiting = self.states.track[self.states.track < NO_PARTICLE].tolist()
        self._parents = {track: self._parents[track] for track in waiting}

    def _confirm(self, scan: Scan, row: int, reason: str) -> None:
        one = self.states.take([row])
        track = int(one.track[0])
        self._event("birth", scan, (track,), reason)
        self.events += related("split", self._parents[track], one, self._confirmed(), scan)

    def _deaths(self, scan: Scan) -> None:
        """End the tracks without rivals that have been unseen for too long."""
        states, settings = self.states, self.settings
        unseen = self._single & (states.track > NO_PARTICLE) & (states.seen_frame != scan.frame)
        if not unseen.any():
            self._lost = {}
            return
        confirmed, lost = self._confirmed(), states.take(unseen)
        nearest = beside(confirmed, lost.points_mm, lost.track)
        self._lost = {t: self._lost.get(t) or new for t, new in zip(lost.track.tolist(), nearest)}
        waited_s, frames = scan.t_s - states.seen_t_s, scan.frame - states.seen_frame
        dead = unseen & (waited_s > settings.gap_s) & (frames > settings.gap_frames)
        for row in np.flatnonzero(dead).tolist():
            one, track = states.take([row]), int(states.track[row])
            self.events += related("merge", self._lost.pop(track), one, confirmed, scan)
            reason = not_seen_since(int(states.seen_frame[row]), float(waited_s[row]))
            self._event("death", scan, (track,), reason)
        self._keep(~dead)
