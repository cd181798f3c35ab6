"""What the C library does with memory that arrays gave back."""

from __future__ import annotations

import numpy as np

FREED_BYTES = 16 << 20
"""No more than 32 MB, where glibc stops to learn."""


def keep_freed_memory() -> None:
    """Let the C library keep what is freed, up to twice `FREED_BYTES`, for the next array.

    glibc gives blocks beyond a limit back to the system, whose fresh pages cost 5 us each, twice
    what is computed in them. A block that was freed raises the limit to its size (mallopt(3),
    M_MMAP_THRESHOLD); nothing is written into it, so that it takes no memory.
    """
    np.empty(FREED_BYTES, np.uint8)
