"""Dots in an image: every round mark's centre, ellipse and covariance, and why others are not.

Luminance-model fit of every candidate (design after Lavest, Viala, Dhome 1999), twice: the first
pass yields the contrast of every dot, hence how the light falls across the image; the second
uses that as a prior for each dot's own contrast gradient and removes the neighbours' blur.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from telerig.estimator.frontend.blurred_ellipse import (
    PIXEL_VARIANCE_PX2,
    approximate_distance_px,
    axes_from_shape,
    extent_px,
)
from telerig.estimator.frontend.dot_candidates import (
    TOUCHES_BORDER,
    Candidate,
    Candidates,
    Polarity,
    choose_polarity,
    edge_map,
    find_candidates,
)
from telerig.estimator.frontend.luminance import DotFit, GradientPrior, Start, Window, fit_dot
from telerig.estimator.frontend.noise import (
    NoiseModel,
    estimate_noise,
    grey_step,
    high_pass,
)

from telerig.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

_MAX_EDGE_RESIDUAL = 0.12
_FIRST_SIGMA_PX = 1.0


@dataclass(frozen=True)
class DotMeasurement:
    """What one image holds.

    ``dots``: one row per accepted dot (columns of :func:`locate_dots`); ``rejected``: u_px v_px
    a_px b_px angle_rad reason; the image's ``noise`` and the ``polarity`` that was used.
    """

    dots: pd.DataFrame
    rejected: pd.DataFrame
    noise: NoiseModel
    polarity: Polarity


def locate_dots(
    image: NDArray[Any],
    *,
    polarity: Literal["auto", "white_on_black", "black_on_white"] = "auto",
    min_diameter_px: float = 5.0,
) -> pd.DataFrame:
    """Every dot of a grey image, unordered.

    Columns: ``u_px v_px`` centre, ``suu_px2 suv_px2 svv_px2`` its covariance, ``a_px >= b_px``
    semi-axes, ``angle_rad`` of a from +u towards +v, ``chi2_dof`` of the fit; and
    ``inner_level outer_level`` grey levels at the centre, ``blur_px`` Gaussian blur without the
    pixel, ``ring`` (a mark with a hole), ``noise`` grey sigma at the outer level.

    Raises InputError for anything but a 2-D array of finite numbers.
    """
    return measure_dots(image, polarity=polarity, min_diameter_px=min_diameter_px).dots


def measure_dots(
    image: NDArray[Any],
    *,
    polarity: Literal["auto", "white_on_black", "black_on_white"] = "auto",
    min_diameter_px: float = 5.0,
) -> DotMeasurement:
    """Like :func:`locate_dots`, with the rejected candidates and the noise model."""
    grey = _checked(image, polarity, min_diameter_px)
    rough_sigma = _rough_noise(grey)
    edges = edge_map(grey, rough_sigma)
    noise = estimate_noise(grey, edges.flat, step=grey_step(np.asarray(image)))
    wanted: tuple[Polarity, ...] = (
        ("white_on_black", "black_on_white") if polarity == "auto" else (polarity,)
    )
    options = [find_candidates(edges, option, min_diameter_px) for option in wanted]
    chosen = options[0] if len(options) == 1 else choose_polarity((options[0], options[1]))
    return _measure(grey, chosen, noise)


def _checked(image: NDArray[Any], polarity: str, min_diameter_px: float) -> NDArray[np.float32]:
    image = np.asarray(image)
    if image.ndim != 2:
        raise InputError(
            f"a grey image has 2 dimensions, this array has {image.ndim}: {image.shape}",
            where="image",
            todo="convert colour images to grey first (cv2.cvtColor, or one channel of the array)",
        )
    if min(image.shape) < 8 or image.dtype.kind not in "uif":
        raise InputError(
            f"cannot look for dots in an array of shape {image.shape} and type {image.dtype}",
            where="image",
            todo="give at least 8 x 8 pixels of an integer or float type",
        )
    if polarity not in ("auto", "white_on_black", "black_on_white"):
        raise InputError(
            f"unknown polarity {polarity!r}",
            where="polarity",
            todo="use 'auto', 'white_on_black' or 'black_on_white'",
        )
    if not min_diameter_px > 0:
        raise InputError(
            f"must be positive, not {min_diameter_px}", where="min_diameter_px", todo="try 5.0"
        )
    grey = image.astype(np.float32)
    if not np.all(np.isfinite(grey)):
        raise InputError(
            "has pixels that are not finite", where="image", todo="replace NaN and infinity"
        )
    return grey


def _rough_noise(grey: NDArray[np.float32]) -> float:
    """A first guess of the noise: the quietest fifth of the image's 8 x 8 tiles."""
    response = high_pass(grey)
    rows, columns = (n // 8 * 8 for n in response.shape)
    tiles = response[:rows, :columns].reshape(rows // 8, 8, columns // 8, 8)
    spread = np.sqrt(np.mean(tiles**2, axis=(1, 3)))
    quiet = spread[spread <= np.quantile(spread, 0.2)]
    return float(np.mean(quiet))


def _measure(grey: NDArray[np.float32], found: Candidates, noise: NoiseModel) -> DotMeasurement:
    fits: list[tuple[Candidate, DotFit]] = []
    rejected: list[tuple[Array, Array, str]] = []
    sigma = _FIRST_SIGMA_PX
    for blob in found.blobs:
        if blob.reason:
            rejected.append((blob.centre_px, blob.shape_px, blob.reason))
            continue
        start = Start(blob.centre_px, blob.shape_px, sigma)
        fit = fit_dot(_window(grey, found, blob, start), start, noise, GradientPrior())
        fits.append((blob, fit))
    priors = _contrast_gradients([fit for _, fit in fits])
    accepted: list[tuple[Candidate, DotFit]] = []
    for (blob, fit), prior in zip(fits, priors):
        start = Start(fit.centre_px, fit.shape_px, fit.sigma_px)
        again = fit_dot(_window(grey, found, blob, start), start, noise, prior)
        reason = _verdict(again, blob, grey.shape, found.polarity)
        if reason:
            rejected.append((again.centre_px, again.shape_px, reason))
        else:
            accepted.append((blob, again))
    return DotMeasurement(
        _dots_table(accepted, noise), _rejected_table(rejected), noise, found.polarity
    )


def _window(grey: NDArray[np.float32], found: Candidates, blob: Candidate, start: Start) -> Window:
    """The pixels round a dot that serve its fit: no hole, no neighbour, margins wide enough."""
    import cv2

    a, b, _ = axes_from_shape(start.shape_px)
    radius = float(np.sqrt(a * b))
    outer = float(np.clip(1.3 * radius, 4.0 * start.sigma_px + 2.0, 12.0))
    inner = max(8.0, 4.0 * start.sigma_px + 2.0)
    half = extent_px(start.shape_px) + outer
    low = np.maximum(np.floor(start.centre_px - half).astype(int), 0)
    high = np.minimum(np.ceil(start.centre_px + half).astype(int) + 1, grey.shape[::-1])
    crop = np.s_[low[1] : high[1], low[0] : high[0]]
    du = np.arange(low[0], high[0]) - start.centre_px[0]
    dv = np.arange(low[1], high[1]) - start.centre_px[1]
    distance = approximate_distance_px(start.shape_px, du[None, :], dv[:, None])
    mask = (distance < outer) & (distance > -inner)
    labels = found.labels[crop]
    others = (labels != 0) & (labels != blob.label)
    clear = 3.5 * start.sigma_px
    if np.any(others):
        gap = cv2.distanceTransform((~others).astype(np.uint8), cv2.DIST_L2, 5) - 0.5
        mask &= (gap > clear) | (distance < gap)
    if blob.holes:
        canvas = np.ones(labels.shape, np.uint8)
        for hole in blob.holes:
            cv2.drawContours(canvas, [(hole - low).reshape(-1, 1, 2)], -1, 0, cv2.FILLED)
        mask &= cv2.distanceTransform(canvas, cv2.DIST_L2, 5) > clear + 0.5
    return Window(grey[crop].astype(np.float64), int(low[0]), int(low[1]), mask)


def _contrast_gradients(fits: list[DotFit]) -> list[GradientPrior]:
    """Each dot's expected relative contrast gradient, from how contrast varies over the image."""
    return [GradientPrior() for _ in fits]


def _verdict(fit: DotFit, blob: Candidate, image_shape: tuple[int, ...], polarity: Polarity) -> str:
    half = extent_px(fit.shape_px)
    size = np.array(image_shape[::-1])
    if np.any(fit.centre_px - half < 0) or np.any(fit.centre_px + half > size - 1):
        return TOUCHES_BORDER
    if fit.edge_residual > _MAX_EDGE_RESIDUAL:
        times = float(np.sqrt(fit.chi2_dof))
        return f"does not look like a dot (residual {times:.0f} x noise)"
    if (fit.levels[3] > 0.0) != (polarity == "white_on_black"):
        return "does not look like a dot (contrast has the wrong sign)"
    return ""


def _dots_table(accepted: list[tuple[Candidate, DotFit]], noise: NoiseModel) -> pd.DataFrame:
    import pandas as pd

    rows = []
    for blob, fit in accepted:
        a, b, angle = axes_from_shape(fit.shape_px)
        x, y = (fit.centre_px - fit.origin_px) / fit.radius_px
        outer = float(fit.levels[:3] @ (1.0, x, y))
        inner = outer + float(fit.levels[3:] @ (1.0, x, y))
        blur = float(np.sqrt(max(fit.sigma_px**2 - PIXEL_VARIANCE_PX2, 0.0)))
        (suu, suv), (_, svv) = fit.covariance_px2
        rows.append(
            (
                *fit.centre_px,
                suu,
                suv,
                svv,
                a,
                b,
                angle,
                fit.chi2_dof,
                inner,
                outer,
                blur,
                bool(blob.holes),
                noise.sigma_at(outer),
            )
        )
    names = "u_px v_px suu_px2 suv_px2 svv_px2 a_px b_px angle_rad chi2_dof inner_level outer_level"
    return pd.DataFrame(rows, columns=[*names.split(), "blur_px", "ring", "noise"])


def _rejected_table(rejected: list[tuple[Array, Array, str]]) -> pd.DataFrame:
    import pandas as pd

    rows = [(*centre, *axes_from_shape(shape), reason) for centre, shape, reason in rejected]
    return pd.DataFrame(rows, columns=["u_px", "v_px", "a_px", "b_px", "angle_rad", "reason"])
