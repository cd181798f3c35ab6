"""Tracks thinned for a picture, with what breaks their lines."""

from __future__ import annotations

import numpy as np
import pandas as pd

from telerig.arrays import Array

_SPACING = 1.7
"""Diameters between two bubbles of a track that are drawn."""


def thinned(tracks: pd.DataFrame, most: int) -> pd.DataFrame:
    """Return about ``most`` rows sorted by bubble and frame, with the ends of all tracks.

    Of more tracks than ``most`` / 4 the longest stay. ``new`` marks rows before which a line
    must not be drawn: a track's first, and the first after a gap longer than the thinning.
    """
    table: pd.DataFrame = tracks.loc[
        np.isfinite(tracks[["x_mm", "y_mm", "z_mm"]].to_numpy()).all(1)
    ]
    length = table["particle"].value_counts()
    if len(length) > most // 4:
        table = table[table["particle"].isin(length.index[: most // 4])]
    table = table.sort_values(by=["particle", "frame"])
    particle, frame = table["particle"].to_numpy(), table["frame"].to_numpy()
    first = np.append(True, particle[1:] != particle[:-1])[: len(table)]
    step = max(1, int(np.ceil(len(table) / most)))
    gap = np.append(False, np.diff(frame) > step)[: len(table)]
    within = np.arange(len(table)) - np.maximum.accumulate(
        np.where(first, np.arange(len(table)), 0)
    )
    keep = (within % step == 0) | first | np.append(first[1:], True)[: len(table)]
    run = np.cumsum(first | gap)
    kept: pd.DataFrame = table.assign(run=run).loc[keep]
    new = np.append(True, np.diff(kept["run"]) != 0)[: len(kept)]
    return kept.assign(new=new)


def spaced(points_mm: Array, particle: Array, diameter_mm: Array, most: int) -> list[int]:
    """Return some rows of sorted tracks, so far apart that their bubbles do not hide each other.

    points_mm : (N, 3). particle, diameter_mm : (N,). most : about so many rows.
    """
    chosen: list[int] = []
    for i in range(len(points_mm)):
        last = chosen[-1] if chosen else -1
        far = np.linalg.norm(points_mm[i] - points_mm[last]) > _SPACING * diameter_mm[i]
        if last < 0 or particle[i] != particle[last] or far:
            chosen.append(i)
    return chosen[:: len(chosen) // most + 1]
