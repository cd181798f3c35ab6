"""Names of telerig that it does not export and that the guard needs: a redesign changes them here.

Everything else is called by exported names, by commands, and through files.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from truth import true_cameras

from telerig import Calibration
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.simulation.config import RunConfig, SimulationConfig
from telerig.io.simulation.presets import preset, run_preset

__all__ = ["RunConfig", "SimulationConfig", "exact_calibration", "preset", "run_preset"]


def exact_calibration(truth: Mapping[str, Any]) -> Calibration:
    """The true cameras as a calibration. truth : content of `truth/truth.json`."""
    return calibration_from_cameras(true_cameras(truth), name="truth")
