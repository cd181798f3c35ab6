"""The page of a run: its tracking, and its smoothing if there is one.

In: a tracked run's results folder. Out: report.html. Read ``report`` first.
"""
