"""Read a recording of bubbles: its tables are read and checked, its frames stay on disk.

The frames of several cameras are paired by the numbers in their names, or by their order.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError, suggestion
from telerig.io.dataset.tables import (
    DETECTION_SIGMA_PX,
    REFERENCE_SIGMA_PX,
    assumed_noise,
    check_frame_count,
    choose_source,
    read_accelerometer_csv,
    read_detections_csv,
    read_detections_part,
    read_frames_csv,
    read_references_csv,
    read_run_toml,
    read_stage_csv,
)
from telerig.io.files.frame_table import FrameTable
from telerig.io.files.names import absent, check_name
from telerig.io.images.frames import FILE_EXTENSIONS, FrameSource, open_frames
from telerig.io.images.high_speed import HighSpeedFrames
from telerig.io.images.read import Image, check_size, list_images
from telerig.io.rig_file.description import RigDescription, camera_named
from telerig.io.rig_file.rig_file import read_rig_toml

RunSource = Literal["images", "detections"]


@dataclass(frozen=True)
class RunData:
    """Hold what `load_run` found in the folder of a run with F frames.

    t_s : (F,) the middle of each frame's exposure in s.
    position_mm : (F,) the stage's position at t_s, NaN outside the encoder's record; None without
        stage.csv.
    image_sizes_px : (width, height) by camera.
    source : "images" or "detections".
    rig : the content of rig.toml.
    stage, accelerometers, references, detections : the tables of stage.csv, accelerometer.csv,
        references.csv and detections.csv. Each is None if there is no such file. A large
        detections.csv is a `FrameTable`, which stays on disk.
    notes : sentences that a user should read. `image` adds one for each frame that it cannot read.
    skip_unreadable : whether `image` returns None for a frame that cannot be read. True: for every
        frame; False: for none; None: only for the last frame of a recording.
    sources : the opened frames by camera.
    positions : (F,) by camera, the position of each frame among the camera's opened frames, -1 for
        a missing frame.
    """

    name: str
    path: Path
    cameras: tuple[str, ...]
    frame_count: int
    t_s: Array
    position_mm: Array | None
    image_sizes_px: Mapping[str, tuple[int, int]]
    source: RunSource
    rig: RigDescription | None = None
    stage: pd.DataFrame | None = field(default=None, repr=False, compare=False)
    accelerometers: pd.DataFrame | None = field(default=None, repr=False, compare=False)
    references: pd.DataFrame | None = field(default=None, repr=False, compare=False)
    detections: pd.DataFrame | FrameTable | None = field(default=None, repr=False, compare=False)
    notes: list[str] = field(default_factory=list)
    skip_unreadable: bool | None = None
    sources: Mapping[str, FrameSource] = field(default_factory=dict, repr=False, compare=False)
    positions: Mapping[str, Ints] = field(default_factory=dict, repr=False, compare=False)

    def image(self, camera: str | int, frame: int) -> Image | None:
        """Read one frame of one camera.

        camera : name or index. frame : from 0.
        Returns the pixels (height, width) as stored; None if the camera misses the frame, or if the
        frame cannot be read and `skip_unreadable` permits this. Raises InputError for any other
        frame that cannot be read, for an image of another size, and for a run that was loaded from
        detections.csv.
        """
        name = self.camera_name(camera)
        if name not in self.sources:
            raise InputError(
                "the run was loaded from detections.csv, so it has no images",
                where=str(self.path),
                todo="load the run from its images (--from images)",
            )
        if not 0 <= frame < self.frame_count:
            raise InputError(
                f"there is no frame {frame}",
                where=str(self.path),
                todo=f"frames count from 0 to {self.frame_count - 1}",
            )
        position = int(self.positions[name][frame])
        if position < 0:
            return None
        source = self.sources[name]
        try:
            image = source.read(position)
        except InputError as error:
            if not self._may_skip(name, position):
                raise
            note = f"camera {name}, frame {frame} is left out: {error.what} ({error.where})"
            if note not in self.notes:
                self.notes.append(note)
            return None
        check_size(image, self.image_sizes_px[name], source.where(position))
        return image

    def first(self, frames: int) -> RunData:
        """Return the run with its first ``frames`` frames only; the sensors' records stay whole."""
        if frames < 1:
            raise InputError(
                f"the number of frames is {frames}", where=str(self.path), todo="give 1 or more"
            )
        if frames >= self.frame_count:
            return self

        def earlier(table: pd.DataFrame | None) -> pd.DataFrame | None:
            if table is None:
                return None
            return table[table["frame"] < frames].reset_index(drop=True)

        return replace(
            self,
            frame_count=frames,
            t_s=self.t_s[:frames],
            position_mm=None if self.position_mm is None else self.position_mm[:frames],
            references=earlier(self.references),
            detections=self.detections.before(frames)
            if isinstance(self.detections, FrameTable)
            else earlier(self.detections),
            positions={name: places[:frames] for name, places in self.positions.items()},
            notes=[*self.notes, f"only the first {frames} of {self.frame_count} frames are used"],
        )

    def camera_name(self, camera: str | int) -> str:
        """Return the camera's name from its name or index. Raises InputError for another one."""
        return camera_named(camera, list(self.cameras), where=str(self.path))

    def _may_skip(self, camera: str, position: int) -> bool:
        """Return whether the image at this position may be left out if it is unreadable."""
        last = position == len(self.sources[camera]) - 1
        return last and position > 0 if self.skip_unreadable is None else self.skip_unreadable


def load_run(
    path: str | PathLike[str],
    *,
    rig: RigDescription | None = None,
    source: RunSource | None = None,
    cameras: Sequence[str] | None = None,
    image_sizes_px: Mapping[str, tuple[int, int]] | None = None,
    pair_by: Pairing = "auto",
    skip_unreadable: bool | None = None,
) -> RunData:
    """Open a run: read its tables and open its frames. Only the first and last image are decoded.

    path : `DATASET/runs/NAME`, or any folder that holds the same files.
    rig : the content of rig.toml; None looks for a `rig.toml` two folders above the run.
    source : "images" or "detections", from which bubbles are taken; None takes the only one that
        there is. It has to be given if the folder has both.
    cameras : names of the cameras; None takes those that `[tracking]` in rig.toml names, or all
        of rig.toml (without one, of ``image_sizes_px``) that have images (rows in detections.csv).
    image_sizes_px : (width, height) by camera; they replace those of rig.toml.
    pair_by : how the images of several cameras are paired: "numbers", "order" or "auto", see
        `telerig.io.dataset.run.pair_frames`.
    skip_unreadable : True leaves out every frame that cannot be read, and every table of a sensor
        or of marks, False leaves out none and raises an error. None leaves out only the last frame
        of a recording, which may be cut short because the disk was full or the power failed.

    Returns a `RunData`. Raises InputError, which names the file, the row or frame, and what to do.
    """
    folder = run_folder(Path(path))
    check_name(folder.resolve().name, str(folder), "run")
    above = folder.parent.parent / "rig.toml"
    if rig is None and above.is_file():
        rig = read_rig_toml(above)
    names = list(cameras) if cameras else _cameras_of(rig, image_sizes_px or {}, folder)
    every = list(rig.cameras) if rig and not set(names) - set(rig.cameras) else names
    sizes = {name: c.image_size_px for name, c in rig.cameras.items()} if rig else {}
    sizes |= dict(image_sizes_px or {})
    notes: list[str] = []
    recorded = recordings(folder)
    images = _choose_source(folder, recorded, names, source) == "images"
    stated = bool(cameras) or (rig is not None and rig.tracking is not None)
    if images:
        names = _those_there(names, set(recorded), stated)
    file = folder / "frames.csv"
    frames = read_frames_csv(file, every) if file.is_file() else None
    detections = None
    if not images:
        count = None if frames is None else len(frames)
        detections, seen = _detections(folder, names, every, sizes, count, notes)
        names = _those_there(names, seen, stated)
    if len(every) > len(names):
        notes.append(f"of {', '.join(every)}, the run is that of cameras {', '.join(names)}")
    sources = _open_sources(folder, recorded, names, every) if images else {}
    positions = _paired(folder, sources, frames, pair_by, notes) if images else {}
    sizes |= {n: _size(s) for n, s in sources.items() if n not in sizes}
    t_s = _times(folder, frames, sources, positions, detections, notes)
    lost = notes if skip_unreadable else None
    stage = _table(folder / "stage.csv", read_stage_csv, lost)
    if rig is not None and rig.stage is not None and not (folder / "stage.csv").exists():
        notes.append("there is no stage.csv: the stage counts as standing during the run")
    sensors = list(rig.accelerometers) if rig else None
    marks = _table(
        folder / "references.csv",
        lambda file: _of(names, read_references_csv(file, every, sizes, len(t_s))),
        lost,
    )
    if marks is not None:
        notes += assumed_noise(marks, "references.csv", REFERENCE_SIGMA_PX)
    run = RunData(
        name=folder.name,
        path=folder,
        cameras=tuple(names),
        frame_count=len(t_s),
        t_s=t_s,
        position_mm=None if stage is None else _stage_positions(stage, t_s, notes),
        image_sizes_px=sizes,
        source="images" if images else "detections",
        rig=rig,
        stage=stage,
        accelerometers=_table(
            folder / "accelerometer.csv", lambda file: read_accelerometer_csv(file, sensors), lost
        ),
        references=marks,
        detections=detections,
        notes=notes,
        skip_unreadable=skip_unreadable,
        sources=sources,
        positions=positions,
    )
    return _with_ends_checked(run)


def _cameras_of(
    rig: RigDescription | None, sizes_px: Mapping[str, tuple[int, int]], folder: Path
) -> list[str]:
    """Return the names of the tracking cameras; without a rig, of those whose sizes are given."""
    if rig is None and sizes_px:
        return list(sizes_px)
    if rig is None or not rig.cameras:
        raise InputError(
            "there is no rig.toml two folders up, so the cameras are not known",
            where=str(folder),
            todo="put the run into DATASET/runs/, or give a calibration (--calibration FILE)",
        )
    return list(rig.tracking_cameras)


def _those_there(names: list[str], there: set[str], stated: bool) -> list[str]:
    """Return the cameras with data, unless they are stated or fewer than two have some."""
    found = [name for name in names if name in there]
    return names if stated or len(found) < 2 else found


def _of(names: list[str], table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows whose camera is one of ``names``, in the same order."""
    mine = table["camera"].isin(names)
    return table if mine.all() else table[mine].reset_index(drop=True)


def run_folder(path: Path) -> Path:
    """Return the absolute path of a run's folder. Raises InputError if it is none."""
    if path.is_dir():
        return path.resolve()
    raise absent(path, "run", "check the path")


def _choose_source(
    folder: Path, recorded: Collection[str], names: list[str], source: str | None
) -> RunSource:
    """Return "images" or "detections". Raises InputError when the folder has none, or has both."""
    has: dict[RunSource, bool] = {
        "images": bool(recorded),
        "detections": (folder / "detections.csv").is_file(),
    }
    chosen = choose_source(has, source, folder)
    if chosen is None:
        raise InputError(
            "there is no detections.csv" if source == "detections" else "there are no images",
            where=str(folder),
            todo=f"put frames at {names[0]}/*.tif, {names[0]}.tif or {names[0]}.avi, "
            "or detections into detections.csv",
        )
    return chosen


def recordings(folder: Path) -> dict[str, Path]:
    """List the image folders, multi-page TIFF files and videos that lie in a run's folder.

    Returns the path of each by its name without extension. No file is opened.
    """
    found = {}
    for entry in sorted(folder.iterdir()):
        frames = entry.suffix.lower() in FILE_EXTENSIONS and entry.is_file()
        if not entry.name.startswith(".") and (frames or (entry.is_dir() and list_images(entry))):
            found[entry.name if entry.is_dir() else entry.stem] = entry
    return found


def _open_sources(
    folder: Path, recorded: Mapping[str, Path], names: list[str], every: list[str]
) -> dict[str, FrameSource]:
    """Open the frames of the cameras ``names``, of ``every`` camera of the rig."""
    strangers = {name: p for name, p in recorded.items() if name not in every}
    for name, entry in strangers.items():
        raise InputError(
            f"there is no camera {name!r} in the rig",
            where=str(entry),
            todo=suggestion(name, every) + "; if it is no camera, move it out of the run's folder",
        )
    sources = {name: open_frames(folder, name) for name in names}
    for name, source in sources.items():
        if source is None:
            raise InputError(
                f"camera {name} has no frames",
                where=str(folder),
                todo=f"put the frames at {name}/*.tif, {name}.tif or {name}.avi",
            )
    return {name: source for name, source in sources.items() if source is not None}


def _paired(
    folder: Path,
    sources: Mapping[str, FrameSource],
    frames: pd.DataFrame | None,
    pair_by: Pairing,
    notes: list[str],
) -> dict[str, Ints]:
    """Return `pair_frames`, with what frames.csv reports as missing; append to ``notes``."""
    missing = None
    if frames is not None and "missing" in frames:
        dropped = frames["missing"].str.split("|")
        missing = {n: np.array([n in names for names in dropped], bool) for n in sources}
    positions, found = pair_frames(sources, pair_by, missing, str(folder))
    notes += found
    return positions


def _size(source: FrameSource) -> tuple[int, int]:
    """Return (width, height) in px of the first frame."""
    height, width = source.read(0).shape
    return width, height


def _detections(
    folder: Path,
    names: list[str],
    every: list[str],
    sizes: Mapping[str, tuple[int, int]],
    count: int | None,
    notes: list[str],
) -> tuple[pd.DataFrame | FrameTable, set[str]]:
    """Read detections.csv and keep the rows of the cameras ``names``; append to ``notes``.

    count : number of frames, None where the table decides.
    Returns the cameras that have rows, too.
    """
    path = folder / "detections.csv"
    seen: set[str] = set()

    def read(content: bytes, row: int) -> pd.DataFrame | None:
        part = read_detections_part(path, content, row, every, sizes, count)
        return None if part is None else _of(names, part)

    table: pd.DataFrame | FrameTable | None
    table = FrameTable.of(path, read, lambda part: seen.update(part["camera"].unique()))
    if table is None:
        table = _of(names, read_detections_csv(path, every, sizes, count))
        seen = set(table["camera"])
    if not seen:
        raise InputError(
            f"has no row of the cameras {', '.join(names)}",
            where=str(path),
            todo="name the cameras that saw bubbles: [tracking] cameras in rig.toml",
        )
    if not all(name in sizes for name in names):
        notes.append(
            "the images' sizes are not known, so detections outside the images are not found out"
        )
    absent = [name for name in names if name not in seen]
    notes += [f"detections.csv has nothing of camera {name}" for name in absent]
    notes += assumed_noise(table, path.name, DETECTION_SIGMA_PX)
    return table, seen


def _times(
    folder: Path,
    frames: pd.DataFrame | None,
    sources: Mapping[str, FrameSource],
    positions: Mapping[str, Ints],
    detections: pd.DataFrame | FrameTable | None,
    notes: list[str],
) -> Array:
    """Return the (F,) times in s of the frames from frames.csv, else from run.toml, else recorded.

    positions : of the images; empty where the detections decide how many frames there are.
    """
    settings, count = folder / "run.toml", 0
    if positions:
        count = len(next(iter(positions.values())))
    elif isinstance(detections, FrameTable):
        count = int(detections.last[-1]) + 1
    elif detections is not None:
        count = int(detections["frame"].max()) + 1
    if frames is not None:
        if settings.is_file():
            read_run_toml(settings)
            notes.append("frame times are read from frames.csv; those of run.toml are not used")
        if positions:
            skipped = np.flatnonzero(np.all([p < 0 for p in positions.values()], axis=0))
            check_frame_count(frames, folder / "frames.csv", count, skipped)
        return frames["t_s"].to_numpy(float)
    if settings.is_file():
        rate, start = read_run_toml(settings)
        return start + np.arange(count) / rate
    recorded = _recorded_times(sources, positions)
    if recorded is not None:
        notes.append(f"frame times are read from {recorded[0].name}, counted from its first frame")
        return recorded[1]
    if count == 1:
        notes.append("neither frames.csv nor run.toml: the only frame is taken at 0 s")
        return np.zeros(1)
    raise InputError(
        "has neither frames.csv nor run.toml, so the frames have no times",
        where=str(folder),
        todo="write run.toml with frame_rate_hz = 500.0, or frames.csv with frame,t_s",
    )


def _recorded_times(
    sources: Mapping[str, FrameSource], positions: Mapping[str, Ints]
) -> tuple[Path, Array] | None:
    """Return a high-speed camera's file that has all frames, and their (F,) times in s from 0."""
    for name, source in sources.items():
        if isinstance(source, HighSpeedFrames) and np.all(positions[name] >= 0):
            t_s = source.t_s[positions[name]]
            return source.path, t_s - t_s[:1]
    return None


def _stage_positions(stage: pd.DataFrame, t_s: Array, notes: list[str]) -> Array:
    """Return stage positions (F,) in mm at ``t_s``, NaN outside the record; append to ``notes``."""
    t, position = stage["t_s"].to_numpy(float), stage["position_mm"].to_numpy(float)
    at = np.interp(t_s, t, position, left=np.nan, right=np.nan)
    outside = np.flatnonzero(np.isnan(at))
    if outside.size:
        notes.append(
            f"{_outside_record(t_s, outside)}, {t[0]:.6g} to {t[-1]:.6g} s; their stage position "
            "is not known. Check that both files are in s and of one clock"
        )
    step = np.diff(t)
    if len(t_s) > 1 and np.median(step) > t_s[-1] - t_s[0]:
        notes.append(
            f"the readings of stage.csv are {np.median(step):.3g} s apart, more than the run's "
            f"{t_s[-1] - t_s[0]:.3g} s. Check that t_s is in s"
        )
    wide = np.flatnonzero(step > 10 * np.median(step))
    hit = [i for i in wide if np.any((t_s > t[i]) & (t_s < t[i + 1]))]
    if hit:
        notes.append(
            f"stage.csv has no reading for {step[hit[0]]:.3g} s from {t[hit[0]]:.6g} s on"
            + (f", and {len(hit) - 1} further gaps" if len(hit) > 1 else "")
            + "; the stage's positions in between are interpolated"
        )
    return np.asarray(at, float)


def _outside_record(t_s: Array, outside: Ints) -> str:
    """Return the words that say which frames lie outside the record of the stage's encoder."""
    first, last = int(outside[0]), int(outside[-1])
    frames = f"frame {first}" if outside.size == 1 else f"{outside.size} frames ({first} to {last})"
    span = f"{t_s[first]:.6g} s" + ("" if first == last else f" to {t_s[last]:.6g} s")
    return f"{frames} at {span} lie outside the record of stage.csv"


def _table(
    file: Path, read: Callable[[Path], pd.DataFrame], lost: list[str] | None
) -> pd.DataFrame | None:
    """Read a table with ``read``; returns None when the file does not exist.

    lost : gets a sentence on a file that cannot be read, which is then None; without this list
        InputError is raised.
    """
    try:
        return read(file) if file.is_file() else None
    except InputError as error:
        if lost is None:
            raise
        lost.append(f"{file.name} is left out: {error.what} ({error.where})")
        return None


def _with_ends_checked(run: RunData) -> RunData:
    """Decode the first and the last image of each camera, so that wrong sizes show at once."""
    for name, positions in run.positions.items():
        present = np.flatnonzero(positions >= 0)
        for frame in present[[0, -1]] if present.size else ():
            run.image(name, int(frame))
    return run


Pairing = Literal["auto", "numbers", "order"]

_TODO = (
    "do one of these: add the missing images; give images of the same frame the same number in "
    "their names; or name the missing frames in the column `missing` of frames.csv"
)


def pair_frames(
    sources: Mapping[str, FrameSource],
    pair_by: Pairing,
    missing: Mapping[str, Bools] | None,
    where: str,
) -> tuple[dict[str, Ints], list[str]]:
    """Find which images of several cameras belong to the same frame.

    pair_by : "numbers" pairs by the numbers in the file names, "order" by the order of the images,
        and "auto" by the numbers if they are plausible, otherwise by the order.
    sources : the opened frames by camera.
    missing : (F,) by camera, True for the frames that frames.csv reports as dropped; None for none.
    where : the folder, for errors.

    Returns for each camera the position (F,) of each frame among its opened frames, -1 for a
    missing frame, and sentences for the user. Raises InputError if the images cannot be paired
    safely.
    """
    if pair_by not in get_args(Pairing):
        todo = f"give one of {', '.join(get_args(Pairing))}"
        raise InputError(f"pair_by is {pair_by!r}", where=where, todo=todo)
    if missing is not None:
        return _by_missing(sources, missing, where)
    numbers = {name: source.numbers() for name, source in sources.items()}
    counts = {name: len(source) for name, source in sources.items()}
    if pair_by == "order":
        return _in_order(counts)
    known = {name: n for name, n in numbers.items() if n is not None}
    if len(known) == len(numbers) and (pair_by == "numbers" or _trustworthy(known, where)):
        return _by_numbers(known)
    if pair_by == "numbers":
        silent = ", ".join(name for name, n in numbers.items() if n is None)
        raise InputError(
            f"the names of the images of camera {silent} do not contain the number of the frame",
            where=where,
            todo='name images like 000000.tif, 000001.tif, or pair them in order (pair_by="order")',
        )
    if len(set(counts.values())) > 1:
        counted = ", ".join(f"{name} {count}" for name, count in counts.items())
        what = f"the cameras have different numbers of frames: {counted}"
        raise InputError(what, where=where, todo=_TODO)
    return _in_order(counts)


def _trustworthy(numbers: Mapping[str, Ints], where: str) -> bool:
    """Return whether the numbers in the file names have few gaps and largely agree between cameras.

    Raises InputError when the counts agree but the numbers are shifted: both pairings are
    plausible.
    """
    step = _step(numbers)
    spans = [int(n[-1] - n[0]) // step + 1 for n in numbers.values()]
    if any(span > 2 * len(n) + 8 for span, n in zip(spans, numbers.values())):
        return False
    sets = [set(n.tolist()) for n in numbers.values()]
    shared = set.intersection(*sets)
    if all(len(shared) == len(one) for one in sets):
        return True
    whole = all(span == len(n) for span, n in zip(spans, numbers.values()))
    if len(set(map(len, sets))) == 1 and whole:
        if not shared:
            return False
        starts = " and ".join(f"{name} at {n[0]}" for name, n in numbers.items())
        raise InputError(
            "the cameras have equal numbers of images, but the numbers in the images' names start "
            f"differently: {starts}",
            where=where,
            todo="write frames.csv with a column `missing`: blank if the first images belong "
            "together; with the frames that a camera misses, if equal numbers mean the same frame",
        )
    return 2 * len(shared) >= min(map(len, sets))


def _step(numbers: Mapping[str, Ints]) -> int:
    """Return the greatest common step of the numbers, for example 2 for 0, 2, 4; at least 1."""
    first = min(int(n[0]) for n in numbers.values())
    offsets = np.concatenate([n - first for n in numbers.values()])
    return int(np.gcd.reduce(offsets)) or 1


def _by_numbers(numbers: Mapping[str, Ints]) -> tuple[dict[str, Ints], list[str]]:
    """Pair frames by the numbers in their names; the returned values are those of `pair_frames`."""
    step, first = _step(numbers), min(int(n[0]) for n in numbers.values())
    count = max(int(n[-1] - first) // step + 1 for n in numbers.values())
    notes = [f"the numbers in the images' names increase by {step}"] if step > 1 else []
    positions = {}
    for name, counted in numbers.items():
        place = np.full(count, -1, np.int64)
        place[(counted - first) // step] = np.arange(len(counted))
        positions[name] = place
        notes += _missing_note(name, place)
    return positions, notes


def _in_order(counts: Mapping[str, int]) -> tuple[dict[str, Ints], list[str]]:
    """Pair frames by their order; the returned values are those of `pair_frames`."""
    frames = np.arange(max(counts.values()), dtype=np.int64)
    positions = {name: np.where(frames < count, frames, -1) for name, count in counts.items()}
    return positions, [note for name, p in positions.items() for note in _missing_note(name, p)]


def _by_missing(
    sources: Mapping[str, FrameSource], missing: Mapping[str, Bools], where: str
) -> tuple[dict[str, Ints], list[str]]:
    """Pair frames by the column ``missing``; a camera has images of all, or of those it kept."""
    positions, notes = {}, []
    for name, source in sources.items():
        gone = missing[name]
        frames, present = len(gone), int(np.sum(~gone))
        if len(source) == frames:
            place = np.where(gone, -1, np.arange(frames))
        elif len(source) == present:
            place = np.where(gone, -1, np.cumsum(~gone) - 1)
        else:
            raise InputError(
                f"camera {name} has {len(source)} images, but frames.csv has {frames} rows and "
                f"states that this camera misses {frames - present} of them",
                where=where,
                todo="correct the column `missing`, or add the missing images",
            )
        positions[name] = place
        notes += _missing_note(name, place)
    return positions, notes


def _missing_note(camera: str, positions: Ints) -> list[str]:
    """Return a list with a sentence that counts a camera's missing frames, if any."""
    gone = np.flatnonzero(positions < 0)
    if not gone.size:
        return []
    some = ", ".join(map(str, gone[:8])) + (", ..." if gone.size > 8 else "")
    return [f"camera {camera} misses {gone.size} frame{'s' if gone.size > 1 else ''}: {some}"]
