"""The names of the presets, for the help of the command line, which must not load NumPy."""

from __future__ import annotations

CALIBRATIONS = (
    "paper", "dense", "scheimpflug", "near_telecentric", "symmetric", "unbounded", "two_sided",
    "three",
)  # fmt: skip
RUNS = (
    "rise", "swarm", "swarm_three", "swarm_four", "crossing", "forces", "S0", "S1", "S2", "S3",
    "S4", "S5", "S6",
)  # fmt: skip
