"""Defines the smoothing problem: measurements, geometry and priors of one run.

In: tracks and sensor tables. Out: a ``SmoothingProblem``. Read ``problem`` first.
"""
