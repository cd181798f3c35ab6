"""Lists the methods that estimate the background of a run, by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from numpy.typing import NDArray

from telerig.arrays import Array, Float32
from telerig.errors import InputError, suggestion
from telerig.estimator.bubbles.background.from_run import estimate_background

Images = Callable[[int], NDArray[Any] | None]


class RunBackground(Protocol):
    """The background of a run for one camera, as any method returns it."""

    def of_frame(self, frame: int) -> Float32:
        """Return the level (H, W) of the lit screen in a frame, in grey values."""


class Method(Protocol):
    """Estimates a background from the images of one camera; see `estimate_background`."""

    def __call__(
        self, images: Images, frame_count: int, *, shift_px: Array | None
    ) -> RunBackground: ...


DEFAULT = "layers"
METHODS: dict[str, Method] = {"layers": estimate_background}


def method(name: str) -> Method:
    """Return the method with this name. Raises InputError for an unknown name."""
    if name not in METHODS:
        raise InputError(
            f"there is no background method {name!r}", todo=suggestion(name, list(METHODS))
        )
    return METHODS[name]
