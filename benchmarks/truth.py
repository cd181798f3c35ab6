"""The true cameras of a simulated dataset, from its `truth/truth.json`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.projection import intrinsics_from


def true_cameras(truth: Mapping[str, Any]) -> tuple[Camera, ...]:
    """truth : content of `truth/truth.json`."""
    out = []
    for name, data in truth["cameras"].items():
        pose = data["camera_from_rig"]
        size = (data["image_size_px"][0], data["image_size_px"][1])
        placed = Pose(np.array(pose["rotation"]), np.array(pose["translation_mm"]))
        lens = intrinsics_from(data["parameters"])
        out.append(Camera(name, size, data["rho_mm"], lens, placed))
    return tuple(out)
