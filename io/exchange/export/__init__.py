"""Calibrations and trajectories in the formats of other programs; see docs/exports.md.

In: cameras, or the results folder of a run (``run_results``). Out: one file or folder per format.
Read ``volume`` (where cameras are compared), then one format, such as ``opencv``.
"""
