"""Pages without their drawings, which take seconds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from telerig.io.report.batch import report as of_batch
from telerig.io.report.calibration import report as of_calibration
from telerig.io.report.page.figures import Picture
from telerig.io.report.run import report as of_run


@contextmanager
def undrawn_pages() -> Iterator[None]:
    """Pages that are written meanwhile have their words, tables and colours alone."""
    blanks = {of_batch: None, of_calibration: [], of_run: Picture("", "data:,", "")}
    with pytest.MonkeyPatch.context() as patch:
        for module, blank in blanks.items():
            patch.setattr(
                module, "drawn_over_cores", lambda drawings, blank=blank: [blank] * len(drawings)
            )
        yield
