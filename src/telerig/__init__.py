"""telerig: telecentric stereo self-calibration and shake-free 3-D bubble trajectories."""

from __future__ import annotations

__version__ = "0.1.0"
