"""`stage_axis/` of a simulated dataset: the target at rest while the stage travels past it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.files.atomic import write_json_atomic
from telerig.io.files.csv_table import write_table
from telerig.io.simulation.calibration.scene import TrueTarget, View, hand_held_views, wholly_inside
from telerig.io.simulation.calibration_files import exact_dots, measured_dots, write_images
from telerig.io.simulation.config import RunConfig
from telerig.io.simulation.run.scene import AXIS_RIG
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

_LEAST_VIEWS = 3
_TRIES = 50
_LEAST_DOTS = 0.3
_SHORTER = 0.8


def write_stage_axis(
    config: RunConfig,
    cameras: Mapping[str, Camera],
    target: TrueTarget,
    folder: Path,
    rng: np.random.Generator,
    *,
    images: bool,
) -> None:
    """positions.csv with images or dots.csv in ``folder / "stage_axis"``, and the truth.

    The travel is ``stage.axis_travel_mm``, or less where the target would leave the images.
    Raises InputError for fewer than three views, or when no pose keeps the target in them.
    """
    if config.stage.axis_views < _LEAST_VIEWS:
        raise InputError(
            f"axis_views is {config.stage.axis_views}",
            where=f"simulation {config.name!r}",
            todo=f"must be 0, or {_LEAST_VIEWS} or more",
        )
    pose_rng, encoder_rng, picture_rng = rng.spawn(3)
    stage, calibration = config.stage, config.calibration
    views, stops = _views(config, cameras, target, pose_rng)
    noise = stage.encoder_sigma_mm * encoder_rng.standard_normal(len(stops))
    readings = (1 + stage.encoder_scale) * stops + noise
    out = folder / "stage_axis"
    out.mkdir(parents=True)
    write_table(
        pd.DataFrame({"view": [v.name for v in views], "position_mm": readings}),
        out / "positions.csv",
    )
    if images:
        write_images(calibration, cameras, target, views, out, picture_rng)
    else:
        exact = exact_dots(calibration, cameras, target, views)
        write_table(measured_dots(calibration, exact, cameras, picture_rng), out / "dots.csv")
    truth = {"axis": AXIS_RIG, "encoder_scale": stage.encoder_scale, "position_mm": stops}
    write_json_atomic(folder / "truth" / "stage_axis.json", truth)


def _views(
    config: RunConfig,
    cameras: Mapping[str, Camera],
    target: TrueTarget,
    rng: np.random.Generator,
) -> tuple[list[View], Array]:
    """A pose that both cameras see at every stop, and the stops in mm."""
    upright = replace(
        config.calibration, views=1, roll_deg=0.0, single_camera_views=0, shift_mm=(1.0, 1.0, 1.0)
    )
    count, travel = config.stage.axis_views, config.stage.axis_travel_mm
    for _ in range(_TRIES):
        pose = hand_held_views(upright, cameras, target, rng)[0].rig_from_target
        stops = travel * np.linspace(-0.5, 0.5, count)
        views = [
            View(f"stop{i:02d}", _at(pose, float(stop)), tuple(cameras))
            for i, stop in enumerate(stops)
        ]
        border = config.calibration.border_px
        shares = [
            wholly_inside(camera, view.rig_from_target, target, border).mean()
            for view in views
            for camera in cameras.values()
        ]
        if min(shares) >= _LEAST_DOTS:
            return views, stops
        travel *= _SHORTER
    raise InputError(
        "no pose keeps the target in both images while the stage travels",
        where=f"simulation {config.name!r}",
        todo="make axis_travel_mm or the target smaller",
    )


def _at(pose: Pose, stop_mm: float) -> Pose:
    return Pose(pose.rotation, pose.translation_mm - AXIS_RIG * stop_mm)
