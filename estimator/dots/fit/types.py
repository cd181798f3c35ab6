"""Inputs and results of the fit of a dot, and the reasons why a blob is no dot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PARAMETERS = 10
"""Free parameters of a fit; the two of the contrast gradient are held by their prior."""


class Reason(StrEnum):
    """Why a blob is no dot, in words for the person who looks at the overlay."""

    TOUCHES_BORDER = "touches the image border"
    TOO_LARGE = "larger than the dots"
    TOO_SMALL = "smaller than the smallest dot asked for"
    MUCH_SMALLER = "much smaller than the other dots"
    MERGED = "merged with its neighbour"
    NOT_ELLIPSE = "outline is not an ellipse"
    GLARE = "saturated by glare"
    HIDDEN = "shows too few pixels of its own"
    FAINT = "much fainter than the other dots"
    WRONG_SIGN = "does not look like a dot (contrast has the wrong sign)"
    FIT_FAILED = "does not look like a dot (fit failed)"
    MISFIT = "does not look like a dot (residuals far above the noise)"


@dataclass(frozen=True)
class Prior:
    """Prior knowledge about one dot, from the image's other dots.

    u_per_px, v_per_px : relative contrast gradient (dC/du)/C, (dC/dv)/C, with standard deviation
    ``sigma_per_px``. tie_to_background : take the background's own relative gradient instead, as
    the same light falls on both. edge_px : sigma of the blurred edge, with standard deviation
    ``edge_spread_px`` (infinite where it is unknown).
    """

    u_per_px: float = 0.0
    v_per_px: float = 0.0
    sigma_per_px: float = 3e-4
    tie_to_background: bool = False
    edge_px: float = 1.0
    edge_spread_px: float = np.inf


@dataclass(frozen=True)
class Window:
    """Pixels of a fit: grey levels (V, U) of a crop, its first pixel, and a mask (V, U) of those
    that are used."""

    grey: Array
    first_u: int
    first_v: int
    mask: Mask


@dataclass(frozen=True)
class Start:
    """Start values of a fit: centre (2,) and shape (3,) in image px, edge sigma [px].

    previous : an earlier fit of the same dot, whose grey levels are then start values too.
    """

    centre_px: Array
    shape_px: Array
    sigma_px: float
    previous: DotFit | None = None


@dataclass(frozen=True)
class DotFit:
    """One fitted dot.

    centre_px (2,), shape_px (3,) (see ``blurred_ellipse``), sigma_px of the edge.
    levels : (6,) B0, B1, B2, C, C1, C2 about the window's middle origin_px (2,) in units of
        radius_px.
    covariance_px2 : (2, 2) of the centre. contrast_sigma : of C.
    dropped : number of pixels left out as outliers.
    edge_residual : RMS residual in the band of the edge over C.
    inner_chi2 : mean whitened square residual of the inner_pixels that the dot covers.
    """

    centre_px: Array
    shape_px: Array
    sigma_px: float
    levels: Array
    origin_px: Array
    radius_px: float
    covariance_px2: Array
    contrast_sigma: float
    chi2_dof: float
    pixels: int
    dropped: int
    edge_residual: float
    inner_chi2: float
    inner_pixels: int
    converged: bool

    @property
    def dof(self) -> int:
        return max(self.pixels - self.dropped - PARAMETERS, 1)

    @property
    def inflated_covariance_px2(self) -> Array:
        """The centre's covariance (2, 2), times chi2_dof where that is significantly above 1."""
        significant = self.chi2_dof > 1.0 + 3.0 * np.sqrt(2.0 / self.dof)
        return self.covariance_px2 * (self.chi2_dof if significant else 1.0)

    def under_noise(self, factor: float) -> DotFit:
        """The same fit for a noise variance ``factor`` times as large."""
        return replace(
            self,
            covariance_px2=self.covariance_px2 * factor,
            contrast_sigma=self.contrast_sigma * np.sqrt(factor),
            chi2_dof=self.chi2_dof / factor,
        )

    @property
    def contrast(self) -> float:
        """Contrast [grey] at the dot's centre (negative for a dark dot)."""
        return float(self.levels[3:] @ self._position)

    @property
    def background(self) -> float:
        """Background [grey] extrapolated to the dot's centre."""
        return float(self.levels[:3] @ self._position)

    @property
    def _position(self) -> Array:
        x, y = (self.centre_px - self.origin_px) / self.radius_px
        return np.array([1.0, x, y])
