"""telerig calibrates a rig of telecentric cameras from images of a dot target and gives 3-D
trajectories of bubbles without the rig's shake.

This module holds the public names. Each one is imported when it is first used, so that `import
telerig` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from telerig.version import VERSION

__version__ = VERSION

if TYPE_CHECKING:
    from telerig.errors import TelerigError as TelerigError
    from telerig.estimator.bubbles.detect import detect_bubbles as detect_bubbles
    from telerig.estimator.calibration.calibrate import calibrate as calibrate
    from telerig.estimator.calibration.quality.comparison import (
        compare_calibrations as compare_calibrations,
    )
    from telerig.estimator.calibration.quality.uncertainty_map import (
        uncertainty_map as uncertainty_map,
    )
    from telerig.estimator.calibration.result.calibration import Calibration as Calibration
    from telerig.estimator.calibration.result.calibration import (
        load_calibration as load_calibration,
    )
    from telerig.estimator.dots.dataset_dots import detect_target as detect_target
    from telerig.estimator.dots.locate import locate_dots as locate_dots
    from telerig.estimator.sensors.findings import SensorError as SensorError
    from telerig.estimator.sensors.given import AccelerometerRecord as AccelerometerRecord
    from telerig.estimator.smoothing.problem.problem import ShakeModel as ShakeModel
    from telerig.estimator.smoothing.result import Smoothing as Smoothing
    from telerig.estimator.smoothing.result import bubble_summary as bubble_summary
    from telerig.estimator.smoothing.result import bubble_table as bubble_table
    from telerig.estimator.smoothing.result import load_smoothing as load_smoothing
    from telerig.estimator.smoothing.smooth import smooth as smooth
    from telerig.estimator.tracking.track import track as track
    from telerig.estimator.tracking.tracks import Tracks as Tracks
    from telerig.estimator.tracking.tracks import load_tracks as load_tracks
    from telerig.io.dataset.dataset import Dataset as Dataset
    from telerig.io.dataset.dataset import load_dataset as load_dataset
    from telerig.io.dataset.run import load_run as load_run
    from telerig.io.report import plot as plot
    from telerig.io.simulation.config import SimulationConfig as SimulationConfig
    from telerig.io.simulation.simulate import simulate as simulate
    from telerig.io.view.show import view as view
    from telerig.rig.triangulation import Triangulation as Triangulation

_WHERE = {
    "AccelerometerRecord": "telerig.estimator.sensors.given",
    "Calibration": "telerig.estimator.calibration.result.calibration",
    "Dataset": "telerig.io.dataset.dataset",
    "SensorError": "telerig.estimator.sensors.findings",
    "ShakeModel": "telerig.estimator.smoothing.problem.problem",
    "SimulationConfig": "telerig.io.simulation.config",
    "Smoothing": "telerig.estimator.smoothing.result",
    "TelerigError": "telerig.errors",
    "Triangulation": "telerig.rig.triangulation",
    "bubble_summary": "telerig.estimator.smoothing.result",
    "bubble_table": "telerig.estimator.smoothing.result",
    "calibrate": "telerig.estimator.calibration.calibrate",
    "Tracks": "telerig.estimator.tracking.tracks",
    "compare_calibrations": "telerig.estimator.calibration.quality.comparison",
    "detect_bubbles": "telerig.estimator.bubbles.detect",
    "detect_target": "telerig.estimator.dots.dataset_dots",
    "load_calibration": "telerig.estimator.calibration.result.calibration",
    "load_dataset": "telerig.io.dataset.dataset",
    "load_run": "telerig.io.dataset.run",
    "load_smoothing": "telerig.estimator.smoothing.result",
    "load_tracks": "telerig.estimator.tracking.tracks",
    "locate_dots": "telerig.estimator.dots.locate",
    "plot": "telerig.io.report.plot",
    "simulate": "telerig.io.simulation.simulate",
    "smooth": "telerig.estimator.smoothing.smooth",
    "track": "telerig.estimator.tracking.track",
    "uncertainty_map": "telerig.estimator.calibration.quality.uncertainty_map",
    "view": "telerig.io.view.show",
}
__all__ = ["__version__", *_WHERE]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'telerig' has no attribute {name!r}")
    module = import_module(_WHERE[name])
    return module if name == "plot" else getattr(module, name)


def __dir__() -> list[str]:
    return sorted(__all__)
