"""The smoothing graph: bubble motion and rig shake separated, with a verdict.

In: ``Tracks``, a ``Calibration``, sensors. Out: a ``Smoothing`` and its files. Read ``smooth``
first.
"""
