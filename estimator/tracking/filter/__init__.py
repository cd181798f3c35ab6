"""One bubble's Kalman filter and its motion model.

In: measurements of one bubble. Out: predicted and smoothed states. Read ``kalman`` first; what
goes into and comes out of the tracker is in ``types``.
"""
