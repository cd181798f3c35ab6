"""Eccentricity: the centre of a dot's image is not the image of the dot's centre.

Both agree only for an affine camera. With perspective or distortion the projected disc is centred
elsewhere. The shift is computed by projecting many small pieces of the disc and averaging over
their area.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from telerig.arrays import Array
from telerig.estimator.calibration.solver.problem import Problem
from telerig.factors.projection import State, pixels


def eccentricity_px(problem: Problem, state: State, rings: int = 2, spokes: int = 8) -> Array:
    """Return the centre of area of each projected disc minus the projection of its centre (M, 2),
    in px.

    The result has one row for each of the M measured dots. The disc is sampled at ``rings`` radii
    (Gauss-Legendre points in r^2) and ``spokes`` equal angles. Each sample is weighted by the area
    that it covers in the image.
    """
    obs = problem.unweighted()
    radius = problem.target.diameter_mm(problem.dot_ids) / 2
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    centre = pixels(state, obs, problem.rho_mm)
    top, area = np.zeros_like(centre), np.zeros(len(centre))
    step = 1e-3 * float(radius.min())
    for node, weight in zip((nodes + 1) / 2, weights / 2):
        for angle in 2 * np.pi * np.arange(spokes) / spokes:
            reach = np.sqrt(node) * np.array([np.cos(angle), np.sin(angle), 0.0])
            moved = [
                pixels(_shifted(state, radius[:, None] * reach + extra), obs, problem.rho_mm)
                for extra in (np.zeros(3), [step, 0, 0], [0, step, 0])
            ]
            along = np.stack([moved[1] - moved[0], moved[2] - moved[0]], -1)
            piece = weight * np.abs(np.linalg.det(along)) / step**2
            top += piece[:, None] * (moved[0] - centre)
            area += piece
    return np.asarray(top / area[:, None])


def _shifted(state: State, shift_mm: Array) -> State:
    return replace(state, dots_mm=state.dots_mm + shift_mm)
