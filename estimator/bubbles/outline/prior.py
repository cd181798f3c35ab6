"""Prior knowledge of a bubble's outline and grey levels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.bubbles.outline.ellipse_geometry import ELLIPSE_PARAMETERS, Index
from telerig.estimator.bubbles.outline.rim_model import (
    FIRST_HARMONIC,
    INNER,
    OUTER,
    RimState,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEVEL_SPREAD = 0.3
_FREE_HARMONIC, _FREE_FLATTENING = 0.25, 1e3
_UNLEARNT_HARMONIC, _LEAST_HARMONIC, _LEAST_FLATTENING = 0.02, 0.002, 0.01
_UNLEARNT_FLATTENING = 0.08
_WIDENED = 1.5
_ENOUGH_WHOLE = 4
_HELD = 1e-7


@dataclass(frozen=True)
class ShapePrior:
    """Spread of the harmonics' coefficients ``harmonic_share`` (B,) as a share of the radius;
    mean ``flattening`` (B, 2) and its spread (B,): (a - b) / (a + b) times the cosine and sine
    of twice the angle."""

    harmonic_share: Array
    flattening: Array
    flattening_spread: Array

    def __getitem__(self, index: Index) -> ShapePrior:
        return ShapePrior(
            self.harmonic_share[index], self.flattening[index], self.flattening_spread[index]
        )

    def held_where(self, held: Mask) -> ShapePrior:
        """The same prior with the harmonics of the bubbles ``held`` (B,) tied to zero."""
        return replace(self, harmonic_share=np.where(held, _HELD, self.harmonic_share))


def weak_prior(count: int, *, held: bool = False) -> ShapePrior:
    """A prior too weak to affect whole outlines; ``held`` fixes the harmonics at their start."""
    return ShapePrior(
        np.full(count, _HELD if held else _FREE_HARMONIC),
        np.zeros((count, 2)),
        np.full(count, _FREE_FLATTENING),
    )


def learnt_prior(ellipse: Array, harmonics: Array, whole: Mask, partial: Mask) -> ShapePrior:
    """For outlines that are ``partial`` (B,) the shapes of the ``whole`` ones, for others none.

    With too few whole ones, partial outlines are taken to be round to 8 %.
    """
    count = len(ellipse)
    prior = weak_prior(count)
    share = _UNLEARNT_HARMONIC
    if np.count_nonzero(whole) >= _ENOUGH_WHOLE:
        radius = np.sqrt(ellipse[whole, 2] * ellipse[whole, 3])
        typical = np.median(np.mean((harmonics[whole] / radius[:, None]) ** 2, axis=1))
        share = max(_WIDENED * float(np.sqrt(typical)), _LEAST_HARMONIC)
        own = flattening(ellipse[whole])
        middle = np.median(own, axis=0)
        scatter = 1.4826 * float(np.median(np.abs(own - middle)))
        prior.flattening[partial] = middle
        prior.flattening_spread[partial] = max(_WIDENED * scatter, _LEAST_FLATTENING)
    else:
        prior.flattening_spread[partial] = _UNLEARNT_FLATTENING
    prior.harmonic_share[partial] = share
    return prior


def flattening(ellipse: Array) -> Array:
    """(B, 2): (a - b) / (a + b) times cosine and sine of twice the angle."""
    ratio = (ellipse[:, 2] - ellipse[:, 3]) / (ellipse[:, 2] + ellipse[:, 3])
    angle = 2.0 * ellipse[:, 4]
    return np.stack([ratio * np.cos(angle), ratio * np.sin(angle)], axis=1)


def prior_equations(
    information: Array,
    pull: Array,
    state: RimState,
    shifts: Array,
    inner: Array,
    prior: ShapePrior,
) -> None:
    """Add the prior at outlines ``shifts`` (B, 13) away from the state's ellipses."""
    level = 1.0 / _LEVEL_SPREAD**2
    information[:, OUTER, OUTER] += level
    information[:, INNER, INNER] += level
    pull[:, OUTER] -= level * (state.outer - 1.0)
    pull[:, INNER] -= level * (state.inner - inner)
    ellipse = state.ellipse
    radius = np.sqrt(ellipse[:, 2] * ellipse[:, 3])
    weight = 1.0 / (prior.harmonic_share * radius) ** 2
    places = np.arange(FIRST_HARMONIC, information.shape[1])
    information[:, places, places] += weight[:, None]
    held = (prior.harmonic_share <= _HELD)[:, None]
    gap = np.where(held, 0.0, shifts[:, ELLIPSE_PARAMETERS:])
    pull[:, FIRST_HARMONIC:] -= weight[:, None] * gap
    _add_flattening(information, pull, ellipse, shifts, radius, prior)


def _add_flattening(
    information: Array,
    pull: Array,
    ellipse: Array,
    shifts: Array,
    radius: Array,
    prior: ShapePrior,
) -> None:
    weight = 1.0 / (prior.flattening_spread * radius) ** 2
    cos, sin = np.cos(2.0 * ellipse[:, 4]), np.sin(2.0 * ellipse[:, 4])
    along = prior.flattening[:, 0] * cos + prior.flattening[:, 1] * sin
    across = prior.flattening[:, 1] * cos - prior.flattening[:, 0] * sin
    half_gap = (ellipse[:, 2] + shifts[:, 2] - ellipse[:, 3] - shifts[:, 3]) / 2.0
    information[:, 2, 2] += weight / 4.0
    information[:, 3, 3] += weight / 4.0
    information[:, 2, 3] -= weight / 4.0
    information[:, 3, 2] -= weight / 4.0
    information[:, 4, 4] += weight
    miss = weight * (half_gap - radius * along) / 2.0
    pull[:, 2] -= miss
    pull[:, 3] += miss
    pull[:, 4] -= weight * (shifts[:, 4] - radius * across)
