"""Dots of the calibration target in an image: located, fitted, numbered.

In: grey images and the target's description. Out: tables of dots with covariance, and the reason
for every rejection. Read ``locate`` (unordered dots), then ``detect_target`` (numbered ones).
"""
