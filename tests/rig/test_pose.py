"""Rotation vectors against SciPy's, from nothing to half a turn."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from telerig.rig.pose import rotation_from_rotvec, rotvec_from_rotation


@pytest.mark.parametrize("angle_rad", [0.0, 1e-12, 1e-6, 0.1, 2.0, np.pi - 1e-9])
def test_there_and_back(angle_rad: float) -> None:
    rng = np.random.default_rng(0)
    rotvec = rng.standard_normal((20, 10, 3))
    rotvec *= angle_rad / np.linalg.norm(rotvec, axis=-1, keepdims=True)
    rotation = rotation_from_rotvec(rotvec)
    found = rotvec_from_rotation(rotation)
    np.testing.assert_allclose(found, rotvec, rtol=1e-9, atol=2e-15)
    theirs = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec()
    np.testing.assert_allclose(found.reshape(-1, 3), theirs, atol=2e-15)


@pytest.mark.parametrize("axis", range(3))
def test_half_a_turn(axis: int) -> None:
    rotation = -np.eye(3)
    rotation[axis, axis] = 1.0
    np.testing.assert_allclose(rotvec_from_rotation(rotation), np.pi * np.eye(3)[axis])
