"""A short name of what a task was given: two runs compare draw by draw only if it is the same."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd


def digest(*given: Any) -> str:
    """Of arrays and tables, to nine digits (an order of sums may differ), and of files."""
    code = hashlib.sha256()
    for one in given:
        if isinstance(one, Path):
            code.update(one.read_bytes())
            continue
        numbers = one.select_dtypes("number") if isinstance(one, pd.DataFrame) else one
        values = np.asarray(numbers)
        if values.dtype.kind == "f":
            size = np.nanmax(np.abs(values), initial=1e-300)
            values = np.round(values.astype(np.float64) / size, 9) + 0.0
        code.update(np.ascontiguousarray(values).tobytes())
    return code.hexdigest()[:8]
