"""One object for the results folder of each kind: for `load_*`, reports, exports and the viewer.

In: a folder of `telerig calibrate`, `track`, `smooth` or `batch`. Out: its records, its tables and
what they add up to, each read when it is asked for. Read ``calibration`` first.
"""
