"""What the events of tracks say, of final frames: backtracking fills gaps and moves beginnings and
ends after the tracker has told of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from telerig.arrays import Ints
from telerig.estimator.tracking.linking.filter import TrackEvent
from telerig.estimator.tracking.linking.frames import NO_PARTICLE
from telerig.short_text import counted


class Lifetimes:
    """When each track was measured first and last, in the final frames so far."""

    def __init__(self) -> None:
        self._first: dict[int, int] = {}
        self._last: dict[int, tuple[int, float]] = {}

    def add(self, frame: int, t_s: float, particles: Ints) -> list[TrackEvent]:
        """Take in the tracks (M,) measured in the next final frame; return a "gap" event for each
        gap that ends in it."""
        gaps = []
        for track in sorted({*particles.tolist()} - {NO_PARTICLE}):
            self._first.setdefault(track, frame)
            missed = frame - self._last.get(track, (frame - 1, t_s))[0] - 1
            self._last[track] = frame, t_s
            if missed > 0:
                words = f"{counted(missed, 'frame')} bridged"
                gaps.append(TrackEvent("gap", frame, t_s, (track,), words))
        return gaps

    def corrected(self, events: Iterable[TrackEvent]) -> list[TrackEvent]:
        """Return events of which births and deaths say when the track was really seen first and
        last; a death is never before that."""
        return [self._corrected(event) for event in events]

    def _corrected(self, event: TrackEvent) -> TrackEvent:
        track = event.particles[0]
        if not isinstance(track, int) or track not in self._last:
            return event
        if event.kind == "birth" and event.reason.startswith(FIRST_SEEN):
            return replace(event, reason=f"{FIRST_SEEN} {self._first[track]}")
        if event.kind == "death":
            frame, t_s = self._last[track]
            if frame < event.frame:
                return replace(event, reason=not_seen_since(frame, event.t_s - t_s))
            return replace(event, frame=frame, t_s=t_s, reason="last seen in this frame")
        return event


FIRST_SEEN = "first seen in frame"


def not_seen_since(frame: int, waited_s: float) -> str:
    """Return the reason of a death."""
    return f"not seen since frame {frame}, {waited_s:.3f} s"
