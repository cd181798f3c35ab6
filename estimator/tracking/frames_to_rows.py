"""Detections to tracks, frame by frame: groups across the views, ids in time, points in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array, Ints
from telerig.estimator.bubbles.outline.ellipse_geometry import flag_words
from telerig.estimator.bubbles.pairing.evidence import Prediction
from telerig.estimator.bubbles.pairing.groups import (
    Candidates,
    Groups,
    View,
    candidates,
    match,
    views_of,
)
from telerig.estimator.bubbles.pairing.model import RigModel
from telerig.estimator.bubbles.shape.body import Bodies, body_columns, fit_bodies
from telerig.estimator.bubbles.shape.shapes import Shapes
from telerig.estimator.bubbles.shape.sightings import Sightings, sightings_from_table
from telerig.estimator.tracking.backtracking import (
    CENTRE_PX,
    COVARIANCE_MM2,
    FRAMES_AFTER,
    FRAMES_BEFORE,
    Bubbles,
    Frame,
    Sight,
    SmoothedTracks,
    Tables,
    follow_back,
    fused,
    shared_rows,
)
from telerig.estimator.tracking.filter import (
    NO_PARTICLE,
    FrameMeasurements,
    FrameResult,
    TrackEvent,
)
from telerig.estimator.tracking.tracker import Tracker
from telerig.rig.camera import Camera

_BUBBLES_AT_ONCE = 512
"""Bubbles whose bodies are fitted and whose rows are written together."""

_LIKELY = 0.1
"""Probability without tracks of groups whose bodies are fitted beforehand, together."""

_LEAST_FOR_OFFSET = 3
"""Bubbles that tell the shift of all pixels of a frame by a median."""

WANDER = (21 / 8) ** 0.5
"""Shift of an outline's centre, as a share of the radius, by a body's third harmonics of unit
standard deviation (unit mean square over the sphere; their k = 1 part along a great circle)."""


@dataclass(frozen=True)
class Linked:
    """Hold final rows of tracks.csv and detections.csv."""

    tracks: pd.DataFrame
    detections: pd.DataFrame


@dataclass
class RowMaker:
    """Turns frames of detections into finished rows; holds the frames still open, and a few."""

    model: RigModel
    tracker: Tracker
    shapes: Shapes
    up: Array
    events: list[TrackEvent] = field(default_factory=list)
    _open: dict[int, Frame] = field(default_factory=dict)
    _closed: list[Frame] = field(default_factory=list)
    _before: list[Frame] = field(default_factory=list)
    _waiting: int = 0

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Return the run's cameras."""
        return self.model.cameras

    def sights(self, frames: Sequence[Tables]) -> list[Sight]:
        """Return the detections of several frames as arrays; all frames at once are quicker."""
        counts = np.array([[len(table) for table in tables] for tables in frames], np.int64)
        joined = [pd.concat(tables, ignore_index=True) for tables in zip(*frames)]
        views = views_of(joined, self.model, WANDER * self.shapes.third)
        ids, of_cameras = [_given_ids(table) for table in joined], []
        for c, (table, view) in enumerate(zip(joined, views)):
            a, d_eq = (table[name].to_numpy(float) for name in ("a_px", "d_eq_px"))
            flags = ["|".join(words) for words in flag_words(table)]
            noise = view.covariance_px2[:, *np.triu_indices(2)]
            centre = np.column_stack([view.uv_px, noise])
            ends = np.cumsum([0, *counts[:, c]]).tolist()
            of_cameras.append(
                [
                    (centre[p], a[p], d_eq[p], ids[c][p], flags[p])
                    for p in (slice(low, high) for low, high in pairwise(ends))
                ]
            )
        possible = self._possible(views, ids, joined, counts)
        every: list[tuple[Any, ...]] = [
            (*zip(*own), *groups) for *own, groups in zip(*of_cameras, possible)
        ]
        return [Sight(*columns) for columns in every]

    def _possible(
        self,
        views: Sequence[View],
        ids: Sequence[Ints],
        tables: Sequence[pd.DataFrame],
        counts: Ints,
    ) -> list[tuple[Candidates, Bubbles, Array]]:
        """Return the last three fields of `Sight` for each of F frames.

        counts : (F, C) detections of the frames, which follow each other in the other arguments.
        """
        barred = [own != NO_PARTICLE for own in ids]
        found = candidates(views, counts, self.model, barred)
        frames = [np.repeat(np.arange(len(counts)), many) for many in counts.T]
        named, of_named = _named(ids, frames)
        at = Groups.concat([Groups.of(self.model, views, named), *(f.groups for f in found)])
        starts = np.cumsum(counts, axis=0) - counts
        rows = [np.where(named >= 0, named - starts[of_named], -1)]
        rows += [one.groups.rows for one in found]
        every = np.concatenate(rows)
        frame = np.concatenate([of_named, np.repeat(np.arange(len(found)), [*map(len, found)])])
        given = np.max([_at(i, r) for i, r in zip(ids, named.T)], axis=0, initial=NO_PARTICLE)
        bubbles = Bubbles(
            every,
            np.ones(len(every)),
            np.zeros(len(every), bool),
            np.concatenate([given, np.full(len(every) - len(named), NO_PARTICLE)]),
            at.points_mm,
            at.covariance_mm2,
            Bodies.none(len(every), len(self.cameras)),
            np.full(len(every), NO_PARTICLE),
        )
        likely = [np.arange(len(named))]
        first = len(named) + np.cumsum([0, *map(len, found)])
        likely += [np.flatnonzero(f.probability > _LIKELY) + s for f, s in zip(found, first)]
        self._fit(bubbles, np.concatenate(likely), tables, starts[frame])
        order = np.argsort(frame, kind="stable")
        cuts = [
            order[slice(*ends)]
            for ends in pairwise(np.searchsorted(frame[order], range(len(counts) + 1)))
        ]
        return [(one, bubbles.take(cut), at.left_px[cut]) for one, cut in zip(found, cuts)]

    def add(
        self,
        number: int,
        t_s: float,
        position_mm: float | None,
        tables: Tables,
        sight: Sight | None = None,
    ) -> Linked | None:
        """Take in one frame; return final rows when there are enough of them, otherwise None.

        number, t_s : number and time of the frame.
        position_mm : encoder position of the stage; None without one.
        tables : the detections of each camera.
        sight : the same as arrays, if known.
        """
        predicted = self.tracker.predict(t_s, position_mm)
        sight = self.sights([tables])[0] if sight is None else sight
        bubbles, rays, offset_px = grouped_frame(sight, self.model, predicted)
        late = np.flatnonzero((bubbles.bodies.used == "none") & ~bubbles.alone)
        self._fit(bubbles, late, tables, np.zeros_like(bubbles.rows))
        measured = FrameMeasurements.create(
            bubbles.points_mm, bubbles.covariance_mm2, d_eq_mm=bubbles.d_eq_mm,
            confidence=bubbles.confidence, particle=bubbles.given, alone=bubbles.alone,
        )  # fmt: skip
        result = self.tracker.update(number, t_s, measured, position_mm)
        self._open[number] = Frame(
            number, t_s, tables, sight, offset_px, rays, bubbles, result.motion
        )
        self._take_final(result)
        enough = self._waiting >= _BUBBLES_AT_ONCE and len(self._closed) > 2 * FRAMES_AFTER
        return self._flush(FRAMES_AFTER) if enough else None

    def finish(self) -> Linked | None:
        """Return the remaining rows at the end of the run; None if there are none."""
        result = self.tracker.finish()
        if result is not None:
            self._take_final(result)
        return self._flush(0) if self._closed else None

    def _take_final(self, result: FrameResult) -> None:
        self.events.extend(result.events)
        for ids in result.final:
            frame = self._open.pop(ids.frame)
            frame.bubbles.particle[:] = ids.particle
            self._closed.append(frame)
            self._waiting += 1 + len(frame.bubbles)

    def _flush(self, ahead: int) -> Linked:
        """Return rows of closed frames but the last few, which hidden bubbles may need."""
        done = self._closed[: len(self._closed) - ahead]
        self._closed, self._waiting = self._closed[len(done) :], 0
        window = [*self._before, *done, *self._closed]
        tracks = SmoothedTracks(window, self.cameras, self.tracker.settings)
        follow_back(tracks, {f.number for f in (*done, *self._closed)})
        hidden = shared_rows(tracks, slice(len(self._before), len(self._before) + len(done)))
        self._before = [*self._before, *done][-FRAMES_BEFORE:]
        joined = [pd.concat(own, ignore_index=True) for own in zip(*(f.tables for f in done))]
        found = self._tracks(done, joined)
        if hidden:
            found = pd.concat(
                [found, pd.DataFrame(hidden, columns=found.columns)], ignore_index=True
            )
            found = found.sort_values(["frame", "particle"], kind="stable", ignore_index=True)
        return Linked(found, _detections(done, joined))

    def _fit(
        self, bubbles: Bubbles, some: Ints, tables: Sequence[pd.DataFrame], starts: Ints
    ) -> None:
        """Fit the bodies of some bubbles to their detections.

        starts : (M, C) rows in the tables at which the frames of the M bubbles begin.
        """
        if not len(some):
            return
        rows = bubbles.rows[some]
        at = np.where(rows >= 0, rows + starts[some], -1)
        sightings = [sightings_from_table(t.take(mine[mine >= 0]), c, self.cameras)
                     for c, (t, mine) in enumerate(zip(tables, at.T))]  # fmt: skip
        order = np.full(at.T.shape, -1)
        order[at.T >= 0] = np.arange(np.sum(at >= 0))
        gap_px = np.hypot(self.model.mean("frame_px"), self.model.mean("gap_rms_px"))
        bodies = fit_bodies(
            Sightings.concat(sightings), order.T, self.cameras, self.up, self.shapes,
            gap_sigma_px=float(gap_px),
        )  # fmt: skip
        bubbles.bodies.put(some, bodies)

    def _tracks(self, frames: Sequence[Frame], joined: Sequence[pd.DataFrame]) -> pd.DataFrame:
        every = [f.bubbles.take(~f.bubbles.alone) for f in frames]
        bubbles, many = Bubbles.concat(every), [*map(len, every)]
        starts = np.repeat(_starts(frames), many, 0)
        bodies = bubbles.bodies
        self._fit(bubbles, np.flatnonzero(bodies.used == "none"), joined, starts)
        seen = bubbles.rows >= 0
        table: dict[str, Any] = {
            "frame": np.repeat([f.number for f in frames], many),
            "particle": bubbles.particle,
            "t_s": np.repeat([f.t_s for f in frames], many),
        }
        table |= dict(zip(["x_mm", "y_mm", "z_mm"], bodies.points_mm.T))
        table |= dict(zip(COVARIANCE_MM2, bodies.covariance_mm2[:, *np.triu_indices(3)].T))
        words: list[set[str]] = [{"ambiguous"} if unsure else set() for unsure in bubbles.ambiguous]
        for c, (camera, found) in enumerate(zip(self.cameras, joined)):
            mine = np.flatnonzero(seen[:, c])
            rows = found.take(bubbles.rows[mine, c] + starts[mine, c])
            values = np.full((len(bubbles), 5), np.nan)
            values[mine] = rows[CENTRE_PX].to_numpy(float)
            values[:, 2:] += bodies.shift_covariance_px2[:, c][:, *np.triu_indices(2)]
            table |= {f"{camera.name}_{name}": v for name, v in zip(CENTRE_PX, values.T)}
            for k, name in enumerate(("du_px", "dv_px")):
                shift = np.where(seen[:, c], bodies.shift_px[:, c, k], np.nan)
                table[f"{camera.name}_{name}"] = shift
            for k, flags in zip(mine.tolist(), flag_words(rows)):
                words[k].update(flags)
        table["ray_miss_mm"] = bodies.ray_miss_mm
        table |= body_columns(bodies, self.up)
        table["confidence"] = bubbles.confidence
        table["centre"] = bodies.used
        table |= dict(zip((f"silhouettes_{x}_mm" for x in "xyz"), bodies.silhouette_points_mm.T))
        texts = ["|".join(sorted(own)) for own in words]
        table["flags"] = pd.Series(texts, dtype=str)  # text also where there is no bubble
        rows_of = pd.DataFrame(table)
        return rows_of[rows_of["particle"] != NO_PARTICLE].reset_index(drop=True)


def _named(ids: Sequence[Ints], frames: Sequence[Ints]) -> tuple[Ints, Ints]:
    """Return the groups (M, C) of rows with one given id in one frame, and their frames (M,)."""
    own = [np.flatnonzero(i != NO_PARTICLE) for i in ids]
    tall = max((int(f.max(initial=0)) for f in frames), default=0) + 1
    keys = [i[mine] * tall + f[mine] for i, f, mine in zip(ids, frames, own)]
    every, many = np.unique(np.concatenate(keys), return_counts=True)
    every = every[many > 1]
    rows = np.full((len(every), len(ids)), -1)
    for c, (key, mine) in enumerate(zip(keys, own)):
        _, group, one = np.intersect1d(every, key, return_indices=True)
        rows[group, c] = mine[one]
    frame = every % tall
    order = np.argsort(frame, kind="stable")
    return rows[order], frame[order]


def _at(values: Ints, rows: Ints) -> Ints:
    """Return values at rows, -1 where the row is -1."""
    return np.append(values, -1)[rows]


def _given_ids(table: pd.DataFrame) -> Ints:
    """Return the ids (N,) that came with N detections, -1 for none."""
    if "particle" not in table:
        return np.full(len(table), NO_PARTICLE)
    return table["particle"].to_numpy(np.int64)


def _starts(frames: Sequence[Frame]) -> Ints:
    """Return the position (F, C) of each frame's first detection in the cameras' tables."""
    many = np.array([[len(table) for table in f.tables] for f in frames], np.int64)
    return np.asarray(np.cumsum(many, axis=0) - many)


def grouped_frame(
    sight: Sight, model: RigModel, predicted: Prediction | None
) -> tuple[Bubbles, Bubbles, Array]:
    """Return the bubbles of a frame, each detection by itself, and the shift of each camera's
    pixels.

    Detections with given ids are joined by their ids; all others are matched, and what has no
    partner is a bubble that one camera alone sees.

    sight : detections of all cameras.
    model : the model for matching.
    predicted : expected positions of the tracks; None if there are none.

    The shift is (C, 2) in px: for each camera the median of measured minus projected pixels over
    the bubbles that all cameras see; 0 if there are fewer than three. It is taken off what fewer
    cameras see, so that their points agree with those of the others.
    """
    found = match(sight.candidates, model, predicted)
    given = np.arange(len(sight.possible) - len(sight.candidates))
    chosen = np.concatenate([given, len(given) + found.candidate])
    bubbles = sight.possible.take(chosen)
    bubbles.confidence[len(given) :] = found.confidence
    bubbles.ambiguous[len(given) :] = found.ambiguous
    part = (bubbles.rows < 0).any(1)
    offset = np.zeros((len(model.cameras), 2))
    if np.sum(~part) >= _LEAST_FOR_OFFSET:
        offset = np.median(sight.left_px[chosen][~part], axis=0)
    rays = Bubbles.on_rays(sight, offset)
    at = np.where(bubbles.rows >= 0, bubbles.rows + sight.starts, -1)
    for k in np.flatnonzero(part) if offset.any() else ():
        own = rays.take(at[k, at[k] >= 0])
        bubbles.points_mm[k] = fused(own.points_mm, own.covariance_mm2)[0]
    single = rays.given == NO_PARTICLE
    single[at[at >= 0]] = False
    return Bubbles.concat([bubbles, rays.take(single)]), rays, offset


def _detections(frames: Sequence[Frame], joined: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return every detection with the id of its track, blank where it has none."""
    particle = np.concatenate([frame.owners() for frame in frames])
    order = [len(joined) * k + c for c in range(len(joined)) for k, f in enumerate(frames)
             for _ in f.sight.given[c]]  # fmt: skip
    every = pd.concat(joined, ignore_index=True).take(np.argsort(order, kind="stable"))
    every = every.reset_index(drop=True)
    every["particle"] = pd.arrays.IntegerArray(particle, particle == NO_PARTICLE)
    leading = ["frame", "camera", "particle"]
    every = every[leading + [name for name in every if name not in leading]]
    return every
