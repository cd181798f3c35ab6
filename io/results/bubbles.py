"""Describe bubbles.csv and bubble_summary.csv: sizes, motion and forces of the bubbles of a run."""

from __future__ import annotations

from telerig.io.files.csv_table import Column
from telerig.io.results.bodies import SHAPE_COLUMNS

_VELOCITY = [f"{s}v{a}_mm_s" for s in ("", "s") for a in "xyz"]
_ACCELERATION = [f"{s}a{a}_mm_s2" for s in ("", "s") for a in "xyz"]
_PLACE = [f"{s}{a}_mm" for s in ("", "s") for a in "xyz"]
NUMBERS = ("reynolds", "weber", "eotvos", "drag")
"""Dimensionless numbers; the standard deviation of each has the prefix ``s_``."""

_WITH_SD = [f"{s}{name}" for name in NUMBERS for s in ("", "s_")]

BODY_COLUMNS = ["frame", "particle", "d_eq_mm", "sd_eq_mm", *SHAPE_COLUMNS]
"""What outlines alone tell of a bubble in a frame."""

FRAME_COLUMNS = [
    "frame", "particle", "t_s", *BODY_COLUMNS[2:7], *_VELOCITY, *_ACCELERATION, *_WITH_SD,
    "added_mass", "slip_mm_s", "s_slip_mm_s", "curvature_1_mm", "s_curvature_1_mm",
    *BODY_COLUMNS[7:], *_PLACE, "observed",
]  # fmt: skip
"""bubbles.csv, one row per bubble and frame."""

SUMMARY_COLUMNS = [
    "particle", "first_frame", "last_frame", "frames", "lifetime_s",
    "d_eq_mm", "sd_eq_mm", "aspect", "s_aspect", "tilt_deg", "s_tilt_deg",
    "rise_mm_s", "s_rise_mm_s", "slip_mm_s", "s_slip_mm_s",
    "zigzag_hz", "s_zigzag_hz", "zigzag_mm", "s_zigzag_mm", "zigzag_minor_mm", "s_zigzag_minor_mm",
    "strouhal", "s_strouhal", "shape_hz", "s_shape_hz", "shape_amplitude", "s_shape_amplitude",
    *_WITH_SD,
]  # fmt: skip
"""bubble_summary.csv, one row per bubble."""

WHOLE = ("frame", "particle", "first_frame", "last_frame", "frames")


def _columns(names: list[str]) -> list[Column]:
    return [
        Column(name, "whole") if name in WHOLE else Column(name, required=False, blank=True)
        for name in names
    ]


BUBBLES, SUMMARY = _columns(FRAME_COLUMNS), _columns(SUMMARY_COLUMNS)
"""Both tables as they are read."""
