"""This folder calibrates the stage: its direction of travel and the scale of its encoder.

In: the folder ``stage_axis/`` of a dataset, and a calibration of the cameras. Out: axis and scale
with their covariance. Read ``stage_axis`` first.
"""
