"""Where the fits of outlines begin, and what they return."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.bubbles.outline.ellipse_geometry import Index
from telerig.estimator.bubbles.outline.rim_model import RimState

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PIXEL_VARIANCE_PX2 = 1.0 / 12.0


@dataclass(frozen=True)
class Start:
    """Where the fits begin: ``ellipse`` (B, 5), ``harmonics`` (B, 8), ``blur_px`` and ``inner``
    level (B,), noise ``sigma_outer`` and ``sigma_inner`` (B,) as shares of the background."""

    ellipse: Array
    harmonics: Array
    blur_px: Array
    inner: Array
    sigma_outer: Array
    sigma_inner: Array

    def __len__(self) -> int:
        return int(self.ellipse.shape[0])

    def __getitem__(self, index: Index) -> Start:
        return Start(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass(frozen=True)
class Outlines:
    """Fitted outlines of B bubbles.

    ``ellipse`` (B, 5), ``harmonics`` (B, 8; 0 where ``resolved`` is False), ``sigma_px`` blur of
    optics and pixel, ``outer`` and ``inner`` levels, ``centre_covariance_px2`` (B, 2, 2),
    ``sigma_outline_px`` of a harmonic's coefficient, ``chi2_dof``, ``coverage`` (share of the
    outline that was seen), ``misfit_px`` (how far the rim strays from the outline, beyond noise),
    ``shift_px`` (largest displacement since the linearisation) and
    ``step_px`` (the last one).
    """

    ellipse: Array
    harmonics: Array
    resolved: Mask
    sigma_px: Array
    outer: Array
    inner: Array
    centre_covariance_px2: Array
    sigma_outline_px: Array
    chi2_dof: Array
    coverage: Array
    misfit_px: Array
    shift_px: Array
    step_px: Array

    @property
    def blur_px(self) -> Array:
        """Blur (B,) of the optics alone."""
        blur: Array = np.sqrt(np.maximum(self.sigma_px**2 - PIXEL_VARIANCE_PX2, 0.0))
        return blur

    def state(self, index: Index) -> RimState:
        """The outlines ``index`` as a point to go on from."""
        every = (self.ellipse, self.harmonics, self.sigma_px, self.outer, self.inner)
        return RimState(*(values[index] for values in every))

    def updated(self, index: Index, other: Outlines) -> Outlines:
        """These outlines with those at ``index`` replaced by ``other``."""
        changed = {}
        for field in fields(self):
            changed[field.name] = getattr(self, field.name).copy()
            changed[field.name][index] = getattr(other, field.name)
        return Outlines(**changed)
