"""Tracks followed back before their birth and over their gaps, by what came later.

The tracker goes forward only. A bubble that is born hidden, or whose pairs were in doubt, is known
better once later frames have been seen: its place is smoothed over all frames at hand, and
detections that belong to no track are its own where nothing else explains them nearly as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.tracking.association.likelihoods import best_assignment, gate2, size_score
from telerig.estimator.tracking.association.single_camera import unrivalled
from telerig.estimator.tracking.filter.rts_smoother import smooth_points
from telerig.estimator.tracking.filter.types import NO_PARTICLE, TrackerSettings
from telerig.estimator.tracking.frame_rows import Frame, Single, readings_of
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian, triangulate

Array = NDArray[np.float64]

_LEAST_POINTS = 4
"""Points in space that a track needs to be followed."""

_PASSES = 12
_REACH_FRAMES = 4
"""Frames beyond a track's ends that one pass looks at."""

_VAGUE = 0.5
"""Largest sd of a foretold pixel, as a share of the bubble's diameter."""

_NOTHING = 1e-6
_CONFIDENCE = 0.95
_DOUBTFUL = {"overlap", "merged", "border"}


@dataclass(frozen=True)
class Foretold:
    """Where particles that a frame does not show yet should be: points (K, 3), covariances."""

    particles: Sequence[int]
    points_mm: Array
    covariance_mm2: Array
    d_eq_mm: Array


def follow_back(
    frames: Sequence[Frame],
    changeable: set[int],
    cameras: tuple[Camera, Camera],
    settings: TrackerSettings,
) -> None:
    """Give free detections of the ``changeable`` frames to the tracks that they continue.

    frames : consecutive, all settled.
    """
    motions = [f.motion for f in frames]
    sizes = _sizes(frames)
    everyone = sorted(sizes)
    for frame in frames:
        if frame.number in changeable:
            _reconsider(frame, sizes)
    _release_wrong(frames, changeable, sizes, cameras, settings)
    for _ in range(_PASSES):
        missing = _missing(frames, changeable, everyone)
        particles = sorted({p for found in missing for p in found})
        if not particles:
            break
        readings = readings_of(frames, particles, cameras)
        points, covariances = smooth_points(readings, motions, settings)
        place = {p: k for k, p in enumerate(particles)}
        changed = False
        for i, frame in enumerate(frames):
            at = [place[p] for p in missing[i]]
            if at:
                d_eq = np.array([sizes[p] for p in missing[i]])
                told = Foretold(missing[i], points[i, at], covariances[i, at], d_eq)
                changed |= _claim(frame, told, cameras, settings)
        if not changed:
            break


def _sizes(frames: Sequence[Frame]) -> dict[int, float]:
    """Median diameter (mm) of the tracks that can be followed; ids that were given are not."""
    found: dict[int, list[float]] = {}
    for frame in frames:
        own = frame.pairs.particle == NO_PARTICLE
        for column in np.flatnonzero(own & (frame.particle != NO_PARTICLE)):
            d_eq = float(frame.d_eq_mm[column])
            found.setdefault(int(frame.particle[column]), []).append(d_eq)
    enough = {p: np.array(d) for p, d in found.items() if len(d) >= _LEAST_POINTS}
    known = {p: d[np.isfinite(d)] for p, d in enough.items()}
    return {p: float(np.median(d)) if len(d) else float("nan") for p, d in known.items()}


def _reconsider(frame: Frame, sizes: dict[int, float]) -> None:
    """Two cameras that each saw a particle by itself may be a pair, or one of them is wrong."""
    for particle in {s.particle for s in frame.singles if len(frame.of(s.particle)) > 1}:
        if particle in sizes:
            frame.release(particle)


def _release_wrong(
    frames: Sequence[Frame],
    changeable: set[int],
    sizes: dict[int, float],
    cameras: tuple[Camera, Camera],
    settings: TrackerSettings,
) -> None:
    """Pairs with a doubtful outline where the bubble cannot be go on as the other one alone."""
    doubtful = [_doubtful(f) if f.number in changeable else np.zeros((0, 2), bool) for f in frames]
    ids = {int(p) for f, d in zip(frames, doubtful) for p in f.particle[: len(d)][d.any(1)]}
    place = {p: k for k, p in enumerate(sorted(ids & set(sizes)))}
    if not place:
        return
    motions = [f.motion for f in frames]
    smoothed = smooth_points(readings_of(frames, list(place), cameras), motions, settings)
    for i, (frame, doubt) in enumerate(zip(frames, doubtful)):
        columns = [int(c) for c in np.flatnonzero(doubt.any(1)) if frame.particle[c] in place]
        k = [place[int(frame.particle[c])] for c in columns]
        found = _left_out(frame, columns, smoothed[0][i, k], smoothed[1][i, k])
        for column, point, covariance in zip(columns, *found):
            particle = int(frame.particle[column])
            told = Foretold([particle], point[None], covariance[None], np.array([sizes[particle]]))
            agrees = [_agrees(frame, c, column, told, cameras[c], settings) for c in (0, 1)]
            camera = int(agrees[1])
            if agrees[0] != agrees[1] and doubt[column, 1 - camera]:
                row = int(frame.pairs.rows(camera)[column])
                frame.particle[column] = NO_PARTICLE
                _claim_single(frame, particle, camera, row, told, 0)


def _doubtful(frame: Frame) -> NDArray[np.bool_]:
    """(M, 2) whether the outlines of each pair may be off: only a part of them was seen."""
    out = [
        [bool(_DOUBTFUL & set(str(word).split("|"))) for word in table["flags"].to_numpy()[rows]]
        for table, rows in zip(frame.tables, (frame.pairs.first, frame.pairs.second))
    ]
    return np.array(out, bool).reshape(2, -1).T


def _left_out(
    frame: Frame, columns: Sequence[int], points: Array, covariances: Array
) -> tuple[Array, Array]:
    """The smoothed points and their covariances without what the frame itself says of them."""
    own = np.linalg.inv(frame.covariance_mm2[columns])
    all_of_it = np.linalg.inv(covariances)
    pull = all_of_it @ points[..., None] - own @ frame.points_mm[columns][..., None]
    covariance = np.asarray(np.linalg.inv(all_of_it - own + _NOTHING * np.eye(3)), np.float64)
    return np.asarray(covariance @ pull, float)[..., 0], covariance


def _agrees(
    frame: Frame, camera: int, column: int, told: Foretold, view: Camera, settings: TrackerSettings
) -> bool:
    """Whether a pair's outline is where the bubble is foretold; also when that is too vague."""
    row = int(frame.pairs.rows(camera)[column])
    uv, by_point, _ = stacked_jacobian((view,), told.points_mm)
    spread = by_point[0] @ told.covariance_mm2[0] @ by_point[0].T
    measured, noise = frame.pixels[camera]
    left = measured[row] - uv[0] - frame.offset_px[camera]
    return bool(left @ np.linalg.solve(spread + noise[row], left) <= gate2(settings, 2))


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


def _claim(
    frame: Frame, told: Foretold, cameras: tuple[Camera, Camera], settings: TrackerSettings
) -> bool:
    """Give the frame's free detections to the foretold particles; whether any was given."""
    found = [_nearest(frame, c, told, cameras[c], settings) for c in (0, 1)]
    changed = False
    for k, particle in enumerate(told.particles):
        rows = found[0][k], found[1][k]
        if max(rows) < 0:
            continue
        if min(rows) >= 0:
            changed |= _claim_pair(frame, rows, k, told, cameras, settings)
        else:
            camera = int(rows[0] < 0)
            _claim_single(frame, particle, camera, rows[camera], told, k)
            changed = True
    return changed


def _nearest(
    frame: Frame, camera: int, told: Foretold, view: Camera, settings: TrackerSettings
) -> list[int]:
    """The row of each particle in one camera, -1 where there is none or not without a rival."""
    free = np.flatnonzero(frame.owners(camera) == NO_PARTICLE)
    uv_px, noise = (a[free] for a in frame.pixels[camera])
    uv, by_point, _ = stacked_jacobian((view,), told.points_mm)
    uv = uv + frame.offset_px[camera]
    spread = by_point @ told.covariance_mm2 @ np.swapaxes(by_point, -1, -2)
    scale = np.linalg.det(by_point @ np.swapaxes(by_point, -1, -2)) ** 0.25
    sharp = np.linalg.eigvalsh(spread)[:, -1] <= (_VAGUE * scale * told.d_eq_mm) ** 2
    between = uv_px[None] - uv[:, None]
    covariance = spread[:, None] + noise[None]
    distance2 = np.einsum("kli,klij,klj->kl", between, np.linalg.inv(covariance), between)
    measured_mm = frame.tables[camera]["d_eq_px"].to_numpy(float)[free] / scale[:, None]
    near = (distance2 <= gate2(settings, 2)) & sharp[:, None]
    row, local = np.nonzero(near)
    certain = settings.detection_probability
    base = np.log(certain / (1 - certain) / settings.new_per_px2) - np.log(2 * np.pi)
    score = base - np.log(np.linalg.det(covariance))[row, local] / 2 - distance2[row, local] / 2
    score = score + size_score(told.d_eq_mm[row], measured_mm[row, local], settings)
    chosen = best_assignment(len(uv), row, local, score)
    safe = unrivalled(row, local, score, chosen, settings.margin_nats)
    return [int(free[j]) if ok else -1 for j, ok in zip(chosen, safe)]


def _claim_single(
    frame: Frame, particle: int, camera: int, row: int, told: Foretold, k: int
) -> None:
    frame.singles.append(Single(particle, camera, row, told.points_mm[k], float(told.d_eq_mm[k])))


def _claim_pair(
    frame: Frame,
    rows: tuple[int, int],
    k: int,
    told: Foretold,
    cameras: tuple[Camera, Camera],
    settings: TrackerSettings,
) -> bool:
    """As one point where the two agree; else the one whose outline is whole, if one is."""
    (uv, noise), particle = (
        zip(*((a[r] for a in frame.pixels[c]) for c, r in enumerate(rows))),
        told.particles[k],
    )
    expected, by_point, _ = stacked_jacobian(cameras, told.points_mm[k : k + 1])
    covariance = by_point[0] @ told.covariance_mm2[k] @ by_point[0].T
    covariance[:2, :2] += noise[0]
    covariance[2:, 2:] += noise[1]
    left = np.concatenate(uv) - expected[0] - frame.offset_px.ravel()
    if left @ np.linalg.solve(covariance, left) <= gate2(settings, 4):
        found = triangulate(cameras, (uv[0][None], uv[1][None]), (noise[0][None], noise[1][None]))
        point, covariance = found.points_mm[0], found.covariance_mm2[0]
        frame.claim(particle, rows, point, covariance, float(told.d_eq_mm[k]), _CONFIDENCE)
        return True
    doubtful = [
        _DOUBTFUL & set(str(t["flags"].iloc[r]).split("|")) for t, r in zip(frame.tables, rows)
    ]
    if bool(doubtful[0]) == bool(doubtful[1]):
        return False
    camera = int(bool(doubtful[0]))
    _claim_single(frame, particle, camera, rows[camera], told, k)
    return True
