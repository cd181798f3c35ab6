"""What the images of a run show: bubbles, and the strip of dots of rig.toml [references].

Frames are worked on in batches over the cores; each batch is kept in a file, so that an interrupted
run goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array, Bools
from telerig.errors import InputError
from telerig.estimator.bubbles.background.from_run import (
    LEAST_FRAMES,
    Background,
    estimate_background,
)
from telerig.estimator.bubbles.detect import find_bubbles, load_compiled_loops
from telerig.estimator.bubbles.field import described_field
from telerig.estimator.bubbles.outline.blobs import Rejected
from telerig.estimator.bubbles.outline.ellipse_geometry import DETECTION_COLUMNS
from telerig.io.dataset.run import RunData
from telerig.io.files.atomic import atomic_path
from telerig.io.files.csv_table import write_table
from telerig.io.machine.parallel import cores, keep_freed_memory, ordered_map, quick_workers
from telerig.io.results.inputs import Source, fingerprints
from telerig.io.results.work_folder import empty_unless, work_key
from telerig.live import due, publish
from telerig.rig.camera import Camera

if TYPE_CHECKING:
    from telerig.estimator.marks.following import StripInImages
    from telerig.io.rig_file.description import ReferencesDescription

Progress = Callable[[str, int, int], None]
CORRECTIONS = "corrections.csv"
"""File of a run with corrections of its tracks; programs keep copies under longer names."""
Batch = tuple[int, int]
"""The first frame of a batch, and the frame after its last."""

FRAMES_FOR_WORKERS = 40
"""Below this, starting fresh worker processes costs more than it saves."""

_BATCHES, _LEAST_BATCH, _LARGEST_BATCH = 64, 4, 64
"""A run has about so many batches, and a batch so many frames. They do not depend on the number of
cores, so that a run can go on with another one."""


class Sought(NamedTuple):
    """Which dark spots count as bubbles; see `telerig.detect_bubbles`."""

    min_diameter_px: float
    min_contrast: float


@dataclass(frozen=True)
class Scene:
    """Hold what the detections of all F frames have in common.

    backgrounds : background of each camera, by name.
    sought : which dark spots count as bubbles.
    strips : by camera name, the dots fixed to the tank, which are erased from the images.
    fields : by camera name, where bubbles are looked for (rows, columns); absent for everywhere.
    """

    run: RunData
    backgrounds: dict[str, Background]
    sought: Sought
    strips: Mapping[str, StripInImages] = field(default_factory=dict)
    fields: Mapping[str, Bools] = field(default_factory=dict)

    def image(self, camera: str, frame: int) -> NDArray[Any] | None:
        """Return an image (height, width) without the strip's dots; None if the image is
        missing.
        """
        return _image(self.run, self.strips, camera, frame)


def make_scene(
    run: RunData,
    cameras: Sequence[Camera],
    axis_rig: Array,
    sought: Sought,
    progress: Progress | None = None,
    strips: Mapping[str, StripInImages] | None = None,
) -> Scene:
    """Estimate each camera's background from the images of the run.

    axis_rig : (3,) unit vector of the stage's travel in the rig frame.
    progress : function that is called with the name of the step, the number done and the total.
    strips : dots to erase, by camera name; None for none.
    """
    fields = described_fields(run)
    shifts = {c.name: lab_shift_px(c, axis_rig, run.position_mm, run.frame_count) for c in cameras}
    names = [c.name for c in cameras]
    estimate = partial(_background, run, shifts, strips or {})
    backgrounds = {}
    if progress is not None:
        progress("background", 0, len(names))
    for name, found in zip(names, ordered_map(estimate, names, quick_workers(len(names)))):
        backgrounds[name] = found
        if progress is not None:
            progress("background", len(backgrounds), len(names))
    return Scene(run, backgrounds, sought, strips or {}, fields)


def described_fields(run: RunData) -> dict[str, Bools]:
    """Return by camera where rig.toml says that bubbles are to be looked for (rows, columns).

    Raises InputError for a region or a mask that does not fit the camera's images.
    """
    if run.rig is None:
        return {}
    masks, out = mask_files(run), {}
    for name in set(run.cameras) & set(run.rig.bubbles):
        width, height = run.rig.cameras[name].image_size_px
        region = run.rig.bubbles[name].region
        where = f"rig.toml [bubbles.{name}] region"
        field = described_field((height, width), region, masks.get(name), where)
        if field is not None:
            out[name] = field
    return out


def mask_files(run: RunData) -> dict[str, Path]:
    """Return {camera: mask}, images that are 0 where no bubbles are sought."""
    described = {} if run.rig is None else run.rig.bubbles
    folder = run.path.parent.parent
    return {name: folder / one.mask for name, one in described.items() if one.mask is not None}


def _image(
    run: RunData, strips: Mapping[str, StripInImages], camera: str, frame: int
) -> NDArray[Any] | None:
    image, strip = run.image(camera, frame), strips.get(camera)
    return image if image is None or strip is None else strip.erased(image, frame)


def _background(
    run: RunData,
    shifts: dict[str, Array],
    strips: Mapping[str, StripInImages],
    camera: str,
) -> Background:
    keep_freed_memory()
    images = partial(_image, run, strips, camera)
    return estimate_background(images, run.frame_count, shift_px=shifts[camera])


def lab_shift_px(
    camera: Camera, axis_rig: Array, position_mm: Array | None, frame_count: int
) -> Array:
    """Return the travel of the rig since the first frame as (F, 2) in px of a camera.

    An object at rest in the laboratory that is seen at pixel p in the first frame is later seen at
    p minus this shift. It is computed for the middle of the image at depth 0, and is NaN in frames
    without a stage position; 0 if too few frames have one for a background.

    axis_rig : (3,) unit vector of the travel in the rig frame.
    position_mm : (F,) encoder positions, NaN where missing; None without an encoder.
    """
    if position_mm is None or np.isfinite(position_mm).sum() < LEAST_FRAMES:
        return np.zeros((frame_count, 2))
    start = position_mm[np.isfinite(position_mm)][0]
    moved = (position_mm - start)[:, None] * axis_rig
    width, height = camera.image_size_px
    origin, _ = camera.unproject(np.array([(width - 1) / 2, (height - 1) / 2]))
    return np.asarray(camera.project(origin + moved) - camera.project(origin))


class DetectionStore:
    """Keep the detections of each batch of frames in CSV files, so that an interrupted run can
    continue. When its rows are complete, `LinkedRows` of the same folder has the detections.

    The folder belongs to one fingerprint of input and options; it is emptied if the fingerprint is
    a different one. It holds tables of three kinds: "detections" of bubbles, "rejected" shadows
    beside them, and "dots" of a strip.
    """

    def __init__(self, folder: Path, fingerprint: str, frame_count: int) -> None:
        self.folder, self.frame_count = folder, frame_count
        size = int(np.clip(frame_count // _BATCHES, _LEAST_BATCH, _LARGEST_BATCH))
        self.batches = list(pairwise([*range(0, frame_count, size), frame_count]))
        empty_unless(folder, fingerprint)

    def path(self, batch: Batch, kind: str = "detections") -> Path:
        """Return the file of a batch of frames."""
        return self.folder / f"{kind}-{batch[0]:07d}.csv"

    def missing(self, kind: str = "detections") -> list[Batch]:
        """Return the batches of frames that are not detected yet."""
        return [b for b in self.batches if not self.path(b, kind).is_file()]

    def tables(self, kind: str = "detections") -> Iterator[pd.DataFrame]:
        """Yield the table of each batch of frames, in their order."""
        return (read_batch(self.path(batch, kind)) for batch in self.batches)

    def fill(
        self,
        kind: str,
        table_of: Callable[[Batch], pd.DataFrame],
        progress: Progress | None,
        name: str,
        executor: Executor | None = None,
    ) -> None:
        """Compute the missing tables of one kind in parallel and write them.

        table_of : function that returns the table of a batch; it has to work in another process.
        progress : function that is called with ``name``, the number of frames done and the total;
            or None.
        executor : runs the batches, on computers that see the same folders at the same paths; None
            for processes of this computer.
        """
        missing = self.missing(kind)
        frames = sum(last - first for first, last in missing)
        done = self.frame_count - frames
        if progress is not None:
            progress(name, done, self.frame_count)
        if executor is not None:
            finished = _elsewhere(self, kind, table_of, missing, executor)
        else:
            large = frames >= FRAMES_FOR_WORKERS
            workers = min(cores(), len(missing)) if large else quick_workers(len(missing))
            finished = ordered_map(partial(_write, self, kind, table_of), missing, workers)
        for first, last in finished:
            done += last - first
            if kind == "detections" and due("detected"):
                publish("detected", file=self.path((first, last)), frame=last - 1)
            if progress is not None:
                progress(name, done, self.frame_count)


def _write(
    store: DetectionStore, kind: str, table_of: Callable[[Batch], pd.DataFrame], batch: Batch
) -> Batch:
    write_table(table_of(batch), store.path(batch, kind))
    return batch


def _elsewhere(
    store: DetectionStore,
    kind: str,
    table_of: Callable[[Batch], pd.DataFrame],
    batches: Sequence[Batch],
    executor: Executor,
) -> Iterator[Batch]:
    """Batches in the order in which an executor has written them.

    The scene is too large to be sent with every batch: it is a file in the store's folder, which a
    worker that takes the place of a dead one finds as well.
    """
    shared = pickle.dumps((store, kind, table_of))
    path = store.folder / f"{kind}-{hashlib.sha256(shared).hexdigest()[:16]}.pickle"
    with atomic_path(path) as staged:
        staged.write_bytes(shared)
    futures = [executor.submit(_write_shared, str(path), batch) for batch in batches]
    try:
        for future in as_completed(futures):
            yield future.result()
    finally:
        for future in futures:
            future.cancel()
        path.unlink(missing_ok=True)


def _write_shared(path: str, batch: Batch) -> Batch:
    keep_freed_memory()
    return _write(*_shared(path), batch)


@lru_cache(maxsize=1)
def _shared(path: str) -> tuple[DetectionStore, str, Callable[[Batch], pd.DataFrame]]:
    found: tuple[DetectionStore, str, Callable[[Batch], pd.DataFrame]]
    found = pickle.loads(Path(path).read_bytes())
    return found


def read_batch(path: Path) -> pd.DataFrame:
    """Read a CSV table that `write_table` wrote; blank texts become ""."""
    kinds = {"camera": str, "flags": str, "reason": str}
    # a camera may be named NA
    table = pd.read_csv(path, dtype=kinds, keep_default_na=False, na_values=[""])
    texts = [name for name in kinds if name in table]
    table[texts] = table[texts].fillna("")
    return table


def fingerprint(run: RunData, options: dict[str, Any]) -> str:
    """Return a hash of the options, of the program, and of what was recorded of the run.

    Corrections of the tracks do not count, and images as `Source` has them.
    """
    tables = (p for p in run.path.iterdir() if p.is_file() and p.stem not in run.cameras)
    recorded = fingerprints(
        run.path,
        [
            Source(run.path, cameras=run.cameras),
            *sorted(p for p in tables if CORRECTIONS not in p.name),
        ],
    )
    return work_key(options, recorded)


def detect_missing(
    scene: Scene,
    store: DetectionStore,
    progress: Progress | None,
    executor: Executor | None = None,
) -> None:
    """Detect bubbles in every frame that the store lacks.

    executor : see `DetectionStore.fill`.
    """
    if executor is None:
        load_compiled_loops()
    table_of = partial(_detect_batch, scene, store)
    store.fill("detections", table_of, progress, "detection", executor)


def _detect_batch(scene: Scene, store: DetectionStore, batch: Batch) -> pd.DataFrame:
    """Return the bubbles of a batch, after the shadows that are none were written."""
    keep_freed_memory()
    found = [
        _detect(scene, camera, frame) for frame in range(*batch) for camera in scene.run.cameras
    ]
    bubbles, rejected = map(joined, zip(*found))
    write_table(rejected, store.path(batch, "rejected"))
    return bubbles


def joined(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return the rows of one or more tables in one; columns of empty tables have no type."""
    return pd.concat([t for t in tables if len(t)] or tables[:1], ignore_index=True)


def _detect(scene: Scene, camera: str, frame: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Detect the bubbles of an image; without any the reason is the only row.

    Returns them, and the shadows that are no bubbles (`Bubbles.rejected`).
    """
    image, strip = scene.image(camera, frame), scene.strips.get(camera)
    found, reason = pd.DataFrame(columns=DETECTION_COLUMNS), "no image"
    rejected = pd.DataFrame(columns=Rejected._fields)
    if image is not None:
        level = scene.backgrounds[camera].of_frame(frame)
        try:
            bubbles = find_bubbles(
                image, background=level, field=scene.fields.get(camera),
                **scene.sought._asdict(),
            )  # fmt: skip
        except InputError as error:
            raise InputError(
                error.what, where=f"camera {camera}, frame {frame}", todo=error.todo
            ) from error
        found, rejected = bubbles.accepted, bubbles.rejected
        if strip is not None and len(found):
            found = found[~strip.are_dots(frame, found)].reset_index(drop=True)
        reason = str(found.attrs.get("reason", "")) or "no bubble" if found.empty else ""
    if found.empty:
        found = pd.DataFrame({name: [np.nan] for name in DETECTION_COLUMNS}).assign(flags="")
    found = found.assign(frame=frame, camera=camera, reason=reason)
    return found, rejected.assign(frame=frame, camera=camera)


def described_strip(run: RunData) -> ReferencesDescription | None:
    """Return the description of the strip of dots in rig.toml.

    It is None if there is none, if the run has its own references.csv, or if it has no images.
    """
    described = run.rig.references if run.rig is not None else None
    return described if run.source == "images" and run.references is None else None
