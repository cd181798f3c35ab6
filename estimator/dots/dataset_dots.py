"""The numbered dots of every image of a dataset, with what was rejected and why."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.errors import DetectionError, InputError
from telerig.estimator.dots.detect_target import (
    MEASURED,
    REJECTED,
    ambiguous_numbering,
    numbered_table,
    rejected_table,
)
from telerig.estimator.dots.grid.numbering import check_handedness, number_dots
from telerig.estimator.dots.locate import DotMeasurement, measure_dots
from telerig.io.dataset.dataset import Dataset, View
from telerig.io.machine.parallel import cores, ordered_map, quick_workers
from telerig.rig.target import Target

Progress = Callable[[int, int], None]

MEGAPIXELS_FOR_WORKERS = 40
"""Below this, starting fresh worker processes costs more than it saves."""

OVERLAY_WIDTH_PX = 900

NO_DOTS = pd.DataFrame(columns=["dot", "row", "column", *MEASURED])


@dataclass(frozen=True)
class ImageDots:
    """One image: its numbered dots, its rejected candidates, and why it was left out, if it was.

    overlay : a JPEG of the image with all of them, where it was asked for.
    """

    view: str
    camera: str
    dots: pd.DataFrame
    rejected: pd.DataFrame
    handedness: int
    failure: str = ""
    notes: tuple[str, ...] = ()
    overlay: bytes = b""


@dataclass(frozen=True)
class DatasetDots:
    """dots, rejected : tables of all images, first columns view and camera.

    images : per image, in the order of views and cameras.  notes : words for the user.
    example : one dot with its fit, as `dot_example` gives it, where overlays were asked for.
    """

    dots: pd.DataFrame
    rejected: pd.DataFrame
    images: tuple[ImageDots, ...] = ()
    notes: tuple[str, ...] = field(default=())
    example: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)


def detect_dataset(
    dataset: Dataset,
    *,
    progress: Progress | None = None,
    workers: int | None = None,
    overlays: bool = False,
    meanwhile: Callable[[], object] | None = None,
) -> DatasetDots:
    """Detect the target in every calibration image.

    workers : processes; None takes one per core where that pays.
    overlays : draw them, and fit one dot as an example.
    meanwhile : called in this process while the others work.

    Raises InputError for images that cannot be read, DetectionError when no image shows the
    target or when images contradict each other's handedness.
    """
    tasks = [(view, camera) for view in dataset.views for camera in view.image_paths]
    count = _workers(dataset, len(tasks)) if workers is None else workers
    found: list[ImageDots] = []
    work = partial(_one_of, dataset, overlays)
    if count > 1:
        _prepare(dataset, overlays, tasks[0])
    for done, image in enumerate(ordered_map(work, tasks, count, meanwhile), 1):
        found.append(image)
        if progress is not None:
            progress(done, len(tasks))
    together = detected_together(dataset, found)
    return with_example(dataset, together) if overlays else together


def _prepare(dataset: Dataset, overlays: bool, task: tuple[View, str]) -> None:
    """Load what copies of this process would each load at their first image."""
    dataset.image(*task)
    if overlays:
        import cv2  # noqa: F401

        import telerig.estimator.dots.example_dot
        import telerig.io.report.overlays.dots  # noqa: F401


def detect_image(dataset: Dataset, view: View, camera: str, *, overlay: bool = False) -> ImageDots:
    """The target in one image. Raises InputError for an image that cannot be read."""
    return _one_of(dataset, overlay, (view, camera))


def detected_together(dataset: Dataset, found: list[ImageDots]) -> DatasetDots:
    """Tables and notes of images that were detected one by one.

    Raises DetectionError when none shows the target, or when they contradict each other's
    handedness.
    """
    failures = [i for i in found if i.failure]
    if len(failures) == len(found):
        raise DetectionError(
            f"the target was found in none of {len(found)} images",
            where=str(dataset.path / "calibration"),
            todo=f"first failure: view {failures[0].view}, camera {failures[0].camera}: "
            f"{failures[0].failure}",
        )
    hands = {(i.view, i.camera): i.handedness for i in found if not i.failure}
    check_handedness(hands, dataset.target.two_sided)
    notes = [f"view {i.view}, camera {i.camera} left out: {i.failure}" for i in failures]
    notes += [f"view {i.view}, camera {i.camera}: {n}" for i in found for n in i.notes]
    return DatasetDots(
        _joined(found, "dots"), _joined(found, "rejected"), tuple(found), tuple(notes)
    )


def with_example(dataset: Dataset, detected: DatasetDots) -> DatasetDots:
    """With the fit of a well-kept dot, that of median chi-square."""
    from telerig.estimator.dots.example_dot import dot_example

    order = np.argsort(detected.dots["chi2_dof"].to_numpy())
    chosen = detected.dots.iloc[int(order[len(order) // 2])]
    view = next(v for v in dataset.views if v.name == chosen["view"])
    example = dot_example(
        dataset.image(view, chosen["camera"]), float(chosen["u_px"]), float(chosen["v_px"]),
        float(chosen["a_px"]), polarity=dataset.target.polarity,
    )  # fmt: skip
    return replace(detected, example=example or {})


def _joined(images: list[ImageDots], name: str) -> pd.DataFrame:
    tables: list[pd.DataFrame] = []
    for image in images:
        table = getattr(image, name).copy()
        table.insert(0, "camera", image.camera)
        table.insert(0, "view", image.view)
        tables.append(table)
    kept = [t for t in tables if len(t)] or tables[:1]
    return pd.concat(kept, ignore_index=True)


def _workers(dataset: Dataset, images: int) -> int:
    pixels = [int(np.prod(c.image_size_px)) for c in dataset.rig.cameras.values()]
    large = sum(pixels) / len(pixels) * images / 1e6 > MEGAPIXELS_FOR_WORKERS
    return min(cores(), images) if large else quick_workers(images)


def _one_of(dataset: Dataset, overlay: bool, task: tuple[View, str]) -> ImageDots:
    image = dataset.image(*task)
    found = _one(dataset, image, *task)
    if not overlay:
        return found
    from telerig.io.report.overlays.dots import overlay_jpeg

    drawn = overlay_jpeg(image, found.dots, found.rejected, max_width_px=OVERLAY_WIDTH_PX)
    return replace(found, overlay=drawn)


def _one(dataset: Dataset, image: NDArray[Any], view: View, camera: str) -> ImageDots:
    target: Target = dataset.target
    smallest = _smallest_px(dataset, camera)
    try:
        measured = measure_dots(image, polarity=target.polarity, min_diameter_px=smallest)
    except InputError as error:
        raise InputError(
            error.what, where=str(view.image_paths[camera]), todo=error.todo
        ) from error
    try:
        numbering = number_dots(measured.dots, target)
        if numbering.ambiguous:
            raise ambiguous_numbering(numbering, target)
    except DetectionError as error:
        words = f"{error.what}" + (f" ({error.todo})" if error.todo else "")
        return ImageDots(view.name, camera, NO_DOTS, _all_rejected(measured, error.what), 0, words)
    rejected = rejected_table(measured.dots, measured.rejected, numbering)
    table = numbered_table(measured.dots, numbering)
    notes = tuple(n for n in numbering.notes if "assumed" not in n)
    return ImageDots(view.name, camera, table, rejected, numbering.handedness, notes=notes)


def _all_rejected(measured: DotMeasurement, reason: str) -> pd.DataFrame:
    parts = [measured.dots.assign(reason=reason)[REJECTED], measured.rejected[REJECTED]]
    filled = [part for part in parts if len(part)]
    return pd.concat(filled, ignore_index=True) if filled else pd.DataFrame(columns=REJECTED)


def _smallest_px(dataset: Dataset, camera: str) -> float:
    """A third of the nominal dot, so that dirt is passed over; tilts foreshorten to 0.3."""
    nominal = dataset.target.dot_diameter_mm * dataset.rig.cameras[camera].scale_px_per_mm
    return float(max(5.0, 0.35 * nominal))
