"""Birth and death of tracks, and whether a birth was a split or an end a merger."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.tracking.association.advance import Scan, continue_track
from telerig.estimator.tracking.association.likelihoods import (
    assigned_with_shift,
    best_assignment,
    gated_pairs,
    unrivalled,
)
from telerig.estimator.tracking.filter.motion import POSITION, VELOCITY, birth_covariance
from telerig.estimator.tracking.filter.state import Common, Track, new_filter
from telerig.estimator.tracking.filter.types import TrackerSettings, TrackEvent

Array = NDArray[np.float64]

_TOUCHING = 1.5
"""Largest distance of two centres, in diameters, of bubbles that may have been one."""


def born(
    scan: Scan, column: int, velocity_mm_s: Array, encoder: bool, tracks: Sequence[Track]
) -> Track:
    """A tentative track at a measurement; ``tracks``: the confirmed ones it may stem from."""
    point = scan.measured.points_mm[column]
    covariance = birth_covariance(scan.settings, scan.measured.covariance_mm2[column], encoder)
    x = np.zeros(len(covariance))
    x[POSITION], x[VELOCITY] = point, velocity_mm_s
    out = Track(new_filter(x, covariance), born_frame=scan.frame, history=[(scan.frame, column)])
    out.saw(scan.frame, scan.t_s, float(scan.measured.d_eq_mm[column]))
    out.parent = _beside(point, tracks)
    return out


def extend(
    tentative: Sequence[Track], scan: Scan, common: Common, mean_gain: Array | None
) -> tuple[list[Track], Common, Array | None]:
    """Continue the tentative tracks with the free measurements; those with a rival are given up.

    Where no confirmed track determined the common shift (mean_gain None), they determine it.
    """
    if not tentative:
        return [], common, mean_gain
    pairs = gated_pairs(tentative, scan.measured, scan.columns, common, scan.settings)
    if mean_gain is None:
        everyone = np.ones(len(tentative), bool)
        common, chosen = assigned_with_shift(pairs, len(tentative), everyone, common)
    else:
        score = pairs.scores(common.shift_mm)
        chosen = best_assignment(len(tentative), pairs.row, pairs.column, score)
    score = pairs.scores(common.shift_mm)
    safe = unrivalled(pairs.row, pairs.column, score, chosen, scan.settings.margin_nats)
    picked = np.flatnonzero(chosen[pairs.row] == pairs.column)
    if mean_gain is None and len(picked):
        p = np.array([tentative[r].filter.P[:, POSITION] for r in pairs.row[picked]])
        mean_gain = (p @ pairs.information[picked]).mean(0)
    gain = np.zeros((len(common.shift), 3)) if mean_gain is None else mean_gain
    out = []
    for i, track in enumerate(tentative):
        if chosen[i] >= 0 and not safe[i]:
            continue
        continue_track(track, int(chosen[i]), scan, common, gain)
        if chosen[i] >= 0:
            track.history.append((scan.frame, int(chosen[i])))
        out.append(track)
    return out, common, mean_gain


def hopeless(track: Track, frame: int, settings: TrackerSettings) -> bool:
    """Whether a tentative track was missed too often to be confirmed."""
    missed = frame - track.born_frame + 1 - len(track.history)
    return missed > settings.confirm_frames - settings.confirm_hits


def split_off(track: Track, confirmed: Sequence[Track], scan: Scan) -> list[TrackEvent]:
    """The event that a newly confirmed track is a part of the one it was born beside, if it is."""
    parents = {t.particle: t for t in confirmed}
    if track.parent is None or track.parent[0] not in parents:
        return []
    parent, before = parents[track.parent[0]], track.parent[1]
    if not _volumes_balance(before, parent.d_last_mm, track.d_last_mm, scan.settings):
        return []
    reason = f"d_eq {before:.2f} mm became {parent.d_last_mm:.2f} and {track.d_last_mm:.2f} mm"
    return [TrackEvent("split", scan.frame, scan.t_s, (parent.particle, track.particle), reason)]


def ended(
    tracks: Sequence[Track], confirmed: Sequence[Track], scan: Scan
) -> tuple[set[int], list[TrackEvent]]:
    """Particles unseen for too long, and the events; a track just lost remembers who was beside."""
    dead, events = set(), []
    for track in tracks:
        if track.seen_frame == scan.frame:
            continue
        if track.near is None:
            others = [t for t in confirmed if t.particle != track.particle]
            track.near = _beside(track.point_mm, others)
        unseen, frames = scan.t_s - track.seen_t_s, scan.frame - track.seen_frame
        if unseen > scan.settings.gap_s and frames > scan.settings.gap_frames:
            dead.add(track.particle)
            events += _merged_into(track, confirmed, scan)
            reason = f"not seen since frame {track.seen_frame}, {unseen:.3f} s"
            events.append(TrackEvent("death", scan.frame, scan.t_s, (track.particle,), reason))
    return dead, events


def _merged_into(track: Track, confirmed: Sequence[Track], scan: Scan) -> list[TrackEvent]:
    others = {t.particle: t for t in confirmed}
    if track.near is None or track.near[0] not in others:
        return []
    other, before = others[track.near[0]], track.near[1]
    if not _volumes_balance(other.d_last_mm, before, track.d_eq_mm, scan.settings):
        return []
    reason = f"d_eq {before:.2f} and {track.d_eq_mm:.2f} mm became {other.d_last_mm:.2f} mm"
    return [TrackEvent("merge", scan.frame, scan.t_s, (other.particle, track.particle), reason)]


def _beside(point_mm: Array, tracks: Sequence[Track]) -> tuple[int, float] | None:
    """The nearest track whose bubble could touch one at the point: its id, its size before."""
    sized = [t for t in tracks if np.isfinite(t.d_eq_mm)]
    if not sized:
        return None
    away = np.linalg.norm([t.point_mm - point_mm for t in sized], axis=1)
    nearest = int(away.argmin())
    track = sized[nearest]
    if away[nearest] > _TOUCHING * track.d_eq_mm:
        return None
    before = track.d_before_mm if np.isfinite(track.d_before_mm) else track.d_eq_mm
    return track.particle, before


def _volumes_balance(
    whole_mm: float, part_a_mm: float, part_b_mm: float, settings: TrackerSettings
) -> bool:
    """Whether the volumes of two diameters add up to that of a third, within the tolerance."""
    off = abs(part_a_mm**3 + part_b_mm**3 - whole_mm**3)
    return bool(off <= settings.balance_tolerance * whole_mm**3)
