"""What smoothed tracks add to frames whose ids are final.

The tracker goes forward only. Where a bubble is born hidden, or in frames with doubtful pairs, its
position is better known from later frames: it is smoothed over all frames at hand, and detections
without a track are given to it where no other explanation is nearly as likely (`follow_back`).

One outline in one image may show two bubbles which another image separates. One camera alone sees
the hidden bubble; its depth in that camera follows from the motion between the frames in which more
saw it (`shared_rows`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools, Ints, Rows
from telerig.estimator.bubbles.pairing.groups import Candidates, Pixels
from telerig.estimator.bubbles.pairing.matching import Prediction
from telerig.estimator.bubbles.shape.body import Bodies
from telerig.estimator.tracking.association import (
    Projected,
    gate2,
    pair_pixels,
    projected,
    px_per_mm,
    size_score,
)
from telerig.estimator.tracking.filter import (
    NO_PARTICLE,
    POSITION,
    FrameIds,
    Motion,
    SeenAlone,
    TrackerSettings,
    birth_covariance,
)
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian, triangulate_views

_ANYWHERE_MM = 100.0


@dataclass(frozen=True)
class Readings:
    """Measurements of K bubbles in F frames, in information form.

    information : (F, K, 3, 3) inverse covariance of each measured point (1/mm^2), 0 where a bubble
        was not measured.
    pull : (F, K, 3) information @ point (1/mm).
    """

    information: Array
    pull: Array

    @staticmethod
    def none(frames: int, bubbles: int) -> Readings:
        return Readings(np.zeros((frames, bubbles, 3, 3)), np.zeros((frames, bubbles, 3)))

    def add(
        self, frames: Ints, bubbles: Ints, values: Array, covariances: Array, by_points: Array
    ) -> None:
        """Add M measurements with k components each.

        frames, bubbles : (M,) indices.
        values : (M, k) equal to by_points (M, k, 3) @ point plus noise.
        covariances : (M, k, k) of the noise.
        """
        weighted = np.swapaxes(np.linalg.solve(covariances, by_points), -1, -2)
        np.add.at(self.information, (frames, bubbles), weighted @ by_points)
        np.add.at(self.pull, (frames, bubbles), (weighted @ values[..., None])[..., 0])


def smooth_points(
    readings: Readings,
    motions: Sequence[Motion | None],
    settings: TrackerSettings,
) -> tuple[Array, Array]:
    """Return the smoothed points (F, K, 3) in mm in the rig frame, and covariances (F, K, 3, 3).

    motions : motion of the bubbles from the frame before into each frame; the first is not used.
    """
    from telerig.estimator.tracking import kernels

    prior = birth_covariance(settings, _ANYWHERE_MM**2 * np.eye(3), encoder=False)
    x = np.zeros((readings.pull.shape[1], len(prior)))
    total = readings.information.sum(0) + 1e-9 * np.eye(3)
    x[:, POSITION] = np.linalg.solve(total, readings.pull.sum(0)[..., None])[..., 0]
    still = Motion(np.eye(len(prior)), np.zeros_like(prior), np.zeros(len(prior)))
    steps = [still, *(m for m in motions[1:] if m is not None)]
    assert len(steps) == max(len(motions), 1), "only the first frame has no motion into it"
    matrices, noises, offsets = (
        np.array([getattr(step, field.name) for step in steps]) for field in fields(Motion)
    )
    return kernels.smooth(readings.information, readings.pull, matrices, noises, offsets, x, prior)


Tables = tuple["pd.DataFrame", ...]
"""One frame's detections in each camera."""

COVARIANCE_MM2 = ["sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2"]
CENTRE_PX = ["u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"]


@dataclass(frozen=True)
class Bubbles(Rows):
    """M bubbles of one frame, each of which two cameras or more see.

    rows : (M, C) row of the detection in the table of each camera, -1 where it does not see it.
    confidence : (M,) probability that all detections of the bubble are its own.
    ambiguous : (M,) whether another group is nearly as probable.
    given : (M,) id that the user gave to the detections, -1 for none.
    points_mm, covariance_mm2 : (M, 3), (M, 3, 3) position of the outlines' centres with the
        covariance of a bubble of unknown shape.
    bodies : the M bodies, fitted to all outlines.
    particle : (M,) id of the track, -1 for none; it is known when the frame is final.
    """

    rows: Ints
    confidence: Array
    ambiguous: Bools
    given: Ints
    points_mm: Array
    covariance_mm2: Array
    bodies: Bodies
    particle: Ints

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def d_eq_mm(self) -> Array:
        """Equivalent diameters (M,), NaN where unknown."""
        return self.bodies.d_eq_mm


@dataclass(frozen=True)
class Sight:
    """Hold the detections of one frame as arrays; tuples have an entry for each camera.

    pixels : centres and covariances with the share of the unknown shape.
    centre_px : (N, 5) the columns CENTRE_PX.
    a_px, d_eq_px : (N,) major semi-axes and equivalent diameters.
    given : (N,) ids given by the user, -1 for none.
    flags : (N,) texts.
    possible : the groups with given ids, then those of `candidates`, in space.
    left_px : (E, C, 2) pixels less those of the points; NaN where a camera does not see it.
    """

    pixels: tuple[Pixels, ...]
    centre_px: tuple[Array, ...]
    a_px: tuple[Array, ...]
    d_eq_px: tuple[Array, ...]
    given: tuple[Ints, ...]
    flags: tuple[list[str], ...]
    candidates: Candidates
    possible: Bubbles
    left_px: Array


@dataclass(frozen=True)
class Single:
    """A bubble with a track that only one camera sees in a frame.

    particle : id of the track.
    camera, row : the camera, and the row of its table of detections.
    point_mm : (3,) approximate position in the rig frame.
    d_eq_mm : equivalent diameter.
    """

    particle: int
    camera: int
    row: int
    point_mm: Array
    d_eq_mm: float


@dataclass
class Frame:
    """One frame of a run while its tracks may still change.

    tables : its detections in each camera.
    sight : the same as arrays.
    offset_px : (C, 2) for each camera the shift of all detections, because the cameras shake.
    bubbles : the bubbles that two cameras or more see.
    others : for each camera the rows of its table that are of none of these.
    alone : tracks that only one camera continued, by index into the rows of ``others``, those of
        the first camera first.
    singles : the same with the final ids, after `take_final`.
    motion : motion of all bubbles since the frame before; None for the first frame.
    """

    number: int
    t_s: float
    tables: Tables
    sight: Sight
    offset_px: Array
    bubbles: Bubbles
    others: tuple[Ints, ...]
    alone: Mapping[int, SeenAlone]
    motion: Motion | None
    singles: list[Single] = field(default_factory=list)

    def take_final(self, ids: FrameIds) -> None:
        """Take over the tracker's final ids."""
        self.bubbles.particle[:] = ids.particle
        cameras = np.repeat(np.arange(len(self.others)), [len(rows) for rows in self.others])
        rows = np.concatenate(self.others)
        for index in np.flatnonzero(ids.single != NO_PARTICLE).tolist():
            seen = self.alone[index]
            camera, row = int(cameras[index]), int(rows[index])
            self.singles.append(
                Single(int(ids.single[index]), camera, row, seen.point_mm, seen.d_eq_mm)
            )

    @property
    def particle(self) -> Ints:
        """The ids (M,) of the tracks of M bubbles, -1 for none."""
        return self.bubbles.particle

    def owners(self, camera: int) -> Ints:
        """Return the id (N,) of the track of each of a camera's N detections, -1 for none."""
        out = self.sight.given[camera].copy()
        taken = (self.particle != NO_PARTICLE) & (self.bubbles.rows[:, camera] >= 0)
        out[self.bubbles.rows[taken, camera]] = self.particle[taken]
        for single in self.singles:
            if single.camera == camera:
                out[single.row] = single.particle
        return out

    def of(self, particle: int) -> list[Single]:
        return [s for s in self.singles if s.particle == particle]

    def hidden(self) -> list[Single]:
        """Return the bubbles with tracks that exactly one camera sees."""
        return [s for s in self.singles if len(self.of(s.particle)) == 1]

    def claim(self, one: Bubbles) -> None:
        """Add one bubble with its track. Earlier ones with one of its detections are removed."""
        same = (self.bubbles.rows == one.rows) & (one.rows >= 0)
        known = (self.bubbles.rows == one.rows).all(1)
        if known.any():
            self.particle[known] = one.particle
        else:
            self.bubbles = Bubbles.concat([self.bubbles.take(~same.any(1)), one])


def given_ids(table: pd.DataFrame) -> Ints:
    """Return the ids (N,) that came with N detections, -1 for none."""
    if "particle" not in table:
        return np.full(len(table), NO_PARTICLE)
    return table["particle"].to_numpy(np.int64)


def readings_of(
    frames: Sequence[Frame], particles: Sequence[int], cameras: Sequence[Camera]
) -> Readings:
    """Return the measurements of some tracks in several frames, in the order of ``particles``.

    particles : ids of the tracks.
    """
    place = {p: k for k, p in enumerate(particles)}
    out = Readings.none(len(frames), len(place))
    who = np.array([place.get(p, -1) for frame in frames for p in frame.particle.tolist()], int)
    kept = np.flatnonzero(who >= 0)
    if len(kept):
        at = np.repeat(np.arange(len(frames)), [len(frame.bubbles) for frame in frames])
        points, covariances = (
            np.concatenate([getattr(frame.bubbles, name) for frame in frames])[kept]
            for name in ("points_mm", "covariance_mm2")
        )
        out.add(at[kept], who[kept], points, covariances, np.eye(3))
    for c, camera in enumerate(cameras):
        singles = [
            (i, place[s.particle], s.point_mm, frame.sight.pixels[c][0][s.row] - frame.offset_px[c],
             frame.sight.pixels[c][1][s.row])
            for i, frame in enumerate(frames)
            for s in frame.singles
            if s.camera == c and s.particle in place
        ]  # fmt: skip
        if singles:
            index, who, points, measured, covariances = map(np.array, zip(*singles))
            uv, by_point = stacked_jacobian((camera,), points)
            values = measured - uv + (by_point @ points[..., None])[..., 0]
            out.add(index, who, values, covariances, by_point)
    return out


_LEAST_POINTS = 4
"""Points in space that a track needs to be followed."""

_PASSES = 12
_REACH_FRAMES = 4
"""Frames beyond a track's ends that one pass looks at."""

_VAGUE = 0.5
"""Largest sd of a predicted pixel, as a share of the bubble's diameter."""

_CONFIDENCE = 0.95
"""Share of points from smoothed tracks that were right in simulated swarms."""

_DOUBTFUL = {"overlap", "merged", "border"}
"""Flags of outlines of which only a part was seen."""


@dataclass
class SmoothedTracks:
    """Smooths tracks over consecutive frames with final ids, and keeps the results.

    The result for a track is kept until `forget` says that its measurements have changed.
    """

    frames: Sequence[Frame]
    cameras: tuple[Camera, ...]
    settings: TrackerSettings
    _known: dict[int, tuple[Array, Array]] = field(default_factory=dict)

    def at(self, index: int, particles: Sequence[int]) -> tuple[Array, Array]:
        """Return the points (K, 3) and covariances (K, 3, 3) of K tracks in one frame.

        index : of the frame. particles : ids of the tracks, which `prepare` must have smoothed.
        """
        points, covariances = zip(*(self._known[p] for p in particles))
        return np.array([x[index] for x in points]), np.array([c[index] for c in covariances])

    def prepare(self, particles: Iterable[int]) -> None:
        """Smooth those of the given tracks for which no result is kept."""
        new = sorted(set(particles) - set(self._known))
        if new:
            readings = readings_of(self.frames, new, self.cameras)
            found = smooth_points(readings, [f.motion for f in self.frames], self.settings)
            self._known |= zip(new, zip(*(np.swapaxes(values, 0, 1) for values in found)))

    def forget(self, particles: Iterable[int]) -> None:
        """Drop the results of tracks whose measurements have changed."""
        for particle in particles:
            del self._known[particle]


def follow_back(tracks: SmoothedTracks, changeable: set[int]) -> None:
    """Give detections without a track to the tracks that they continue.

    changeable : numbers of the frames in which tracks may still change.
    """
    frames, cameras = tracks.frames, tracks.cameras
    sizes = _sizes(frames)
    for frame in frames:
        if frame.number in changeable:
            # Cameras that each saw a particle alone may see it together, or one of them is wrong.
            twice = {s.particle for s in frame.singles if len(frame.of(s.particle)) > 1}
            wrong = twice & set(sizes)
            frame.singles = [s for s in frame.singles if s.particle not in wrong]
    for _ in range(_PASSES):
        missing = [
            (i, here)
            for i, here in enumerate(_missing(frames, changeable, sorted(sizes)))
            if here and any((frames[i].owners(c) == NO_PARTICLE).any() for c in range(len(cameras)))
        ]
        if not missing:
            break
        tracks.prepare(chain.from_iterable(here for _, here in missing))
        every = [tracks.at(i, here) for i, here in missing]
        expected = [projected(camera, *map(np.concatenate, zip(*every))) for camera in cameras]
        changed, first = set(), 0
        for (i, here), (points, covariances) in zip(missing, every):
            d_eq = np.array([sizes[p] for p in here])
            predicted = Prediction(np.array(here), points, covariances, d_eq)
            own = [_of(view, slice(first, first + len(here))) for view in expected]
            changed |= _claim(frames[i], predicted, own, cameras, tracks.settings)
            first += len(here)
        if not changed:
            break
        tracks.forget(changed)


def _sizes(frames: Sequence[Frame]) -> dict[int, float]:
    """Median diameter (mm) of the tracks that can be followed; tracks with given ids cannot."""
    found: dict[int, list[float]] = {}
    for frame in frames:
        here = frame.bubbles
        own = (here.given == NO_PARTICLE) & (here.particle != NO_PARTICLE)
        for particle, d_eq in zip(here.particle[own].tolist(), here.d_eq_mm[own].tolist()):
            found.setdefault(particle, []).append(d_eq)
    enough = {p: np.array(d) for p, d in found.items() if len(d) >= _LEAST_POINTS}
    known = {p: d[np.isfinite(d)] for p, d in enough.items()}
    return {p: float(np.median(d)) if len(d) else float("nan") for p, d in known.items()}


def _distance2(
    frame: Frame, rows: Ints, predicted: Prediction, k: int, cameras: Sequence[Camera]
) -> float:
    """Squared Mahalanobis distance of detections from the k-th predicted particle.

    rows : (C,) of the cameras' tables, -1 for none.
    """
    seen = np.flatnonzero(rows >= 0).tolist()
    some = tuple(cameras[c] for c in seen)
    expected, by_point = stacked_jacobian(some, predicted.points_mm[k : k + 1])
    covariance = by_point[0] @ predicted.covariance_mm2[k] @ by_point[0].T
    left = -expected[0]
    for i, c in enumerate(seen):
        at, (centre, noise) = slice(2 * i, 2 * i + 2), frame.sight.pixels[c]
        covariance[at, at] += noise[rows[c]]
        left[at] += centre[rows[c]] - frame.offset_px[c]
    return float(left @ np.linalg.solve(covariance, left))


def _missing(
    frames: Sequence[Frame], changeable: set[int], particles: Sequence[int]
) -> list[list[int]]:
    """Per frame the particles that it lacks, in the gaps of their tracks and a little beyond."""
    seen = np.zeros((len(frames), len(particles)), bool)
    for i, frame in enumerate(frames):
        here = {*frame.particle.tolist(), *(s.particle for s in frame.singles)}
        seen[i] = [p in here for p in particles]
    first, last = seen.argmax(0), len(seen) - 1 - seen[::-1].argmax(0)
    index = np.arange(len(frames))[:, None]
    reach = (index >= first - _REACH_FRAMES) & (index <= last + _REACH_FRAMES)
    wanted = ~seen & reach & np.array([f.number in changeable for f in frames])[:, None]
    return [[particles[k] for k in np.flatnonzero(row).tolist()] for row in wanted]


def _of(expected: Projected, rows: slice) -> Projected:
    return Projected(*(getattr(expected, field.name)[rows] for field in fields(Projected)))


def _claim(
    frame: Frame,
    predicted: Prediction,
    expected: Sequence[Projected],
    cameras: Sequence[Camera],
    settings: TrackerSettings,
) -> set[int]:
    """Give the frame's free detections to the predicted particles; those to which any was given.

    expected : the predicted points in each camera.
    """
    found = [_nearest(frame, c, predicted, own, settings) for c, own in enumerate(expected)]
    changed = set()
    for k, rows in enumerate(np.array(found, np.int64).T):
        if rows.max() >= 0 and _claim_rows(frame, rows, k, predicted, cameras, settings):
            changed.add(int(predicted.ids[k]))
    return changed


def _nearest(
    frame: Frame,
    camera: int,
    predicted: Prediction,
    expected: Projected,
    settings: TrackerSettings,
) -> list[int]:
    """The row of each particle in one camera, -1 where there is none or not without a rival."""
    free = np.flatnonzero(frame.owners(camera) == NO_PARTICLE)
    if not len(free):
        return [-1] * len(predicted.ids)
    centre, noise = (a[free] for a in frame.sight.pixels[camera])
    scale = px_per_mm(expected.by_point)
    sd2 = np.linalg.eigvalsh(expected.covariance_px2)[:, -1]
    sharp = sd2 <= (_VAGUE * scale * predicted.d_eq_mm) ** 2
    measured_mm = frame.sight.d_eq_px[camera][free] / scale[:, None]
    chosen = pair_pixels(
        expected,
        centre - frame.offset_px[camera],
        noise,
        settings,
        size_score=size_score(predicted.d_eq_mm[:, None], measured_mm, settings),
        allowed=sharp[:, None],
    )
    return [int(free[j]) if j >= 0 else -1 for j in chosen]


def _claim_rows(
    frame: Frame,
    rows: Ints,
    k: int,
    predicted: Prediction,
    cameras: Sequence[Camera],
    settings: TrackerSettings,
) -> bool:
    """Give detections, (C,) rows of the cameras' tables or -1, to the prediction of track k.

    One alone is taken as such; where several agree with the prediction, they become one point. Else
    those whose outlines are whole are tried, if others are not. Returns whether any were taken.
    """
    seen, d_eq = np.flatnonzero(rows >= 0).tolist(), predicted.d_eq_mm[k : k + 1]
    if len(seen) == 1:
        particle, camera = int(predicted.ids[k]), seen[0]
        point = predicted.points_mm[k]
        frame.singles.append(Single(particle, camera, int(rows[camera]), point, float(d_eq[0])))
        return True
    if _distance2(frame, rows, predicted, k, cameras) <= gate2(settings, 2 * len(seen)):
        uv, noise = zip(*([a[rows[c]][None] for a in frame.sight.pixels[c]] for c in seen))
        found = triangulate_views([cameras[c] for c in seen], uv, noise)
        frame.claim(
            Bubbles(
                rows[None],
                np.array([_CONFIDENCE]),
                np.array([True]),
                np.array([NO_PARTICLE]),
                found.points_mm,
                found.covariance_mm2,
                Bodies.sized(d_eq, len(cameras)),
                predicted.ids[k : k + 1],
            )
        )
        return True
    flags = [set(frame.sight.flags[c][rows[c]].split("|")) for c in seen]
    doubtful = np.array([bool(words & _DOUBTFUL) for words in flags])
    if doubtful.all() or not doubtful.any():
        return False
    whole = rows.copy()
    whole[np.array(seen)[doubtful]] = -1
    return _claim_rows(frame, whole, k, predicted, cameras, settings)


FRAMES_BEFORE, FRAMES_AFTER = 15, 40
"""Frames around a hidden one by which its position is smoothed."""

FLAG = "shared"
_SHARPNESS, _SHARPNESS_PX = 0.1, 3.0
"""Largest sd of a hidden centre, as a share of the bubble's diameter and in px."""

_APART = 0.5
"""Least distance of two bubbles' centres, as a share of their distance when they touch."""

_BEHIND = 0.25
"""Standard deviation of a pixel "behind that outline", as a share of the outline's semi-axis."""


def shared_rows(tracks: SmoothedTracks, frames: slice) -> list[dict[str, Any]]:
    """Return rows for the hidden bubbles of some frames; the other frames are context.

    A hidden view's pixel is that of the point; its covariance states only that the bubble is
    behind that outline, so that motion is not counted twice when tracks are smoothed.
    """
    seen = {p for frame in tracks.frames for p in frame.particle.tolist()}
    hidden = [
        (i, single)
        for i, frame in list(enumerate(tracks.frames))[frames]
        for single in frame.hidden()
        if single.particle in seen
    ]
    if not hidden:
        return []
    tracks.prepare(single.particle for _, single in hidden)
    every = [tracks.at(i, [single.particle]) for i, single in hidden]
    points, covariances = (np.concatenate(values) for values in zip(*every))
    views = [projected(camera, points, covariances) for camera in tracks.cameras]
    order = np.lexsort((np.trace(covariances, axis1=1, axis2=2), [i for i, _ in hidden]))
    out, last = [], None
    for k in order.tolist():
        frame, single = tracks.frames[hidden[k][0]], hidden[k][1]
        if frame is not last:
            known, last = frame.particle != NO_PARTICLE, frame
            here = frame.bubbles.take(known)
            where, sizes = [*here.points_mm], here.d_eq_mm.tolist()
        each = [_of(view, slice(k, k + 1)) for view in views]
        row = _row(frame, single, points[k], covariances[k], each, tracks.cameras)
        if row is not None and not _taken(single, points[k], where, sizes):
            out.append(row)
            where.append(points[k])
            sizes.append(single.d_eq_mm)
    return out


def _taken(
    single: Single, point_mm: Array, others_mm: Sequence[Array], sizes_mm: Sequence[float]
) -> bool:
    """Whether another track's bubble occupies the place of this one."""
    away = np.linalg.norm(np.reshape(others_mm, (-1, 3)) - point_mm, axis=1)
    return bool((away < _APART * (np.array(sizes_mm) + single.d_eq_mm) / 2).any())


def _row(
    frame: Frame,
    single: Single,
    point: Array,
    covariance: Array,
    views: Sequence[Projected],
    cameras: Sequence[Camera],
) -> dict[str, Any] | None:
    """None where the point is too uncertain, or a camera's image does not explain why it is not
    seen there: neither an outline of another bubble nor the image's border.

    views : the point in each camera.
    """
    per_camera = {}
    for c, (camera, view) in enumerate(zip(cameras, views)):
        if c == single.camera:
            per_camera[camera.name] = frame.sight.centre_px[c][single.row].tolist()
            continue
        uv, spread = view.uv_px[0] + frame.offset_px[c], view.covariance_px2[0]
        diameter = single.d_eq_mm * px_per_mm(view.by_point)[0]
        sd = float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
        reach = _outline_over(frame.sight, c, uv, diameter / 2)
        if sd <= min(_SHARPNESS * diameter, _SHARPNESS_PX) and reach > 0:
            behind = spread + (_BEHIND * reach) ** 2 * np.eye(2)
            per_camera[camera.name] = [*uv, behind[0, 0], behind[0, 1], behind[1, 1]]
        elif _inside(camera, uv, diameter / 2):
            return None
    if len(per_camera) < 2:
        return None
    flags = sorted({FLAG, *frame.sight.flags[single.camera][single.row].split("|")} - {""})
    return {
        "frame": frame.number,
        "particle": single.particle,
        "t_s": frame.t_s,
        **{f"{x}_mm": v for x, v in zip("xyz", point)},
        **dict(zip(COVARIANCE_MM2, covariance[np.triu_indices(3)])),
        **{f"{c}_{n}": v for c, values in per_camera.items() for n, v in zip(CENTRE_PX, values)},
        **{f"{c}_{n}": 0.0 for c in per_camera for n in ("du_px", "dv_px")},
        "d_eq_mm": single.d_eq_mm,
        "confidence": _CONFIDENCE,
        "centre": "silhouettes",
        **{f"silhouettes_{x}_mm": v for x, v in zip("xyz", point)},
        "flags": "|".join(flags),
    }


def _inside(camera: Camera, uv_px: Array, radius_px: float) -> bool:
    """Return whether an image shows a part of a disc."""
    limit = np.array(camera.image_size_px) - 1.0
    return bool(np.all((uv_px > -radius_px) & (uv_px < limit + radius_px)))


def _outline_over(sight: Sight, camera: int, uv_px: Array, radius_px: float) -> float:
    """Return the semi-axis (px) of the largest outline that covers a part of the disc, or 0."""
    long = sight.a_px[camera]
    away = np.linalg.norm(sight.centre_px[camera][:, :2] - uv_px, axis=1)
    covering = away < long + 0.5 * radius_px
    return float(np.max(long[covering], initial=0.0))
