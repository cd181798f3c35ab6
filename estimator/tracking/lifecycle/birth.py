"""New tracks: held back until confirmed, and told apart from splits and mergers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.tracking.association.advance import Scan, continue_track
from telerig.estimator.tracking.association.likelihoods import (
    best_assignment,
    gated_pairs,
    settle_shift,
)
from telerig.estimator.tracking.association.single_camera import unrivalled
from telerig.estimator.tracking.filter.motion import birth_covariance
from telerig.estimator.tracking.filter.state import Common, Track, new_filter
from telerig.estimator.tracking.filter.types import TrackerSettings

Array = NDArray[np.float64]


def extend(
    tentative: Sequence[Track], scan: Scan, common: Common, mean_gain: Array | None
) -> tuple[list[Track], Common, Array | None]:
    """Continue the tentative tracks with the free measurements; those with a rival are given up.

    Where no confirmed track told the common shift (mean_gain None), they tell it themselves.
    """
    if not tentative:
        return [], common, mean_gain
    pairs = gated_pairs(tentative, scan.measured, scan.columns, common, scan.settings)
    if mean_gain is None:
        everyone = np.ones(len(tentative), bool)
        common, chosen = settle_shift(pairs, len(tentative), everyone, common)
    else:
        score = pairs.scores(common.shift_mm)
        chosen = best_assignment(len(tentative), pairs.row, pairs.column, score)
    score = pairs.scores(common.shift_mm)
    safe = unrivalled(pairs.row, pairs.column, score, chosen, scan.settings.margin_nats)
    picked = np.flatnonzero(chosen[pairs.row] == pairs.column)
    if mean_gain is None and len(picked):
        p = np.array([tentative[r].filter.P[:, :3] for r in pairs.row[picked]])
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
    missed = frame - track.born_frame + 1 - len(track.history)
    return missed > settings.confirm_frames - settings.confirm_hits


def born(
    scan: Scan, column: int, velocity_mm_s: Array, encoder: bool, tracks: Sequence[Track]
) -> Track:
    """A tentative track at a measurement; ``tracks`` are the confirmed ones it may stem from."""
    point = scan.measured.points_mm[column]
    covariance = birth_covariance(scan.settings, scan.measured.covariance_mm2[column], encoder)
    x = np.zeros(len(covariance))
    x[:3], x[3:6] = point, velocity_mm_s
    out = Track(new_filter(x, covariance), born_frame=scan.frame, history=[(scan.frame, column)])
    out.saw(scan.frame, scan.t_s, float(scan.measured.d_eq_mm[column]))
    out.parent = beside(point, tracks)
    return out


def beside(point_mm: Array, tracks: Sequence[Track]) -> tuple[int, float] | None:
    """The nearest track whose bubble could touch one at the point: its id, its size before."""
    sized = [t for t in tracks if np.isfinite(t.d_eq_mm)]
    if not sized:
        return None
    away = np.linalg.norm([t.filter.x[:3] - point_mm for t in sized], axis=1)
    nearest = int(away.argmin())
    track = sized[nearest]
    if away[nearest] > 1.5 * track.d_eq_mm:
        return None
    before = track.d_before_mm if np.isfinite(track.d_before_mm) else track.d_eq_mm
    return track.particle, before


def volumes_balance(whole_mm: float, part_a_mm: float, part_b_mm: float, tolerance: float) -> bool:
    """Whether two diameters make up a third, by volume within the relative tolerance."""
    off = abs(part_a_mm**3 + part_b_mm**3 - whole_mm**3)
    return bool(off <= tolerance * whole_mm**3)
