"""The stage's motion as the tracker's control input, with and without an encoder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class StageStep:
    """moved_mm : of the stage along its axis; known : told by the encoder.

    found_speed_mm_s : not 0 in the one step in which the encoder is first heard of: until then
    velocities were relative to the rig.
    """

    moved_mm: float
    known: bool
    found_speed_mm_s: float


@dataclass
class StageMotion:
    """in_lab : velocities are the lab's, since the encoder has told a speed.

    read_mm, read_t_s : the last reading; assumed_mm : where the tracks think the stage is.
    """

    in_lab: bool = False
    read_mm: float = float("nan")
    read_t_s: float = float("nan")
    assumed_mm: float = float("nan")
    speed_mm_s: float = 0.0

    def step(self, position_mm: float | None, t_s: float, dt_s: float) -> StageStep:
        """A missing reading (None, NaN) goes on at the last speed; the next one corrects it."""
        if position_mm is None or not np.isfinite(position_mm):
            moved = self.speed_mm_s * dt_s if self.in_lab else 0.0
            self.assumed_mm += moved
            return StageStep(moved, False, 0.0)
        if not np.isfinite(self.read_mm):
            self._read(position_mm, t_s)
            return StageStep(0.0, False, 0.0)
        speed = (position_mm - self.read_mm) / (t_s - self.read_t_s)
        moved = position_mm - self.assumed_mm
        found = 0.0 if self.in_lab else speed
        if not self.in_lab:
            moved = speed * dt_s
        self.in_lab, self.speed_mm_s = True, speed
        self._read(position_mm, t_s)
        return StageStep(moved, True, found)

    def _read(self, position_mm: float, t_s: float) -> None:
        self.read_mm = self.assumed_mm = float(position_mm)
        self.read_t_s = float(t_s)
