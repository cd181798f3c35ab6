"""One body from its outlines in any number of views: centre of volume, size, shape and pole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Ints, Rows
from telerig.estimator.bubbles.shape.shapes import DEFAULT_SHAPES, Shapes
from telerig.estimator.bubbles.shape.sightings import Sightings
from telerig.estimator.bubbles.shape.spheroid import Shape, best_shape
from telerig.estimator.bubbles.shape.views import Views, grouped
from telerig.estimator.bubbles.shape.volume_centre import volume_centre
from telerig.rig.camera import Camera


@dataclass(frozen=True)
class Bodies(Rows):
    """B bodies in the rig frame, seen by up to C cameras; NaN where unknown.

    points_mm, covariance_mm2 : (B, 3), (B, 3, 3) centre of volume; the covariance includes the part
        of the shape that the outlines do not determine.
    silhouette_points_mm : (B, 3) triangulated centres of the outlines.
    used : (B,) "volume": points_mm is corrected for the shape. "silhouettes": it is not, because
        harmonics are unknown, an outline is incomplete, or the rays pass farther apart than the
        bubble is large. "none": fewer than two centres are known, and the row is NaN.
    shift_px, shift_covariance_px2 : (B, C, 2), (B, C, 2, 2) projected centre of volume minus the
        outline's centre, 0 unless used is "volume", and its covariance.
    ray_miss_mm : (B,) of the outlines' centres: the distance between two rays, with a sign; with
        more views the RMS distance of the point from the rays.
    d_eq_mm, aspect : (B,) diameter of the sphere of equal volume; equatorial over polar semi-axis.
    frame : (B, 3, 3) columns: two equatorial axes and the pole, of arbitrary sign.
    shape_covariance : (B, 6, 6) of `spheroid.PARAMETERS`.
    stretch : (B,) estimated difference of the logarithms of the body's extents along two
        horizontal axes of the rig, beyond those of a spheroid.
    noise : (B, 3) part of the variances of log size, log aspect ratio and stretch by the outlines'
        own noise, independent from frame to frame.
    fixed : (B, 2) part of the variances of log size and log aspect ratio by the rims' excess (of
        the size alone) and by the mean square of what is not seen of the shape.
    chi2 : (B,) misfit of a spheroid with t = 0, with 3 n - 4 degrees of freedom of n views.
    entire : (B,) whether nothing of any of the outlines is missing.
    """

    points_mm: Array
    covariance_mm2: Array
    silhouette_points_mm: Array
    used: NDArray[np.str_]
    shift_px: Array
    shift_covariance_px2: Array
    ray_miss_mm: Array
    d_eq_mm: Array
    aspect: Array
    frame: Array
    shape_covariance: Array
    stretch: Array
    noise: Array
    fixed: Array
    chi2: Array
    entire: Bools

    @staticmethod
    def none(count: int, cameras: int) -> Bodies:
        """Return bodies of which nothing is known."""

        def nan(*shape: int) -> Array:
            return np.full((count, *shape), np.nan)

        return Bodies(
            nan(3), nan(3, 3), nan(3), np.full(count, "none", "<U11"),
            np.zeros((count, cameras, 2)), np.zeros((count, cameras, 2, 2)), nan(), nan(), nan(),
            nan(3, 3), nan(6, 6), nan(), nan(3), nan(2), nan(), np.zeros(count, bool),
        )  # fmt: skip

    @property
    def sd_eq_mm(self) -> Array:
        """Standard deviation (B,) of d_eq_mm."""
        return np.asarray(self.d_eq_mm * np.sqrt(self.shape_covariance[:, 0, 0]))

    @property
    def pole(self) -> Array:
        """Unit vector (B, 3) along the polar axis, of arbitrary sign."""
        return np.asarray(self.frame[:, :, 2])

    def put(self, rows: Ints, other: Bodies) -> None:
        """Replace some rows by other bodies."""
        self._put(rows, **{f.name: getattr(other, f.name) for f in fields(self)})

    def _put(self, rows: Ints, **values: Any) -> None:
        for name, value in values.items():
            getattr(self, name)[rows] = value


def fit_bodies(
    sightings: Sightings,
    seen: Ints,
    cameras: Sequence[Camera],
    up: Array,
    shapes: Shapes = DEFAULT_SHAPES,
    *,
    gap_sigma_px: float = 0.0,
    unsized_px2: Array | float = 0.0,
) -> Bodies:
    """Estimate centre of volume, size and shape of B bodies.

    seen : (B, C) for each body its row in ``sightings`` for each of the C cameras, -1 for none.
    up : (3,) unit vector against gravity in the rig frame. Of an oblate spheroid with vertical pole
        and a prolate one with horizontal pole midway between two views, which have the same
        outlines, the one that is more probable for a rising bubble is returned.
    shapes : what the run tells of its bubbles (`learn_shapes`).
    gap_sigma_px : standard deviation of the difference between two views that shake or errors of
        the calibration can cause, and not the shape.
    unsized_px2 : (C,) variance by the unknown shape of the centres of a body without any outline.
    """
    bodies = Bodies.none(*seen.shape)
    spread = np.broadcast_to(unsized_px2, seen.shape[1])[:, None, None] * np.eye(2)
    for rows, used in grouped(sightings, seen):
        own = sightings.take(seen[np.ix_(rows, used)])
        added = np.where(np.any(own.shaped, axis=-1)[:, None, None, None], 0.0, spread[used])
        own = replace(own, covariance_px2=own.covariance_px2 + added)
        views = Views.of(own, [cameras[c] for c in used])
        points, noise, miss = views.triangulated
        bodies.shift_covariance_px2[np.ix_(rows, used)] = added
        bodies._put(
            rows, points_mm=points, covariance_mm2=noise, silhouette_points_mm=points,
            used="silhouettes", ray_miss_mm=miss,
        )  # fmt: skip
        shaped = views.inside() & views.sightings.shaped.any(-1)
        if not shaped.any():
            continue
        rows, views = rows[shaped], views.take(shaped)
        shape = best_shape(views, shapes, up)
        stretch, stretch_noise = _stretch(shape, cameras[0], up)
        noise = np.diagonal(shape.noise, axis1=1, axis2=2)[:, :2]
        centre = volume_centre(views, shape, shapes, gap_sigma_px)
        known = np.asarray(views.sightings.whole.any(-1))
        bodies._put(
            rows, points_mm=points[shaped] + np.where(known[:, None], centre.step_mm, 0.0),
            covariance_mm2=centre.covariance_mm2,
            used=np.where(known, "volume", "silhouettes"),
            d_eq_mm=2 * np.exp(shape.value[:, 0]), aspect=np.exp(shape.value[:, 1]),
            frame=shape.frame, shape_covariance=shape.covariance, chi2=shape.chi2,
            stretch=stretch, noise=np.column_stack([noise, stretch_noise]), fixed=shape.fixed,
            entire=views.sightings.all_entire,
        )  # fmt: skip
        bodies.shift_covariance_px2[np.ix_(rows, used)] = centre.shift_covariance_px2
        bodies.shift_px[np.ix_(rows, used)] = np.where(known[:, None, None], centre.shift_px, 0.0)
    return bodies


def body_columns(bodies: Bodies, up: Array) -> dict[str, Array]:
    """Return size and shape of B bodies as columns: ``d_eq_mm``, ``sd_eq_mm`` and `OF_SHAPE`.

    The shape is NaN where a part of an outline is missing.

    up : (3,) unit vector against gravity in the rig frame.
    """
    covariance = bodies.shape_covariance
    size_sd, aspect_sd = np.sqrt(covariance[:, 0, 0]), np.sqrt(covariance[:, 1, 1])
    shared = covariance[:, 0, 1]

    def log_sd(of_aspect: float) -> Array:
        """Of log size plus a multiple of log aspect."""
        variance = size_sd**2 + (of_aspect * aspect_sd) ** 2 + 2 * of_aspect * shared
        return np.asarray(np.sqrt(np.maximum(variance, 0)))

    pole = bodies.pole * np.where(bodies.pole @ up < 0, -1.0, 1.0)[:, None]
    tilt, tilt_sd = _tilt(bodies, up)
    equator = bodies.d_eq_mm / 2 * np.cbrt(bodies.aspect)
    polar = equator / bodies.aspect
    shape = {
        "aspect": bodies.aspect,
        "s_aspect": bodies.aspect * aspect_sd,
        "tilt_deg": np.degrees(tilt),
        "s_tilt_deg": np.degrees(tilt_sd),
        "equator_mm": equator,
        "s_equator_mm": equator * log_sd(1 / 3),
        "polar_mm": polar,
        "s_polar_mm": polar * log_sd(-2 / 3),
        "pole_x": pole[:, 0],
        "pole_y": pole[:, 1],
        "pole_z": pole[:, 2],
        "r_size_aspect": shared / (size_sd * aspect_sd),
        "spheroid_chi2": bodies.chi2,
        "noise_eq_mm": bodies.d_eq_mm * np.sqrt(bodies.noise[:, 0]),
        "fixed_eq_mm": bodies.d_eq_mm * np.sqrt(bodies.fixed[:, 0]),
        "noise_aspect": bodies.aspect * np.sqrt(bodies.noise[:, 1]),
        "fixed_aspect": bodies.aspect * np.sqrt(bodies.fixed[:, 1]),
        "stretch": bodies.stretch,
        "noise_stretch": np.sqrt(bodies.noise[:, 2]),
    }
    size = {"d_eq_mm": bodies.d_eq_mm, "sd_eq_mm": bodies.sd_eq_mm}
    return size | {name: np.where(bodies.entire, v, np.nan) for name, v in shape.items()}


def _stretch(shape: Shape, camera: Camera, up: Array) -> tuple[Array, Array]:
    """Return `Bodies.stretch` (B,), across a camera's line of sight minus along it, and the part of
    its variance by the outlines' noise."""
    sight = camera.unproject(np.array(camera.image_size_px) / 2)[1]
    across = np.cross(sight, up)
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(up, across)], -1)
    first, second = np.moveaxis(shape.frame[:, :, :2].mT @ axes, 1, 0)
    by_t = np.stack([first**2 - second**2, 2 * first * second], -1)  # (B, axis, t)
    slope = by_t[:, 0] - by_t[:, 1]
    variance = np.einsum("bi,bij,bj->b", slope, shape.noise[:, 4:, 4:], slope)
    return (slope * shape.value[:, 2:]).sum(-1), variance


def _tilt(bodies: Bodies, up: Array) -> tuple[Array, Array]:
    """Return the angle (M,) between pole and vertical in rad, 0 to pi/2, and its sd."""
    along = (bodies.frame.mT @ up[:, None])[..., 0]
    across = np.linalg.norm(along[:, :2], axis=-1, keepdims=True)
    tilt = np.arctan2(across[:, 0], np.abs(along[:, 2]))
    # an upright pole has no direction of its tilt: the mean over all of them
    toward = along[:, :2] / np.maximum(across, 1e-12)
    lean = bodies.shape_covariance[:, 2:4, 2:4]
    variance = np.einsum("mi,mij,mj->m", toward, lean, toward)
    mean = np.trace(lean, axis1=1, axis2=2) / 2
    upright = across[:, 0] ** 2 < mean
    return tilt, np.sqrt(np.where(upright, mean, variance))
