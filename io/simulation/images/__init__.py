"""Images rendered from geometry alone.

In: a scene. Out: grey images of plates and backlit bubbles. Read ``plates`` or ``bubbles``.
"""
