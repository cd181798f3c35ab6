"""The strip of dots that rig.toml's [references] tells of, found and followed through a run."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.marks.erasing import StripInImages
from telerig.estimator.marks.following import Follower, Mark
from telerig.estimator.marks.strip_dots import (
    DotLook,
    DotSightings,
    find_dots,
    learn_look,
)
from telerig.estimator.marks.tank_view import TankView
from telerig.io.files.atomic import atomic_path
from telerig.io.machine.parallel import cores, ordered_map, quick_workers
from telerig.rig.camera import Camera

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.tracking.detection import DetectionStore, Progress
    from telerig.io.dataset.run import RunData
    from telerig.io.rig_file.description import ReferencesDescription

Array = NDArray[np.float64]
Looks = Mapping[str, DotLook]

SAMPLE_FRAMES = 12
"""Frames of a camera from which the dots' looks and the strip's place are learnt."""

CAMERA_NUMBERS = 1000
"""Marks of the second camera are numbered from here on, or from the next multiple."""

REFERENCE_COLUMNS = ("frame", "camera", "mark", "u_px", "v_px", "sigma_px")

_FRAMES_FOR_WORKERS = 40
_MOVED_DIAMETERS = 2.0


@dataclass(frozen=True)
class Followed:
    """What became of the strip in a run.

    table : a file of REFERENCE_COLUMNS, None without a mark. strips : by camera that sees one.
    summary : the part "references" of tracking.json.
    """

    table: Path | None
    strips: Mapping[str, StripInImages]
    summary: Mapping[str, Any] = field(default_factory=dict)

    def rows(self) -> pd.DataFrame | None:
        """The table, read."""
        import pandas as pd

        return None if self.table is None else pd.read_csv(self.table, dtype={"camera": str})


def wanted(run: RunData) -> ReferencesDescription | None:
    """The strip to be looked for: not where the run brings its own references.csv, or no images."""
    told = run.rig.references if run.rig is not None else None
    return told if run.source == "images" and run.references is None else None


def follow_references(
    run: RunData,
    cameras: Sequence[Camera],
    axis_rig: Array,
    store: DetectionStore,
    progress: Progress | None = None,
) -> Followed | None:
    """None where rig.toml tells of no strip. Dots already found are taken from the store's folder.

    Raises GeometryError for a camera that looks along the travel.
    """
    told = wanted(run)
    if told is None:
        return None
    views = {c.name: TankView.of(c, axis_rig) for c in cameras}
    looks = _looks(run, views, told)
    followers = {
        name: Follower(
            views[name],
            diameter_mm=told.dot_diameter_mm,
            margin_px=look.margin_px,
            frame_count=run.frame_count,
        )
        for name, look in looks.items()
    }
    folder = store.folder
    if looks:
        _find(run, looks, store.batches, folder, progress)
        _follow(run, followers, store.batches, folder)
    held = _held_positions(run)
    kept = {name: f.kept(moved=_moved(f, held)) for name, f in followers.items()}
    names = _numbers(kept)
    table = _write_table(folder, names) if any(kept.values()) else None
    strips = {
        name: StripInImages.of(followers[name], looks[name], marks, held)
        for name, marks in kept.items()
        if marks
    }
    summary = {
        c.name: _summary(followers.get(c.name), kept.get(c.name, []), folder, names)
        for c in cameras
    }
    return Followed(table, strips, {"cameras": summary, "words": _words(summary, run)})


def _looks(
    run: RunData, views: Mapping[str, TankView], told: ReferencesDescription
) -> dict[str, DotLook]:
    names = list(views)
    learn = partial(_look, run, views, told)
    found = ordered_map(learn, names, quick_workers(len(names)))
    return {name: look for name, look in zip(names, found) if look is not None}


def _look(
    run: RunData, views: Mapping[str, TankView], told: ReferencesDescription, name: str
) -> DotLook | None:
    view = views[name]
    count = min(SAMPLE_FRAMES, run.frame_count)
    frames = np.unique(np.linspace(0, run.frame_count - 1, count).astype(int))
    pictures = (run.image(name, int(frame)) for frame in frames)
    return learn_look(
        (p for p in pictures if p is not None),
        view.travel_px_per_mm,
        polarity=told.polarity,
        diameter_px=told.dot_diameter_mm * view.px_per_mm,
    )


def _dots_file(folder: Path, batch: tuple[int, int]) -> Path:
    return folder / f"dots-{batch[0]:07d}.csv"


def _find(
    run: RunData,
    looks: Looks,
    batches: Sequence[tuple[int, int]],
    folder: Path,
    progress: Progress | None,
) -> None:
    missing = [b for b in batches if not _dots_file(folder, b).is_file()]
    frames = sum(last - first for first, last in missing)
    large = frames >= _FRAMES_FOR_WORKERS
    workers = min(cores(), len(missing)) if large else quick_workers(len(missing))
    done = run.frame_count - frames
    for first, last in ordered_map(partial(_find_batch, run, looks, folder), missing, workers):
        done += last - first
        if progress is not None:
            progress("references", done, run.frame_count)


def _find_batch(
    run: RunData, looks: Looks, folder: Path, batch: tuple[int, int]
) -> tuple[int, int]:
    with atomic_path(_dots_file(folder, batch)) as path, path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        for frame in range(*batch):
            for name, look in looks.items():
                image = run.image(name, frame)
                if image is None:
                    continue
                dots = find_dots(image, look)
                for (u, v), sigma in zip(dots.uv_px.tolist(), dots.sigma_px.tolist()):
                    writer.writerow((frame, name, repr(u), repr(v), repr(sigma)))
    return batch


def _dots(file: Path) -> dict[tuple[int, str], DotSightings]:
    rows: dict[tuple[int, str], list[tuple[float, float, float]]] = {}
    with file.open(newline="") as stream:
        for frame, name, u, v, sigma in csv.reader(stream):
            rows.setdefault((int(frame), name), []).append((float(u), float(v), float(sigma)))
    arrays = {key: np.array(value) for key, value in rows.items()}
    return {key: DotSightings(a[:, :2], a[:, 2]) for key, a in arrays.items()}


def _follow(
    run: RunData,
    followers: Mapping[str, Follower],
    batches: Sequence[tuple[int, int]],
    folder: Path,
) -> None:
    """Every dot with the number that its camera's follower gives it, into sightings.csv."""
    nothing = DotSightings(np.zeros((0, 2)), np.zeros(0))
    with (folder / "sightings.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        for batch in batches:
            found = _dots(_dots_file(folder, batch))
            for frame in range(*batch):
                position = None if run.position_mm is None else float(run.position_mm[frame])
                for name, follower in followers.items():
                    dots = found.get((frame, name), nothing)
                    for i, mark in follower.add(frame, dots, position):
                        u, v = dots.uv_px[i].tolist()
                        row = (frame, name, mark, repr(u), repr(v), repr(float(dots.sigma_px[i])))
                        writer.writerow(row)


def _held_positions(run: RunData) -> Array:
    """(F,) the stage's positions, the last known one where there is none, else 0."""
    if run.position_mm is None:
        return np.zeros(run.frame_count)
    known = np.where(np.isfinite(run.position_mm), np.arange(run.frame_count), -1)
    last = np.maximum.accumulate(known)
    return np.where(last >= 0, run.position_mm[np.maximum(last, 0)], 0.0)


def _moved(follower: Follower, held_mm: Array) -> bool:
    """Whether the tank passed through the image at all, so that what stays behind is told from
    what comes along."""
    along = follower.view.basis @ follower.view.axis_rig
    places = held_mm[:, None] * along - np.nan_to_num(follower.shift_mm)
    far = float(np.linalg.norm(np.ptp(places, axis=0)))
    return far > _MOVED_DIAMETERS * follower.diameter_mm


def _numbers(kept: Mapping[str, list[Mark]]) -> dict[tuple[str, int], int]:
    """Camera and follower's number -> mark in the table: 0.. and 1000.., in order of appearance."""
    out: dict[tuple[str, int], int] = {}
    base = 0
    for name, marks in kept.items():
        ordered = sorted(marks, key=lambda m: m.number)
        out |= {(name, m.number): base + i for i, m in enumerate(ordered)}
        base += CAMERA_NUMBERS * (1 + max(0, len(marks) - 1) // CAMERA_NUMBERS)
    return out


def _sightings(folder: Path) -> Iterator[list[str]]:
    with (folder / "sightings.csv").open(newline="") as stream:
        yield from csv.reader(stream)


def _write_table(folder: Path, names: Mapping[tuple[str, int], int]) -> Path:
    path = folder / "references.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(REFERENCE_COLUMNS)
        for frame, name, mark, u, v, sigma in _sightings(folder):
            number = names.get((name, int(mark)))
            if number is not None:
                writer.writerow((frame, name, number, u, v, sigma))
    return path


def _summary(
    follower: Follower | None,
    kept: list[Mark],
    folder: Path,
    names: Mapping[tuple[str, int], int],
) -> dict[str, Any]:
    if follower is None:
        return {"marks": 0, "sightings": 0, "dots_that_are_no_marks": 0, "breaks": []}
    camera = follower.view.camera.name
    sigma, others = [], 0
    for _, name, mark, _, _, s in _sightings(folder):
        if name == camera:
            if (name, int(mark)) in names:
                sigma.append(float(s))
            else:
                others += 1
    left: dict[str, int] = {}
    for one in kept:
        for why, count in one.left_out.items():
            left[why] = left.get(why, 0) + count
    return {
        "marks": len(kept),
        "sightings": len(sigma),
        "median_sigma_px": float(np.median(sigma)) if sigma else None,
        "left_out": left,
        "dots_that_are_no_marks": others,
        "breaks": [{"frame": f, "reason": why} for f, why in follower.breaks],
    }


def _words(summary: Mapping[str, Mapping[str, Any]], run: RunData) -> list[str]:
    out = []
    for name, found in summary.items():
        if not found["marks"]:
            out.append(
                f"camera {name}: rig.toml tells of a strip of dots ([references]), but none is "
                "seen in the images: check its dot_diameter_mm and polarity, or leave it out"
            )
            continue
        out.append(
            f"camera {name}: {found['marks']} marks of the strip, measured {found['sightings']} "
            f"times, to {found['median_sigma_px']:.3f} px"
        )
        out += [f"  left out {n} times: {why}" for why, n in found["left_out"].items()]
        breaks = found["breaks"]
        if breaks:
            out.append(
                f"  followed anew {len(breaks)} times, first at frame {breaks[0]['frame']}: "
                f"{breaks[0]['reason']}; the marks have new numbers from there on"
            )
    if run.position_mm is None and any(found["marks"] for found in summary.values()):
        out.append(
            "without stage.csv the strip is taken to move less than half its dots' spacing from "
            "the first frame to the second, if its spacing is even"
        )
    return out
