"""Tracking of a run: background, detection, groups, tracks; row by row, and resumable."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from telerig.arrays import Array, Ints
from telerig.errors import LOAD, CalibrationError, InputError, need_kind
from telerig.estimator.bubbles.detect import COVERED_LIMIT, crowded_words, is_crowded
from telerig.estimator.bubbles.field import lit_field
from telerig.estimator.bubbles.lighting import (
    NOT_BACKLIT,
    NOT_BACKLIT_WORDS,
    on_bright_spots,
    share_of_hearts,
)
from telerig.estimator.bubbles.outline.ellipse_geometry import DETECTION_COLUMNS
from telerig.estimator.bubbles.pairing.groups import candidates_of
from telerig.estimator.bubbles.pairing.learning import learn_rig
from telerig.estimator.bubbles.pairing.model import RigModel
from telerig.estimator.bubbles.shape.lasting import LastingShare
from telerig.estimator.bubbles.shape.learning import learn_shapes
from telerig.estimator.bubbles.shape.shapes import Shapes
from telerig.estimator.bubbles.shape.sightings import Sightings, sightings_from_table
from telerig.estimator.calibration.result.calibration import (
    Calibration,
    of_run,
)
from telerig.estimator.rig_drift.change import with_change
from telerig.estimator.rig_drift.estimate import LEAST_SEEN_S, PairCollector
from telerig.estimator.tracking.corrections import Corrections, read_corrections
from telerig.estimator.tracking.detect_run import (
    DetectionStore,
    Progress,
    Sought,
    described_fields,
    described_strip,
    detect_missing,
    fingerprint,
    make_scene,
    mask_files,
)
from telerig.estimator.tracking.linking.filter import TrackerSettings
from telerig.estimator.tracking.linking.frames import NO_PARTICLE, Tables
from telerig.estimator.tracking.linking.frames_to_rows import Linked, RowMaker
from telerig.estimator.tracking.linking.linked_rows import LinkedRows, Linking
from telerig.estimator.tracking.linking.tracker import Tracker
from telerig.estimator.tracking.tracks import Tracks, events_table
from telerig.io.dataset.run import RunData
from telerig.io.files.atomic import plain
from telerig.io.files.csv_table import whole_id
from telerig.io.files.frame_table import FrameTable
from telerig.io.files.hashing import hash_if_there
from telerig.io.results.calibration_words import NO_COVARIANCE
from telerig.io.results.cameras import CameraRecord, wall_records
from telerig.io.tables.table import CALIBRATION_SHARE, EXTRAPOLATED, POINT
from telerig.live import publish
from telerig.progress import Progress as Steps
from telerig.progress import showing_progress
from telerig.rig.camera import Camera
from telerig.short_text import counted

if TYPE_CHECKING:
    from telerig.estimator.tracking.follow_marks import FollowedMarks
    from telerig.estimator.tracking.linking.filter import TrackEvent


MODEL_FRAMES = 60
"""Frames spread over those with bubbles, from which the model of groups is learnt."""

LARGEST_ID = 10**15
"""Tracks are numbered below it; a larger number is the name of a bubble."""

_VERTICAL = 0.98
"""Cosine of the angle up to which bubbles rise along the travel axis, which is calibrated."""

_RELIABLE = 0.99
"""Probability of a group from which shapes are learned."""

_LIGHT_FRAMES = 10
"""Images of each camera, spread over those with bubbles, of which is looked at how they are lit:
five outlines in all tell it."""

_FRAMES_AT_ONCE = 64
"""Frames whose tables are turned into arrays together."""


@dataclass(frozen=True)
class TrackOptions:
    """Hold the options of tracking.

    min_diameter_px, min_contrast : as for `telerig.detect_bubbles`.
    tracker : settings of the tracker.
    """

    min_diameter_px: float = 8.0
    min_contrast: float = 0.3
    tracker: TrackerSettings = field(default_factory=TrackerSettings)


@dataclass
class TrackingStream:
    """Hold a run while it is tracked. Read ``rows`` to their end, then ask for the ``summary``.

    linking : what linking the detections tells beside the rows.
    store : files of detections; none of bubbles if the run has a table of them.
    marks : marks that were followed in the images; None without a strip of dots.
    linked : the rows, which are computed while they are read.
    detections, points, particles : numbers of detections and points, and ids of tracks, so far.
    together : number of detections that show a bubble together with another camera, so far.
    covered : for each camera, number of detections and the area that they cover (px^2), so far.
    beyond : number of points beyond the dots of the calibration, so far.
    common_mm2 : (3,) sums over the points of the variances by the calibration's errors, so far.
    place_mm : (3,) sum of the points, so far.
    shown : for each camera, ellipses (B, 5) by frame, of the first frame with bubbles in each of
        `_LIGHT_FRAMES` parts of the run, so far.
    names : names of the tracks by number, if the given ids are no whole numbers.
    """

    run: RunData
    calibration: Calibration
    linking: Linking
    store: DetectionStore
    marks: FollowedMarks | None
    linked: Iterator[Linked]
    corrections: Corrections
    detections: int = 0
    points: int = 0
    together: int = 0
    beyond: int = 0
    common_mm2: Array = field(default_factory=lambda: np.zeros(3))
    place_mm: Array = field(default_factory=lambda: np.zeros(3))
    particles: set[Any] = field(default_factory=set)
    covered: dict[str, tuple[int, float]] = field(default_factory=dict)
    shown: dict[str, dict[int, Array]] = field(default_factory=dict)
    names: Mapping[int, str] | None = None

    def __post_init__(self) -> None:
        self._pairs = PairCollector(self.calibration)
        self._lasting = LastingShare()

    @property
    def events(self) -> list[TrackEvent]:
        """Events of the tracks so far."""
        events, names = self.linking.events, self.names
        if names is not None:
            events = [
                replace(e, particles=tuple(_name(p, names) for p in e.particles)) for e in events
            ]
        return self.corrections.of_events(events)

    @property
    def rows(self) -> Iterator[Linked]:
        """Final rows of tracks.csv and detections.csv, some frames at a time."""
        for part in map(self._with_share, self.linked):
            self.detections += int(np.isfinite(part.detections["u_px"].to_numpy(float)).sum())
            self.points += len(part.tracks)
            measured = part.tracks[part.tracks["ray_miss_mm"].notna()]
            names = [f"{camera}_u_px" for camera in self.run.cameras]
            self.together += int(measured[names].notna().to_numpy().sum())
            self.particles |= set(part.tracks["particle"])
            self._pairs.add(part.tracks)
            self._lasting.add(part.tracks)
            self.place_mm += part.tracks[[*POINT]].sum().to_numpy(float)
            for camera, areas in part.detections.groupby("camera")["area_px2"]:
                many, area = self.covered.get(str(camera), (0, 0.0))
                many, area = many + int(areas.notna().sum()), area + float(areas.sum())
                self.covered[str(camera)] = many, area
            if self.run.detections is None:
                self._keep_shown(part.detections)
            publish("linked", tracks=part.tracks, detections=part.detections)
            yield part

    def _keep_shown(self, detections: pd.DataFrame) -> None:
        """Keep the outlines of those frames whose images `_not_backlit` looks at."""
        for camera, rows in detections[detections["a_px"].notna()].groupby("camera"):
            frames = self.shown.setdefault(str(camera), {})
            part = rows["frame"] * _LIGHT_FRAMES // self.run.frame_count
            known = {frame * _LIGHT_FRAMES // self.run.frame_count for frame in frames}
            for _, new in rows[~part.isin(known)].groupby(part):
                first = new[new["frame"] == new["frame"].min()]
                ellipse = first[["u_px", "v_px", "a_px", "b_px", "angle_rad"]]
                frames[int(first["frame"].iloc[0])] = ellipse.to_numpy(float)

    def _with_share(self, part: Linked) -> Linked:
        """Add the columns of the calibration's share, and count them."""
        share = self.calibration.share_columns(part.tracks[[*POINT]].to_numpy(float))
        tracks = part.tracks.assign(**share)
        self.beyond += int(np.sum(share.get(EXTRAPOLATED, 0)))
        self.common_mm2 += [np.sum(share.get(n, np.nan) ** 2) for n in CALIBRATION_SHARE]
        return replace(part, tracks=tracks)

    def summary(self) -> dict[str, Any]:
        """Return the content of tracking.json. Raises InputError when no bubble was found."""
        run, kinds = self.run, [e.kind for e in self.events]
        if not self.detections:
            raise InputError(
                f"no bubble was found in {counted(run.frame_count, 'frame')}",
                where=str(run.path),
                todo="look at the images; bubbles must be darker than the screen by "
                "--min-contrast, and wider than --min-diameter",
            )
        used = [c for c in self.calibration.cameras if c.name in run.cameras]
        change, known = self._pairs.found(), self.calibration.covariance_known
        # in a shorter time slow shake is no different from it
        misplaced = self.linking.misplaced if np.ptp(run.t_s) >= LEAST_SEEN_S else None
        content: dict[str, Any] = {
            "schema": 1,
            "kind": "telerig tracks",
            "run": run.name,
            "pixel_origin": "centre",
            "frame_of_reference": "rig frame (the first camera's), mm",
            "image_size_px": {c.name: c.image_size_px for c in used},
            "cameras": {c.name: CameraRecord.of_camera(c).content() for c in used},
            "walls": wall_records(used),
            "frames": run.frame_count,
            "detections": self.detections,
            "points": self.points,
            "tracks": len(self.particles),
            "detections_without_partner_or_track": self.detections - self.together,
            "frames_without_bubbles": self.linking.frames_without,
            "events": {kind: kinds.count(kind) for kind in sorted(set(kinds))},
            "pairs": with_change(self.linking.pairs, change, self.calibration, misplaced),
            "shapes": asdict(self.linking.shapes) | self._lasting.found(),
            "covariance": "Of the measurement."
            + known
            * " The calibration's share, common to all points, is in calibration_sx_mm, "
            "calibration_sy_mm and calibration_sz_mm.",
            "warnings": [
                *filter(None, [self.calibration.rejection]),
                *_window_warnings(run, self.calibration),
                *self._crowded(),
                *self._not_backlit(),
                *self.corrections.warnings,
                *([] if known else [NO_COVARIANCE]),
            ],
            "notes": list(run.notes),
        }
        if self.points and np.isfinite(self.common_mm2).all():
            content["calibration_sd_mm"] = np.sqrt(self.common_mm2 / self.points).tolist()
        if self.points and known:
            middle = self.place_mm / self.points
            content["shapes"]["scale_sd"] = self.calibration.scale_sd(middle)
        if self.points and self.calibration.beyond_dots(np.zeros((0, 3))) is not None:
            content["extrapolated"] = self.beyond / self.points
        if change is not None:
            content["rig_change"] = change.as_dict()
        up = upwards(run, stage_axis(run, self.calibration))
        content["up"] = (up / np.linalg.norm(up)).tolist()
        if self.marks is not None:
            content["references"] = self.marks.summary
        return content

    def _crowded(self) -> list[str]:
        """Return a warning for each camera with more bubbles than the detection can separate."""
        found, frames = [], self.run.frame_count
        fields = described_fields(self.run) if self.run.detections is None else {}
        sizes = {camera.name: camera.image_size_px for camera in self.calibration.cameras}
        for camera, (many, area) in self.covered.items():
            width, height = sizes[camera]
            looked_at = fields[camera].sum() if camera in fields else width * height
            share = area / (float(looked_at) * frames)
            if is_crowded(share, many / frames, COVERED_LIMIT):
                found.append(crowded_words(f"camera {camera}", share))
        return found

    def _not_backlit(self) -> list[str]:
        """Return a warning for each camera whose bubbles are dark hearts of bright spots."""
        found, fields = [], described_fields(self.run) if self.shown else {}
        for camera, frames in self.shown.items():
            judged = []
            for frame, ellipse in frames.items():
                image = self.run.image(camera, frame)
                if image is not None:
                    field = fields[camera] if camera in fields else lit_field(image)
                    judged.append(on_bright_spots(image, field, ellipse, []))
            if not judged:
                continue
            bright, seen = map(np.concatenate, zip(*judged))
            if share_of_hearts(bright, seen) > NOT_BACKLIT:
                found.append(
                    f"camera {camera}: {bright.sum()} of {seen.sum()} outlines in {len(judged)} "
                    f"images are {NOT_BACKLIT_WORDS}"
                )
        return found


def _window_warnings(run: RunData, calibration: Calibration) -> list[str]:
    if not ((run.rig and run.rig.walls) or any(camera.wall for camera in calibration.cameras)):
        return []
    from telerig.estimator.calibration.refractive_windows import window_warnings

    return window_warnings(run.rig, calibration)


@showing_progress
def track(
    run: RunData,
    calibration: Calibration,
    *,
    options: TrackOptions | None = None,
    progress: Steps | bool = False,
) -> Tracks:
    """Detect the bubbles of a run, find the same ones in all views, and follow them in time.

    run : the run as read by `telerig.load_run` or ``dataset.runs[name].load()``.
    calibration : calibration of the rig.
    options : None for the defaults.
    progress : True to show a progress bar; or a function that is called with the name of the step,
        the number done and the total.

    Raises InputError for recordings that cannot be used, and CalibrationError for the calibration
    of another rig.
    """
    need_kind(run, "frame_count", "telerig.track", "give what telerig.load_run returns")
    need_kind(calibration, "cameras", "telerig.track", LOAD)
    stage = None if isinstance(progress, bool) else progress
    with tempfile.TemporaryDirectory(prefix="telerig-") as work:
        stream = tracking_stream(run, calibration, Path(work) / "work", options, stage)
        parts = list(stream.rows)
    tables = [p.tracks for p in parts if len(p.tracks)] or [p.tracks for p in parts[:1]]
    return Tracks(
        run.name,
        pd.concat([p.detections for p in parts], ignore_index=True),
        pd.concat(tables, ignore_index=True),
        events_table(stream.events),
        stream.summary(),
        None if stream.marks is None else stream.marks.table,
    )


def tracking_stream(
    run: RunData,
    calibration: Calibration,
    work: Path,
    options: TrackOptions | None = None,
    stage: Progress | None = None,
    executor: Executor | None = None,
) -> TrackingStream:
    """Detect the bubbles, learn how their views agree, and return a stream that tracks them.

    work : folder into which detections and rows are written, so that an interrupted run can
        continue, and a run that is complete repeats nothing but its corrections.
    executor : runs the detection in batches of frames, on computers that see the run and ``work``
        at the same paths; None for processes of this computer.

    The other arguments and the errors are those of `track`. Tracks are computed while the stream's
    rows are read.
    """
    chosen = options or TrackOptions()
    calibration = of_run(calibration, run.cameras)
    cameras = check_calibration(run, calibration)
    axis = stage_axis(run, calibration)
    up = upwards(run, axis)
    inputs = _inputs(run, cameras, chosen, (axis, up))
    store = DetectionStore(work, fingerprint(run, inputs), run.frame_count)
    first_id, labels, marks = 0, None, None
    batches: Callable[[], Iterator[pd.DataFrame]] = store.tables
    if run.detections is not None:
        numbers, labels = numbers_of(ids_of(run.detections))
        taken = [*numbers.values(), *_whole(numbers).values()]  # no new track gets a given name
        first_id = max(taken, default=NO_PARTICLE) + 1
        batches = partial(_given, run.detections, numbers)
    strip = described_strip(run)
    if strip is not None:
        from telerig.estimator.tracking.follow_marks import follow_references

        marks = follow_references(run, cameras, axis, strip, store, stage, executor)
    stored = LinkedRows(store.folder)
    linking = stored.linking()
    if linking is not None:
        rows = stored.kept()
    else:
        if run.detections is None and store.missing():
            strips = marks.strips if marks is not None else None
            sought = Sought(chosen.min_diameter_px, chosen.min_contrast)
            scene = make_scene(run, cameras, axis, sought, stage, strips)
            detect_missing(scene, store, stage, executor)
        if stage is not None:
            stage("pair model", 0, 0)
        sample = _sample(cameras, batches)
        model = learn_rig(sample, cameras)
        rise = axis if axis @ up > _VERTICAL else up
        tracker = Tracker(axis, _settings(chosen, run), first_id=first_id, up=rise)
        linker = RowMaker(model, tracker, _shapes(sample, model, up), up)
        without: dict[str, dict[str, int]] = {c.name: {} for c in cameras}
        linking = Linking(model.pairs, linker.shapes, linker.events, without, model.misplaced)
        rows = stored.keep(_linked(run, cameras, batches(), linker, without, stage), linking)
    if labels is not None:
        rows = (_labelled(part, labels) for part in rows)
    corrections = read_corrections(run.path, numbered=labels is None)
    rows = corrections.applied(rows)
    return TrackingStream(run, calibration, linking, store, marks, rows, corrections, names=labels)


def _inputs(
    run: RunData, cameras: Sequence[Camera], options: TrackOptions, directions: Sequence[Array]
) -> dict[str, Any]:
    """Return what the rows depend on beside the recording's files, for `fingerprint`.

    directions : unit vectors (3,) of the stage's travel and against gravity.
    """
    masks = {name: hash_if_there(file) for name, file in mask_files(run).items()}
    described = None if run.rig is None else (run.rig.bubbles, described_strip(run))
    inputs = {
        "options": repr(options), "cameras": cameras, "frames": run.frame_count,
        "source": run.source, "times": run.t_s, "positions": run.position_mm,
        "directions": directions, "described": repr(described), "masks": masks,
    }  # fmt: skip
    return dict(plain(inputs))


def _settings(options: TrackOptions, run: RunData) -> TrackerSettings:
    """Return the settings; in a run too short to confirm a track, all of its frames do."""
    settings = options.tracker
    hits = max(1, min(settings.confirm_hits, run.frame_count))
    return replace(settings, confirm_hits=hits, confirm_frames=max(hits, settings.confirm_frames))


def check_calibration(run: RunData, calibration: Calibration) -> tuple[Camera, ...]:
    """Return the cameras of the calibration.

    Raises CalibrationError when it has only one, or when the run was not taken with them.
    """
    if len(calibration.cameras) < 2:
        raise CalibrationError(
            "tracking in space needs two cameras or more, but the calibration has "
            f"{len(calibration.cameras)}",
            todo="calibrate all cameras together",
        )
    names = [c.name for c in calibration.cameras]
    if list(run.cameras) != names:
        raise CalibrationError(
            f"the run's cameras are {', '.join(run.cameras)}, the calibration's {', '.join(names)}",
            where=str(run.path),
            todo="give the calibration of this rig (--calibration), or use the same camera names "
            "in both",
        )
    for camera in calibration.cameras:
        size = run.image_sizes_px.get(camera.name)
        if size is not None and size != camera.image_size_px:
            raise CalibrationError(
                f"images of camera {camera.name} are {size[0]} x {size[1]} px, the calibration is "
                f"for {camera.image_size_px[0]} x {camera.image_size_px[1]}",
                where=str(run.path),
                todo="give the calibration of this rig, made at this image size",
            )
    return calibration.cameras


def stage_axis(run: RunData, calibration: Calibration) -> Array:
    """Return the unit vector (3,) of the stage's travel in the rig frame.

    It comes from the calibration, otherwise from rig.toml, otherwise it is upwards in the images.
    """
    axis: ArrayLike = (0.0, -1.0, 0.0)
    if calibration.stage:
        axis = calibration.stage["axis"]
    elif run.rig is not None and run.rig.stage is not None:
        axis = run.rig.stage.axis
    return np.asarray(np.asarray(axis, float) / np.linalg.norm(axis))


def upwards(run: RunData, axis: Array) -> Array:
    """Return the unit vector (3,) against gravity in the rig frame: that of rig.toml, or the
    travel axis."""
    described = None if run.rig is None else run.rig.stage
    return axis if described is None else np.asarray(described.up, float)


def _complete(detections: pd.DataFrame) -> pd.DataFrame:
    """Return a user's detections with missing columns left blank."""
    missing = [name for name in DETECTION_COLUMNS if name not in detections]
    blank = {name: "" if name == "flags" else np.nan for name in missing}
    return detections.assign(**blank)


def ids_of(detections: pd.DataFrame | FrameTable) -> set[str]:
    """Return the given ids of bubbles, as text."""
    if isinstance(detections, FrameTable):
        return set(detections.particles) - {""}
    if "particle" not in detections:
        return set()
    return set(detections["particle"].unique().astype(str)) - {""}


def _whole(ids: Iterable[str]) -> dict[str, int]:
    """Return the numbers of those ids that are whole numbers below `LARGEST_ID`, as 7 for "07"."""
    found = {text: int(text) for text in ids if text.isascii() and text.isdecimal()}
    return {text: number for text, number in found.items() if number < LARGEST_ID}


def numbers_of(ids: set[str]) -> tuple[dict[str, int], dict[int, str] | None]:
    """Return the number of each given id, and the ids' names by number.

    The names are None if all given ids are whole numbers below `LARGEST_ID`, each written in one
    way, "3" or "3.0".
    """
    given = sorted(ids)
    numbers = {text: number for text in given if (number := whole_id(text)) is not None}
    if len(set(numbers.values())) == len(given) and min(numbers.values(), default=0) >= 0:
        return numbers, None
    return {text: i for i, text in enumerate(given)}, dict(enumerate(given))


def _given(
    detections: pd.DataFrame | FrameTable, numbers: dict[str, int]
) -> Iterator[pd.DataFrame]:
    """Yield a user's detections with numbers for their ids, -1 where blank."""
    parts = detections.parts() if isinstance(detections, FrameTable) else iter((detections,))
    for part in parts:
        texts = part["particle"].astype(str) if "particle" in part else pd.Series("", part.index)
        particle = texts.map(numbers | {"": NO_PARTICLE}).astype(np.int64)
        yield _complete(part).assign(particle=particle)


def _name(particle: Any, names: Mapping[int, str]) -> str:
    """Return the given name of a track, or its number as text."""
    return names.get(int(particle), str(particle))


def _labelled(part: Linked, labels: Mapping[int, str]) -> Linked:
    """Replace numbers by the given names, None where there is no track."""

    def named(particle: pd.Series[Any]) -> pd.Series[Any]:
        names = [None if pd.isna(p) else _name(p, labels) for p in particle]
        return pd.Series(names, particle.index, dtype=object)

    return Linked(
        part.tracks.assign(particle=named(part.tracks["particle"])),
        part.detections.assign(particle=named(part.detections["particle"])),
    )


def _split(table: pd.DataFrame, cameras: Sequence[Camera]) -> dict[int, Tables]:
    """Return the bubbles of all cameras by frame; rows with a reason only are left out."""
    kept = table[np.isfinite(table["u_px"].to_numpy(float))]
    found = dict(iter(kept.groupby(["frame", "camera"], sort=False)))
    return {
        int(f): tuple(found.get((f, c.name), kept.iloc[:0]) for c in cameras)
        for f in sorted(set(table["frame"]))
    }


def _sample(
    cameras: Sequence[Camera], batches: Callable[[], Iterator[pd.DataFrame]]
) -> list[Tables]:
    """Return the detections of `MODEL_FRAMES` of the frames in which two cameras see bubbles."""
    some = np.concatenate([np.zeros(0, np.int64), *map(_seen_by_two, batches())])
    frames = some[np.linspace(0, len(some) - 1, min(len(some), MODEL_FRAMES)).astype(int)]
    return [
        tables
        for batch in batches()
        for tables in _split(batch[batch["frame"].isin(frames)], cameras).values()
    ]


def _seen_by_two(batch: pd.DataFrame) -> Ints:
    """Return the frames of a batch in which two cameras or more have detections."""
    cameras = batch[np.isfinite(batch["u_px"].to_numpy(float))].groupby("frame")["camera"].nunique()
    return np.asarray(cameras.index[cameras >= 2], np.int64)


def _shapes(sample: list[Tables], model: RigModel, up: Array) -> Shapes:
    """Return how the run's bubbles deviate from spheroids, by its reliable groups."""
    if not sample:
        return Shapes()
    tables, counts, found = candidates_of(sample, model)
    starts = np.cumsum(counts, axis=0) - counts
    seen = []
    for first, (groups, _) in zip(starts, found):
        rows = groups.rows[groups.probability > _RELIABLE]
        seen.append(np.where(rows >= 0, rows + first, -1))
    sightings = [sightings_from_table(t, c, model.cameras) for c, t in enumerate(tables)]
    many = counts.sum(0)
    rows = np.concatenate(seen)
    order = np.where(rows >= 0, rows + np.cumsum(many) - many, -1)
    return learn_shapes(Sightings.concat(sightings), order, model.cameras, up)


def _linked(
    run: RunData,
    cameras: tuple[Camera, ...],
    batches: Iterator[pd.DataFrame],
    linker: RowMaker,
    without: dict[str, dict[str, int]],
    stage: Progress | None,
) -> Iterator[Linked]:
    done = 0
    if stage is not None:
        stage("tracks", 0, run.frame_count)
    for batch, last in _with_ends(batches, run.frame_count):
        _count_reasons(batch, without)
        empty = tuple(batch.iloc[:0] for _ in cameras)
        numbers = batch["frame"].to_numpy()
        for first in range(done, last, _FRAMES_AT_ONCE):
            frames = range(first, min(first + _FRAMES_AT_ONCE, last))
            split = _split(batch[(numbers >= first) & (numbers < frames.stop)], cameras)
            tables = [split.get(frame, empty) for frame in frames]
            for frame, own, sight in zip(frames, tables, linker.sights(tables)):
                position = None if run.position_mm is None else float(run.position_mm[frame])
                rows = linker.add(frame, float(run.t_s[frame]), position, own, sight)
                if rows is not None:
                    yield rows
            if stage is not None:
                stage("tracks", frames.stop, run.frame_count)
        done = last
    rows = linker.finish()
    if rows is not None:
        yield rows


def _with_ends(batches: Iterator[pd.DataFrame], frames: int) -> Iterator[tuple[pd.DataFrame, int]]:
    """Yield each batch with the frame after its last one, which is the run's end for the last."""
    before = next(batches)
    for batch in batches:
        if len(batch):
            yield before, int(batch["frame"].min())
            before = batch
    yield before, frames


def _count_reasons(batch: pd.DataFrame, without: dict[str, dict[str, int]]) -> None:
    if "reason" not in batch:
        return
    empty = batch[batch["reason"] != ""]
    for camera, reason in zip(empty["camera"].astype(str), empty["reason"].astype(str)):
        without[camera][reason] = without[camera].get(reason, 0) + 1
