"""A simulated calibration as files: rig.toml, images or dots, and the truth beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.io.files.atomic import write_json_atomic
from telerig.io.files.csv_table import write_table
from telerig.io.rig_file.description import CameraDescription, RigDescription
from telerig.io.rig_file.rig_file import write_rig_toml
from telerig.io.simulation.calibration.scene import (
    TrueTarget,
    View,
    hand_held_views,
    true_cameras,
    true_target,
    wholly_inside,
)
from telerig.io.simulation.config import SimulationConfig
from telerig.io.simulation.images.plates import Light, image_centres, render
from telerig.io.simulation.images.sensor import digitise
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import PARAMETERS
from telerig.rig.pose import Pose

TRUTH_SCHEMA = 1

LEAST_SIGMA_PX = 1e-4
"""What a table of exact dots states, since a standard deviation of 0 means nothing."""


def write_calibration(
    settings: SimulationConfig,
    folder: Path,
    rng: np.random.Generator,
    *,
    images: bool,
    complete: Callable[[RigDescription], RigDescription] = lambda rig: rig,
) -> tuple[Mapping[str, Camera], TrueTarget]:
    """Write `rig.toml`, `calibration/` and `truth/` of a simulated dataset.

    images : whether images are rendered; otherwise dots.csv is written. complete : function that
    adds further tables to rig.toml.
    Returns the true cameras by name, and the true target.
    """
    seed = seed_of(rng)
    scene_rng, dots_rng, image_rng = rng.spawn(3)
    cameras = true_cameras(settings)
    target = true_target(settings, scene_rng)
    views = hand_held_views(settings, cameras, target, scene_rng)
    exact = exact_dots(settings, cameras, target, views)
    write_rig_toml(complete(rig_description(settings, target)), folder / "rig.toml")
    row, column = settings.target.row_column_from_id(target.ids)
    truth = {
        "schema": TRUTH_SCHEMA,
        "pixel_origin": "centre",
        "seed": seed,
        "cameras": {name: _camera_truth(camera) for name, camera in cameras.items()},
        "target": {
            "dot": target.ids,
            "row": row,
            "column": column,
            "points_mm": target.points_mm,
            "scale_distance_mm": target.scale_distance_mm,
        },
        "views": {
            view.name: {
                "rig_from_target": _pose_truth(view.rig_from_target),
                "cameras": view.cameras,
            }
            for view in views
        },
        "config": settings,
    }
    write_json_atomic(folder / "truth" / "truth.json", truth)
    write_table(exact, folder / "truth" / "dots.csv")
    if images:
        write_images(settings, cameras, target, views, folder / "calibration", image_rng)
    else:
        measured = measured_dots(settings, exact, cameras, dots_rng)
        write_table(measured, folder / "calibration" / "dots.csv")
    return cameras, target


def rig_description(config: SimulationConfig, target: TrueTarget) -> RigDescription:
    """Return the rig as a user knows it before the calibration, with nominal values."""
    cameras = {
        c.name: CameraDescription(
            c.name, c.image_size_px, c.nominal_scale_px_per_mm, c.nominal_telecentricity_per_mm
        )
        for c in config.cameras
    }
    known = replace(config.target, scale_distance_mm=target.scale_distance_mm)
    sides = {
        name: (0.0, i * float(config.angle_deg), 0.0) for i, name in enumerate(cameras) if i > 0
    }
    return RigDescription(config.name, cameras, known, rotvec_from_first_deg=sides)


def exact_dots(
    config: SimulationConfig,
    cameras: Mapping[str, Camera],
    target: TrueTarget,
    views: list[View],
) -> pd.DataFrame:
    """Return a table of the true centres of the dots' images, which are what is measured.

    The column inside is 1 for dots that lie completely inside the image and away from its border.
    """
    row, column = config.target.row_column_from_id(target.ids)
    tables = []
    for view in views:
        for name in view.cameras:
            uv = image_centres(cameras[name], view.rig_from_target, target.plate)
            inside = wholly_inside(cameras[name], view.rig_from_target, target, config.border_px)
            size = np.array(cameras[name].image_size_px)
            seen = np.all((uv >= -0.5) & (uv <= size - 0.5), -1)
            columns = {
                "view": view.name,
                "camera": name,
                "dot": target.ids[seen],
                "row": row[seen],
                "column": column[seen],
                "u_px": uv[seen, 0],
                "v_px": uv[seen, 1],
                "inside": inside[seen].astype(int),
            }
            tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def measured_dots(
    config: SimulationConfig,
    exact: pd.DataFrame,
    cameras: Mapping[str, Camera],
    rng: np.random.Generator,
) -> pd.DataFrame:
    """Return the rows of ``exact`` with inside = 1, with noise and outliers added."""
    dots = exact[exact["inside"] == 1].drop(columns="inside").reset_index(drop=True)
    uv = dots[["u_px", "v_px"]].to_numpy()
    size = np.array([cameras[name].image_size_px for name in dots["camera"]])
    outlier = rng.random(len(uv)) < config.outlier_fraction
    uv = uv + config.sigma_px * rng.standard_normal(uv.shape)
    uv += outlier[:, None] * config.outlier_px * rng.standard_normal(uv.shape)
    dots[["u_px", "v_px"]] = np.clip(uv, 0, size - 1)
    dots["sigma_px"] = max(config.sigma_px, LEAST_SIGMA_PX)
    return dots[["view", "camera", "dot", "u_px", "v_px", "sigma_px", "row", "column"]]


def write_images(
    config: SimulationConfig,
    cameras: Mapping[str, Camera],
    target: TrueTarget,
    views: list[View],
    folder: Path,
    rng: np.random.Generator,
) -> None:
    """Render and write a TIFF image ``folder/<camera>/<view>.tif`` for each camera of each view."""
    for view in views:
        for name in view.cameras:
            image = view_image(config, cameras[name], target, view.rig_from_target, rng)
            write_image(folder / name / f"{view.name}.tif", image)


def write_image(file: Path, image: NDArray[Any]) -> None:
    """Write a TIFF image, and make its folder."""
    import tifffile

    file.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(file, image, metadata=None, software="telerig")


def view_image(
    config: SimulationConfig,
    camera: Camera,
    target: TrueTarget,
    rig_from_target: Pose,
    rng: np.random.Generator,
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Return one image (height, width) of the target, with random light and noise."""
    angle = rng.uniform(0, 2 * np.pi)
    gain = np.exp(config.exposure_spread * rng.standard_normal())
    place = rng.uniform(0, 1, 2) * camera.image_size_px
    glare = (float(place[0]), float(place[1]), config.glare_radius_px, config.glare)
    gradient = config.light_gradient * np.array([np.cos(angle), np.sin(angle)])
    light = Light(
        float(gain),
        (float(gradient[0]), float(gradient[1])),
        config.vignetting,
        glare if config.glare > 0 else None,
    )
    grey = render(camera, rig_from_target, target.plate, light, blur_px=config.blur_px)
    return digitise(
        grey,
        rng,
        read_noise=config.noise * abs(config.white - config.black),
        shot_noise=config.shot_noise,
        bit_depth=config.bit_depth,
    )


def _camera_truth(camera: Camera) -> dict[str, Any]:
    return {
        "image_size_px": camera.image_size_px,
        "rho_mm": camera.rho_mm,
        "parameters": {name: camera[name] for name in PARAMETERS},
        "camera_from_rig": _pose_truth(camera.camera_from_rig),
    }


def _pose_truth(pose: Pose) -> dict[str, Any]:
    return {
        "rotation": pose.rotation,
        "rotvec_deg": np.degrees(pose.rotvec_rad),
        "translation_mm": pose.translation_mm,
    }


def seed_of(rng: np.random.Generator) -> dict[str, Any]:
    """Return the entropy and the key with which the same random generator can be made again."""
    sequence = rng.bit_generator.seed_seq
    entropy = getattr(sequence, "entropy", None)
    key = getattr(sequence, "spawn_key", ())
    children = getattr(sequence, "n_children_spawned", 0)
    return {"entropy": entropy, "spawn_key": list(key), "children_spawned": children}
