"""Estimates the body of a bubble from its outlines in two views.

In: both outlines of each bubble. Out: its centre of volume and its spheroid, with covariances.
Read ``volume_centroid`` first, then ``spheroid``.
"""
