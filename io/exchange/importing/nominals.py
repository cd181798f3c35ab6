"""Imported cameras as the nominal values of rig.toml, for a calibration to start from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from telerig.errors import InputError
from telerig.rig.camera import Camera


def nominal_toml(cameras: Sequence[Camera]) -> str:
    """The tables [cameras.*] and [stereo] of rig.toml; docs/files.md says what else it needs.

    Raises InputError for more than two cameras.
    """
    if not 1 <= len(cameras) <= 2:
        raise InputError(f"{len(cameras)} cameras", todo="rig.toml describes one or two")
    lines = []
    for camera in cameras:
        width, height = camera.image_size_px
        lines += [
            f"[cameras.{camera.name}]",
            f"image_size_px = [{width}, {height}]",
            f"scale_px_per_mm = {camera['scale_px_per_mm']:.9g}",
            f"telecentricity_per_mm = {camera['kappa_per_mm']:.9g}",
        ]
    if len(cameras) == 2:
        turn = np.degrees(cameras[1].camera_from_rig.rotvec_rad)
        numbers = ", ".join(f"{value:.6f}" for value in turn)
        lines += ["[stereo]", f"{cameras[1].name}_from_{cameras[0].name}_rotvec_deg = [{numbers}]"]
    return "\n".join(lines) + "\n"
