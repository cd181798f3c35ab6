"""telerig: telecentric stereo self-calibration and shake-free 3-D bubble trajectories.

The public names; each is loaded when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from telerig.errors import TelerigError as TelerigError
    from telerig.estimator.calibrate import calibrate as calibrate
    from telerig.estimator.calibration import Calibration as Calibration
    from telerig.estimator.calibration import load_calibration as load_calibration
    from telerig.estimator.compare_calibrations import compare_calibrations as compare_calibrations
    from telerig.estimator.frontend.bubbles import detect_bubbles as detect_bubbles
    from telerig.estimator.frontend.dots import locate_dots as locate_dots
    from telerig.estimator.frontend.target_detection import detect_target as detect_target
    from telerig.estimator.smoother.model import ShakeModel as ShakeModel
    from telerig.estimator.smoother.results import Smoothing as Smoothing
    from telerig.estimator.smoother.smooth import smooth as smooth
    from telerig.estimator.track_run import track as track
    from telerig.estimator.tracks import Tracks as Tracks
    from telerig.estimator.tracks import load_tracks as load_tracks
    from telerig.estimator.uncertainty_map import uncertainty_map as uncertainty_map
    from telerig.io.dataset import Dataset as Dataset
    from telerig.io.dataset import load_dataset as load_dataset
    from telerig.io.run import load_run as load_run
    from telerig.io.simulation import simulate as simulate
    from telerig.io.simulation_presets import SimulationConfig as SimulationConfig
    from telerig.rig.triangulation import Triangulation as Triangulation

_WHERE = {
    "Calibration": "telerig.estimator.calibration",
    "Dataset": "telerig.io.dataset",
    "ShakeModel": "telerig.estimator.smoother.model",
    "SimulationConfig": "telerig.io.simulation_presets",
    "Smoothing": "telerig.estimator.smoother.results",
    "TelerigError": "telerig.errors",
    "Triangulation": "telerig.rig.triangulation",
    "calibrate": "telerig.estimator.calibrate",
    "Tracks": "telerig.estimator.tracks",
    "compare_calibrations": "telerig.estimator.compare_calibrations",
    "detect_bubbles": "telerig.estimator.frontend.bubbles",
    "detect_target": "telerig.estimator.frontend.target_detection",
    "load_calibration": "telerig.estimator.calibration",
    "load_dataset": "telerig.io.dataset",
    "load_run": "telerig.io.run",
    "load_tracks": "telerig.estimator.tracks",
    "locate_dots": "telerig.estimator.frontend.dots",
    "simulate": "telerig.io.simulation",
    "smooth": "telerig.estimator.smoother.smooth",
    "track": "telerig.estimator.track_run",
    "uncertainty_map": "telerig.estimator.uncertainty_map",
}
__all__ = ["__version__", *_WHERE]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'telerig' has no attribute {name!r}")
    return getattr(import_module(_WHERE[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
