"""Cameras and trajectories in the formats of other programs: ``importing`` and ``export``."""
