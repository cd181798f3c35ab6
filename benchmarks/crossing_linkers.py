"""The trackers under comparison, all on the same detections: ids per frame out."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pandas as pd
from crossing_scenes import Scene
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from telerig.estimator.tracking.linking.filter import TrackerSettings
from telerig.estimator.tracking.linking.frames import NO_PARTICLE, Bubbles
from telerig.estimator.tracking.linking.tracker import Tracker

Ids = list[NDArray[np.int64]]
Linker = Callable[[Scene], Ids]


def telerig(settings: TrackerSettings | None = None, *, encoder: bool = True) -> Linker:
    def link(scene: Scene) -> Ids:
        tracker = Tracker(settings=settings)
        settled = []
        for i, (t, points) in enumerate(zip(scene.t_s, scene.points_mm)):
            many = len(points)
            both, none = np.zeros((many, 2), np.int64), np.full(many, NO_PARTICLE)
            covariance = np.broadcast_to(scene.covariance_mm2, (many, 3, 3))
            measured = Bubbles.of(both, points, covariance, none, np.full(many, np.nan))
            read = float(scene.position_mm[i]) if encoder else None
            settled += tracker.update(i, float(t), measured, read).final
        last = tracker.finish()
        settled += last.final if last is not None else ()
        return [ids.particle for ids in settled]

    return link


def table(scene: Scene) -> pd.DataFrame:
    frame = np.repeat(np.arange(len(scene.t_s)), [len(p) for p in scene.points_mm])
    out = pd.DataFrame(np.vstack(scene.points_mm), columns=["x", "y", "z"])
    return out.assign(frame=frame)


def _ids(found: pd.DataFrame, column: str, scene: Scene) -> Ids:
    ordered = found.sort_index()
    groups = np.split(
        ordered[column].to_numpy(np.int64), np.cumsum([len(p) for p in scene.points_mm])[:-1]
    )
    return list(groups)


def reach_mm(scene: Scene) -> float:
    """What a bubble (250 mm/s sideways) and the shake can move in a frame."""
    return 0.3 + 250.0 * float(np.diff(scene.t_s).mean())


def trackpy_link(scene: Scene, *, velocity: bool = False, memory: int = 3) -> Ids:
    import trackpy

    trackpy.quiet()
    linker = trackpy.predict.NearestVelocityPredict().link_df if velocity else trackpy.link
    found = table(scene)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if velocity:
            frames = [g for _, g in found.groupby("frame")]
            parts = trackpy.predict.NearestVelocityPredict().link_df_iter(
                frames, reach_mm(scene), memory=memory, pos_columns=["x", "y", "z"]
            )
            linked = pd.concat(parts)
        else:
            linked = linker(found, reach_mm(scene), memory=memory, pos_columns=["x", "y", "z"])
    return _ids(linked, "particle", scene)


def laptrack_link(scene: Scene) -> Ids:
    from laptrack import LapTrack

    cutoff = reach_mm(scene) ** 2
    tracker = LapTrack(cutoff=cutoff, gap_closing_cutoff=4 * cutoff, gap_closing_max_frame_count=3)
    found = table(scene)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        linked, *_ = tracker.predict_dataframe(
            found.assign(row=found.index), ["x", "y", "z"], frame_col="frame"
        )
    return _ids(linked.set_index("row"), "track_id", scene)


def plain_prediction(scene: Scene) -> Ids:
    """Constant velocity from the last two positions, best assignment of distances; 3 frames."""
    reach, live, out, fresh = reach_mm(scene), [], [], 0
    for i, points in enumerate(scene.points_mm):
        ids = np.full(len(points), -1)
        guess = np.array([p + v * (i - f) for _, p, v, f in live]).reshape(-1, 3)
        away = np.linalg.norm(guess[:, None] - points[None], axis=-1)
        rows, columns = linear_sum_assignment(np.minimum(away, 10 * reach))
        for r, c in zip(rows, columns):
            if away[r, c] <= reach:
                key, p, _, f = live[r]
                live[r] = (key, points[c], (points[c] - p) / (i - f), i)
                ids[c] = key
        for c in np.flatnonzero(ids < 0):
            live.append((fresh, points[c], np.zeros(3), i))
            ids[c], fresh = fresh, fresh + 1
        live = [t for t in live if i - t[3] <= 3]
        out.append(ids)
    return out
