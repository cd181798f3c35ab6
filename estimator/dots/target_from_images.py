"""From images of a target to the lines that describe it in a new `rig.toml`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from telerig.errors import DetectionError, InputError
from telerig.estimator.dots.fit.candidates import Polarity
from telerig.estimator.dots.grid.seen_target import (
    SeenPoints,
    SeenTarget,
    agreed_points,
    agreed_target,
    seen_points,
    seen_target,
)
from telerig.estimator.dots.locate import measure_dots
from telerig.io.images.read import list_images, read_image
from telerig.io.rig_file.description import MOST_CAMERAS

MOST_IMAGES = 6
"""Images of each camera that are looked at, evenly spread over all."""
_WHOLE_VIEWS = 0.8
"""Share of the views with an image of every camera, above which names seem to name cameras."""
_VIEW_AND_CAMERA = (
    re.compile(r"(?P<view>.+)(?P<camera>[_-][^_-]+)"),
    re.compile(r"(?P<camera>[^_-]+[_-])(?P<view>.+)"),
)


@dataclass(frozen=True)
class TargetProposal:
    """What the images of one camera or several show.

    cameras : for each camera its name, (width, height) in px and scale in px/mm.
    pitch_px : distance of neighbouring dots in the first camera along the axis on which it is
        larger, for a target that faces the camera.
    lines : content of the table [target] of rig.toml.
    words : sentences for the user.
    sources : the folder of each camera's images.
    """

    cameras: tuple[tuple[str, tuple[int, int], float], ...]
    pitch_px: float
    lines: str
    words: tuple[str, ...]
    sources: Mapping[str, Path]


def target_from_images(
    folder: Path, *, pitch_mm: float | None, scale_px_per_mm: float
) -> TargetProposal:
    """Describe the target that images in a folder, or in one folder for each camera, show.

    pitch_mm : the known distance of neighbouring dots (along x).
    scale_px_per_mm : nominal scale of the first camera, used where no pitch is given.

    Raises InputError if there are no images, if one folder has those of several cameras, or if
    those of a camera differ in size, DetectionError if none shows a grid of dots.
    """
    found, failures = [], []
    by_camera = _images_by_camera(folder)
    for name, images in by_camera.items():
        some = images[:: -(-len(images) // MOST_IMAGES)]
        for path in some:
            image = read_image(path)
            measured = measure_dots(image)
            try:
                seen = seen_points(measured.dots, image.shape) or seen_target(
                    measured.dots, image.shape
                )
            except DetectionError as error:
                failures.append(f"{path}: {error.what}")
                continue
            found.append((name, image.shape[1::-1], path, measured.polarity, seen))
    if not found:
        what = f"no image shows a grid of dots; the first: {failures[0]}"
        todo = "give images in which at least 6 whole, sharp dots of the grid are seen"
        raise DetectionError(what, where=str(folder), todo=todo)
    _refuse_sizes([(name, size) for name, size, *_ in found], folder)
    polarity = Counter(p for *_, p, _ in found).most_common(1)[0][0]
    failures += [
        f"{path}: its dots are {p.replace('_', ' ')}, unlike those of most images; it is not used"
        for *_, path, p, _ in found if p != polarity
    ]  # fmt: skip
    found = [one for one in found if one[3] == polarity]
    pointwise = 2 * sum(isinstance(seen, SeenPoints) for *_, seen in found) > len(found)
    failures += [
        f"{path}: its grid is of another kind than in most images; it is not used"
        for *_, path, _, seen in found if isinstance(seen, SeenPoints) != pointwise
    ]  # fmt: skip
    found = [one for one in found if isinstance(one[4], SeenPoints) == pointwise]
    pointed = [seen for *_, seen in found if isinstance(seen, SeenPoints)]
    grids = [seen for *_, seen in found if isinstance(seen, SeenTarget)]
    agreed = agreed_points(pointed) if pointwise else agreed_target(grids)
    diameter_px = {
        name: float(np.median([seen.diameter_px for n, *_, seen in found if n == name]))
        for name in dict.fromkeys(n for n, *_ in found)
    }
    first = next(iter(diameter_px))
    pitch_px = max(agreed.pitch) * diameter_px[first]
    if pitch_mm is None:
        pitch_mm = round(agreed.pitch[0] * diameter_px[first] / scale_px_per_mm, 4)
    dot_mm = pitch_mm / agreed.pitch[0]
    sizes = {n: (int(w), int(h)) for n, (w, h), *_ in found}
    cameras = tuple((n, sizes[n], round(d / dot_mm, 4)) for n, d in diameter_px.items())
    words = _words(agreed, polarity, len(found), diameter_px[first], pitch_px)
    if not set.intersection(*({p.stem for p in images} for images in by_camera.values())):
        failures.append(
            "no view has an image of every camera: give the images of one view the same name in "
            "all folders"
        )
    sources = {name: by_camera[name][0].parent for name, *_ in cameras}
    return TargetProposal(
        cameras, pitch_px, _lines(agreed, polarity, pitch_mm), (*words, *failures), sources
    )


def _refuse_sizes(sizes: Sequence[tuple[str, tuple[int, ...]]], folder: Path) -> None:
    """Raise InputError if images of one camera (its name, and their size) differ in size."""
    first = dict(reversed(sizes))
    for name, size in sizes:
        if size != first[name]:
            known, other = (f"{w}x{h}" for w, h in (first[name], size))
            raise InputError(
                f"images of camera {name} have different sizes, {known} and {other} px",
                where=str(folder),
                todo="give images of one camera, or one folder for each camera",
            )


def _images_by_camera(folder: Path) -> dict[str, list[Path]]:
    images = list_images(folder)
    if images:
        _refuse_several_cameras(folder, [path.stem for path in images])
        return {"camera": images}
    folders = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    found = {p.name: list_images(p) for p in folders}
    found = {name: paths for name, paths in found.items() if paths}
    if not found:
        todo = "give a folder of images, or one that has a folder of images for each camera"
        raise InputError("holds no images", where=str(folder), todo=todo)
    return found


def _refuse_several_cameras(folder: Path, names: Sequence[str]) -> None:
    """Raise InputError if the names of images in one folder seem to be those of several cameras.

    They do if most views, two at least, have an image with each of two to four endings, or
    beginnings, like _0 and _1.
    """
    for pattern in _VIEW_AND_CAMERA:
        split = [pattern.fullmatch(name) for name in names]
        views: dict[str, set[str]] = {}
        for found in filter(None, split):
            views.setdefault(found["view"], set()).add(found["camera"])
        cameras = sorted(set().union(*views.values()))
        whole = sum(len(seen) == len(cameras) for seen in views.values())
        several = all(split) and len(views) > 1 and 1 < len(cameras) <= MOST_CAMERAS
        if several and whole > _WHOLE_VIEWS * len(views):
            first, *_ = (view for view, seen in views.items() if len(seen) == len(cameras))
            raise InputError(
                f"the names of the {len(names)} images have {' or '.join(cameras)}, as if "
                f"{len(cameras)} cameras had taken {len(views)} views",
                where=str(folder),
                todo="make a folder for each camera, named like the camera, in which an image of "
                f"the same view has the same name (left/{first}, right/{first}), and give the "
                "folder that holds these folders; if one camera took all, make one such folder",
            )


def _lines(seen: SeenTarget | SeenPoints, polarity: Polarity, pitch_mm: float) -> str:
    """Return the lines of [target]."""
    dot_mm = round(pitch_mm / seen.pitch[0], 4)
    if isinstance(seen, SeenPoints):
        (*shape,), rest, counted = seen.lines(pitch_mm), [], "in points_mm from 0"
    else:
        across_mm = round(pitch_mm * seen.pitch[1] / seen.pitch[0], 4)
        square = abs(across_mm / pitch_mm - 1.0) < 0.02
        pitch = f"pitch_mm = {pitch_mm if square else [pitch_mm, across_mm]}"
        shape, rest = ['layout = "grid"', *seen.lines()[:2], pitch], seen.lines()[2:]
        counted = "along the rows from 0"
    large = seen.mark_style == "large"
    return "\n".join([
        *shape,
        f"dot_diameter_mm = {dot_mm}",
        f'polarity = "{polarity}"',
        *rest,
        *([f"mark_diameter_mm = {round(seen.mark_diameter * dot_mm, 4)}"] if large else []),
        "print_sigma_mm = 0.02              # how far a dot may be from its place in the plane",
        "flatness_sigma_mm = 0.02           # and out of it",
        f"# scale_dots = [0, 1]              # two dots, counted {counted} ...",
        "# scale_distance_mm = 1.0          # ... whose distance was measured ...",
        "# scale_sigma_mm = 0.001           # ... so well",
    ])  # fmt: skip


def _words(
    seen: SeenTarget | SeenPoints,
    polarity: Polarity,
    images: int,
    diameter_px: float,
    pitch_px: float,
) -> Sequence[str]:
    """Return what was found as sentences. diameter_px, pitch_px : in the first camera."""
    if isinstance(seen, SeenTarget):
        kind, size = "a grid", f"{seen.rows} rows, {seen.columns} columns"
    else:
        kind, size = seen.kind, f"of {len(seen.points)} dots"
    whole = kind if seen.whole else f"{kind} that goes on beyond the images; seen at once:"
    marks = f"{len(seen.marks)} marks of the style {seen.mark_style}" if seen.marks else "no marks"
    words = [
        f"{images} images show {whole} {size}, "
        f"{polarity.replace('_', ' ')}, {marks}, dots {diameter_px:.1f} px across, "
        f"{pitch_px:.1f} px apart"
    ]
    if isinstance(seen, SeenPoints) and not seen.whole:
        words.append("add to points_mm the dots that no image shows, or photograph the whole plate")
    if not seen.marks:
        words.append(
            "without marks the whole grid must be in view, and its numbering stays ambiguous by "
            "the grid's symmetry, if gaps do not break it"
        )
    return words
