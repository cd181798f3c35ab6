"""Events of tracks are those of the final frames, which backtracking has filled."""

from __future__ import annotations

import numpy as np

from telerig.estimator.tracking.linking.filter import TrackEvent
from telerig.estimator.tracking.linking.lifetimes import (
    FIRST_SEEN,
    Lifetimes,
    not_seen_since,
)


def test_gaps_are_those_that_are_left() -> None:
    lives, gaps = Lifetimes(), []
    for frame, tracks in enumerate([[0, -1], [0], [-1], [1], [0, 1], [0], [0, 1]]):
        gaps += lives.add(frame, frame / 100, np.array(tracks))
    assert [(e.frame, e.t_s, e.particles, e.reason) for e in gaps] == [
        (4, 0.04, (0,), "2 frames bridged"),
        (6, 0.06, (1,), "1 frame bridged"),
    ]


def test_births_and_deaths_know_what_was_filled_in() -> None:
    lives = Lifetimes()
    for frame in range(3, 21):
        lives.add(frame, frame / 100, np.array([7] if frame < 13 else [8]))
    told = [
        TrackEvent("birth", 6, 0.06, (7,), f"{FIRST_SEEN} 4"),
        TrackEvent("birth", 14, 0.14, (8,), "id given with the data"),
        TrackEvent("death", 17, 0.17, (7,), not_seen_since(10, 0.07)),
        TrackEvent("death", 18, 0.18, (8,), not_seen_since(13, 0.05)),
        TrackEvent("split", 14, 0.14, (7, 8), "one became two"),
    ]
    birth, given, death, late, split = lives.corrected(told)
    assert birth.reason == "first seen in frame 3" and birth.frame == 6
    assert death.reason == "not seen since frame 12, 0.050 s" and death.frame == 17
    assert (late.frame, late.t_s, late.reason) == (20, 0.2, "last seen in this frame")
    assert (given, split) == (told[1], told[4])
