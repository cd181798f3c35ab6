"""The file ``rig.toml``: all that is known of a rig before calibration.

In: TOML. Out: a ``RigDescription``. Read ``description``, then ``rig_file``.
"""
