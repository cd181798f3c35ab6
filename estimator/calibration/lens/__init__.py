"""The choice of each camera's lens model.

In: a ``Problem``. Out: the lens model that the data support, and what the covariance keeps open
of the rest. Read ``choice`` first.
"""
