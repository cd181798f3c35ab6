"""The tables of a smoothed run, and of the bubbles of many."""

from __future__ import annotations

from dataclasses import replace

from telerig.io.files.csv_table import Column
from telerig.io.tables.table import (
    FRAME,
    OF_CALIBRATION,
    OF_SHAPE,
    OF_SIZE,
    PARTICLE,
    TIME,
    Table,
    may,
    sd,
    sure,
    whole,
    xyz,
)

AXES = ("x", "y", "z")
POSITION, VELOCITY, ACCELERATION = "{}_mm", "v{}_mm_s", "a{}_mm_s2"
"""Patterns of column names for one axis: position (mm), velocity (mm/s), acceleration (mm/s^2).

A leading "s" marks the standard deviation, "naive_" and "rts_" two simpler estimates.
"""
STATE = tuple(pattern.format(axis) for pattern in (POSITION, VELOCITY) for axis in AXES)
"""The names of the columns of position (mm) and velocity (mm/s)."""

_ID = replace(PARTICLE, kind="whole")
_OBSERVED = may("observed", "", "1 where a camera saw the bubble, and not as an outlier, else 0")


def _state(prefix: str, what: str) -> list[Column]:
    """Declare position and velocity along x, y and z."""
    return [
        *may(xyz(f"{prefix}{POSITION}"), "mm", f"position {what}"),
        *may(xyz(f"{prefix}{VELOCITY}"), "mm s-1", f"velocity {what}"),
    ]


def _with_sd(name: str, unit: str, what: str) -> list[Column]:
    """Declare a number and its standard deviation."""
    return [*may(name, unit, what), *sd(f"s_{name}", unit)]


_MOTION = (
    *may(xyz(VELOCITY), "mm s-1", "velocity in the laboratory frame"),
    *sd(xyz(f"s{VELOCITY}"), "mm s-1"),
    *may(xyz(ACCELERATION), "mm s-2", "acceleration in the laboratory frame"),
    *sd(xyz(f"s{ACCELERATION}"), "mm s-2"),
)
NUMBERS = ("reynolds", "weber", "eotvos", "drag")
"""Dimensionless numbers; the standard deviation of each has the prefix ``s_``."""
_NUMBERS = (
    *_with_sd("reynolds", "", "Reynolds number of d_eq_mm and the slip velocity"),
    *_with_sd("weber", "", "Weber number of d_eq_mm and the slip velocity"),
    *_with_sd("eotvos", "", "Eötvös number of d_eq_mm"),
    *_with_sd("drag", "", "drag coefficient, on the cross-section of the sphere of equal volume"),
)

TRAJECTORIES = Table(
    "trajectories.csv",
    "a frame between a bubble's first and last detection",
    (
        FRAME, _ID, TIME,
        *(replace(one, blank=False) for one in _state("", "in the laboratory frame")),
        *(replace(one, kind="sd") for one in _state(
            "s", "(standard deviation; of the position with the calibration's errors)")),
        *_state("naive_", "by triangulating and adding the encoder"),
        *_state("rts_", "by a plain smoother; blank for tracks of more than 5,000 frames, and "
                "beyond the first 40,000 rows"),
        *(replace(one, kind="whole", blank=False) for one in _OBSERVED),
        *_MOTION[6:],
        *OF_SIZE[:1],
        *OF_CALIBRATION,
    ),
)  # fmt: skip

SHAKE = Table(
    "shake.csv",
    "a frame of the run",
    (
        FRAME, TIME,
        *sure([f"{{camera}}_{axis}_mm" for axis in AXES], "mm",
              "shake of the camera: its offset from where the carriage's position puts it"),
        *sd([f"s{{camera}}_{axis}_mm" for axis in AXES], "mm"),
        *may("position_mm", "mm", "position of the carriage"),
        *sd("sposition_mm", "mm"),
    ),
)  # fmt: skip

BUBBLES = Table(
    "bubbles.csv",
    "a row of trajectories.csv",
    (
        FRAME, _ID, *may("t_s", "s", TIME.what),
        *OF_SIZE, *OF_SHAPE[:3], *_MOTION, *_NUMBERS,
        *may("added_mass", "", "added-mass coefficient along the slip velocity"),
        *_with_sd("slip_mm_s", "mm s-1", "speed relative to the liquid"),
        *_with_sd("curvature_1_mm", "mm-1", "curvature of the path in the laboratory"),
        *OF_SHAPE[3:],
        *may(xyz(POSITION), "mm", "position in the laboratory frame"),
        *sd(xyz(f"s{POSITION}"), "mm"),
        *_OBSERVED,
    ),
)  # fmt: skip
BODY_COLUMNS = ["frame", "particle", *(c.name for c in (*OF_SIZE, *OF_SHAPE))]
"""Those that outlines alone tell."""

SUMMARY = Table(
    "bubble_summary.csv",
    "a bubble of the run",
    (
        _ID,
        whole("first_frame", "first frame with the bubble"),
        whole("last_frame", "last frame with the bubble"),
        whole("frames", "frames with an image of it"),
        *may("lifetime_s", "s", "time from the first to the last"),
        *OF_SIZE, *OF_SHAPE[:4],
        *_with_sd("rise_mm_s", "mm s-1", "height gained over the time"),
        *_with_sd("slip_mm_s", "mm s-1", "mean speed relative to the liquid"),
        *_with_sd("zigzag_hz", "Hz", "frequency of the strongest lateral oscillation"),
        *_with_sd("zigzag_mm", "mm", "its amplitude (semi-axis)"),
        *_with_sd("zigzag_minor_mm", "mm", "its other semi-axis: 0 in a plane, equal for a helix"),
        *_with_sd("strouhal", "", "zigzag_hz d_eq_mm / slip_mm_s"),
        *_with_sd("shape_hz", "Hz", "frequency of the aspect ratio, above twice the zigzag's"),
        *_with_sd("shape_amplitude", "", "relative amplitude of this oscillation"),
        *_NUMBERS,
    ),
)  # fmt: skip

BATCH_BUBBLES = Table(
    "bubbles.csv of a batch",
    "a bubble of a smoothed run",
    (
        Column("dataset", "text", what="folder of the dataset"),
        Column("run", "name", what="name of the run"),
        *SUMMARY.columns,
    ),
)
