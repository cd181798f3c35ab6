"""Tracks of a simulated run against the truth, for the demo and the benchmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools

if TYPE_CHECKING:
    from telerig.estimator.tracking.tracks import Tracks


NEAR_PX = 3.0
"""A point shows a bubble when both its pixels are this near to the bubble's true ones."""


@dataclass(frozen=True)
class Score:
    """Bubbles that an image cuts are neither right nor wrong.

    in_view : (bubble, frame) pairs that both images show whole; right : of these, with a point.
    wrong : points that show no bubble, or one that has a point already.
    centre_px, corrected_px : RMS per coordinate of the outlines' centres against the projected
    centre of volume, as measured and with the shape's correction.
    """

    in_view: int
    right: int
    wrong: int
    tracks: int
    centre_px: float
    corrected_px: float

    @property
    def recall(self) -> float:
        return self.right / max(self.in_view, 1)

    @property
    def precision(self) -> float:
        return self.right / max(self.right + self.wrong, 1)


def score_tracks(tracks: Tracks, truth: pd.DataFrame, cameras: Sequence[str]) -> Score:
    """Compare with the simulator's `truth/runs/<run>/bubbles.csv`."""
    bubble, right = matched(tracks.table, truth, cameras)
    wrong = (bubble["row"].isna() | bubble["row"].duplicated()).sum()
    measured, shift = (
        pixels(tracks.table[right], cameras, name) for name in ("{c}_{x}_px", "{c}_d{x}_px")
    )
    error = measured - pixels(bubble[right], cameras, "{c}_{x}_px")
    in_view = int(whole(truth, cameras).sum())
    return Score(in_view, int(right.sum()), int(wrong), len(tracks), rms(error), rms(error + shift))


def matched(
    table: pd.DataFrame, truth: pd.DataFrame, cameras: Sequence[str]
) -> tuple[pd.DataFrame, Bools]:
    """For each point the true bubble that it shows and its ``row`` in truth, blank without one;
    and whether it is the only one to show it, and the bubble is whole in both images."""
    rows_of = truth.groupby("frame").indices
    at, true = (pixels(t, cameras, "{c}_{x}_px").reshape(len(t), -1, 2) for t in (table, truth))
    chosen = np.full(len(table), np.nan)
    for i, frame in enumerate(table["frame"]):
        rows = rows_of.get(frame, np.zeros(0, int))
        off = np.linalg.norm(true[rows] - at[i], axis=-1).max(axis=1)
        if len(rows) and off.min() < NEAR_PX:
            chosen[i] = rows[off.argmin()]
    known = truth.assign(row=np.arange(len(truth)), whole=whole(truth, cameras))
    bubble = known.reset_index(drop=True).reindex(chosen).reset_index(drop=True)
    first = bubble["row"].notna() & ~bubble["row"].duplicated()
    return bubble, (first & bubble["whole"].eq(True)).to_numpy(bool)


def whole(truth: pd.DataFrame, cameras: Sequence[str]) -> pd.Series[bool]:
    """Which bubbles both images show uncut."""
    return (truth[[f"{c}_whole" for c in cameras]] == 1).all(axis=1)


def pixels(table: pd.DataFrame, cameras: Sequence[str], name: str) -> Array:
    """(N, 2 cameras) columns of the name pattern {c} camera, {x} u or v."""
    return table[[name.format(c=c, x=x) for c in cameras for x in "uv"]].to_numpy(float)


def rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2))) if error.size else float("nan")
