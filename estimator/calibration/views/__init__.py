"""The next best view of the target.

In: a fitted calibration. Out: poses in which one more view would help most. Read ``next_view``
first.
"""
