"""Tracks whose ids came with the measurements: no association, only their filters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.tracking.association.advance import Scan, continue_track
from telerig.estimator.tracking.filter.state import Common, Track

Array = NDArray[np.float64]


def follow_given(
    tracks: Sequence[Track], scan: Scan, common: Common
) -> tuple[Common, list[Array], list[int]]:
    """Update the tracks in place; the common shift they tell, their gains, the columns that are
    no track's yet."""
    columns = {int(scan.measured.particle[c]): int(c) for c in scan.columns}
    at = [columns.pop(t.particle, -1) for t in tracks]
    seen = [(t, c) for t, c in zip(tracks, at) if c >= 0]
    fresh = sorted(columns.values())
    if not seen:
        return common, [], fresh
    points = np.array([scan.measured.points_mm[c] for _, c in seen])
    noise = np.array([scan.measured.covariance_mm2[c] for _, c in seen])
    x = np.array([t.filter.x[:3] for t, _ in seen])
    p = np.array([t.filter.P[:, :3] for t, _ in seen])
    covariance = p[:, :3] + noise
    common = common.informed(points - x, covariance)
    gains = p @ np.linalg.inv(covariance)
    mean_gain = gains.mean(0)
    for track, column in zip(tracks, at):
        continue_track(track, column, scan, common, mean_gain)
    return Common(np.zeros_like(common.shift), common.covariance), list(gains), fresh
