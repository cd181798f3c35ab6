"""Linear stochastic processes of bubbles and rig, and their exact discretisation.

Every process is x' = F x + B c + L w, with w white noise of unit two-sided density and c constants
(a bubble's mean velocity). A step of any length is exact: Van Loan's matrix exponential (IEEE
Trans. Autom. Control 23:395, 1978) over a short step, doubled as often as the step needs, so that
neither a long gap nor the tiny variance of an often integrated noise loses digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Ints
from telerig.errors import InputError

_SERIES_TERMS = 26
_SHORT_STEP = 0.5
"""Largest eigenvalue times step over which the exponential's series is summed."""
_STEPS_PER_S = 1e11
"""Clocks printed to a nanosecond jitter in the last digit; that makes no new length of step."""


@dataclass(frozen=True, eq=False)
class Component:
    """One process. Lengths in mm (or px, rad: the caller's), time in s.

    drift : (n, n) F.  noise : (n, m) L.  start_covariance : (n, n) at the first node.
    position, velocity, acceleration : (n,) rows that read these from the state; an acceleration
        that does not exist (white noise drives the velocity) is 0.
    input : (n, k) B.  start_from_input : (n, k), the state's mean at the start for constants c.
    memoryless : the state is drawn anew at every node, from start_covariance.
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
        return len(self.drift)

    @property
    def jerk(self) -> Array:
        """(n,) the acceleration's rate of change, its white part (if any) left out."""
        return np.asarray(self.acceleration @ self.drift)

    def without_input(self) -> Component:
        """The same process about a mean that is known."""
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
    """States (displacement, velocity, ...); start None: stationary."""
    f = np.atleast_2d(np.asarray(drift, float))
    n = len(f)
    gain = np.asarray(noise, float).reshape(n, -1)
    rows = np.eye(max(n, 2))[:2, :n]
    covariance = stationary_covariance(f, gain) if start is None else start
    still = np.zeros(n) if acceleration is None else np.asarray(acceleration, float)
    nothing = np.zeros((n, 0))
    return Component(name, f, gain, covariance, rows[0], rows[1], still, nothing, nothing)


def stationary_covariance(drift: Array, noise: Array) -> Array:
    """(n, n) P with F P + P F^T + L L^T = 0. Raises InputError for an unstable process."""
    from scipy.linalg import solve_continuous_lyapunov

    if np.max(np.linalg.eigvals(drift).real) >= 0:
        raise InputError("a motion without damping has no stationary state", todo="damp it")
    covariance = solve_continuous_lyapunov(drift, -noise @ noise.T)
    return np.asarray((covariance + covariance.T) / 2)


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} is {value}", todo="give a positive number")


def ou_velocity(sigma_mm_s: float, tau_s: float, *, start_sigma_mm: float = 100.0) -> Component:
    """States (position, velocity): a velocity about a constant mean that forgets within tau.

    v' = (U - v) / tau + noise, v - U of RMS sigma; U is the input. Starts at position 0 within
    start_sigma, its velocity stationary about U.
    """
    _positive(sigma_mm_s=sigma_mm_s, tau_s=tau_s, start_sigma_mm=start_sigma_mm)
    drift = np.array([[0.0, 1.0], [0.0, -1 / tau_s]])
    start = np.diag([start_sigma_mm**2, sigma_mm_s**2])
    plain = _component("ou_velocity", drift, [0.0, sigma_mm_s * np.sqrt(2 / tau_s)], start)
    return replace(
        plain, input=np.array([[0.0], [1 / tau_s]]), start_from_input=np.array([[0.0], [1.0]])
    )


def forced_mass(
    acceleration_rms_mm_s2: float,
    *,
    corner_hz: float = 60.0,
    start_sigma_mm: float = 100.0,
    start_sigma_mm_s: float = 1000.0,
) -> Component:
    """A carriage under a smooth force: its acceleration is white noise through three equal poles.

    States (position, velocity, acceleration and two more of the force). Smooth on
    purpose: a prior's power above a sensor's sampling rate is aliased into the sensor's band and
    makes an accelerometer worthless.
    """
    _positive(acceleration_rms_mm_s2=acceleration_rms_mm_s2, corner_hz=corner_hz)
    cutoff = 2 * np.pi * corner_hz
    force = np.diag([-cutoff] * 3) + np.diag([1.0, 1.0], 1)
    scaled = _scaled("force", force, np.array([1.0, 0.0, 0.0]), acceleration_rms_mm_s2)
    drift = np.diag([0.0, 0.0, -cutoff, -cutoff, -cutoff]) + np.diag([1.0] * 4, 1)
    noise = np.vstack([np.zeros((2, 1)), scaled.noise])
    start = np.diag([start_sigma_mm**2, start_sigma_mm_s**2, 0.0, 0.0, 0.0])
    start[2:, 2:] = scaled.start_covariance
    return _component("forced_mass", drift, noise, start, acceleration=[0.0, 0.0, 1.0, 0.0, 0.0])


def oscillator(rms_mm: float, frequency_hz: float, damping: float) -> Component:
    """States (displacement, velocity) of a resonator driven by white noise: zigzag, rough mode."""
    _positive(rms_mm=rms_mm, frequency_hz=frequency_hz, damping=damping)
    w = 2 * np.pi * frequency_hz
    drift = np.array([[0.0, 1.0], [-(w**2), -2 * damping * w]])
    start = np.diag([rms_mm**2, (w * rms_mm) ** 2])
    return _component("oscillator", drift, [0.0, 2 * rms_mm * np.sqrt(damping * w**3)], start)


def driven_mode(
    rms_mm: float, frequency_hz: float, damping: float, *, force_hz: float = 60.0
) -> Component:
    """States (displacement, velocity, force, force's slope) of one degree of freedom.

    The force is white noise through two critically damped poles at force_hz.
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
    """An `oscillator`, or with a low-pass filtered force a `driven_mode`."""
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
    """Shake of unknown modes: (s + floor a) / ((s + a)^3 (s + b)^tail) of white noise, given RMS.

    A density that falls from low_hz (a) on and steeply from high_hz (b) on: accelerations as
    smooth as a force through two poles makes them, without which accelerometers are of no use.
    Below low_hz it falls too, to floor^2 of about the peak: to nothing at floor 0, while a mode of
    little damping keeps a compliance there. Three states and ``tail``, one for each pole.
    """
    _positive(rms_mm=rms_mm, low_hz=low_hz, high_hz=high_hz)
    a, b = 2 * np.pi * low_hz, 2 * np.pi * high_hz
    size = 3 + tail
    chain = np.diag([-a] * 3 + [-b] * tail) + np.eye(size, k=1)
    return _scaled("broad_band", chain, chain[0] + floor * a * np.eye(size)[0], rms_mm)


def broad_band_density(
    frequency_hz: Array,
    rms_mm: float,
    *,
    low_hz: float,
    high_hz: float,
    floor: float,
    tail: int = 2,
) -> Array:
    """(N,) one-sided density (mm^2 / Hz) of `broad_band` at the frequencies (N,)."""
    a, b = low_hz, high_hz

    def shape(f: Array) -> Array:
        f2 = f * f
        return (f2 + (floor * a) ** 2) / ((f2 + a * a) ** 3 * (f2 + b * b) ** tail)

    whole = np.concatenate([[0.0], np.geomspace(1e-3 * a, 1e2 * b, 2000)])
    density: Array = rms_mm**2 * shape(frequency_hz) / np.trapezoid(shape(whole), whole)
    return density


def _scaled(name: str, drift: Array, position: Array, rms: float) -> Component:
    """A process driven at its last state, its displacement ``position`` scaled to the RMS."""
    unit = np.zeros((len(drift), 1))
    unit[-1] = 1.0
    shape = stationary_covariance(drift, unit)
    gain = rms / np.sqrt(position @ shape @ position)
    velocity = position @ drift
    plain = _component(name, drift, unit * gain, shape * gain**2, acceleration=velocity @ drift)
    return replace(plain, position=position, velocity=velocity)


def slow_ou(rms: float, tau_s: float) -> Component:
    """One state that forgets within tau: slow drift of an arm, wander of a centroid (in px).

    Too rough to have a velocity: accelerometers do not measure it.
    """
    _positive(rms=rms, tau_s=tau_s)
    return _component("slow_ou", [[-1 / tau_s]], [rms * np.sqrt(2 / tau_s)])


def independent(sigma: float) -> Component:
    """One state, drawn anew at every node: a position known from its own reading alone."""
    _positive(sigma=sigma)
    plain = _component("independent", [[0.0]], [[0.0]], np.array([[sigma**2]]))
    return replace(plain, memoryless=True)


@dataclass(frozen=True)
class Steps:
    """Exact steps of N processes alike in kind, of n states and k inputs, over U lengths.

    which : (N,) their places in the list of processes.
    transition, covariance : (N, U, n, n).  input : (N, U, n, k).
    whitener : (N, U, n, n) W with W covariance W^T = 1.  log_det : (N, U) of W.
    start : (N, n, n) whitener of the state at the first node.  start_log_det : (N,).
    """

    which: Ints
    transition: Array
    input: Array
    covariance: Array
    whitener: Array
    log_det: Array
    start: Array
    start_log_det: Array

    def bases(self) -> Array:
        """(N, U + 1, n, n) bases T, x = T y, of a state before each step, last one: before none.

        Integrated noise has variances many powers of the step apart. In this basis the information
        of the next state and of the prior on a state, Phi^T Q^-1 Phi + P^-1, is the identity: the
        pivots of a forward elimination are of order one, as Cholesky in double precision needs.
        """
        count, lengths, size, _ = self.whitener.shape
        ahead = np.zeros((count, lengths + 1, size, size))
        ahead[:, :-1] = self.whitener @ self.transition
        prior = np.broadcast_to(self.start[:, None], ahead.shape)
        root = np.linalg.qr(np.concatenate([ahead, prior], -2), mode="r")
        return np.asarray(np.linalg.inv(root))


def distinct_steps(dt_s: ArrayLike) -> tuple[Array, Ints]:
    """Distinct lengths (U,) of steps dt_s (M,), and (M,) which of them each is.

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
    """Exact steps of lengths_s (U,), of components of one kind in one batch or each by itself."""
    kinds: dict[object, list[int]] = {}
    for i, component in enumerate(components):
        kinds.setdefault(_kind(component) if batched else i, []).append(i)
    return [_steps([components[i] for i in mine], mine, lengths_s) for mine in kinds.values()]


def _kind(component: Component) -> object:
    """Alike for processes that one batch can hold."""
    drift, noise = (a.astype(bool).tobytes() for a in (component.drift, component.noise))
    inputs = component.input.astype(bool).tobytes()
    return component.memoryless, inputs, _cached_orders(drift, noise, component.size)


@lru_cache(maxsize=64)
def _cached_orders(drift: bytes, noise: bytes, size: int) -> tuple[float, ...]:
    pattern = [np.frombuffer(b, bool).reshape(size, -1).astype(float) for b in (drift, noise)]
    return tuple(_integrations(*pattern).tolist())


def _steps(components: Sequence[Component], which: Sequence[int], lengths_s: Array) -> Steps:
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
    covariance = q[..., :n, :n]
    whitener, first = _inverse_root(covariance), _inverse_root(begin)
    return Steps(
        np.array(which), transition[..., :n, :n], transition[..., :n, n:], covariance,
        whitener, log_det_of(whitener), first, log_det_of(first),
    )  # fmt: skip


def exact_step(drift: Array, noise: Array, dt_s: float) -> tuple[Array, Array]:
    """(n, n) transition and covariance of x' = F x + L w over one step.

    drift : (n, n) F.  noise : (n, m) L.  The covariance may be singular.
    """
    transition, covariance = _exact_steps(
        drift[None], noise[None], np.array([dt_s]), _integrations(drift, noise)
    )
    return transition[0], covariance[0]


def _exact_steps(drift: Array, noise: Array, dt_s: Array, orders: Array) -> tuple[Array, Array]:
    """Transitions and covariances (M, n, n) of steps dt_s (M,); drift (M, n, n), noise (M, n, m).

    orders : (n,) see `_integrations`, the same for all.
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
    """Van Loan's exponential by its series, states scaled by the powers of h they grow with."""
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
    """(n,) how many integrations lie between the white noise and each state."""
    orders = np.full(len(drift), np.nan)
    reached = np.abs(noise).sum(1)
    for order in range(len(orders)):
        orders[np.isnan(orders) & (reached > 0)] = order
        reached = np.abs(drift) @ reached
    return np.asarray(np.nan_to_num(orders, nan=0.0))


def _inverse_root(covariance: Array) -> Array:
    """(..., n, n) lower W with W C W^T = 1, scaled so that small variances keep their digits."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    scaled = covariance / sigma[..., :, None] / sigma[..., None, :]
    root = np.linalg.cholesky(scaled)
    unit = np.broadcast_to(np.eye(root.shape[-1]), root.shape)
    return np.asarray(np.tril(np.linalg.solve(root, unit)) / sigma[..., None, :])


def whitener_of(covariance: Array) -> Array:
    """(..., n, n) lower W with W covariance W^T = 1. Raises LinAlgError for a singular one."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def log_det_of(whitener: Array) -> Array:
    """(...) log of the determinant of triangular whiteners (..., n, n)."""
    return np.asarray(np.log(np.abs(np.diagonal(whitener, axis1=-2, axis2=-1))).sum(-1))


def block_diagonal(blocks: Sequence[Array]) -> Array:
    """Blocks (..., a, b), batch axes alike, into one (..., sum a, sum b)."""
    rows, columns = (sum(b.shape[axis] for b in blocks) for axis in (-2, -1))
    batch = np.broadcast_shapes(*(b.shape[:-2] for b in blocks)) if blocks else ()
    out = np.zeros((*batch, rows, columns))
    i = j = 0
    for block in blocks:
        a, b = block.shape[-2:]
        out[..., i : i + a, j : j + b] = block
        i, j = i + a, j + b
    return out
