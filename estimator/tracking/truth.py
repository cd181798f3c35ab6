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
"""Largest distance in px, in both images, between a point's pixels and the true pixels of the
bubble that it is said to show.
"""

NEAR_SD = 3.0
"""A point also shows a bubble that an image's edge cuts if no pixel is off by more of the standard
deviations that the point states: the centre of a cut outline can be uncertain by several px.
"""


@dataclass(frozen=True)
class Score:
    """Compare the points of a tracked run with the truth.

    Bubbles that are cut by an image's edge count neither as right nor as wrong.

    in_view : number of (bubble, frame) pairs in which both images show the whole bubble.
    right : number of these pairs that have a point.
    wrong : number of points that show no bubble, or a bubble that has a point already.
    tracks : number of tracks.
    centre_px, corrected_px : RMS per coordinate of the difference between the outlines' centres and
        the projected centre of volume, without and with the correction for the bubble's shape.
    """

    in_view: int
    right: int
    wrong: int
    tracks: int
    centre_px: float
    corrected_px: float

    @property
    def recall(self) -> float:
        """Share of the bubbles in view that have a point."""
        return self.right / max(self.in_view, 1)

    @property
    def precision(self) -> float:
        """Share of the points that are right."""
        return self.right / max(self.right + self.wrong, 1)


def score_tracks(tracks: Tracks, truth: pd.DataFrame, cameras: Sequence[str]) -> Score:
    """Compare tracks with the truth of a simulated run.

    truth : the simulator's table `truth/runs/<run>/bubbles.csv`.
    cameras : names of the two cameras.
    """
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
    """Find the true bubble that each of N points shows.

    table : N points, as in tracks.csv.
    truth : the simulator's table of bubbles.
    cameras : names of the cameras.

    Returns a table of N rows of ``truth``, with the row's number in the column ``row`` (blank if
    the point shows no bubble), and N booleans (N,). A boolean is True if the point is the first one
    that shows its bubble and the bubble is whole in both images.
    """
    rows_of = truth.groupby("frame").indices
    at, true = (pixels(t, cameras, "{c}_{x}_px").reshape(len(t), -1, 2) for t in (table, truth))
    sd = np.sqrt(pixels(table, cameras, "{c}_s{x}{x}_px2")).reshape(at.shape)
    known = truth.assign(row=np.arange(len(truth)), whole=whole(truth, cameras))
    cut = ~known["whole"].to_numpy()
    chosen = np.full(len(table), np.nan)
    for i, frame in enumerate(table["frame"]):
        rows = rows_of.get(frame, np.zeros(0, int))
        off = true[rows] - at[i]
        away = np.linalg.norm(off, axis=-1).max(axis=1)
        agrees = cut[rows] & (np.abs(off) <= NEAR_SD * sd[i]).all(axis=(1, 2))
        away[~(agrees | (away < NEAR_PX))] = np.inf
        if np.isfinite(away).any():
            chosen[i] = rows[away.argmin()]
    bubble = known.reset_index(drop=True).reindex(chosen).reset_index(drop=True)
    first = bubble["row"].notna() & ~bubble["row"].duplicated()
    return bubble, (first & bubble["whole"].eq(True)).to_numpy(bool)


def whole(truth: pd.DataFrame, cameras: Sequence[str]) -> pd.Series[bool]:
    """Return for each row of the simulator's table whether all images show the whole bubble."""
    return (truth[[f"{c}_whole" for c in cameras]] == 1).all(axis=1)


def pixels(table: pd.DataFrame, cameras: Sequence[str], name: str) -> Array:
    """Return pixels from N rows of a table, (N, 4) for two cameras: u and v of the first, then of
    the second.

    name : pattern of the column names, in which {c} stands for the camera and {x} for u or v.
    """
    return table[[name.format(c=c, x=x) for c in cameras for x in "uv"]].to_numpy(float)


def rms(error: Array) -> float:
    """Return the root mean square of errors; NaN of none."""
    return float(np.sqrt(np.mean(error**2))) if error.size else float("nan")
