"""How the cameras have moved relative to each other since the calibration, from ray misses.

In: a table of tracks and the calibration. Out: a `RigChange` of each pair of cameras. Read
``estimate.py`` first; ``ray_misses.py`` is the geometry, ``noise.py`` the noise of ray misses.
"""

from telerig.estimator.rig_drift.movement import DriftPrior

__all__ = ["DriftPrior"]
