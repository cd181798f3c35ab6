"""What cameras, encoder and accelerometers read of bubbles, carriage and camera offsets.

Each function predicts a reading and gives its derivatives; leading axes are batch axes. Lengths
mm, times s, angles rad, accelerations mm/s^2, pixels px. A camera j with offset o_j sees the lab
point P at the rig point P - axis * position - o_j.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.rig.camera import Camera

Array = NDArray[np.float64]

GRAVITY_MM_S2 = 9810.0


@dataclass(frozen=True)
class ImagePrediction:
    """uv_px : (..., 2) and its derivatives.

    by_point, by_offset : (..., 2, 3) by the lab point and the camera's offset.
    by_position : (..., 2) by the stage's position.  by_pitch : (..., 2) by the arm's pitch.
    """

    uv_px: Array
    by_point: Array
    by_offset: Array
    by_position: Array
    by_pitch: Array


def rig_point_seen(
    camera: Camera,
    point_lab_mm: ArrayLike,
    position_mm: ArrayLike,
    axis: Array,
    offset_mm: ArrayLike,
    pitch_rad: ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """(..., 3) rig point that a still rig would see there, and (...) its depth in the camera.

    pitch : of the camera about its own x axis; a point at depth Z looks higher by pitch * Z.
    """
    position = np.asarray(position_mm, float)[..., None]
    point = np.asarray(point_lab_mm, float) - axis * position - np.asarray(offset_mm, float)
    rotation, shift = camera.camera_from_rig.rotation, camera.camera_from_rig.translation_mm
    depth = np.asarray(point @ rotation[2] + shift[2])
    lift = np.asarray(pitch_rad, float) * depth
    return np.asarray(point - lift[..., None] * rotation[1]), depth


def image_of_point(
    camera: Camera,
    point_lab_mm: ArrayLike,
    position_mm: ArrayLike,
    axis: Array,
    offset_mm: ArrayLike,
    pitch_rad: ArrayLike = 0.0,
) -> ImagePrediction:
    """The image of a bubble, or of a mark fixed to the tank, and its derivatives.

    Raises GeometryError (from `Camera`) for nothing here: points are near the measured ones.
    """
    point, depth = rig_point_seen(camera, point_lab_mm, position_mm, axis, offset_mm, pitch_rad)
    pose = camera.camera_from_rig
    in_camera = point @ pose.rotation.T + pose.translation_mm
    flat = in_camera.reshape(-1, 3)
    uv, by_camera, _ = camera.pixel_jacobians(flat)
    by_camera = by_camera.reshape(*in_camera.shape[:-1], 2, 3)
    by_rig = by_camera @ pose.rotation
    by_pitch = -by_camera[..., 1] * depth[..., None]
    # depth along the optical axis moves with the point, and with it the lift
    tilted = np.asarray(pitch_rad, float)[..., None, None] * by_camera[..., 1:2]
    by_point = by_rig - tilted * pose.rotation[2]
    return ImagePrediction(
        uv.reshape(*in_camera.shape[:-1], 2), by_point, -by_point, -by_point @ axis, by_pitch
    )


@dataclass(frozen=True)
class EncoderPrediction:
    """reading_mm : (...) and its derivatives, all (...)."""

    reading_mm: Array
    by_position: Array
    by_scale: Array
    by_delay: Array


def carriage_position(reading_mm: ArrayLike, scale: float) -> tuple[Array, float, Array]:
    """Where the carriage is when its encoder reads so: reading / (1 + scale).

    Also its derivatives by the reading and by the scale.
    """
    gain = 1 / (1 + scale)
    position = gain * np.asarray(reading_mm, float)
    return position, gain, -gain * position


def encoder_reading(
    position_mm: ArrayLike, velocity_mm_s: ArrayLike, scale: ArrayLike = 0.0
) -> EncoderPrediction:
    """(1 + scale) * position; position and velocity are those at the stamp minus the delay."""
    position = np.asarray(position_mm, float)
    gain = 1 + np.asarray(scale, float) + np.zeros_like(position)
    slope = -gain * np.asarray(velocity_mm_s, float)
    return EncoderPrediction(gain * position, gain, position, slope)


@dataclass(frozen=True)
class AccelerometerPrediction:
    """reading_mm_s2 : (..., 3) along the sensor's axes.

    by_acceleration : (..., 3, 3) by the mount's acceleration in rig axes.  by_scale, by_delay :
    (..., 3).  The derivative by the bias is the identity.
    """

    reading_mm_s2: Array
    by_acceleration: Array
    by_scale: Array
    by_delay: Array


def accelerometer_reading(
    acceleration_mm_s2: ArrayLike,
    jerk_mm_s3: ArrayLike,
    up: Array,
    axes: Array,
    bias_mm_s2: ArrayLike = 0.0,
    scale: ArrayLike = 0.0,
) -> AccelerometerPrediction:
    """axes . ((1 + scale) acceleration - g) + bias; specific force as the sensor gives it.

    acceleration, jerk : (..., 3) of the mount, in rig axes, at the stamp minus the delay.
    axes : (3, 3), rows are the sensor's axes in rig coordinates.
    """
    acceleration = np.asarray(acceleration_mm_s2, float)
    gain = 1 + np.asarray(scale, float)[..., None]
    force = gain * acceleration + GRAVITY_MM_S2 * up
    reading = force @ axes.T + np.asarray(bias_mm_s2, float)
    by_acceleration = np.broadcast_to(gain[..., None] * axes, (*reading.shape, 3))
    slope = -(gain * np.asarray(jerk_mm_s3, float)) @ axes.T
    return AccelerometerPrediction(reading, by_acceleration, acceleration @ axes.T, slope)


def speed_residual(
    velocity_mm_s: ArrayLike, speed_mm_s: ArrayLike, up: Array
) -> tuple[Array, Array, Array]:
    """A zigzagging bubble keeps its speed V: v_up + |v_across|^2 / (2 V) - V, near zero.

    (..., 3) velocity, (...) V -> residual (...), derivatives (..., 3) and (...).
    """
    velocity, speed = np.asarray(velocity_mm_s, float), np.asarray(speed_mm_s, float)
    rise = velocity @ up
    across = velocity - rise[..., None] * up
    square = (across**2).sum(-1)
    by_velocity = up + across / speed[..., None]
    return (
        np.asarray(rise + square / (2 * speed) - speed),
        np.asarray(by_velocity),
        np.asarray(-square / (2 * speed**2) - 1),
    )


def whitener_of(covariance: Array) -> Array:
    """(..., n, n) lower W with W covariance W^T = 1. Raises LinAlgError for a singular one."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
