"""Simulated motions against stationary closed forms, spectra and conservation laws."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import welch

from telerig.errors import InputError
from telerig.io.simulation.run.motion import (
    GRAVITY_M_S2,
    LinearProcess,
    accelerometer_readings,
    constant_speed_path,
    constant_speed_rise_mm_s,
    mode_acceleration,
    ornstein_uhlenbeck,
    oscillator,
    rig_mode,
    rig_shake,
    square_root,
    stage_trajectory,
    stochastic_paths,
)


def rng(seed=0):
    return np.random.default_rng(seed)


def step_covariance(process, step):
    """The integral of e^(F s) L L^T e^(F^T s) by Gauss-Legendre: what Van Loan's method gives."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    columns = [expm(process.drift * step * (n + 1) / 2) @ process.noise_input for n in nodes]
    return sum(w * step / 2 * np.outer(c, c) for w, c in zip(weights, columns))


@pytest.mark.parametrize("step", [5e-4, 2e-3, 1e-2])
@pytest.mark.parametrize(
    "process",
    [
        ornstein_uhlenbeck(10.0, 0.3),
        oscillator(0.177, 12.0, 0.03),
        rig_mode(0.14, 20.0, 0.03, 60.0),
        rig_mode(0.1, 15.0, 0.3, 60.0),
    ],
)
def test_one_step_has_the_exact_transition_and_noise(process, step):
    transition, root = process.discretised(step)
    expected = step_covariance(process, step)
    sigma = np.sqrt(np.diag(expected))
    change = (transition - expm(process.drift * step)) / sigma[:, None] * sigma
    assert np.allclose(change, 0, atol=1e-9)
    got = root @ root.T / sigma[:, None] / sigma
    assert np.allclose(got, expected / sigma[:, None] / sigma, atol=1e-9)


@pytest.mark.parametrize("step", [5e-4, 1e-2, 0.3])
def test_the_stationary_state_stays(step):
    process = rig_mode(0.2, 12.0, 0.03, 60.0)
    start = process.stationary_covariance()
    transition, root = process.discretised(step)
    after = transition @ start @ transition.T + root @ root.T
    sigma = np.sqrt(np.diag(start))
    assert np.allclose((after - start) / sigma[:, None] / sigma, 0, atol=1e-9)


def test_oscillator_in_closed_form():
    """Stationary: x and v independent, RMS of v = w times that of x; correlation at a lag."""
    w, damping = 2 * np.pi * 12.0, 0.1
    process = oscillator(0.5, 12.0, damping)
    assert np.allclose(process.stationary_covariance(), np.diag([0.25, (0.5 * w) ** 2]), atol=1e-9)
    x = process.paths(1 / 200, 2000, rng(), paths=200)[..., 0]
    assert x.std() == pytest.approx(0.5, rel=0.02)
    lag = np.arange(0, 30) / 200
    free = w * np.sqrt(1 - damping**2)
    fall = np.exp(-damping * w * lag)
    expected = fall * (np.cos(free * lag) + damping * w / free * np.sin(free * lag))
    got = [np.mean(x[:, : 2000 - k] * x[:, k:]) / 0.25 for k in range(30)]
    assert np.allclose(got, expected, atol=0.06)


def test_ornstein_uhlenbeck_displacement_variance():
    """Var of the displacement: 2 s^2 tau (t - tau (1 - e^(-t/tau)))."""
    process = ornstein_uhlenbeck(10.0, 0.3)
    paths = process.paths(0.01, 101, rng(), paths=20_000, start_covariance=np.diag([0.0, 100.0]))
    for k in (5, 30, 100):
        t = 0.01 * k
        expected = 2 * 100 * 0.3 * (t - 0.3 * (1 - np.exp(-t / 0.3)))
        assert paths[:, k, 0].var() == pytest.approx(expected, rel=0.05)
        assert paths[:, k, 1].std() == pytest.approx(10.0, rel=0.03)


def test_rig_mode_spectrum_and_acceleration():
    """Displacement density = |force filter|^2 |resonator|^2, and its second derivative."""
    f0, damping, force = 20.0, 0.1, 60.0
    process = rig_mode(0.2, f0, damping, force)
    rate = 1000.0
    states = process.paths(1 / rate, 4096, rng(), paths=60)
    assert states[..., 0].std() == pytest.approx(0.2, rel=0.05)
    frequency, density = welch(states[..., 0], rate, nperseg=1024)
    w = 2 * np.pi * frequency
    low_pass = process.noise_input[3] / ((2 * np.pi * force) ** 2 - w**2 + 4j * np.pi * force * w)
    resonator = 1 / ((2 * np.pi * f0) ** 2 - w**2 + 2j * damping * 2 * np.pi * f0 * w)
    expected = 2 * np.abs(low_pass * resonator) ** 2
    band = (frequency > 8) & (frequency < 80)
    ratio = density.mean(0)[band] / expected[band]
    assert np.abs(np.log(ratio)).max() < 0.5 and abs(np.log(ratio).mean()) < 0.05
    acceleration = mode_acceleration(states, process)
    velocity = states[..., 1]
    mean = np.cumsum((acceleration[:, 1:] + acceleration[:, :-1]) / 2, 1) / rate
    drift = np.diff(velocity[:, 1:] - velocity[:, :1] - mean, axis=1)
    assert drift.std() < 0.03 * np.diff(velocity, axis=1).std()


def test_processes_that_do_not_settle_are_refused():
    with pytest.raises(InputError, match="no stationary state"):
        ornstein_uhlenbeck(1.0, 1.0).stationary_covariance()
    undamped = LinearProcess(np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([0.0, 1.0]))
    with pytest.raises(InputError):
        undamped.paths(0.1, 3, rng())


def test_square_root_of_singular_covariances():
    covariance = np.array([[4.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    root = square_root(covariance)
    assert np.allclose(root @ root.T, covariance, atol=1e-12)


@pytest.mark.parametrize("amplitudes", [(3.0, 0.0), (3.0, 3.0), (4.0, 2.0)])
def test_constant_speed_paths(amplitudes):
    t = np.linspace(0, 1, 20_001)
    path = constant_speed_path(t, 280.0, 6.0, amplitudes, azimuth_rad=0.7, phase_rad=0.4)
    speed = np.hypot(path.height_mm_s, np.linalg.norm(path.lateral_mm_s, axis=-1))
    assert np.allclose(speed, 280.0, rtol=1e-12)
    assert np.allclose(np.gradient(path.height_mm, t)[1:-1], path.height_mm_s[1:-1], atol=2e-3)
    slope = np.gradient(path.lateral_mm, t, axis=0)[1:-1]
    assert np.allclose(slope, path.lateral_mm_s[1:-1], atol=2e-3)
    assert path.height_mm[0] == 0
    assert np.linalg.norm(path.lateral_mm, axis=-1).max() == pytest.approx(amplitudes[0], rel=1e-6)
    rise = constant_speed_rise_mm_s(280.0, 6.0, amplitudes)
    assert path.height_mm[-1] == pytest.approx(rise, rel=1e-12)
    if amplitudes == (3.0, 3.0):
        assert rise == pytest.approx(np.sqrt(280**2 - (36 * np.pi) ** 2), rel=1e-12)


def test_impossible_zigzag_is_refused():
    with pytest.raises(InputError, match="needs 302 mm/s"):
        constant_speed_path([0.0], 280.0, 8.0, (6.0, 0.0))


def test_stochastic_path_velocities_are_the_derivatives():
    """But for the Brownian bridge between samples, of variance step * kick^2 / 12."""
    path = stochastic_paths(
        1e-4, 4000, rng(), rise_mm_s=[280.0, 100.0], wander_mm_s=10.0, wander_tau_s=0.3,
        height_oscillation=(0.177, 12.0, 0.03), lateral_oscillation=(2.0, 6.0, 0.03),
    )  # fmt: skip
    wander = 10.0 * np.sqrt(2 / 0.3)
    for place, speed, rms, hertz in (
        (path.height_mm, path.height_mm_s, 0.177, 12.0),
        (path.lateral_mm, path.lateral_mm_s, 2.0, 6.0),
    ):
        gap = np.diff(place, axis=1) / 1e-4 - (speed[:, 1:] + speed[:, :-1]) / 2
        kick = np.hypot(wander, 2 * rms * np.sqrt(0.03 * (2 * np.pi * hertz) ** 3))
        assert gap.std() == pytest.approx(kick * np.sqrt(1e-4 / 12), rel=0.05)
        assert np.all(np.abs(gap.mean(1)) < 4 * gap.std() / np.sqrt(4000))
    assert np.allclose(path.height_mm_s.mean(1), [280, 100], atol=30)
    gap = path.lateral_mm_s[0] - path.lateral_mm_s[1]
    assert gap.std() > 0.5 * path.lateral_mm_s.std()


def test_stage_starts_from_rest_and_goes_on_steadily():
    t = np.linspace(-0.05, 0.5, 55_001)
    place, velocity, acceleration = stage_trajectory(t, 280.0, 0.1)
    assert np.all(place[t < 0] == 0) and place[-1] == pytest.approx(280 * 0.45)
    assert np.all(velocity[t > 0.1001] == 280)
    assert np.allclose(np.gradient(place, t)[1:-1], velocity[1:-1], atol=0.02)
    assert np.allclose(np.gradient(velocity, t)[1:-1], acceleration[1:-1], atol=1.0)
    assert np.allclose(stage_trajectory([2.0], 280.0, 0.0)[0], 560)


def test_rig_shake_shares():
    shake = rig_shake(
        1e-3, 12_000, rng(), cameras=2, rms_mm=[0.0, 0.2, 0.1], frequency_hz=20.0, damping=0.3
    )
    first, second = shake.offset_mm[..., 1]
    assert np.all(shake.offset_mm[..., 0] == 0)
    assert first.std() == pytest.approx(0.2, rel=0.08)
    assert shake.offset_mm[..., 2].std() == pytest.approx(0.1, rel=0.08)
    assert np.corrcoef(first, second)[0, 1] == pytest.approx(0.75, abs=0.06)
    assert (first - second).std() == pytest.approx(0.2 * np.sqrt(0.5), rel=0.08)
    middle = (shake.velocity_mm_s[:, 1:] + shake.velocity_mm_s[:, :-1]) / 2
    slope = np.diff(shake.offset_mm, axis=1) / 1e-3
    assert np.abs(slope - middle).max() < 0.03 * shake.velocity_mm_s[..., 1].std()


def test_accelerometer_reads_gravity_upwards_and_its_noise():
    up = np.array([0.0, -1.0, 0.0])
    axes = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    reading = accelerometer_readings(
        np.tile([500.0, 0.0, 0.0], (20_000, 1)),
        up,
        axes,
        rng(),
        rate_hz=2000.0,
        density_ug_sqrt_hz=22.5,
        bias_m_s2=[0.01, 0.0, -0.02],
    )
    assert np.allclose(reading.mean(0), [GRAVITY_M_S2 + 0.01, 0.5, -0.02], atol=2e-4)
    expected = 22.5e-6 * 9.81 * np.sqrt(1000.0)
    assert np.allclose(reading.std(0), expected, rtol=0.03)
