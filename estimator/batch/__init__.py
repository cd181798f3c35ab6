"""Many datasets and runs, calibrated, tracked and smoothed: one job at a time or many at once.

In: dataset folders (`jobs`). Out: their results folders, and the records of a batch (`records`).
Read ``jobs``, then ``batch``; ``work`` does one job.
"""
