"""Tracks of a simulated run beside the truth. For the demo and the benchmarks, never estimators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.estimator.tracking.tracks import Tracks

Array = NDArray[np.float64]

NEAR_PX = 3.0
"""A point is a bubble's when both its pixels are this near to the bubble's true ones."""


@dataclass(frozen=True)
class TrackScore:
    """How tracks agree with the truth; bubbles that an image cuts are neither right nor wrong.

    in_view : (bubble, frame) pairs that both images show whole; right : of these, with a point;
    hidden, hidden_right : of these and of the right ones, those of which another bubble hides half
    of the outline or more in a view (silhouettes taken for circles of their area).
    wrong : points that are no bubble, or one that has a point already; swaps : changes of the true
    bubble along a track.
    centre_px, corrected_px : RMS per coordinate of the outlines' centres against the projected
    centre of volume, as measured and with the shape's correction; silhouette_px : against the
    centroid of the true silhouette.
    """

    in_view: int
    right: int
    hidden: int
    hidden_right: int
    wrong: int
    tracks: int
    swaps: int
    breaks: int
    centre_px: float
    corrected_px: float
    silhouette_px: float

    @property
    def recall(self) -> float:
        return self.right / max(self.in_view, 1)

    @property
    def recall_in_sight(self) -> float:
        """Recall of the bubbles that show more than half of their outline in both views."""
        return (self.right - self.hidden_right) / max(self.in_view - self.hidden, 1)

    @property
    def precision(self) -> float:
        return self.right / max(self.right + self.wrong, 1)


def score_tracks(tracks: Tracks, truth: pd.DataFrame, cameras: Sequence[str]) -> TrackScore:
    """Compare with the simulator's `truth/runs/<run>/bubbles.csv`."""
    bubble = _true_bubbles(tracks.table, truth, cameras)
    found = bubble["row"].notna().to_numpy()
    whole = _whole(truth, cameras)
    hidden = whole & (_hidden_share(truth, cameras) >= 0.5)
    again = found & bubble["row"].duplicated().to_numpy()
    right = found & ~again & bubble["whole"].fillna(False).to_numpy(bool)
    measured, shift, volume, silhouette = (
        _columns(table[right], cameras, name)
        for table, name in (
            (tracks.table, "{c}_{x}_px"),
            (tracks.table, "{c}_d{x}_px"),
            (bubble, "{c}_{x}_px"),
            (bubble, "{c}_silhouette_{x}_px"),
        )
    )
    return TrackScore(
        int(whole.sum()),
        int(right.sum()),
        int(hidden.sum()),
        int(hidden.to_numpy()[bubble["row"][right].astype(int)].sum()),
        int((~found | again).sum()),
        len(tracks),
        _swaps(tracks.table["particle"].to_numpy()[found], bubble["particle"].to_numpy()[found]),
        int((tracks.events["kind"] == "break").sum()),
        _rms(measured - volume),
        _rms(measured + shift - volume),
        _rms(measured - silhouette),
    )


def _true_bubbles(table: pd.DataFrame, truth: pd.DataFrame, cameras: Sequence[str]) -> pd.DataFrame:
    """For each row of ``table`` the row of ``truth`` it shows; blank where there is none."""
    by_frame = {
        f: rows.to_numpy() for f, rows in pd.Series(range(len(truth))).groupby(truth["frame"])
    }
    at, true = (_columns(t, cameras, "{c}_{x}_px").reshape(len(t), -1, 2) for t in (table, truth))
    chosen = np.full(len(table), np.nan)
    for i, frame in enumerate(table["frame"]):
        rows = by_frame.get(frame, np.zeros(0, int))
        off = np.linalg.norm(true[rows] - at[i], axis=-1).max(axis=1)
        if len(rows) and off.min() < NEAR_PX:
            chosen[i] = rows[off.argmin()]
    known = truth.assign(row=np.arange(len(truth)), whole=_whole(truth, cameras))
    return known.reindex(chosen).reset_index(drop=True)


def _hidden_share(truth: pd.DataFrame, cameras: Sequence[str]) -> Array:
    """(N,) largest share over the views of a bubble's outline that lies inside other bubbles."""
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn)], -1)
    out = np.zeros(len(truth))
    for rows in truth.groupby("frame").indices.values():
        for c in cameras:
            part = truth.iloc[rows]
            centre = part[[f"{c}_silhouette_u_px", f"{c}_silhouette_v_px"]].to_numpy(float)
            radius = np.sqrt(part[f"{c}_area_px2"].to_numpy(float) / np.pi)
            outline = centre[:, None] + radius[:, None, None] * circle
            off = np.linalg.norm(outline[:, :, None] - centre, axis=-1)
            inside = off < radius
            inside[np.arange(len(rows)), :, np.arange(len(rows))] = False
            out[rows] = np.maximum(out[rows], inside.any(-1).mean(-1))
    return out


def _whole(truth: pd.DataFrame, cameras: Sequence[str]) -> pd.Series[bool]:
    return (truth[[f"{c}_whole" for c in cameras]] == 1).all(axis=1)


def _columns(table: pd.DataFrame, cameras: Sequence[str], name: str) -> Array:
    return table[[name.format(c=c, x=x) for c in cameras for x in "uv"]].to_numpy(float)


def _swaps(particle: NDArray[np.int64], true: Array) -> int:
    last: dict[int, float] = {}
    swaps = 0
    for mine, theirs in zip(particle.tolist(), true.tolist()):
        swaps += last.get(mine, theirs) != theirs
        last[mine] = theirs
    return swaps


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2))) if error.size else float("nan")
