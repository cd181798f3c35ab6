"""Films of a run: the path in space turned round, and all cameras' images with what was found.

In: a tracked run's results folder, the calibration beside it, and for ``views`` the recording's
images. Out: an MP4 file (``mp4``). Read ``path`` and ``views`` first.
"""
