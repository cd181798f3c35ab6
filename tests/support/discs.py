"""The centre of a disc's image from its projected rim."""

from __future__ import annotations

from typing import Any

import numpy as np


def polygon_centroid(rim: Any) -> Any:
    """Area centroid of a closed polygon (shoelace formula)."""
    x, y = (rim - rim.mean(0)).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    centre = [((a + np.roll(a, -1)) * cross).sum() / (3 * cross.sum()) for a in (x, y)]
    return np.array(centre) + rim.mean(0)
