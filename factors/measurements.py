"""Predicts the measurements of cameras and accelerometers, with derivatives.

A measurement depends on the positions of the bubble and of the carriage and on the offset of the
camera. Leading axes (...) are batch axes. Lengths are in mm, times in s, angles in rad,
accelerations in mm/s^2 and image coordinates in px. A camera j with the offset o_j sees the lab
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
    """Holds predicted pixels of points, and their derivatives.

    uv_px : (..., 2).
    by_point, by_offset : (..., 2, 3) with respect to the lab point and to the camera's offset.
    by_position : (..., 2) with respect to the stage's position.
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
    """Project a point in the laboratory frame: a bubble, or a mark that is fixed to the tank.

    Returns the pixel and its derivatives by the point, the camera's offset and the carriage's
    position.

    point_lab_mm : (..., 3) position in the laboratory frame.
    position_mm : (...) position of the carriage.
    axis : (3,) unit vector along which the carriage moves, in the rig frame.
    offset_mm : (..., 3) displacement of the camera by shake, in the rig frame.
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
    """Holds predicted readings of an accelerometer, and their derivatives.

    reading_mm_s2 : (..., 3) along the sensor's axes.
    by_acceleration : (..., 3, 3) with respect to the acceleration of the sensor's mount, in rig
        axes.
    by_scale : (..., 3) with respect to the scale error.

    The derivative with respect to the bias is the identity.
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
    """Return the predicted readings: axes ((1 + scale) acceleration - g) + bias.

    An accelerometer measures specific force, which is acceleration minus gravity.

    acceleration_mm_s2 : (..., 3) acceleration of the mount in rig axes, at the time of the sample
        minus the sensor's delay.
    gravity_mm_s2 : (3,) g in the laboratory, pointing down, in rig axes.
    axes : (3, 3) whose rows are the sensor's axes in rig coordinates.
    bias_mm_s2 : constant error of the reading, broadcast to (..., 3).
    scale : relative error of the scale, broadcast to (...).
    """
    acceleration = np.asarray(acceleration_mm_s2, float)
    gain = 1 + np.asarray(scale, float)[..., None]
    force = gain * acceleration - gravity_mm_s2
    reading = force @ axes.T + np.asarray(bias_mm_s2, float)
    by_acceleration = np.broadcast_to(gain[..., None] * axes, (*reading.shape, 3))
    return AccelerometerPrediction(reading, by_acceleration, acceleration @ axes.T)
