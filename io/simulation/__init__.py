"""Simulated datasets with their truth.

In: a preset and a random generator. Out: a dataset folder as a laboratory would have it, and
``truth/``. Read ``simulate``; ``config`` has every setting, ``presets`` the named examples.
"""
