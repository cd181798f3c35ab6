"""A strip of marks in a simulated run: how it is laid out."""

from __future__ import annotations

from dataclasses import dataclass

MARKS_AT = 0.88
"""Where a strip of marks stands, from the image's middle over half its width."""

MARKS_JITTER = 0.25
"""Unevenness of a strip of marks, over their spacing."""


@dataclass(frozen=True)
class StripConfig:
    """A strip of dots fixed to the tank for each camera, drawn into the images.

    dots : in view at a time. diameter_mm. transmission : of the ink. at, jitter : as `MARKS_AT`,
    `MARKS_JITTER`. depth_mm : its depth is drawn from -depth_mm to depth_mm.
    """

    dots: int = 6
    diameter_mm: float = 1.0
    transmission: float = 0.08
    at: float = MARKS_AT
    jitter: float = MARKS_JITTER
    depth_mm: float = 0.0
