"""What each camera sees of a simulated run, exactly: outlines, centres, areas, what hides what."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.io.simulation.images.bodies import outline_moments, outline_px
from telerig.io.simulation.images.bubbles import Silhouette
from telerig.io.simulation.run.scene import AXIS_RIG, RunScene
from telerig.rig.camera import Camera

_EDGE_PX = 0.5


@dataclass(frozen=True)
class CameraView:
    """M bubbles in or near one image.

    particle : (M,) ids.
    outline_px : (M, N, 2) outlines of N points.
    centre_px : (M, 2) projected centres of volume.
    silhouette_px, area_px2, second_px2 : (M, 2), (M,), (M, 2, 2) centroid, area and central second
        moments of each silhouette.
    smear_px : (M, 2) motion during the exposure.
    blur_px : (M,) standard deviation of the blur.
    visible, whole, overlap : (M,) whether a part of the silhouette is in the image, whether all of
        it is, and whether another outline crosses it.
    """

    particle: Ints
    outline_px: Array
    centre_px: Array
    silhouette_px: Array
    area_px2: Array
    second_px2: Array
    smear_px: Array
    blur_px: Array
    visible: Bools
    whole: Bools
    overlap: Bools

    def silhouettes(self, scene: RunScene) -> list[Silhouette]:
        """Return the outline, look, blur and smear of each bubble, for the renderer."""
        return [
            Silhouette(
                outline, scene.population.looks[k], float(blur), (float(smear[0]), float(smear[1]))
            )
            for k, outline, blur, smear in zip(
                self.particle, self.outline_px, self.blur_px, self.smear_px
            )
        ]

    def ellipse_px(self) -> tuple[Array, Array, Array]:
        """Return semi-axes a >= b in px, and the angle in rad from +u towards +v, each (M,).

        They are those of the ellipses with the same second moments as the silhouettes.
        """
        values, vectors = np.linalg.eigh(self.second_px2)
        angle = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
        a, b = 2 * np.sqrt(values[:, 1]), 2 * np.sqrt(values[:, 0])
        return a, b, (angle + np.pi / 2) % np.pi - np.pi / 2


def camera_view(scene: RunScene, frame: int, index: int) -> CameraView:
    """Return the view of one frame in one camera."""
    camera = list(scene.cameras.values())[index]
    to_rig = scene.rig_from_lab_mm(index, frame)
    near = _near(camera, scene.lab_mm[:, frame] + to_rig, scene.population.d_eq_mm)
    centre = scene.lab_mm[near, frame] + to_rig
    outline = outline_px(scene.bodies_lab(frame, near).moved(to_rig), camera)
    area, silhouette, second = outline_moments(outline)
    image = scene.config.image
    velocity = scene.lab_mm_s[near, frame] - AXIS_RIG * scene.velocity_mm_s[frame]
    travel = (velocity - scene.shake_mm_s[index, frame]) * image.exposure_s / 2
    smear = camera.project(centre + travel) - camera.project(centre - travel)
    depth = camera.camera_from_rig.apply(centre)[:, 2]
    blur = np.hypot(image.blur_px, image.defocus_px_per_mm * depth)
    size = np.array(camera.image_size_px) - 1
    inside = np.all((outline > -_EDGE_PX) & (outline < size + _EDGE_PX), -1)
    middle_inside = np.all((silhouette > -_EDGE_PX) & (silhouette < size + _EDGE_PX), -1)
    visible = inside.any(-1) | middle_inside
    overlap = _overlap(outline, silhouette)
    return CameraView(
        near,
        outline,
        camera.project(centre),
        silhouette,
        area,
        second,
        smear,
        blur,
        visible,
        inside.all(-1),
        overlap,
    )


def _near(camera: Camera, points_mm: Array, d_eq_mm: Array) -> Ints:
    """Return bubbles that may reach the image, by linear projection, which also holds far away."""
    at_centre, slope = linear_projection(camera)
    uv = at_centre + points_mm @ slope.T
    reach = d_eq_mm * float(np.linalg.norm(slope, 2)) + 0.02 * max(camera.image_size_px) + 10
    size = np.array(camera.image_size_px)
    return np.flatnonzero(np.all((uv > -reach[:, None]) & (uv < size + reach[:, None]), -1))


def linear_projection(camera: Camera) -> tuple[Array, Array]:
    """Return the pixel (2,) of the rig's origin and its derivative (2, 3) px/mm there."""
    step = 1e-3
    points = np.concatenate([np.zeros((1, 3)), step * np.eye(3), -step * np.eye(3)])
    uv = camera.project(points)
    return uv[0], (uv[1:4] - uv[4:]).T / (2 * step)


def _overlap(outline: Array, centre: Array) -> Bools:
    """Return (M,) whether another silhouette covers a part of this outline, or all of it."""
    out = np.zeros(len(outline), bool)
    reach = np.linalg.norm(outline - centre[:, None], axis=-1).max(-1, initial=0)
    apart = np.linalg.norm(centre[:, None] - centre, axis=-1)
    first, second = np.nonzero(np.triu(apart < reach[:, None] + reach, 1))
    for i, j in zip(first, second):
        touch = _any_inside(outline[i], outline[j], centre[j])
        if touch or _any_inside(outline[j], outline[i], centre[i]):
            out[i] = out[j] = True
    return out


def _any_inside(points: Array, outline: Array, centre: Array) -> bool:
    """Whether a point lies within an outline that every ray from its centre meets once."""
    rim, place = outline - centre, points - centre
    angle = np.arctan2(rim[:, 1], rim[:, 0])
    order = np.argsort(angle)
    radius = np.interp(
        np.arctan2(place[:, 1], place[:, 0]),
        angle[order],
        np.hypot(rim[order, 0], rim[order, 1]),
        period=2 * np.pi,
    )
    return bool(np.any(np.hypot(place[:, 0], place[:, 1]) < radius))


def truth_rows(scene: RunScene, frame: int, views: dict[str, CameraView]) -> dict[str, Any]:
    """Return the rows of `truth/runs/<run>/bubbles.csv` for one frame, as columns by name.

    There is a row for each bubble that any camera sees. It holds position and velocity of the
    centre of volume in the laboratory, its acceleration and drag coefficient where they are known,
    and its position in the carriage's frame, without any camera's shake. For each camera it holds
    the pixels of the projected centre of volume and of the silhouette's centroid (both with the
    shake of this camera), area, blur, and the flags of `CameraView`; these are blank if the bubble
    is far from the image.
    """
    seen = np.zeros(len(scene.population.d_eq_mm), bool)
    for view in views.values():
        seen[view.particle[view.visible]] = True
    particle = np.flatnonzero(seen)
    lab = scene.lab_mm[particle, frame]
    velocity = scene.lab_mm_s[particle, frame]
    rig = lab - AXIS_RIG * scene.position_mm[frame]
    columns: dict[str, Any] = {
        "frame": np.full(len(particle), frame),
        "particle": particle,
        "t_s": np.full(len(particle), scene.t_s[frame]),
    }
    for axis, name in enumerate("xyz"):
        columns[f"{name}_lab_mm"] = lab[:, axis]
        columns[f"v{name}_lab_mm_s"] = velocity[:, axis]
        columns[f"{name}_rig_mm"] = rig[:, axis]
    if scene.lab_mm_s2 is not None and scene.forces is not None:
        for axis, name in enumerate("xyz"):
            columns[f"a{name}_lab_mm_s2"] = scene.lab_mm_s2[particle, frame, axis]
        drag = scene.forces.drag_1_mm * scene.population.d_eq_mm * 4 / 3
        columns["drag"] = drag[particle]
    columns["d_eq_mm"] = scene.population.d_eq_mm[particle]
    for name, view in views.items():
        columns |= _camera_columns(name, view, particle)
    return columns


def _camera_columns(name: str, view: CameraView, particle: Ints) -> dict[str, Any]:
    place = {int(k): i for i, k in enumerate(view.particle)}
    rows = np.array([place.get(int(k), -1) for k in particle], int)
    known = rows >= 0
    values = {
        "u_px": view.centre_px[:, 0],
        "v_px": view.centre_px[:, 1],
        "silhouette_u_px": view.silhouette_px[:, 0],
        "silhouette_v_px": view.silhouette_px[:, 1],
        "area_px2": view.area_px2,
        "blur_px": view.blur_px,
    }
    columns: dict[str, Any] = {}
    for key, value in values.items():
        column = np.full(len(particle), np.nan)
        column[known] = value[rows[known]]
        columns[f"{name}_{key}"] = column
    for key, flag in (("visible", view.visible), ("whole", view.whole), ("overlap", view.overlap)):
        flags = np.zeros(len(particle), int)
        flags[known] = flag[rows[known]] & view.visible[rows[known]]
        columns[f"{name}_{key}"] = flags
    return columns
