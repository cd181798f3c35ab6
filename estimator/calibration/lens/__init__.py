"""The choice of each camera's lens model.

In: a ``Problem`` and a start. Out: the lens model that the data support, and which parameters the
covariance considers besides. Read ``choice`` first.
"""
