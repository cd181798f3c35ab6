"""The camera's sensor: from grey levels to the noisy integers that it delivers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError

Image = NDArray[np.uint8] | NDArray[np.uint16]


def digitise(
    grey: NDArray[np.floating],
    rng: np.random.Generator,
    *,
    read_noise: float,
    shot_noise: float = 0.0,
    bit_depth: int = 8,
) -> Image:
    """Convert grey levels to the noisy integers that a camera delivers.

    grey : (height, width) fractions of full scale. read_noise : standard deviation. shot_noise :
    standard deviation at full scale, which grows with the root of the grey level.
    Returns (height, width) uint8 for 8 bits, otherwise uint16. Raises InputError outside 8 to 16
    bits.
    """
    if not 8 <= bit_depth <= 16:
        raise InputError(f"a bit depth of {bit_depth}", todo="choose 8 to 16 bits")
    kind = grey.dtype.type
    full = kind(2**bit_depth - 1)
    levels = rng.standard_normal(grey.shape, dtype=kind)
    levels *= np.sqrt(kind(read_noise**2) + kind(shot_noise**2) * np.clip(grey, 0, 1))
    levels += grey
    levels *= full
    np.clip(np.rint(levels, out=levels), 0, full, out=levels)
    return levels.astype(np.uint8) if bit_depth == 8 else levels.astype(np.uint16)
