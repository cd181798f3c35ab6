"""Measures the numbered dots of one image, and those of all images of a dataset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.errors import DetectionError, InputError, need_kind
from telerig.estimator.dots.fit.candidates import Polarity
from telerig.estimator.dots.grid.agreement import PossibleNumbers, decided_by_pair
from telerig.estimator.dots.grid.numbering import (
    OUTSIDE,
    Numbering,
    is_likely,
    number_dots,
)
from telerig.estimator.dots.grid.seen_target import SeenTarget, contradiction, seen_target
from telerig.estimator.dots.locate import REJECTED, DotMeasurement, measure_dots
from telerig.io.dataset.dataset import Dataset, View
from telerig.io.machine.parallel import cores, ordered_map, quick_workers
from telerig.io.results.findings import Code, Finding
from telerig.io.tables.table import EDGE_COVARIANCE, PIXEL_COVARIANCE
from telerig.rig.target import Target, check_handedness

MEASURED = [
    *("u_px", "v_px", *PIXEL_COVARIANCE),
    *("a_px", "b_px", "angle_rad", "chi2_dof", *EDGE_COVARIANCE),
]


@dataclass(frozen=True)
class TargetDetection:
    """The target as it was found in one image.

    table : a row for each numbered dot, sorted by number: dot, row, column and the measured columns
        of `locate_dots` up to chi2_dof.
    rejected : candidates that were left out (u_px, v_px, a_px, b_px, angle_rad, reason).
    numbering : how the dots were numbered.
    """

    table: pd.DataFrame
    rejected: pd.DataFrame
    numbering: Numbering


def detect_target(image: NDArray[Any], target: Target) -> pd.DataFrame:
    """Find the target's dots in an image (rows, columns) of grey levels and number them.

    target : as rig.toml describes it, `load_dataset(folder).rig.target`.
    Returns a table with a row for each dot and the columns dot (number), row, column, u_px, v_px,
    suu_px2, suv_px2, svv_px2, a_px, b_px, angle_rad, chi2_dof, edge_suu_px2, edge_suv_px2,
    edge_svv_px2; see `locate_dots`. For a symmetric
    target without marks it holds one of several equal numberings.
    Raises DetectionError if the target is not found or its numbers are ambiguous, and InputError if
    ``image`` is no grey image.
    """
    todo = "give the target of a rig: telerig.load_dataset(folder).rig.target"
    need_kind(target, "polarity", "telerig.detect_target", todo)
    measured = measure_dots(image, polarity=target.polarity)
    found = _numbered(image, measured, target)
    if found.numbering.ambiguous:
        raise _ambiguous(found, measured, target)
    return found.table


def _numbered(
    image: NDArray[Any], measured: DotMeasurement, target: Target, min_diameter_px: float = 5.0
) -> TargetDetection:
    """Number the target's dots that were measured in an image, see `numbered`.

    Raises DetectionError, which says what of the target in rig.toml does not fit the image, if they
    cannot be numbered.

    min_diameter_px : as for `measure_dots`.
    """
    try:
        return numbered(measured, target)
    except DetectionError as error:
        words = _other_polarity(image, measured, target, min_diameter_px)
        words = words or _described_otherwise(measured, target)
        raise DetectionError(error.what, todo=words or error.todo) from error


def _ambiguous(found: TargetDetection, measured: DotMeasurement, target: Target) -> DetectionError:
    """Return the error for a numbering that is not unique."""
    error = ambiguous_numbering(found.numbering, target)
    return DetectionError(error.what, todo=_described_otherwise(measured, target) or error.todo)


def _other_polarity(
    image: NDArray[Any], measured: DotMeasurement, target: Target, min_diameter_px: float
) -> str:
    """Return what to do if the image shows the target, or else a grid, in the other polarity."""
    other: Polarity = "black_on_white" if target.polarity == "white_on_black" else "white_on_black"
    inverse = measure_dots(image, polarity=other, min_diameter_px=min_diameter_px)
    try:
        numbered(inverse, target)
    except DetectionError:
        if _grid(measured) or not _grid(inverse):
            return ""
    stated, seen = (name.replace("_", " ") for name in (target.polarity, other))
    return (
        f'the image shows dots {seen}, not {stated}: write polarity = "{other}" into [target] of '
        "rig.toml"
    )


def _grid(measured: DotMeasurement) -> SeenTarget | None:
    """Return the grid that an image shows, None if it shows none."""
    try:
        return seen_target(measured.dots, measured.image_shape)
    except DetectionError:
        return None


def _described_otherwise(measured: DotMeasurement, target: Target) -> str:
    seen = _grid(measured) if target.layout == "grid" else None
    return "" if seen is None else contradiction(seen, target)


def numbered(measured: DotMeasurement, target: Target) -> TargetDetection:
    """Find out which dot of the target each measured dot of an image is.

    If several numberings fit equally well, one of them is returned and ``numbering.ambiguous`` is
    True. Raises DetectionError if no numbering fits.
    """
    if not len(measured.dots) and len(measured.rejected):
        reasons = measured.rejected["reason"].value_counts()
        raise DetectionError(
            f"no dots found: {len(measured.rejected)} spots were rejected, {reasons.iloc[0]} of "
            f"them because: {reasons.index[0]}",
            todo="check the exposure and the focus, [target] polarity and dot_diameter_mm, and "
            "scale_px_per_mm of the camera in rig.toml; a dot needs a diameter of 5 px, and of a "
            "third of the one that rig.toml states",
        )
    numbering = number_dots(measured.dots, target, measured.image_shape)
    rows = measured.dots.iloc[numbering.table["index"].to_numpy()][MEASURED]
    unplaced = numbering.unplaced
    return TargetDetection(
        pd.concat([numbering.table[["dot", "row", "column"]], rows.reset_index(drop=True)], axis=1),
        rejected_table(measured, unplaced["index"].to_numpy(), unplaced["reason"].to_numpy()),
        numbering,
    )


def ambiguous_numbering(numbering: Numbering, target: Target) -> DetectionError:
    """Return the error that the caller may raise for a numbering that is not unique."""
    found, wanted = len(numbering.marks_found), len(target.marks)
    likely = is_likely(numbering.score)
    hands = set(numbering.equivalent_handedness[likely].tolist())
    mirrored = "; some of these need the image to be mirrored" if len(hands) > 1 else ""
    count = np.count_nonzero(likely)
    return DetectionError(
        f"the {len(numbering.table)} dots can be numbered in {count} ways that fit the image about "
        f"equally well{mirrored}; {found} of the target's {wanted} marks were found",
        todo="keep all marks in view, clean and lit, or leave this image out",
    )


def rejected_table(measured: DotMeasurement, index: Any, reason: Any) -> pd.DataFrame:
    """Return a table of the blobs and dots of an image that are not dots of the target.

    index : positions in ``measured.dots`` of the dots that are rejected. reason : why, for each.
    Returns the columns u_px, v_px, a_px, b_px, angle_rad and reason.
    """
    dots = measured.dots.iloc[index].assign(reason=reason)[REJECTED]
    parts = [part for part in (measured.rejected, dots) if len(part)]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=REJECTED)


Progress = Callable[[int, int], None]

MEGAPIXELS_FOR_WORKERS = 40
"""Number of pixels below which starting worker processes takes longer than they save."""

NO_DOTS = pd.DataFrame(columns=["dot", "row", "column", *MEASURED])


@dataclass(frozen=True)
class ImageDots:
    """What was found in one image of the target.

    dots, rejected : ``table`` and ``rejected`` of `TargetDetection`.
    handedness : -1 if the image shows the target mirrored, +1 if not, 0 if no target was found.
    failure : why the image was left out, or "".
    overlay : JPEG data of the image with the dots and rejected candidates drawn, or empty.
    found : the dots and all their possible numberings; None if they cannot be numbered.
    """

    view: str
    camera: str
    dots: pd.DataFrame
    rejected: pd.DataFrame
    handedness: int
    failure: str = ""
    overlay: bytes = b""
    found: TargetDetection | None = None


@dataclass(frozen=True)
class DatasetDots:
    """What was found in all images of a dataset, in the order of views and cameras.

    dots, rejected : tables of all images, each row with its view and camera.
    """

    dots: pd.DataFrame
    rejected: pd.DataFrame
    images: tuple[ImageDots, ...] = ()
    findings: tuple[Finding, ...] = ()


def detect_dataset(
    dataset: Dataset,
    *,
    progress: Progress | None = None,
    workers: int | None = None,
    overlays: bool = False,
    meanwhile: Callable[[], object] | None = None,
) -> DatasetDots:
    """Detect the target in every calibration image of a dataset.

    progress : is called with (number of images done, number of images).
    workers : number of processes; None chooses it from the number of images.
    overlays : whether to draw the overlay of each image.
    meanwhile : is called in this process while the worker processes detect.

    Raises InputError for an image that cannot be read, and DetectionError if no image shows the
    target or if some images are mirrored and others are not.
    """
    tasks = [(view, camera) for view in dataset.views for camera in view.image_paths]
    count = _workers(dataset, len(tasks)) if workers is None else workers
    found: list[ImageDots] = []
    work = partial(_detect_task, dataset, overlays)
    # what the first image loads here, each worker process would otherwise load again
    rest = ordered_map(work, tasks[1:], count, meanwhile)
    for done, image in enumerate(chain(map(work, tasks[:1]), rest), 1):
        found.append(image)
        if progress is not None:
            progress(done, len(tasks))
    return detected_together(dataset, found)


def detect_image(dataset: Dataset, view: View, camera: str, *, overlay: bool = False) -> ImageDots:
    """Read one image of a dataset and detect the target in it.

    If the target is not found, ``failure`` of the result says why. overlay : whether to draw the
    overlay. Raises InputError if the image cannot be read.
    """
    image = dataset.image(view, camera)
    found = _numbered_image(dataset, image, view, camera)
    return _with_overlay(found, image) if overlay else found


def _with_overlay(found: ImageDots, image: NDArray[Any]) -> ImageDots:
    from telerig.io.report.overlays import draw_overlay, encoded

    drawn = draw_overlay(image, found.dots, found.rejected, max_width_px=900)
    return replace(found, overlay=encoded(drawn))


def _detect_task(dataset: Dataset, overlay: bool, task: tuple[View, str]) -> ImageDots:
    return detect_image(dataset, *task, overlay=overlay)


def detected_together(dataset: Dataset, found: list[ImageDots]) -> DatasetDots:
    """Return the results of all images of a dataset as one.

    What one image leaves open of its numbering is decided by the other camera's, if it can be.
    Raises DetectionError if no image shows the target, or if only some of them are mirrored.
    """
    found = _decided_by_pairs(dataset, found)
    failures = [i for i in found if i.failure]
    if len(failures) == len(found):
        raise DetectionError(
            f"the target was found in none of {len(found)} images",
            where=str(dataset.path / "calibration"),
            todo=f"the first failure is in view {failures[0].view}, camera {failures[0].camera}: "
            f"{failures[0].failure}",
        )
    hands = {(i.view, i.camera): i.handedness for i in found if not i.failure}
    check_handedness(hands, dataset.target.two_sided)
    left_out = tuple(
        Code.LEFT_OUT.found(cameras=i.camera, views=i.view, text=i.failure) for i in failures
    )
    return DatasetDots(_joined(found, "dots"), _joined(found, "rejected"), tuple(found), left_out)


def _decided_by_pairs(dataset: Dataset, found: list[ImageDots]) -> list[ImageDots]:
    """Return the images, those that `decided_by_pair` decides with their numbers."""
    by_image = {(i.view, i.camera): i for i in found}
    if dataset.target.symmetry_order() > 1:
        return found
    for cameras in combinations(dict.fromkeys(i.camera for i in found), 2):
        views: dict[str, tuple[PossibleNumbers, PossibleNumbers]] = {}
        for view in dict.fromkeys(i.view for i in found):
            first, second = (by_image.get((view, camera)) for camera in cameras)
            if first and second and first.found and second.found:
                views[view] = _possible_numbers(first.found), _possible_numbers(second.found)
        for view, choices in decided_by_pair(views).items():
            for camera, choice in zip(cameras, choices):
                image = by_image[view, camera]
                by_image[view, camera] = _numbered_as(dataset, image, choice)
    return [by_image[i.view, i.camera] for i in found]


def _possible_numbers(found: TargetDetection) -> PossibleNumbers:
    numbering = found.numbering
    uv_px = found.table[["u_px", "v_px"]].to_numpy(float)
    return PossibleNumbers(uv_px, numbering.equivalents, numbering.score)


def _numbered_as(dataset: Dataset, image: ImageDots, choice: int) -> ImageDots:
    """Return an image with one of its possible numberings."""
    found = image.found
    assert found is not None
    before = found.numbering
    ids, hand = before.equivalents[choice], int(before.equivalent_handedness[choice])
    row, column = dataset.target.row_column_from_id(ids)
    table = found.table.assign(dot=ids, row=row, column=column)
    off = table[ids < 0].assign(reason=OUTSIDE)[REJECTED]
    only = replace(
        before, equivalents=ids[None], score=np.zeros(1), ambiguous=False, handedness=hand,
        equivalent_handedness=np.array([hand]),
    )  # fmt: skip
    numbered_so = replace(image, dots=table[ids >= 0].sort_values("dot", ignore_index=True),
        rejected=pd.concat([found.rejected, off], ignore_index=True), handedness=hand, failure="",
        found=replace(found, table=table, numbering=only),
    )  # fmt: skip
    if not image.overlay:
        return numbered_so
    view = next(v for v in dataset.views if v.name == image.view)
    return _with_overlay(numbered_so, dataset.image(view, image.camera))


def _joined(images: list[ImageDots], name: str) -> pd.DataFrame:
    tables = [_with_image(getattr(image, name), image) for image in images]
    kept = [t for t in tables if len(t)] or tables[:1]
    return pd.concat(kept, ignore_index=True)


def _with_image(table: pd.DataFrame, image: ImageDots) -> pd.DataFrame:
    named = table.assign(view=image.view, camera=image.camera)
    return named[["view", "camera", *table.columns]]


def _workers(dataset: Dataset, images: int) -> int:
    pixels = [int(np.prod(c.image_size_px)) for c in dataset.rig.cameras.values()]
    large = sum(pixels) / len(pixels) * images / 1e6 > MEGAPIXELS_FOR_WORKERS
    return min(cores(), images) if large else quick_workers(images)


def _numbered_image(dataset: Dataset, image: NDArray[Any], view: View, camera: str) -> ImageDots:
    target = dataset.target
    smallest_px = _smallest_px(dataset, camera)
    try:
        measured = measure_dots(image, polarity=target.polarity, min_diameter_px=smallest_px)
    except InputError as error:
        where = str(view.image_paths[camera])
        raise InputError(error.what, where=where, todo=error.todo) from error
    try:
        found = _numbered(image, measured, target, smallest_px)
    except DetectionError as error:
        return _left_out(view, camera, measured, error)
    if found.numbering.ambiguous:
        unsure = _ambiguous(found, measured, target)
        return replace(_left_out(view, camera, measured, unsure), found=found)
    hand = found.numbering.handedness
    return ImageDots(view.name, camera, found.table, found.rejected, hand, found=found)


def _left_out(
    view: View, camera: str, measured: DotMeasurement, error: DetectionError
) -> ImageDots:
    words = f"{error.what}" + (f" ({error.todo})" if error.todo else "")
    rejected = rejected_table(measured, slice(None), error.what)
    return ImageDots(view.name, camera, NO_DOTS, rejected, 0, words)


def _smallest_px(dataset: Dataset, camera: str) -> float:
    """Return the least diameter of a dot (px): about a third of the nominal one."""
    nominal = dataset.target.dot_diameter_mm * dataset.rig.cameras[camera].scale_px_per_mm
    return float(max(5.0, 0.35 * nominal))
