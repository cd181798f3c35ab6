"""Calibrations and trajectories in the formats of other programs; see docs/exports.md."""
