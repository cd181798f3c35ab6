"""The stages of the data's way, from images and sensors to calibrations and trajectories.

Order of the stages: ``images``, ``dots``, ``bubbles``, ``marks``, ``calibration``, ``rig_drift``,
``tracking``, ``sensors``, ``smoothing``, ``batch``. A stage knows only stages before it.
"""
