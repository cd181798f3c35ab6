"""Follows the marks of a strip, which is fixed to the tank, through the images of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array, Ints
from telerig.estimator.marks.following import Follower, Mark, StripInImages, TankView
from telerig.estimator.marks.strip_dots import DotLook, DotSightings, find_dots, learn_look
from telerig.estimator.tracking.detect_run import Batch, DetectionStore, Progress, read_batch
from telerig.io.dataset.run import RunData
from telerig.io.machine.parallel import ordered_map, quick_workers
from telerig.io.rig_file.description import ReferencesDescription
from telerig.rig.camera import Camera

Looks = Mapping[str, DotLook]

SAMPLE_FRAMES = 12
"""Frames of a camera from which the dots' looks and the strip's place are learnt."""

CAMERA_NUMBERS = 1000
"""Marks of the second camera are numbered from here on, or from the next multiple."""

DOT_COLUMNS = ["frame", "camera", "u_px", "v_px", "sigma_px"]
REFERENCE_COLUMNS = ["frame", "camera", "mark", "u_px", "v_px", "sigma_px"]

_MOVED_DIAMETERS = 2.0


@dataclass(frozen=True)
class FollowedMarks:
    """Hold the marks of a strip that were followed through the images.

    table : table with the columns `REFERENCE_COLUMNS`; None if no mark was found.
    strips : the strip as seen by each camera that sees marks, by name.
    summary : the part "references" of tracking.json.
    """

    table: pd.DataFrame | None
    strips: Mapping[str, StripInImages]
    summary: Mapping[str, Any] = field(default_factory=dict)


def follow_references(
    run: RunData,
    cameras: Sequence[Camera],
    axis_rig: Array,
    strip: ReferencesDescription,
    store: DetectionStore,
    progress: Progress | None = None,
    executor: Executor | None = None,
) -> FollowedMarks:
    """Follow the dots of a strip through the images of a run.

    strip : as rig.toml describes it.
    axis_rig : (3,) unit vector of the stage's travel in the rig frame.
    store : files of dots; those found before are read, the others are computed and written.
    executor : see `DetectionStore.fill`.
    progress : as for `make_scene`.

    Raises GeometryError for a camera that looks along the travel.
    """
    views = {c.name: TankView.of(c, axis_rig) for c in cameras}
    names = list(views)
    learnt = ordered_map(partial(_look, run, views, strip), names, quick_workers(len(names)))
    looks = {name: look for name, look in zip(names, learnt) if look is not None}
    held = held_positions(run.position_mm, run.frame_count)
    followers = {
        name: Follower(
            views[name],
            diameter_mm=strip.dot_diameter_mm,
            margin_px=look.margin_px,
            frame_count=run.frame_count,
            held_mm=float(held[0]),
        )
        for name, look in looks.items()
    }
    if looks:
        store.fill("dots", partial(_find_dots, run, looks), progress, "references", executor)
    sightings = _sightings(run, followers, store)
    kept = {name: f.kept(moved=moved_far(f, held)) for name, f in followers.items()}
    mark = _mark_numbers(sightings, kept)
    strips = {
        name: StripInImages.of(followers[name], looks[name], marks, held)
        for name, marks in kept.items()
        if marks
    }
    summary = {
        c.name: _summary(followers.get(c.name), kept.get(c.name, []), sightings.assign(mark=mark))
        for c in cameras
    }
    table = sightings.assign(mark=mark)[mark >= 0].reset_index(drop=True) if strips else None
    return FollowedMarks(table, strips, {"cameras": summary, "words": _words(summary, run)})


def _look(
    run: RunData, views: Mapping[str, TankView], strip: ReferencesDescription, name: str
) -> DotLook | None:
    view = views[name]
    count = min(SAMPLE_FRAMES, run.frame_count)
    frames = np.unique(np.linspace(0, run.frame_count - 1, count).astype(int))
    images = (run.image(name, int(frame)) for frame in frames)
    return learn_look(
        (image for image in images if image is not None),
        view.travel_px_per_mm,
        polarity=strip.polarity,
        diameter_px=strip.dot_diameter_mm * view.px_per_mm,
    )


def _find_dots(run: RunData, looks: Looks, batch: Batch) -> pd.DataFrame:
    """Return every dot in the images of some frames, `DOT_COLUMNS`."""
    rows: list[tuple[Any, ...]] = []
    for frame in range(*batch):
        for name, look in looks.items():
            image = run.image(name, frame)
            if image is not None:
                dots = find_dots(image, look)
                rows += [(frame, name, *uv, s) for uv, s in zip(dots.uv_px, dots.sigma_px)]
    return pd.DataFrame(rows, columns=DOT_COLUMNS)


def _sightings(
    run: RunData, followers: Mapping[str, Follower], store: DetectionStore
) -> pd.DataFrame:
    """Return every dot that a camera's follower gives a number, `REFERENCE_COLUMNS`."""
    parts = [pd.DataFrame(columns=REFERENCE_COLUMNS)]
    for batch in store.batches if followers else ():
        dots = read_batch(store.path(batch, "dots"))
        found = dict(iter(dots.groupby(["frame", "camera"])))
        for frame in range(*batch):
            position = None if run.position_mm is None else float(run.position_mm[frame])
            for name, follower in followers.items():
                mine = found.get((frame, name), dots.iloc[:0])
                uv, sigma = mine[["u_px", "v_px"]].to_numpy(float), mine["sigma_px"]
                marks = follower.add(frame, DotSightings(uv, sigma.to_numpy(float)), position)
                if marks:
                    rows, numbers = zip(*marks)
                    parts.append(mine.iloc[list(rows)].assign(mark=numbers))
    joined = pd.concat(parts[1:] or parts, ignore_index=True)
    return joined[REFERENCE_COLUMNS]


def held_positions(position_mm: Array | None, frame_count: int) -> Array:
    """Return the stage's positions (F,) in mm; a missing one is replaced by the last known one, or
    before all by the first. Without any they are 0.

    position_mm : (F,), NaN where unknown.
    """
    if position_mm is None or not np.isfinite(position_mm).any():
        return np.zeros(frame_count)
    known = np.flatnonzero(np.isfinite(position_mm))
    last = np.searchsorted(known, np.arange(frame_count), side="right") - 1
    return np.asarray(position_mm[known[np.maximum(last, 0)]])


def moved_far(follower: Follower, held_mm: Array) -> bool:
    """Whether the tank moved through the image far enough to tell its marks from dirt."""
    along = follower.view.basis @ follower.view.axis_rig
    places = held_mm[:, None] * along - np.nan_to_num(follower.shift_mm)
    far = float(np.linalg.norm(np.ptp(places, axis=0)))
    return far > _MOVED_DIAMETERS * follower.diameter_mm


def _mark_numbers(sightings: pd.DataFrame, kept: Mapping[str, list[Mark]]) -> Ints:
    """Return the mark's number (N,) for each of N sightings, -1 for dots that are no marks.

    Marks are numbered from 0 for the first camera and from 1000 for the second.
    """
    numbers: dict[tuple[str, int], int] = {}
    base = 0
    for name, marks in kept.items():
        ordered = sorted(m.number for m in marks)
        numbers |= {(name, number): base + i for i, number in enumerate(ordered)}
        base += CAMERA_NUMBERS * (1 + max(0, len(marks) - 1) // CAMERA_NUMBERS)
    keys = zip(sightings["camera"], sightings["mark"])
    return np.array([numbers.get(key, -1) for key in keys], np.int64)


def _summary(
    follower: Follower | None, kept: list[Mark], sightings: pd.DataFrame
) -> dict[str, Any]:
    if follower is None:
        return {"marks": 0, "sightings": 0, "dots_that_are_no_marks": 0, "breaks": []}
    mine = sightings[sightings["camera"] == follower.view.camera.name]
    sigma = mine.loc[mine["mark"] >= 0, "sigma_px"]
    left: dict[str, int] = {}
    for mark in kept:
        for reason, count in mark.left_out.items():
            left[reason] = left.get(reason, 0) + count
    return {
        "marks": len(kept),
        "sightings": len(sigma),
        "median_sigma_px": float(np.median(sigma)) if len(sigma) else None,
        "left_out": left,
        "dots_that_are_no_marks": len(mine) - len(sigma),
        "breaks": [{"frame": f, "reason": reason} for f, reason in follower.breaks],
    }


def _words(summary: Mapping[str, Mapping[str, Any]], run: RunData) -> list[str]:
    out = []
    for name, found in summary.items():
        if not found["marks"]:
            out.append(
                f"camera {name}: rig.toml describes a strip of dots ([references]), but none is "
                "seen in the images. Check its dot_diameter_mm and polarity, or remove [references]"
            )
            continue
        out.append(
            f"camera {name}: {found['marks']} marks of the strip of dots, {found['sightings']} "
            "measurements in all; standard deviation of one measurement "
            f"{found['median_sigma_px']:.3f} px (median)"
        )
        out += [f"  left out {n} times: {reason}" for reason, n in found["left_out"].items()]
        breaks = found["breaks"]
        if breaks:
            out.append(
                f"  following began anew {len(breaks)} times, first at frame {breaks[0]['frame']}: "
                f"{breaks[0]['reason']}. The marks have new numbers from there on"
            )
    if run.position_mm is None and any(found["marks"] for found in summary.values()):
        out.append(
            "The run has no stage.csv. The strip is therefore assumed to move less than half its "
            "dots' spacing from the first frame to the second, if its spacing is even"
        )
    return out
