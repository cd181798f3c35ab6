"""Faults of an encoder's record: jumps, single wrong readings, a counter that wrapped round."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_NOISES = 10.0
_QUANTA = 4.0
_LEAST_MM = 0.002
_GAP = 5.0
_RETURNS = 0.3
_WRAP_OF_RANGE = 0.5
_LEAST_RECORD = 6
_LEAST_TO_LEARN = 60
_REACH = 4
_SHARE = 0.3


@dataclass(frozen=True)
class EncoderFault:
    """t_s : of the first reading after the jump.  size_mm : what the reading gained too much.

    kind : "jump" stays, "spike" is taken back after ``readings``, "wrap" throws the reading from
    one end of the counter to the other.  step_s : between the readings before and after.
    """

    t_s: float
    size_mm: float
    kind: Literal["jump", "spike", "wrap"]
    step_s: float
    readings: int = 0

    @property
    def acceleration_m_s2(self) -> float:
        """The least that moves the carriage by the fault's size within its step."""
        return 4e-3 * abs(self.size_mm) / self.step_s**2

    @property
    def words(self) -> str:
        """One sentence with time and size."""
        if self.kind == "spike":
            return (
                f"{self.readings} reading(s) from {self.t_s:.6g} s on are off by "
                f"{self.size_mm:+.4g} mm"
            )
        what = "the counter wraps round" if self.kind == "wrap" else "the reading jumps"
        return f"{what} by {self.size_mm:+.4g} mm at {self.t_s:.6g} s"


def encoder_faults(t_s: ArrayLike, position_mm: ArrayLike) -> list[EncoderFault]:
    """Steps that no motion makes, in the order of time.

    t_s, position_mm : (E,), times increasing. A step counts as a fault when its speed lies
    outside the speeds of the two steps before and after it, by 10 times the record's own noise:
    a hard acceleration changes the speed once, a jump changes it twice.
    """
    t, position = np.asarray(t_s, float), np.asarray(position_mm, float)
    if len(t) < _LEAST_RECORD:
        return []
    dt, step = np.diff(t), np.diff(position)
    excess = _excess(dt, step)
    unforeseen = _unforeseen(dt, step)
    noise = 1.4826 * float(np.median(np.abs(unforeseen)))
    odd = np.abs(unforeseen) > max(_NOISES * noise, _least(step))
    odd &= (excess * unforeseen > 0) & (np.abs(excess) > _SHARE * np.abs(unforeseen))
    clear = np.abs(excess) > _threshold(dt, step)
    excess = np.where(odd & ~clear, unforeseen, excess)
    steps = np.flatnonzero(odd | clear)
    return _named(steps, excess, t, position)


def _excess(dt: Array, step: Array) -> Array:
    """(E - 1,) how far each step goes beyond what its neighbours' speeds allow (mm); 0 in gaps."""
    speed = step / dt
    padded = np.pad(speed, 2, constant_values=np.nan)
    near = np.stack([padded[k : k + len(speed)] for k in (0, 1, 3, 4)])
    high, low = np.nanmax(near, 0), np.nanmin(near, 0)
    beyond = np.maximum(speed - high, 0) + np.minimum(speed - low, 0)
    return np.asarray(np.where(dt > _GAP * np.median(dt), 0.0, beyond * dt))


def _unforeseen(dt: Array, step: Array) -> Array:
    """(E - 1,) what each step (mm) differs from the one that eight neighbours foretell.

    The weights are those of the record itself (least squares without the steps that they miss),
    so that an oscillation is foretold too; 0 in short records and at their ends.
    """
    speed, reach = step / dt, _REACH
    if len(speed) < _LEAST_TO_LEARN:
        return np.zeros(len(speed))
    padded = np.pad(speed, reach, mode="edge")
    near = np.stack([padded[k : k + len(speed)] for k in range(2 * reach + 1) if k != reach], -1)
    near = np.concatenate([near, np.ones((len(speed), 1))], -1)
    kept = np.ones(len(speed), bool)
    for _ in range(4):
        weights = np.linalg.lstsq(near[kept], speed[kept], rcond=None)[0]
        off = speed - near @ weights
        limit = 5 * 1.4826 * float(np.median(np.abs(off)))
        clean = np.abs(off) <= limit
        kept = np.convolve(~clean, np.ones(2 * reach + 1), "same") < 0.5
        if kept.sum() < _LEAST_TO_LEARN // 2:
            return np.zeros(len(speed))
    known = dt <= _GAP * np.median(dt)
    known[:reach] = known[-reach:] = False
    return np.asarray(np.where(known, off * dt, 0.0))


def _least(step: Array) -> float:
    """The smallest fault that is looked for (mm): some counts of the encoder."""
    moved = np.abs(step[step != 0])
    quantum = float(np.percentile(moved, 1)) if _counts(moved) else 0.0
    return max(_QUANTA * quantum, _LEAST_MM)


def _threshold(dt: Array, step: Array) -> float:
    speed = step / dt
    bend = (speed[1:-1] - (speed[:-2] + speed[2:]) / 2) * dt[1:-1]
    noise = 1.4826 * float(np.median(np.abs(bend - np.median(bend))))
    return max(_NOISES * noise, _least(step))


def _counts(moved: Array) -> bool:
    """Whether the steps are few multiples of one count."""
    return len(moved) > 0 and len(np.unique(np.round(moved, 9))) < len(moved) / 4


def _named(steps: NDArray[np.intp], excess: Array, t: Array, position: Array) -> list[EncoderFault]:
    out: list[EncoderFault] = []
    left = list(steps)
    span = float(np.ptp(position))
    while left:
        i = left.pop(0)
        size = float(excess[i])
        if left and left[0] - i <= 3 and abs(size + excess[left[0]]) < _RETURNS * abs(size):
            back = left.pop(0)
            out.append(
                EncoderFault(float(t[i + 1]), size, "spike", float(t[i + 1] - t[i]), int(back - i))
            )
            continue
        pace = np.median(np.delete(np.diff(position), steps))
        wraps = size * pace < 0 and abs(size) > _WRAP_OF_RANGE * span
        kind: Literal["wrap", "jump"] = "wrap" if wraps else "jump"
        out.append(EncoderFault(float(t[i + 1]), size, kind, float(t[i + 1] - t[i])))
    return out
