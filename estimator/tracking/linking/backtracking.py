"""What smoothed tracks add to frames whose ids are final.

The tracker goes forward only. Where a bubble is born hidden, or in frames with doubtful pairs, its
position is better known from later frames: it is smoothed over all frames at hand, and detections
without a track are given to it where no other explanation is nearly as likely, by the evidence of
the tracker (`follow_back`).

One outline in one image may show two bubbles which another image separates. One camera alone sees
the hidden bubble; its depth in that camera follows from the motion between the frames in which more
saw it (`place_hidden`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import chain

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.bubbles.pairing.evidence import Prediction, gate2
from telerig.estimator.bubbles.shape.body import Bodies
from telerig.estimator.tracking.linking.association import clear_assignment, gated_pairs
from telerig.estimator.tracking.linking.filter import (
    POSITION,
    Common,
    TrackerSettings,
    birth_covariance,
)
from telerig.estimator.tracking.linking.frames import NO_PARTICLE, Bubbles, Frame, Motion, Seen
from telerig.rig.camera import Camera
from telerig.rig.triangulation import UNKNOWN_MM, stacked_jacobian


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
    from telerig.estimator.tracking.linking import kernels

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
    """Return the measurements of K ascending tracks in F frames, as `smooth_points` takes them."""
    points = np.full((len(frames), len(particles), 3), np.nan)
    covariances = np.full((*points.shape, 3), np.nan)
    frame, track, at = _bubbles_of(frames, particles)
    points[frame, track] = np.concatenate([f.bubbles.points_mm for f in frames])[at]
    covariances[frame, track] = np.concatenate([f.bubbles.covariance_mm2 for f in frames])[at]
    return points, covariances


def _bubbles_of(frames: Sequence[Frame], particles: Sequence[int]) -> tuple[Ints, Ints, Ints]:
    """Return the bubbles (N,) of K tracks (ascending): frame, track, place among all bubbles."""
    ids = np.concatenate([frame.particle for frame in frames])
    track = np.searchsorted(particles, ids)
    at = np.flatnonzero(np.append(particles, NO_PARTICLE - 1)[track] == ids)
    frame = np.repeat(np.arange(len(frames)), [len(frame.particle) for frame in frames])
    return frame[at], track[at], at


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
    changed, filled = set(sizes), set[int]()
    for _ in range(_PASSES):
        missing = [
            (i, here)
            for i, here in enumerate(_missing(frames, changeable, sorted(sizes)))
            if (i in filled or not changed.isdisjoint(here))  # in others nothing is new
            and here
            and (frames[i].owners() == NO_PARTICLE).any()
        ]
        if not missing:
            break
        tracks.prepare(chain.from_iterable(here for _, here in missing))
        changed, filled = set(), set()
        for i, here in missing:
            d_eq = np.array([sizes[p] for p in here])
            predicted = Prediction(np.array(here), *tracks.at(i, here), d_eq)
            found = _nearest(frames[i], predicted, tracks.cameras, tracks.settings)
            taken = {
                here[k]
                for k in np.flatnonzero((found >= 0).any(1)).tolist()
                if _claim(frames[i], found[k][found[k] >= 0], predicted.take([k]))
            }
            changed |= taken
            filled |= {i} if taken else set()
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
    seen[_bubbles_of(frames, particles)[:2]] = True
    first, last = seen.argmax(0), len(seen) - 1 - seen[::-1].argmax(0)
    index = np.arange(len(frames))[:, None]
    reach = (index >= first - _REACH_FRAMES) & (index <= last + _REACH_FRAMES)
    wanted = ~seen & reach & np.array([f.number in changeable for f in frames])[:, None]
    return [[particles[k] for k in np.flatnonzero(row).tolist()] for row in wanted]


def _nearest(
    frame: Frame, predicted: Prediction, cameras: Sequence[Camera], settings: TrackerSettings
) -> Ints:
    """Return which detection each of K particles has in each camera (K, C): free ones, and -1 where
    there is none or not without a rival."""
    free = np.flatnonzero(frame.owners() == NO_PARTICLE)
    there, many = frame.rays.take(free), len(cameras)
    each = predicted.take(np.repeat(np.arange(len(predicted.ids)), many))
    of_camera = np.tile(np.arange(many), len(predicted.ids))
    across = np.array([camera.camera_from_rig.rotation[:2] for camera in cameras])[of_camera]
    spread = np.linalg.eigvalsh(across @ each.covariance_mm2 @ across.mT)[:, -1]
    sharp = spread <= (_VAGUE * each.d_eq_mm) ** 2
    allowed = sharp[:, None] & (there.rows[:, of_camera] >= 0).T
    pairs = gated_pairs(each, there, allowed, Common(), settings)
    chosen, clear = clear_assignment(pairs, len(sharp), np.zeros(3), settings)
    return np.append(free, -1)[np.where(clear, chosen, -1)].reshape(-1, many)


def _claim(frame: Frame, rays: Ints, predicted: Prediction) -> bool:
    """Give detections of several cameras to a predicted particle, where they agree with it.

    rays : (n,) the detections. If they do not agree, those whose outlines are whole are tried.
    Returns whether any were taken.
    """
    each = frame.rays.take(rays)
    members = [np.concatenate([getattr(one, name) for one in (predicted, each)])
               for name in ("points_mm", "covariance_mm2")]  # fmt: skip
    if len(rays) and fused(*members)[2] <= gate2(2 * len(rays)):
        point, covariance, _ = fused(each.points_mm, each.covariance_mm2)
        none, rows = np.array([NO_PARTICLE]), each.rows.max(0)[None]
        one = Bubbles.of(rows, point[None], covariance[None], none, predicted.d_eq_mm)
        sure, unsure = np.array([_CONFIDENCE]), np.array([True])
        frame.claim(replace(one, confidence=sure, ambiguous=unsure, particle=predicted.ids))
        return True
    whole = frame.seen.sightings.entire[rays]
    if whole.all() or not whole.any():
        return False
    return _claim(frame, rays[whole], predicted)


FRAMES_BEFORE, FRAMES_AFTER = 15, 40
"""Frames around a hidden one by which its position is smoothed."""

_SHARPNESS, _SHARPNESS_PX = 0.1, 3.0
"""Largest sd of a hidden centre, as a share of the bubble's diameter and in px."""

_APART = 0.5
"""Least distance of two bubbles' centres, as a share of their distance when they touch."""

_BEHIND = 0.25
"""Standard deviation of a pixel "behind that outline", as a share of the outline's semi-axis."""


def place_hidden(tracks: SmoothedTracks, frames: slice) -> None:
    """Give the hidden bubbles of some frames their places; the other frames are context.

    A hidden view's pixel is that of the point; its covariance states only that the bubble is
    behind that outline, so that motion is not counted twice when tracks are smoothed.
    """
    sizes = _sizes(tracks.frames, 1)
    lonely = [
        (i, frame, np.array([k for k in np.flatnonzero(frame.bubbles.alone)
                             if int(frame.particle[k]) in sizes], np.int64))
        for i, frame in list(enumerate(tracks.frames))[frames]
    ]  # fmt: skip
    tracks.prepare(chain.from_iterable(frame.particle[own].tolist() for _, frame, own in lonely))
    for i, frame, own in lonely:
        if len(own):
            ids = frame.particle[own]
            d_eq = np.array([sizes[p] for p in ids.tolist()])
            one = Prediction(ids, *tracks.at(i, ids.tolist()), d_eq)
            _place(frame, own, one, tracks.cameras)


def _place(frame: Frame, own: Ints, smoothed: Prediction, cameras: Sequence[Camera]) -> None:
    """Write the places of hidden bubbles (K,) of a frame, unless another track's bubble is there.

    A point must be certain, and an outline in front must explain why a camera does not show it, or
    the image's border.
    """
    bubbles, (shape, size_mm) = frame.bubbles, ((len(own), len(cameras)), smoothed.d_eq_mm)
    uv, by_point = stacked_jacobian(tuple(cameras), smoothed.points_mm)
    uv, by_point = uv.reshape(*shape, 2) + frame.offset_px, by_point.reshape(*shape, 2, 3)
    spread = by_point @ smoothed.covariance_mm2[:, None] @ by_point.mT
    diameter = size_mm[:, None] * np.linalg.det(by_point @ by_point.mT) ** 0.25
    sharp = np.minimum(_SHARPNESS * diameter, _SHARPNESS_PX)
    reach, seen = _outline_over(frame.seen, uv, diameter / 2), bubbles.rows[own] >= 0
    covered = (np.linalg.eigvalsh(spread)[..., -1] <= sharp**2) & (reach > 0) & ~seen
    radius = diameter[..., None] / 2
    limit = np.array([camera.image_size_px for camera in cameras]) - 1.0
    inside = ((uv > -radius) & (uv < limit + radius)).all(-1)
    good = ((seen | covered).sum(1) > 1) & (seen | covered | ~inside).all(1)
    if not good.any():
        return
    beside = bubbles.take((frame.particle != NO_PARTICLE) & ~bubbles.alone)
    points, sizes = [*beside.points_mm], beside.d_eq_mm.tolist()
    for k in np.argsort(np.trace(smoothed.covariance_mm2, axis1=1, axis2=2)).tolist():
        away = np.linalg.norm(np.reshape(points, (-1, 3)) - smoothed.points_mm[k], axis=1)
        good[k] &= not (away < _APART * (np.array(sizes) + size_mm[k]) / 2).any()
        if good[k]:
            points.append(smoothed.points_mm[k])
            sizes.append(float(size_mm[k]))
    behind = spread + (_BEHIND * reach)[..., None, None] ** 2 * np.eye(2)
    hidden = np.concatenate([uv, behind[..., *np.triu_indices(2)]], -1)
    bubbles.hidden_px[own[good]] = np.where(covered[..., None], hidden, np.nan)[good]
    bubbles.confidence[own[good]], bubbles.ambiguous[own[good]] = _CONFIDENCE, False
    unknown = frame.seen.unknown_px2[bubbles.rows[own]] * seen
    placed = replace(
        Bodies.none(*shape), d_eq_mm=size_mm, points_mm=smoothed.points_mm,
        covariance_mm2=smoothed.covariance_mm2, silhouette_points_mm=smoothed.points_mm,
        shift_covariance_px2=unknown[..., None, None] * np.eye(2),
        used=np.full(len(own), "silhouettes"),
    )  # fmt: skip
    bubbles.body[own[good]] = len(frame.bodies) + np.arange(good.sum())
    frame.bodies = Bodies.concat([frame.bodies, placed.take(good)])


def _outline_over(seen: Seen, uv_px: Array, radius_px: Array) -> Array:
    """Return the semi-axis (K, C) in px of the largest outline of each camera that covers a part of
    a disc there, or 0. uv_px, radius_px : (K, C, 2), (K, C)."""
    at, camera = uv_px[:, seen.sightings.camera], seen.sightings.camera
    away = np.linalg.norm(seen.centre_px[:, :2] - at, axis=-1)
    covering = np.where(away < seen.a_px + 0.5 * radius_px[:, camera], seen.a_px, 0.0)
    own = camera == np.arange(uv_px.shape[1])[:, None]
    return np.asarray((covering[:, None] * own).max(-1, initial=0.0))
