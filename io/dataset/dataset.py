"""A dataset folder: its rig file, its calibration views or dots, its runs. Images stay on disk."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pandas as pd

from telerig.errors import InputError, nearest, suggestion
from telerig.io.dataset.tables import DEFAULT_SIGMA_PX, assumed_noise, choose_source, read_dots_csv
from telerig.io.files.names import absent, check_name
from telerig.io.images.read import EXTENSIONS, Image, by_stem, list_images, natural, read_image
from telerig.io.results.record import read_object
from telerig.io.rig_file.description import RigDescription
from telerig.io.rig_file.rig_file import read_rig_toml
from telerig.rig.target import Target
from telerig.short_text import ShortText, counted, first_of

if TYPE_CHECKING:
    from telerig.io.dataset.run import RunData


Source = Literal["images", "dots"]

_FOLDERS = ["calibration", "stage_axis", "runs", "truth", "results"]
_LAYOUT = "put images at calibration/<camera>/<view>.tif, or dots in calibration/dots.csv"


@dataclass(frozen=True)
class View:
    """One position of the calibration target, of which each camera takes an image.

    name : name of its image files without their extension, or the text in column view of dots.csv.
    image_paths : the image file of each camera, by the camera's name; empty if the dots are read
        from dots.csv.
    """

    name: str
    image_paths: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class Run:
    """Hold the name and the folder `runs/<name>` of one recording of bubbles."""

    name: str
    path: Path

    def load(self, **options: Any) -> RunData:
        """Read the run's tables and open its frames with `telerig.io.dataset.run.load_run`."""
        from telerig.io.dataset.run import load_run

        return load_run(self.path, **options)


class Runs(dict[str, Run]):
    """The runs of a dataset by name; InputError with the most similar name for one that is none."""

    def __missing__(self, name: object) -> Run:
        todo = suggestion(str(name), list(self)) if self else "put recordings into runs/NAME"
        raise InputError(f"there is no run {name!r:.60}", where="Dataset.runs", todo=todo)


@dataclass(frozen=True, repr=False)
class Dataset(ShortText):
    """Hold what `load_dataset` found in a dataset folder.

    path : the folder.
    rig : the content of rig.toml.
    views : the calibration views in natural order of their names (2 before 10).
    runs : the runs by name.
    source : "images" or "dots", from which the views are read; None if views were not required and
        the folder has none, or both images and dots.
    notes : sentences that a user should read.
    table : the dots as `read_dots_csv` returns them; None for images.
    """

    path: Path
    rig: RigDescription
    views: tuple[View, ...]
    runs: Mapping[str, Run]
    source: Source | None
    notes: list[str] = field(default_factory=list)
    table: pd.DataFrame | None = field(default=None, repr=False, compare=False)

    def title(self) -> str:
        """Return the name of the rig and the folder."""
        return f"Dataset {self.rig.name!r} in {self.path}"

    def facts(self) -> dict[str, str]:
        """Return the cameras, the target, the views and the runs, in words."""
        cameras = (
            f"{c.name} {c.image_size_px[0]} x {c.image_size_px[1]} px at {c.scale_px_per_mm:g} "
            "px/mm"
            for c in self.rig.cameras.values()
        )
        dots = f"{len(self.target.ids())} dots" if self.target.bounded else "an unbounded grid"
        views = counted(len(self.views), "view")
        return {
            "cameras": ", ".join(cameras),
            "target": dots,
            "views": views + (f", given as {self.source}" if self.source else ""),
            "runs": ", ".join(self.runs),
            "notes": first_of(self.notes),
        }

    @property
    def target(self) -> Target:
        """Return the calibration target that rig.toml describes."""
        return self.rig.target

    @property
    def results(self) -> Path:
        """Return the folder into which commands write, unless --out names another one."""
        return self.path / "results"

    def dots(self) -> pd.DataFrame:
        """Return a copy of the table that `read_dots_csv` made of `calibration/dots.csv`.

        Raises InputError for a dataset of images, whose dots must be detected first.
        """
        if self.table is None:
            raise InputError(
                "the views are images, no dots.csv was read",
                where=str(self.path),
                todo="detect the dots first (telerig detect)",
            )
        return self.table.copy()

    def image(self, view: View, camera: str | int) -> Image:
        """Read the image of a view from one camera, given by name or index.

        Returns pixels (height, width) of uint8, uint16 or float32, with the size that `rig.toml`
        states. Raises InputError when there is no such image, or when it cannot be used.
        """
        name = self.rig.camera_name(camera)
        if name not in view.image_paths:
            raise InputError(
                f"camera {name} has no image of view {view.name}",
                where=str(self.path / "calibration" / name),
                todo="add the image, or ask only for cameras in view.image_paths, which holds the "
                "image files of the view by camera",
            )
        size = self.rig.cameras[name].image_size_px
        return read_image(view.image_paths[name], expected_size_px=size)

    @cached_property
    def truth(self) -> dict[str, Any] | None:
        """The content of the simulator's `truth/truth.json`; None in a real dataset.

        The truth is for comparison with results only; no estimator may use it.
        """
        file = self.path / "truth" / "truth.json"
        if not file.is_file():
            return None
        return dict(read_object(file, "simulate the dataset again"))


def load_dataset(
    path: str | PathLike[str],
    source: Source | None = None,
    *,
    need_views: bool = True,
) -> Dataset:
    """Open a dataset: read its rig.toml and dots.csv, and list its views and runs.

    No image is decoded.

    source : "images" or "dots", from which the views are read; None takes the only one that there
    is. It has to be given if `calibration/` holds both.
    need_views : whether the dataset must have views of the target. False is for runs that are
    evaluated with a calibration from elsewhere.
    Returns a `Dataset`. Raises InputError if the folder is not a dataset or if two views have equal
    names, and NoViewsError if views are needed and there are none.
    """
    folder = _dataset_folder(Path(path))
    rig = read_rig_toml(folder / "rig.toml")
    found = [p for p in _entries(folder / "runs") if p.is_dir()]
    runs = Runs({p.name: Run(p.name, p) for p in found})
    chosen = _choose_source(folder, rig, source, need_views)
    notes: list[str] = []
    views: tuple[View, ...] = ()
    table = None
    if chosen == "images":
        views = image_views(folder / "calibration", rig, notes)
    elif chosen == "dots":
        table = read_dots_csv(folder / "calibration" / "dots.csv", rig)
        views = tuple(View(name) for name in sorted(set(table["view"]), key=natural))
        notes += assumed_noise(table, "dots.csv", DEFAULT_SIGMA_PX)
    else:
        notes.append("no calibration views were read")
    return Dataset(folder, rig, views, runs, chosen, notes, table)


def _dataset_folder(path: Path) -> Path:
    where = str(path)
    if not path.is_dir():
        otherwise = "check the path, or make one with `telerig init` or `telerig simulate`"
        raise absent(path, "dataset folder", otherwise)
    if not (path / "rig.toml").is_file():
        inner = [p.parent.name for p in sorted(path.glob("*/rig.toml"))]
        todo = f"the dataset may be {path / inner[0]}; if not, " if inner else ""
        raise InputError(
            "has no rig.toml, so it is not a dataset",
            where=where,
            todo=todo + "write one with `telerig init`",
        )
    return path


def _entries(folder: Path) -> list[Path]:
    """List a folder's entries in natural order, without hidden ones; none if it does not exist."""
    if not folder.is_dir():
        return []
    found = (p for p in folder.iterdir() if not p.name.startswith("."))
    return sorted(found, key=lambda p: natural(p.name))


def _choose_source(
    folder: Path, rig: RigDescription, source: str | None, need_views: bool
) -> Source | None:
    calibration = folder / "calibration"
    has: dict[Source, bool] = {
        "images": any(list_images(p) for p in _entries(calibration) if p.is_dir()),
        "dots": (calibration / "dots.csv").is_file(),
    }
    if not need_views and source is None and all(has.values()):
        return None
    chosen = choose_source(has, source, calibration)
    if chosen is None and (need_views or source is not None):
        raise _no_views(folder, rig, [s for s in has if source in (None, s)])
    return chosen


class NoViewsError(InputError):
    """Report that a dataset has no calibration views yet."""


def _no_views(folder: Path, rig: RigDescription, wanted: list[Source]) -> NoViewsError:
    calibration = folder / "calibration"
    kind = {"images": "images in calibration/<camera>/", "dots": "calibration/dots.csv"}
    what = f"there are no views: no {' and no '.join(kind[s] for s in wanted)}"
    todo = _LAYOUT
    if not calibration.is_dir():
        others = [p.name for p in _entries(folder) if p.is_dir() and p.name not in _FOLDERS]
        near = [name for name in others if nearest(name, _FOLDERS) == "calibration"]
        todo = f"rename {near[0]} to calibration" if near else todo
    elif list_images(calibration):
        todo = f"move the images in calibration/ into calibration/{rig.first}/"
    return NoViewsError(what, where=str(folder), todo=todo)


def image_views(
    folder: Path, rig: RigDescription, notes: list[str], tables: Container[str] = ("dots.csv",)
) -> tuple[View, ...]:
    """Return the views with images in ``folder``/<camera>/; append to ``notes``.

    tables : names of the files that may lie beside the cameras' folders.
    Raises InputError for the folder of another camera, and for two files of one view.
    """
    by_view: dict[str, dict[str, Path]] = {}
    for entry in _entries(folder):
        if not entry.is_dir():
            if entry.name not in tables:
                notes.append(
                    f"{folder.name}/{entry.name} is not used, because it is in no camera's folder "
                    f"{folder.name}/<camera>/"
                )
        elif entry.name not in rig.cameras:
            raise InputError(
                f"there is no camera {entry.name!r} in rig.toml",
                where=str(entry),
                todo=suggestion(entry.name, list(rig.cameras)),
            )
        else:
            for stem, file in _files_by_view(entry, notes).items():
                by_view.setdefault(stem, {})[entry.name] = file
    _check_case(by_view, folder)
    return tuple(
        View(name, {c: by_view[name][c] for c in rig.cameras if c in by_view[name]})
        for name in sorted(by_view, key=natural)
    )


def _files_by_view(folder: Path, notes: list[str]) -> dict[str, Path]:
    """Return a camera's image files by view name (without extension); append to ``notes``.

    Raises InputError for two files of one view.
    """
    images = list_images(folder)
    unused = [p.name for p in _entries(folder) if p not in images]
    if unused:
        notes.append(
            f"{folder.parent.name}/{folder.name}: not used, as they are no images "
            f"({' '.join(EXTENSIONS)}): {', '.join(unused)}"
        )
    stems = by_stem(images, "view")
    for name in stems:
        check_name(name, str(folder), "view")
    return stems


def _check_case(by_view: dict[str, dict[str, Path]], calibration: Path) -> None:
    """Raise InputError when two views differ only in case, which file systems may ignore."""
    spelled: dict[str, str] = {}
    for view in by_view:
        other = spelled.setdefault(view.casefold(), view)
        if other != view:
            files = [next(iter(by_view[name].values())) for name in (other, view)]
            names = " and ".join(f.relative_to(calibration).as_posix() for f in files)
            raise InputError(
                f"{names} differ only in upper and lower case",
                where=str(calibration),
                todo="write a view's name in the same way for all cameras, or rename one of the "
                "files",
            )
