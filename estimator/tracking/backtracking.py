"""What smoothed tracks add to frames whose ids are final.

The tracker goes forward only. Where a bubble is born hidden, or in frames with doubtful pairs, its
position is better known from later frames: it is smoothed over all frames at hand, and detections
without a track are given to it where no other explanation is nearly as likely (`follow_back`).

One outline in one image may show two bubbles which another image separates. One camera alone sees
the hidden bubble; its depth in that camera follows from the motion between the frames in which more
saw it (`shared_rows`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools, Ints, Rows
from telerig.estimator.bubbles.pairing.evidence import Prediction, gate2
from telerig.estimator.bubbles.pairing.groups import Candidates
from telerig.estimator.bubbles.shape.body import Bodies
from telerig.estimator.tracking.association import clear_assignment, gated_pairs
from telerig.estimator.tracking.filter import (
    NO_PARTICLE,
    POSITION,
    Common,
    FrameMeasurements,
    Motion,
    TrackerSettings,
    birth_covariance,
)
from telerig.rig.camera import Camera
from telerig.rig.triangulation import UNKNOWN_MM, stacked_jacobian

Tables = tuple["pd.DataFrame", ...]
"""One frame's detections in each camera."""

COVARIANCE_MM2 = ["sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2"]
CENTRE_PX = ["u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"]


@dataclass(frozen=True)
class Bubbles(Rows):
    """M bubbles of one frame, each of which at least one camera sees.

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

    @staticmethod
    def on_rays(sight: Sight, offset_px: Array) -> Bubbles:
        """Return the detections of a frame, camera by camera, each as a bubble that no other camera
        sees: a point of unknown depth.

        offset_px : (C, 2) shift of all detections of each camera.
        """
        found = [(x - by @ off, p, by) for (x, p, by), off in zip(sight.candidates.rays, offset_px)]
        points, covariances, by_pixel = map(np.concatenate, zip(*found))
        mm_per_px = np.linalg.det(by_pixel.mT @ by_pixel) ** 0.25
        many = [len(ids) for ids in sight.given]
        rows = np.full((sum(many), len(many)), -1)
        at = np.arange(len(rows)), np.repeat(np.arange(len(many)), many)
        rows[at] = np.concatenate([np.arange(n) for n in many])
        sizes = Bodies.sized(np.concatenate(sight.d_eq_px) * mm_per_px, len(many))
        return Bubbles(
            rows, np.ones(len(rows)), np.zeros(len(rows), bool), np.concatenate(sight.given),
            points, covariances, sizes, np.full(len(rows), NO_PARTICLE),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def d_eq_mm(self) -> Array:
        """Equivalent diameters (M,), NaN where unknown."""
        return self.bodies.d_eq_mm

    @property
    def alone(self) -> Bools:
        """Whether one camera alone sees the bubble (M,)."""
        return np.asarray((self.rows >= 0).sum(1) < 2)


@dataclass(frozen=True)
class Sight:
    """Hold the detections of one frame as arrays; tuples have an entry for each camera.

    centre_px : (N, 5) the columns CENTRE_PX, with the share of the unknown shape.
    a_px, d_eq_px : (N,) major semi-axes and equivalent diameters.
    given : (N,) ids given by the user, -1 for none.
    flags : (N,) texts.
    possible : the groups with given ids, then those of `candidates`, in space.
    left_px : (E, C, 2) pixels less those of the points; NaN where a camera does not see it.
    """

    centre_px: tuple[Array, ...]
    a_px: tuple[Array, ...]
    d_eq_px: tuple[Array, ...]
    given: tuple[Ints, ...]
    flags: tuple[list[str], ...]
    candidates: Candidates
    possible: Bubbles
    left_px: Array

    @property
    def starts(self) -> Ints:
        """Where the rays of each camera begin among those of all (C,)."""
        many = [len(ids) for ids in self.given]
        return np.asarray(np.cumsum(many) - many)


@dataclass
class Frame:
    """One frame of a run while its tracks may still change.

    tables : its detections in each camera.
    sight : the same as arrays.
    offset_px : (C, 2) for each camera the shift of all detections, because the cameras shake.
    rays : each detection by itself, as `Bubbles.on_rays` returns them.
    bubbles : those that several cameras see, and those that one camera alone sees.
    motion : motion of all bubbles since the frame before; None for the first frame.
    """

    number: int
    t_s: float
    tables: Tables
    sight: Sight
    offset_px: Array
    rays: Bubbles
    bubbles: Bubbles
    motion: Motion | None

    @property
    def particle(self) -> Ints:
        """The ids (M,) of the tracks of M bubbles, -1 for none."""
        return self.bubbles.particle

    def owners(self) -> Ints:
        """Return the id (N,) of the track of each detection in ``rays``, -1 for none."""
        out = self.rays.given.copy()
        rows = self.bubbles.rows + self.sight.starts
        taken = (self.bubbles.rows >= 0) & (self.particle != NO_PARTICLE)[:, None]
        out[rows[taken]] = np.repeat(self.particle, taken.sum(1))
        return out

    def claim(self, one: Bubbles) -> None:
        """Add one bubble with its track. Earlier ones with one of its detections are removed."""
        same = (self.bubbles.rows == one.rows) & (one.rows >= 0)
        known = (self.bubbles.rows == one.rows).all(1)
        if known.any():
            self.particle[known] = one.particle
        else:
            self.bubbles = Bubbles.concat([self.bubbles.take(~same.any(1)), one])


def fused(points_mm: Array, covariance_mm2: Array) -> tuple[Array, Array, float]:
    """Return the most likely point (3,) of n measurements (n, 3), its covariance, and the sum of
    their squared Mahalanobis distances from it."""
    information = np.linalg.inv(covariance_mm2)
    covariance = np.linalg.inv(information.sum(0))
    point = covariance @ np.einsum("nij,nj->i", information, points_mm)
    left = points_mm - point
    return point, covariance, float(np.einsum("ni,nij,nj->", left, information, left))


def smooth_points(
    points_mm: Array,
    covariance_mm2: Array,
    motions: Sequence[Motion | None],
    settings: TrackerSettings,
) -> tuple[Array, Array]:
    """Return the smoothed points (F, K, 3) in mm in the rig frame, and covariances (F, K, 3, 3).

    points_mm, covariance_mm2 : (F, K, 3), (F, K, 3, 3) measured; NaN where a bubble was not.
    motions : motion of the bubbles from the frame before into each frame; the first is not used.
    """
    from telerig.estimator.tracking import kernels

    prior = birth_covariance(settings, UNKNOWN_MM**2 * np.eye(3), encoder=False)
    x = np.zeros((points_mm.shape[1], len(prior)))
    seen = np.isfinite(points_mm[..., :1])
    weight = np.linalg.inv(np.where(seen[..., None], covariance_mm2, np.eye(3))) * seen[..., None]
    pull = (weight @ np.where(seen, points_mm, 0.0)[..., None])[..., 0].sum(0)
    total = weight.sum(0) + 1e-9 * np.eye(3)
    x[:, POSITION] = np.linalg.solve(total, pull[..., None])[..., 0]
    still = Motion(np.eye(len(prior)), np.zeros_like(prior), np.zeros(len(prior)))
    steps = [still, *(m for m in motions[1:] if m is not None)]
    assert len(steps) == max(len(motions), 1), "only the first frame has no motion into it"
    matrices, noises, offsets = (
        np.array([getattr(step, field.name) for step in steps]) for field in fields(Motion)
    )
    return kernels.smooth(points_mm, covariance_mm2, matrices, noises, offsets, x, prior)


def readings_of(frames: Sequence[Frame], particles: Sequence[int]) -> tuple[Array, Array]:
    """Return the measurements of K tracks in F frames, as `smooth_points` takes them."""
    points = np.full((len(frames), len(particles), 3), np.nan)
    covariances = np.full((*points.shape, 3), np.nan)
    for i, frame in enumerate(frames):
        _, mine, at = np.intersect1d(particles, frame.particle, return_indices=True)
        points[i, mine] = frame.bubbles.points_mm[at]
        covariances[i, mine] = frame.bubbles.covariance_mm2[at]
    return points, covariances


_LEAST_POINTS = 4
"""Points in space that a track needs to be followed."""

_PASSES = 12
"""Largest number of times that tracks are smoothed and get detections."""

_REACH_FRAMES = 4
"""Frames beyond a track's ends that one pass looks at."""

_VAGUE = 0.5
"""Largest sd of a prediction across a line of sight, as a share of the bubble's diameter."""

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
            motions = [f.motion for f in self.frames]
            found = smooth_points(*readings_of(self.frames, new), motions, self.settings)
            self._known |= zip(new, zip(*(np.swapaxes(values, 0, 1) for values in found)))

    def forget(self, particles: Iterable[int]) -> None:
        """Drop the results of tracks whose measurements have changed."""
        for particle in particles:
            del self._known[particle]


def follow_back(tracks: SmoothedTracks, changeable: set[int]) -> None:
    """Give detections without a track to the tracks that they continue.

    changeable : numbers of the frames in which tracks may still change.
    """
    frames = tracks.frames
    sizes = _sizes(frames, _LEAST_POINTS)
    for _ in range(_PASSES):
        missing = [
            (i, here)
            for i, here in enumerate(_missing(frames, changeable, sorted(sizes)))
            if here and (frames[i].owners() == NO_PARTICLE).any()
        ]
        if not missing:
            break
        tracks.prepare(chain.from_iterable(here for _, here in missing))
        changed = set()
        for i, here in missing:
            d_eq = np.array([sizes[p] for p in here])
            predicted = Prediction(np.array(here), *tracks.at(i, here), d_eq)
            found = _nearest(frames[i], predicted, tracks.cameras, tracks.settings)
            changed |= {
                here[k]
                for k, rays in enumerate(found)
                if _claim(frames[i], rays[rays >= 0], predicted.take([k]))
            }
        if not changed:
            break
        tracks.forget(changed)


def _sizes(frames: Sequence[Frame], least: int) -> dict[int, float]:
    """Median diameters (mm) of the tracks with so many points in space and no given id."""
    found: dict[int, list[float]] = {}
    for frame in frames:
        here = frame.bubbles
        own = (here.given == NO_PARTICLE) & (here.particle != NO_PARTICLE) & ~here.alone
        for particle, d_eq in zip(here.particle[own].tolist(), here.d_eq_mm[own].tolist()):
            found.setdefault(particle, []).append(d_eq)
    enough = {p: np.array(d) for p, d in found.items() if len(d) >= least}
    known = {p: d[np.isfinite(d)] for p, d in enough.items()}
    return {p: float(np.median(d)) if len(d) else float("nan") for p, d in known.items()}


def _missing(
    frames: Sequence[Frame], changeable: set[int], particles: Sequence[int]
) -> list[list[int]]:
    """Per frame the particles that it lacks, in the gaps of their tracks and a little beyond."""
    seen = np.zeros((len(frames), len(particles)), bool)
    for i, frame in enumerate(frames):
        seen[i] = np.isin(particles, frame.particle)
    first, last = seen.argmax(0), len(seen) - 1 - seen[::-1].argmax(0)
    index = np.arange(len(frames))[:, None]
    reach = (index >= first - _REACH_FRAMES) & (index <= last + _REACH_FRAMES)
    wanted = ~seen & reach & np.array([f.number in changeable for f in frames])[:, None]
    return [[particles[k] for k in np.flatnonzero(row).tolist()] for row in wanted]


def _nearest(
    frame: Frame, predicted: Prediction, cameras: Sequence[Camera], settings: TrackerSettings
) -> Ints:
    """Return which of the frame's rays each of K particles has in each camera (K, C): free ones,
    and -1 where there is none or not without a rival."""
    free, out = frame.owners() == NO_PARTICLE, []
    for c, camera in enumerate(cameras):
        mine = np.flatnonzero(free & (frame.rays.rows[:, c] >= 0))
        there = frame.rays.take(mine)
        across = camera.camera_from_rig.rotation[:2]
        spread = np.linalg.eigvalsh(across @ predicted.covariance_mm2 @ across.T)[:, -1]
        sharp = spread <= (_VAGUE * predicted.d_eq_mm) ** 2
        measured = FrameMeasurements.create(
            there.points_mm, there.covariance_mm2, d_eq_mm=there.d_eq_mm
        )
        allowed = np.tile(sharp[:, None], (1, len(mine)))
        pairs = gated_pairs(predicted, measured, allowed, Common(), settings)
        chosen, clear = clear_assignment(pairs, len(sharp), np.zeros(3), settings)
        out.append(np.append(mine, -1)[np.where(clear, chosen, -1)])
    return np.stack(out, -1)


def _claim(frame: Frame, rays: Ints, predicted: Prediction) -> bool:
    """Give detections of several cameras to a predicted particle, where they agree with it.

    rays : (n,) indices of the frame's rays. If they do not agree, those whose outlines are whole
    are tried. Returns whether any were taken.
    """
    each = frame.rays.take(rays)
    members = [np.concatenate([getattr(one, name) for one in (predicted, each)])
               for name in ("points_mm", "covariance_mm2")]  # fmt: skip
    if len(rays) and fused(*members)[2] <= gate2(2 * len(rays)):
        point, covariance, _ = fused(each.points_mm, each.covariance_mm2)
        frame.claim(
            Bubbles(
                each.rows.max(0)[None], np.array([_CONFIDENCE]), np.array([True]),
                np.array([NO_PARTICLE]), point[None], covariance[None],
                Bodies.sized(predicted.d_eq_mm, each.rows.shape[1]), predicted.ids,
            )
        )  # fmt: skip
        return True
    flags = np.concatenate([np.array(own, object) for own in frame.sight.flags])[rays]
    whole = np.array([not _DOUBTFUL & set(text.split("|")) for text in flags], bool)
    if whole.all() or not whole.any():
        return False
    return _claim(frame, rays[whole], predicted)


FRAMES_BEFORE, FRAMES_AFTER = 15, 40
"""Frames around a hidden one by which its position is smoothed."""

FLAG = "shared"
_SHARPNESS, _SHARPNESS_PX = 0.1, 3.0
"""Largest sd of a hidden centre, as a share of the bubble's diameter and in px."""

_APART = 0.5
"""Least distance of two bubbles' centres, as a share of their distance when they touch."""

_BEHIND = 0.25
"""Standard deviation of a pixel "behind that outline", as a share of the outline's semi-axis."""


@dataclass(frozen=True)
class Hidden:
    """A bubble that one camera alone sees, as its smoothed track tells of it.

    bubble : its index in the frame. d_eq_mm : its diameter.
    point_mm, covariance_mm2 : (3,), (3, 3) position.
    uv_px, covariance_px2, px_per_mm : (C, 2), (C, 2, 2), (C,) the same in each camera, and scales.
    """

    bubble: int
    d_eq_mm: float
    point_mm: Array
    covariance_mm2: Array
    uv_px: Array
    covariance_px2: Array
    px_per_mm: Array


def shared_rows(tracks: SmoothedTracks, frames: slice) -> list[dict[str, Any]]:
    """Return rows for the hidden bubbles of some frames; the other frames are context.

    A hidden view's pixel is that of the point; its covariance states only that the bubble is
    behind that outline, so that motion is not counted twice when tracks are smoothed.
    """
    sizes, out = _sizes(tracks.frames, 1), []
    for i, frame in list(enumerate(tracks.frames))[frames]:
        known = frame.particle != NO_PARTICLE
        mine = [k for k in np.flatnonzero(known & frame.bubbles.alone).tolist()
                if int(frame.particle[k]) in sizes]  # fmt: skip
        if not mine:
            continue
        ids = frame.particle[mine].tolist()
        tracks.prepare(ids)
        points, covariances = tracks.at(i, ids)
        uv, by_point = stacked_jacobian(tracks.cameras, points)
        uv, by_point = (a.reshape(len(mine), len(tracks.cameras), 2, -1) for a in (uv, by_point))
        spread = by_point @ covariances[:, None] @ by_point.mT
        scale = np.linalg.det(by_point @ by_point.mT) ** 0.25
        here = frame.bubbles.take(known & ~frame.bubbles.alone)
        where, wide = [*here.points_mm], here.d_eq_mm.tolist()
        for k in np.argsort(np.trace(covariances, axis1=1, axis2=2)).tolist():
            one = Hidden(
                mine[k], sizes[ids[k]], points[k], covariances[k], uv[k, ..., 0], spread[k],
                scale[k],
            )  # fmt: skip
            row = _row(frame, one, tracks.cameras)
            if row is not None and not _taken(one, where, wide):
                out.append(row)
                where.append(one.point_mm)
                wide.append(one.d_eq_mm)
    return out


def _taken(one: Hidden, others_mm: Sequence[Array], sizes_mm: Sequence[float]) -> bool:
    """Whether another track's bubble occupies the place of this one."""
    away = np.linalg.norm(np.reshape(others_mm, (-1, 3)) - one.point_mm, axis=1)
    return bool((away < _APART * (np.array(sizes_mm) + one.d_eq_mm) / 2).any())


def _row(frame: Frame, one: Hidden, cameras: Sequence[Camera]) -> dict[str, Any] | None:
    """None where the point is too uncertain, or a camera's image does not explain why it is not
    seen there: neither an outline of another bubble nor the image's border."""
    per_camera, rows, flags = {}, frame.bubbles.rows[one.bubble], {FLAG}
    for c, camera in enumerate(cameras):
        if rows[c] >= 0:
            per_camera[camera.name] = frame.sight.centre_px[c][rows[c]].tolist()
            flags |= {*frame.sight.flags[c][rows[c]].split("|")} - {""}
            continue
        uv, spread = one.uv_px[c] + frame.offset_px[c], one.covariance_px2[c]
        diameter = one.d_eq_mm * one.px_per_mm[c]
        sd = float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
        reach = _outline_over(frame.sight, c, uv, diameter / 2)
        if sd <= min(_SHARPNESS * diameter, _SHARPNESS_PX) and reach > 0:
            behind = spread + (_BEHIND * reach) ** 2 * np.eye(2)
            per_camera[camera.name] = [*uv, behind[0, 0], behind[0, 1], behind[1, 1]]
        elif _inside(camera, uv, diameter / 2):
            return None
    if len(per_camera) < 2:
        return None
    return {
        "frame": frame.number,
        "particle": int(frame.particle[one.bubble]),
        "t_s": frame.t_s,
        **{f"{x}_mm": v for x, v in zip("xyz", one.point_mm)},
        **dict(zip(COVARIANCE_MM2, one.covariance_mm2[np.triu_indices(3)])),
        **{f"{c}_{n}": v for c, values in per_camera.items() for n, v in zip(CENTRE_PX, values)},
        **{f"{c}_{n}": 0.0 for c in per_camera for n in ("du_px", "dv_px")},
        "d_eq_mm": one.d_eq_mm,
        "confidence": _CONFIDENCE,
        "centre": "silhouettes",
        **{f"silhouettes_{x}_mm": v for x, v in zip("xyz", one.point_mm)},
        "flags": "|".join(sorted(flags)),
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
