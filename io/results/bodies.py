"""The shapes of bubbles, from the columns of tracks.csv or bubbles.csv."""

from __future__ import annotations

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools


def ellipsoids_of(rows: pd.DataFrame) -> tuple[Array, Bools]:
    """Return Q (N, 3, 3) in mm^2 and rig axes of the spheroids x^T Q^-1 x = 1 of N bubbles.

    rows : N rows with ``d_eq_mm`` and the columns of the shape, where they are known. A bubble
        of unknown shape is a sphere; one of unknown size is NaN.

    Also returns (N,) whether the shape is known.
    """
    radius = np.array(rows.get("d_eq_mm", np.full(len(rows), np.nan)), float) / 2
    spheres = radius[:, None, None] ** 2 * np.eye(3)
    if not {"equator_mm", "polar_mm", "pole_x", "pole_y", "pole_z"} <= set(rows):
        return spheres, np.zeros(len(rows), bool)
    equator2, polar2 = (rows[name].to_numpy(float) ** 2 for name in ("equator_mm", "polar_mm"))
    pole = rows[["pole_x", "pole_y", "pole_z"]].to_numpy(float)
    along = pole[:, :, None] * pole[:, None, :]
    flat = (polar2 - equator2)[:, None, None] * along
    found = equator2[:, None, None] * np.eye(3) + flat
    known = np.isfinite(found).all((1, 2))
    return np.where(known[:, None, None], found, spheres), known
