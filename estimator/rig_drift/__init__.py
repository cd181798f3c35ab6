"""Movement of the cameras against each other since the calibration.

In: the ray misses of a tracked run's pairs. Out: the change of the pose between the cameras, with
its covariance. Read ``drift`` first.
"""
