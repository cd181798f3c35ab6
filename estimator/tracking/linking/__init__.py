"""Bubbles of consecutive frames linked to tracks.

In: the detections of a frame in each camera, and how a run's views agree. Out: rows of tracks.csv
with final ids, and events. Read ``frames``, then ``tracker``.
"""
