"""Tracks of a run: detections, points in space, events, and the summary in a few lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from telerig.errors import InputError
from telerig.io.files.frame_table import FrameTable
from telerig.io.files.names import absent
from telerig.io.results.folders.tracking import TrackResults, read_track_table
from telerig.io.results.manifest import reading, replaced_results
from telerig.io.results.tracking import TrackingFile, share_words
from telerig.io.tables.run import DETECTIONS, EVENTS, TRACKS
from telerig.short_text import ShortText, counted, first_of

if TYPE_CHECKING:
    import xarray

    from telerig.estimator.tracking.linking.filter import TrackEvent


@dataclass(frozen=True, repr=False)
class Tracks(ShortText):
    """Hold the tracks of a run.

    name : name of the run.
    detections : table of all bubbles found in the images, with the id of the track in the column
        ``particle``, blank for none.
    table : table with one row per frame and bubble that several cameras saw, positions in mm in the
        rig frame; `docs/files.md` describes the columns.
    events : table of births, deaths, gaps, breaks, splits and mergers, each with its reason.
    summary : content of tracking.json.
    references : table of the dots of a strip fixed to the tank that were found in the images; None
        if there is no strip.
    """

    name: str
    detections: pd.DataFrame
    table: pd.DataFrame
    events: pd.DataFrame
    summary: Mapping[str, Any] = field(default_factory=dict)
    references: pd.DataFrame | None = None

    def __len__(self) -> int:
        """Number of tracks."""
        return int(self.table["particle"].nunique())

    def title(self) -> str:
        """Return the name of the run and the number of its tracks."""
        return f"Tracks of run {self.name!r}: {counted(len(self), 'track')}"

    def facts(self) -> dict[str, str]:
        """Return the numbers of points and detections, the events and the warnings, in words."""
        points = counted(len(self.table), "point")
        if len(self.table):
            points += f" in frames {self.table['frame'].min()} to {self.table['frame'].max()}"
        rows = self.table.groupby("particle").size()
        kinds = self.events["kind"].value_counts()
        return {
            "points": f"{points} from {counted(len(self.detections), 'detection')}",
            "length": f"{rows.median():.0f} points per track (median)" if len(rows) else "",
            "events": ", ".join(f"{count} x {kind}" for kind, count in kinds.items()),
            "frame": "that of the first camera, so positions contain the rig's travel and shake",
            "warnings": first_of(list(self.summary.get("warnings", ()))),
        }

    def to_pandas(self) -> pd.DataFrame:
        """Return ``table`` indexed by particle and frame, sorted: ``.loc[3]`` is one bubble."""
        return self.table.set_index(["particle", "frame"]).sort_index()

    def to_xarray(self) -> xarray.Dataset:
        """Return the tracks as an `xarray.Dataset` with the names and units of the CF conventions.

        Its dimension ``obs`` has the rows of ``table``, sorted by particle and frame;
        ``trajectory`` has the bubbles, with the number of their rows in ``rowSize``.
        ``covariance`` is (obs, axis, axis_of) in mm^2.
        Raises InputError if xarray is not installed.
        """
        from telerig.io.exchange.export.netcdf import to_xarray
        from telerig.io.exchange.export.run_results import RIG, RunResults

        return to_xarray(RunResults(self.name, RIG, self.table, source="telerig.track"))

    def save(self, folder: str | Path) -> None:
        """Write detections.csv, tracks.csv, events.csv and tracking.json into a folder.

        references.csv is written too if the tracks have references. All files appear together.
        """
        from telerig.io.files.csv_table import write_table

        place = Path(folder)
        record = TrackingFile.of(self.summary, place / "tracking.json")
        with replaced_results(place, "track", again="Tracks.save", inputs={}) as out:
            for name in ("detections", "tracks", "events"):
                table = self.table if name == "tracks" else getattr(self, name)
                write_table(table, out / f"{name}.csv")
            if self.references is not None:
                write_table(self.references, out / "references.csv")
            record.write(out / "tracking.json")


@dataclass(frozen=True)
class StoredTracks:
    """Hold the tracks of a long run, whose tables stay in their files.

    name, summary, references : as for `Tracks`.
    table, detections : the files of the tables; None without detections.
    """

    name: str
    table: FrameTable
    detections: FrameTable | None
    summary: Mapping[str, Any] = field(default_factory=dict)
    references: pd.DataFrame | None = None

    def between(self, first: int, end: int) -> Tracks:
        """Return what there is in the frames from ``first`` to before ``end``."""
        table, detections = self.table.between(first, end), pd.DataFrame()
        if self.detections is not None:
            detections = self.detections.between(first, end)
        return Tracks(self.name, detections, table, pd.DataFrame(columns=EVENTS.names()))


def open_tracks(folder: str | Path) -> Tracks | StoredTracks:
    """Read the files that `telerig track` wrote into a folder; large tables stay on disk.

    Raises InputError as `load_tracks` does.
    """
    place = Path(folder)
    if not place.is_dir():
        raise absent(place, "folder of results", f"run `{TrackingFile.MAKE}` first")
    files = [place / name for name in ("tracks.csv", "detections.csv")]
    found = TrackResults(place)
    with reading(place, TrackResults.FILES[:-1]):
        table, detections = (
            FrameTable.of(file, one.reader_of_parts(file, need=need), _unseen)
            for file, one, need in zip(files, (TRACKS, DETECTIONS), (TrackResults.NEED, None))
        )
        if table is None or detections is None:
            return load_tracks(folder)
        references = found.references if found.has("references.csv") else None
        summary = found.content
    return StoredTracks(str(summary.get("run", place.name)), table, detections, summary, references)


def open_track_table(file: Path) -> pd.DataFrame | StoredTracks:
    """Read a table as `read_track_table` does; of a large file return a `StoredTracks`, which reads
    the rows of single frames when they are needed."""
    table = FrameTable.of(file, TRACKS.reader_of_parts(file, need=TrackResults.NEED), _unseen)
    return read_track_table(file) if table is None else StoredTracks("", table, None)


def _unseen(_part: pd.DataFrame) -> None:
    """Look at nothing."""


def events_table(events: Sequence[TrackEvent]) -> pd.DataFrame:
    """Return the events as a table with the columns of events.csv, in the order of time."""
    rows = [
        (e.frame, e.t_s, e.kind, " ".join(str(p) for p in e.particles), e.reason)
        for e in sorted(events, key=lambda e: e.frame)
    ]
    return pd.DataFrame(rows, columns=EVENTS.names())


def load_tracks(folder: str | Path) -> Tracks:
    """Read the files that `telerig track` wrote into a folder.

    Raises InputError when one of detections.csv, tracks.csv, events.csv and tracking.json is
    missing.
    """
    place = Path(folder)
    if not place.is_dir():
        raise absent(place, "folder of results", f"run `{TrackingFile.MAKE}` first")
    for name in TrackResults.FILES[:4]:
        if not (place / name).is_file():
            raise InputError(f"there is no {name}", where=str(place), todo="run telerig track")
    found = TrackResults(place)
    with reading(place, TrackResults.FILES[:-1]):
        summary = found.content
        references = found.references if found.has("references.csv") else None
        return Tracks(
            str(summary.get("run", place.name)), found.detections, found.tracks, found.events,
            summary, references,
        )  # fmt: skip


def tracking_words(summary: Mapping[str, Any], seconds: float, steps: str = "") -> str:
    """Return the text that `telerig track` prints.

    summary : content of tracking.json.
    seconds : time that the tracking took.
    steps : how long its steps took, in words.
    """
    lines = [f"{count_words(summary)} ({seconds:.1f} s{steps and f': {steps}'})"]
    left = summary["detections_without_partner_or_track"]
    if left:
        lines.append(f"  {left} detections have no partner in another view, or no track")
    for camera, reasons in summary["frames_without_bubbles"].items():
        lines += [
            f"  camera {camera}: {counted(count, 'frame')} without a bubble: {reason}"
            for reason, count in reasons.items()
        ]
    share = share_words(summary.get("calibration_sd_mm"), summary.get("extrapolated"))
    lines += [f"  {word}" for word in share]
    kinds = {k: n for k, n in summary["events"].items() if k not in ("birth", "death")}
    if kinds:
        lines.append("  " + ", ".join(f"{n} x {kind}" for kind, n in kinds.items()))
    lines += [f"  {word}" for word in summary["pairs"]["words"]]
    lines += [f"  {word}" for word in summary.get("references", {}).get("words", [])]
    lines += [f"  warning: {warning}" for warning in summary.get("warnings", [])]
    lines += [f"  note: {note}" for note in summary["notes"]]
    return "\n".join(lines)


def count_words(summary: Mapping[str, Any]) -> str:
    """Return how many tracks and points were found, from the content of tracking.json."""
    return (
        f"Run {summary['run']!r}: {counted(summary['tracks'], 'track')}, "
        f"{counted(summary['points'], 'point')} in space from "
        f"{counted(summary['detections'], 'detection')} in {counted(summary['frames'], 'frame')}"
    )
