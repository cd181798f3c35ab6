"""The phases of a smoothing: what is being done, as a callback, and the seconds that each took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from telerig.estimator.smoothing.graph.solve import Progress


class Phases:
    """Report phases to a callback and keep their wall time in ``seconds``, by name."""

    def __init__(self, progress: Progress | None) -> None:
        self.progress: Progress = progress or (lambda _what, _share: None)
        self.seconds: dict[str, float] = {}

    @contextmanager
    def phase(self, name: str, words: str = "") -> Iterator[Progress]:
        """Report a phase as begun and as done.

        Yields a callback for its share; the words that it is given follow those of the phase.

        name : key of ``seconds``.  words : what the callback is told; "" for the name.
        """
        words, begun = words or name, time.perf_counter()
        self.progress(words, 0.0)
        yield lambda what, share: self.progress(f"{words}: {what}" if what else words, share)
        self.progress(words, 1.0)
        took = time.perf_counter() - begun
        self.seconds[name] = round(self.seconds.get(name, 0.0) + took, 3)
