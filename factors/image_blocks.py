"""What images add to the normal equations: the products of their derivatives, many at a time.

Equal to products of `telerig.factors.projection.whitened_residuals`, without its arrays of all
derivatives. A camera's pose needs no columns of its own: pixels depend on where the target is in
the camera alone, so that its columns are those of the view times a 6 x 6 matrix of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

import numpy as np
from numpy.typing import NDArray

from telerig.factors import lens_planes as planes
from telerig.factors.image_rows import ImageRows
from telerig.factors.lens_planes import Lens
from telerig.factors.projection import State, apparent_shift_mm
from telerig.io.machine.parallel import keep_freed_memory
from telerig.rig.pose import hat

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ImageBlocks:
    """Products of a chunk's K = 7 + F columns: view (6), free intrinsics (F), residual.

    gram : (I, K, K) of the columns with each other.  by_dot : (I, K, 3, m) of the columns with
    those of each dot; the view's rows 3 to 5 are the dot's own block.
    view_from_camera : (I, 6, 6), see `view_from_camera_tangent`.
    """

    gram: Array
    by_dot: Array
    view_from_camera: Array


@dataclass(frozen=True)
class Placed:
    """rotation : (I, 3, 3) camera from target.  target, camera : (I, 3, m) dots in either frame."""

    rotation: Array
    target: Array
    camera: Array


def camera_from_target(state: State, rows: ImageRows) -> tuple[Array, Array]:
    """(I, 3, 3) rotation and (I, 3, 1) translation of every image."""
    view, camera = state.rig_from_target[rows.view], state.rig_from_camera[rows.camera]
    camera_from_rig = np.swapaxes(camera[:, :3, :3], -1, -2)
    rotation = camera_from_rig @ view[:, :3, :3]
    return rotation, camera_from_rig @ (view[:, :3, 3:] - camera[:, :3, 3:])


def placed(state: State, rows: ImageRows, rotation: Array, offset: Array) -> Placed:
    """The dots as `telerig.factors.projection.camera_points` has them."""
    dots = np.take(state.dots_mm.T, rows.dot, axis=1)
    if np.any(rows.plate_shift):
        shift, _ = apparent_shift_mm(np.abs(rotation[:, 2, 2]), *rows.plate)
        dots[2] += (rows.plate_shift * shift)[:, None]
    target = dots.transpose(1, 0, 2)
    return Placed(rotation, target, rotation @ target + offset)


def view_from_camera_tangent(rotation: Array, offset: Array) -> Array:
    """(I, 6, 6): the view's right perturbation that does to pixels what the camera's does.

    rig_from_camera exp(w) moves camera_from_target by exp(-w) on the left, which is minus the
    adjoint of target_from_camera on the right (GTSAM's order: rotation, translation).
    """
    back = np.swapaxes(rotation, -1, -2)
    out = np.zeros((len(back), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = -back
    out[:, 3:, :3] = hat((back @ offset)[..., 0]) @ back
    return out


class Scratch:
    """Memory that is used again for the next chunk: a fresh megabyte costs more than its use."""

    def __init__(self) -> None:
        self._kept: dict[str, Array] = {}
        keep_freed_memory()

    def empty(self, name: str, *shape: int) -> Array:
        """The beginning of what is kept under the name, which grows; its content is lost."""
        size = prod(shape)
        if name not in self._kept or len(self._kept[name]) < size:
            self._kept[name] = np.empty(size)
        return self._kept[name][:size].reshape(shape)


def view_gram(state: State, rows: ImageRows, rho_mm: tuple[float, ...]) -> Array:
    """(I, 7, 7) products of the view's columns and the residual, for fits of views alone."""
    return _gram(_all_columns(state, rows, rho_mm, (), Scratch())[0])


def image_blocks(
    state: State, rows: ImageRows, rho_mm: tuple[float, ...], free: Sequence[int], scratch: Scratch
) -> ImageBlocks:
    """Valid until ``scratch`` is used again.

    free : the intrinsics of interest, indices into `PARAMETERS`, the same for all cameras.
    """
    columns, moved = _all_columns(state, rows, rho_mm, free, scratch)
    images, count, _, width = columns.shape
    by_dot = scratch.empty("by dot", images, count, 3, width)
    other = scratch.empty("other", images, count, 3, width)
    np.multiply(columns[:, :, None, 0], columns[:, None, 3:6, 0], out=by_dot)
    np.multiply(columns[:, :, None, 1], columns[:, None, 3:6, 1], out=other)
    by_dot += other
    return ImageBlocks(_gram(columns), by_dot, moved)


def _all_columns(
    state: State, rows: ImageRows, rho_mm: tuple[float, ...], free: Sequence[int], scratch: Scratch
) -> tuple[Array, Array]:
    """`fill_columns` and `view_from_camera_tangent`."""
    rotation, offset = camera_from_target(state, rows)
    at = placed(state, rows, rotation, offset)
    lens = planes.lens_of(state.intrinsics, rho_mm, rows)
    out = scratch.empty("columns", len(rows.view), 7 + len(free), 2, rows.dot.shape[1])
    fill_columns(out, at, lens, rows, free)
    return out, view_from_camera_tangent(rotation, offset)


def _gram(columns: Array) -> Array:
    flat = columns.reshape(*columns.shape[:2], -1)
    return np.asarray(flat @ np.swapaxes(flat, -1, -2))


def fill_columns(out: Array, at: Placed, lens: Lens, rows: ImageRows, free: Sequence[int]) -> None:
    """(I, 7 + F, 2, m) whitened derivatives by view and free intrinsics, and the residual."""
    seen = planes.ideal(at.camera, lens, rows, derivatives=True)
    r2 = seen.x * seen.x + seen.y * seen.y
    xd, yd = planes.distorted(seen.x, seen.y, r2, lens)
    white = rows.whitener
    white_by_sensor = _white_by_sensor(white, lens)
    xs, ys = xd * lens.rho, yd * lens.rho
    white_by_distorted, by_tilt = white_by_sensor, None
    if lens.tilt or any(planes.TILT.start <= p < planes.TILT.stop for p in free):
        (xs, ys), by_xy, by_tilt = planes.tilted(xs, ys, lens, rows)
        white_by_distorted = _matmul(white_by_sensor, by_xy)
        by_tilt = _matmul(white_by_sensor, by_tilt)
    white_by_distorted = white_by_distorted * lens.rho
    _residual(out[:, -1], xs, ys, lens, rows)
    slopes = planes.distortion_slopes(seen.x, seen.y, r2, lens)
    by_ideal = white_by_distorted if slopes is None else _matmul(white_by_distorted, slopes)
    by_kappa = _pose_columns(out[:, :6], by_ideal, seen, lens, at, rows)
    for i, p in enumerate(free):
        column = out[:, 6 + i]
        basis = planes.coefficient_basis(p, seen.x, seen.y, r2)
        if basis is not None:
            _apply(white_by_distorted, *basis, column)
        elif p == planes.SCALE:
            _apply(white_by_sensor, xs / lens[planes.SCALE], ys / lens[planes.SCALE], column)
        elif p == planes.KAPPA:
            column[:] = by_kappa
        elif p in (planes.ASPECT, planes.SKEW):
            np.multiply(white[:, 1 - (p - planes.ASPECT)].swapaxes(0, 1),
                        (ys * lens[planes.SCALE])[:, None], out=column)  # fmt: skip
        elif p in (planes.CU, planes.CV):
            column[:] = white[:, p - planes.CU].swapaxes(0, 1)
        elif by_tilt is not None and planes.TILT.start <= p < planes.TILT.stop:
            column[:] = by_tilt[:, p - planes.TILT.start].swapaxes(0, 1)
        elif seen.by_turn is not None:
            _apply(by_ideal, *_pair(seen.by_turn[:, p - planes.WALL.start]), column)
        else:
            column[:] = 0.0


def _white_by_sensor(white: Array, lens: Lens) -> Array:
    """(2, 2, I, m) whitened pixels by sensor coordinates."""
    scale = lens[planes.SCALE]
    if not lens.affine:
        return white * scale
    out = np.empty_like(white)
    np.multiply(white[:, 0], scale, out=out[:, 0])
    out[:, 1] = white[:, 1] * (scale * lens[planes.ASPECT]) + out[:, 0] * lens[planes.SKEW]
    return out


def _matmul(left: Array, right: Array | planes.Matrix) -> Array:
    """(2, 2) times (2, n), component by component."""
    first, second = np.asarray(right[0]), np.asarray(right[1])
    return np.asarray(left[:, 0, None] * first + left[:, 1, None] * second)


def _apply(matrix: Array, x: Array, y: Array, out: Array) -> None:
    """out : (I, 2, m), the (2, 2, I, m) matrix times (x, y)."""
    np.multiply(matrix[:, 0].swapaxes(0, 1), x[:, None], out=out)
    out += matrix[:, 1].swapaxes(0, 1) * y[:, None]


def _residual(out: Array, xs: Array, ys: Array, lens: Lens, rows: ImageRows) -> None:
    scale = lens[planes.SCALE]
    if lens.affine:
        u = scale * (xs + lens[planes.SKEW] * ys)
        v = (scale * lens[planes.ASPECT]) * ys
    else:
        u, v = scale * xs, scale * ys
    u += lens[planes.CU] - rows.uv_px[0]
    v += lens[planes.CV] - rows.uv_px[1]
    _apply(rows.whitener, u, v, out)


def _pose_columns(
    out: Array, by_ideal: Array, seen: planes.Ideal, lens: Lens, at: Placed, rows: ImageRows
) -> Array:
    """Fills (I, 6, 2, m) with the view's columns; returns the column of kappa, (I, 2, m)."""
    images, _, _, width = out.shape
    by_point = np.empty((images, 3, 2, width))
    across, down = by_ideal[:, 0].swapaxes(0, 1), by_ideal[:, 1].swapaxes(0, 1)
    if seen.by_point is None:
        depth = np.broadcast_to(seen.by_depth, seen.x.shape)[:, None]
        np.multiply(across, depth, out=by_point[:, 0])
        np.multiply(down, depth, out=by_point[:, 1])
        pull = (across * seen.x[:, None] + down * seen.y[:, None]) * (depth * lens.rho[..., None])
        np.multiply(pull, -lens[planes.KAPPA][:, None], out=by_point[:, 2])
        by_kappa = pull * -at.camera[:, 2, None]
    else:
        for j in range(3):
            _apply(by_ideal, *_pair(seen.by_point[:, j]), by_point[:, j])
        by_kappa = np.empty((images, 2, width))
        _apply(by_ideal, *_pair(seen.by_kappa), by_kappa)
    turned = np.swapaxes(at.rotation, -1, -2) @ by_point.reshape(images, 3, 2 * width)
    out[:, 3:] = turned.reshape(images, 3, 2, width)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(at.target[:, j, None], out[:, 3 + k], out=out[:, i])
        out[:, i] -= at.target[:, k, None] * out[:, 3 + j]
    if np.any(rows.plate_shift):
        _add_plate_slopes(out, at.rotation, rows)
    return by_kappa


def _pair(planes_or_none: Array | None) -> tuple[Array, Array]:
    assert planes_or_none is not None
    return planes_or_none[0], planes_or_none[1]


def _add_plate_slopes(out: Array, rotation: Array, rows: ImageRows) -> None:
    cosine = rotation[:, 2, 2]
    _, slope = apparent_shift_mm(np.abs(cosine), *rows.plate)
    slope = rows.plate_shift * slope * np.sign(cosine)
    out[:, 0] -= out[:, 5] * (slope * rotation[:, 2, 1])[:, None, None]
    out[:, 1] += out[:, 5] * (slope * rotation[:, 2, 0])[:, None, None]


def squared_error(state: State, rows: ImageRows, rho_mm: tuple[float, ...]) -> float:
    """Sum of the squared whitened residuals of a chunk."""
    at = placed(state, rows, *camera_from_target(state, rows))
    lens = planes.lens_of(state.intrinsics, rho_mm, rows)
    seen = planes.ideal(at.camera, lens, rows, derivatives=False)
    r2 = seen.x * seen.x + seen.y * seen.y
    xd, yd = planes.distorted(seen.x, seen.y, r2, lens)
    xs, ys = planes.sensor_xy(xd * lens.rho, yd * lens.rho, lens, rows)
    out = np.empty((len(rows.view), 2, rows.dot.shape[1]))
    _residual(out, xs, ys, lens, rows)
    return float(np.vdot(out, out))
