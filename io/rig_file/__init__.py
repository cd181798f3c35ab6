"""The file ``rig.toml``: all that is known of a rig before calibration.

In: TOML. Out: a ``RigDescription``. Read ``description`` (what a file may hold), then ``rig_file``.
"""
