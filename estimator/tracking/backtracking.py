"""Tracks followed back before their birth and over their gaps, by later frames.

The tracker goes forward only. Where a bubble is born hidden, or in frames with doubtful pairs, its
position is better known from later frames: it is smoothed over all frames at hand, and detections
without a track are given to it where no other explanation is nearly as likely.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.estimator.bubbles.pairing.matching import Prediction
from telerig.estimator.tracking.association.likelihoods import gate2, size_score
from telerig.estimator.tracking.association.single_camera import pair_pixels, projected, px_per_mm
from telerig.estimator.tracking.filter.rts_smoother import smooth_points
from telerig.estimator.tracking.filter.types import NO_PARTICLE, TrackerSettings
from telerig.estimator.tracking.frame_rows import Frame, Pairs, Single, readings_of
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian, triangulate

Array = NDArray[np.float64]

_LEAST_POINTS = 4
"""Points in space that a track needs to be followed."""

_PASSES = 12
_REACH_FRAMES = 4
"""Frames beyond a track's ends that one pass looks at."""

_VAGUE = 0.5
"""Largest sd of a predicted pixel, as a share of the bubble's diameter."""

_REGULARISATION = 1e-6
_CONFIDENCE = 0.95
_DOUBTFUL = "overlap|merged|border"
"""Flags of outlines of which only a part was seen."""


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
    for frame in frames:
        if frame.number in changeable:
            _reconsider(frame, sizes)
    _release_wrong(frames, changeable, sizes, cameras, settings)
    for _ in range(_PASSES):
        missing = _missing(frames, changeable, sorted(sizes))
        particles = sorted({p for found in missing for p in found})
        if not particles:
            break
        points, covariances = smooth_points(
            readings_of(frames, particles, cameras), motions, settings
        )
        place = {p: k for k, p in enumerate(particles)}
        changed = False
        for i, frame in enumerate(frames):
            at = [place[p] for p in missing[i]]
            if at:
                predicted = _prediction(missing[i], points[i, at], covariances[i, at], sizes)
                changed |= _claim(frame, predicted, cameras, settings)
        if not changed:
            break


def _prediction(
    particles: Sequence[int], points: Array, covariances: Array, sizes: dict[int, float]
) -> Prediction:
    d_eq = np.array([sizes[p] for p in particles])
    return Prediction(np.array(particles, np.int64), points, covariances, d_eq)


def _sizes(frames: Sequence[Frame]) -> dict[int, float]:
    """Median diameter (mm) of the tracks that can be followed; tracks with given ids cannot."""
    found: dict[int, list[float]] = {}
    for frame in frames:
        pairs = frame.pairs
        own = (pairs.given == NO_PARTICLE) & (pairs.particle != NO_PARTICLE)
        for particle, d_eq in zip(pairs.particle[own].tolist(), pairs.d_eq_mm[own].tolist()):
            found.setdefault(particle, []).append(d_eq)
    enough = {p: np.array(d) for p, d in found.items() if len(d) >= _LEAST_POINTS}
    known = {p: d[np.isfinite(d)] for p, d in enough.items()}
    return {p: float(np.median(d)) if len(d) else float("nan") for p, d in known.items()}


def _reconsider(frame: Frame, sizes: dict[int, float]) -> None:
    """Two cameras that each saw a particle alone may be a pair, or one of them is wrong."""
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
    """Undo pairs whose doubtful outline is where the bubble cannot be; the other view stays."""
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
        found = _without_own(frame.pairs, columns, smoothed[0][i, k], smoothed[1][i, k])
        for column, point, covariance in zip(columns, *found):
            particle, rows = int(frame.particle[column]), frame.pairs.rows[column].tolist()
            predicted = _prediction([particle], point[None], covariance[None], sizes)
            agrees = [
                _distance2(frame, [(c, rows[c])], predicted, 0, cameras) <= gate2(settings, 2)
                for c in (0, 1)
            ]
            camera = int(agrees[1])
            if agrees[0] != agrees[1] and doubt[column, 1 - camera]:
                frame.particle[column] = NO_PARTICLE
                _claim_single(frame, camera, rows[camera], predicted, 0)


def _doubtful(frame: Frame) -> NDArray[np.bool_]:
    """(M, 2) whether the outlines of each pair may be off: only a part of them was seen."""
    return np.stack(
        [
            _flagged(table["flags"].iloc[frame.pairs.rows[:, c]])
            for c, table in enumerate(frame.tables)
        ],
        -1,
    )


def _flagged(flags: pd.Series[str]) -> NDArray[np.bool_]:
    return flags.fillna("").astype(str).str.contains(_DOUBTFUL).to_numpy(bool)


def _without_own(
    pairs: Pairs, columns: Sequence[int], points: Array, covariances: Array
) -> tuple[Array, Array]:
    """The smoothed points and covariances, the frame's own measurements removed from them."""
    own, total = np.linalg.inv(pairs.covariance_mm2[columns]), np.linalg.inv(covariances)
    pull = total @ points[..., None] - own @ pairs.points_mm[columns][..., None]
    covariance = np.linalg.inv(total - own + _REGULARISATION * np.eye(3))
    return np.asarray(covariance @ pull, float)[..., 0], np.asarray(covariance, np.float64)


def _distance2(
    frame: Frame,
    seen: Sequence[tuple[int, int]],
    predicted: Prediction,
    k: int,
    cameras: tuple[Camera, Camera],
) -> float:
    """Squared Mahalanobis distance of rows (camera, row) from the k-th predicted particle."""
    views = tuple(cameras[c] for c, _ in seen)
    expected, by_point, _ = stacked_jacobian(views, predicted.points_mm[k : k + 1])
    covariance = by_point[0] @ predicted.covariance_mm2[k] @ by_point[0].T
    left = -expected[0]
    for i, (c, row) in enumerate(seen):
        at = slice(2 * i, 2 * i + 2)
        centre, noise = frame.pixels[c]
        covariance[at, at] += noise[row]
        left[at] = centre[row] - expected[0, at] - frame.offset_px[c]
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


def _claim(
    frame: Frame, predicted: Prediction, cameras: tuple[Camera, Camera], settings: TrackerSettings
) -> bool:
    """Give the frame's free detections to the predicted particles; whether any was given."""
    found = [_nearest(frame, c, predicted, cameras[c], settings) for c in (0, 1)]
    changed = False
    for k, rows in enumerate(zip(*found)):
        if max(rows) < 0:
            continue
        if min(rows) >= 0:
            changed |= _claim_pair(frame, rows, k, predicted, cameras, settings)
        else:
            camera = int(rows[0] < 0)
            _claim_single(frame, camera, rows[camera], predicted, k)
            changed = True
    return changed


def _nearest(
    frame: Frame, camera: int, predicted: Prediction, view: Camera, settings: TrackerSettings
) -> list[int]:
    """The row of each particle in one camera, -1 where there is none or not without a rival."""
    free = np.flatnonzero(frame.owners(camera) == NO_PARTICLE)
    centre, noise = (a[free] for a in frame.pixels[camera])
    expected = projected(view, predicted.points_mm, predicted.covariance_mm2)
    scale = px_per_mm(expected.by_point)
    sd2 = np.linalg.eigvalsh(expected.covariance_px2)[:, -1]
    sharp = sd2 <= (_VAGUE * scale * predicted.d_eq_mm) ** 2
    measured_mm = frame.tables[camera]["d_eq_px"].to_numpy(float)[free] / scale[:, None]
    chosen = pair_pixels(
        expected,
        centre - frame.offset_px[camera],
        noise,
        settings,
        size_score=size_score(predicted.d_eq_mm[:, None], measured_mm, settings),
        allowed=sharp[:, None],
    )
    return [int(free[j]) if j >= 0 else -1 for j in chosen]


def _claim_single(frame: Frame, camera: int, row: int, predicted: Prediction, k: int) -> None:
    particle, d_eq = int(predicted.ids[k]), float(predicted.d_eq_mm[k])
    frame.singles.append(Single(particle, camera, row, predicted.points_mm[k], d_eq))


def _claim_pair(
    frame: Frame,
    rows: tuple[int, int],
    k: int,
    predicted: Prediction,
    cameras: tuple[Camera, Camera],
    settings: TrackerSettings,
) -> bool:
    """Give the detections ``rows`` of the two cameras to the prediction of track k, if they fit.

    Where both agree with it they become one point. Else the detection whose outline is whole is
    taken alone, if only one is. Returns whether anything was taken.
    """
    if _distance2(frame, list(enumerate(rows)), predicted, k, cameras) <= gate2(settings, 4):
        uv, noise = zip(*([a[r : r + 1] for a in p] for p, r in zip(frame.pixels, rows)))
        found = triangulate(cameras, uv, noise)
        frame.claim(
            Pairs(
                np.array([rows], np.int64),
                np.array([_CONFIDENCE]),
                np.array([True]),
                np.array([NO_PARTICLE]),
                found.points_mm,
                found.covariance_mm2,
                predicted.d_eq_mm[k : k + 1],
                predicted.ids[k : k + 1],
            )
        )
        return True
    first, second = (
        bool(_flagged(t["flags"].iloc[r : r + 1])[0]) for t, r in zip(frame.tables, rows)
    )
    if first == second:
        return False
    _claim_single(frame, int(first), rows[int(first)], predicted, k)
    return True
