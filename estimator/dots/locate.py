"""Dots in an image: the centre, ellipse and covariance of each, and why other blobs are no dots.

A luminance model is fitted to every candidate (after Lavest, Viala, Dhome 1999), twice: the first
fits yield the contrast of every dot and so the illumination across the image; the second fits use
it as a prior for each dot's own contrast gradient, and take the neighbours' blur away. Dots that
are smaller than the others, or that one disc fits badly, are fitted once more with a heart, and all
dots of an image in which most have one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Float32
from telerig.errors import InputError
from telerig.estimator.dots.fit.blurred_ellipse import (
    PIXEL_VARIANCE_PX2,
    axes_from_shape,
    matrix_from_shape,
    semi_axes,
)
from telerig.estimator.dots.fit.candidates import (
    Candidate,
    Candidates,
    Look,
    Polarity,
    clipping_levels,
    edge_map,
    find_candidates,
    is_ring,
    is_unlike,
    reason_against_blob,
    reason_against_fit,
)
from telerig.estimator.dots.fit.hearts import (
    FEWEST_DOTS,
    FEWEST_PIXELS,
    of_other_size,
    show_hearts,
    too_small_sd,
    with_hearts,
)
from telerig.estimator.dots.fit.luminance import DotFit, Prior, Start, Window, fit_dot
from telerig.estimator.dots.fit.rim import EdgeErrors, edge_errors
from telerig.estimator.dots.fit.surroundings import (
    close_neighbours,
    dot_window,
    priors_from,
    without_neighbours,
)
from telerig.estimator.dots.thresholds import LOG_FITTED
from telerig.estimator.images.noise import (
    NoiseModel,
    agreed_factor,
    check_grey_image,
    estimate_noise,
    grey_step,
    high_pass,
    rough_sigma,
    with_inner_level,
)
from telerig.io.machine.parallel import keep_freed_memory
from telerig.io.tables.table import EDGE_COVARIANCE, PIXEL_COVARIANCE

COLUMNS = [
    *("u_px", "v_px", *PIXEL_COVARIANCE),
    *("a_px", "b_px", "angle_rad", "chi2_dof"),
    *("inner_level", "outer_level", "blur_px", "ring", "noise"),
    *EDGE_COVARIANCE,
]
REJECTED = ["u_px", "v_px", "a_px", "b_px", "angle_rad", "reason"]


@dataclass(frozen=True)
class DotMeasurement:
    """What was measured in one image.

    dots : as `locate_dots` returns them.
    rejected : the candidates that are no dots: u_px, v_px, a_px, b_px, angle_rad, reason.
    noise : noise of the grey levels.
    polarity : of the dots.
    image_shape : (rows, columns).
    """

    dots: pd.DataFrame
    rejected: pd.DataFrame
    noise: NoiseModel
    polarity: Polarity
    image_shape: tuple[int, ...]


def locate_dots(
    image: NDArray[Any],
    *,
    polarity: Literal["auto", "white_on_black", "black_on_white"] = "auto",
    min_diameter_px: float = 5.0,
) -> pd.DataFrame:
    """Find all dots in a grey image (rows, columns).

    polarity : "white_on_black", "black_on_white", or "auto", which decides this.
    min_diameter_px : smaller dots are left out.

    Returns a table with a row for each dot, in no particular order. Its columns are: ``u_px``,
    ``v_px`` centre; ``suu_px2``, ``suv_px2``, ``svv_px2`` its covariance; ``a_px`` >= ``b_px``
    semi-axes; ``angle_rad`` angle of the major axis from +u towards +v; ``chi2_dof`` chi-square per
    degree of freedom of the fit; ``inner_level``, ``outer_level`` grey levels of the dot and of the
    background; ``blur_px`` standard deviation of the optical blur; ``ring`` whether it is a mark
    with a hole; ``noise`` standard deviation of a grey level; ``edge_suu_px2``, ``edge_suv_px2``,
    ``edge_svv_px2`` the part of the covariance that comes from rough edges of the dots
    (`fit.rim`): it is the same in all images of a dot.
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
    """Find the dots of an image as `locate_dots` does, and return more about the image.

    max_diameter_px : larger dots are rejected.
    """
    grey = _checked(image, polarity, min_diameter_px)
    keep_freed_memory()
    response = high_pass(grey)
    edges = edge_map(grey, rough_sigma(response))
    noise = estimate_noise(
        grey, response, edges.flat, step=grey_step(np.asarray(image)), clip=clipping_levels(grey)
    )
    wanted: tuple[Polarity, ...] = (
        ("white_on_black", "black_on_white") if polarity == "auto" else (polarity,)
    )
    options = [
        find_candidates(edges, option, min_diameter_px).up_to(max_diameter_px) for option in wanted
    ]
    most_area = max(options, key=lambda c: sum(blob.area_px2 for blob in c.promising))
    return _measure(grey, most_area, noise)


def _checked(image: NDArray[Any], polarity: str, min_diameter_px: float) -> Float32:
    image = np.asarray(image)
    check_grey_image(image, 8, "dots")
    if polarity not in ("auto", "white_on_black", "black_on_white"):
        raise InputError(
            f"unknown polarity {polarity!r}",
            where="polarity",
            todo="use 'auto', 'white_on_black' or 'black_on_white'",
        )
    if not min_diameter_px > 0:
        raise InputError(
            f"the smallest diameter must be positive, not {min_diameter_px}",
            where="min_diameter_px",
            todo="use 5.0 px unless the dots are smaller",
        )
    return image.astype(np.float32)


def _measure(grey: Float32, found: Candidates, noise: NoiseModel) -> DotMeasurement:
    look = Look.of_blobs(found)
    rejected: list[tuple[Any, ...]] = []
    blobs: list[Candidate] = []
    for blob in found.blobs:
        reason = reason_against_blob(blob, look)
        if reason:
            rejected.append((*blob.centre_px, *axes_from_shape(blob.shape_px), str(reason)))
        else:
            blobs.append(blob)
    scene = _Scene(grey, found.labels, blobs)
    fits = scene.first_fits(noise)
    if scene.show_hearts(fits, noise):
        fits = scene.second_fits(scene.with_hearts(fits, noise, look, usual=True), noise)
    else:
        noise = _noise_with_inner_level(noise, fits)
        fits = scene.with_hearts(scene.second_fits(fits, noise), noise, look, usual=False)
    factor = agreed_factor(
        noise, np.array([fit.chi2_dof for fit in fits]), np.array([fit.dof for fit in fits])
    )
    fits, noise = [fit.under_noise(factor) for fit in fits], noise.scaled(factor)
    look = look.with_fits(fits)
    edges = _edge_errors(fits)
    usual_chi2 = float(np.median([fit.chi2_dof for fit in fits])) if edges else 1.0
    accepted: list[tuple[Any, ...]] = []
    hearts = any(fit.heart is not None for fit in fits)
    for blob, fit, smaller in zip(blobs, fits, too_small_sd(fits)):
        # Where no dot has a heart, a disc that fits as well as the others is a smaller dot.
        smaller = smaller if hearts or look.misfit_sd(fit) > 1.0 else 0.0
        reason = reason_against_fit(blob, fit, grey.shape, found.polarity, look, smaller)
        if reason:
            rejected.append((*fit.centre_px, *axes_from_shape(fit.shape_px), str(reason)))
        else:
            accepted.append(_row(blob, fit, noise, edges, usual_chi2))
    return DotMeasurement(
        pd.DataFrame(accepted, columns=COLUMNS),
        pd.DataFrame(rejected, columns=REJECTED),
        noise,
        found.polarity,
        grey.shape,
    )


def _row(
    blob: Candidate, fit: DotFit, noise: NoiseModel, edges: EdgeErrors | None, usual_chi2: float
) -> tuple[Any, ...]:
    """Return the values of the columns `COLUMNS` of an accepted dot.

    usual_chi2 : chi2_dof of the image's dots, of which `edges` tells what it means for centres.
    """
    rough, at_edge = edges or (0.0, 1.0)
    blur = float(np.sqrt(max(fit.sigma_px**2 - PIXEL_VARIANCE_PX2, 0.0)))
    axes = rough * matrix_from_shape(fit.shape_px)
    edge = axes @ axes
    (suu, suv), (_, svv) = at_edge * fit.inflated_covariance_px2(usual_chi2) + edge
    place = (*fit.centre_px, suu, suv, svv, *axes_from_shape(fit.shape_px), fit.chi2_dof)
    levels = (fit.background + fit.contrast, fit.background)
    own = edge[[0, 0, 1], [0, 1, 1]]
    return (*place, *levels, blur, is_ring(blob), noise.sigma_at(fit.background), *own)


def _edge_errors(fits: list[DotFit]) -> EdgeErrors | None:
    """Return `edge_errors` of fitted dots."""
    seen = [fit for fit in fits if fit.converged and np.all(np.isfinite(fit.edge_variance))]
    if not seen:
        return None
    names = ("edge", "edge_variance", "centre_px", "shape_px", "sigma_px")
    return edge_errors(*(np.array([getattr(fit, name) for fit in seen]) for name in names))


def _noise_with_inner_level(noise: NoiseModel, fits: list[DotFit]) -> NoiseModel:
    seen = [fit for fit in fits if fit.inner_pixels > 0]
    if not seen:
        return noise
    inner = float(np.median([fit.background + fit.contrast for fit in seen]))
    outer = float(np.median([fit.background for fit in seen]))
    ratio = float(np.median([fit.inner_chi2 for fit in seen]))
    pixels = sum(fit.inner_pixels for fit in seen)
    return with_inner_level(noise, inner, outer, ratio, pixels)


@dataclass(frozen=True)
class _Scene:
    """Grey levels (rows, columns), the blob's number of each pixel (0: none), and blobs to fit."""

    grey: Float32
    labels: NDArray[np.int32]
    blobs: list[Candidate]

    def first_fits(self, noise: NoiseModel) -> list[DotFit]:
        """Fit each dot independently, to a part of its pixels."""
        fits = []
        for blob in self.blobs:
            start = Start(blob.centre_px, blob.shape_px, Prior().edge_px)
            window = dot_window(self.grey, self.labels, blob, start, coarse=True)
            fits.append(fit_dot(window, start, noise, Prior(), tolerance=0.3, outlier_rounds=1))
        return fits

    def second_fits(self, fits: list[DotFit], noise: NoiseModel, rounds: int = 10) -> list[DotFit]:
        """Fit each dot again, with the illumination and its neighbours known from the first fits.

        Of dots that share pixels, each is fitted after the light of the others was subtracted,
        until none moves (Gauss-Seidel iteration; its limit is the fit of all dots together).
        """
        priors = priors_from(fits, self.grey.shape)
        neighbours = close_neighbours(fits)
        fits = list(fits)
        again: Sequence[int] = range(len(fits))
        for _ in range(rounds):
            moved: set[int] = set()
            for i in again:
                window = self._window(
                    i, fits[i].start, fits, neighbours[i], whole=fits[i].heart is not None
                )
                if np.count_nonzero(window.mask) < FEWEST_PIXELS:
                    continue
                fit = fit_dot(window, fits[i].start, noise, priors[i], edges=True)
                if neighbours[i] and fit.has_moved_from(fits[i]):
                    moved |= {i, *neighbours[i]}
                fits[i] = fit
            again = sorted(moved)
            if not again:
                break
        return fits

    def show_hearts(self, fits: list[DotFit], noise: NoiseModel) -> bool:
        """Return whether the dots have hearts, which one in four pixels tells."""
        if len(fits) < FEWEST_DOTS:
            return False

        def window(dot: int, start: Start) -> Window:
            return dot_window(
                self.grey, self.labels, self.blobs[dot], start, coarse=True, whole=True
            )

        return show_hearts(fits, noise, priors_from(fits, self.grey.shape), window)

    def with_hearts(
        self, fits: list[DotFit], noise: NoiseModel, look: Look, *, usual: bool
    ) -> list[DotFit]:
        """Fit dots that are smaller than most or larger than their blobs, or that have larger
        residuals, again with a heart.

        usual : whether all may have one.
        """
        look = look.with_fits(fits)
        doubtful = {*range(len(fits))} if usual else {*of_other_size(fits)}
        for i, (blob, fit) in enumerate(zip(self.blobs, fits)):
            larger = float(np.log(semi_axes(fit.shape_px)[1] / semi_axes(blob.shape_px)[1]))
            if np.any(is_unlike([[look.misfit_sd(fit)], [max(larger, 0.0) / LOG_FITTED]])):
                doubtful.add(i)
        which = [i for i in sorted(doubtful) if not is_ring(self.blobs[i])]
        if not which or len(fits) < FEWEST_DOTS:
            return fits
        priors = priors_from(fits, self.grey.shape)
        # Single discs that are fitted to hearts have so much blur that all would be neighbours.
        neighbours = [[] for _ in fits] if usual else close_neighbours(fits)

        def window(dot: int, start: Start) -> Window:
            return self._window(dot, start, fits, neighbours[dot], whole=True)

        return with_hearts(fits, noise, priors, window, which, usual=usual)

    def _window(
        self, dot: int, start: Start, fits: list[DotFit], near: list[int], *, whole: bool = False
    ) -> Window:
        """Return the pixels of a dot after the light of its neighbours is subtracted."""
        blobs = self.blobs
        known = [blobs[k].label for k in near if fits[k].converged and not blobs[k].holes]
        window = dot_window(self.grey, self.labels, blobs[dot], start, known=known, whole=whole)
        return without_neighbours(window, [fits[k] for k in near])
