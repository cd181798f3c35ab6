"""A movement of the cameras against each other, from the pairs of a tracked run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.bubbles.pairing.wording import CALIBRATION_PROBLEM
from telerig.estimator.rig_drift.drift import (
    DriftPrior,
    RigChange,
    chance_of,
    described,
    drift_covariance,
    gaps_of,
    rig_block,
    share_of_drift,
    with_drift,
)
from telerig.estimator.rig_drift.gap_noise import Noise, Series, information, learned_noise

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.bubbles.pairing.types import PairModel
    from telerig.estimator.calibration.result.calibration import Calibration

Array = NDArray[np.float64]

LEAST_PAIRS = 20
LEAST_SEEN_S = 0.5
"""In less, all bubbles together, their centres' wander is not seen for what it is: no verdict."""

_LEAST_CONFIDENCE = 0.9
_DOUBTFUL = "shared|ambiguous|merged|border"
_FAR_SIGMAS = 6.0
_OUTLIER_SIGMAS = 4.5
_MOST_ROWS = 520
_MOST_STRETCHES = 10
_STRETCH_S = 2.0
_LEARNED_FROM = 2
_PASSES = 3
_SHAPE_PX = 0.02
"""What no outline tells of a bubble's centre, constant for each bubble, each view."""


def pair_columns(cameras: Sequence[str]) -> list[str]:
    """Columns of tracks.csv that are needed."""
    pixels = ("u_px", "v_px", "du_px", "dv_px", "suu_px2", "suv_px2", "svv_px2")
    base = ["frame", "particle", "t_s", "x_mm", "y_mm", "z_mm", "ray_miss_mm"]
    return base + [f"{c}_{p}" for c in cameras for p in pixels]


class PairCollector:
    """The sure pairs of a run while it is tracked, and what they tell at its end."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.parts: list[pd.DataFrame] = []

    def add(self, tracks: pd.DataFrame) -> None:
        names = pair_columns([c.name for c in self.calibration.cameras])
        sure = _believed(tracks)
        self.parts.append(tracks.loc[sure, [n for n in names if n in tracks]])

    def found(self) -> RigChange | None:
        import pandas as pd

        filled = [p for p in self.parts if len(p)]
        if not filled:
            return None
        found = rig_change(pd.concat(filled, ignore_index=True), self.calibration)
        return None if found is None else found[0]


def rig_change(
    tracks: pd.DataFrame, calibration: Calibration, prior: DriftPrior | None = None
) -> tuple[RigChange, Noise] | None:
    """What a table of tracks tells of a movement, with the noise of its gaps.

    None for fewer than `LEAST_PAIRS` sure pairs, or without two cameras.
    """
    if len(calibration.cameras) != 2 or len(tracks) < LEAST_PAIRS:
        return None
    cameras = (calibration.cameras[0], calibration.cameras[1])
    table = _sure(tracks)
    if len(table) < LEAST_PAIRS or table["frame"].nunique() < 4:
        return None
    points = table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    drift = drift_covariance(cameras, prior or DriftPrior())
    covariance, free = rig_block(calibration)
    root = _root(with_drift(covariance, drift))

    def series_of(part: pd.DataFrame) -> Series:
        where = part[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
        uv, spread = _pixels(part, [c.name for c in cameras])
        gaps = gaps_of(cameras, free, where, uv, spread)
        typical = float(np.median(gaps.variance_mm2))
        return Series(
            part["frame"].to_numpy(np.int64),
            part["particle"].to_numpy(np.int64),
            part["t_s"].to_numpy(float), gaps.gap_mm,
            gaps.variance_mm2 / typical, gaps.by_rig @ root,
        )  # fmt: skip

    scale = min(c["scale_px_per_mm"] for c in cameras)
    found = _estimate(table, series_of, np.sqrt(2) * _SHAPE_PX / scale)
    if found is None:
        return None
    unit, spreads, noise, used = found
    rig = root @ unit
    (tangent, own), (_, careful) = (
        share_of_drift(rig, root @ spread @ root.T, covariance, drift) for spread in spreads
    )
    change = described(cameras, tangent, own, drift, points.mean(0), used)
    long = _seen_s(table) >= LEAST_SEEN_S
    chance = chance_of(tangent, careful, drift) if long else 1.0
    return replace(change, chance=chance), noise


def _seen_s(table: pd.DataFrame) -> float:
    """How long bubbles were seen, added up."""
    t = np.unique(table["t_s"].to_numpy(float))
    return float(np.median(np.diff(t)) * len(table))


def _believed(tracks: pd.DataFrame) -> NDArray[np.bool_]:
    """Rows whose pixels are both measured, of pairs that are hardly to be doubted."""
    keep = np.isfinite(tracks["ray_miss_mm"].to_numpy(float))
    if "confidence" in tracks:
        keep &= ~(tracks["confidence"].to_numpy(float) < _LEAST_CONFIDENCE)
    if "flags" in tracks:
        words = tracks["flags"].fillna("").astype(str)
        keep &= ~words.str.contains(_DOUBTFUL).to_numpy()
    return np.asarray(keep)


def _sure(tracks: pd.DataFrame) -> pd.DataFrame:
    """Believed rows without gaps that are far from all others."""
    table: pd.DataFrame = tracks.loc[_believed(tracks)]
    miss = table["ray_miss_mm"].to_numpy(float)
    if not len(miss):
        return table
    middle = np.median(miss)
    spread = 1.4826 * np.median(np.abs(miss - middle))
    near = np.abs(miss - middle) <= _FAR_SIGMAS * max(float(spread), 1e-6)
    bubble = np.unique(table["particle"], return_inverse=True)[1].astype(np.int64)
    kept: pd.DataFrame = table.assign(particle=bubble).loc[near]
    return kept


def _pixels(table: pd.DataFrame, cameras: list[str]) -> tuple[Array, Array]:
    """(M, 2, 2) centres, corrected where they are; (M, 2, 2, 2) covariances."""
    uv, spread = [], []
    for name in cameras:
        centre = table[[f"{name}_u_px", f"{name}_v_px"]].to_numpy(float)
        if f"{name}_du_px" in table:
            centre = centre + np.nan_to_num(
                table[[f"{name}_du_px", f"{name}_dv_px"]].to_numpy(float)
            )
        names = [f"{name}_{c}" for c in ("suu_px2", "suv_px2", "suv_px2", "svv_px2")]
        uv.append(centre)
        spread.append(table[names].to_numpy(float).reshape(-1, 2, 2))
    return np.stack(uv, 1), np.stack(spread, 1)


def _root(covariance: Array) -> Array:
    """(P, K) directions of unit variance."""
    scale = np.sqrt(np.diagonal(covariance).clip(0))
    unit = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / unit[:, None] / unit)
    keep = values > 1e-12
    return np.asarray(unit[:, None] * vectors[:, keep] * np.sqrt(values[keep]))


def with_change(
    model: PairModel, change: RigChange | None, calibration: Calibration
) -> dict[str, Any]:
    """What tracking.json says of the pairs, with a movement in place of a biased calibration."""
    words, moved = list(model.words), change is not None and change.moved
    if change is not None and moved:
        words = [w for w in words if not w.startswith(CALIBRATION_PROBLEM)]
        first = calibration.cameras[0].name
        unsure = "" if np.any(calibration.covariance) else " or was never where it says"
        words.append(
            f"Calibration: camera {change.camera!r} has moved against {first!r} since{unsure}, "
            f"{change.size_words()}. Calibrate again, or smooth with --refine-rig; until then "
            "positions are off by it."
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
    """Parts of a run, of not too many pairs each, spread over it.

    Frames are taken evenly: all of them where one bubble is followed, fewer where there are many.
    """
    frames, counts = np.unique(table["frame"].to_numpy(np.int64), return_counts=True)
    per_frame = float(counts.mean())
    most = max(4, int(_MOST_ROWS / per_frame))
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
    """Unit unknowns, their covariance, the noise and the number of pairs that were kept.

    The second covariance holds a constant shape of each bubble besides.
    """
    parts = [series_of(part) for part in stretches(table)]
    some = [parts[i] for i in np.unique(np.linspace(0, len(parts) - 1, _LEARNED_FROM).astype(int))]
    noise = learned_noise(some)
    size = parts[0].free.shape[1]
    matrix, right = np.eye(size), np.zeros(size)
    for last in range(_PASSES):
        matrix, right = np.eye(size), np.zeros(size)
        kept, dropped = [], 0
        for part in parts:
            added, value, sigmas = information(part, noise)
            matrix, right = matrix + added, right + value
            good = np.abs(sigmas) < _OUTLIER_SIGMAS
            dropped += int((~good).sum())
            kept.append(part.of(good))
        if not dropped or last == _PASSES - 1:
            break
        parts = [p for p in kept if len(p.gap_mm) >= 4]
        if not parts:
            return None
        noise = learned_noise(parts[:_LEARNED_FROM])
    covariance: Array = np.asarray(np.linalg.inv(matrix), np.float64)
    bubbles = len(np.unique(np.concatenate([p.bubble for p in parts])))
    careful = covariance + _shape_share(parts, covariance, noise, shape_mm) / bubbles
    pairs = sum(len(p.gap_mm) for p in parts)
    return np.asarray(covariance @ right), (covariance, careful), noise, pairs


def _shape_share(parts: list[Series], covariance: Array, noise: Noise, shape_mm: float) -> Array:
    """(K, K) what a constant gap of every bubble adds, as if all of the run were one bubble."""
    response = np.zeros(len(covariance))
    for part in parts:
        constant = replace(part, gap_mm=np.full(len(part.gap_mm), shape_mm))
        response = response + information(constant, noise)[1]
    shift = covariance @ response
    return np.outer(shift, shift)
