"""Detections to tracks: bubbles followed in time and triangulated.

In: a run and a calibration. Out: ``Tracks`` and a results folder. Read ``track``, then
``linking``.
"""
