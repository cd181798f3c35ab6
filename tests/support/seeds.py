"""Statistics over random draws: a few by default, many with `-m slow`."""

from __future__ import annotations

from typing import Any

import pytest


def first_or_all(*cases: Any) -> list[Any]:
    """Values for `parametrize`: the first by default, the others, which repeat it, as slow."""
    return [cases[0], *(pytest.param(case, marks=pytest.mark.slow) for case in cases[1:])]


def few_or_many(few: int, many: int) -> Any:
    """Parametrise a test with ``draws``, of which ``many`` are marked as slow."""
    return pytest.mark.parametrize("draws", [few, pytest.param(many, marks=pytest.mark.slow)])
