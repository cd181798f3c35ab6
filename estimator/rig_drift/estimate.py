"""Estimates from the tracks of a run how a camera has moved, and whether two expose together.

Beside the movement it is estimated how much later than the first camera the second one exposes: its
pixels are then ahead by their speed times the delay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.rig_drift.change import LATE_SIGMAS, RigChange, rig_change_from
from telerig.estimator.rig_drift.movement import (
    DriftPrior,
    Movement,
    covariance_root,
    drift_posterior,
    p_value_of,
    rig_block,
    with_drift,
)
from telerig.estimator.rig_drift.noise import Noise, Series, information, learned_noise
from telerig.estimator.rig_drift.ray_misses import ray_misses
from telerig.rig.triangulation import midpoint, nearly_parallel
from telerig.statistics import robust_sd

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.calibration.result.calibration import Calibration


_LATE_S = 0.01
"""Prior standard deviation of the delay."""

LEAST_PAIRS = 20
LEAST_SEEN_S = 0.5
"""Least total duration of all tracks for a verdict. In a shorter time, wander of the outlines'
centres cannot be distinguished from a movement."""

_LEAST_CONFIDENCE = 0.9
_DOUBTFUL = "shared|ambiguous|merged|border"
_FAR_SIGMAS = 6.0
_OUTLIER_SIGMAS = 4.5
_LEAST = 4
"""With fewer frames in a run, or fewer pairs in a stretch, nothing is estimated."""
_MOST_COLLECTED = 100_000
_MOST_ROWS = 520
_MOST_STRETCHES = 10
_STRETCH_S = 2.0
_LEARNED_FROM = 2
_PASSES = 3
_SHAPE_PX = 0.02
"""Standard deviation of the constant error of each bubble's centre in each view that its outline
does not reveal."""


class PairCollector:
    """Collects the reliable pairs of a run while it is tracked, and estimates a movement.

    Of a long run it keeps the pairs of every second, fourth, ... frame, since `stretches` use no
    more than some thousand of all.
    """

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.parts: list[pd.DataFrame] = []
        self.every, self.first = 1, 0

    def add(self, tracks: pd.DataFrame) -> None:
        """Add the reliable pairs of a part of the tracks."""
        import pandas as pd

        cameras = [c.name for c in self.calibration.cameras]
        names = pair_columns(cameras) + _speed_columns(cameras)
        moving = with_speeds(tracks, cameras)
        found = moving.loc[_reliable(tracks), [n for n in names if n in moving]]
        if not self.parts and len(found):
            self.first = int(found["frame"].iloc[0])
        self.parts.append(self._thinned(found))
        if sum(map(len, self.parts)) > _MOST_COLLECTED:
            self.every *= 2
            self.parts = [self._thinned(pd.concat(self.parts, ignore_index=True))]

    def _thinned(self, pairs: pd.DataFrame) -> pd.DataFrame:
        return pairs[(pairs["frame"] - self.first) % self.every == 0]

    def found(self) -> RigChange | None:
        """Return the movement that all collected rows give, or None if there are too few.

        Of more than two cameras it is that of the pair which contradicts the calibration most.
        """
        changes = self.changes()
        if not changes:
            return None
        least = min((change for change, _ in changes.values()), key=lambda change: change.chance)
        alone = culprit(changes, len(self.calibration.cameras))
        name = "" if alone is None else self.calibration.cameras[alone].name
        return replace(least, culprit=name)

    def changes(self, prior: DriftPrior | None = None) -> Changes:
        """Return `rig_changes` of all collected rows."""
        import pandas as pd

        filled = [p for p in self.parts if len(p)]
        if not filled:
            return {}
        return rig_changes(pd.concat(filled, ignore_index=True), self.calibration, prior)


Changes = dict[tuple[int, int], "tuple[RigChange, Noise]"]


def rig_changes(
    tracks: pd.DataFrame, calibration: Calibration, prior: DriftPrior | None = None
) -> Changes:
    """Return `rig_change` of each pair of cameras whose lines of sight are not parallel."""
    changes: Changes = {}
    for pair in combinations(range(len(calibration.cameras)), 2):
        two = calibration.subset(*pair)
        if not nearly_parallel((two.cameras[0], two.cameras[1])):
            found = rig_change(_seen_by(tracks, two), two, prior)
            if found is not None:
                changes[pair] = found
    return changes


def culprit(changes: Changes, cameras: int) -> int | None:
    """Return which of more than two cameras has moved, if all pairs of it say so and no others."""
    moved = {pair for pair, (change, _) in changes.items() if change.moved}
    alone = [c for c in range(cameras) if moved == {pair for pair in changes if c in pair}]
    return alone[0] if len(moved) > 1 and len(alone) == 1 else None


def _seen_by(table: pd.DataFrame, calibration: Calibration) -> pd.DataFrame:
    """Return the rows that both cameras of a calibration see, with the miss of their two rays."""
    names = [c.name for c in calibration.cameras]
    both = np.isfinite(table[[f"{name}_u_px" for name in names]].to_numpy(float)).all(1)
    mine: pd.DataFrame = table.loc[both]
    uv, _ = _pixels(mine, names)
    rays = [c.unproject(uv[:, i]) for i, c in enumerate(calibration.cameras)]
    return mine.assign(ray_miss_mm=midpoint(*rays[0], *rays[1])[1])


def _speed_columns(cameras: Sequence[str]) -> list[str]:
    return [f"{camera}_{axis}_px_s" for camera in cameras for axis in "uv"]


def with_speeds(tracks: pd.DataFrame, cameras: Sequence[str]) -> pd.DataFrame:
    """Return a table of tracks with the speed of each pixel (px/s), unless it has them.

    They are central differences; 0 where a bubble was not seen in the frame before or after.
    """
    columns = _speed_columns(cameras)
    if columns[0] in tracks:
        return tracks
    order = np.lexsort((tracks["frame"], tracks["particle"]))
    pixels = [f"{camera}_{axis}_px" for camera in cameras for axis in "uv"]
    frame, particle = (tracks[c].to_numpy()[order] for c in ("frame", "particle"))
    t_s, uv = (tracks[c].to_numpy(float)[order] for c in ("t_s", pixels))
    beside = (frame[2:] - frame[:-2] == 2) & (particle[2:] == particle[:-2])
    speed = np.zeros(uv.shape)
    inner = np.flatnonzero(beside)
    speed[1 + inner] = (uv[2 + inner] - uv[inner]) / (t_s[2 + inner] - t_s[inner])[:, None]
    back = np.empty_like(speed)
    back[order] = np.nan_to_num(speed)
    return tracks.assign(**dict(zip(columns, back.T)))


def pair_columns(cameras: Sequence[str]) -> list[str]:
    """Return the names of the columns of tracks.csv that `rig_change` uses."""
    pixels = ("u_px", "v_px", "du_px", "dv_px", "suu_px2", "suv_px2", "svv_px2")
    base = ["frame", "particle", "t_s", "x_mm", "y_mm", "z_mm", "ray_miss_mm"]
    return base + [f"{c}_{p}" for c in cameras for p in pixels]


def rig_change(
    tracks: pd.DataFrame, calibration: Calibration, prior: DriftPrior | None = None
) -> tuple[RigChange, Noise] | None:
    """Estimate how the second camera has moved since the calibration, from the tracks of a run.

    tracks : table with the columns `pair_columns`. prior : of the movement; None for `DriftPrior`.
    Returns the movement and the noise model of the ray misses; None if there are fewer than
    `LEAST_PAIRS` reliable pairs, or not exactly two cameras.
    """
    if len(calibration.cameras) != 2 or len(tracks) < LEAST_PAIRS:
        return None
    cameras = (calibration.cameras[0], calibration.cameras[1])
    names = [c.name for c in cameras]
    table = _without_outliers(with_speeds(tracks, names).loc[_reliable(tracks)])
    if len(table) < LEAST_PAIRS or table["frame"].nunique() < _LEAST:
        return None
    movement = Movement.of(cameras, 1, 0, prior or DriftPrior())
    drift = movement.covariance
    covariance, free = rig_block(calibration)
    root = covariance_root(with_drift(covariance, movement))

    def series_of(part: pd.DataFrame) -> Series:
        misses = ray_misses(cameras, free, _points(part), *_pixels(part, names))
        speed = part[_speed_columns(names)].to_numpy(float).reshape(-1, 2, 2)
        middle = float(np.median(misses.variance_mm2))  # 0 if the tracks state no noise
        # half of it in each view, for then errors of both speeds and curved paths cancel
        by_delay = 0.5 * _LATE_S * np.einsum("mci,mci,c->m", misses.by_pixel, speed, [-1.0, 1.0])
        return Series(
            part["frame"].to_numpy(np.int64),
            part["particle"].to_numpy(np.int64),
            part["t_s"].to_numpy(float),
            misses.miss_mm,
            misses.variance_mm2 / middle if middle > 0 else np.ones(len(part)),
            np.column_stack([misses.by_rig @ root, by_delay]),
        )

    scale = min(c["scale_px_per_mm"] for c in cameras)
    found = _estimate(table, series_of, np.sqrt(2) * _SHAPE_PX / scale)
    if found is None:
        return None
    unit, spreads, noise, used = found
    late, slate = _LATE_S * float(unit[-1]), _LATE_S * float(np.sqrt(spreads[1][-1, -1]))
    if abs(late) <= LATE_SIGMAS * slate:  # then the cameras are taken to be synchronous
        hold = np.eye(len(unit))
        hold[:, -1] -= spreads[0][:, -1] / spreads[0][-1, -1]
        unit, spreads = hold @ unit, (hold @ spreads[0] @ hold.T, hold @ spreads[1] @ hold.T)
    rig = root @ unit[:-1]
    (tangent, own), (_, with_shapes) = (
        drift_posterior(rig, root @ spread[:-1, :-1] @ root.T, covariance, movement)
        for spread in spreads
    )
    change = rig_change_from(cameras, tangent, own, drift, _points(table).mean(0), used)
    t = np.unique(table["t_s"].to_numpy(float))
    seen_s = float(np.median(np.diff(t)) * len(table))
    chance = p_value_of(tangent, with_shapes, drift) if seen_s >= LEAST_SEEN_S else 1.0
    return replace(change, chance=chance, late_s=late, slate_s=slate), noise


def _reliable(tracks: pd.DataFrame) -> Bools:
    """Return which rows have pixels in both views, high confidence and no doubtful flag."""
    keep = np.isfinite(tracks["ray_miss_mm"].to_numpy(float))
    if "confidence" in tracks:
        keep &= ~(tracks["confidence"].to_numpy(float) < _LEAST_CONFIDENCE)
    if "flags" in tracks:
        keep &= ~tracks["flags"].fillna("").astype(str).str.contains(_DOUBTFUL).to_numpy()
    return np.asarray(keep)


def _without_outliers(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows whose ray miss is near all others', with particles numbered from 0."""
    miss = table["ray_miss_mm"].to_numpy(float)
    if not len(miss):
        return table
    middle = np.median(miss)
    spread = float(robust_sd(miss - middle))
    near = np.abs(miss - middle) <= _FAR_SIGMAS * max(spread, 1e-6)
    bubble = np.unique(table["particle"], return_inverse=True)[1].astype(np.int64)
    kept: pd.DataFrame = table.assign(particle=bubble).loc[near]
    return kept


def _points(table: pd.DataFrame) -> Array:
    return table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)


def _pixels(table: pd.DataFrame, cameras: list[str]) -> tuple[Array, Array]:
    """Return the centres (M, 2, 2) of pairs in two cameras, of volume if known, and covariances."""
    uv, spread = [], []
    for name in cameras:
        centre = table[[f"{name}_u_px", f"{name}_v_px"]].to_numpy(float)
        shift = [f"{name}_du_px", f"{name}_dv_px"]
        if shift[0] in table:
            centre = centre + np.nan_to_num(table[shift].to_numpy(float))
        names = [f"{name}_{c}" for c in ("suu_px2", "suv_px2", "suv_px2", "svv_px2")]
        uv.append(centre)
        spread.append(table[names].to_numpy(float).reshape(-1, 2, 2))
    return np.stack(uv, 1), np.stack(spread, 1)


def stretches(table: pd.DataFrame) -> list[pd.DataFrame]:
    """Return parts of a table of tracks, with at most about 520 pairs each, spread over the run.

    If many bubbles are seen, the parts use only every second, third, ... frame.
    """
    frames, counts = np.unique(table["frame"].to_numpy(np.int64), return_counts=True)
    most = max(4, int(_MOST_ROWS / float(counts.mean())))
    first = table.drop_duplicates("frame").sort_values("frame")["t_s"].to_numpy(float)
    step = float(np.median(np.diff(first)))
    thin = max(1, int(np.ceil(min(_STRETCH_S, float(np.ptp(first))) / step / most)))
    used = frames[::thin]
    parts = min(max(1, round(len(used) / most)), _MOST_STRETCHES)
    length = min(most, len(used) // parts)
    starts = np.linspace(0, len(used) - length, parts).astype(int)
    by_frame = table.set_index("frame", drop=False)
    by_frame.index.name = None
    return [by_frame.loc[used[s : s + length]].reset_index(drop=True) for s in starts]


def _estimate(
    table: pd.DataFrame, series_of: Callable[[Any], Series], shape_mm: float
) -> tuple[Array, tuple[Array, Array], Noise, int] | None:
    """Return unknowns (K,) of unit prior variance, two covariances, the noise and number of pairs.

    The second covariance includes a constant ray miss (sd shape_mm) of each bubble due to its
    shape. Returns None if too few pairs remain without outliers.
    """
    parts = [series_of(part) for part in stretches(table)]
    some = np.unique(np.linspace(0, len(parts) - 1, _LEARNED_FROM).astype(int))
    noise = learned_noise([parts[i] for i in some])
    size = parts[0].by_unknowns.shape[1]
    for last in range(_PASSES):
        matrix, right = np.eye(size), np.zeros(size)
        kept = []
        for part in parts:
            added, value, sigmas = information(part, noise)
            matrix, right = matrix + added, right + value
            kept.append(part.of(np.abs(sigmas) < _OUTLIER_SIGMAS))
        if last == _PASSES - 1 or list(map(len, kept)) == list(map(len, parts)):
            break
        parts = [p for p in kept if len(p) >= _LEAST]
        if not parts:
            return None
        noise = learned_noise(parts[:_LEARNED_FROM])
    covariance: Array = np.asarray(np.linalg.inv(matrix), np.float64)
    bubbles = len(np.unique(np.concatenate([p.bubble for p in parts])))
    with_shapes = covariance + _shape_share(parts, covariance, noise, shape_mm) / bubbles
    pairs = sum(map(len, parts))
    return np.asarray(covariance @ right), (covariance, with_shapes), noise, pairs


def _shape_share(parts: list[Series], covariance: Array, noise: Noise, shape_mm: float) -> Array:
    """Return the covariance (K, K) due to a constant ray miss of one bubble in the whole run."""
    response = np.zeros(len(covariance))
    for part in parts:
        constant = replace(part, miss_mm=np.full(len(part), shape_mm))
        response = response + information(constant, noise)[1]
    shift = covariance @ response
    return np.outer(shift, shift)
