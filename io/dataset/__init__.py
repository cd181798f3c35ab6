"""A dataset folder: calibration views, runs and their tables.

In: a folder. Out: ``Dataset`` and ``RunData``. Read ``dataset``, then ``run``.
"""
