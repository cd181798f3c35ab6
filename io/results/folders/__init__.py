"""A whole results folder in memory, read and checked: for reports, films and the viewer.

In: a folder of `telerig calibrate`, `track` or `smooth`. Out: its records, its tables and what they
add up to. Read ``calibration`` first.
"""
