"""A run's tables from a raw log: stage.csv, accelerometer.csv, frames.csv, recording.json.

Frames come from trigger or frame-counter lines: their times, and which are missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.io.files.atomic import atomic_folder, write_json_atomic
from telerig.io.recording.judgement import GAP_INTERVALS
from telerig.io.recording.log import recorded_already
from telerig.io.recording.replay import (
    REGULAR_CLOCK,
    TIME_DIGITS,
    DeviceRecord,
    replay,
)
from telerig.io.rig_file.description import DeviceDescription
from telerig.io.tables.run import ACCELEROMETER, STAGE
from telerig.io.tables.table import Table

_ROWS = 20_000
_LISTED_GAPS = 200
_LONGEST_LINE = 200
_MOST_FRAMES = 100
"""More frames than so many for each line that reports one cannot be right."""
REFUSED_NAME = "refused.csv"


@dataclass(frozen=True)
class Recording:
    """What `write_tables` has written.

    summary : the content of recording.json.
    rows : number of rows of each table.
    errors : for each device with a fault, the error.
    """

    folder: Path
    summary: dict[str, Any]
    rows: dict[str, int]
    errors: dict[str, InputError]


def write_tables(
    log: str | PathLike[str],
    folder: str | PathLike[str] | None = None,
    devices: Mapping[str, DeviceDescription] | None = None,
) -> Recording:
    """Write the tables of the log's devices into ``folder``, by default that of the log.

    devices : as in `replay`. Sensors that were imported into `accelerometer.csv` stay there. If a
    device has a fault, it is stated in recording.json and in `Recording.errors`, and all other
    readings are written.
    Raises InputError for a file that is no log, or a folder that cannot be written.
    """
    path = Path(log)
    out = Path(folder) if folder is not None else path.parent
    found = replay(path, devices)
    of = {k: [r for r in found.records if r.device.kind == k] for k in _TABLES}
    errors = {r.device.name: r.error for r in found.records if r.error is not None}
    encoder = of["encoder"][:1]
    for record in of["encoder"][1:]:
        errors[record.device.name] = InputError(
            f"a run has one stage.csv, which has the readings of {encoder[0].device.name}",
            where=f"devices.{record.device.name}",
            todo="keep one encoder in rig.toml",
        )
    try:
        frames = frame_times(of["frames"])
    except InputError as error:
        frames = frame_times([])
        errors |= {r.device.name: error for r in of["frames"]}
    accelerometers = chain(
        _measured(ACCELEROMETER, of["accelerometer"]),
        _of_others(out / "accelerometer.csv", {r.device.name for r in of["accelerometer"]}),
    )
    text = {
        "encoder": _measured(STAGE, encoder),
        "accelerometer": accelerometers,
        "frames": _frames(frames),
    }
    rows: dict[str, int] = {}
    with atomic_folder(out) as beside:
        for kind, name in _TABLES.items():
            if of[kind]:
                rows[name] = _write(beside / name, text[kind], out / name)
        if any(len(r.refused.reason) for r in found.records) or (out / REFUSED_NAME).exists():
            refused = _refused(found.records)
            rows[REFUSED_NAME] = _write(beside / REFUSED_NAME, refused, out / REFUSED_NAME)
        header = found.header
        summary = {
            "schema": 1,
            "started": header.started,
            "seconds": round(found.end_s, 6),
            "clock": "t_s is the host's monotonic clock since the begin of the recording",
            "closed": found.ended,
            "log_bytes": path.stat().st_size,
            "log_damaged_bytes": found.damaged_bytes,
            "rows": rows,
            "devices": {
                r.device.name: _device_summary(r, errors.get(r.device.name)) for r in found.records
            },
            "frames": {
                "count": len(frames.t_s),
                "missing": sum(map(bool, frames.missing)),
                "interpolated": np.flatnonzero(frames.interpolated).tolist(),
            }
            if "frames.csv" in rows
            else None,
        }
        write_json_atomic(beside / "recording.json", summary)
    return Recording(out, summary, rows, errors)


def refuse_existing(folder: str | PathLike[str]) -> None:
    """Raise InputError if ``folder`` holds a table that a recording would replace."""
    for name in (*_TABLES.values(), REFUSED_NAME, "recording.json"):
        file = Path(folder) / name
        if file.exists():
            raise recorded_already(file)


def _measured(table: Table, records: Sequence[DeviceRecord]) -> Iterator[str]:
    """Return a table of what encoders or accelerometers have measured."""
    yield f"{','.join(table.names())}\n"
    for record in records:
        if len(record.t_s):
            columns = [record.t_s, *record.device.measured(record.values).values()]
            name = [record.device.name.replace("%", "%%")] if table is ACCELEROMETER else []
            line = ",".join([f"%.{TIME_DIGITS}f", *name, *["%.9g"] * (len(columns) - 1)])
            yield from _rows(f"{line}\n", columns)


def _of_others(file: Path, recorded: set[str]) -> Iterator[str]:
    """Return the rows of an existing table whose sensors are not in this recording."""
    if file.is_file():
        found = ACCELEROMETER.read(file)
        others = found[~found["sensor"].isin(recorded)]
        columns = [others[n].to_numpy() for n in ACCELEROMETER.names()]
        yield from _rows("%r,%s,%r,%r,%r\n", columns)


def _frames(frames: FrameTimes) -> Iterator[str]:
    any_missing = any(frames.missing)
    yield "frame,t_s,missing\n" if any_missing else "frame,t_s\n"
    for frame, (t_s, missing) in enumerate(zip(frames.t_s, frames.missing)):
        yield f"{frame},{t_s:.{TIME_DIGITS}f}" + (f",{missing}\n" if any_missing else "\n")


def _refused(records: Sequence[DeviceRecord]) -> Iterator[str]:
    """Return the lines that are in no table; other bytes than text are written as \\x00."""
    yield "device,t_s,arrived_s,reason,line\n"
    for record in records:
        name, refused = record.device.name, record.refused
        times = zip(refused.t_s.tolist(), refused.arrived_s.tolist())
        for (t_s, arrived_s), reason, line in zip(times, refused.reason.tolist(), refused.lines):
            made = "" if np.isnan(t_s) else f"{t_s:.{TIME_DIGITS}f}"
            shown = repr(line.rstrip(b"\r")[:_LONGEST_LINE])[2:-1].replace('"', '""')
            yield f'{name},{made},{arrived_s:.{TIME_DIGITS}f},"{reason}","{shown}"\n'


_TABLES = {"encoder": "stage.csv", "accelerometer": "accelerometer.csv", "frames": "frames.csv"}


def _rows(line: str, columns: list[Array]) -> Iterator[str]:
    for start in range(0, len(columns[0]), _ROWS):
        cells = [column[start : start + _ROWS].tolist() for column in columns]
        yield "".join([line % row for row in zip(*cells)])


def _write(path: Path, text: Iterable[str], final: Path) -> int:
    lines = -1
    try:
        with path.open("w", encoding="utf-8", newline="\n") as stream:
            for part in text:
                stream.write(part)
                lines += part.count("\n")
    except OSError as error:
        raise InputError(
            f"cannot be written: {error.strerror or error}",
            where=str(final),
            todo="make room on the disk, then run `telerig record --replay` on the recording.raw",
        ) from error
    return lines


def _device_summary(record: DeviceRecord, error: InputError | None) -> dict[str, Any]:
    gaps = list(gaps_of(record))
    return {
        "error": None if error is None else str(error),
        "kind": record.device.kind,
        "protocol": record.device.protocol,
        "readings": len(record.t_s),
        "rate_hz": _rate_hz(record.t_s),
        "time_from": record.time_from,
        "half_question_to_answer_ms": 1e3 * record.half_width_s or None,
        "time_sd_ms": None if record.time_sd_s is None else 1e3 * record.time_sd_s,
        "malformed": len(record.malformed_s),
        "malformed_bytes": record.malformed_bytes,
        "malformed_like": record.samples,
        "partial_bytes": record.partial_bytes,
        "left_out": record.faults,
        "counter_wraps": record.wraps,
        "clocks": [asdict(fit) for fit in record.clocks],
        "unplugged": [{"lost_s": a, "found_s": b} for a, b in record.away_s],
        "lost": sum(gap["lost"] for gap in gaps),
        "gap_count": len(gaps),
        "gaps": gaps[:_LISTED_GAPS],
    }


def gaps_of(record: DeviceRecord) -> Iterator[dict[str, Any]]:
    """Yield for each gap in the readings from_s, to_s, the number of lost readings, the reason."""
    step = np.diff(record.t_s)
    if record.device.kind == "frames" or step.size < 8:
        return
    median_s = float(np.median(step))
    regular = record.time_from in ("device", REGULAR_CLOCK)
    limit = GAP_INTERVALS if regular else 10.0
    for i in np.flatnonzero(step > limit * median_s):
        begin, end = float(record.t_s[i]), float(record.t_s[i + 1])
        lost = round(float(step[i]) / median_s) - 1
        yield {"from_s": begin, "to_s": end, "lost": lost, "why": _why(record, begin, end)}


def _why(record: DeviceRecord, begin: float, end: float) -> str:
    if any(lost <= end and not found < begin for lost, found in record.away_s):
        return "unplugged"
    near = (record.malformed_s >= begin) & (record.malformed_s <= end + 0.1)
    return "damaged bytes" if np.any(near) else "nothing came"


def _rate_hz(t_s: Array) -> float | None:
    return round(1 / float(np.median(np.diff(t_s))), 6) if len(t_s) > 1 else None


@dataclass(frozen=True)
class FrameTimes:
    """The times of F frames.

    t_s : (F,) times in s.
    missing : for each frame the names of the cameras that have no image of it, joined by `|`.
    interpolated : (F,) whether no line reported the frame, so that its time is interpolated.
    """

    t_s: Array
    missing: tuple[str, ...]
    interpolated: Bools


def frame_times(records: list[DeviceRecord]) -> FrameTimes:
    """Return the times of all frames that the devices reported; the first frame is 0.

    If a counter skips a frame and its line was undamaged at that time, the cameras of this counter
    miss the frame; frames before its first line and after its last one are skipped, too. If the
    line was damaged, only the time of the frame is interpolated.
    """
    records = [r for r in records if len(r.t_s)]
    if not records:
        return FrameTimes(np.zeros(0), (), np.zeros(0, bool))
    numbers = _aligned(records)
    count = 1 + max(int(n[-1]) for n in numbers)
    reported = sum(len(r.t_s) for r in records)
    if count > _MOST_FRAMES * reported + _ROWS:
        raise InputError(
            f"{reported} lines count {count} frames, so its counter or its times are wrong",
            where=", ".join(f"devices.{r.device.name}" for r in records),
            todo="check the counter; frames.csv is empty, the lines are in recording.raw",
        )
    t_s = np.full(count, np.nan)
    missing: list[list[str]] = [[] for _ in range(count)]
    for record, number in zip(reversed(records), reversed(numbers)):
        t_s[number] = record.t_s
    for record, number in zip(records, numbers):
        # Frames that the line skipped while its bytes were undamaged.
        skipped: list[int] = []
        damaged_s = np.array([*record.malformed_s, *(t for away in record.away_s for t in away)])
        seen = np.concatenate([[-1], number, [count]])
        seen_s = np.concatenate([[-np.inf], record.t_s, [np.inf]])
        for i in np.flatnonzero(np.diff(seen) > 1):
            begin, end = seen_s[i] - 1e-3, seen_s[i + 1] + 0.1
            if not np.any((damaged_s >= begin) & (damaged_s <= end)):
                skipped += range(int(seen[i]) + 1, int(seen[i + 1]))
        for frame in skipped:
            missing[frame] += record.device.cameras
    unreported = np.isnan(t_s)
    known = np.flatnonzero(~unreported)
    t_s[unreported] = np.interp(np.flatnonzero(unreported), known, t_s[known])
    return FrameTimes(t_s, tuple("|".join(dict.fromkeys(names)) for names in missing), unreported)


def frame_numbers(t_s: Array, counter: Array | None) -> Ints:
    """Return the number (N,), from 0, of the frame that each reading reports.

    t_s : (N,) times. counter : (N,) the counter in the readings; None if there is none. Where the
    counter is wrong, the number follows from the times. A counter may fall behind the time (the
    camera paused), but it must not run ahead by more than a tenth, or go back.
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
    """Return the frame numbers of several lines, shifted so that equal numbers are equal times."""
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
