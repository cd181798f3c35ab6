"""The codes of what the checks of a calibration, of a stage or of images found."""

from __future__ import annotations

from typing import Any

from telerig.io.results.findings import Code, Finding


def codes(found: Any) -> list[str]:
    """The codes of ``found.findings``, in their order."""
    return [finding.code.name for finding in found.findings]


def only(found: Any, code: Code) -> Finding:
    """The only finding with that code."""
    (finding,) = (f for f in found.findings if f.code is code)
    return finding
