"""This folder chooses the lens model of each camera.

In: a ``Problem`` and a start. Out: the lens model that the data support, and the parameters that
the covariance considers in addition. Read ``choice`` first.
"""
