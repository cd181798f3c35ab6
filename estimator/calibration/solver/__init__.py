"""This folder defines and solves the least-squares problem of a self-calibration, with its
covariance.

In: a ``Problem`` and a start. Out: the fitted state, the weights of the dots and the joint
covariance. Read ``problem``, then ``robust_least_squares``.
"""
