"""Defines linear stochastic processes of bubbles and rig, and discretises them exactly.

Every process is x' = F x + B c + L w. Here x (n,) is the state, w (m,) is white noise of unit
two-sided density, and c (k,) are constant inputs, for instance a bubble's mean velocity. A step of
any length is exact: Van Loan's matrix exponential (IEEE Trans. Autom. Control 23:395, 1978) is
computed over a short step, which is then doubled until it has the wanted length. In this way a long
gap loses no digits, and neither does the very small variance of a noise that is integrated several
times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Ints
from telerig.errors import InputError

_SERIES_TERMS = 26
_SHORT_STEP = 0.5
"""Largest product of eigenvalue and step for which the series of the exponential is summed."""
_STEPS_PER_S = 1e11
"""Lengths of steps that agree after rounding to 1e-11 s count as equal. Clocks that are printed to
a nanosecond vary in the last digit."""


@dataclass(frozen=True, eq=False)
class Component:
    """Describes one stochastic process x' = F x + B c + L w.

    It has n states x, k constant inputs c and m white noises w of unit two-sided spectral density.
    Lengths are in mm (or px or rad, as the caller chooses), times in s.

    drift : (n, n) F.
    noise : (n, m) L.
    start_covariance : (n, n) covariance of the state at the first time.
    position, velocity, acceleration : (n,) rows that give these quantities from the state. The row
        of an acceleration that does not exist (white noise drives the velocity) is 0.
    input : (n, k) B.
    start_from_input : (n, k) matrix that gives the mean of the first state from the inputs c.
    memoryless : whether the state at every time is independent of the others, with
        start_covariance.
    """

    name: str
    drift: Array
    noise: Array
    start_covariance: Array
    position: Array
    velocity: Array
    acceleration: Array
    input: Array
    start_from_input: Array
    memoryless: bool = False

    @property
    def size(self) -> int:
        """Return the number of states of the component."""
        return len(self.drift)

    @property
    def jerk(self) -> Array:
        """The row (n,) that gives the rate of change of the acceleration, without its white-noise
        part."""
        return np.asarray(self.acceleration @ self.drift)

    def density(self, frequency_hz: Array) -> Array:
        """Return the one-sided spectral density (N,) of the position, in mm^2/Hz."""
        swing = 2j * np.pi * frequency_hz[:, None, None] * np.eye(self.size) - self.drift
        gain = np.linalg.solve(swing, self.noise[None])
        return np.asarray(2 * (np.abs(self.position @ gain) ** 2).sum(-1))

    def without_input(self) -> Component:
        """Return the same process about a known mean, so that it has no inputs."""
        nothing = np.zeros((self.size, 0))
        return replace(self, input=nothing, start_from_input=nothing)


def _component(
    name: str,
    drift: ArrayLike,
    noise: ArrayLike,
    start: Array | None = None,
    *,
    acceleration: ArrayLike | None = None,
) -> Component:
    """Return a process whose first states are displacement and velocity.

    start : (n, n) covariance at the start; None takes the stationary covariance.
    acceleration : (n,) row that gives the acceleration; None if it does not exist.
    """
    f = np.atleast_2d(np.asarray(drift, float))
    n = len(f)
    gain = np.asarray(noise, float).reshape(n, -1)
    rows = np.eye(max(n, 2))[:2, :n]
    covariance = stationary_covariance(f, gain) if start is None else start
    still = np.zeros(n) if acceleration is None else np.asarray(acceleration, float)
    nothing = np.zeros((n, 0))
    return Component(name, f, gain, covariance, rows[0], rows[1], still, nothing, nothing)


def stationary_covariance(drift: Array, noise: Array) -> Array:
    """Return the covariance P (n, n) of the stationary state: F P + P F^T + L L^T = 0.

    Raises InputError for a process that is not stable.
    """
    from scipy.linalg import solve_continuous_lyapunov

    if np.max(np.linalg.eigvals(drift).real) >= 0:
        raise InputError(
            "a motion without damping has no stationary state", todo="give a positive damping"
        )
    covariance = solve_continuous_lyapunov(drift, -noise @ noise.T)
    return np.asarray((covariance + covariance.T) / 2)


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} is {value}", todo="give a positive number")


def ou_velocity(sigma_mm_s: float, tau_s: float, *, start_sigma_mm: float = 100.0) -> Component:
    """Return a process whose velocity is an Ornstein-Uhlenbeck process about a constant mean U.

    The velocity v obeys v' = (U - v) / tau + noise, and v - U has the RMS sigma. The states are
    position and velocity, and U is the input. The first position is 0 +- start_sigma_mm, and the
    first velocity has its stationary distribution about U.
    """
    _positive(sigma_mm_s=sigma_mm_s, tau_s=tau_s, start_sigma_mm=start_sigma_mm)
    drift = np.array([[0.0, 1.0], [0.0, -1 / tau_s]])
    start = np.diag([start_sigma_mm**2, sigma_mm_s**2])
    plain = _component("ou_velocity", drift, [0.0, sigma_mm_s * np.sqrt(2 / tau_s)], start)
    return replace(
        plain, input=np.array([[0.0], [1 / tau_s]]), start_from_input=np.array([[0.0], [1.0]])
    )


def inertial_path(
    sigma_mm_s: float,
    tau_s: float,
    inertia_s: float,
    oscillations: Sequence[Component] = (),
    *,
    start_sigma_mm: float = 100.0,
) -> Component:
    """Return the sum of an `ou_velocity` process and oscillations after a first-order low-pass.

    The low-pass of time ``inertia_s`` adds a pole to the spectrum, so that the acceleration has a
    finite variance (without oscillations: Sawford, Phys. Fluids A 3:1577, 1991). With the input u,
    the velocity before the low-pass, the velocity w and the acceleration a obey w' = a and
    a' = (u' - a) / inertia_s. The states are position, velocity, acceleration and then the states
    of the oscillations before the low-pass; the mean velocity U is the input.

    sigma_mm_s, tau_s : as for `ou_velocity`, before the low-pass.
    oscillations : processes with a velocity and without inputs.
    """
    _positive(sigma_mm_s=sigma_mm_s, tau_s=tau_s, inertia_s=inertia_s)
    _positive(start_sigma_mm=start_sigma_mm)
    drift = block_diagonal([np.zeros((3, 3)), *(c.drift for c in oscillations)])
    inner = block_diagonal([np.zeros((3, 1)), *(c.noise for c in oscillations)])
    swing = np.concatenate([np.zeros(3), *(c.velocity for c in oscillations)])
    # u' of the Ornstein-Uhlenbeck part is (U - v) / tau + noise with v = w + inertia a - swing
    rate = swing / tau_s + swing @ drift
    rate[1:3] -= 1 / tau_s, inertia_s / tau_s + 1
    drift[0, 1] = drift[1, 2] = 1.0
    drift[2] = rate / inertia_s
    inner[2] = swing @ inner / inertia_s
    inner[2, 0] = sigma_mm_s * np.sqrt(2 / tau_s) / inertia_s
    start = np.zeros_like(drift)
    start[0, 0] = start_sigma_mm**2
    start[1:, 1:] = stationary_covariance(drift[1:, 1:], inner[1:])
    mean = np.zeros((len(drift), 1))
    still, pushed = mean.copy(), mean.copy()
    still[1], pushed[2] = 1.0, 1 / (tau_s * inertia_s)
    path = _component("inertial_path", drift, inner, start, acceleration=np.eye(len(drift))[2])
    return replace(path, input=pushed, start_from_input=still)


def forced_mass(
    acceleration_rms_mm_s2: float,
    *,
    force_hz: float = 60.0,
    start_sigma_mm: float = 100.0,
    start_sigma_mm_s: float = 1000.0,
) -> Component:
    """Return the process of a carriage under a smooth force.

    The acceleration is white noise through three equal poles at ``force_hz``. The states are
    position, velocity, acceleration and two more of the force. The force has to be smooth: if a
    prior had power above the sampling rate of an accelerometer, this power would be aliased into
    the sensor's band, and the readings would then carry almost no information.
    """
    _positive(acceleration_rms_mm_s2=acceleration_rms_mm_s2, force_hz=force_hz)
    cutoff = 2 * np.pi * force_hz
    force = np.diag([-cutoff] * 3) + np.diag([1.0, 1.0], 1)
    scaled = _scaled("force", force, np.array([1.0, 0.0, 0.0]), acceleration_rms_mm_s2)
    drift = np.diag([0.0, 0.0, -cutoff, -cutoff, -cutoff]) + np.diag([1.0] * 4, 1)
    noise = np.vstack([np.zeros((2, 1)), scaled.noise])
    start = np.diag([start_sigma_mm**2, start_sigma_mm_s**2, 0.0, 0.0, 0.0])
    start[2:, 2:] = scaled.start_covariance
    return _component("forced_mass", drift, noise, start, acceleration=[0.0, 0.0, 1.0, 0.0, 0.0])


def oscillator(rms_mm: float, frequency_hz: float, damping: float) -> Component:
    """Return a resonator driven by white noise, for a zigzag or a mode. Its states are displacement
    and velocity.

    damping : damping ratio.
    """
    _positive(rms_mm=rms_mm, frequency_hz=frequency_hz, damping=damping)
    w = 2 * np.pi * frequency_hz
    drift = np.array([[0.0, 1.0], [-(w**2), -2 * damping * w]])
    start = np.diag([rms_mm**2, (w * rms_mm) ** 2])
    return _component("oscillator", drift, [0.0, 2 * rms_mm * np.sqrt(damping * w**3)], start)


def driven_mode(
    rms_mm: float, frequency_hz: float, damping: float, *, force_hz: float = 60.0
) -> Component:
    """Return a vibration mode driven by a low-pass filtered force.

    The states are displacement, velocity, force and the rate of change of the force. The force is
    white noise through two equal poles (critical damping) at ``force_hz``.
    """
    _positive(rms_mm=rms_mm, frequency_hz=frequency_hz, damping=damping, force_hz=force_hz)
    w, f = 2 * np.pi * frequency_hz, 2 * np.pi * force_hz
    drift = np.zeros((4, 4))
    drift[0, 1] = drift[1, 2] = drift[2, 3] = 1.0
    drift[1, :2] = -(w**2), -2 * damping * w
    drift[3, 2:] = -(f**2), -2 * f
    return _scaled("driven_mode", drift, np.array([1.0, 0, 0, 0]), rms_mm)


def resonance(
    rms_mm: float, frequency_hz: float, damping: float, force_hz: float | None = None
) -> Component:
    """Return an `oscillator`, or a `driven_mode` if the cut-off ``force_hz`` of the force is
    given."""
    if force_hz is None:
        return oscillator(rms_mm, frequency_hz, damping)
    return driven_mode(rms_mm, frequency_hz, damping, force_hz=force_hz)


def broad_band(
    rms_mm: float,
    *,
    low_hz: float = 8.0,
    high_hz: float = 60.0,
    floor: float = 0.0,
    tail: int = 2,
) -> Component:
    """Return shake whose modes are unknown, with a broad spectrum and the given RMS.

    White noise passes the filter (s + floor a) / ((s + a)^3 (s + b)^tail), with a = 2 pi low_hz and
    b = 2 pi high_hz. The spectral density falls above low_hz, and steeply above high_hz. The
    accelerations are then as smooth as those under a force with two poles; otherwise accelerometers
    would carry almost no information. Below low_hz the density falls as well, to about floor^2
    times its peak. With floor = 0 it falls to zero, whereas a mode of little damping keeps its
    static compliance there.

    tail : number of poles at high_hz. There are 3 + tail states.
    """
    _positive(rms_mm=rms_mm, low_hz=low_hz, high_hz=high_hz)
    a, b = 2 * np.pi * low_hz, 2 * np.pi * high_hz
    size = 3 + tail
    chain = np.diag([-a] * 3 + [-b] * tail) + np.eye(size, k=1)
    return _scaled("broad_band", chain, chain[0] + floor * a * np.eye(size)[0], rms_mm)


def _scaled(name: str, drift: Array, position: Array, rms: float) -> Component:
    """Return a process that is driven at its last state, scaled such that its displacement has the
    RMS.

    position : (n,) row that gives the displacement from the state.
    """
    unit = np.zeros((len(drift), 1))
    unit[-1] = 1.0
    shape = stationary_covariance(drift, unit)
    gain = rms / np.sqrt(position @ shape @ position)
    velocity = position @ drift
    plain = _component(name, drift, unit * gain, shape * gain**2, acceleration=velocity @ drift)
    return replace(plain, position=position, velocity=velocity)


def slow_ou(rms: float, tau_s: float) -> Component:
    """Return an Ornstein-Uhlenbeck process with one state, for the slow drift of an arm (mm) or the
    wander of a centroid (px).

    It has no velocity, so accelerometers do not measure it.
    """
    _positive(rms=rms, tau_s=tau_s)
    return _component("slow_ou", [[-1 / tau_s]], [rms * np.sqrt(2 / tau_s)])


def independent(sigma: float) -> Component:
    """Return a process with one state that is independent at every time, with standard deviation
    sigma.

    It describes a position that is known only from its own reading.
    """
    _positive(sigma=sigma)
    plain = _component("independent", [[0.0]], [[0.0]], np.array([[sigma**2]]))
    return replace(plain, memoryless=True)


@dataclass(frozen=True)
class Steps:
    """Holds exact steps of N processes of equal kind, with n states and k inputs, over U lengths.

    which : (N,) indices of the processes in the caller's list.
    transition, covariance : (N, U, n, n) of each step.
    input : (N, U, n, k) effect of the inputs.
    start_covariance : (N, n, n) of the first state.
    """

    which: Ints
    transition: Array
    input: Array
    covariance: Array
    start_covariance: Array

    @cached_property
    def whitener(self) -> Array:
        """(N, U, n, n) W with W covariance W^T = identity."""
        return _inverse_root(self.covariance)

    @cached_property
    def log_det(self) -> Array:
        """(N, U) logarithm of the determinant of W."""
        return log_det_of(self.whitener)

    @cached_property
    def start(self) -> Array:
        """(N, n, n) whitening matrix of the first state."""
        return _inverse_root(self.start_covariance)

    @cached_property
    def start_log_det(self) -> Array:
        """(N,) logarithm of its determinant."""
        return log_det_of(self.start)

    def bases(self) -> Array:
        """Return well-conditioned bases T (N, U + 1, n, n) for the states x = T y of N processes.

        There is one basis for the state before a step of each of the U lengths, and a last one for
        a state after which there is no step. n : size of the state. Integrated noise has variances
        that differ by many powers of the step. In this basis the information from the next state
        together with that of the state's prior, Phi^T Q^-1 Phi + P^-1 (Phi transition, Q noise
        of the step, P prior covariance of the state), is the identity. The pivots
        of a forward elimination are then of order one, as a Cholesky factorisation in double
        precision needs.
        """
        count, lengths, size, _ = self.whitener.shape
        ahead = np.zeros((count, lengths + 1, size, size))
        ahead[:, :-1] = self.whitener @ self.transition
        prior = np.broadcast_to(self.start[:, None], ahead.shape)
        root = np.linalg.qr(np.concatenate([ahead, prior], -2), mode="r")
        return np.asarray(np.linalg.inv(root))


def distinct_steps(dt_s: ArrayLike) -> tuple[Array, Ints]:
    """Return the different lengths (U,) among the steps dt_s (M,), and the index (M,) of each
    step's length.

    Raises InputError for a length that is not positive.
    """
    return _distinct(np.atleast_1d(np.asarray(dt_s, float)).tobytes())


@lru_cache(maxsize=64)
def _distinct(dt_s: bytes) -> tuple[Array, Ints]:
    dt = np.frombuffer(dt_s)
    if dt.size and not np.min(dt) > 0:
        raise InputError("a time step is not positive", todo="give strictly increasing times")
    digits = np.round(dt * _STEPS_PER_S)
    _, first, index = np.unique(digits, return_index=True, return_inverse=True)
    return dt[first], index.ravel().astype(np.int64)


def discretise(
    components: Sequence[Component], lengths_s: Array, *, batched: bool = True
) -> list[Steps]:
    """Return the exact steps of processes for the lengths lengths_s (U,).

    batched : whether all processes of equal kind are computed in one batch, or each by itself.
    """
    kinds: dict[object, list[int]] = {}
    for i, component in enumerate(components):
        kinds.setdefault(_kind(component) if batched else i, []).append(i)
    return [_steps([components[i] for i in mine], mine, lengths_s) for mine in kinds.values()]


def _kind(component: Component) -> object:
    """Return a key that is equal for all processes that can be computed in one batch."""
    drift, noise = (a.astype(bool).tobytes() for a in (component.drift, component.noise))
    inputs = component.input.astype(bool).tobytes()
    return component.memoryless, inputs, _cached_orders(drift, noise, component.size)


@lru_cache(maxsize=64)
def _cached_orders(drift: bytes, noise: bytes, size: int) -> tuple[float, ...]:
    pattern = [np.frombuffer(b, bool).reshape(size, -1).astype(float) for b in (drift, noise)]
    return tuple(_integrations(*pattern).tolist())


def _steps(components: Sequence[Component], which: Sequence[int], lengths_s: Array) -> Steps:
    """Return the exact steps of processes of equal kind.

    which : indices of the processes in the caller's list.
    lengths_s : (U,) lengths of the steps.
    """
    n, k = components[0].input.shape
    shape = (len(components), len(lengths_s))
    begin = np.array([c.start_covariance for c in components])
    if components[0].memoryless:
        transition, q = np.zeros((*shape, n + k, n + k)), np.zeros((*shape, n + k, n + k))
        q[..., :n, :n] = begin[:, None]
    else:
        drift = np.zeros((len(components), n + k, n + k))
        drift[:, :n, :n] = [c.drift for c in components]
        drift[:, :n, n:] = [c.input for c in components]
        noise = np.zeros((len(components), n + k, components[0].noise.shape[1]))
        noise[:, :n] = [c.noise for c in components]
        orders = _integrations(drift[0], noise[0])
        drift, noise = (np.repeat(a, shape[1], 0) for a in (drift, noise))
        whole = _exact_steps(drift, noise, np.tile(lengths_s, shape[0]), orders)
        transition, q = (a.reshape(*shape, n + k, n + k) for a in whole)
    phi, by_input = transition[..., :n, :n], transition[..., :n, n:]
    return Steps(np.array(which), phi, by_input, q[..., :n, :n], begin)


def exact_step(drift: Array, noise: Array, dt_s: float | Array) -> tuple[Array, Array]:
    """Return the transition and the covariance, both (n, n), of x' = F x + L w over one step, or
    both (U, n, n) over steps of the lengths dt_s (U,).

    drift : (n, n) F.
    noise : (n, m) L.

    The covariance may be singular.
    """
    lengths = np.atleast_1d(np.asarray(dt_s, float))
    f, gain = (np.repeat(a[None], len(lengths), 0) for a in (drift, noise))
    transition, covariance = _exact_steps(f, gain, lengths, _integrations(drift, noise))
    return (transition, covariance) if np.ndim(dt_s) else (transition[0], covariance[0])


def _exact_steps(drift: Array, noise: Array, dt_s: Array, orders: Array) -> tuple[Array, Array]:
    """Return the transitions and covariances, both (M, n, n), of M steps.

    drift : (M, n, n).
    noise : (M, n, m).
    dt_s : (M,).
    orders : (n,) as `_integrations` gives them, the same for all steps.
    """
    rate = np.abs(np.linalg.eigvals(drift)).max(-1, initial=0.0)
    doublings = np.ceil(np.log2(np.maximum(rate * dt_s / _SHORT_STEP, 1.0))).astype(int)
    transition, q = _short_step(drift, noise, dt_s / 2.0**doublings, orders)
    for step in range(int(doublings.max(initial=0))):
        more = doublings > step
        phi = transition[more]
        q[more] += phi @ q[more] @ np.swapaxes(phi, -1, -2)
        transition[more] = phi @ phi
    return transition, (q + np.swapaxes(q, -1, -2)) / 2


def _short_step(drift: Array, noise: Array, h: Array, orders: Array) -> tuple[Array, Array]:
    """Return transitions and covariances by the series of Van Loan's matrix exponential.

    Each state is scaled by the power of the step h (M,) with which it grows.
    """
    n = drift.shape[-1]
    scale = h[:, None] ** orders
    ratio = scale[:, None, :] / scale[:, :, None]
    f = drift * h[:, None, None] * ratio
    q = (
        noise
        @ np.swapaxes(noise, -1, -2)
        * h[:, None, None]
        / scale[:, :, None]
        / scale[:, None, :]
    )
    block = np.zeros((len(h), 2 * n, 2 * n))
    block[:, :n, :n], block[:, :n, n:], block[:, n:, n:] = -f, q, np.swapaxes(f, -1, -2)
    total = np.broadcast_to(np.eye(2 * n), block.shape).copy()
    term = total.copy()
    for i in range(1, _SERIES_TERMS):
        term = term @ block / i
        total += term
    phi = np.swapaxes(total[:, n:, n:], -1, -2)
    covariance = phi @ total[:, :n, n:]
    return phi / ratio, covariance * scale[:, :, None] * scale[:, None, :]


def _integrations(drift: Array, noise: Array) -> Array:
    """Return for each state (n,) how many integrations lie between the white noise and the
    state."""
    orders = np.full(len(drift), np.nan)
    reached = np.abs(noise).sum(1)
    for order in range(len(orders)):
        orders[np.isnan(orders) & (reached > 0)] = order
        reached = np.abs(drift) @ reached
    return np.asarray(np.nan_to_num(orders, nan=0.0))


def _inverse_root(covariance: Array) -> Array:
    """Return lower triangular matrices W (..., n, n) with W C W^T = identity, for covariances C.

    The covariances are scaled first, so that small variances keep their digits.
    """
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    scaled = covariance / sigma[..., :, None] / sigma[..., None, :]
    root = np.linalg.cholesky(scaled)
    unit = np.broadcast_to(np.eye(root.shape[-1]), root.shape)
    return np.asarray(np.tril(np.linalg.solve(root, unit)) / sigma[..., None, :])


def whitener_of(covariance: Array) -> Array:
    """Return lower triangular matrices W (..., n, n) with W covariance W^T = identity.

    Raises LinAlgError if a covariance is singular.
    """
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def log_det_of(whitener: Array) -> Array:
    """Return the logarithm (...) of the determinant of triangular matrices (..., n, n)."""
    return np.asarray(np.log(np.abs(np.diagonal(whitener, axis1=-2, axis2=-1))).sum(-1))


def block_diagonal(blocks: Sequence[Array]) -> Array:
    """Return matrices (..., sum of a, sum of b) with the given blocks (..., a, b) on the
    diagonal."""
    rows, columns = (sum(b.shape[axis] for b in blocks) for axis in (-2, -1))
    batch = np.broadcast_shapes(*(b.shape[:-2] for b in blocks)) if blocks else ()
    out = np.zeros((*batch, rows, columns))
    i = j = 0
    for block in blocks:
        a, b = block.shape[-2:]
        out[..., i : i + a, j : j + b] = block
        i, j = i + a, j + b
    return out
