"""Tracks that end, and whether a birth was a split or an end a merger."""

from __future__ import annotations

from collections.abc import Sequence

from telerig.estimator.tracking.association.advance import Scan
from telerig.estimator.tracking.filter.state import Track
from telerig.estimator.tracking.filter.types import TrackEvent
from telerig.estimator.tracking.lifecycle.birth import beside, volumes_balance


def split_off(track: Track, confirmed: Sequence[Track], scan: Scan) -> list[TrackEvent]:
    """The event that a newly confirmed track is a part of the one it was born beside, if it is."""
    parents = {t.particle: t for t in confirmed}
    if track.parent is None or track.parent[0] not in parents:
        return []
    parent, before = parents[track.parent[0]], track.parent[1]
    sizes = (before, parent.d_last_mm, track.d_last_mm)
    if not volumes_balance(*sizes, scan.settings.balance_tolerance):
        return []
    reason = "d_eq {:.2f} mm became {:.2f} and {:.2f} mm".format(*sizes)
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
            track.near = beside(track.filter.x[:3], others)
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
    sizes = (other.d_last_mm, before, track.d_eq_mm)
    if not volumes_balance(*sizes, scan.settings.balance_tolerance):
        return []
    reason = "d_eq {1:.2f} and {2:.2f} mm became {0:.2f} mm".format(*sizes)
    return [TrackEvent("merge", scan.frame, scan.t_s, (other.particle, track.particle), reason)]
