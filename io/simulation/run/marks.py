"""Marks fixed to the tank in a simulated run: places, pictures, `references.csv` and truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.random import Generator

from telerig.arrays import Array, Ints
from telerig.io.simulation.config import MARKS_AT, MARKS_JITTER
from telerig.io.simulation.images.bubbles import Look, Silhouette
from telerig.io.simulation.run.scene import AXIS_RIG, RunScene
from telerig.rig.camera import Camera

_OUTLINE_POINTS = 128


@dataclass(frozen=True)
class Strip:
    """The dots of a strip that is fixed to the tank, for one camera.

    lab_mm : (K, 3) places in the laboratory frame; the dots face the camera.
    look : appearance.
    """

    camera: Camera
    lab_mm: Array
    diameter_mm: float
    look: Look

    def seen(self, rig_from_lab_mm: Array) -> tuple[Ints, Array]:
        """Return which dots reach into the image, as indices (M,), and their centres (M, 2) in px.

        rig_from_lab_mm : (3,) vector that is added to a lab point to have it in the rig frame.
        """
        rig = self.lab_mm + rig_from_lab_mm
        size = np.array(self.camera.image_size_px) - 1
        reach = self.diameter_mm * self.camera["scale_px_per_mm"]
        height_mm = size[1] / self.camera["scale_px_per_mm"]
        near = np.flatnonzero(np.abs(rig @ AXIS_RIG) < height_mm)
        uv = self.camera.project(rig[near])
        inside = np.all((uv > -reach) & (uv < size + reach), -1)
        return near[inside], uv[inside]

    def silhouettes(
        self, rig_from_lab_mm: Array, travel_mm: Array, blur_px: float
    ) -> list[Silhouette]:
        """Return the outline, look and smear of each dot that the camera sees, for the renderer.

        rig_from_lab_mm : (3,) added to positions in the laboratory to give those in the rig.
        travel_mm : (3,) motion of the tank relative to the rig during the exposure.
        blur_px : blur of the image.
        """
        chosen, uv = self.seen(rig_from_lab_mm)
        rig = self.lab_mm[chosen] + rig_from_lab_mm
        after = self.camera.project(rig + travel_mm / 2)
        smear = after - self.camera.project(rig - travel_mm / 2)
        outlines = self.camera.project(rig[:, None] + self._rim_mm(uv))
        return [
            Silhouette(outline, self.look, blur_px, (float(s[0]), float(s[1])))
            for outline, s in zip(outlines, smear)
        ]

    def _rim_mm(self, uv_px: Array) -> Array:
        """Return (M, N, 3) the dots' rims about their centres, across the rays that see them."""
        ray = self.camera.unproject(uv_px)[1]
        first = np.cross(ray, AXIS_RIG)
        first /= np.linalg.norm(first, axis=-1, keepdims=True)
        second = np.cross(ray, first)
        angle = np.arange(_OUTLINE_POINTS) * 2 * np.pi / _OUTLINE_POINTS
        turn = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
        return np.asarray(self.diameter_mm / 2 * turn)


def random_strips(scene: RunScene, rng: Generator) -> list[Strip]:
    """Return a strip for each camera, over all the height that it sees during the run."""
    chosen = scene.config.strip
    if chosen is None:
        return []
    out = []
    for camera in scene.cameras.values():
        places = strip_places(
            camera, scene.position_mm, chosen.dots, rng, at=chosen.at, jitter=chosen.jitter
        )
        depth = rng.uniform(-1, 1) * chosen.depth_mm * camera.camera_from_rig.rotation[2]
        look = Look(rim=chosen.transmission, heart=0.0, ring=0.0)
        out.append(Strip(camera, places + depth, chosen.diameter_mm, look))
    return out


def strip_places(
    camera: Camera, position_mm: Array, count: int, rng: Generator, *, at: float, jitter: float
) -> Array:
    """Return the places (K, 3) in mm, in the laboratory frame, of a strip's dots.

    The strip runs along the travel, and ``count`` dots are in view at a time.

    position_mm : positions of the stage.
    at : distance of the strip from the image's middle, on a random side, divided by half the width
        of the image.
    jitter : largest deviation of the dots' heights from even spacing, divided by the spacing.
    """
    size = np.array(camera.image_size_px) - 1
    height_mm = size[1] / camera["scale_px_per_mm"]
    pitch = height_mm / count
    low, high = position_mm.min() - 0.6 * height_mm, position_mm.max() + 0.6 * height_mm
    heights = np.arange(low, high, pitch)
    heights = heights + jitter * pitch * rng.uniform(-1, 1, len(heights))
    side = rng.choice([-1.0, 1.0]) * at
    origin, _ = camera.unproject(size / 2 * np.array([1 + side, 1.0]))
    foot = origin - AXIS_RIG * (origin @ AXIS_RIG)
    return np.asarray(foot + heights[:, None] * AXIS_RIG)


def references_table(scene: RunScene, rng: Generator) -> pd.DataFrame:
    """Return the content of `references.csv`: noisy pixels of the marks of one strip per camera."""
    table = scene.config.table
    parts = []
    for j, (name, camera) in enumerate(scene.cameras.items()):
        places = strip_places(
            camera, scene.position_mm, table.references, rng, at=MARKS_AT, jitter=MARKS_JITTER
        )
        strip = Strip(camera, places, 0.0, Look())
        size = np.array(camera.image_size_px) - 1
        for frame in range(scene.config.frames):
            marks, exact = strip.seen(scene.rig_from_lab_mm(j, frame))
            noise = table.reference_sigma_px * rng.standard_normal(exact.shape)
            uv = np.clip(exact + noise, 0, size)
            columns = {"frame": frame, "camera": name, "mark": [f"{name}{k}" for k in marks]}
            parts.append(pd.DataFrame(columns | {"u_px": uv[:, 0], "v_px": uv[:, 1]}))
    out = pd.concat(parts, ignore_index=True)
    out["sigma_px"] = max(table.reference_sigma_px, 1e-4)
    return out


def strip_truth(scene: RunScene, strips: Sequence[Strip]) -> pd.DataFrame:
    """Return the content of `truth/runs/<run>/references.csv`: all dots that reach into an image.

    The column whole is 1 if no part of the dot lies outside the image.
    """
    parts = []
    for j, (name, strip) in enumerate(zip(scene.cameras, strips)):
        size = np.array(strip.camera.image_size_px) - 1
        radius = strip.diameter_mm * strip.camera["scale_px_per_mm"] / 2
        for frame in range(scene.config.frames):
            dots, uv = strip.seen(scene.rig_from_lab_mm(j, frame))
            whole = np.all((uv > radius - 0.5) & (uv < size - radius + 0.5), -1)
            lab = strip.lab_mm[dots]
            columns = {"frame": frame, "camera": name, "dot": dots, "u_px": uv[:, 0]}
            columns |= {"v_px": uv[:, 1], **{f"{x}_lab_mm": lab[:, i] for i, x in enumerate("xyz")}}
            parts.append(pd.DataFrame(columns | {"whole": whole.astype(int)}))
    return pd.concat(parts, ignore_index=True)
