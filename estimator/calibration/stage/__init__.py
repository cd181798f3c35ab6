"""The stage's travel axis and the encoder's scale.

In: ``stage_axis/`` of a dataset and a calibration. Out: axis and scale with covariance. Read
``stage_axis`` first.
"""
