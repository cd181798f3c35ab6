"""Sub-pixel outlines of bubbles: ellipses with harmonics, fitted to the pixels at the rim.

In: an image divided by its background. Out: outlines with covariance. Read ``regions`` (dark
blobs), ``split`` (overlapping bubbles), then ``outline_fit``.
"""
