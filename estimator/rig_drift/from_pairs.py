"""Estimates a movement of the cameras relative to each other, from the pairs of a tracked run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.bubbles.pairing.matching import Finding
from telerig.estimator.rig_drift.drift import (
    DriftPrior,
    RigChange,
    covariance_root,
    drift_covariance,
    drift_posterior,
    p_value_of,
    ray_misses,
    rig_block,
    rig_change_from,
    with_drift,
)
from telerig.estimator.rig_drift.ray_miss_noise import Noise, Series, information, learned_noise
from telerig.statistics import robust_sd

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.bubbles.pairing.matching import PairModel
    from telerig.estimator.calibration.result.calibration import Calibration


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
_MOST_ROWS = 520
_MOST_STRETCHES = 10
_STRETCH_S = 2.0
_LEARNED_FROM = 2
_PASSES = 3
_SINGULAR = 1e-12
_SHAPE_PX = 0.02
"""Constant error of each bubble's centre in each view that its outline does not reveal."""


class PairCollector:
    """Collects the reliable pairs of a run while it is tracked, and estimates a movement at its
    end.
    """

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.parts: list[pd.DataFrame] = []

    def add(self, tracks: pd.DataFrame) -> None:
        """Add the reliable pairs of a part of the tracks."""
        names = pair_columns([c.name for c in self.calibration.cameras])
        self.parts.append(tracks.loc[_reliable(tracks), [n for n in names if n in tracks]])

    def found(self) -> RigChange | None:
        """Return the movement that all collected pairs give, or None if there are too few of
        them."""
        import pandas as pd

        filled = [p for p in self.parts if len(p)]
        found = rig_change(pd.concat(filled, ignore_index=True), self.calibration) if filled else ()
        return found[0] if found else None


def pair_columns(cameras: Sequence[str]) -> list[str]:
    """Return the names of the columns of tracks.csv that the estimate needs."""
    pixels = ("u_px", "v_px", "du_px", "dv_px", "suu_px2", "suv_px2", "svv_px2")
    base = ["frame", "particle", "t_s", "x_mm", "y_mm", "z_mm", "ray_miss_mm"]
    return base + [f"{c}_{p}" for c in cameras for p in pixels]


def rig_change(
    tracks: pd.DataFrame, calibration: Calibration, prior: DriftPrior | None = None
) -> tuple[RigChange, Noise] | None:
    """Return the movement estimated from a table of tracks, and the noise model of its ray misses.

    Returns None if there are fewer than `LEAST_PAIRS` reliable pairs, or not exactly two cameras.
    """
    if len(calibration.cameras) != 2 or len(tracks) < LEAST_PAIRS:
        return None
    cameras = (calibration.cameras[0], calibration.cameras[1])
    table = _without_outliers(tracks.loc[_reliable(tracks)])
    if len(table) < LEAST_PAIRS or table["frame"].nunique() < _LEAST:
        return None
    drift = drift_covariance(cameras, prior or DriftPrior())
    covariance, free = rig_block(calibration)
    root = covariance_root(with_drift(covariance, drift), _SINGULAR)

    def series_of(part: pd.DataFrame) -> Series:
        misses = ray_misses(cameras, free, _points(part), *_pixels(part, [c.name for c in cameras]))
        return Series(
            part["frame"].to_numpy(np.int64),
            part["particle"].to_numpy(np.int64),
            part["t_s"].to_numpy(float),
            misses.miss_mm,
            misses.variance_mm2 / float(np.median(misses.variance_mm2)),
            misses.by_rig @ root,
        )

    scale = min(c["scale_px_per_mm"] for c in cameras)
    found = _estimate(table, series_of, np.sqrt(2) * _SHAPE_PX / scale)
    if found is None:
        return None
    unit, spreads, noise, used = found
    rig = root @ unit
    (tangent, own), (_, with_shapes) = (
        drift_posterior(rig, root @ spread @ root.T, covariance, drift) for spread in spreads
    )
    change = rig_change_from(cameras, tangent, own, drift, _points(table).mean(0), used)
    t = np.unique(table["t_s"].to_numpy(float))
    seen_s = float(np.median(np.diff(t)) * len(table))
    chance = p_value_of(tangent, with_shapes, drift) if seen_s >= LEAST_SEEN_S else 1.0
    return replace(change, chance=chance), noise


def _reliable(tracks: pd.DataFrame) -> Bools:
    """Return which rows have pixels measured in both views, high confidence and no flag of a
    doubtful pair."""
    keep = np.isfinite(tracks["ray_miss_mm"].to_numpy(float))
    if "confidence" in tracks:
        keep &= ~(tracks["confidence"].to_numpy(float) < _LEAST_CONFIDENCE)
    if "flags" in tracks:
        keep &= ~tracks["flags"].fillna("").astype(str).str.contains(_DOUBTFUL).to_numpy()
    return np.asarray(keep)


def _without_outliers(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows whose ray miss is not far from those of all others, with particles numbered
    from 0."""
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
    """Return the centres (M, 2, 2) of M pairs in two cameras, and their covariances (M, 2, 2, 2).

    The centres contain the correction from outline centre to centre of volume if it is known.
    """
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


def with_change(
    model: PairModel, change: RigChange | None, calibration: Calibration
) -> dict[str, Any]:
    """Return the part ``pairs`` of tracking.json.

    If the cameras have moved, a sentence on this replaces the one on an offset of the calibration.
    """
    words, moved = model.sentences(), change is not None and change.moved
    if change is not None and moved:
        words = model.sentences(without=[Finding.CALIBRATION_OFFSET])
        first = calibration.cameras[0].name
        unsure = "" if np.any(calibration.covariance) else " (or the calibration was never right)"
        words.append(
            f"Camera {change.camera!r} has moved against {first!r} since the calibration{unsure}, "
            f"{change.size_words()}. All positions are off by this movement. Calibrate again, or "
            "smooth the run with --refine-rig."
        )
    return {
        "bias_px": model.bias_px,
        "scatter_px": model.scatter_px,
        "frame_px": model.frame_px,
        "rms_px": model.rms_px,
        "calibration_problem": model.calibration_problem or moved,
        "words": words,
    }


def stretches(table: pd.DataFrame) -> list[pd.DataFrame]:
    """Return stretches of a run with at most about 520 pairs each, spread evenly over the run.

    Each stretch uses every frame if few bubbles are seen, and every second, third, ... frame if
    many are.
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
    """Return the estimate of K unknowns, which have unit prior variance, from stretches of the run.

    series_of : function that returns the ray misses of a part of the table.
    shape_mm : standard deviation of the constant ray miss of each bubble due to its shape.

    Returns the unknowns (K,), two covariances (K, K), the noise model and the number of used pairs.
    The second covariance includes the constant shape error of each bubble. Returns None if too few
    pairs remain without outliers.
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
    """Return the covariance (K, K) due to a constant ray miss, as if the whole run showed one
    bubble.
    """
    response = np.zeros(len(covariance))
    for part in parts:
        constant = replace(part, miss_mm=np.full(len(part), shape_mm))
        response = response + information(constant, noise)[1]
    shift = covariance @ response
    return np.outer(shift, shift)
