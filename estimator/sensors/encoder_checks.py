"""Checks an encoder's record for jumps, single wrong readings, overflow of the counter and bunched
times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.sensors.record_numbers import runs
from telerig.estimator.sensors.spikes import LONGEST_SPIKE, prediction_residual
from telerig.short_text import counted, counted_list
from telerig.statistics import GAP_STEPS, robust_sd

_SIGMAS = 10.0
_COUNTS = 4.0
_LEAST_MM = 0.002
_RETURNS = 0.3
_WRAP_OF_RANGE = 0.5
_LEAST_RECORD = 6
_SHARE = 0.3
_HARMLESS_MM = 0.05
_REAL_M_S2 = 50.0
_SHOWN = 3
_BUNCHED = 0.1
"""A bunch takes less than this share of the mean step and of the time to the next one."""
_LEAST_BUNCHES = 10


@dataclass(frozen=True)
class EncoderFault:
    """A fault in an encoder's record: from the time t_s on, the readings are wrong by size_mm.

    kind : "jump" if the error persists, "spike" if it ends after ``readings`` readings, "wrap" if
        the counter overflows.
    step_s : time between the readings before and after the fault.
    """

    t_s: float
    size_mm: float
    kind: Literal["jump", "spike", "wrap"]
    step_s: float
    readings: int = 0

    @property
    def acceleration_m_s2(self) -> float:
        """The least acceleration that moves the carriage by the fault's size within its step."""
        return 4e-3 * abs(self.size_mm) / self.step_s**2

    def affects(self, t_s: Array, frames_t_s: Array) -> bool:
        """Return whether the fault changes differences of position between frames."""
        first = int(np.searchsorted(t_s, self.t_s))
        begin = t_s[max(first - 1, 0)]
        if self.kind == "spike":
            end = t_s[min(first + self.readings, len(t_s) - 1)]
            return bool(np.any((frames_t_s > begin) & (frames_t_s < end)))
        return bool(frames_t_s[0] < self.t_s and frames_t_s[-1] > begin)

    @property
    def words(self) -> str:
        """The fault in words."""
        at = f"{self.size_mm:+.4g} mm"
        if self.kind == "spike":
            return f"{self.readings} reading(s) from {self.t_s:.6g} s on are wrong by {at}"
        what = "the counter wraps round" if self.kind == "wrap" else "the reading jumps"
        return f"{what} by {at} at {self.t_s:.6g} s"

    @property
    def remedy(self) -> str:
        """What the user can do about a jump."""
        what = "unwrap the counter: " if self.kind == "wrap" else ""
        return (
            f"{what}subtract {self.size_mm:.6g} mm from every position from {self.t_s:.6g} s on, "
            "or cut the run there"
        )


def check_encoder(
    t_s: ArrayLike, position_mm: ArrayLike, frames_t_s: ArrayLike, *, where: str = "stage"
) -> tuple[Bools, list[Finding]]:
    """Return which readings (E,) can be used, and what is wrong with the others.

    Single wrong readings are masked. A jump that affects the frames is refused (`ENCODER_JUMP`),
    and so are times that come in bunches (`ENCODER_CLOCK`).
    What looks like a wrong end of the record may be a stage that starts or stops between two
    readings, where these are far apart.
    """
    t, frames = np.asarray(t_s, float), np.asarray(frames_t_s, float)
    kept = np.ones(len(t), bool)
    bunched = _bunched(t, np.asarray(position_mm, float), frames, where)
    if bunched is not None:
        return kept, [bunched]
    faults = encoder_faults(t, position_mm)
    spikes = []
    for fault in (f for f in faults if f.kind == "spike"):
        first = int(np.searchsorted(t, fault.t_s))
        end = first + fault.readings
        if (first > 0 and end < len(t)) or fault.acceleration_m_s2 > _REAL_M_S2:
            kept[first:end] = False
            spikes.append(fault)
    jumps = [f for f in faults if f.kind != "spike"]
    grave = [
        f
        for f in jumps
        if abs(f.size_mm) > _HARMLESS_MM and f.acceleration_m_s2 > _REAL_M_S2
        if f.affects(t, frames)
    ]
    findings = []
    if grave:
        others = [f.words for f in grave[1:]]
        more = f" (and {counted_list(others, 'more fault')})" if others else ""
        findings.append(
            Finding(
                grave[0].words + more, where, grave[0].remedy, Code.ENCODER_JUMP,
                {"encoder_jumps": [[f.t_s, f.size_mm] for f in grave]},
            )
        )  # fmt: skip
    else:
        findings += [Finding(fault.words, where) for fault in jumps[:_SHOWN]]
        if len(jumps) > _SHOWN:
            findings.append(Finding(f"and {counted(len(jumps) - _SHOWN, 'more jump')}", where))
    if spikes:
        more = f" (and {len(spikes) - 1} more)" if len(spikes) > 1 else ""
        findings.append(Finding(f"{spikes[0].words}{more}; they are not used", where))
    return kept, findings


def _bunched(t: Array, position: Array, frames: Array, where: str) -> Finding | None:
    """Return a finding if many readings of a moving stage have nearly the times of others.

    They were buffered, and have the times at which the buffer was sent: within a bunch the stage
    would move faster than it can.
    """
    short = np.diff(t) < _BUNCHED * (t[-1] - t[0]) / (len(t) - 1)
    bunches = np.array(list(runs(short)), np.int64).reshape(-1, 2)
    first, last = bunches[(t[bunches[:, 0]] >= frames[0]) & (t[bunches[:, 1]] <= frames[-1])].T
    way, took = np.abs(position[last] - position[first]), t[last] - t[first]
    wrong = (way > _HARMLESS_MM) & (4e-3 * way > _REAL_M_S2 * took**2)
    wrong &= took < _BUNCHED * (np.append(t[first[1:]], t[-1]) - t[first])
    if wrong.sum() < _LEAST_BUNCHES:
        return None
    size = int(np.median((last - first)[wrong])) + 1
    return Finding(
        f"the readings come in bunches: {size} of them within {np.median(took[wrong]):.2g} s, in "
        f"which the stage moves {np.median(way[wrong]):.3g} mm (medians of {int(wrong.sum())} "
        "bunches). They were buffered, and their times are not those at which they were taken",
        where,
        "record the encoder's own time stamps, or spread the readings of a bunch evenly over the "
        "time since the one before",
        Code.ENCODER_CLOCK,
    )


def encoder_faults(t_s: ArrayLike, position_mm: ArrayLike) -> list[EncoderFault]:
    """Return the steps of the record (E,) that no motion can explain, in the order of time.

    The speed of a fault lies outside the speeds of the two steps before and the two after by 10
    standard deviations of the record's own noise. A strong acceleration changes the speed only
    once, a jump twice. Motion in gaps is not judged.
    """
    t, position = np.asarray(t_s, float), np.asarray(position_mm, float)
    if len(t) < _LEAST_RECORD:
        return []
    dt, step = np.diff(t), np.diff(position)
    speed = step / dt
    known = dt <= GAP_STEPS * np.median(dt)
    excess = np.where(known, _excess_speed(speed) * dt, 0.0)
    residual = np.where(known, prediction_residual(speed) * dt, 0.0)
    least = _least_fault(step)
    moves = step != 0  # a long rest, in which readings repeat, says nothing about the noise
    if not moves.any():
        return []
    odd = np.abs(residual) > max(_SIGMAS * robust_sd(residual[moves]), least)
    odd &= (excess * residual > 0) & (np.abs(excess) > _SHARE * np.abs(residual))
    bend = (speed[1:-1] - (speed[:-2] + speed[2:]) / 2) * dt[1:-1]
    bend = bend[moves[1:-1]] if moves[1:-1].any() else bend
    clear = np.abs(excess) > max(_SIGMAS * robust_sd(bend - np.median(bend)), least)
    excess = np.where(odd & ~clear, residual, excess)
    return _classified(np.flatnonzero(odd | clear), excess, t, position)


def _excess_speed(speed: Array) -> Array:
    """Return how far each speed (E - 1,) is outside the range of two neighbours on each side."""
    near = np.delete(sliding_window_view(np.pad(speed, 2, constant_values=np.nan), 5), 2, axis=1)
    high, low = np.nanmax(near, 1), np.nanmin(near, 1)
    return np.asarray(np.maximum(speed - high, 0) + np.minimum(speed - low, 0))


def _least_fault(step: Array) -> float:
    """Return the smallest fault (mm) that is looked for: a few of an encoder's coarse counts."""
    moved = np.abs(step[step != 0])
    coarse = len(moved) > 0 and len(np.unique(np.round(moved, 9))) < len(moved) / 4
    return max(_COUNTS * float(np.percentile(moved, 1)) if coarse else 0.0, _LEAST_MM)


def _classified(
    steps: NDArray[np.intp], excess: Array, t: Array, position: Array
) -> list[EncoderFault]:
    """Return the faults at ``steps`` as jumps, spikes or wraps; excess (E - 1,) in mm."""
    out: list[EncoderFault] = []
    left = [int(i) for i in steps]
    last = len(t) - 2
    pace = np.median(np.delete(np.diff(position), steps))
    while left:
        i = left.pop(0)
        size, at, step = float(excess[i]), float(t[i + 1]), float(t[i + 1] - t[i])
        near = left and left[0] - i <= LONGEST_SPIKE
        if near and abs(size + float(excess[left[0]])) < _RETURNS * abs(size):
            out.append(EncoderFault(at, size, "spike", step, left.pop(0) - i))
        elif i < LONGEST_SPIKE and i + LONGEST_SPIKE < last:
            out.append(EncoderFault(float(t[0]), -size, "spike", step, i + 1))
        elif last - i < LONGEST_SPIKE:
            out.append(EncoderFault(at, size, "spike", step, last - i + 1))
        elif size * pace < 0 and abs(size) > _WRAP_OF_RANGE * float(np.ptp(position)):
            out.append(EncoderFault(at, size, "wrap", step))
        else:
            out.append(EncoderFault(at, size, "jump", step))
    return out
