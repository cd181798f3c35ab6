"""Corrections of tracks by hand: `corrections.csv` in the folder of a run.

A person who has looked at the report may drop, join, split and rename tracks there, by hand or with
`telerig correct`. Every tracking of the run applies the file, row by row in its order, to the
finished rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from telerig.errors import InputError
from telerig.estimator.tracking.detect_run import CORRECTIONS
from telerig.estimator.tracking.linking.filter import TrackEvent
from telerig.estimator.tracking.linking.frames_to_rows import Linked
from telerig.estimator.tracking.tracks import Tracks, load_tracks
from telerig.io.files.atomic import atomic_path
from telerig.io.files.csv_table import read_table, whole_id, write_table
from telerig.io.tables.run import CORRECTIONS as _ROWS
from telerig.short_text import counted, counted_list

_ONCE = ["frame", "particle", "camera"]
ACTIONS = ("drop", "join", "split", "rename")
_MOST_DIGITS = 18
"""Of an id, so that it is a 64-bit whole number."""
_TODO = {
    "drop": "give particle (the track's id) and frame (the first one to drop; blank for all)",
    "join": "give particle (an id) and other (the id of the track that gets this id)",
    "split": "give particle (the track's id), frame (the first frame of the new track) and other "
    "(the new track's id)",
    "rename": "give particle (the track's id) and other (its new id)",
}


@dataclass(frozen=True)
class Correction:
    """Describe one row of the file. frame : the first one that it concerns; 0 for all."""

    row: int
    action: str
    particle: str
    other: str
    frame: int
    reason: str

    @property
    def of(self) -> str:
        """Id of the track whose rows change."""
        return self.other if self.action == "join" else self.particle

    @property
    def new(self) -> str:
        """The new id of these rows; "" for none."""
        return {"drop": "", "join": self.particle}.get(self.action, self.other)

    def new_id(self, particle: str, frame: int) -> str:
        """Return the id that a track has in a frame after the correction."""
        return self.new if particle == self.of and frame >= self.frame else particle


@dataclass
class Corrections:
    """Apply corrections to the rows of a run, and keep what was done.

    used : by correction, the first frame and time in which it changed something.
    kept : the joins whose staying track was found.
    last_frame : of each corrected track so far, by its id as text.
    """

    file: Path
    corrections: tuple[Correction, ...] = ()
    used: dict[Correction, tuple[int, float]] = field(default_factory=dict)
    kept: set[Correction] = field(default_factory=set)
    last_frame: dict[str, int] = field(default_factory=dict)

    def of_events(self, events: Sequence[TrackEvent]) -> list[TrackEvent]:
        """Return the events of the corrected tracks, then one for each correction that changed
        something.

        Ids are those of the corrected rows, and each track has one birth and one death at most: a
        death is left out if the track has rows afterwards, because it was joined with another.
        Events of dropped tracks are left out, and so are splits and mergers of one track.
        """
        new = (
            [replace(e, particles=self._ids_at(e)) for e in events] if self.corrections else events
        )
        known = [
            e for e in new if len(e.particles) > (e.kind in ("split", "merge"))
            and not (e.kind == "death" and self.last_frame.get(str(e.particles[0]), -1) >= e.frame)
        ]  # fmt: skip
        births = {e.particles: e for e in reversed(known) if e.kind == "birth"}
        deaths = {e.particles: e for e in known if e.kind == "death"}
        own = [
            TrackEvent("correction", frame, t_s, tuple(p for p in (c.particle, c.other) if p),
                       f"{c.action}: {c.reason}")
            for c, (frame, t_s) in self.used.items()
        ]  # fmt: skip
        return [
            e for e in known
            if {"birth": births, "death": deaths}.get(e.kind, {}).get(e.particles, e) is e
        ] + own  # fmt: skip

    def _ids_at(self, event: TrackEvent) -> tuple[int | str, ...]:
        """Return the ids of an event's tracks, each once, without those that are dropped."""
        out: dict[int | str, None] = {}
        for particle in event.particles:
            text = str(particle)
            for one in self.corrections:
                text = one.new_id(text, event.frame)
            if text:
                out[type(particle)(text)] = None
        return tuple(out)

    @property
    def warnings(self) -> list[str]:
        """Return a sentence for each correction that changed nothing, or joined nothing."""
        alone = [
            f"{CORRECTIONS} row {c.row}: join only renamed track {c.other}: there is no track "
            f"{c.particle} to join it with. Check the row"
            for c in self.used
            if c.action == "join" and c not in self.kept
        ]
        return alone + [
            f"{CORRECTIONS} row {c.row}: {c.action} changed nothing: there is no track "
            f"{c.of}"
            + (f" from frame {c.frame} on" if c.frame else "")
            + ". The ids of the tracks may have changed since the file was written: check the row"
            for c in self.corrections
            if c not in self.used
        ]

    def applied(self, parts: Iterator[Linked]) -> Iterator[Linked]:
        """Yield the corrected rows. Raises InputError where two tracks would become one."""
        for part in parts:
            yield self._corrected(part) if self.corrections else part

    def _corrected(self, part: Linked) -> Linked:
        tracks = self._renamed(part.tracks, counts=True)
        detections = self._renamed(part.detections, counts=False)
        known = tracks["particle"].notna()
        kind = part.tracks["particle"].dtype
        tracks = tracks[known].astype({"particle": kind}).reset_index(drop=True)
        seen = detections[detections["particle"].notna()]
        for table, names in ((tracks, _ONCE[:2]), (seen, _ONCE)):
            twice = table.duplicated(names)
            if not twice.any():
                continue
            particle, frame = (table.loc[twice, name].iloc[0] for name in ("particle", "frame"))
            raise InputError(
                f"two tracks have the id {particle} in frame {frame}",
                where=str(self.file),
                todo="join only tracks that follow each other in time; give another id to a track "
                "that overlaps in time",
            )
        last = tracks.groupby("particle")["frame"].max()
        self.last_frame |= zip(_texts(last.index.to_series()), last.tolist())
        return replace(part, tracks=tracks, detections=detections)

    def _renamed(self, table: pd.DataFrame, *, counts: bool) -> pd.DataFrame:
        """Return the table with new ids, NaN for dropped ones."""
        ids, frames = _texts(table["particle"]), table["frame"].to_numpy(np.int64)
        for one in self.corrections:
            hit = (ids == one.of) & (frames >= one.frame)
            if one.action in ("split", "rename") and (ids == one.new).any():
                raise InputError(
                    f"there is a track {one.new} already",
                    where=f"{self.file} row {one.row}",
                    todo="give another id, or join the tracks",
                )
            if one.action == "join" and counts and (ids == one.particle).any():
                self.kept.add(one)
            if counts and hit.any():
                first = table.iloc[int(np.flatnonzero(hit)[0])]
                self.used.setdefault(one, (int(first["frame"]), float(first["t_s"])))
            ids = np.where(hit, one.new, ids)
        return table.assign(particle=_ids(ids, table["particle"]))


def _texts(particle: pd.Series[Any]) -> Any:
    """Return ids as text: "3" for 3 and 3.0, "" for none."""
    texts = particle.astype(object).where(particle.notna(), "")
    return np.array([f"{p:.0f}" if isinstance(p, float) else str(p) for p in texts], object)


def _ids(texts: Any, like: pd.Series[Any]) -> pd.Series[Any]:
    """Return ids as numbers if those of ``like`` are numbers, else as text; NaN for none."""
    known = pd.Series(texts, like.index, dtype=object).where(texts != "", np.nan)
    if like.dtype == object or isinstance(like.dtype, pd.StringDtype):
        return known
    numbers = pd.to_numeric(known).astype(float)
    return numbers.astype(like.dtype) if isinstance(like.dtype, pd.Int64Dtype) else numbers


def add_correction(run: Path, results: Path, row: Mapping[str, Any]) -> str:
    """Write a row to the corrections of a run, and return in words what it changes in its tracks.

    results : folder with the run's tracks.
    row : action, particle, other ("" for none), frame (None for all) and reason.

    Raises InputError, and writes nothing, when the row does not fit the tracks: ids that are not
    there, tracks that are both seen in a frame, an id that is taken, a frame in which the track has
    nothing to correct.
    """
    found, file = load_tracks(results), run / CORRECTIONS
    numbered = found.table["particle"].dtype.kind == "i"
    row = {**row, "reason": " ".join(str(row["reason"]).split())}
    before = read_table(file, _ROWS.of(), empty=True) if file.is_file() else pd.DataFrame()
    new = pd.DataFrame([row]).dropna(axis=1)
    table = pd.concat([before, new], ignore_index=True).reindex(columns=_ROWS.names())
    with atomic_path(file) as staged:
        write_table(table.astype({"frame": "Int64"}), staged)
        *_, one = _read(staged, numbered).corrections
        words = _effect(one, found, results / "tracks.csv")
        list(Corrections(file, (one,)).applied(iter([Linked(found.table, found.detections)])))
    return f"{file} row {one.row}: {words}"


def _effect(one: Correction, found: Tracks, where: Path) -> str:
    """Return in words what a correction changes. Raises InputError when it does not fit."""
    ids = _texts(found.table["particle"])
    needed = [one.other, one.particle] if one.action == "join" else [one.particle]
    for particle in needed:
        if particle not in ids:
            known = sorted(set(ids), key=lambda text: (len(text), text))
            todo = f"the run has {counted_list(known, 'id')}" if known else "there are no tracks"
            raise InputError(f"there is no track {particle}", where=str(where), todo=todo)
    of = needed[0]
    frames = found.table["frame"].to_numpy(np.int64)[ids == of]
    hit = frames[frames >= one.frame]
    if not len(hit) or (one.action == "split" and len(hit) == len(frames)):
        what = f"track {of} is in frames {frames.min()} to {frames.max()}"
        todo = "give a frame after its first one and up to its last one"
        what += f"; {one.action} from frame {one.frame} on changes {'all' if len(hit) else 'none'}"
        raise InputError(f"{what} of it", where=str(where), todo=todo)
    if one.action == "join":
        _refuse_overlap(one, found, where)
    rows = f"{counted(len(hit), 'row')} of track {of}, frames {hit.min()} to {hit.max()}"
    return f"{one.action}: {rows}, " + (f"now track {one.new}" if one.new else "dropped")


def _refuse_overlap(one: Correction, found: Tracks, where: Path) -> None:
    """Raise InputError when tracks to be joined are in one image, or both have a point."""
    points = found.table[["frame", "particle"]].assign(camera="")
    seen = pd.concat([points, found.detections[["frame", "particle", "camera"]]])
    ids, frames = _texts(seen["particle"]), seen["frame"].to_numpy(np.int64)
    joined = seen[(ids == one.particle) | ((ids == one.other) & (frames >= one.frame))]
    both = joined.loc[joined.duplicated(["frame", "camera"]), "frame"].unique()
    if len(both):
        raise InputError(
            f"tracks {one.particle} and {one.other} are both seen in "
            f"{counted(len(both), 'frame')} between {both.min()} and {both.max()}",
            where=str(where),
            todo="join only tracks that follow each other in time",
        )


def _number(text: str) -> int | None:
    """Return the whole number of an id, 7 for "07" and "7.0"; None if tables do not hold it so."""
    if text.isascii() and text.isdecimal() and len(text) <= _MOST_DIGITS:
        return int(text)
    number = whole_id(text)
    return number if number is not None and number >= 0 else None


def read_corrections(run: Path, numbered: bool) -> Corrections:
    """Read the corrections of a run; there are none if it has no such file.

    numbered : whether the run's ids are whole numbers, so that new ones have to be.

    Raises InputError for a file that cannot be read, an unknown action, and a row that lacks what
    its action needs.
    """
    file = run / CORRECTIONS
    return _read(file, numbered) if file.is_file() else Corrections(file)


def _read(file: Path, numbered: bool) -> Corrections:
    table = read_table(file, _ROWS.of(), empty=True)
    blank = pd.Series("", table.index)
    others = table.get("other", blank).fillna("").astype(str)
    frames = table.get("frame", pd.Series(np.nan, table.index))
    out = []
    for row, action, particle, other, frame, reason in zip(
        table.index, table["action"], table["particle"].astype(str), others, frames, table["reason"]
    ):
        where = f"{file} row {row}"
        if action not in ACTIONS:
            todo = f"use one of: {', '.join(ACTIONS)}"
            raise InputError(f"there is no action {action!r}", where=where, todo=todo)
        lacks_other = (other == "") != (action == "drop") or other == particle
        if lacks_other or (action == "split" and np.isnan(frame)):
            first = "" if np.isnan(frame) else int(frame)
            what = f"{action} has particle {particle!r}, other {other!r}, frame {first!r}"
            raise InputError(what, where=where, todo=_TODO[action])
        if numbered and None in (_number(particle), _number(other or "0")):
            what, todo = (
                f"{particle!r} or {other!r} is no whole number",
                "give numbers, as tracks.csv",
            )
            raise InputError(what, where=where, todo=todo)
        if numbered:
            particle, other = (str(_number(text)) if text else "" for text in (particle, other))
        start = 0 if np.isnan(frame) else int(frame)
        out.append(Correction(int(row), action, particle, other, start, reason))
    return Corrections(file, tuple(out))
