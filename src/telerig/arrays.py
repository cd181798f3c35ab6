"""These types name arrays by what they hold. The docstring of each function that takes or returns
an array states its shape."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Ints = NDArray[np.int64]
