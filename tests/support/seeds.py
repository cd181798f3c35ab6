"""Statistics over random draws: a few by default, many with `-m slow`."""

from __future__ import annotations

from typing import Any

import pytest


def few_or_many(few: int, many: int) -> Any:
    """Parametrise a test with ``draws``, of which ``many`` are marked as slow."""
    return pytest.mark.parametrize("draws", [few, pytest.param(many, marks=pytest.mark.slow)])
