"""The luminance model of one dot and its least-squares fit to the pixels.

In: an image and the rough outlines of its blobs. Out: centre, ellipse, covariance, chi-square, or
a reason for rejection. Read ``candidates``, then ``luminance``.
"""
