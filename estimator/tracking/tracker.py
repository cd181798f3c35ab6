"""Bubbles followed through time in the rig frame, frame by frame, from birth to death.

A track is born tentative and confirmed after some hits; it ends when it was not seen for too long.
The ids of a frame stay open while a conflict or a birth may change them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.estimator.bubbles.pairing.evidence import Prediction
from telerig.estimator.tracking.association import (
    Cluster,
    Scan,
    advance,
    assigned_with_shift,
    clear_assignment,
    continue_tracks,
    decide,
    expected,
    gated_pairs,
)
from telerig.estimator.tracking.filter import (
    NO_PARTICLE,
    POSITION,
    STATES,
    VELOCITY,
    Common,
    FrameIds,
    FrameMeasurements,
    FrameResult,
    Motion,
    StageMotion,
    Track,
    TrackerSettings,
    TrackEvent,
    Transition,
    birth_covariance,
    predict_tracks,
    transition,
)

_SPARE = 16
"""Tracks that have ended and are still remembered, beside twice as many as live."""


class OpenFrames:
    """Hold the track ids of the undecided frames, and when each track was last seen."""

    def __init__(self) -> None:
        self._frames: dict[int, tuple[float, Ints]] = {}
        self._seen: dict[int, int] = {}

    def begin(self, frame: int, t_s: float, count: int) -> None:
        """Add a frame with so many measurements, without ids."""
        self._frames[frame] = (t_s, np.full(count, NO_PARTICLE))

    def write(self, entries: Iterable[tuple[int, int]], particle: int) -> None:
        """Set the id of a track in some frames.

        entries : (frame, index of the measurement); the index is -1 where the track was missed.
        """
        for frame, column in entries:
            if column >= 0:
                self._frames[frame][1][column] = particle

    def close(
        self, before_frame: int, alive: set[int]
    ) -> tuple[tuple[FrameIds, ...], list[TrackEvent]]:
        """Return and forget the ids of all frames before ``before_frame``.

        alive : ids of the living tracks; when many others have been collected, they are forgotten.

        Returns the final ids of the frames, and a "gap" event for each gap that a track bridges.
        """
        out, events = [], []
        for frame in [f for f in self._frames if f < before_frame]:
            t_s, particle = self._frames.pop(frame)
            out.append(FrameIds(frame, particle))
            for p in sorted({*particle.tolist()} - {NO_PARTICLE}):
                missed = frame - self._seen.get(p, frame - 1) - 1
                self._seen[p] = frame
                if missed > 0:
                    words = f"{missed} frames bridged" if missed > 1 else "1 frame bridged"
                    events.append(TrackEvent("gap", frame, t_s, (p,), words))
        if len(self._seen) > 2 * len(alive) + _SPARE:
            self._seen = {p: f for p, f in self._seen.items() if p in alive}
        return tuple(out), events


_TOUCHING = 1.5
"""Largest distance of two centres, in diameters, of bubbles that may have been one."""


def extend(
    tentative: Sequence[Track], scan: Scan, free: Bools, common: Common, mean_gain: Array | None
) -> tuple[list[Track], Common, Array | None]:
    """Continue the tentative tracks with the measurements ``free`` (M,), which no other track uses.

    Tracks for which two measurements fit almost equally well are given up.

    common : the error that all bubbles have in common.
    mean_gain : (12, 3) mean Kalman gain of the confirmed tracks; None if no confirmed track was
        measured. The tentative tracks then determine the common shift.

    Returns the tracks that continue, the common error, and the mean gain (None if no track was
    measured).
    """
    many = len(tentative)
    if not many:
        return [], common, mean_gain
    allowed = np.tile(free, (many, 1))
    pairs = gated_pairs(expected(tentative), scan.measured, allowed, common, scan.settings)
    if mean_gain is None:
        common, _ = assigned_with_shift(pairs, many, np.ones(many, bool), common)
    chosen, clear = clear_assignment(pairs, many, common.shift_mm, scan.settings)
    picked = np.flatnonzero(chosen[pairs.row] == pairs.column)
    if mean_gain is None and len(picked):
        p = np.array([tentative[r].p[:, POSITION] for r in pairs.row[picked]])
        mean_gain = (p @ pairs.information[picked]).mean(0)
    gain = np.zeros((STATES, 3)) if mean_gain is None else mean_gain
    going = np.flatnonzero((chosen < 0) | clear).tolist()
    out, columns = [tentative[i] for i in going], chosen[going].tolist()
    continue_tracks(out, columns, scan, common, gain)
    for track, column in zip(out, columns):
        if column >= 0:
            track.history.append((scan.frame, column))
    return out, common, mean_gain


def hopeless(track: Track, frame: int, settings: TrackerSettings) -> bool:
    """Return whether a tentative track was missed too often to be confirmed."""
    missed = frame - track.born_frame + 1 - len(track.history)
    return missed > settings.confirm_frames - settings.confirm_hits


def related(kind: str, track: Track, confirmed: Sequence[Track], scan: Scan) -> list[TrackEvent]:
    """Return a "split" event if a newly confirmed track is a part of the track beside which it was
    born, or a "merge" event if a lost track is a part of the one beside which it was lost.

    There is none unless the volumes before and after agree within the tolerance.
    """
    noted = track.parent if kind == "split" else track.near
    other = next((t for t in confirmed if noted is not None and t.particle == noted[0]), None)
    if noted is None or other is None:
        return []
    whole, *parts = (
        (noted[1], other.d_last_mm, track.d_last_mm)
        if kind == "split"
        else (other.d_last_mm, noted[1], track.d_eq_mm)
    )
    off = abs(parts[0] ** 3 + parts[1] ** 3 - whole**3)
    if not off <= scan.settings.balance_tolerance * whole**3:
        return []
    both, one = f"{parts[0]:.2f} and {parts[1]:.2f} mm", f"{whole:.2f} mm"
    before, after = (one, both) if kind == "split" else (both, one)
    ids = other.particle, track.particle
    return [TrackEvent(kind, scan.frame, scan.t_s, ids, f"d_eq {before} became {after}")]


def ended(
    tracks: Sequence[Track], confirmed: Sequence[Track], scan: Scan
) -> tuple[set[int], list[TrackEvent]]:
    """Find the tracks that have been unseen for too long.

    tracks : the tracks to examine; one that has just been lost notes the nearest confirmed track.
    confirmed : all confirmed tracks.

    Returns the ids of the ended tracks, and their "death" and "merge" events.
    """
    dead, events = set(), []
    unseen_now = [t for t in tracks if t.seen_frame != scan.frame]
    neighbours = Neighbours(confirmed if unseen_now else ())
    for track in unseen_now:
        if track.near is None:
            track.near = neighbours.beside(track.point_mm, track)
        unseen, frames = scan.t_s - track.seen_t_s, scan.frame - track.seen_frame
        if unseen > scan.settings.gap_s and frames > scan.settings.gap_frames:
            dead.add(track.particle)
            events += related("merge", track, confirmed, scan)
            reason = f"not seen since frame {track.seen_frame}, {unseen:.3f} s"
            events.append(TrackEvent("death", scan.frame, scan.t_s, (track.particle,), reason))
    return dead, events


class Neighbours:
    """Find which of some tracks is beside a point."""

    def __init__(self, tracks: Sequence[Track]) -> None:
        self._tracks = [t for t in tracks if np.isfinite(t.d_eq_mm)]
        self._points_mm = np.array([t.point_mm for t in self._tracks]).reshape(-1, 3)

    def beside(self, point_mm: Array, own: Track | None = None) -> tuple[int, float] | None:
        """Return the nearest track, other than ``own``, whose bubble could touch one at a point.

        It is given as its id and its former diameter in mm; None if no track is near enough.
        """
        away = np.sqrt(((self._points_mm - point_mm) ** 2).sum(1))
        for k in away.argsort()[:2].tolist():
            track = self._tracks[k]
            if track is not own:
                before = track.d_before_mm if np.isfinite(track.d_before_mm) else track.d_eq_mm
                near = away[k] <= _TOUCHING * track.d_eq_mm
                return (track.particle, before) if near else None
        return None


class Tracker:
    """Follow bubbles: take the measurements of one frame after another and return track ids.

    axis_rig : (3,) the stage's travel direction in the rig frame, along which bubbles also rise. It
        need not have unit length.
    settings : None for the defaults.
    first_id : id of the first track; it has to be larger than any id given with the measurements.

    Take the ids for tables from `FrameResult.final` and from `finish`. A frame stays undecided
    while a conflict or a birth in it is undecided, at most for ``window_frames`` or
    ``confirm_frames`` frames. The memory that is needed does not grow with the length of the run.

    Raises InputError when axis_rig is no direction.
    """

    def __init__(
        self,
        axis_rig: ArrayLike = (0.0, -1.0, 0.0),
        settings: TrackerSettings | None = None,
        *,
        first_id: int = 0,
    ) -> None:
        axis = np.asarray(axis_rig, float)
        if axis.shape != (3,) or not np.linalg.norm(axis) > 0:
            raise InputError(
                f"axis_rig = {axis.tolist()}", todo="give a direction of three numbers"
            )
        unit = (axis / np.linalg.norm(axis)).tolist()
        self.axis: tuple[float, float, float] = (unit[0], unit[1], unit[2])
        self.settings = TrackerSettings() if settings is None else settings
        self.next_id = first_id
        self.clusters: list[Cluster] = []
        self.tentative: list[Track] = []
        self.common = Common()
        self.stage = StageMotion()
        self.frames = OpenFrames()
        self.last: tuple[int, float] | None = None
        self.events: list[TrackEvent] = []

    def predict(self, t_s: float, position_mm: float | None = None) -> Prediction:
        """Return the expected positions of the confirmed tracks in the rig frame; the tracker is
        unchanged.

        t_s : time of the frame.
        position_mm : encoder position of the stage at that time; None if it has to be extrapolated.

        Raises InputError when t_s is not later than the last frame's time.
        """
        tracks = self._confirmed()
        if not tracks or self.last is None:
            return expected(tracks)
        step, control, found = self._motion(replace(self.stage), t_s, position_mm)
        x = np.array([t.x for t in tracks])
        x[:, VELOCITY] += found
        x = x @ step.matrix.T + control
        p = np.array([t.p for t in tracks]) + self.common.covariance
        p = step.matrix @ p @ step.matrix.T + step.noise + step.common_noise
        points, covariances = x[:, POSITION], p[:, POSITION, POSITION]
        return replace(expected(tracks), points_mm=points, covariance_mm2=covariances)

    def update(
        self,
        frame: int,
        t_s: float,
        measured: FrameMeasurements,
        position_mm: float | None = None,
    ) -> FrameResult:
        """Take in the measurements of one frame and return what is final.

        frame, t_s : number and time of the frame; both have to increase.
        measured : the bubbles of the frame.
        position_mm : encoder position of the stage; None or NaN if there is none.

        Raises InputError when frame or t_s do not increase.
        """
        self._check(frame, t_s)
        motion = self._predict_all(t_s, position_mm)
        self.last = (frame, t_s)
        self.frames.begin(frame, t_s, len(measured))
        self.events = []
        scan = Scan(frame, t_s, measured, self.settings)
        grown, common, gain = advance(self.clusters, scan, self.common)
        claimed = self._decide(grown, scan)
        moved = None if motion is None else motion.shifted(common.shift, common.covariance_mm2)
        self._births(scan, claimed, common, gain)
        self._deaths(scan)
        final = self._close(self._open_since(frame))
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
        nothing = FrameMeasurements.create(np.zeros((0, 3)), np.zeros((0, 3, 3)))
        scan = Scan(*self.last, nothing, self.settings)
        self._decide(self.clusters, scan, at_once=True)
        self.tentative = []
        final = self._close(scan.frame + 1)
        return FrameResult(tuple(self.events), final)

    def _close(self, before_frame: int) -> tuple[FrameIds, ...]:
        final, gaps = self.frames.close(before_frame, {t.particle for t in self._confirmed()})
        self.events += gaps
        return final

    def _confirmed(self) -> list[Track]:
        return [t for c in self.clusters for t in c.tracks]

    def _every(self) -> list[Track]:
        return [*(t for c in self.clusters for b in c.branches for t in b.tracks), *self.tentative]

    def _open_since(self, frame: int) -> int:
        starts = [c.since_frame for c in self.clusters if c.open]
        starts += [t.born_frame for t in self.tentative]
        return min([frame + 1, *starts])

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
        step = transition(self.settings, self.axis, round(dt, 12), known)
        control = np.zeros(STATES)
        control[POSITION] -= axis * moved_mm
        return step, control, axis * found_mm_s

    def _predict_all(self, t_s: float, position_mm: float | None) -> Motion | None:
        if self.last is None:
            self.stage.step(position_mm, t_s, 0.0)
            return None
        step, control, found = self._motion(self.stage, t_s, position_mm)
        every = self._every()
        self.common = self.common.predicted(step) if every else Common()
        if found.any():
            for track in every:
                track.x = track.x + np.pad(found, (3, STATES - 6))
        predict_tracks(every, step, control)
        return Motion(step.matrix, step.noise, step.matrix[:, VELOCITY] @ found + control)

    def _new(self, scan: Scan, column: int) -> Track:
        """Start a tentative track at a measurement, with the mean rise if velocities are the lab's.

        The nearest confirmed track is noted as a possible parent.
        """
        measured, in_lab = scan.measured, self.stage.in_lab
        x = np.zeros(STATES)
        x[POSITION] = measured.points_mm[column]
        x[VELOCITY] = np.array(self.axis) * (self.settings.rise_mm_s if in_lab else 0.0)
        p = birth_covariance(self.settings, measured.covariance_mm2[column], in_lab)
        out = Track(x, p, born_frame=scan.frame, history=[(scan.frame, column)])
        out.saw(scan.frame, scan.t_s, float(measured.d_eq_mm[column]))
        out.parent = Neighbours(self._confirmed()).beside(out.point_mm)
        return out

    def _event(self, kind: str, scan: Scan, particles: tuple[int, ...], reason: str) -> None:
        self.events.append(TrackEvent(kind, scan.frame, scan.t_s, particles, reason))

    def _take_id(self) -> int:
        self.next_id += 1
        return self.next_id - 1

    def _decide(self, grown: Sequence[Cluster], scan: Scan, *, at_once: bool = False) -> Ints:
        """Decide the conflicts that can be decided; the columns that some track claims."""
        claimed, out = [], []
        for cluster in grown:
            histories = [h for b in cluster.branches for h in b.history.values()]
            claimed += [c for h in histories for f, c in h[-1:] if f == scan.frame and c >= 0]
            still, decided = decide(cluster, scan.frame, self.settings, at_once=at_once)
            waited, old, new = dict[int, int](), [], []
            for one in decided:
                track = one.track
                self.frames.write(one.kept, track.particle)
                if one.new is None:
                    waited |= {track.particle: len(one.kept)} if len(one.kept) > 1 else {}
                else:
                    old.append(track.particle)
                if one.new:
                    track.particle = self._take_id()
                    self.frames.write(one.new, track.particle)
                    new.append(track.particle)
                if one.new != []:
                    out.append(Cluster.of(track))
            if waited:
                reason = f"conflict of {max(waited.values())} frames decided"
                self._event("resolved", scan, tuple(waited), reason)
            if old:
                behind = -cluster.branches[1].weight
                reason = (
                    f"continuation not safe: the log-likelihood ratio to the runner-up is "
                    f"{behind:.1f}, less than {self.settings.margin_log_ratio:g}"
                )
                self._event("break", scan, (*old, *new), reason)
            if still is not None:
                out.append(still)
        self.clusters = out
        return np.unique(np.array(claimed, np.int64))

    def _births(self, scan: Scan, claimed: Ints, common: Common, gain: Array | None) -> None:
        """Tentative tracks go on, are confirmed or given up; what is left starts new ones."""
        measured = scan.measured
        free = ~measured.alone & (measured.particle == NO_PARTICLE)
        free[claimed] = False
        going, common, gain = extend(self.tentative, scan, free, common, gain)
        self.common = common.applied(np.zeros((STATES, 3)) if gain is None else gain)
        free[[c for t in going for f, c in t.history[-1:] if f == scan.frame]] = False
        fresh = [self._new(scan, column) for column in np.flatnonzero(free).tolist()]
        self.tentative = []
        for track in [*going, *fresh]:
            if len(track.history) >= self.settings.confirm_hits:
                track.particle = self._take_id()
                self._confirm(track, scan, f"first seen in frame {track.history[0][0]}")
            elif not hopeless(track, scan.frame, self.settings):
                self.tentative.append(track)
        given = {t.particle for t in self._confirmed() if t.given}
        for column in np.flatnonzero(measured.particle != NO_PARTICLE).tolist():
            particle = int(measured.particle[column])
            if particle not in given:
                track = replace(self._new(scan, column), particle=particle, given=True)
                self.next_id = max(self.next_id, particle + 1)
                self._confirm(track, scan, "id given with the data")

    def _confirm(self, track: Track, scan: Scan, reason: str) -> None:
        self.frames.write(track.history, track.particle)
        self._event("birth", scan, (track.particle,), reason)
        self.events += related("split", track, self._confirmed(), scan)
        track.history, track.parent = [], None
        self.clusters.append(Cluster.of(track))

    def _deaths(self, scan: Scan) -> None:
        closed = [c.tracks[0] for c in self.clusters if not c.open]
        dead, found = ended(closed, self._confirmed(), scan)
        self.events += found
        if dead:
            self.clusters = [c for c in self.clusters if c.tracks[0].particle not in dead]
