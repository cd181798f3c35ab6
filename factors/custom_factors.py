"""Provides the factors of a self-calibration as `gtsam.CustomFactor`, for users who build their own
graphs.

Each one wraps the NumPy function that defines its residual. The solvers of telerig do not use these
wrappers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from telerig.arrays import Array, Ints
from telerig.factors.calibration import (
    Observations,
    State,
    depth_gauge_residual,
    distance_residual,
    dot_columns,
    image_columns,
    place_residual,
)

Residual = Callable[[Any], tuple[Array, list[Array]]]


@dataclass(frozen=True)
class Keys:
    """Holds the GTSAM keys of a calibration's variables, and how intrinsics are scaled.

    intrinsics : for each camera the key of a vector of its F_c free intrinsics, given as
        differences from the start and in multiples of ``unit``.
    camera : for each camera the key of its Pose3 rig_from_camera; the first one is not used.
    view : for each view the key of its Pose3 rig_from_target.
    dots : for each dot the key of its position (3,) in the target frame.
    free : for each camera the indices of its free intrinsics in `PARAMETERS`.
    unit : for each camera the units (F_c,) of its free intrinsics.
    """

    intrinsics: tuple[int, ...]
    camera: tuple[int, ...]
    view: tuple[int, ...]
    dots: tuple[int, ...]
    free: tuple[Ints, ...]
    unit: tuple[Array, ...]


def custom_factor(keys: Sequence[int], columns: Sequence[int], rows: int, f: Residual) -> Any:
    """Return a `gtsam.CustomFactor` with unit noise for the residual function ``f``.

    keys, columns : the variables and the number of columns of each one's Jacobian.
    rows : number of rows of the residual.
    f : takes a `gtsam.Values` and returns the residual (rows,) and a list of Jacobians (rows,
        columns[k]).

    Raises AssertionError if the shapes are wrong: a Jacobian with a wrong number of rows crashes
    GTSAM, and a wrong number of columns goes unnoticed.
    """
    import gtsam

    shapes = [(rows, n) for n in columns]

    def error(_this: Any, values: Any, jacobians: list[Array] | None) -> Array:
        value, blocks = f(values)
        if value.shape != (rows,):
            raise AssertionError(f"factor of {rows} rows returned {value.shape}")
        if [b.shape for b in blocks] != shapes or len(shapes) != len(keys):
            raise AssertionError(f"factor of Jacobians {shapes} gave {[b.shape for b in blocks]}")
        if jacobians is not None:
            for i, block in enumerate(blocks):
                jacobians[i] = np.asfortranarray(block)
        return value

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), list(keys), error)


def image_factor(keys: Keys, start: State, image: Observations, camera: int, rho_mm: float) -> Any:
    """Return the factor of the M dots that one camera measured in one view.

    start : the state to which the increments of the intrinsics refer.
    image : the measurements of one view and one camera.
    """
    view, free, unit = int(image.view[0]), keys.free[camera], keys.unit[camera]
    variables = [*([keys.intrinsics[camera]] if len(free) else []), keys.view[view]]
    variables += [keys.camera[camera]] if camera else []
    columns = [*([len(free)] if len(free) else []), 6, *([6] if camera else [])]
    variables += [keys.dots[dot] for dot in image.dot.tolist()]
    rows = 2 * len(image)

    def residual(values: Any) -> tuple[Array, list[Array]]:
        state = _image_state(values, keys, start, image, camera)
        found = image_columns(state, image, camera, rho_mm, free.tolist())
        found[: len(free)] *= unit[:, None, None]
        flat = found.transpose(2, 1, 0).reshape(rows, -1)
        own, pose = flat[:, : len(free)], flat[:, len(free) : -7]
        blocks = [*([own] if len(free) else []), flat[:, -7:-1], *([pose] if camera else [])]
        for m, by_dot in enumerate(dot_columns(found).transpose(2, 1, 0)):
            blocks.append(np.zeros((rows, 3)))
            blocks[-1][2 * m : 2 * m + 2] = by_dot
        return flat[:, -1], blocks

    return custom_factor(variables, columns + [3] * len(image), rows, residual)


def _image_state(values: Any, keys: Keys, start: State, image: Observations, camera: int) -> State:
    """Return ``start`` with the variables of one image replaced by those of a `gtsam.Values`."""
    intrinsics, cameras = start.intrinsics.copy(), start.rig_from_camera.copy()
    views, dots = start.rig_from_target.copy(), start.dots_mm.copy()
    free, view = keys.free[camera], int(image.view[0])
    if len(free):
        intrinsics[camera, free] += values.atVector(keys.intrinsics[camera]) * keys.unit[camera]
    if camera:
        cameras[camera] = values.atPose3(keys.camera[camera]).matrix()
    views[view] = values.atPose3(keys.view[view]).matrix()
    for dot in image.dot.tolist():
        dots[dot] = values.atVector(keys.dots[dot])
    return replace(
        start, intrinsics=intrinsics, rig_from_camera=cameras, rig_from_target=views, dots_mm=dots
    )


def distance_factor(first: int, second: int, distance_mm: float, sigma_mm: float) -> Any:
    """Return the factor of the known distance between two dots, whose keys are ``first`` and
    ``second``."""

    def residual(values: Any) -> tuple[Array, list[Array]]:
        ends = values.atVector(first), values.atVector(second)
        value, by_first = distance_residual(*ends, distance_mm, sigma_mm)
        return value.reshape(1), [by_first[None], -by_first[None]]

    return custom_factor([first, second], [3, 3], 1, residual)


def depth_gauge_factor(key: int, sigma_mm: float, *, both: bool) -> Any:
    """Return the factor that fixes the origin of the rig frame; see `depth_gauge_residual`.

    both : whether the camera takes both rows, as the one that fixes the origin along the first axis
        does. A further camera takes only the row along its own axis.
    """
    first = 0 if both else 1

    def residual(values: Any) -> tuple[Array, list[Array]]:
        value, jacobian = depth_gauge_residual(values.atPose3(key).matrix(), sigma_mm)
        return value[first:], [jacobian[first:]]

    return custom_factor([key], [6], 2 - first, residual)


def place_factor(key: int, sigma_mm: float) -> Any:
    """Return the factor of the weak prior on a view's position; see `place_residual`."""

    def residual(values: Any) -> tuple[Array, list[Array]]:
        value, jacobian = place_residual(values.atPose3(key).matrix(), sigma_mm)
        return value, [jacobian]

    return custom_factor([key], [6], 3, residual)
