"""Every score of a simulated run's tracks against the truth: hidden bubbles, swaps, breaks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.estimator.tracking.tracks import Tracks
from telerig.estimator.tracking.truth import Score, matched, pixels, rms, score_tracks, whole

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FullScore(Score):
    """hidden, hidden_right : of the bubbles in view and of the right points, those of which
        another bubble hides half of the outline or more in a view (silhouettes taken for circles).
    swaps : changes of the true bubble along a track.
    silhouette_px : RMS of the outlines' centres against the centroid of the true silhouette.
    """

    hidden: int
    hidden_right: int
    swaps: int
    breaks: int
    silhouette_px: float

    @property
    def recall_in_sight(self) -> float:
        """Recall of the bubbles that show more than half of their outline in both views."""
        return (self.right - self.hidden_right) / max(self.in_view - self.hidden, 1)


def full_score(tracks: Tracks, truth: pd.DataFrame, cameras: list[str]) -> FullScore:
    """Compare with the simulator's `truth/runs/<run>/bubbles.csv`."""
    bubble, right = matched(tracks.table, truth, cameras)
    found = bubble["row"].notna().to_numpy()
    hidden = whole(truth, cameras).to_numpy() & (_hidden_share(truth, cameras) >= 0.5)
    measured = pixels(tracks.table[right], cameras, "{c}_{x}_px")
    silhouette = pixels(bubble[right], cameras, "{c}_silhouette_{x}_px")
    return FullScore(
        **vars(score_tracks(tracks, truth, cameras)),
        hidden=int(hidden.sum()),
        hidden_right=int(hidden[bubble["row"][right].astype(int)].sum()),
        swaps=_swaps(tracks.table["particle"].to_numpy()[found], bubble["particle"][found]),
        breaks=int((tracks.events["kind"] == "break").sum()),
        silhouette_px=rms(measured - silhouette),
    )


def _hidden_share(truth: pd.DataFrame, cameras: list[str]) -> Array:
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
            inside = np.linalg.norm(outline[:, :, None] - centre, axis=-1) < radius
            inside[np.arange(len(rows)), :, np.arange(len(rows))] = False
            out[rows] = np.maximum(out[rows], inside.any(-1).mean(-1))
    return out


def _swaps(particle: NDArray[np.int64], true: pd.Series[float]) -> int:
    changes = pd.Series(true.to_numpy()).groupby(particle).diff()
    return int((changes.fillna(0) != 0).sum())
