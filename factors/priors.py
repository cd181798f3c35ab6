"""Priors and gauge of the self-calibration graph, each a pure residual with its Jacobian.

They are linear or nearly so and cheap; the GTSAM wrapper is the same for all (`custom_factor`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.rig.pose import hat

Array = NDArray[np.float64]


def distance_residual(
    dots_mm: Array, pair: tuple[int, int], distance_mm: float, sigma_mm: float
) -> tuple[Array, Array]:
    """The known distance of two dots, which sets the scale. Returns (1,) and (1, 3 N)."""
    a, b = pair
    difference = dots_mm[a] - dots_mm[b]
    length = np.linalg.norm(difference)
    jacobian = np.zeros((1, dots_mm.size))
    jacobian[0, 3 * a : 3 * a + 3] = difference / length / sigma_mm
    jacobian[0, 3 * b : 3 * b + 3] = -difference / length / sigma_mm
    return np.array([(length - distance_mm) / sigma_mm]), jacobian


def depth_gauge_residual(rig_from_camera: Array, sigma_mm: float) -> tuple[Array, Array]:
    """The rig origin lies where the two optical axes come closest.

    (4, 4) pose of the second camera -> (2,) its translation along the first and the second axis,
    and (2, 6) by GTSAM's Pose3 tangent. Neither is observable; see `docs/theory.md`.
    """
    rotation, translation = rig_from_camera[:3, :3], rig_from_camera[:3, 3]
    axis = rotation[:, 2]
    residual = np.array([translation[2], translation @ axis]) / sigma_mm
    jacobian = np.zeros((2, 6))
    jacobian[0, 3:] = rotation[2]
    jacobian[1, :3] = -translation @ rotation @ hat(np.array([0.0, 0.0, 1.0]))
    jacobian[1, 3:] = axis @ rotation
    return residual, jacobian / sigma_mm


def custom_factor(
    keys: Sequence[int],
    rows: int,
    columns: Sequence[int],
    residual: Callable[[Any], tuple[Array, list[Array]]],
) -> Any:
    """A `gtsam.CustomFactor` of unit noise round ``residual(values) -> (r, [J per key])``.

    columns : dimension of each key's variable. A Jacobian with the wrong number of rows is a
    segmentation fault in GTSAM and a wrong number of columns goes unseen, so shapes are checked.
    """
    shapes = [(rows, n) for n in columns]
    import gtsam

    def error(_this: Any, values: Any, jacobians: list[Array] | None) -> Array:
        value, blocks = residual(values)
        if value.shape != (rows,):
            raise AssertionError(f"factor of {rows} rows returned {value.shape}")
        if [b.shape for b in blocks] != shapes or len(shapes) != len(keys):
            raise AssertionError(f"factor of Jacobians {shapes} gave {[b.shape for b in blocks]}")
        if jacobians is not None:
            for i, block in enumerate(blocks):
                jacobians[i] = np.asfortranarray(block)
        return value

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), list(keys), error)


def diagonal_prior(key: int, mean: Array, sigma: Array) -> Any:
    """A native GTSAM prior on a vector variable, independent components."""
    import gtsam

    return gtsam.PriorFactorVector(key, mean, gtsam.noiseModel.Diagonal.Sigmas(sigma))
