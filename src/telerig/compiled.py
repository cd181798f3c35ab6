"""Compiles loops over pixels and points with numba."""

from __future__ import annotations

from collections.abc import Callable
from multiprocessing import parent_process
from typing import Any, TypeVar

from numba import njit
from numba.core import event

from telerig.progress import tell

_Function = TypeVar("_Function", bound=Callable[..., Any])


class _FirstCompilation(event.Listener):  # type: ignore[misc]
    """Tell the user why the first call of a new installation takes long."""

    told = False

    def on_start(self, started: event.Event) -> None:
        """Say it once, in the process that the user has started."""
        ours = started.data["dispatcher"].py_func.__module__.startswith("telerig.")
        if ours and not self.told and parent_process() is None:
            self.told = True
            tell("compiling loops, once for this installation")

    def on_end(self, _ended: event.Event) -> None:
        pass


FIRST = _FirstCompilation()
event.register("numba:compile", FIRST)


def compiled(function: _Function) -> _Function:
    """Return the function, compiled when it is first called.

    The machine code is kept for later processes, beside the source file or in the user's cache
    folder; ``NUMBA_CACHE_DIR`` names another one. If none of these can be written, each process
    compiles for itself.

    Sums may be reordered. NaN and infinity keep their meaning in comparisons, so write
    ``abs(x) < np.inf``: ``np.isfinite`` of a sum may be simplified to True.

    The function cannot be passed to other compiled ones, which makes compiling faster.
    """
    options = {
        "fastmath": {"reassoc", "contract", "nsz", "arcp"}, "error_model": "numpy",
        "no_cfunc_wrapper": True,
    }  # fmt: skip
    try:
        kept: _Function = njit(cache=True, **options)(function)
    except RuntimeError:  # no folder for the cache
        kept = njit(**options)(function)
    return kept
