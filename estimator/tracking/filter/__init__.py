"""One bubble's Kalman filter and its motion model.

In: measurements of one bubble. Out: predicted and smoothed states. Read ``types`` and ``state``
first.
"""
