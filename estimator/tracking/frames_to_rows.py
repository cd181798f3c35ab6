"""Detections to tracks, frame by frame: pairs across the views, ids in time, points in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array, Ints
from telerig.estimator.bubbles.outline.ellipse_geometry import flag_words
from telerig.estimator.bubbles.pairing.matching import (
    Candidates,
    PairModel,
    Prediction,
    View,
    candidates,
    match_candidates,
    shared_axis,
    view_of,
)
from telerig.estimator.bubbles.shape.body import Bodies, body_columns, fit_bodies
from telerig.estimator.bubbles.shape.shapes import Shapes
from telerig.estimator.bubbles.shape.sightings import Sightings, sightings_from_table
from telerig.estimator.tracking.backtracking import (
    CENTRE_PX,
    COVARIANCE_MM2,
    FRAMES_AFTER,
    FRAMES_BEFORE,
    Frame,
    Pairs,
    Pixels,
    Sight,
    SmoothedTracks,
    Tables,
    follow_back,
    given_ids,
    shared_rows,
)
from telerig.estimator.tracking.filter import (
    NO_PARTICLE,
    FrameMeasurements,
    FrameResult,
    SingleMeasurements,
    TrackEvent,
)
from telerig.estimator.tracking.tracker import Tracker
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian, triangulate

_PAIRS_AT_ONCE = 512
_LEAST_FOR_OFFSET = 3

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

    cameras: tuple[Camera, Camera]
    model: PairModel
    tracker: Tracker
    shapes: Shapes
    up: Array
    events: list[TrackEvent] = field(default_factory=list)
    _open: dict[int, Frame] = field(default_factory=dict)
    _closed: list[Frame] = field(default_factory=list)
    _before: list[Frame] = field(default_factory=list)
    _waiting: int = 0

    def sights(self, frames: Sequence[Tables]) -> list[Sight]:
        """Return the detections of several frames as arrays; all frames at once are quicker."""
        axis = shared_axis(self.cameras)
        counts = np.array([[len(table) for table in tables] for tables in frames], np.int64)
        views, pixels, ids, joined, of_cameras = [], [], [], [], []
        for c, (camera, tables) in enumerate(zip(self.cameras, zip(*frames))):
            table = pd.concat(tables, ignore_index=True)
            views.append(view_of(table, camera, axis))
            pixels.append(_pixels(table, self._wander))
            ids.append(given_ids(table))
            a, d_eq = (table[name].to_numpy(float) for name in ("a_px", "d_eq_px"))
            joined.append(table)
            flags = ["|".join(words) for words in flag_words(table)]
            centre, (uv, covariance) = table[CENTRE_PX].to_numpy(float), pixels[c]
            ends = np.cumsum([0, *counts[:, c]]).tolist()
            of_cameras.append(
                [
                    ((uv[p], covariance[p]), centre[p], a[p], d_eq[p], ids[c][p], flags[p])
                    for p in (slice(low, high) for low, high in pairwise(ends))
                ]
            )
        possible = self._possible((views[0], views[1]), pixels, ids, joined, counts)
        every: list[tuple[Any, ...]] = [
            (*zip(*both), *pairs) for *both, pairs in zip(*of_cameras, possible)
        ]
        return [Sight(*columns) for columns in every]

    def _possible(
        self,
        views: tuple[View, View],
        pixels: Sequence[Pixels],
        ids: Sequence[Ints],
        tables: Sequence[pd.DataFrame],
        counts: Ints,
    ) -> list[tuple[Candidates, Pairs, Array]]:
        """Return the last three fields of `Sight` for each of F frames.

        counts : (F, 2) detections of the frames, which follow each other in the other arguments.
        """
        frames = [np.repeat(np.arange(len(counts)), many) for many in counts.T]
        free = [np.flatnonzero(i == NO_PARTICLE) for i in ids]
        left = np.array([np.bincount(n[i], minlength=len(counts)) for n, i in zip(frames, free)]).T
        found = candidates((views[0].of(free[0]), views[1].of(free[1])), left, self.model)
        rows = np.concatenate([f.rows + s for f, s in zip(found, np.cumsum(left, axis=0) - left)])
        rows = np.stack([own[r] for own, r in zip(free, rows.T)], -1)
        if any(len(own) < len(i) for own, i in zip(free, ids)):
            named = [np.flatnonzero(i != NO_PARTICLE) for i in ids]
            keys = [n[i] + len(counts) * own[i] for n, own, i in zip(frames, ids, named)]
            _, first, second = np.intersect1d(keys[0], keys[1], return_indices=True)
            rows = np.concatenate([np.stack([named[0][first], named[1][second]], -1), rows])
            rows = rows[np.argsort(frames[0][rows[:, 0]], kind="stable")]
        (uv_a, cov_a), (uv_b, cov_b) = ([a[i] for a in p] for p, i in zip(pixels, rows.T))
        rays = [(view.origin_mm[i], view.direction[i]) for view, i in zip(views, rows.T)]
        points = triangulate(self.cameras, (uv_a, uv_b), (cov_a, cov_b), rays=rays)
        expected, _ = stacked_jacobian(self.cameras, points.points_mm)
        frame = frames[0][rows[:, 0]]
        pairs = Pairs(
            rows - (np.cumsum(counts, axis=0) - counts)[frame],
            np.ones(len(rows)),
            np.zeros(len(rows), bool),
            ids[0][rows[:, 0]],
            points.points_mm,
            points.covariance_mm2,
            self._bodies(tables, rows),
            np.full(len(rows), NO_PARTICLE),
        )
        off = np.hstack([uv_a, uv_b]) - expected
        cuts = [slice(*ends) for ends in pairwise(np.searchsorted(frame, range(len(counts) + 1)))]
        return [(one, pairs.take(cut), off[cut]) for one, cut in zip(found, cuts)]

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
        tables : the detections of the two cameras
        sight : the same as arrays, if known.
        """
        predicted = self.tracker.predict(t_s, position_mm)
        sight = self.sights([tables])[0] if sight is None else sight
        pairs, offset_px = pair_frame(sight, self.model, predicted)
        first, second = (_others(rows, given) for rows, given in zip(pairs.rows.T, sight.given))
        unpaired = (first, second)
        measured = _measured(pairs, unpaired, sight.pixels, offset_px)
        result = self.tracker.update(number, t_s, measured, position_mm)
        self._open[number] = Frame(
            number, t_s, tables, sight, offset_px, pairs, unpaired, result.alone, result.motion
        )
        self._take_final(result)
        enough = self._waiting >= _PAIRS_AT_ONCE and len(self._closed) > 2 * FRAMES_AFTER
        return self._flush(FRAMES_AFTER) if enough else None

    @property
    def _wander(self) -> float:
        """Sd of the shift of an outline's centre by a bubble's shape, as a share of its radius."""
        return WANDER * self.shapes.third

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
            frame.take_final(ids)
            self._closed.append(frame)
            self._waiting += 1 + len(frame.pairs)

    def _flush(self, ahead: int) -> Linked:
        """Return rows of closed frames but the last few, which hidden bubbles may need."""
        done = self._closed[: len(self._closed) - ahead]
        self._closed, self._waiting = self._closed[len(done) :], 0
        window = [*self._before, *done, *self._closed]
        tracks = SmoothedTracks(window, self.cameras, self.tracker.settings)
        follow_back(tracks, {f.number for f in (*done, *self._closed)})
        hidden = shared_rows(tracks, slice(len(self._before), len(self._before) + len(done)))
        self._before = [*self._before, *done][-FRAMES_BEFORE:]
        joined = tuple(pd.concat([f.tables[c] for f in done], ignore_index=True) for c in range(2))
        found = self._tracks(done, joined)
        if hidden:
            found = pd.concat(
                [found, pd.DataFrame(hidden, columns=found.columns)], ignore_index=True
            )
            found = found.sort_values(["frame", "particle"], kind="stable", ignore_index=True)
        return Linked(found, _detections(done, joined))

    def _bodies(self, tables: Sequence[pd.DataFrame], rows: Ints) -> Bodies:
        """Fit M bodies to the detections ``rows`` (M, C) of the cameras' tables."""
        seen = [table.take(mine) for table, mine in zip(tables, rows.T)]
        sightings = [sightings_from_table(t, c, self.cameras) for c, t in enumerate(seen)]
        order = np.arange(rows.size).reshape(rows.shape[::-1]).T
        gap_px = float(np.hypot(self.model.frame_px, self.model.rms_px[0]))
        return fit_bodies(
            Sightings.concat(sightings), order, self.cameras, self.up, self.shapes,
            gap_sigma_px=gap_px,
        )  # fmt: skip

    def _tracks(self, frames: Sequence[Frame], joined: Sequence[pd.DataFrame]) -> pd.DataFrame:
        pairs = Pairs.concat([f.pairs for f in frames])
        starts = np.repeat(_starts(frames).T, [len(f.pairs) for f in frames], 0)
        at = pairs.rows + starts
        first, second = (t.take(at[:, c]).reset_index(drop=True) for c, t in enumerate(joined))
        bodies, late = pairs.bodies, np.flatnonzero(pairs.bodies.used == "none")
        if len(late):
            bodies.put(late, self._bodies(joined, at[late]))
        many = [len(f.pairs) for f in frames]
        table: dict[str, Any] = {
            "frame": np.repeat([f.number for f in frames], many),
            "particle": np.concatenate([f.particle for f in frames]),
            "t_s": np.repeat([f.t_s for f in frames], many),
        }
        table |= dict(zip(["x_mm", "y_mm", "z_mm"], bodies.points_mm.T))
        table |= dict(zip(COVARIANCE_MM2, bodies.covariance_mm2[:, *np.triu_indices(3)].T))
        shape = _shape_share_px2(self.cameras, bodies)
        for c, (camera, rows) in enumerate(zip(self.cameras, (first, second))):
            values = rows[CENTRE_PX].to_numpy(float, copy=True)
            values[:, 2:] += shape[:, c][:, *np.triu_indices(2)]
            table |= {f"{camera.name}_{name}": v for name, v in zip(CENTRE_PX, values.T)}
            for k, name in enumerate(("du_px", "dv_px")):
                table[f"{camera.name}_{name}"] = bodies.shift_px[:, c, k]
        table["ray_miss_mm"] = bodies.ray_miss_mm
        table |= body_columns(bodies, self.up)
        table["confidence"] = np.concatenate([f.pairs.confidence for f in frames])
        table["centre"] = bodies.used
        table |= dict(zip((f"silhouettes_{x}_mm" for x in "xyz"), bodies.silhouette_points_mm.T))
        ambiguous = np.concatenate([f.pairs.ambiguous for f in frames])
        words = zip(flag_words(first), flag_words(second), ambiguous)
        texts = [
            "|".join(sorted({*a, *b, *(["ambiguous"] if unsure else [])})) for a, b, unsure in words
        ]
        table["flags"] = pd.Series(texts, dtype=str)  # text also where there is no pair
        found = pd.DataFrame(table)
        return found[found["particle"] != NO_PARTICLE].reset_index(drop=True)


def _starts(frames: Sequence[Frame]) -> Ints:
    """Return the position (2, F) of each frame's first detection in the cameras' tables."""
    many = np.array([[len(table) for table in f.tables] for f in frames], np.int64).reshape(-1, 2)
    return (np.cumsum(many, axis=0) - many).T


def _shape_share_px2(cameras: tuple[Camera, Camera], bodies: Bodies) -> Array:
    """Return the share (M, 2, 2, 2) of the unknown shape in the centres' covariances, by camera."""
    out = np.zeros((len(bodies.points_mm), 2, 2, 2))
    known = np.isfinite(bodies.covariance_mm2).all((1, 2))
    share = (bodies.covariance_mm2 - bodies.silhouette_covariance_mm2)[known]
    values, vectors = np.linalg.eigh(share)
    share = (vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, -1, -2)
    _, jacobian = stacked_jacobian(cameras, bodies.points_mm[known])
    for c in range(2):
        view = jacobian[:, 2 * c : 2 * c + 2]
        out[known, c] = view @ share @ np.swapaxes(view, -1, -2)
    return out


def pair_frame(sight: Sight, model: PairModel, predicted: Prediction | None) -> tuple[Pairs, Array]:
    """Return the pairs of a frame, and the median shift of each camera's pixels.

    Detections with given ids are paired by their ids; all others are matched.

    sight : detections of the two cameras.
    model : the model for pairing.
    predicted : expected positions of the tracks; None if there are none.

    The shift is (2, 2) in px: for each camera the median of measured minus projected pixels over
    the pairs; 0 if there are fewer than three pairs.
    """
    found = match_candidates(sight.candidates, model, predicted)
    given = np.arange(len(sight.possible) - len(sight.candidates))
    chosen = np.concatenate([given, len(given) + found.candidate])
    pairs = sight.possible.take(chosen)
    pairs.confidence[len(given) :] = found.confidence
    pairs.ambiguous[len(given) :] = found.ambiguous
    if len(chosen) < _LEAST_FOR_OFFSET:
        return pairs, np.zeros((2, 2))
    return pairs, np.median(sight.left_px[chosen], axis=0).reshape(2, 2)


def _others(rows: Ints, given: Ints) -> Ints:
    """Return the rows of detections without a given id that are not among ``rows``."""
    out = given == NO_PARTICLE
    out[rows] = False
    return np.flatnonzero(out)


def _pixels(table: pd.DataFrame, wander: float) -> Pixels:
    """Return centres (N, 2) and covariances (N, 2, 2), the unknown shape's share included."""
    covariance = table[["suu_px2", "suv_px2", "suv_px2", "svv_px2"]].to_numpy(float)
    radius = np.nan_to_num(table["d_eq_px"].to_numpy(float)) / 2
    shape = (wander * radius)[:, None, None] ** 2 * np.eye(2)
    return table[["u_px", "v_px"]].to_numpy(float), covariance.reshape(-1, 2, 2) + shape


def _measured(
    pairs: Pairs, unpaired: tuple[Ints, Ints], pixels: tuple[Pixels, Pixels], offset_px: Array
) -> FrameMeasurements:
    """Return the tracker's input; unpaired : rows of the detections without a partner."""
    (uv_a, cov_a), (uv_b, cov_b) = ([a[i] for a in p] for p, i in zip(pixels, unpaired))
    singles = SingleMeasurements(
        np.repeat([0, 1], [len(i) for i in unpaired]).astype(np.int64),
        np.concatenate([uv_a - offset_px[0], uv_b - offset_px[1]]),
        np.concatenate([cov_a, cov_b]),
    )
    return FrameMeasurements.create(
        pairs.points_mm,
        pairs.covariance_mm2,
        d_eq_mm=pairs.d_eq_mm,
        confidence=pairs.confidence,
        particle=pairs.given,
        singles=singles,
    )


def _detections(frames: Sequence[Frame], joined: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return every detection with the id of its track, blank where it has none."""
    particle = np.concatenate([frame.owners(c) for c in range(2) for frame in frames])
    order = [2 * k + c for c in range(2) for k, f in enumerate(frames) for _ in f.sight.given[c]]
    both = pd.concat(joined, ignore_index=True)
    both["particle"] = pd.arrays.IntegerArray(particle, particle == NO_PARTICLE)
    leading = ["frame", "camera", "particle"]
    both = both[leading + [name for name in both if name not in leading]]
    return both.take(np.argsort(order, kind="stable")).reset_index(drop=True)
