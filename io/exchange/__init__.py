"""Cameras and trajectories in the formats of other programs: ``importing`` and ``export``.

In: calibrated cameras and results of runs, or files of other programs. Out: the reverse. Read
``formats`` first: it lists every export and importer.
"""
