"""Images and videos read from disk.

In: files. Out: grey arrays. Read ``read`` (one image) or ``frames`` (a camera's frames of a run).
"""
