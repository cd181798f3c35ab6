"""A recording of bubbles as it is in memory: times, stage, sensors; images stay on disk."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError, suggestion
from telerig.io.images.frames import FrameSource
from telerig.io.images.read import Image, check_size
from telerig.io.rig_file.description import RigDescription

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
RunSource = Literal["images", "detections"]


@dataclass(frozen=True)
class RunData:
    """What `load_run` found.

    cameras : names, the rig's first camera first. t_s : (F,) mid-exposure.
    position_mm : (F,) the stage's position at t_s, NaN outside its record; None without stage.csv.
    detections : None when the source is images. image_sizes_px : (width, height) by camera.
    notes : what a user should know, in words; frames found unreadable later are added.
    skip_unreadable : whether `image` gives None for a frame that cannot be read; None: only for
    the last one.
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
    detections: pd.DataFrame | None = field(default=None, repr=False, compare=False)
    notes: list[str] = field(default_factory=list)
    skip_unreadable: bool | None = None
    sources: Mapping[str, FrameSource] = field(default_factory=dict, repr=False, compare=False)
    positions: Mapping[str, NDArray[np.int64]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def image(self, camera: str | int, frame: int) -> Image | None:
        """(height, width) as stored; None when the frame is missing in that camera.

        Raises InputError for a frame that cannot be read (see ``skip_unreadable``), has another
        size, or when the run has detections in place of images.
        """
        name = self.camera_name(camera)
        if name not in self.sources:
            raise InputError(
                "the run was loaded from detections.csv, it has no images",
                where=str(self.path),
                todo="load it from its images (--from images)",
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

    def frames_of(self, camera: str | int) -> Iterator[Image | None]:
        """The camera's images in order, None where one is missing."""
        return (self.image(camera, frame) for frame in range(self.frame_count))

    def camera_name(self, camera: str | int) -> str:
        """The camera's name from its name or its index. Raises InputError for an unknown one."""
        if isinstance(camera, int) and 0 <= camera < len(self.cameras):
            return self.cameras[camera]
        if isinstance(camera, str) and camera in self.cameras:
            return camera
        todo = suggestion(str(camera), list(self.cameras))
        raise InputError(f"no camera {camera!r} in the run", where=str(self.path), todo=todo)

    def positions_on_record_mm(self) -> Array:
        """(F,) stage positions, all of them known.

        Raises InputError when there is no stage.csv, or frames lie outside its record.
        """
        if self.position_mm is None:
            raise InputError(
                "there is no stage.csv",
                where=str(self.path),
                todo="record the encoder's t_s,position_mm",
            )
        outside = np.flatnonzero(np.isnan(self.position_mm))
        if outside.size:
            raise InputError(
                outside_record(self.t_s, outside),
                where=str(self.path / "stage.csv"),
                todo="record the stage from before the first frame until after the last, check "
                "the clocks' offset, or leave those frames out",
            )
        return self.position_mm

    def _may_skip(self, camera: str, position: int) -> bool:
        last = position == len(self.sources[camera]) - 1
        return last and position > 0 if self.skip_unreadable is None else self.skip_unreadable


def outside_record(t_s: Array, outside: NDArray[np.int64]) -> str:
    """Which frames lie outside the stage's record, in words."""
    first, last = int(outside[0]), int(outside[-1])
    frames = f"frame {first}" if outside.size == 1 else f"{outside.size} frames ({first} to {last})"
    span = f"{t_s[first]:.6g} s" + ("" if first == last else f" to {t_s[last]:.6g} s")
    return f"{frames} at {span} lie outside the record of stage.csv"
