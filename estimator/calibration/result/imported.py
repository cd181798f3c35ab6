"""Cameras that another program calibrated, as a `Calibration` that tracking can use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from telerig.errors import CalibrationError
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.solver.covariance import POSE_COMPONENTS
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

NO_COVARIANCE = (
    "imported: the calibration's own uncertainty is unknown and counted as none, so covariances "
    "of points hold the measurement's share only"
)


def calibration_from_cameras(
    cameras: Sequence[Camera],
    *,
    name: str = "imported",
    sigma_px: float = 0.1,
    notes: Sequence[str] = (),
) -> Calibration:
    """Make a `Calibration` from cameras that are taken as exactly known.

    cameras : one or more cameras. The frame of the first has to be the rig frame.
    name : name of the rig.
    sigma_px : standard deviation of the pixels (px) that `Calibration.triangulate` assumes if none
        is given.
    notes : further sentences to keep with the calibration, for example the names of its files.

    The result has no free intrinsics, and the covariance of its poses is zero; its first note says
    that the uncertainty is unknown.
    Raises CalibrationError if there is no camera, if two cameras have the same name, if the first
    camera's frame is not the rig frame, or if sigma_px is not positive.
    """
    names = [c.name for c in cameras]
    if not names or len(set(names)) != len(names):
        raise CalibrationError(
            f"cameras named {names}", todo="give at least one camera, no two of one name"
        )
    first = cameras[0].camera_from_rig
    if not np.allclose(np.c_[first.rotation, first.translation_mm], np.eye(3, 4), atol=1e-12):
        raise CalibrationError(
            "the first camera's frame is not the rig frame",
            where=names[0],
            todo="express all poses in the first camera's frame",
        )
    if not sigma_px > 0:
        raise CalibrationError(f"sigma_px is {sigma_px}", todo="give the pixel noise, > 0 px")
    pose_names = tuple(f"{n}.{component}" for n in names[1:] for component in POSE_COMPONENTS)
    return Calibration(
        cameras=(replace(cameras[0], camera_from_rig=Pose.identity()), *cameras[1:]),
        dot_ids=np.zeros(0, np.int64),
        target_points_mm=np.zeros((0, 3)),
        target_poses={},
        covariance=np.zeros((len(pose_names), len(pose_names))),
        covariance_names=pose_names,
        free=tuple(() for _ in cameras),
        name=name,
        verdict={"status": "IMPORTED", "reasons": [NO_COVARIANCE]},
        model={"words": "imported and held fixed"},
        diagnostics={"gauge": "as imported", "weak": []},
        statistics={"scatter_px": float(sigma_px)},
        notes=(NO_COVARIANCE, *notes),
    )
