"""Estimates the body of a bubble from its outlines in any number of views.

In: sightings (outlines in images) and which of them show the same body. Out: its centre of volume,
size, shape and pole, with covariances. Read ``body`` first, then ``spheroid``.
"""
