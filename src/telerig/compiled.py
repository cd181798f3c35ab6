"""Compiles loops over pixels and points with numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Return the function, compiled when it is first called.

    The machine code is kept for later processes, beside the source file or in the user's cache
    folder; ``NUMBA_CACHE_DIR`` names another one. If none of these can be written, each process
    compiles for itself.

    Sums may be reordered. NaN and infinity keep their meaning in comparisons, so write
    ``abs(x) < np.inf``: ``np.isfinite`` of a sum may be simplified to True.
    """
    options = {"fastmath": {"reassoc", "contract", "nsz", "arcp"}, "error_model": "numpy"}
    try:
        kept: _Function = njit(cache=True, **options)(function)
    except RuntimeError:  # no folder for the cache
        kept = njit(**options)(function)
    return kept
