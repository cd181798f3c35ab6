"""Components and their exact discretisation, against quadrature and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from telerig.errors import InputError
from telerig.factors.state_space import (
    Component,
    Steps,
    broad_band,
    discretise,
    distinct_steps,
    driven_mode,
    forced_mass,
    independent,
    inertial_path,
    oscillator,
    ou_velocity,
    slow_ou,
)

ALL = [
    ou_velocity(10.0, 0.3),
    forced_mass(1000.0),
    oscillator(0.2, 12.0, 0.03),
    driven_mode(0.14, 20.0, 0.03),
    broad_band(0.14),
    slow_ou(0.02, 0.3),
    inertial_path(10.0, 0.3, 0.01),
    inertial_path(10.0, 0.3, 0.3, [oscillator(0.5, 6.0, 0.03), driven_mode(0.2, 13.0, 0.03)]),
]
STEEP = broad_band(0.3, low_hz=40.0, high_hz=80.0, floor=0.12, tail=3)
SETTLING = [c for c in ALL if c.start_from_input.shape[1] == 0 and c.name != "forced_mass"]


def steps_of(component: Component, *lengths_s: float) -> Steps:
    return discretise([component], np.array(lengths_s))[0]


def quadrature(component: Component, dt: float) -> tuple[Any, Any]:
    """Transition and noise covariance by Gauss-Legendre over the impulse response."""
    nodes, weights = np.polynomial.legendre.leggauss(60)
    covariance = np.zeros_like(component.drift)
    for part in range(4):
        for x, w in zip(nodes, weights):
            gain = expm(component.drift * dt * (part + (x + 1) / 2) / 4) @ component.noise
            covariance += gain @ gain.T * w * dt / 8
    return expm(component.drift * dt), covariance


@pytest.mark.parametrize(
    ("component", "dt"),
    # the quadrature has too few digits for six integrations in half a millisecond
    [*((c, dt) for dt in (5e-4, 2e-3, 0.1) for c in ALL), (STEEP, 4e-3), (STEEP, 0.1)],
    ids=lambda v: getattr(v, "name", v),
)
def test_steps_are_exact(component: Component, dt: float) -> None:
    steps = steps_of(component, dt)
    transition, covariance = quadrature(component, dt)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        steps.transition[0, 0], transition, atol=1e-12 * np.abs(transition).max()
    )
    error = (steps.covariance[0, 0] - covariance) / sigma / sigma[:, None]
    assert np.abs(error).max() < 1e-11
    white = steps.whitener[0, 0] @ steps.covariance[0, 0] @ steps.whitener[0, 0].T
    np.testing.assert_allclose(white, np.eye(component.size), atol=1e-8)
    assert steps.log_det[0, 0] == pytest.approx(np.linalg.slogdet(steps.whitener[0, 0])[1])


@pytest.mark.parametrize("component", SETTLING, ids=lambda c: c.name)
def test_stationary_stays_stationary(component: Component) -> None:
    steps, p = steps_of(component, 0.003), component.start_covariance
    sigma = np.sqrt(np.diag(p))
    after = steps.transition[0, 0] @ p @ steps.transition[0, 0].T + steps.covariance[0, 0]
    np.testing.assert_allclose(
        after / sigma / sigma[:, None], p / sigma / sigma[:, None], atol=1e-9
    )


@pytest.mark.parametrize(
    ("component", "rms"),
    [
        (oscillator(0.2, 12.0, 0.03), 0.2),
        (driven_mode(0.14, 20.0, 0.03), 0.14),
        (broad_band(0.3, low_hz=5.0), 0.3),
        (slow_ou(0.02, 0.3), 0.02),
    ],
    ids=lambda v: getattr(v, "name", None),
)
def test_rms_is_the_one_asked_for(component: Component, rms: float) -> None:
    row = component.position
    assert np.sqrt(row @ component.start_covariance @ row) == pytest.approx(rms, rel=1e-9)


@pytest.mark.parametrize("component", [ALL[1], *ALL[3:5], *ALL[6:], STEEP], ids=lambda c: c.name)
def test_rows_are_derivatives_of_one_another(component: Component) -> None:
    """No white noise enters position or velocity, and each row's rate of change is the next."""
    for row, following in (
        (component.position, component.velocity),
        (component.velocity, component.acceleration),
    ):
        np.testing.assert_allclose(row @ component.drift, following, atol=1e-9)
        np.testing.assert_allclose(row @ component.noise, 0, atol=1e-12)


def test_broad_band_has_nothing_at_zero_frequency() -> None:
    c = broad_band(0.14, low_hz=8.0, high_hz=60.0)

    def density(hz: float) -> float:
        response = np.linalg.solve(2j * np.pi * hz * np.eye(5) - c.drift, c.noise)
        return float(abs(c.position @ response[:, 0]) ** 2)

    assert density(0.0) < 1e-20
    assert density(0.1) < 2e-3 * density(8.0)
    assert density(4000.0) / density(2000.0) == pytest.approx(2.0**-8, rel=0.05)


def test_mean_velocity_enters_as_the_input() -> None:
    steps = steps_of(ou_velocity(10.0, 0.3), 0.02)
    state = steps.transition[0, 0] @ [5.0, 280.0] + steps.input[0, 0] @ [280.0]
    np.testing.assert_allclose(state, [5.0 + 280 * 0.02, 280.0], rtol=1e-12)


@pytest.mark.parametrize("inertia_s", [1e-5, 1e-3, 0.3 - 1e-12, 0.3, 5.0])
def test_an_inertial_path_is_sawfords_process_at_all_times(inertia_s: float) -> None:
    """Times that are equal, and one far shorter than the step (Sawford 1991, equations 9 to 12)."""
    path = inertial_path(10.0, 0.3, inertia_s)
    both = 0.3 + inertia_s
    expected = np.diag([1e4, 100 * 0.3 / both, 100 / (inertia_s * both)])
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(path.start_covariance / scale / scale[:, None], np.eye(3), atol=1e-6)
    steps = steps_of(path, 0.02)
    phi, q = steps.transition[0, 0][1:, 1:], steps.covariance[0, 0][1:, 1:]
    after = phi @ expected[1:, 1:] @ phi.T + q
    np.testing.assert_allclose(after / scale[1:] / scale[1:, None], np.eye(2), atol=1e-6)
    state = steps.transition[0, 0] @ [5.0, 280.0, 0.0] + steps.input[0, 0] @ [280.0]
    np.testing.assert_allclose(state, [5.0 + 280 * 0.02, 280.0, 0.0], atol=1e-5)


def test_irregular_steps_each_get_their_own(rng: np.random.Generator) -> None:
    dt = rng.uniform(1e-3, 5e-3, 40)
    dt[7] = dt[3]
    lengths, index = distinct_steps(dt)
    steps = steps_of(driven_mode(0.1, 8.0, 0.03), *lengths)
    assert len(lengths) == 39
    assert index[7] == index[3]
    for i in (0, 11, 39):
        expected = expm(driven_mode(0.1, 8.0, 0.03).drift * dt[i])
        np.testing.assert_allclose(steps.transition[0, index[i]], expected, atol=1e-8)


def test_memoryless_state_is_drawn_anew() -> None:
    steps = steps_of(independent(0.3), 0.1, 7.0)
    np.testing.assert_array_equal(steps.transition, 0)
    np.testing.assert_allclose(steps.covariance, 0.09)


def test_elimination_basis_makes_pivots_the_identity() -> None:
    component = broad_band(0.14)
    steps = steps_of(component, 5e-4)
    basis = steps.bases()[0, 0]
    ahead = steps.whitener[0, 0] @ steps.transition[0, 0] @ basis
    prior = basis.T @ np.linalg.solve(component.start_covariance, basis)
    np.testing.assert_allclose(ahead.T @ ahead + prior, np.eye(5), atol=1e-5)


def test_refusals() -> None:
    with pytest.raises(InputError, match="not positive"):
        distinct_steps([0.1, 0.0])
    with pytest.raises(InputError, match="rms_mm is 0"):
        oscillator(0.0, 12.0, 0.1)
    with pytest.raises(InputError, match="tau_s is nan"):
        ou_velocity(1.0, float("nan"))
    with pytest.raises(InputError, match="inertia_s is 0"):
        inertial_path(1.0, 0.3, 0.0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)
