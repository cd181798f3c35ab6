"""The table of measured bodies: size, aspect ratio and pole of each bubble in each frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from telerig.io.tables.smoothing import BODY_COLUMNS

_KEYS = ["frame", "particle"]


def bodies_table(tracks: Any) -> pd.DataFrame:
    """Return size and shape of each bubble in each frame of a run.

    tracks : `Tracks`; or a table with the columns of tracks.csv, or of another program, for which
        only the diameters may be known.

    Returns the columns `BODY_COLUMNS`, without rows for frames in which an outline is missing, cut
    or covered. If no shape is known in the run, the rows have diameters alone.
    """
    table: pd.DataFrame = getattr(tracks, "table", tracks)
    out = table.reindex(columns=BODY_COLUMNS)
    known = out["aspect"].notna() if out["aspect"].notna().any() else out["d_eq_mm"].notna()
    return out[known].astype(dict.fromkeys(_KEYS, np.int64)).reset_index(drop=True)
