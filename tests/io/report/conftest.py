"""What tests of pages share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from undrawn_pages import undrawn_pages


@pytest.fixture
def undrawn() -> Iterator[None]:
    """The pages of one test without their drawings, which others of its module need."""
    with undrawn_pages():
        yield
