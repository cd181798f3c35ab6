"""The true rig and target of a simulated calibration.

In: a preset. Out: true cameras, dots, poses. Read ``presets`` first.
"""
