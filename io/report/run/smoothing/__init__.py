"""The smoothing section of a run's page: words and tables, numbers, figures. Read ``tables`` first.

In: smoothing.json, trajectories.csv and shake.csv. Out: words, rows and pictures for the template.
"""
