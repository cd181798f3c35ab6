"""Dots in an image: every round mark's centre, ellipse and covariance, and why others are not.

Luminance-model fit of every candidate (design after Lavest, Viala, Dhome 1999), twice: the first
pass yields the contrast of every dot, hence how the light falls across the image; the second
uses that as a prior for each dot's own contrast gradient and removes the neighbours' blur.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.estimator.dots.fit.blurred_ellipse import PIXEL_VARIANCE_PX2, axes_from_shape
from telerig.estimator.dots.fit.candidates import (
    Candidate,
    Candidates,
    Polarity,
    choose_polarity,
    edge_map,
    find_candidates,
)
from telerig.estimator.dots.fit.illumination import contrast_gradients, with_common_blur
from telerig.estimator.dots.fit.luminance_fit import fit_dots
from telerig.estimator.dots.fit.pixel_windows import (
    close_neighbours,
    dot_window,
    without_neighbours,
)
from telerig.estimator.dots.fit.rejection import (
    is_ring,
    reason_against_blob,
    reason_against_fit,
    reference_radius_px,
    saturation_level,
)
from telerig.estimator.dots.fit.types import DotFit, Prior, Start, Window
from telerig.estimator.images.noise import (
    NoiseModel,
    agreed_factor,
    estimate_noise,
    grey_step,
    high_pass,
    rough_sigma,
    with_inner_level,
)
from telerig.io.machine.memory import keep_freed_memory

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

_FIRST_SIGMA_PX = 1.0
_PILOTS = 5
_FEWEST_PIXELS = 25
"""A first fit that ran out of the image leaves no window for a second one."""
_ROUNDS = 10
_SETTLED_SD = 0.1


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
    max_diameter_px: float = np.inf,
) -> DotMeasurement:
    """Like :func:`locate_dots`, with the rejected candidates and the noise model.

    max_diameter_px : larger blobs are no dots, and tell nothing of the dots' size.
    """
    grey = _checked(image, polarity, min_diameter_px)
    keep_freed_memory()
    response = high_pass(grey)
    edges = edge_map(grey, rough_sigma(response))
    noise = estimate_noise(grey, response, edges.flat, step=grey_step(np.asarray(image)))
    wanted: tuple[Polarity, ...] = (
        ("white_on_black", "black_on_white") if polarity == "auto" else (polarity,)
    )
    options = [
        find_candidates(edges, option, min_diameter_px).up_to(max_diameter_px) for option in wanted
    ]
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


@dataclass(frozen=True)
class _Rejection:
    centre_px: Array
    shape_px: Array
    reason: str


def _measure(grey: NDArray[np.float32], found: Candidates, noise: NoiseModel) -> DotMeasurement:
    saturation = saturation_level(grey)
    reference_px = reference_radius_px(found)
    rejected: list[_Rejection] = []
    blobs: list[Candidate] = []
    for blob in found.blobs:
        reason = reason_against_blob(blob, grey, reference_px, saturation)
        if reason:
            rejected.append(_Rejection(blob.centre_px, blob.shape_px, reason))
        else:
            blobs.append(blob)
    fits = _first_pass(grey, found, blobs, noise)
    noise = _noise_with_inner_level(noise, fits)
    fits = _second_pass(grey, found, blobs, fits, noise)
    factor = agreed_factor(
        noise, np.array([fit.chi2_dof for fit in fits]), np.array([fit.dof for fit in fits])
    )
    fits, noise = [fit.under_noise(factor) for fit in fits], noise.scaled(factor)
    usual_contrast = float(np.median([abs(fit.contrast) for fit in fits])) if fits else 0.0
    accepted: list[tuple[Candidate, DotFit]] = []
    for blob, fit in zip(blobs, fits):
        reason = reason_against_fit(fit, grey, found.polarity, usual_contrast, saturation)
        if reason:
            rejected.append(_Rejection(fit.centre_px, fit.shape_px, reason))
        else:
            accepted.append((blob, fit))
    return DotMeasurement(
        _dots_table(accepted, noise), _rejected_table(rejected), noise, found.polarity
    )


def _first_pass(
    grey: NDArray[np.float32], found: Candidates, blobs: list[Candidate], noise: NoiseModel
) -> list[DotFit]:
    """Every dot by itself; the first ones tell the blur at which the others start."""
    pilots = _look(grey, found, blobs[:_PILOTS], noise, _FIRST_SIGMA_PX)
    if len(blobs) <= _PILOTS:
        return pilots
    sigma = float(np.median([fit.sigma_px for fit in pilots]))
    return pilots + _look(grey, found, blobs[_PILOTS:], noise, sigma)


def _look(
    grey: NDArray[np.float32],
    found: Candidates,
    blobs: Sequence[Candidate],
    noise: NoiseModel,
    sigma: float,
) -> list[DotFit]:
    starts = [Start(blob.centre_px, blob.shape_px, sigma) for blob in blobs]
    windows = [
        dot_window(grey, found.labels, blob, start, coarse=True)
        for blob, start in zip(blobs, starts)
    ]
    priors = [Prior()] * len(blobs)
    return fit_dots(windows, starts, noise, priors, tolerance=0.3, outlier_rounds=1)


def _noise_with_inner_level(noise: NoiseModel, fits: list[DotFit]) -> NoiseModel:
    seen = [fit for fit in fits if fit.inner_pixels > 0]
    if not seen:
        return noise
    inner = float(np.median([fit.background + fit.contrast for fit in seen]))
    outer = float(np.median([fit.background for fit in seen]))
    ratio = float(np.median([fit.inner_chi2 for fit in seen]))
    pixels = sum(fit.inner_pixels for fit in seen)
    return with_inner_level(noise, inner, outer, ratio, pixels)


def _second_pass(
    grey: NDArray[np.float32],
    found: Candidates,
    blobs: list[Candidate],
    fits: list[DotFit],
    noise: NoiseModel,
) -> list[DotFit]:
    """Every dot again, knowing the light and its neighbours.

    Dots that share pixels are fitted in turn, each beside the last fits of the others, until none
    moves (Gauss-Seidel: the limit is the fit of all together).
    """
    priors = with_common_blur(contrast_gradients(fits, grey.shape), fits)
    neighbours = close_neighbours(fits)
    fits = list(fits)
    again: Sequence[int] = range(len(fits))
    for _ in range(_ROUNDS):
        moved: list[int] = []
        for some in _apart(again, neighbours):
            windows = [_alone(grey, found, blobs, fits, i, neighbours[i]) for i in some]
            moved += _refit(fits, some, windows, noise, priors, neighbours)
        again = sorted({k for i in moved for k in (i, *neighbours[i])})
        if not again:
            break
    return fits


def _apart(dots: Sequence[int], neighbours: list[list[int]]) -> Iterator[list[int]]:
    """Groups of dots that share no pixels, so that those of one may be fitted together."""
    left = list(dots)
    while left:
        group: list[int] = []
        near: set[int] = set()
        for i in left:
            if i not in near:
                group.append(i)
                near.update(neighbours[i])
        yield group
        left = sorted(set(left) - set(group))


def _alone(
    grey: NDArray[np.float32],
    found: Candidates,
    blobs: list[Candidate],
    fits: list[DotFit],
    dot: int,
    near: list[int],
) -> Window:
    """A dot's pixels without its neighbours' light."""
    sure = [blobs[k].label for k in near if fits[k].converged and not blobs[k].holes]
    window = dot_window(grey, found.labels, blobs[dot], _start(fits[dot]), known=sure)
    return without_neighbours(window, [fits[k] for k in near])


def _start(fit: DotFit) -> Start:
    return Start(fit.centre_px, fit.shape_px, fit.sigma_px, previous=fit)


def _refit(
    fits: list[DotFit],
    dots: list[int],
    windows: list[Window],
    noise: NoiseModel,
    priors: list[Prior],
    neighbours: list[list[int]],
) -> list[int]:
    """Replace those dots' fits; returns those with neighbours whose centres moved."""
    seen = {
        i: window
        for i, window in zip(dots, windows)
        if np.count_nonzero(window.mask) >= _FEWEST_PIXELS
    }
    starts = [_start(fits[i]) for i in seen]
    found = fit_dots(list(seen.values()), starts, noise, [priors[i] for i in seen])
    moved = []
    for i, fit in zip(seen, found):
        step = float(np.linalg.norm(fit.centre_px - fits[i].centre_px))
        if neighbours[i] and step > _SETTLED_SD * np.sqrt(np.trace(fit.covariance_px2)):
            moved.append(i)
        fits[i] = fit
    return moved


def _dots_table(accepted: list[tuple[Candidate, DotFit]], noise: NoiseModel) -> pd.DataFrame:
    import pandas as pd

    rows = []
    for blob, fit in accepted:
        blur = float(np.sqrt(max(fit.sigma_px**2 - PIXEL_VARIANCE_PX2, 0.0)))
        (suu, suv), (_, svv) = fit.inflated_covariance_px2
        place = (*fit.centre_px, suu, suv, svv, *axes_from_shape(fit.shape_px), fit.chi2_dof)
        levels = (fit.background + fit.contrast, fit.background)
        rows.append((*place, *levels, blur, is_ring(blob), noise.sigma_at(fit.background)))
    names = "u_px v_px suu_px2 suv_px2 svv_px2 a_px b_px angle_rad chi2_dof inner_level outer_level"
    return pd.DataFrame(rows, columns=[*names.split(), "blur_px", "ring", "noise"])


def _rejected_table(rejected: list[_Rejection]) -> pd.DataFrame:
    import pandas as pd

    rows = [(*r.centre_px, *axes_from_shape(r.shape_px), r.reason) for r in rejected]
    return pd.DataFrame(rows, columns=["u_px", "v_px", "a_px", "b_px", "angle_rad", "reason"])
