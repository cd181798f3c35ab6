"""Self-calibration: from tables of dots to cameras, poses and target, with their covariance.

In: numbered dots and ``rig.toml``. Out: a ``Calibration`` and its results folder. Read
``calibrate``, then ``self_calibration``.
"""
