"""How two detections compare: the gap along the shared coordinate, the ratios of their sizes.

Two views of one body share the planes that touch it and hold both viewing directions. So along
the common perpendicular of the rays both silhouettes have the same top and the same bottom, for
any body and any angle between the cameras. The *gap* is the mismatch of the two middles, the
*height* half the distance of top and bottom.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools
from telerig.errors import InputError
from telerig.estimator.bubbles.outline.ellipse_geometry import (
    AXES_COLUMNS,
    CENTRE_COLUMNS,
    COVARIANCE_COLUMNS,
    HARMONIC_COLUMNS,
    HARMONICS,
    centre_covariances,
    columns,
    flag_words,
)
from telerig.rig import projection
from telerig.rig.camera import Camera
from telerig.rig.triangulation import midpoint

NO_SIZE_FLAGS = ("border", "merged")
_SCATTER_FACTOR = {"overlap": 2.0, "defocus": 1.5, "saturated": 1.5, "merged": 3.0, "border": 3.0}
_UNSURE_SHARE = {"overlap": 0.01, "merged": 0.05, "border": 0.05}
"""By flag, the standard deviation that a partly hidden outline adds to the centre, as a share of
the major semi-axis."""
_OUTLINE_SAMPLES = 96


@dataclass(frozen=True)
class View:
    """Hold the N detections of one camera, as `pair_geometry` compares them.

    The shared axis is the common perpendicular of both cameras' optical axes.

    camera : the camera.
    uv_px, covariance_px2 : (N, 2) centres (px) and their (N, 2, 2) covariances (px^2).
    origin_mm, direction : (N, 3) origins (mm) and unit directions of the rays in the rig frame.
    mm_by_px : (N, 2, 2) derivative of a point at depth 0 in the camera's frame (mm) by the pixel.
    middle_mm : (N,) position midway between the outline's top and bottom along the shared axis,
        minus the centre's position (mm).
    log_size : (N, 2) logarithms of half the height and half the width (mm), along and across the
        shared axis; NaN where unknown.
    log_contrast : (N, 1) logarithm of the contrast; NaN where unknown.
    scatter_factor : (N,) factor on the scatter of the gap, above 1 for detections with some flags.
    """

    camera: Camera
    uv_px: Array
    origin_mm: Array
    direction: Array
    mm_by_px: Array
    covariance_px2: Array
    middle_mm: Array
    log_size: Array
    log_contrast: Array
    scatter_factor: Array

    def __len__(self) -> int:
        return len(self.scatter_factor)


@dataclass(frozen=True)
class PairGeometry:
    """Compare all combinations of a frame's N1 first and N2 second detections.

    views : the detections of both cameras.
    gap_px : (N1, N2) position of the first minus that of the second along the shared axis, in px of
        the first image, including any bias. It is positive along +u or +v of this image, whichever
        is nearer to the axis.
    variance_px2 : (N1, N2) variance of the gap that follows from the detections' covariances.
    points_mm : (N1, N2, 3) points midway between the two rays, in the rig frame (mm).
    size : (N1, N2, 2) logarithms of the ratios first / second of height and width.
    contrast : (N1, N2, 1) logarithm of the ratio first / second of the contrast.
    mm_per_px : (N1, N2) length of one pixel of the gap (mm).
    scatter_factor : (N1, N2) the larger of both detections' factors.
    """

    views: tuple[View, View]
    gap_px: Array
    variance_px2: Array
    points_mm: Array
    size: Array
    contrast: Array
    mm_per_px: Array
    scatter_factor: Array


def shared_axis(cameras: tuple[Camera, Camera]) -> Array:
    """Return the direction of the common perpendicular of two cameras' optical axes.

    Returns a unit vector (3,) in the rig frame. It points along +u or +v of the first camera's
    image, whichever is nearer.
    Raises InputError if both cameras look along nearly the same direction.
    """
    first, second = (c.camera_from_rig.rotation[2] for c in cameras)
    cross = np.cross(first, second)
    length = np.linalg.norm(cross)
    if length < 0.05:
        raise InputError(
            "both cameras look along nearly the same direction",
            todo="views less than 3 deg apart cannot be matched by a shared coordinate",
        )
    in_first = (cameras[0].camera_from_rig.rotation @ cross)[:2]
    return np.asarray(cross / length * np.sign(in_first[np.argmax(np.abs(in_first))]))


def view_of(table: pd.DataFrame, camera: Camera, axis: Array) -> View:
    """Compute rays and sizes from the detections of one camera.

    table : table of `detect_bubbles`; camera : the calibrated camera.
    axis : (3,) shared axis in the rig frame, see `shared_axis`.

    Raises InputError if a column is missing, or if a centre or its covariance is not finite.
    """
    missing = {*CENTRE_COLUMNS, *COVARIANCE_COLUMNS, *AXES_COLUMNS[:2]} - set(table)
    if missing:
        raise InputError(
            f"the detections of camera {camera.name!r} lack {', '.join(sorted(missing))}",
            todo="give the table that detect_bubbles returns",
        )
    uv, covariance = columns(table, CENTRE_COLUMNS), centre_covariances(table)
    bad = ~(np.isfinite(uv).all(1) & np.isfinite(covariance).all((1, 2)))
    if bad.any():
        raise InputError(
            f"{int(bad.sum())} detections of camera {camera.name!r} have no finite centre or "
            f"covariance (first: row {int(np.argmax(bad))})",
            todo="leave such rows out",
        )
    origin, direction = camera.unproject(uv)
    mm_by_px = _mm_by_px(camera, uv)
    across = np.einsum("i,nij->nj", (camera.camera_from_rig.rotation @ axis)[:2], mm_by_px)
    middle, height = outline_extent(table, across)
    known, scatter_factor, unsure = _trust(table)
    a, b, measured, contrast = columns(table, ["a_px", "b_px", "area_px2", "contrast"]).T
    extra = np.square(unsure * np.nan_to_num(a))
    area = np.where(measured > 0, measured, np.pi * a * b)
    area_mm2 = area * np.abs(np.linalg.det(mm_by_px))
    with np.errstate(divide="ignore", invalid="ignore"):
        log_height = np.where(known & (height > 0), np.log(height), np.nan)
        log_width = np.log(area_mm2 / np.pi) - log_height
        log_contrast = np.log(contrast)
    return View(
        camera, uv, origin, direction, mm_by_px,
        covariance + extra[:, None, None] * np.eye(2), middle,
        _finite(np.stack([log_height, log_width], -1)), _finite(log_contrast[:, None]),
        scatter_factor,
    )  # fmt: skip


def pair_geometry(first: View, second: View) -> PairGeometry:
    """Compare each detection of the first view with each of the second."""
    views = (first, second)
    origins = (first.origin_mm[:, None], second.origin_mm[None])
    directions = (first.direction[:, None], second.direction[None])
    points, _ = midpoint(origins[0], directions[0], origins[1], directions[1])
    axis = np.cross(directions[0], directions[1])
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    axis *= np.sign(axis @ shared_axis((first.camera, second.camera)))[..., None]
    gap = ((origins[0] - origins[1]) * axis).sum(-1)
    variance, stretch, lengths = np.zeros_like(gap), [], []
    for c, view in enumerate(views):
        pose = view.camera.camera_from_rig
        depth = points @ pose.rotation[2] + pose.translation_mm[2]
        magnified = 1 + view.camera["kappa_per_mm"] * depth
        per_row = (slice(None), None) if c == 0 else (None, slice(None))
        across = (axis @ pose.rotation.T)[..., None, :2] @ view.mm_by_px[per_row]
        across = across[..., 0, :] * magnified[..., None]
        spread = np.einsum("...i,...ij,...j", across, view.covariance_px2[per_row], across)
        variance += spread
        gap += (1 - 2 * c) * view.middle_mm[per_row] * magnified
        stretch.append(np.log(magnified))
        lengths.append(np.linalg.norm(across, axis=-1))
    return PairGeometry(
        views, gap / lengths[0], variance / lengths[0] ** 2, points,
        first.log_size[:, None] - second.log_size + (stretch[0] - stretch[1])[..., None],
        first.log_contrast[:, None] - second.log_contrast,
        lengths[0], np.maximum(first.scatter_factor[:, None], second.scatter_factor),
    )  # fmt: skip


def outline_extent(table: pd.DataFrame, across: Array) -> tuple[Array, Array]:
    """Compute how far outlines extend along a direction.

    table : detection table with N rows.
    across : (N, 2) for each row, the increase (mm) of the coordinate along this direction per px
        of u and of v.

    Returns two arrays (N,) in mm: the middle of each outline's extent relative to its centre, and
    half of the extent. Harmonics are used if they were fitted.
    """
    a, b, angle = columns(table, AXES_COLUMNS).T
    angle = np.nan_to_num(angle)
    turn = np.stack([np.cos(angle), np.sin(angle)], -1)
    along = (across * turn).sum(-1)
    beside = across[:, 1] * turn[:, 0] - across[:, 0] * turn[:, 1]
    half = np.hypot(a * along, b * beside)
    middle = np.zeros(len(table))
    harmonics = columns(table, HARMONIC_COLUMNS)
    shaped = np.isfinite(harmonics).all(1)
    if shaped.any():
        phi = 2 * np.pi * np.arange(_OUTLINE_SAMPLES) / _OUTLINE_SAMPLES
        cosine, sine = np.cos(phi), np.sin(phi)
        a, b, along, beside = (v[shaped, None] for v in (a, b, along, beside))
        normal = (b * cosine * along + a * sine * beside) / np.hypot(b * cosine, a * sine)
        waves = np.stack([f(k * phi) for k in HARMONICS for f in (np.cos, np.sin)])
        profile = a * cosine * along + b * sine * beside + normal * (harmonics[shaped] @ waves)
        top, bottom = _peak(profile), -_peak(-profile)
        middle[shaped], half[shaped] = (top + bottom) / 2, (top - bottom) / 2
    return middle, half


def _peak(profile: Array) -> Array:
    """Return the maximum of each row of a periodic profile, refined by a parabola."""
    rows, i = np.arange(len(profile)), np.argmax(profile, axis=1)
    n = profile.shape[1]
    before, here, after = profile[rows, i - 1], profile[rows, i], profile[rows, (i + 1) % n]
    bend = before - 2 * here + after
    bend = np.where(bend < 0, bend, -1.0)
    return np.asarray(here - (after - before) ** 2 / (8 * bend))


def _mm_by_px(camera: Camera, uv_px: Array) -> Array:
    ideal = projection.ideal_from_pixel(uv_px, camera.intrinsics, camera.rho_mm)
    points = np.concatenate([ideal, np.zeros((len(ideal), 1))], -1)
    _, by_point, _ = projection.pixel_jacobians(points, camera.intrinsics, camera.rho_mm, free=())
    return np.asarray(np.linalg.inv(by_point[..., :2]))


def _trust(table: pd.DataFrame) -> tuple[Bools, Array, Array]:
    """Return how far each of N detections can be trusted, as its flags say.

    Returns three arrays (N,): whether the size is known, the factor on the scatter of the gap, and
    the additional standard deviation of the centre as a share of the major semi-axis.
    """
    flags = flag_words(table)
    known = np.array([not any(word in NO_SIZE_FLAGS for word in row) for row in flags], bool)
    factor = [max((_SCATTER_FACTOR.get(word, 1.0) for word in row), default=1.0) for row in flags]
    unsure = [max((_UNSURE_SHARE.get(word, 0.0) for word in row), default=0.0) for row in flags]
    return known, np.array(factor), np.array(unsure)


def _finite(values: Array) -> Array:
    return np.where(np.isfinite(values), values, np.nan)
