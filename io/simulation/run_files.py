"""A simulated run as files: images or detections, clocks, sensors, stage_axis/, and the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.random import Generator
from numpy.typing import NDArray

from telerig.arrays import Array, Bools
from telerig.errors import InputError
from telerig.io.files.atomic import plain, write_json_atomic
from telerig.io.files.csv_table import write_table
from telerig.io.rig_file.description import (
    CARRIAGE,
    AccelerometerDescription,
    FluidDescription,
    ReferencesDescription,
    RigDescription,
    StageDescription,
)
from telerig.io.simulation.calibration.scene import TrueTarget, View, hand_held_views, wholly_inside
from telerig.io.simulation.calibration_files import (
    exact_dots,
    measured_dots,
    seed_of,
    write_calibration,
    write_image,
    write_images,
)
from telerig.io.simulation.config import ImageConfig, RunConfig
from telerig.io.simulation.images.backlight import Specks, random_screen, random_specks
from telerig.io.simulation.images.bodies import MODES
from telerig.io.simulation.images.bubbles import Silhouette, render_bubbles
from telerig.io.simulation.images.sensor import digitise
from telerig.io.simulation.run.marks import Strip, random_strips, references_table, strip_truth
from telerig.io.simulation.run.scene import AXIS_RIG, RunScene, run_scene
from telerig.io.simulation.run.sensors import accelerometer_table, stage_table
from telerig.io.simulation.run.views import CameraView, camera_view, linear_projection, truth_rows
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

Views = dict[str, CameraView]

RUN_TRUTH_SCHEMA = 1

LEAST_ACCELEROMETER_SIGMA = 1e-4
"""What the rig file states of a perfect accelerometer, as it must state a positive number."""


def write_run_dataset(config: RunConfig, folder: Path, rng: Generator, *, images: bool) -> None:
    """Write a whole dataset into an empty folder: the calibration and `runs/<preset>/`.

    Each part has a random generator of its own, made from ``rng``, so that the same seed gives the
    same bubbles with and without images.
    """
    seed = seed_of(rng)
    calibration_rng, scene_rng, sensor_rng, image_rng, table_rng, stage_rng = rng.spawn(6)

    def complete(rig: RigDescription) -> RigDescription:
        # The rig file also states the stage, and the sensors and marks that the run has.
        x, y, z = (float(a) for a in AXIS_RIG)
        stage = StageDescription(
            (x, y, z),
            (x, y, z),
            max(config.stage.encoder_sigma_mm, 1e-4),
            config.stage.scale_sigma,
            gravity_m_s2=config.stage.gravity_m_s2,
        )
        unit = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        sensors = {}
        for mount in config.stage.accelerometers:
            name = mount if mount == CARRIAGE else f"arm_{mount}"
            sensors[name] = AccelerometerDescription(
                name,
                mount,
                unit,
                max(config.stage.accelerometer_density_ug, LEAST_ACCELEROMETER_SIGMA),
                max(config.stage.accelerometer_bias_m_s2, LEAST_ACCELEROMETER_SIGMA),
            )
        marks = ReferencesDescription() if config.table.references else None
        if config.strip is not None:
            marks = ReferencesDescription(dot_diameter_mm=config.strip.diameter_mm)
        fluid = None
        if config.fluid is not None:
            liquid = vars(config.fluid)
            fluid = FluidDescription(**{k: v for k, v in liquid.items() if k != "law"})
        return replace(rig, stage=stage, accelerometers=sensors, references=marks, fluid=fluid)

    cameras, target = write_calibration(
        config.calibration, folder, calibration_rng, images=images, complete=complete
    )
    if config.stage.axis_views:
        write_stage_axis(config, cameras, target, folder, stage_rng, images=images)
    scene = run_scene(config, cameras, scene_rng)
    strips = random_strips(scene, rng.spawn(1)[0]) if config.strip and images else []
    run = folder / "runs" / config.name
    # lost (cameras, frames): what a camera drops; each camera keeps its first frame.
    lost = image_rng.random((len(scene.cameras), scene.config.frames)) < scene.config.image.dropped
    lost[:, 0] = False
    encoder_rng, accelerometer_rng, mark_rng = sensor_rng.spawn(3)
    run.mkdir(parents=True, exist_ok=True)
    frames = pd.DataFrame({"frame": np.arange(scene.config.frames), "t_s": scene.t_s})
    if lost.any():
        names = np.array(list(scene.cameras))
        frames["missing"] = ["|".join(names[gone]) for gone in lost.T]
    write_table(frames, run / "frames.csv")
    write_table(stage_table(scene, encoder_rng), run / "stage.csv")
    if scene.config.stage.accelerometers:
        write_table(accelerometer_table(scene, accelerometer_rng), run / "accelerometer.csv")
    # Marks that are drawn into the images are found there, and have no table.
    if not strips and scene.config.table.references:
        write_table(references_table(scene, mark_rng), run / "references.csv")
    truth: list[dict[str, Any]] = []
    detections: list[dict[str, Any]] = []
    renderer = _Renderer(scene, image_rng, strips) if images else None
    for frame in range(config.frames):
        views = {name: camera_view(scene, frame, j) for j, name in enumerate(cameras)}
        truth.append(truth_rows(scene, frame, views))
        for j, (name, view) in enumerate(views.items()):
            if lost[j, frame]:
                continue
            if renderer is not None:
                write_image(run / name / f"{frame:06d}.tif", renderer.image(frame, j, view))
            else:
                size = cameras[name].image_size_px
                detections.append(_detected(config, frame, name, view, scene, size, table_rng))
    if not images:
        write_table(_joined(detections), run / "detections.csv")
    known = folder / "truth" / "runs" / config.name
    _write_truth(scene, known, seed, truth, lost)
    if strips:
        write_table(strip_truth(scene, strips), known / "references.csv")


class _Renderer:
    """The surroundings of the bubbles in each camera, drawn once, and each frame's light."""

    def __init__(self, scene: RunScene, rng: Generator, strips: Sequence[Strip]) -> None:
        self.scene, self.strips = scene, strips
        image = scene.config.image
        names = list(scene.cameras)
        look_rng, light_rng, *self.noise = rng.spawn(2 + len(names))
        self.gain = np.exp(image.flicker * light_rng.standard_normal(scene.config.frames))
        self.lab_shift = np.stack([_lab_shift_px(scene, j) for j in range(len(names))])
        sizes = [camera.image_size_px for camera in scene.cameras.values()]
        self.sizes = sizes
        light = {key: getattr(image, key) for key in ("gradient", "vignetting", "texture")}
        self.screens = [random_screen(look_rng, level=image.screen, **light) for _ in names]
        self.lens = [_lens_dirt(image, size, look_rng) for size in sizes]
        self.window = [
            _window_dirt(image, size, shift, look_rng) for size, shift in zip(sizes, self.lab_shift)
        ]

    def image(self, frame: int, index: int, view: CameraView) -> NDArray[Any]:
        """Return (height, width) what camera ``index`` records."""
        image = self.scene.config.image
        lab_shift = self.lab_shift[index, frame]
        grey = render_bubbles(
            self.sizes[index],
            view.silhouettes(self.scene) + self._marks(frame, index),
            self.screens[index],
            screen_shift_px=lab_shift if image.screen_fixed_to == "lab" else np.zeros(2),
            window_dirt=self.window[index],
            lens_dirt=self.lens[index],
            lab_shift_px=lab_shift,
            gain=float(self.gain[frame]),
        )
        return digitise(
            grey,
            self.noise[index],
            read_noise=image.read_noise,
            shot_noise=image.shot_noise,
            bit_depth=image.bit_depth,
        )

    def _marks(self, frame: int, index: int) -> list[Silhouette]:
        if not self.strips:
            return []
        scene, image = self.scene, self.scene.config.image
        velocity = AXIS_RIG * scene.velocity_mm_s[frame] + scene.shake_mm_s[index, frame]
        return self.strips[index].silhouettes(
            scene.rig_from_lab_mm(index, frame), -velocity * image.exposure_s, image.blur_px
        )


def _lab_shift_px(scene: RunScene, index: int) -> Array:
    """Return (F, 2) how far what is at rest in the lab has moved in the image since position 0."""
    _, slope = linear_projection(list(scene.cameras.values())[index])
    frames = range(scene.config.frames)
    return np.stack([scene.rig_from_lab_mm(index, frame) for frame in frames]) @ slope.T


def _lens_dirt(image: ImageConfig, size: tuple[int, int], rng: Generator) -> Specks:
    low, high = np.zeros(2), np.array(size) - 1.0
    return random_specks(rng, image.lens_dirt, low, high, sigma_px=(1.5, 9.0), depth=(0.01, 0.06))


def _window_dirt(
    image: ImageConfig, size: tuple[int, int], shift_px: Array, rng: Generator
) -> Specks:
    """Return the specks over all that the camera ever sees of the window."""
    low = -shift_px.max(0)
    high = np.array(size) - 1.0 - shift_px.min(0)
    share = float(np.prod(high - low) / np.prod(size))
    count = round(image.window_dirt * share)
    return random_specks(rng, count, low, high, sigma_px=(0.7, 2.2), depth=(0.05, 0.5))


def _detected(
    config: RunConfig,
    frame: int,
    camera: str,
    view: CameraView,
    scene: RunScene,
    size_px: tuple[int, int],
    rng: Generator,
) -> dict[str, Any]:
    """Return rows of `detections.csv` of an image in random order: whole bubbles and false ones."""
    table = config.table
    found = np.flatnonzero(view.whole & (rng.random(len(view.particle)) >= table.missed))
    false = int(rng.poisson(table.false_per_image))
    centre = view.centre_px if table.centre == "volume" else view.silhouette_px
    a, b, angle = (value[found] for value in view.ellipse_px())
    if table.noisy_axes:
        a, b, angle = _noisy_axes(a, b, angle, table.sigma_px, rng.spawn(1)[0])
    radius = rng.choice(a, false) if len(a) else np.full(false, 5.0)
    uv = np.concatenate([centre[found], rng.uniform(0, np.array(size_px) - 1.0, (false, 2))])
    uv += table.sigma_px * rng.standard_normal(uv.shape)
    order = rng.permutation(len(uv))
    area = np.concatenate([view.area_px2[found], np.pi * radius**2])
    columns = {
        "frame": np.full(len(uv), frame),
        "camera": np.full(len(uv), camera),
        "particle": np.concatenate([view.particle[found].astype(str), np.full(false, "")]),
        "u_px": uv[:, 0],
        "v_px": uv[:, 1],
        "sigma_px": np.full(len(uv), max(table.sigma_px, 1e-4)),
        "a_px": np.concatenate([a, radius]),
        "b_px": np.concatenate([b, radius]),
        "angle_rad": np.concatenate([angle, np.zeros(false)]),
        "area_px2": area,
        "d_eq_px": np.sqrt(4 / np.pi * area),
    }
    if not table.particle_ids:
        del columns["particle"]
    return {name: values[order] for name, values in columns.items()}


def _noisy_axes(
    a: Array, b: Array, angle: Array, sigma_px: float, rng: Generator
) -> tuple[Array, Array, Array]:
    """Return the ellipses whose outlines have been displaced by white noise.

    On the unit circle cos and sin of 2 phi have the variance of those of phi, which move the
    centre, and the mean radius half of it.
    """
    noise = sigma_px / np.sqrt(a * b) * rng.standard_normal((3, len(a)))
    grown, stretched, sheared = noise * np.array([[np.sqrt(0.5)], [1.0], [1.0]])
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1)
    axes = turn.reshape(-1, 2, 2) * np.stack([a, b], -1)[:, None]
    change = np.stack([grown + stretched, sheared, sheared, grown - stretched], -1)
    axes = axes @ (np.eye(2) + change.reshape(-1, 2, 2))
    values, vectors = np.linalg.eigh(axes @ np.swapaxes(axes, -1, -2))
    turned = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
    turned = (turned + np.pi / 2) % np.pi - np.pi / 2
    return np.sqrt(values[:, 1]), np.sqrt(values[:, 0]), turned


def _joined(parts: list[dict[str, Any]]) -> pd.DataFrame:
    if not parts:
        return pd.DataFrame()
    return pd.DataFrame({key: np.concatenate([part[key] for part in parts]) for key in parts[0]})


def _write_truth(
    scene: RunScene,
    folder: Path,
    seed: dict[str, Any],
    rows: list[dict[str, Any]],
    lost: Bools,
) -> None:
    write_table(_joined(rows), folder / "bubbles.csv")
    columns: dict[str, Any] = {
        "frame": np.arange(scene.config.frames),
        "t_s": scene.t_s,
        "position_mm": scene.position_mm,
    }
    for j, name in enumerate(scene.cameras):
        for axis, letter in enumerate("xyz"):
            columns[f"{name}_shake_{letter}_mm"] = scene.shake_mm[j, :, axis]
        columns[f"{name}_lost"] = lost[j].astype(int)
    write_table(pd.DataFrame(columns), folder / "cameras.csv")
    population, config = scene.population, plain(scene.config)
    config = {k: v for k, v in config.items() if v is not None or k not in ("strip", "fluid")}
    write_json_atomic(
        folder / "truth.json",
        {
            "schema": RUN_TRUTH_SCHEMA,
            "pixel_origin": "centre",
            "seed": seed,
            "axis_rig": AXIS_RIG,
            "modes": MODES,
            "particles": {
                "d_eq_mm": population.d_eq_mm,
                "semi_axes_proportions": population.semi_axes_mm,
                "modes_static": population.modes_static,
                "modes_swing": population.modes_swing,
                "swing_hz": population.swing_hz,
                "spin_hz": population.spin_hz,
            },
            "pairs_closest_s": scene.closest_s,
            "config": config,
        },
    )


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
    """Write views of a target at rest, from several stage positions, into ``folder/stage_axis``.

    These are positions.csv, with images or dots.csv; the truth is written, too. The travel is
    ``stage.axis_travel_mm``, or less if the target would leave the images. Raises InputError for
    fewer than three views, or if no pose keeps the target in the images.
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
    """Return a pose that both cameras see at every stop, and the stops in mm."""
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
