"""What tests of pages share."""

from __future__ import annotations

import pytest

from telerig.io.report.page.figures import Picture
from telerig.io.report.run import report


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's words without its drawings, which take seconds."""
    blank = Picture("", "data:,", "")
    monkeypatch.setattr(report, "drawn_over_cores", lambda drawings: [blank] * len(drawings))
