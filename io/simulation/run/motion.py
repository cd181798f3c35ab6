"""Motions of a run: bubbles, stage, servo and shaking rig, all discretised exactly.

Linear processes x' = F x + L w are stepped with Van Loan's matrix exponential (IEEE Trans. Autom.
Control 23:395, 1978), so that any sampling rate has the right spectra and covariances. Vectors
lead with the path: (paths, steps, states). Heights are along the stage's axis, upwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.simulation.config import GRAVITY_M_S2

POSITION, VELOCITY = 0, 1
"""Places of these states in every process below."""

MICRO_G_M_S2 = 1e-6 * GRAVITY_M_S2


@dataclass(frozen=True)
class LinearProcess:
    """The process x' = drift x + input * w, with w white noise of unit two-sided density."""

    drift: Array
    noise_input: Array

    def stationary_covariance(self) -> Array:
        """Return the covariance (n, n). Raises InputError for a process without one."""
        from scipy.linalg import solve_continuous_lyapunov

        if np.max(np.linalg.eigvals(self.drift).real) >= 0:
            raise InputError("a motion without damping has no stationary state", todo="damp it")
        noise = np.outer(self.noise_input, self.noise_input)
        return np.asarray(solve_continuous_lyapunov(self.drift, -noise))

    def discretised(self, step_s: float) -> tuple[Array, Array]:
        """Return the transition over a step and a square root of its noise covariance, both (n, n).

        The root is symmetric. Van Loan's method contains e^(-F t), which is too large to compute
        with if states decay fast. It is therefore applied to a small fraction of the step, which is
        then doubled repeatedly.
        """
        doublings = max(
            0, int(np.ceil(np.log2(np.linalg.norm(self._rates(), 2) * step_s + 1e-300)))
        )
        transition, covariance = self._van_loan(step_s / 2**doublings)
        for _ in range(doublings):
            covariance = covariance + transition @ covariance @ transition.T
            transition = transition @ transition
        return transition, square_root(covariance)

    def _van_loan(self, step_s: float) -> tuple[Array, Array]:
        """Return transition and noise covariance (n, n) of a short step.

        Integrals of white noise differ by powers of the step: they are scaled before the
        exponential, else the smallest drown in rounding.
        """
        from scipy.linalg import expm

        scale = step_s ** self._orders()
        drift = self.drift * step_s / scale[:, None] * scale
        noise = self.noise_input * np.sqrt(step_s) / scale
        strength = float(np.linalg.norm(noise)) or 1.0
        noise, n = noise / strength, len(noise)
        block = np.zeros((2 * n, 2 * n))
        block[:n, :n], block[:n, n:], block[n:, n:] = -drift, np.outer(noise, noise), drift.T
        exponential = expm(block)
        transition = exponential[n:, n:].T
        covariance = transition @ exponential[:n, n:]
        symmetric = (covariance + covariance.T) / 2
        return (
            np.asarray(transition * scale[:, None] / scale),
            np.asarray(symmetric * strength**2 * scale[:, None] * scale),
        )

    def _rates(self) -> Array:
        """Return (n, n) the drift with states scaled to one unit, so that its norm is a rate."""
        off = np.abs(np.linalg.eigvals(self.drift)).max()
        scale = off ** -self._orders()
        return np.asarray(self.drift / scale[:, None] * scale)

    def _orders(self) -> Array:
        """Return (n,) how many integrations lie between the white noise and each state."""
        orders = np.full(len(self.noise_input), np.nan)
        reached = self.noise_input
        for order in range(len(orders)):
            orders[np.isnan(orders) & (reached != 0)] = order
            reached = np.abs(self.drift) @ np.abs(reached)
        return np.asarray(np.nan_to_num(orders, nan=0.0))

    def paths(
        self,
        step_s: float,
        steps: int,
        rng: Generator,
        *,
        paths: int = 1,
        start_covariance: Array | None = None,
    ) -> Array:
        """Return samples (paths, steps, n) from a random start, by default a stationary one."""
        start = self.stationary_covariance() if start_covariance is None else start_covariance
        transition, root = self.discretised(step_s)
        n = len(self.noise_input)
        out = np.empty((steps, paths, n))
        out[0] = rng.standard_normal((paths, n)) @ square_root(start).T
        kicks = rng.standard_normal((steps, paths, n)) @ root.T
        for i in range(1, steps):
            out[i] = out[i - 1] @ transition.T + kicks[i]
        return out.transpose(1, 0, 2)


def square_root(covariance: Array) -> Array:
    """Return the S (n, n) with S S^T = ``covariance`` (n, n), which may be singular.

    Scaled to unit variances S is symmetric, and so does not depend on the signs of eigenvectors,
    which are different from machine to machine: a seed gives the same run everywhere.
    """
    sigma = np.sqrt(np.diag(covariance))
    unit = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / unit[:, None] / unit)
    root = vectors * np.sqrt(np.clip(values, 0, None)) @ vectors.T
    return np.asarray(unit[:, None] * root)


def ornstein_uhlenbeck(sigma: float, tau_s: float) -> LinearProcess:
    """Return the process of an Ornstein-Uhlenbeck velocity and its integral.

    The states are (integral, value). The velocity has the RMS sigma and the correlation time tau_s;
    the integral starts at 0.
    """
    return LinearProcess(
        np.array([[0.0, 1.0], [0.0, -1 / tau_s]]), np.array([0.0, sigma * np.sqrt(2 / tau_s)])
    )


def oscillator(rms: float, frequency_hz: float, damping: float) -> LinearProcess:
    """Return the process (displacement, velocity) of a resonator with this RMS in white noise."""
    w = 2 * np.pi * frequency_hz
    drift = np.array([[0.0, 1.0], [-(w**2), -2 * damping * w]])
    return LinearProcess(drift, np.array([0.0, 2 * rms * np.sqrt(damping * w**3)]))


def rig_mode(rms: float, frequency_hz: float, damping: float, force_hz: float) -> LinearProcess:
    """Return the process of a structure's mode, whose displacement has the RMS value rms.

    Its states are displacement, velocity, force and the slope of the force, which is white noise
    through two critically damped poles at force_hz.
    """
    w, f = 2 * np.pi * frequency_hz, 2 * np.pi * force_hz
    drift = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-(w**2), -2 * damping * w, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
            [0.0, 0.0, -(f**2), -2 * f],
        ]
    )
    unit = LinearProcess(drift, np.array([0.0, 0.0, 0.0, f**2]))
    gain = rms / np.sqrt(unit.stationary_covariance()[POSITION, POSITION])
    return LinearProcess(drift, unit.noise_input * gain)


def mode_acceleration(states: Array, process: LinearProcess) -> Array:
    """Return the acceleration (...) in mm/s^2 of a `rig_mode` from its states (..., 4)."""
    return np.asarray(states @ process.drift[VELOCITY])


@dataclass(frozen=True)
class Path:
    """Hold places and velocities of bubbles in the laboratory frame.

    height_mm, height_mm_s : (...) along the stage's axis, in mm and mm/s.
    lateral_mm, lateral_mm_s : (..., 2) perpendicular to it, in mm and mm/s.
    height_mm_s2, lateral_mm_s2 : accelerations in mm/s^2; None where the path has none.
    """

    height_mm: Array
    lateral_mm: Array
    height_mm_s: Array
    lateral_mm_s: Array
    height_mm_s2: Array | None = None
    lateral_mm_s2: Array | None = None


def constant_speed_path(
    t_s: ArrayLike,
    speed_mm_s: float,
    frequency_hz: float,
    amplitudes_mm: tuple[float, float],
    *,
    azimuth_rad: float = 0.0,
    phase_rad: float = 0.0,
) -> Path:
    """Return a path of constant speed whose lateral motion is an ellipse.

    It is a zigzag if the second of the two amplitudes is 0, and a helix if both are equal. The
    height is an elliptic integral of the second kind.

    azimuth_rad : direction of the first amplitude. phase_rad : phase at t = 0.
    Raises InputError when the lateral motion alone is faster than the speed.
    """
    from scipy.special import ellipeinc

    large, small = sorted((abs(a) for a in amplitudes_mm), reverse=True)
    w = 2 * np.pi * frequency_hz
    if w * large >= speed_mm_s:
        raise InputError(
            f"an amplitude of {large:g} mm at {frequency_hz:g} Hz needs {w * large:.0f} mm/s",
            todo=f"stay below the bubble's speed of {speed_mm_s:g} mm/s",
        )
    theta = w * np.asarray(t_s, float) + phase_rad
    upright = np.sqrt(speed_mm_s**2 - (w * small) ** 2)
    m = (large**2 - small**2) * (w / upright) ** 2
    rise = ellipeinc(theta - np.pi / 2, m) - ellipeinc(phase_rad - np.pi / 2, m)
    turn = np.array(
        [[np.cos(azimuth_rad), np.sin(azimuth_rad)], [-np.sin(azimuth_rad), np.cos(azimuth_rad)]]
    )
    place = np.stack([large * np.sin(theta), -small * np.cos(theta)], -1) @ turn
    speed = w * np.stack([large * np.cos(theta), small * np.sin(theta)], -1) @ turn
    climb = upright * np.sqrt(1 - m * np.cos(theta) ** 2)
    return Path(upright / w * rise, place, climb, speed)


def constant_speed_rise_mm_s(
    speed_mm_s: float, frequency_hz: float, amplitudes_mm: tuple[float, float]
) -> float:
    """Return the mean vertical velocity of `constant_speed_path` in mm/s."""
    whole = constant_speed_path([1 / frequency_hz], speed_mm_s, frequency_hz, amplitudes_mm)
    return float(whole.height_mm[0] * frequency_hz)


def stochastic_paths(
    step_s: float,
    steps: int,
    rng: Generator,
    *,
    rise_mm_s: ArrayLike,
    wander_mm_s: float,
    wander_tau_s: float,
    height_oscillation: tuple[float, float, float],
    lateral_oscillation: tuple[float, float, float],
) -> Path:
    """Return B random paths: a steady rise, Ornstein-Uhlenbeck velocity and damped oscillation.

    rise_mm_s : (B,) mean velocity upwards.
    wander_mm_s, wander_tau_s : standard deviation along each axis and correlation time of the
        velocity about its mean.
    height_oscillation, lateral_oscillation : (RMS in mm, frequency in Hz, damping ratio) of the
        vertical oscillation, and of independent ones along the two lateral axes.
    """
    rise = np.asarray(rise_mm_s, float)
    count = len(rise)
    wander = ornstein_uhlenbeck(wander_mm_s, wander_tau_s).paths(
        step_s, steps, rng, paths=3 * count, start_covariance=np.diag([0.0, wander_mm_s**2])
    )
    up = wander[:count] + oscillator(*height_oscillation).paths(step_s, steps, rng, paths=count)
    across = wander[count:] + oscillator(*lateral_oscillation).paths(
        step_s, steps, rng, paths=2 * count
    )
    across = across.reshape(2, count, steps, 2).transpose(1, 2, 3, 0)
    t = step_s * np.arange(steps)
    return Path(
        rise[:, None] * t + up[..., POSITION],
        across[:, :, POSITION],
        rise[:, None] + up[..., VELOCITY],
        across[:, :, VELOCITY],
    )


def added_mass_along(aspect: float) -> float:
    """Return the added-mass coefficient of a spheroid along its pole, by numerical integration.

    The integral is gamma = a^2 c int dl / ((c^2 + l)^(3/2) (a^2 + l)) (Lamb, Hydrodynamics, section
    373), with l = c^2 u here; the coefficient is gamma / (2 - gamma).

    aspect : equatorial semi-axis a divided by the polar one c.
    """
    from scipy.integrate import quad

    square = aspect**2
    gamma, _ = quad(lambda u: square / ((1 + u) ** 1.5 * (square + u)), 0, np.inf)
    return float(gamma / (2 - gamma))


@dataclass(frozen=True)
class Forces:
    """The forces on each of B bubbles, divided by the mass of the displaced liquid.

    drag_1_mm : (B,) drag divided by the squared speed.
    added_mass : (B,) coefficient.
    lift_mm_s2, lift_hz, lift_rad : (B,) amplitude, frequency and phase of an oscillating lift.
    lift_azimuth : (B, 2) horizontal unit vector along which it acts.
    noise_mm_s2, noise_tau_s : RMS along both horizontal axes, and correlation time, of a random
        lift (Ornstein-Uhlenbeck process).
    """

    drag_1_mm: Array
    added_mass: Array
    lift_mm_s2: Array
    lift_hz: Array
    lift_rad: Array
    lift_azimuth: Array
    noise_mm_s2: float
    noise_tau_s: float
    gravity_mm_s2: float

    def acceleration(self, t_s: float, velocity: Array, noise: Array) -> Array:
        """Return the accelerations (B, 3) in mm/s^2: along the vertical, then along lateral axes.

        velocity : (B, 3) in mm/s, in the same order. noise : (B, 2) random lift in mm/s^2.
        """
        speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
        along = velocity / speed
        swing = self.lift_mm_s2 * np.cos(2 * np.pi * self.lift_hz * t_s + self.lift_rad)
        across = np.concatenate([0 * speed, swing[:, None] * self.lift_azimuth + noise], -1)
        across = across - along * (across * along).sum(-1, keepdims=True)
        force = across - self.drag_1_mm[:, None] * speed * velocity
        force[:, 0] += self.gravity_mm_s2
        return np.asarray(force / self.added_mass[:, None])


_WARM_UP_S = 1.0
_LONGEST_STEP_S = 5e-4


def driven_paths(step_s: float, steps: int, forces: Forces, rng: Generator) -> Path:
    """Return paths of bubbles under forces, by fourth-order Runge-Kutta, after the transient.

    The noise is drawn at the beginning, middle and end of every step.
    """
    count = len(forces.added_mass)
    fine = int(np.ceil(step_s / _LONGEST_STEP_S))
    h = step_s / fine
    warm = int(np.ceil(_WARM_UP_S / step_s)) * fine
    process = ornstein_uhlenbeck(forces.noise_mm_s2, forces.noise_tau_s)
    noise = np.zeros((2 * (warm + steps * fine) + 1, count, 2))
    if forces.noise_mm_s2 > 0:
        drawn = process.paths(
            h / 2, len(noise), rng, paths=2 * count,
            start_covariance=np.diag([0.0, forces.noise_mm_s2**2]),
        )[..., VELOCITY]  # fmt: skip
        noise = drawn.reshape(count, 2, -1).transpose(2, 0, 1)
    velocity = np.zeros((count, 3))
    velocity[:, 0] = np.sqrt(forces.gravity_mm_s2 / forces.drag_1_mm)
    state = np.concatenate([0 * velocity, velocity], -1)

    def slope(half: int, state: Array) -> Array:
        t = (half / 2 - warm) * h
        rate = forces.acceleration(t, state[:, 3:], noise[half])
        return np.concatenate([state[:, 3:], rate], -1)

    states, rates = [], []
    for i in range(warm + (steps - 1) * fine + 1):
        first = slope(2 * i, state)
        if i == warm:
            state[:, :3] = 0.0
        if i >= warm and (i - warm) % fine == 0:
            states.append(state)
            rates.append(first[:, 3:])
        second = slope(2 * i + 1, state + h / 2 * first)
        third = slope(2 * i + 1, state + h / 2 * second)
        fourth = slope(2 * i + 2, state + h * third)
        state = state + h / 6 * (first + 2 * second + 2 * third + fourth)
    place, rate = np.stack(states, 1), np.stack(rates, 1)
    return Path(
        place[..., 0], place[..., 1:3], place[..., 3], place[..., 4:], rate[..., 0], rate[..., 1:]
    )


def stage_trajectory(
    t_s: ArrayLike, speed_mm_s: float, ramp_s: float
) -> tuple[Array, Array, Array]:
    """Return position (mm), velocity (mm/s) and acceleration (mm/s^2) of a start from rest at 0 s.

    The velocity rises like half a cosine during ramp_s, so the acceleration has no step.
    """
    t = np.asarray(t_s, float)
    if ramp_s == 0:
        return speed_mm_s * t, np.full_like(t, speed_mm_s), np.zeros_like(t)
    phase = np.pi * np.clip(t / ramp_s, 0, 1)
    ramp = speed_mm_s * ramp_s / 2 / np.pi * (phase - np.sin(phase))
    place = ramp + speed_mm_s * np.maximum(t - ramp_s, 0)
    velocity = speed_mm_s * (1 - np.cos(phase)) / 2
    return place, velocity, speed_mm_s * np.pi / 2 / ramp_s * np.sin(phase)


@dataclass(frozen=True)
class Shake:
    """The offsets of the cameras from the carriage, with their first and second derivatives.

    Each array is (cameras, steps, axes).
    """

    offset_mm: Array
    velocity_mm_s: Array
    acceleration_mm_s2: Array


def rig_shake(
    step_s: float,
    steps: int,
    rng: Generator,
    *,
    cameras: int,
    rms_mm: ArrayLike,
    frequency_hz: float,
    common_share: float = 0.75,
    arm_ratio: float = 1.6,
    damping: float = 0.03,
    force_hz: float = 60.0,
) -> Shake:
    """Return a random shake: on each axis one mode that is common to all cameras, and one mode of
    each camera's arm.

    rms_mm : (axes,) RMS of each camera's whole shake.
    frequency_hz : frequency of the common mode.
    common_share : share of the common mode in the variance.
    arm_ratio : frequency of the arms' modes divided by frequency_hz.
    damping : damping ratio of all modes.
    force_hz : see `rig_mode`.
    """
    rms = np.asarray(rms_mm, float)
    offset = np.zeros((cameras, steps, len(rms)))
    velocity, acceleration = np.zeros_like(offset), np.zeros_like(offset)
    parts = ((common_share, 1.0, 1), (1 - common_share, arm_ratio, cameras))
    for axis, total in enumerate(rms):
        for share, ratio, copies in parts:
            if total * share == 0:
                continue
            mode = rig_mode(total * np.sqrt(share), ratio * frequency_hz, damping, force_hz)
            states = mode.paths(step_s, steps, rng, paths=copies)
            offset[..., axis] += states[..., POSITION]
            velocity[..., axis] += states[..., VELOCITY]
            acceleration[..., axis] += mode_acceleration(states, mode)
    return Shake(offset, velocity, acceleration)


def accelerometer_readings(
    acceleration_mm_s2: ArrayLike,
    up: ArrayLike,
    axes: ArrayLike,
    rng: Generator,
    *,
    rate_hz: float,
    density_ug_sqrt_hz: float,
    bias_m_s2: ArrayLike,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> Array:
    """Return the noisy readings (N, 3) in m/s^2 of an accelerometer: axes . (a - g) + bias.

    acceleration_mm_s2 : (N, 3) in rig axes.
    up : (3,) unit vector against gravity.
    axes : (3, 3) whose rows are the sensor's axes in rig coordinates.
    rate_hz, density_ug_sqrt_hz : sampling rate and noise density.
    """
    force = np.asarray(acceleration_mm_s2, float) / 1000 + gravity_m_s2 * np.asarray(up, float)
    sigma = density_ug_sqrt_hz * MICRO_G_M_S2 * np.sqrt(rate_hz / 2)
    noise = sigma * rng.standard_normal(force.shape)
    return np.asarray(force @ np.asarray(axes, float).T + np.asarray(bias_m_s2) + noise)
