"""Pages without their drawings, which take seconds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from telerig.io.report.page import page


@contextmanager
def undrawn_pages() -> Iterator[None]:
    """Pages that are written meanwhile have their words, tables and colours alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "drawn_over_cores", lambda drawings: [None] * len(drawings))
        yield
