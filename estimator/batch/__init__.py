"""Many datasets and runs, calibrated, tracked and smoothed: one job at a time or many at once.

In: dataset folders. Out: their results folders, and the records of a batch. Read ``jobs``, then
``batch``.
"""
