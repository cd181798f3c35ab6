"""Detections to tracks, frame by frame: groups across the views, ids in time, points in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array, Ints
from telerig.estimator.bubbles.pairing.evidence import Prediction
from telerig.estimator.bubbles.pairing.groups import candidates, match, views_of
from telerig.estimator.bubbles.pairing.model import RigModel
from telerig.estimator.bubbles.shape.body import Bodies, body_columns, fit_bodies
from telerig.estimator.bubbles.shape.shapes import Shapes
from telerig.estimator.tracking.linking.backtracking import (
    FRAMES_AFTER,
    FRAMES_BEFORE,
    SmoothedTracks,
    follow_back,
    fused,
    place_hidden,
)
from telerig.estimator.tracking.linking.filter import FrameResult, TrackEvent
from telerig.estimator.tracking.linking.frames import (
    CENTRE_PX,
    NO_PARTICLE,
    Bubbles,
    Frame,
    Seen,
    Sight,
    Tables,
    moved,
    starts,
)
from telerig.estimator.tracking.linking.lifetimes import Lifetimes
from telerig.estimator.tracking.linking.tracker import Tracker
from telerig.rig.camera import Camera

COVARIANCE_MM2 = ["sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2"]

_HIDDEN_FLAG = "shared"
"""Flag of a bubble that one image hides behind another one."""

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
    _lifetimes: Lifetimes = field(default_factory=Lifetimes)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Return the run's cameras."""
        return self.model.cameras

    def sights(self, frames: Sequence[Tables]) -> list[Sight]:
        """Return the detections of several frames as arrays; all frames at once are quicker."""
        counts = np.array([[len(table) for table in tables] for tables in frames], np.int64)
        joined = [pd.concat(tables, ignore_index=True) for tables in zip(*frames)]
        views = views_of(joined, self.model, WANDER * self.shapes.third)
        every = [Seen.of(t, c, v, self.cameras) for c, (t, v) in enumerate(zip(joined, views))]
        found = candidates(views, counts, self.model, [own.given for own in every])
        frame = np.concatenate([np.repeat(np.arange(len(counts)), many) for many in counts.T])
        seen = Seen.concat(every).take(np.argsort(frame, kind="stable"))
        of_camera, start = np.cumsum(counts, axis=1) - counts, np.cumsum([0, *counts.sum(1)])
        rows = np.concatenate([
            moved(groups.rows, first + begin)
            for (groups, _), first, begin in zip(found, of_camera, start)
        ])  # fmt: skip
        likely = np.flatnonzero(np.concatenate([g.probability for g, _ in found]) > _LIKELY)
        bodies = Bodies.none(*rows.shape)
        self._fit(bodies, likely, seen, rows[likely])
        ends = np.cumsum([0, *(len(groups) for groups, _ in found)])
        return [
            Sight(seen.take(slice(*own)), rays, groups, bodies.take(slice(*these)))
            for own, (groups, rays), these in zip(pairwise(start), found, pairwise(ends))
        ]

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
        own = np.flatnonzero(bubbles.body >= 0)
        late = own[sight.bodies.used[bubbles.body[own]] == "none"]
        self._fit(sight.bodies, bubbles.body[late], sight.seen, bubbles.rows[late])
        bubbles.d_eq_mm[late] = sight.bodies.d_eq_mm[bubbles.body[late]]
        result = self.tracker.update(number, t_s, bubbles, position_mm)
        self._open[number] = Frame(
            number, t_s, tables, sight.seen, offset_px, rays, bubbles, sight.bodies, result.motion
        )
        self._take_final(result)
        enough = self._waiting >= _BUBBLES_AT_ONCE and len(self._closed) > 2 * FRAMES_AFTER
        return self._flush(FRAMES_AFTER) if enough else None

    def finish(self) -> Linked | None:
        """Return the remaining rows at the end of the run; None if there are none."""
        result = self.tracker.finish()
        if result is not None:
            self._take_final(result)
        rows = self._flush(0) if self._closed else None
        self.events[:] = self._lifetimes.corrected(self.events)
        return rows

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
        for frame in done:
            self.events += self._lifetimes.add(frame.number, frame.t_s, frame.bubbles.particle)
        place_hidden(tracks, slice(len(self._before), len(self._before) + len(done)))
        self._before = [*self._before, *done][-FRAMES_BEFORE:]
        return Linked(self._tracks(done), _detections(done))

    def _fit(self, bodies: Bodies, some: Ints, seen: Seen, rows: Ints) -> None:
        """Fit some bodies to their detections. rows : (len(some), C) in ``seen``."""
        if not len(some):
            return
        gap_px = np.hypot(self.model.mean("frame_px"), self.model.mean("gap_rms_px"))
        fitted = fit_bodies(
            seen.sightings, rows, self.cameras, self.up, self.shapes,
            gap_sigma_px=float(gap_px), unsized_px2=self.model.scatter_px2(),
        )  # fmt: skip
        bodies.put(some, fitted)

    def _tracks(self, frames: Sequence[Frame]) -> pd.DataFrame:
        chosen = [
            f.bubbles.take((~f.bubbles.alone | (f.bubbles.body >= 0)) & (f.particle != NO_PARTICLE))
            for f in frames
        ]
        bubbles, many = Bubbles.concat(chosen), [*map(len, chosen)]
        seen = Seen.concat([f.seen for f in frames])
        here = moved(bubbles.rows, np.repeat(starts(f.seen for f in frames), many)[:, None])
        known = moved(bubbles.body, np.repeat(starts(f.bodies for f in frames), many))
        none = Bodies.none(1, len(self.cameras))  # the last one, of those without a body
        bodies = Bodies.concat([*(f.bodies for f in frames), none]).take(known)
        late = np.flatnonzero(known < 0)
        self._fit(bodies, late, seen, here[late])
        table: dict[str, Any] = {
            "frame": np.repeat([f.number for f in frames], many),
            "particle": bubbles.particle,
            "t_s": np.repeat([f.t_s for f in frames], many),
        }
        table |= dict(zip(["x_mm", "y_mm", "z_mm"], bodies.points_mm.T))
        table |= dict(zip(COVARIANCE_MM2, bodies.covariance_mm2[:, *np.triu_indices(3)].T))
        words: list[set[str]] = [{"ambiguous"} if unsure else set() for unsure in bubbles.ambiguous]
        for c, camera in enumerate(self.cameras):
            mine, values = np.flatnonzero(here[:, c] >= 0), bubbles.hidden_px[:, c].copy()
            values[mine] = seen.centre_px[here[mine, c]]
            values[mine, 2:] += bodies.shift_covariance_px2[mine, c][:, *np.triu_indices(2)]
            table |= {f"{camera.name}_{name}": v for name, v in zip(CENTRE_PX, values.T)}
            for k, name in enumerate(("du_px", "dv_px")):
                shift = np.where(np.isfinite(values[:, 0]), bodies.shift_px[:, c, k], np.nan)
                table[f"{camera.name}_{name}"] = shift
            for k, text in zip(mine.tolist(), seen.flags[here[mine, c]].tolist()):
                words[k].update(text.split("|"))
        for k in np.flatnonzero(bubbles.alone).tolist():
            words[k].add(_HIDDEN_FLAG)
        table["ray_miss_mm"] = bodies.ray_miss_mm
        table |= body_columns(bodies, self.up)
        table["confidence"] = bubbles.confidence
        table["centre"] = bodies.used
        table |= dict(zip((f"silhouettes_{x}_mm" for x in "xyz"), bodies.silhouette_points_mm.T))
        texts = ["|".join(sorted(own - {""})) for own in words]
        table["flags"] = pd.Series(texts, dtype=str)  # text also where there is no bubble
        return pd.DataFrame(table).sort_values(["frame", "particle"], ignore_index=True)


def grouped_frame(
    sight: Sight, model: RigModel, predicted: Prediction | None
) -> tuple[Bubbles, Bubbles, Array]:
    """Return the bubbles of a frame, each detection by itself, and the shift of each camera's
    pixels.

    What has no partner is a bubble that one camera alone sees.

    sight : detections of all cameras.
    model : the model for matching.
    predicted : expected positions of the tracks; None if there are none.

    The shift is (C, 2) in px: for each camera the median of measured minus projected pixels over
    the bubbles that all cameras see; 0 if there are fewer than three. It is taken off what fewer
    cameras see, so that their points agree with those of the others.
    """
    chosen, groups = match(sight.groups, sight.rays, model, predicted)
    bubbles = sight.together(chosen, groups)
    part = (bubbles.rows < 0).any(1)
    offset = np.zeros((len(model.cameras), 2))
    if np.sum(~part) >= _LEAST_FOR_OFFSET:
        offset = np.median(groups.left_px[~part], axis=0)
    rays = sight.alone(offset)
    for k in np.flatnonzero(part) if offset.any() else ():
        own = bubbles.rows[k, bubbles.rows[k] >= 0]
        bubbles.points_mm[k] = fused(rays.points_mm[own], rays.covariance_mm2[own])[0]
    single = rays.given == NO_PARTICLE
    single[bubbles.rows[bubbles.rows >= 0]] = False
    return Bubbles.concat([bubbles, rays.take(single)]), rays, offset


def _detections(frames: Sequence[Frame]) -> pd.DataFrame:
    """Return every detection with the id of its track, blank where it has none."""
    particle = np.concatenate([frame.owners() for frame in frames])
    every = pd.concat([table for frame in frames for table in frame.tables], ignore_index=True)
    every["particle"] = pd.arrays.IntegerArray(particle, particle == NO_PARTICLE)
    leading = ["frame", "camera", "particle"]
    every = every[leading + [name for name in every if name not in leading]]
    return every
