"""Films of a run: the path in space turned round, and all cameras' images with what was found.

In: a tracked run's results folder, the calibration beside it, and for ``views`` the recording's
images. Out: MP4 and GIF files (``files``). Read ``path`` and ``views`` first.
"""
