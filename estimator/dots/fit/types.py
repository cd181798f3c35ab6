"""What goes into the fit of a dot and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PARAMETERS = 10  # free ones: the contrast gradient's two are held by their prior


@dataclass(frozen=True)
class Prior:
    """What the image's other dots tell about one dot.

    Relative contrast gradient (dC/du)/C, (dC/dv)/C [1/px] and its sigma; with
    ``tie_to_background`` instead the background's own relative gradient (light falls on both) up
    to ``sigma_per_px``. The edge's sigma ``edge_px`` up to ``edge_spread_px`` (infinite: unknown).
    """

    u_per_px: float = 0.0
    v_per_px: float = 0.0
    sigma_per_px: float = 3e-4
    tie_to_background: bool = False
    edge_px: float = 1.0
    edge_spread_px: float = np.inf


@dataclass(frozen=True)
class Window:
    """Pixels that a fit looks at: grey levels (V, U) of a crop, its first pixel, a mask (V, U)."""

    grey: Array
    first_u: int
    first_v: int
    mask: Mask


@dataclass(frozen=True)
class Start:
    """Where a fit begins: centre (2,) and shape (3,) in image px, edge sigma [px].

    ``previous`` is an earlier fit of the same dot: its levels are then the start too.
    """

    centre_px: Array
    shape_px: Array
    sigma_px: float
    previous: DotFit | None = None


@dataclass(frozen=True)
class DotFit:
    """One fitted dot.

    ``centre_px`` (2,), ``shape_px`` (3,) (see ``blurred_ellipse``), ``sigma_px`` of the edge,
    ``levels`` (6,): B0, B1, B2, C, C1, C2 about the window's middle ``origin_px`` (2,) in units of
    ``radius_px``; ``covariance_px2`` (2, 2) of the centre, ``contrast_sigma`` of C; ``dropped``
    pixels were outliers; ``edge_residual`` is the residual's RMS over C in the edge's band,
    ``inner_chi2`` the mean whitened square of the ``inner_pixels`` that the dot covers.
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
        """The same fit judged by a noise variance ``factor`` times as large."""
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
        """Background [grey] carried on under the dot's centre."""
        return float(self.levels[:3] @ self._position)

    @property
    def _position(self) -> Array:
        x, y = (self.centre_px - self.origin_px) / self.radius_px
        return np.array([1.0, x, y])
