"""The true rig, the true target and hand-held poses of a simulated calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.io.rig_file.description import MOST_CAMERAS
from telerig.io.simulation.config import CameraConfig, SimulationConfig
from telerig.io.simulation.images.plates import Plate, pixel_from_plate
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec

_DIRECTIONS = 4000
_TRIES = 2000


@dataclass(frozen=True)
class TrueTarget:
    """The true target with N dots.

    ids : (N,).
    points_mm : (N, 3) true centres in the target's frame.
    diameter_mm : (N,).
    plate : the plate as it is rendered.
    scale_distance_mm : the known distance of two dots, as it was measured; None if there is none.
    """

    ids: Ints
    points_mm: Array
    diameter_mm: Array
    plate: Plate
    scale_distance_mm: float | None


@dataclass(frozen=True)
class View:
    """One pose of the target; ``cameras`` are the names of the cameras that see it."""

    name: str
    rig_from_target: Pose
    cameras: tuple[str, ...]


def nominal_rotation(config: SimulationConfig, camera: int = 1) -> Array:
    """Return the nominal rotation (3, 3) from the first camera to another, as rig.toml states it.

    camera : index of the other camera.
    """
    return rotation_from_rotvec([0.0, np.radians(camera * config.angle_deg), 0.0])


def true_cameras(config: SimulationConfig) -> Mapping[str, Camera]:
    """Return the true cameras by name; the rig's origin is where the first two optical axes come
    closest.

    Raises InputError unless there are one to four cameras of different names.
    """
    names = [camera.name for camera in config.cameras]
    if len(set(names)) != len(names) or not 1 <= len(names) <= MOST_CAMERAS:
        todo = f"give one to {MOST_CAMERAS}, named apart"
        raise InputError(f"a simulated rig of cameras {names}", todo=todo)
    poses = [Pose.identity(), *(_from_rig(config, i) for i in range(1, len(names)))]
    return {c.name: _camera(c, pose) for c, pose in zip(config.cameras, poses)}


def _from_rig(config: SimulationConfig, camera: int) -> Pose:
    """Return camera_from_rig: nominal, and the mounting error, whose sign alternates."""
    sign = 1.0 if camera % 2 else -1.0
    mount = rotation_from_rotvec(np.radians(sign * np.array(config.mount_rotvec_deg)))
    rotation = mount @ nominal_rotation(config, camera)
    between = np.cross(rotation[:, 2], [0.0, 0.0, 1.0])
    length = float(np.linalg.norm(between))
    if length < 1e-6:
        return Pose(rotation, np.zeros(3))
    beside = [0.0 if camera == 1 else config.axis_gap_mm, 0.0, 0.0]
    return Pose(rotation, sign * config.axis_gap_mm * between / length + beside)


def _camera(config: CameraConfig, camera_from_rig: Pose) -> Camera:
    width, height = config.image_size_px
    parameters = {
        "centre_u_px": (width - 1) / 2 + config.centre_offset_px[0],
        "centre_v_px": (height - 1) / 2 + config.centre_offset_px[1],
    } | dict(config.parameters)
    return Camera.create(
        config.name,
        config.image_size_px,
        config.scale_px_per_mm,
        camera_from_rig=camera_from_rig,
        rho_mm=float(np.hypot(width, height)) / 2 / config.nominal_scale_px_per_mm,
        **parameters,
    )


def true_target(config: SimulationConfig, rng: np.random.Generator) -> TrueTarget:
    """Return a random true target: displaced dots, the plate, dirt, and the measured distance."""
    target = config.target
    ids = _all_ids(config)
    nominal = target.nominal_mm(ids)
    sigma = np.array([target.print_sigma_mm, target.print_sigma_mm, target.flatness_sigma_mm])
    points = nominal + config.print_factor * sigma * rng.standard_normal(nominal.shape)
    diameter = target.diameter_mm(ids)
    ring = target.is_mark(ids) & (target.mark_style == "ring")
    margin = config.plate_margin_mm + diameter.max() / 2
    low, high = nominal[:, :2].min(0) - margin, nominal[:, :2].max(0) + margin
    white_dots = target.polarity == "white_on_black"
    dirt = np.c_[rng.uniform(low, high, (config.dirt, 2)), np.zeros(config.dirt)]
    plate = Plate(
        points,
        diameter,
        np.where(ring, config.ring_hole_ratio * diameter, 0.0),
        outline_mm=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        thickness_mm=target.plate_thickness_mm if target.two_sided else 0.0,
        index=target.plate_index,
        dot_albedo=config.white if white_dots else config.black,
        plate_albedo=config.black if white_dots else config.white,
        background_albedo=config.background,
        dirt_mm=dirt,
        dirt_diameter_mm=rng.uniform(*config.dirt_diameter_mm, config.dirt),
        dirt_albedo=0.6 * config.black + 0.4 * config.white,
    )
    return TrueTarget(ids, points, diameter, plate, _measured_distance(config, ids, points, rng))


def _all_ids(config: SimulationConfig) -> Ints:
    target, margin = config.target, config.margin_dots
    if target.bounded:
        return target.ids()
    rows = np.arange(-margin, target.rows + margin)
    columns = np.arange(-margin, target.columns + margin)
    ids = target.id_from_row_column(*(a.ravel() for a in np.meshgrid(rows, columns, indexing="ij")))
    missing = target.is_mark(ids) & (target.mark_style == "missing")
    return ids[~missing]


def _measured_distance(
    config: SimulationConfig, ids: Ints, points: Array, rng: np.random.Generator
) -> float | None:
    if config.target.scale_dots is None:
        return None
    ends = [points[ids == dot] for dot in config.target.scale_dots]
    if any(len(end) != 1 for end in ends):
        raise InputError(f"scale dots {config.target.scale_dots} are not on the target")
    true = float(np.linalg.norm(ends[0] - ends[1]))
    return true + config.target.scale_sigma_mm * float(rng.standard_normal())


def hand_held_views(
    config: SimulationConfig,
    cameras: Mapping[str, Camera],
    target: TrueTarget,
    rng: np.random.Generator,
) -> list[View]:
    """Return random views of the target that fulfil the conditions of ``config``.

    Raises InputError if no such pose is found.
    """
    names = tuple(cameras)
    groups = config.seen_by or (names,)
    unknown = sorted({name for group in groups for name in group} - set(names))
    if unknown:
        raise InputError(
            f"seen_by names {', '.join(unknown)}, which the simulated rig does not have",
            todo=f"use names of its cameras: {', '.join(names)}",
        )
    digits = len(str(config.views - 1))
    views = []
    for i in range(config.views):
        single = config.views - 1 - i < config.single_camera_views and len(names) > 1
        seeing = (names[i % len(names)],) if single else groups[i % len(groups)]
        normals = _plate_normals(config, [cameras[n] for n in seeing], rng)
        pose = _visible_pose(config, [cameras[n] for n in seeing], target, normals, rng)
        views.append(View(f"view{i:0{max(2, digits)}d}", pose, seeing))
    return views


def _plate_normals(
    config: SimulationConfig, cameras: list[Camera], rng: np.random.Generator
) -> Array:
    """Return directions (N, 3) of the target's z, evenly spread, within a tilt of each camera."""
    directions = rng.standard_normal((_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axes = np.array([camera.camera_from_rig.rotation[2] for camera in cameras])
    cosine = directions @ axes.T
    if config.target.two_sided:
        cosine = np.abs(cosine)
    low, high = np.cos(np.radians(config.tilt_deg[1])), np.cos(np.radians(config.tilt_deg[0]))
    allowed = directions[np.all((cosine >= low) & (cosine <= high), 1)]
    if len(allowed) < 3:
        raise InputError(
            "no plate can stand so that its normal is between "
            f"{config.tilt_deg[0]:g} and {config.tilt_deg[1]:g} deg (tilt_deg) from the optical "
            f"axis of every camera: neighbouring cameras stand {config.angle_deg:g} deg "
            "(angle_deg) apart",
            todo="widen tilt_deg (the tilts towards two cameras that see the same side of the "
            "plate add up to at least the angle between these cameras), choose angle_deg between "
            "20 and 110 deg, or simulate a two-sided target",
        )
    return allowed


def _visible_pose(
    config: SimulationConfig,
    cameras: list[Camera],
    target: TrueTarget,
    normals: Array,
    rng: np.random.Generator,
) -> Pose:
    middle = config.target.nominal_mm(_block_ids(config)).mean(0)
    marks = config.target.is_mark(target.ids) & config.marks_visible
    for _ in range(_TRIES):
        rotation = _rotation(normals[rng.integers(len(normals))], config.roll_deg, rng)
        place = np.asarray(config.shift_mm) * rng.uniform(-1, 1, 3)
        pose = Pose(rotation, place - rotation @ middle)
        seen = [wholly_inside(camera, pose, target, config.border_px) for camera in cameras]
        if all(s.mean() >= config.visible_fraction and np.all(s[marks]) for s in seen):
            return pose
    raise InputError(
        f"no pose out of {_TRIES} shows {100 * config.visible_fraction:g} % of the dots",
        todo="choose a smaller target, or lower shift_mm, visible_fraction or border_px",
    )


def _block_ids(config: SimulationConfig) -> Ints:
    target = config.target
    if target.bounded:
        return target.ids()
    corners = np.array([[0, 0], [target.rows - 1, target.columns - 1]])
    return target.id_from_row_column(corners[:, 0], corners[:, 1])


def _rotation(normal: Array, roll_deg: float, rng: np.random.Generator) -> Array:
    """Return rig_from_target with this z; without roll, its x is as near to the rig's as can be."""
    start = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.99 else np.array([0.0, 0.0, 1.0])
    x = start - normal * (start @ normal)
    x /= np.linalg.norm(x)
    upright = np.stack([x, np.cross(normal, x), normal], 1)
    roll = np.radians(roll_deg) * rng.uniform(-1, 1)
    return np.asarray(upright @ rotation_from_rotvec([0.0, 0.0, roll]))


def wholly_inside(camera: Camera, pose: Pose, target: TrueTarget, border_px: float) -> Bools:
    """Return (N,) whether each dot lies completely inside the image.

    border_px : least distance of its rim from the border.
    """
    uv = pixel_from_plate(camera, pose, target.points_mm, target.plate)
    radius = 1.03 * target.diameter_mm / 2 * camera["scale_px_per_mm"] * max(1, camera["aspect"])
    to_border_px = np.minimum(uv, np.array(camera.image_size_px) - 1 - uv).min(-1)
    return np.asarray(to_border_px >= radius + border_px)
