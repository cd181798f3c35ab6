"""Which particle each measurement of the last frames belongs to, while a conflict may change it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from telerig.estimator.tracking.filter.types import NO_PARTICLE, FrameIds, Ids, TrackEvent

_SPARE = 16


class OpenFrames:
    """The ids of frames that are still open, and when each living particle was last seen."""

    def __init__(self) -> None:
        self._frames: dict[int, tuple[float, Ids, Ids]] = {}
        self._seen: dict[int, int] = {}

    def begin(self, frame: int, t_s: float, points: int, singles: int) -> None:
        self._frames[frame] = (t_s, np.full(points, NO_PARTICLE), np.full(singles, NO_PARTICLE))

    def write(self, entries: Iterable[tuple[int, int]], particle: int) -> None:
        """entries : (frame, column), column -1 where it was missed; they replace the particle's
        earlier entries in these frames."""
        for frame, column in entries:
            ids = self._frames[frame][1]
            if particle != NO_PARTICLE:
                ids[ids == particle] = NO_PARTICLE
            if column >= 0:
                ids[column] = particle

    def write_single(self, frame: int, index: int, particle: int) -> None:
        self._frames[frame][2][index] = particle

    def now(self, frame: int) -> tuple[Ids, Ids]:
        _, particle, single = self._frames[frame]
        return particle.copy(), single.copy()

    def close(
        self, before_frame: int, alive: set[int]
    ) -> tuple[tuple[FrameIds, ...], list[TrackEvent]]:
        """The frames before ``before_frame``, and the gaps that their tracks bridge.

        Particles that are not ``alive`` are forgotten now and then.
        """
        out, events = [], []
        for frame in [f for f in self._frames if f < before_frame]:
            t_s, particle, single = self._frames.pop(frame)
            out.append(FrameIds(frame, particle, single))
            for p in sorted({*particle.tolist(), *single.tolist()} - {NO_PARTICLE}):
                missed = frame - self._seen.get(p, frame - 1) - 1
                self._seen[p] = frame
                if missed > 0:
                    words = f"{missed} frames bridged" if missed > 1 else "1 frame bridged"
                    events.append(TrackEvent("gap", frame, t_s, (p,), words))
        if len(self._seen) > 2 * len(alive) + _SPARE:
            self._seen = {p: f for p, f in self._seen.items() if p in alive}
        return tuple(out), events
