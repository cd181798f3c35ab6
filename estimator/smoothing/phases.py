"""The phases of a smoothing: what is being done, as a callback, and the seconds that each took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from telerig.estimator.smoothing.graph.solve import Progress
from telerig.progress import Progress as Steps


class Phases:
    """Report phases to a callback and keep their wall time in ``seconds``, by name.

    steps : function that is called with the words of the phase, the share that is done, and 1;
        none for True and False.
    """

    def __init__(self, steps: Steps | bool) -> None:
        self.steps = None if isinstance(steps, bool) else steps
        self.seconds: dict[str, float] = {}

    def progress(self, what: str, share: float) -> None:
        """Report the share that is done."""
        if self.steps is not None:
            self.steps(what, float(share), 1)

    @contextmanager
    def phase(self, name: str, words: str = "") -> Iterator[Progress]:
        """Report a phase as begun and as done.

        Yields a callback for its share; the words that it is given follow those of the phase.

        name : key of ``seconds``.  words : what the callback gets; "" for the name.
        """
        words, begun = words or name, time.perf_counter()
        self.progress(words, 0.0)
        yield lambda what, share: self.progress(f"{words}: {what}" if what else words, share)
        self.progress(words, 1.0)
        took = time.perf_counter() - begun
        self.seconds[name] = round(self.seconds.get(name, 0.0) + took, 3)
