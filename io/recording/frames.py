"""Camera frames from trigger or frame-counter lines: their times, and which are missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.io.recording.replay import DeviceRecord


@dataclass(frozen=True)
class FrameTimes:
    """t_s : (F,) of the frames from 0. missing : names of the cameras without it, joined by `|`.

    interpolated : (F,) no line reported the frame; its time is interpolated.
    """

    t_s: Array
    missing: tuple[str, ...]
    interpolated: Bools


def frame_times(records: list[DeviceRecord]) -> FrameTimes:
    """All frames that the lines report, the first being 0.

    A frame that a counter skips is missing from its cameras, if its line was undamaged meanwhile;
    where bytes were damaged or the line was unplugged, only its time is interpolated.
    """
    records = [r for r in records if len(r.t_s)]
    if not records:
        return FrameTimes(np.zeros(0), (), np.zeros(0, bool))
    numbers = _aligned(records)
    count = 1 + max(int(n[-1]) for n in numbers)
    t_s = np.full(count, np.nan)
    missing: list[list[str]] = [[] for _ in range(count)]
    for record, number in zip(reversed(records), reversed(numbers)):
        t_s[number] = record.t_s
    for record, number in zip(records, numbers):
        # Frames that the line skipped while its bytes were undamaged.
        skipped = [*range(int(number[0])), *range(int(number[-1]) + 1, count)]
        damaged_s = np.array([*record.malformed_s, *(t for away in record.away_s for t in away)])
        for i in np.flatnonzero(np.diff(number) > 1):
            begin, end = record.t_s[i] - 1e-3, record.t_s[i + 1] + 0.1
            if not np.any((damaged_s >= begin) & (damaged_s <= end)):
                skipped += range(int(number[i]) + 1, int(number[i + 1]))
        for frame in skipped:
            missing[frame] += record.device.cameras
    unreported = np.isnan(t_s)
    known = np.flatnonzero(~unreported)
    t_s[unreported] = np.interp(np.flatnonzero(unreported), known, t_s[known])
    return FrameTimes(t_s, tuple("|".join(dict.fromkeys(names)) for names in missing), unreported)


def frame_numbers(t_s: Array, counter: Array | None) -> Ints:
    """(N,) frame of each reading of a line, from 0; from the times where the counter is wrong.

    A counter may fall behind the time (a pause of the camera), but not run ahead of it by more
    than a tenth, nor go back: then it restarted, wrapped, or was damaged.
    """
    if len(t_s) < 2:
        return np.zeros(len(t_s), np.int64)
    step_s = np.diff(t_s)
    by_time = np.maximum(np.round(step_s / np.median(step_s)), 1)
    if counter is None:
        steps = by_time
    else:
        counted = np.diff(counter)
        valid = (counted >= 1) & (counted <= by_time + np.maximum(1, 0.1 * by_time))
        steps = np.where(valid, counted, by_time)
    return np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)


def _aligned(records: list[DeviceRecord]) -> list[Ints]:
    """Frame numbers of several lines, shifted so that equal numbers are equal times."""
    numbers = [frame_numbers(r.t_s, r.values.get("frame")) for r in records]
    first, base = records[0], numbers[0]
    if len(records) == 1:
        return numbers
    period = float(np.median(np.diff(first.t_s))) if len(base) > 1 else 1.0
    shifted = [base]
    for record, number in zip(records[1:], numbers[1:]):
        near = np.clip(np.searchsorted(first.t_s, record.t_s), 0, len(base) - 1)
        apart = (record.t_s - first.t_s[near]) / period + base[near] - number
        shifted.append(number + int(np.round(np.median(apart))))
    lowest = min(int(n[0]) for n in shifted)
    return [n - lowest for n in shifted]
