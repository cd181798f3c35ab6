"""What a smoothing problem is: measurements, geometry, priors.

In: tracks and sensor tables. Out: a ``SmoothingProblem``. Read ``problem`` first.
"""
