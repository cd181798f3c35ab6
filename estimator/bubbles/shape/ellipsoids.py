"""The ellipsoids that two outlines allow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.rig import silhouette
from telerig.rig.silhouette import EllipsePair

Array = NDArray[np.float64]

_LEAST_COUPLING = 0.01
_LARGEST_COUPLING = 0.9


@dataclass(frozen=True)
class BodyShapes:
    """What M pairs of outlines allow.

    pair : their ellipses in mm.  moments_mm2 : (M, 3, 3) A A^T of the most spherical ellipsoid,
    coupling : (M,) its coupling (`EllipsePair`), coupling_sigma : (M,) how far that may be off.
    oblate_mm2 : (M, 3, 3) A A^T of the nearest oblate spheroid, poles : two (M, 2), where its pole
    appears in the outlines' unit circles.
    """

    pair: EllipsePair
    moments_mm2: Array
    coupling: Array
    coupling_sigma: Array
    oblate_mm2: Array
    poles: tuple[Array, Array]

    def couplings(self) -> Iterator[tuple[Array, float]]:
        """(M,) possible couplings and their probabilities.

        Half goes to the most spherical ellipsoid, half to the oblate spheroid.
        """
        yield self.coupling, 0.5
        yield _possible(self.pair.coupling_of(self.oblate_mm2)), 0.5


def body_shapes(jacobians: tuple[Array, Array], axes_px: tuple[Array, Array]) -> BodyShapes:
    """jacobians : two (M, 2, 3), px per mm.  axes_px : two (M, 2, 2), columns are semi-axes."""
    pair = silhouette.ellipse_pair(jacobians, axes_px)
    moments = silhouette.most_spherical(pair)
    pole, oblate = silhouette.oblate_spheroid(pair)
    first, second = (
        np.asarray(np.linalg.solve(a, j @ pole[..., None])[..., 0])
        for a, j in zip(axes_px, jacobians)
    )
    spread = _coupling_sigma(moments)
    coupling = _possible(pair.coupling_of(moments))
    return BodyShapes(pair, moments, coupling, spread, oblate, (first, second))


def _coupling_sigma(moments_mm2: Array) -> Array:
    """(M,) the coupling is as large as the four like numbers of the anisotropy that are seen."""
    logs = np.log(np.linalg.eigvalsh(moments_mm2))
    seen = ((logs - logs.mean(-1, keepdims=True)) ** 2).sum(-1)
    return np.asarray(np.sqrt(seen / 8 + _LEAST_COUPLING**2))


def _possible(coupling: Array) -> Array:
    return np.clip(coupling, -_LARGEST_COUPLING, _LARGEST_COUPLING)
