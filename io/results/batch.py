"""What the records of a batch say together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any


def verdict_of(record: Mapping[str, Any]) -> str:
    """Return the verdict of a job without its flags; "" for a job without one."""
    words = str((record.get("figures") or {}).get("verdict") or "").split()
    return words[0] if words else ""


def verdict_counts(records: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Return how often each verdict occurs among the jobs that were done."""
    found = (verdict_of(record) for record in records if record.get("status") == "done")
    return dict(Counter(word for word in found if word))
