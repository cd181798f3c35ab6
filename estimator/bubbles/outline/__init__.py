"""Sub-pixel outlines of bubbles: ellipses with harmonics, fitted to the pixels at the rim.

In: an image divided by its background. Out: outlines with covariance. Read ``blobs`` (dark
regions, overlapping bubbles), then ``outline_fit``.
"""
