"""Marks: dots of a strip that is fixed to the tank and seen in the bubble images.

In: images of a run. Out: the place of every mark in every frame, and images from which the marks
are erased. Read ``strip_dots`` first, then ``following``.
"""
