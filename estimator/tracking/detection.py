"""The bubbles of every frame, found over the cores; what is found is kept if the work stops."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.estimator.bubbles.background.from_run import Background, estimate_background
from telerig.estimator.bubbles.detect import detect_bubbles
from telerig.estimator.bubbles.outline.detection_table import DETECTION_COLUMNS
from telerig.estimator.marks.erasing import StripInImages
from telerig.io.dataset.run import RunData
from telerig.io.files.atomic import write_json_atomic
from telerig.io.files.csv_table import write_table
from telerig.io.machine.parallel import cores, ordered_map, quick_workers
from telerig.rig.camera import Camera

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

FRAMES_FOR_WORKERS = 40
"""Below this, starting fresh worker processes costs more than it saves."""

_LARGEST_BATCH = 64


@dataclass(frozen=True)
class Scene:
    """What every frame's detection shares.

    backgrounds : by camera; shift_px : by camera, (F, 2) travel of the rig, see `lab_shift_px`.
    strips : by camera, dots fixed to the tank, which are taken out of the images.
    """

    run: RunData
    backgrounds: dict[str, Background]
    shift_px: dict[str, Array]
    min_diameter_px: float
    strips: Mapping[str, StripInImages] = field(default_factory=dict)

    def image(self, camera: str, frame: int) -> NDArray[Any] | None:
        """(H, W) without the strip's dots; None where it is missing."""
        return image_without_strip(self.run, self.strips, camera, frame)


def make_scene(
    run: RunData,
    cameras: Sequence[Camera],
    axis_rig: Array,
    min_diameter_px: float,
    progress: Progress | None = None,
    strips: Mapping[str, StripInImages] | None = None,
) -> Scene:
    """Estimate each camera's background from the run itself."""
    shifts = {c.name: lab_shift_px(c, axis_rig, run.position_mm, run.frame_count) for c in cameras}
    names = [c.name for c in cameras]
    estimate = partial(_background, run, shifts, strips or {})
    backgrounds = {}
    for name, found in zip(names, ordered_map(estimate, names, quick_workers(len(names)))):
        backgrounds[name] = found
        if progress is not None:
            progress("background", len(backgrounds), len(names))
    return Scene(run, backgrounds, shifts, min_diameter_px, strips or {})


def image_without_strip(
    run: RunData, strips: Mapping[str, StripInImages], camera: str, frame: int
) -> NDArray[Any] | None:
    image, strip = run.image(camera, frame), strips.get(camera)
    return image if image is None or strip is None else strip.erased(image, frame)


def _background(
    run: RunData, shifts: dict[str, Array], strips: Mapping[str, StripInImages], camera: str
) -> Background:
    images = partial(image_without_strip, run, strips, camera)
    return estimate_background(images, run.frame_count, shift_px=shifts[camera])


def lab_shift_px(
    camera: Camera, axis_rig: Array, position_mm: Array | None, frame_count: int
) -> Array:
    """(F, 2) travel of the rig as seen in the image since the first frame.

    What is fixed in the lab and seen at p at first is seen at p - shift. Evaluated in the middle
    of the image at depth 0; frames without a stage position have 0.
    """
    if position_mm is None:
        return np.zeros((frame_count, 2))
    travelled = position_mm - position_mm[np.isfinite(position_mm)][:1].sum()
    moved = np.where(np.isfinite(travelled), travelled, 0.0)[:, None] * axis_rig
    width, height = camera.image_size_px
    origin, _ = camera.unproject(np.array([(width - 1) / 2, (height - 1) / 2]))
    return np.asarray(camera.project(origin + moved) - camera.project(origin))


class DetectionStore:
    """Batches of detections in files, so that an interrupted run goes on where it was.

    The folder belongs to one fingerprint of input and options; another one starts afresh.
    """

    def __init__(self, folder: Path, fingerprint: str, frame_count: int, workers: int) -> None:
        self.folder = folder
        size = int(np.clip(frame_count // (4 * workers), 4, _LARGEST_BATCH))
        edges = [*range(0, frame_count, size), frame_count]
        self.batches = list(pairwise(edges))
        state = {"fingerprint": fingerprint, "batch": size}
        mark = folder / "work.json"
        if not (mark.is_file() and json.loads(mark.read_bytes()) == state):
            shutil.rmtree(folder, ignore_errors=True)
            write_json_atomic(mark, state)

    def path(self, batch: tuple[int, int]) -> Path:
        return self.folder / f"detections-{batch[0]:07d}.csv"

    @property
    def missing(self) -> list[tuple[int, int]]:
        return [b for b in self.batches if not self.path(b).is_file()]

    def tables(self) -> Iterator[pd.DataFrame]:
        return (read_batch(self.path(batch)) for batch in self.batches)

    def remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


def read_batch(path: Path) -> pd.DataFrame:
    """A table that `write_table` wrote; empty texts are ""."""
    import pandas as pd

    kinds = {"camera": str, "flags": str, "reason": str}
    table = pd.read_csv(path, dtype=kinds)
    texts = [name for name in kinds if name in table]
    table[texts] = table[texts].fillna("")
    return table


def fingerprint(run: RunData, options: dict[str, Any]) -> str:
    """Changes when the recording, the options or the version do."""
    from telerig.version import VERSION

    found = hashlib.sha256(json.dumps([VERSION, options], default=str).encode())
    for folder, folders, names in os.walk(run.path):
        folders.sort()
        inside = Path(folder).relative_to(run.path)
        for name in sorted(names):
            state = (Path(folder) / name).stat()
            place = (inside / name).as_posix()
            found.update(f"{place} {state.st_size} {state.st_mtime_ns}\n".encode())
    return found.hexdigest()


def detect_missing(scene: Scene, store: DetectionStore, progress: Progress | None) -> None:
    """Detect in every frame that the store lacks."""
    frames, missing = scene.run.frame_count, store.missing
    done = frames - sum(last - first for first, last in missing)
    if progress is not None:
        progress("frames", done, frames)
    large = frames - done >= FRAMES_FOR_WORKERS
    workers = min(cores(), len(missing)) if large else quick_workers(len(missing))
    work = partial(_detect_batch, scene, store)
    for first, last in ordered_map(work, missing, workers):
        done += last - first
        if progress is not None:
            progress("frames", done, frames)


def _detect_batch(scene: Scene, store: DetectionStore, batch: tuple[int, int]) -> tuple[int, int]:
    import pandas as pd

    tables = [
        _detect(scene, camera, frame) for frame in range(*batch) for camera in scene.run.cameras
    ]
    kept = [t for t in tables if len(t)] or tables[:1]
    write_table(pd.concat(kept, ignore_index=True), store.path(batch))
    return batch


def _detect(scene: Scene, camera: str, frame: int) -> pd.DataFrame:
    """One image's bubbles; an image without one gives a row that only says why."""
    import pandas as pd

    image, strip = scene.image(camera, frame), scene.strips.get(camera)
    if image is None:
        found, reason = pd.DataFrame(columns=DETECTION_COLUMNS), "no image"
    else:
        level = scene.backgrounds[camera].at(tuple(scene.shift_px[camera][frame]))
        try:
            found = detect_bubbles(image, background=level, min_diameter_px=scene.min_diameter_px)
        except InputError as error:
            raise InputError(
                error.what, where=f"camera {camera}, frame {frame}", todo=error.todo
            ) from error
        if strip is not None and len(found):
            found = found[~strip.are_dots(frame, found)].reset_index(drop=True)
        reason = str(found.attrs.get("reason", "")) or "no bubble" if found.empty else ""
    if found.empty:
        found = pd.DataFrame({name: [np.nan] for name in DETECTION_COLUMNS}).assign(flags="")
    return found.assign(frame=frame, camera=camera, reason=reason)
