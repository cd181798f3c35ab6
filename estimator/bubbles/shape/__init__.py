"""The body of a bubble from its two outlines.

In: the outlines of one bubble in two cameras. Out: the centre of its volume with covariance. Read
``volume_centroid`` first.
"""
