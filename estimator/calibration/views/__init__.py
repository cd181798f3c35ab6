"""The next best view of the target.

In: a fitted calibration with its covariance. Out: poses in which one more view would reduce the
uncertainty in space most, and words for whoever holds the target. Read ``next_view`` first.
"""
