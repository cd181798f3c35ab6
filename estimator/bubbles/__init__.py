"""Bubbles in backlit images: background, sub-pixel outlines, shapes, pairs across two views.

In: grey images. Out: tables of outlines with covariance and flags, pairs, centres of volume. Read
``detect`` first.
"""
