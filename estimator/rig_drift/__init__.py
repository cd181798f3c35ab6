"""This folder estimates how the cameras have moved relative to each other since the calibration.

In: the ray misses of the pairs of a tracked run. Out: the change of the pose between the cameras,
with its covariance. Read ``drift`` first.
"""
