"""The bright-field level behind the bubbles.

In: frames of a run, or one image. Out: the level of every pixel without bubbles. Read
``from_run`` first.
"""
