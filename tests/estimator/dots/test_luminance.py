"""The luminance fit: truth recovered, covariance honest, gradients held, dirt ignored."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from seeds import few_or_many

from telerig.estimator.dots.fit.blurred_ellipse import coverage_on_grid, shape_from_axes
from telerig.estimator.dots.fit.candidates import Candidate, Look, reason_against_fit
from telerig.estimator.dots.fit.kernels import damped_step, predict
from telerig.estimator.dots.fit.luminance import DotFit, Prior, Reason, Start, Window, fit_dot
from telerig.estimator.images.noise import (
    NoiseModel,
    agreed_factor,
    estimate_noise,
    grey_step,
    high_pass,
    with_inner_level,
)

Array = NDArray[np.float64]
SIZE = 33
CENTRE = np.array([16.21, 15.84])
SIGMA = float(np.sqrt(0.8**2 + 1 / 12))
LOOK = Look(float(np.log(5.5)), log_contrast=float(np.log(150.0)))
HELD = Prior(sigma_per_px=1e-5)


def noise_of(sigma: float) -> NoiseModel:
    return NoiseModel(sigma**2, 0.0, 0.0, 0.0)


def picture(shape: Array) -> Array:
    """Level 40 outside and 190 inside."""
    pixels = np.arange(SIZE, dtype=float)
    coverage, _ = coverage_on_grid(pixels, pixels, CENTRE, shape, SIGMA)
    grey: Array = 40.0 + 150.0 * coverage
    return grey


def lit_picture(radius: float, slope_per_px: float) -> Array:
    """The same, painted on sub-pixels under light that changes along u before the blur."""
    pixels = (np.arange(SIZE * 20) + 0.5) / 20 - 0.5
    u, v = np.meshgrid(pixels, pixels)
    gap = np.hypot(u - CENTRE[0], v - CENTRE[1]) - radius
    inside = np.clip(0.5 - 20.0 * gap, 0.0, 1.0)
    scene = (40.0 + 150.0 * inside) * (1.0 + slope_per_px * (u - CENTRE[0]))
    blurred = gaussian_filter(scene, 0.8 * 20, mode="nearest", truncate=5.5)
    grey: Array = blurred.reshape(SIZE, 20, SIZE, 20).mean(axis=(1, 3))
    return grey


def fit(grey: Array, shape: Array, sigma: float, prior: Prior = HELD) -> DotFit:
    window = Window(grey, 0, 0, np.ones(grey.shape, dtype=bool))
    start = Start(CENTRE + (0.4, -0.3), shape * 1.06, 1.2)
    return fit_dot(window, start, noise_of(sigma), prior)


@pytest.mark.parametrize("axes", [(4.0, 4.0), (4.0, 1.7), (10.0, 10.0), (10.0, 4.2), (13.0, 12.0)])
def test_recovers_a_clean_dot(axes: tuple[float, float]) -> None:
    shape = shape_from_axes(*axes, 0.6)
    result = fit(picture(shape), shape, 0.01)
    assert result.converged
    np.testing.assert_allclose(result.centre_px, CENTRE, atol=1e-5)
    np.testing.assert_allclose(result.shape_px, shape, atol=1e-3)
    assert result.sigma_px == pytest.approx(SIGMA, abs=1e-3)
    assert result.contrast == pytest.approx(150.0, abs=0.1)
    assert result.background == pytest.approx(40.0, abs=0.1)


@few_or_many(60, 250)
@pytest.mark.parametrize("radius", [4.0, 10.0])
def test_spread_equals_prediction_and_the_bound(radius: float, draws: int) -> None:
    rng = np.random.default_rng(11)
    shape, noise = np.array([radius, 0.0, radius]), 3.0
    clean = picture(shape)
    fits = [
        fit(clean + noise * rng.standard_normal(clean.shape), shape, noise) for _ in range(draws)
    ]
    error = np.array([f.centre_px - CENTRE for f in fits])
    predicted = np.sqrt(np.mean([np.trace(f.covariance_px2) / 2 for f in fits]))
    bound = noise / 150.0 * np.sqrt(2 * SIGMA / (np.sqrt(np.pi) * radius))
    spread = np.sqrt(np.mean(error**2))
    assert spread / predicted == pytest.approx(1.0, abs=1.6 / np.sqrt(draws))
    assert predicted / bound == pytest.approx(1.0, abs=0.08)
    assert np.mean([f.chi2_dof for f in fits]) == pytest.approx(1.0, abs=0.02)


def test_jacobian_of_the_model() -> None:
    shape = shape_from_axes(5.0, 3.0, 0.4)
    parameters = np.array([0.2, -0.1, *shape, 0.9, 40.0, 3.0, -2.0, 150.0, 0.5, -0.4])
    at, first = np.argwhere(np.ones((SIZE, SIZE), bool)), np.array([[-17.0, -17.0]])
    value, gradient = np.empty((1, SIZE, SIZE)), np.empty((1, 6, SIZE, SIZE))

    def model(values: Array) -> tuple[Array, Array]:
        grey, jacobian = np.empty(len(at)), np.empty((12, len(at)))
        predict(at, first, 5.0, values, value, gradient, grey, jacobian)
        return grey, jacobian

    jacobian = model(parameters)[1]
    for i in range(12):
        step = 1e-5 * np.eye(12)[i]
        quotient = (model(parameters + step)[0] - model(parameters - step)[0]) / 2e-5
        np.testing.assert_allclose(jacobian[i], quotient, atol=0.1)


def test_jacobian_of_a_dot_with_a_heart() -> None:
    at, first, radius = np.argwhere(np.ones((22, 22), bool)), np.array([[-11.0, -11.0]]), 7.0
    place = np.array([0.3, -0.2, 7.0, 0.4, 6.0, 0.9, 40, 1, 2, 100, 0, 0, 0.8, 0.1, 0.55, 60.0])

    def model(parameters: Array) -> tuple[Array, Array]:
        grey, slopes = np.empty(len(at)), np.empty((16, len(at)))
        work = np.empty((1, 22, 22)), np.empty((1, 6, 22, 22))
        predict(at, first, radius, parameters, *work, grey, slopes)
        return grey, slopes

    for k, step in enumerate(1e-5 * np.eye(16)):
        change = (model(place + step)[0] - model(place - step)[0]) / 2e-5
        if k not in (10, 11):
            assert np.abs(change - model(place)[1][k]).max() < 1e-4 * np.abs(change).max()


def test_damped_steps_are_those_of_numpy() -> None:
    rng = np.random.default_rng(0)
    rows, step = rng.standard_normal((30, 12)) * 10.0 ** rng.uniform(-3, 3, 12), np.empty(12)
    information, pull = rows.T @ rows, rng.standard_normal(12)
    damped_step(information, pull, 0.3, step)
    scaled = information + 0.3 * np.diag(np.diag(information))
    np.testing.assert_allclose(step, np.linalg.solve(scaled, pull), rtol=1e-8)


@pytest.mark.parametrize("pixels", [0, 1, 3])
def test_a_dot_that_shows_hardly_a_pixel_does_not_disturb_the_others(pixels: int) -> None:
    shape = shape_from_axes(6, 5, 0.3)
    grey = picture(shape)
    hidden = Window(grey, 0, 0, np.ones(grey.shape, dtype=bool))
    hidden.mask.flat[pixels:] = False
    whole = Window(grey, 0, 0, np.ones(grey.shape, dtype=bool))
    start = Start(CENTRE + (0.4, -0.3), shape * 1.06, 1.2)
    none, one = (fit_dot(window, start, noise_of(2.0), HELD) for window in (hidden, whole))
    assert not none.converged and none.pixels == pixels
    blob = Candidate(1, CENTRE, shape, 94.0, (), 0.0, None)
    assert reason_against_fit(blob, none, grey.shape, "white_on_black", LOOK) == Reason.HIDDEN
    assert one.converged and np.linalg.norm(one.centre_px - CENTRE) < 1e-3


@pytest.mark.parametrize("change", [{"centre_px": CENTRE + (7.0, 0.0)}, {"shape_px": 2.4}])
def test_a_fit_that_left_its_blob_is_no_dot(change: dict[str, Any]) -> None:
    shape = shape_from_axes(6, 5, 0.3)
    grey = picture(shape)
    whole = Window(grey, 0, 0, np.ones(grey.shape, dtype=bool))
    fit = fit_dot(whole, Start(CENTRE, shape, 1.2), noise_of(2.0), HELD)
    blob = Candidate(1, CENTRE, shape, 94.0, (), 0.0, None)
    rest = (grey.shape, "white_on_black", LOOK)
    assert reason_against_fit(blob, fit, *rest) is None
    if "shape_px" in change:
        change = {"shape_px": change["shape_px"] * shape}
    assert reason_against_fit(blob, replace(fit, **change), *rest) == Reason.MISPLACED


@pytest.mark.parametrize(("sigma_px", "reason"), [(1.6, None), (0.8, Reason.MISPLACED)])
def test_the_blob_of_a_thin_dot_is_as_wide_as_the_blur(
    sigma_px: float, reason: Reason | None
) -> None:
    thin, shape = (shape_from_axes(4, b, 0.3) for b in (0.9, 3.8))
    grey = picture(thin)
    whole = Window(grey, 0, 0, np.ones(grey.shape, dtype=bool))
    fit = replace(
        fit_dot(whole, Start(CENTRE, thin, SIGMA), noise_of(2.0), HELD),
        shape_px=thin, sigma_px=sigma_px,
    )  # fmt: skip
    blob = Candidate(1, CENTRE, shape, 34.0, (), 0.0, None)
    look = replace(LOOK, log_radius=float(np.log(34.0 / np.pi) / 2))
    assert reason_against_fit(blob, fit, grey.shape, "white_on_black", look) == reason


@pytest.mark.parametrize(
    ("unevenness", "contrast", "reason"),
    [(4.0, 1.0, None), (0.0, 0.4, None), (4.0, 0.4, Reason.NOT_ELLIPSE)],
)
def test_what_is_unlike_a_dot_is_judged_together(
    unevenness: float, contrast: float, reason: Reason | None
) -> None:
    shape = shape_from_axes(6, 5, 0.3)
    grey = picture(shape)
    whole = Window(grey, 0, 0, np.ones(grey.shape, dtype=bool))
    fit = fit_dot(whole, Start(CENTRE, shape, 1.2), noise_of(2.0), HELD)
    blob = Candidate(1, CENTRE, shape, 94.0, (), unevenness, None)
    usual = Look(np.log(94.0 / np.pi) / 2, log_contrast=float(np.log(fit.contrast / contrast)))
    assert reason_against_fit(blob, fit, grey.shape, "white_on_black", usual) == reason


def test_a_free_contrast_gradient_would_more_than_double_the_variance() -> None:
    shape = np.array([4.0, 0.0, 4.0])
    free = fit(picture(shape), shape, 1.0, Prior(sigma_per_px=1.0))
    held = fit(picture(shape), shape, 1.0, HELD)
    ratio = np.trace(free.covariance_px2) / np.trace(held.covariance_px2)
    assert 2.0 < ratio < 6.0


def test_knowing_the_light_removes_its_bias() -> None:
    shape, slope = np.array([4.0, 0.0, 4.0]), 2e-3
    grey = lit_picture(4.0, slope)
    told = fit(grey, shape, 0.3, Prior(u_per_px=slope, sigma_per_px=1e-5))
    untold = fit(grey, shape, 0.3, Prior(sigma_per_px=1e-5))
    assert abs(told.centre_px[0] - CENTRE[0]) < 1e-4
    assert abs(untold.centre_px[0] - CENTRE[0]) > 1e-3


def test_misfit_widens_the_covariance() -> None:
    shape = np.array([8.0, 0.0, 8.0])
    rng = np.random.default_rng(4)
    result = fit(picture(shape) + 3.0 * rng.standard_normal((SIZE, SIZE)), shape, 1.0)
    assert result.chi2_dof == pytest.approx(9.0, rel=0.1)
    widened = np.trace(result.inflated_covariance_px2()) / np.trace(result.covariance_px2)
    assert widened == pytest.approx(result.chi2_dof)
    honest = replace(result, chi2_dof=1.01)
    np.testing.assert_array_equal(honest.inflated_covariance_px2(), honest.covariance_px2)


def noise_in(image: Array, flat: NDArray[np.bool_], step: float) -> NoiseModel:
    grey = image.astype(np.float32)
    return estimate_noise(grey, high_pass(grey), flat, step=step)


@pytest.mark.parametrize("sigma", [0.4, 0.8, 3.0])
def test_noise_of_rounded_grey_levels(sigma: float) -> None:
    rng = np.random.default_rng(6)
    u, v = np.meshgrid(np.arange(300.0), np.arange(200.0))
    image = np.rint(80 + 0.07 * u + 0.05 * v + sigma * rng.standard_normal(u.shape))
    model = noise_in(image, np.ones(u.shape, dtype=bool), step=1.0)
    assert model.sigma_at(90.0) == pytest.approx(np.hypot(sigma, np.sqrt(1 / 12)), rel=0.03)


def test_noise_that_grows_with_the_light() -> None:
    rng = np.random.default_rng(7)
    level = np.repeat([100.0, 400.0, 900.0, 1600.0], 60)[:, None] + np.zeros((240, 300))
    variance = 25.0 + 0.5 * level
    image = level + np.sqrt(variance) * rng.standard_normal(level.shape)
    flat = np.ones(level.shape, dtype=bool)
    flat[58:62] = flat[118:122] = flat[178:182] = False
    model = noise_in(image, flat, step=0.0)
    assert model.beta == pytest.approx(0.5, rel=0.1)
    np.testing.assert_allclose(model.variance(level[::60, 0]), variance[::60, 0], rtol=0.15)


def test_noise_inside_the_dots_comes_from_residuals_only_where_no_flat_shows_it() -> None:
    seen = NoiseModel(4.0, 0.0, 0.0, 0.02, lowest=40.0, highest=50.0)
    told = with_inner_level(seen, 190.0, 40.0, 2.5, 5000)
    np.testing.assert_allclose(told.variance(np.array([40.0, 190.0])), [4.0, 10.0])
    assert with_inner_level(seen, 190.0, 40.0, 1.02, 5000) == seen
    everywhere = replace(seen, highest=195.0)
    assert with_inner_level(everywhere, 190.0, 40.0, 2.5, 5000) == everywhere


def test_the_noise_is_never_below_what_was_seen() -> None:
    """Beyond the levels that were seen, a line through them may reach 0."""
    line = NoiseModel(-500.0, 10.0, 1.0, 0.02, lowest=100.0, highest=900.0)
    np.testing.assert_allclose(line.variance(np.array([0.0, 60.0, 100.0, 1000.0])),
                               [500.0, 500.0, 500.0, 9500.0])  # fmt: skip


def test_residuals_settle_an_uncertain_noise_but_not_a_misfit() -> None:
    dof = np.full(50, 200.0)
    unsure = NoiseModel(1.0, 0.0, 0.0, 0.1)
    assert agreed_factor(unsure, np.full(50, 1.15), dof) == pytest.approx(1.15, abs=0.01)
    assert agreed_factor(unsure, np.full(50, 9.0), dof) == 1.0
    assert agreed_factor(unsure, np.zeros(0), np.zeros(0)) == 1.0


def test_grey_step_finds_twelve_bits_in_sixteen_and_in_floats() -> None:
    rng = np.random.default_rng(8)
    image = rng.integers(0, 4096, (64, 64))
    assert grey_step((image * 16).astype(np.uint16)) == 16.0
    assert grey_step(image.astype(np.uint16)) == 1.0
    assert grey_step(16 * image.astype(np.float32)) == 16.0
    assert 0 < grey_step(rng.standard_normal((64, 64))) < 0.003
