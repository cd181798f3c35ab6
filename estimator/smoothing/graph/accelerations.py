"""What a smoothing says of the bubbles' motion beyond the states themselves.

Velocity and acceleration are states where the bubbles' forces pass a low-pass (`Inertia`). Here are
the frequency up to which an acceleration is followed, and the part of the pixels' noise that
belongs to positions alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.smoothing.graph.layout import GraphLayout, State, points_in_rig
from telerig.estimator.smoothing.graph.linear import white_noise
from telerig.factors.bubble_motion import Inertia, inertial_bubble_path
from telerig.factors.state_space import Component
from telerig.rig.triangulation import stacked_jacobian

_LEAST_INFORMATION = 1e-6
"""Of a place's least known direction over that of its best, for all to count as seen."""
_LOWEST_HZ, _FREQUENCIES, _ABOVE = 1e-2, 6000, 1e3
"""Of the spectra: the lowest frequency, their number, and the highest one over the low-pass's."""


@dataclass(frozen=True)
class Accelerations:
    """Hold the bubbles' accelerations in the laboratory frame (rig axes).

    inertia : the low-pass of the forces.
    value_mm_s2 : (rows, 3), rows as in the graph.
    covariance : (rows, 3, 3) in mm^2/s^4.
    bandwidth_hz : (3,) along each axis the frequency up to which accelerations are followed by at
        least half; 0 where the images say no more than the prior.
    """

    inertia: Inertia
    value_mm_s2: Array
    covariance: Array
    bandwidth_hz: Array

    @property
    def sd_mm_s2(self) -> Array:
        """(rows, 3) standard deviations."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)))


def accelerations_of(graph: GraphLayout, state: State, covariance: Array) -> Accelerations | None:
    """Return the accelerations; None for bubbles without a low-pass, and without bubbles.

    covariance : (rows, D, D) of the bubbles' states.
    """
    bubble, rows = graph.model.bubble, graph.bubble.acceleration
    if bubble.inertia is None or not graph.rows:
        return None
    found = rows @ covariance @ rows.T
    variance = np.diagonal(found, axis1=1, axis2=2).mean(0)
    band = [
        _bandwidth_hz(
            inertial_bubble_path(bubble, axis, bubble.inertia),
            float(one), _ABOVE / (2 * np.pi * time_s),
        )
        for axis, one, time_s in zip(np.eye(3), variance, bubble.inertia.time_s, strict=True)
    ]  # fmt: skip
    return Accelerations(bubble.inertia, state.bubbles @ rows.T, found, np.array(band))


def add_slow_noise(graph: GraphLayout, state: State, bubbles: Array) -> None:
    """Add to covariances of bubbles (rows, D, D) the part of the pixels' stated noise that is not
    white, such as what a bubble's unknown shape adds to its centre.

    It changes slowly, so that a position has all of it. Frames in which a bubble is not fully seen
    have the mean of its others.
    """
    inertia, seen = graph.model.bubble.inertia, graph.problem.observations
    if inertia is None or min(inertia.noise) >= 1 or not graph.rows:
        return
    stated = graph.model.pixel_inflation**2 * seen.covariance_px2
    white, within = white_noise(graph), white_noise(graph, 1.0)
    row, places = graph.row(seen.item, seen.frame), points_in_rig(graph, state)
    information, noise = np.zeros((2, graph.rows, 3, 3))
    for index, camera in enumerate(graph.problem.cameras):
        mine = np.flatnonzero(seen.camera == index)
        by_place = stacked_jacobian((camera,), places[row[mine]])[1]
        slow = stated[mine] - within[index] @ stated[mine] @ within[index]
        gain = np.linalg.solve(white[index] @ stated[mine] @ white[index], by_place)
        np.add.at(information, row[mine], by_place.mT @ gain)
        np.add.at(noise, row[mine], gain.mT @ slow @ gain)
    whole = are_seen(information)
    added = np.zeros((graph.rows, 3, 3))
    inverse = np.linalg.inv(information[whole])
    added[whole] = inverse @ noise[whole] @ inverse
    count = np.add.reduceat(whole, graph.first_row[:-1], dtype=np.int64)
    mean = np.add.reduceat(added, graph.first_row[:-1]) / np.maximum(count, 1)[:, None, None]
    added[~whole] = mean[graph.bubble_of_row[~whole]]
    at = graph.bubble.path_position
    bubbles[:, at[:, None], at] += added


def are_seen(information: Array) -> Bools:
    """Return whether information (n, 3, 3) is of all directions of a place."""
    size = np.linalg.eigvalsh(information)
    return np.asarray(size[:, 0] > _LEAST_INFORMATION * size[:, -1])


def _bandwidth_hz(process: Component, variance: float, highest_hz: float) -> float:
    """Return the frequency at which a smoother passes half of a process's acceleration.

    variance : of the acceleration after smoothing. White noise of the positions that leaves so much
    is compared with the process's spectrum.
    """
    from scipy.optimize import brentq

    frequency = np.geomspace(_LOWEST_HZ, highest_hz, _FREQUENCIES)
    omega = 2 * np.pi * frequency
    density = process.density(frequency)

    def left(log_noise: float) -> float:
        after = density / (1 + density / np.exp(log_noise))
        return float(np.trapezoid(omega**4 * after, frequency)) / variance - 1

    low, high = np.log(density.min() * 1e-3), np.log(density.max() * 1e3)
    if left(high) <= 0:
        return 0.0
    if left(low) >= 0:
        return float(frequency[-1])
    followed = np.flatnonzero(density > np.exp(brentq(left, low, high, xtol=1e-3)))
    return float(frequency[followed[-1]]) if len(followed) else 0.0
