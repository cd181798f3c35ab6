"""Marks fixed to the tank and seen in the bubble images.

In: images of a run. Out: every mark's place in every frame, and images from which the marks are
erased. Read ``strip_dots`` first, then ``following``.
"""
