"""Which axes a sensor is said to have, where images show them little or not at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from telerig.estimator.sensors.alignment import LEAST_LOG_RATIO
from telerig.estimator.sensors.gravity import Gravity
from telerig.estimator.sensors.mounting import LEAST_BESIDE, Expected, Mounting, mounting

Array = NDArray[np.float64]
UP = np.array([0.0, -1.0, 0.0])
SWAPPED = np.eye(3)[[2, 1, 0]]
AT_REST = Gravity(9806.65 * UP)
BAND = butter(2, (5, 40), "bandpass", fs=500, output="sos")


def moved(rng: np.random.Generator, size: float = 1.0) -> Array:
    """A vibration of 5 to 40 Hz in 3 s, along x, y and z."""
    return np.asarray(sosfiltfilt(BAND, rng.normal(0, size, (1500, 3)), axis=0))


def judged(read: Array, images: Array, other: Array | None) -> Mounting:
    """Axes that are stated as those of the rig; images along x, another arm along all axes."""
    known = np.ones(len(read), bool)
    expected = [Expected(np.eye(3)[0], images[:, 0], known)]
    if other is not None:
        expected += [Expected(d, other @ d, known, whole=False) for d in np.eye(3)]
    return mounting(np.eye(3), AT_REST, UP, read, known, expected)


def test_axes_that_images_hardly_show_are_clear_where_another_arm_agrees() -> None:
    rng = np.random.default_rng(5)
    common, own = moved(rng), moved(rng)
    other = common + moved(rng)
    weak = common + own + moved(rng, 6.0)  # the bubble's own motion
    read = (common + own) @ SWAPPED
    alone, both = judged(read, weak, None), judged(read, weak, other)
    np.testing.assert_array_equal(alone.axes, SWAPPED)
    assert LEAST_BESIDE < alone.lead < LEAST_LOG_RATIO
    assert not alone.clear
    assert both.clear
    np.testing.assert_array_equal(both.axes, SWAPPED)


def test_another_arm_alone_says_nothing_against_axes_that_the_images_prefer() -> None:
    """Beyond its resonance an arm moves against the others."""
    rng = np.random.default_rng(5)
    common = moved(rng)
    found = judged(common, common + moved(rng), -common)
    np.testing.assert_array_equal(found.axes, np.eye(3))
    assert not found.clear
