"""A dotted plate as one camera sees it: where its points are imaged, and its grey image.

Nothing here knows the luminance model that the dot fit uses. Sub-pixel cells are traced back
through the camera onto the plate, tested against each dot's disc, and the coverage is blurred and
integrated over the pixels. Distortion, residual perspective and sensor tilt therefore bend the
outline of a dot as they would in a lens.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from telerig.arrays import Array, Bools, Ints
from telerig.io.images.outline_raster import overlap, pixel_weights
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

SUPERSAMPLING = 8
"""Cells per pixel and direction; cells on an outline are cut by its tangent besides."""
_NODES = 5
_RIM = 24


@dataclass(frozen=True)
class Light:
    """Describe smooth light that multiplies an image, and a glare that is added to it.

    gain : factor at the image's centre.
    gradient : (2,) relative change over half the diagonal, along u and v.
    vignetting : relative loss in the corners.
    glare : (u_px, v_px, radius_px, strength) of a Gaussian spot; the strength is a fraction of full
        scale.
    """

    gain: float = 1.0
    gradient: tuple[float, float] = (0.0, 0.0)
    vignetting: float = 0.0
    glare: tuple[float, float, float, float] | None = None


def render(
    camera: Camera, rig_from_target: Pose, plate: Plate, light: Light, *, blur_px: float
) -> Array:
    """Render a dotted plate without noise, (height, width) as fractions of full scale."""
    width, height = camera.image_size_px
    dots = disc_coverage(
        camera, rig_from_target, plate, plate.dots_mm, plate.diameter_mm, plate.hole_mm, blur_px
    )
    grey = _plate_and_background(camera, rig_from_target, plate, blur_px)
    grey += (plate.dot_albedo - plate.plate_albedo) * dots
    if plate.dirt_mm is not None and plate.dirt_diameter_mm is not None:
        clean = np.zeros(len(plate.dirt_mm))
        dirt = disc_coverage(
            camera, rig_from_target, plate, plate.dirt_mm, plate.dirt_diameter_mm, clean, blur_px
        )
        dirt = np.minimum(dirt, 1)
        grey += dirt * (plate.dirt_albedo - grey)
    half_diagonal = np.hypot(width, height) / 2
    u = (np.arange(width) - (width - 1) / 2) / half_diagonal
    v = (np.arange(height)[:, None] - (height - 1) / 2) / half_diagonal
    field = 1 + light.gradient[0] * u + light.gradient[1] * v - light.vignetting * (u**2 + v**2)
    lit = light.gain * field * grey
    if light.glare is not None:
        u_px, v_px, radius, strength = light.glare
        du = (np.arange(width) - u_px) / radius
        dv = (np.arange(height)[:, None] - v_px) / radius
        lit += strength * np.exp(-(du**2 + dv**2) / 2)
    return np.asarray(lit)


def disc_coverage(
    camera: Camera,
    rig_from_target: Pose,
    plate: Plate,
    centres_mm: Array,
    diameter_mm: Array,
    hole_mm: Array,
    blur_px: float,
) -> Array:
    """Return the blurred share (height, width) of each pixel that N discs cover."""
    width, height = camera.image_size_px
    near = _near_image(camera, rig_from_target, plate, centres_mm, diameter_mm, blur_px)
    centres, diameter, hole = centres_mm[near], diameter_mm[near], hole_mm[near]
    first, count = _windows(camera, rig_from_target, plate, centres, diameter)
    # nodes (N, 2, n, n): x, y from each disc's centre at the n x n Chebyshev nodes of its window.
    along = (first[:, None, :] - 0.5) + count[:, None, :] * (1 + _chebyshev(_NODES)[:, None]) / 2
    uv = np.empty((len(centres), _NODES, _NODES, 2))
    uv[..., 0], uv[..., 1] = along[:, None, :, 0], along[:, :, None, 1]
    xy = plate_from_pixel(camera, rig_from_target, uv, plate, centres[:, None, None, 2])
    nodes = np.moveaxis(xy - centres[:, None, None, :2], -1, 1)
    pad = int(np.ceil(5 * blur_px)) + 1
    out = np.zeros((height + 2 * pad, width + 2 * pad))
    for corner, size, local, outer, inner in zip(first, count, nodes, diameter, hole):
        fine = _cell_coverage(local, size, outer / 2)
        if inner > 0:
            fine -= _cell_coverage(local, size, inner / 2)
        rows, columns = (_pixel_weights(int(n), SUPERSAMPLING, pad, blur_px) for n in size[::-1])
        patch = rows @ fine @ columns.T
        inside, taken = overlap(out.shape, patch.shape, int(corner[1]), int(corner[0]))
        out[inside] += patch[taken]
    return out[pad : pad + height, pad : pad + width]


def _near_image(
    camera: Camera, pose: Pose, plate: Plate, centres: Array, diameter: Array, blur_px: float
) -> Bools:
    """Return (N,) whether a disc can reach the image; decided without far projections."""
    width, height = camera.image_size_px
    edge = np.linspace(0, 1, 9)
    side = np.stack(np.meshgrid(edge * (width - 1), edge * (height - 1)), -1).reshape(-1, 2)
    seen = plate_from_pixel(camera, pose, side, plate)
    low, high = seen.min(0), seen.max(0)
    reach = diameter[:, None] + (6 * blur_px + 2) * (high - low) / min(width, height)
    inside = (centres[:, :2] > low - reach) & (centres[:, :2] < high + reach)
    return np.asarray(inside.all(1))


def _windows(
    camera: Camera, pose: Pose, plate: Plate, centres: Array, diameter: Array
) -> tuple[Ints, Ints]:
    """Return first pixel (N, 2) and size (N, 2) in pixels of the box round each disc, as (u, v)."""
    angle = np.arange(_RIM) * 2 * np.pi / _RIM
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(_RIM)], -1)
    points = centres[:, None, :] + 0.51 * diameter[:, None, None] * rim
    uv = pixel_from_plate(camera, pose, points, plate)
    first = np.floor(uv.min(1)).astype(np.int64)
    return first, np.ceil(uv.max(1)).astype(np.int64) - first + 1


def _cell_coverage(nodes: Array, size: Ints, radius_mm: float) -> Array:
    """Return (cells_v, cells_u) share of every cell of a window that lies in the disc."""
    columns, rows = _interpolation(int(size[0])), _interpolation(int(size[1]))
    x, y = rows @ nodes @ columns.T
    square = x * x + y * y
    coverage = (square < radius_mm**2).astype(float)
    # jacobian (2, 2): mean change of plate coordinates (mm) per cell, d(x, y) / d(u, v).
    by_u = [np.mean(a[:, -1] - a[:, 0]) / (a.shape[1] - 1) for a in (x, y)]
    by_v = [np.mean(a[-1] - a[0]) / (a.shape[0] - 1) for a in (x, y)]
    jacobian = np.array([by_u, by_v]).T
    reach = 0.75 * float(np.linalg.norm(jacobian))
    band = np.abs(square - radius_mm**2) < reach * (2 * radius_mm + reach)
    distance = np.sqrt(square[band])
    outward = np.stack([x[band], y[band]], -1) / np.maximum(distance, 1e-12)[:, None]
    coverage[band] = _half_plane_share(radius_mm - distance, outward @ jacobian)
    return np.asarray(coverage)


def _half_plane_share(depth: Array, slope: Array) -> Array:
    """Return the share (N,) of a unit cell inside a straight edge.

    depth : (N,) distance of the cell's centre inside the edge. slope : (N, 2) its change per cell
    along u and v.
    """
    steep = np.abs(slope).max(-1)
    flat = np.abs(slope).min(-1)
    corner = np.maximum((steep + flat) / 2 - np.abs(depth), 0.0)
    small = np.where(
        np.abs(depth) >= (steep - flat) / 2,
        corner**2 / (2 * steep * np.maximum(flat, 1e-300)),
        0.5 - np.abs(depth) / steep,
    )
    return np.asarray(np.where(depth > 0, 1 - small, small))


_pixel_weights = lru_cache(maxsize=512)(pixel_weights)


def _chebyshev(count: int) -> Array:
    return -np.cos(np.pi * (np.arange(count) + 0.5) / count)


@lru_cache(maxsize=512)
def _interpolation(count: int) -> Array:
    """Return (cells, nodes): Lagrange polynomials of the window's nodes at its cells."""
    cells = (np.arange(count * SUPERSAMPLING) + 0.5) / (count * SUPERSAMPLING)
    return _lagrange(2 * cells - 1, _chebyshev(_NODES))


def _lagrange(at: Array, nodes: Array) -> Array:
    """Return Lagrange polynomials (N, K) of the nodes (K,) at places (N,)."""
    gap = nodes[:, None] - nodes
    np.fill_diagonal(gap, 1.0)
    factors = np.repeat((at[:, None] - nodes)[:, None, :], len(nodes), 1)
    factors[:, np.arange(len(nodes)), np.arange(len(nodes))] = 1.0
    return np.asarray(np.prod(factors / gap, -1))


def _plate_and_background(camera: Camera, pose: Pose, plate: Plate, blur_px: float) -> Array:
    """Return (height, width) the bare plate before its surroundings; straight edges, blurred."""
    width, height = camera.image_size_px
    if plate.outline_mm is None:
        return np.full((height, width), plate.plate_albedo)
    nodes = _chebyshev(2 * _NODES)
    u, v = (width - 1) / 2 * (1 + nodes), (height - 1) / 2 * (1 + nodes)
    at_nodes = plate_from_pixel(camera, pose, np.stack(np.meshgrid(u, v), -1), plate)
    columns = _lagrange(np.linspace(-1, 1, width), nodes)
    rows = _lagrange(np.linspace(-1, 1, height), nodes)
    x0, y0, x1, y1 = plate.outline_mm
    share = np.ones((height, width))
    for axis, low, high in ((0, x0, x1), (1, y0, y1)):
        place = rows @ at_nodes[..., axis] @ columns.T
        by_v, by_u = np.gradient(place)
        spread = np.hypot(by_u, by_v) * np.sqrt(blur_px**2 + 1 / 12)
        share *= ndtr((place - low) / spread) * ndtr((high - place) / spread)
    return plate.background_albedo + share * (plate.plate_albedo - plate.background_albedo)


@dataclass(frozen=True)
class Plate:
    """A flat plate with round dots, in the target's frame; its front is the side of negative z.

    dots_mm : (N, 3) centres; each dot is a disc parallel to the plate at its own z.
    diameter_mm, hole_mm : (N,) outer diameter, and the diameter of the hole of a ring (else 0).
    outline_mm : (x0, y0, x1, y1) of the plate; None: it fills every image.
    thickness_mm, index : of the glass that a camera behind the plate looks through.
    dot_albedo, plate_albedo, background_albedo : grey levels as fractions of full scale.
    dirt_mm, dirt_diameter_mm, dirt_albedo : (M, 3), (M,) specks that cover what is below them.
    """

    dots_mm: Array
    diameter_mm: Array
    hole_mm: Array
    outline_mm: tuple[float, float, float, float] | None = None
    thickness_mm: float = 0.0
    index: float = 1.5
    dot_albedo: float = 0.75
    plate_albedo: float = 0.1
    background_albedo: float = 0.25
    dirt_mm: Array | None = None
    dirt_diameter_mm: Array | None = None
    dirt_albedo: float = 0.3


def plate_from_pixel(
    camera: Camera, rig_from_target: Pose, uv_px: ArrayLike, plate: Plate, z_mm: ArrayLike = 0.0
) -> Array:
    """Return where rays of pixels (..., 2) meet the target's plane ``z_mm``, (..., 2) in mm."""
    origin, direction = camera.unproject(uv_px)
    target_from_rig = rig_from_target.inverse()
    origin = target_from_rig.apply(np.atleast_2d(origin))
    direction = direction @ target_from_rig.rotation.T
    along = (np.asarray(z_mm) - origin[..., 2]) / direction[..., 2]
    hit = origin[..., :2] + along[..., None] * direction[..., :2]
    return np.asarray(hit - _glass_shift(direction, plate)).reshape(np.shape(uv_px))


def pixel_from_plate(
    camera: Camera, rig_from_target: Pose, points_mm: ArrayLike, plate: Plate
) -> Array:
    """Project points on the plate, (..., 3) in mm in the target's frame, to pixels (..., 2).

    A camera behind the plate sees them through the glass. The ray's shift depends on its direction;
    for kappa != 0 it is found by iteration.
    """
    points = np.asarray(points_mm, float)
    uv = camera.project(rig_from_target.apply(points))
    if plate.thickness_mm == 0:
        return uv
    target_from_rig = rig_from_target.inverse()
    for _ in range(4 if camera["kappa_per_mm"] else 1):
        direction = camera.unproject(uv)[1] @ target_from_rig.rotation.T
        apparent = points.copy()
        apparent[..., :2] += _glass_shift(direction, plate)
        uv = camera.project(rig_from_target.apply(apparent))
    return uv


def image_centres(camera: Camera, rig_from_target: Pose, plate: Plate) -> Array:
    """Return the centres of area of the dots' images, (N, 2) in px.

    Perspective and distortion move them away from the images of the dots' centres. Each image is
    the polygon of 64 points of the dot's rim.
    """
    angle = 2 * np.pi * np.arange(64) / 64
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
    rims = plate.dots_mm[:, None] + plate.diameter_mm[:, None, None] / 2 * circle
    centre = pixel_from_plate(camera, rig_from_target, plate.dots_mm, plate)
    rim = pixel_from_plate(camera, rig_from_target, rims, plate) - centre[:, None]
    following = np.roll(rim, -1, axis=1)
    twice = rim[..., 0] * following[..., 1] - rim[..., 1] * following[..., 0]
    moment = np.sum(twice[..., None] * (rim + following), 1) / 3
    return np.asarray(centre + moment / np.sum(twice, 1)[:, None])


def _glass_shift(direction: Array, plate: Plate) -> Array:
    """Return straight hit minus refracted hit (..., 2) of directions (..., 3) in target axes."""
    lateral = direction[..., :2]
    if plate.thickness_mm == 0:
        return np.zeros_like(lateral)
    inside = lateral / plate.index
    refracted = inside / np.sqrt(1 - np.sum(inside**2, -1, keepdims=True))
    straight = lateral / np.abs(direction[..., 2:])
    return np.asarray(
        np.where(direction[..., 2:] < 0, plate.thickness_mm * (straight - refracted), 0.0)
    )
