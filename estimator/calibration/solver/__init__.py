"""The least-squares problem of a self-calibration, its solution and its covariance.

In: a ``Problem`` and a start. Out: the fitted state, weights, joint covariance. Read ``problem``,
then ``graph``.
"""
