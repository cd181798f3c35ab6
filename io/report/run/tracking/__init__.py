"""The tracking section of a run's page: words and tables, numbers, figures, the 3-D scene.

In: tracking.json and its tables. Out: words, rows and pictures for the template. Read ``tables``.
"""
