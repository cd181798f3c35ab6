"""What cameras and accelerometers read of bubbles, carriage and camera offsets.

Each function predicts a reading and gives its derivatives; leading axes are batch axes. Lengths
mm, times s, angles rad, accelerations mm/s^2, pixels px. A camera j with offset o_j sees the lab
point P at the rig point P - axis * position - o_j.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.rig.camera import Camera


@dataclass(frozen=True)
class ImagePrediction:
    """uv_px : (..., 2) and its derivatives.

    by_point, by_offset : (..., 2, 3) by the lab point and the camera's offset.
    by_position : (..., 2) by the stage's position.
    """

    uv_px: Array
    by_point: Array
    by_offset: Array
    by_position: Array


def image_of_point(
    camera: Camera,
    point_lab_mm: ArrayLike,
    position_mm: ArrayLike,
    axis: Array,
    offset_mm: ArrayLike,
) -> ImagePrediction:
    """The image of a bubble, or of a mark fixed to the tank, and its derivatives.

    point_lab_mm, offset_mm : (..., 3).  position_mm : (...) of the carriage along ``axis`` (3,).
    """
    pose = camera.camera_from_rig
    position = np.asarray(position_mm, float)[..., None]
    point = np.asarray(point_lab_mm, float) - axis * position - np.asarray(offset_mm, float)
    in_camera = point @ pose.rotation.T + pose.translation_mm
    uv, by_camera, _ = camera.pixel_jacobians(in_camera.reshape(-1, 3), ())
    by_camera = by_camera.reshape(*in_camera.shape[:-1], 2, 3)
    by_point = by_camera @ pose.rotation
    return ImagePrediction(
        uv.reshape(*in_camera.shape[:-1], 2), by_point, -by_point, -by_point @ axis
    )


@dataclass(frozen=True)
class AccelerometerPrediction:
    """reading_mm_s2 : (..., 3) along the sensor's axes.

    by_acceleration : (..., 3, 3) by the mount's acceleration in rig axes.  by_scale : (..., 3).
    The derivative by the bias is the identity.
    """

    reading_mm_s2: Array
    by_acceleration: Array
    by_scale: Array


def accelerometer_reading(
    acceleration_mm_s2: ArrayLike,
    gravity_mm_s2: Array,
    axes: Array,
    bias_mm_s2: ArrayLike = 0.0,
    scale: ArrayLike = 0.0,
) -> AccelerometerPrediction:
    """axes . ((1 + scale) acceleration - g) + bias; specific force as the sensor gives it.

    acceleration_mm_s2 : (..., 3) of the mount, in rig axes, at the stamp minus the delay.
    gravity_mm_s2 : (3,) g of the laboratory, downwards, in rig axes.
    axes : (3, 3), rows are the sensor's axes in rig coordinates.
    """
    acceleration = np.asarray(acceleration_mm_s2, float)
    gain = 1 + np.asarray(scale, float)[..., None]
    force = gain * acceleration - gravity_mm_s2
    reading = force @ axes.T + np.asarray(bias_mm_s2, float)
    by_acceleration = np.broadcast_to(gain[..., None] * axes, (*reading.shape, 3))
    return AccelerometerPrediction(reading, by_acceleration, acceleration @ axes.T)
