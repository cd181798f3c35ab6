"""Tests whether a smoothed run separates the motion of the bubbles from the shake of the rig.

In: a solved smoothing graph. Out: verdict per axis, vibration modes, tests of the residuals. Read
``judge`` first, then ``identifiability``.
"""
