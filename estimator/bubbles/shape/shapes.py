"""What a run tells of the shapes of its bubbles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array
from telerig.estimator.bubbles.shape.sightings import FOURTH, THIRD, Sightings
from telerig.rig import silhouette


@dataclass(frozen=True)
class Shapes:
    """What a run tells of the shapes of its bubbles.

    third, fourth : standard deviations of a body's coefficients of degree 3 and 4 (harmonics of
        unit mean square over the sphere, relative to the radius).
    triaxial : of both numbers t.
    excess : of the coefficients of cos 2 phi and sin 2 phi beyond the stated noise, relative to the
        radius.
    bodies : number of bodies that were used.
    """

    third: float = 0.005
    fourth: float = 0.004
    triaxial: float = 0.01
    excess: float = 1.5e-4
    bodies: int = 0


DEFAULT_SHAPES = Shapes()


def degree_variance(sightings: Sightings, degree: int, less: float = 1.0) -> Array:
    """Return an estimate (...) of a degree's sigma^2 from each outline alone.

    less : how often the variance of the noise is subtracted; unbiased for 1.
    """
    part = THIRD if degree == 3 else FOURTH
    noise = np.einsum("...ii->...", sightings.trace_covariance[..., part, part])
    power = (sightings.trace[..., part] ** 2).sum(-1) - less * noise
    return np.asarray(power / (2 * silhouette.TRACE_VARIANCE[degree, degree]))
