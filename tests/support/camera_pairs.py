"""Pairs of cameras with every parameter, for exports."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.io.exchange.export.volume import seen_points, working_volume
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

Array = NDArray[np.float64]
RIGHT = Pose.from_rotvec([0.03, np.pi / 2 - 0.02, 0.01], [0.2, -0.4, 3.0])
SQUARE_ON = Pose.from_rotvec([0.0, np.pi / 2, 0.0], [0.2, -0.4, 0.0])
DISTORTED = {"k1": 0.012, "k2": -0.004, "p1": 0.0011, "p2": -0.0007}
PRISM = {"s1": 0.0008, "s2": -0.0003, "s3": -0.0005, "s4": 0.0002}


def pair(second: Pose = RIGHT, **parameters: float) -> tuple[Camera, Camera]:
    """Two cameras of one kind, the image of the second not square."""
    ours = {"centre_u_px": 258.3, "centre_v_px": 251.1} | parameters
    return (
        Camera.create("left", (512, 512), 10.1, **ours),
        Camera.create("right", (640, 512), 9.9, camera_from_rig=second, **parameters),
    )


def random_points(cameras: tuple[Camera, ...]) -> Array:
    return seen_points(cameras, working_volume(cameras), 7)
