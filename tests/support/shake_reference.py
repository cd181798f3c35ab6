"""An independent smoother of the vertical axis, and what is exactly possible in each scenario.

It shares no code with the product. Processes x' = F x + L w are discretised by the power series of
the noise integral, started at the stationary covariance that doubling the step converges to, and
smoothed by a Kalman filter (scalar updates) with the modified Bryson-Frazier backward pass
(Bierman, Factorization Methods, 1977, ch. X), which inverts no matrix. ``real`` is the precision
of that: double and extended agree to 1e-10. Heights in mm, upwards; times in s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]
REAL = np.longdouble
_TERMS = 30


@dataclass(frozen=True)
class Part:
    """One process: drift (n, n), noise (n,), start (n, n) its covariance at the first node.

    reads : rows (n,) of "position", "velocity", "acceleration", "value".
    anew : drawn from ``start`` at every node.
    """

    drift: Array
    noise: Array
    start: Array
    reads: Mapping[str, Array]
    anew: bool = False


def _chain(*rows: Sequence[float]) -> Array:
    return np.array(rows, REAL)


def _short(drift: Array, noise: Array, h: float) -> tuple[Array, Array]:
    """Transition and noise covariance of a step with |F| h < 1, term by term.

    Q = sum_ij F^i L L' F'^j h^(i+j+1) / (i! j! (i+j+1)).
    """
    n = len(drift)
    powers, vectors = np.eye(n, dtype=REAL), [noise.astype(REAL)]
    phi = powers.copy()
    for i in range(1, _TERMS):
        powers = powers @ drift * (REAL(h) / i)
        phi = phi + powers
        vectors.append(drift @ vectors[-1] * (REAL(h) / i))
    q = np.zeros((n, n), REAL)
    for i, a in enumerate(vectors):
        for j, b in enumerate(vectors):
            q += np.outer(a, b) * (REAL(h) / (i + j + 1))
    return phi, q


def discretised(part: Part, h: float) -> tuple[Array, Array]:
    """(n, n) transition and (n, n) noise covariance of a step of length h."""
    n = len(part.drift)
    if part.anew:
        return np.zeros((n, n), REAL), part.start.astype(REAL)
    rate = max(np.max(np.abs(np.linalg.eigvals(part.drift.astype(float)))), 1e-9)
    doublings = max(0, int(np.ceil(np.log2(rate * h / 0.25))))
    phi, q = _short(part.drift, part.noise, h / 2**doublings)
    for _ in range(doublings):
        phi, q = phi @ phi, q + phi @ q @ phi.T
    return phi, q


def settled(drift: Array, noise: Array) -> Array:
    """(n, n) stationary covariance: the noise of a step that is doubled until all is forgotten."""
    rate = np.max(np.abs(np.linalg.eigvals(drift.astype(float))))
    phi, q = _short(drift, noise, 0.25 / rate)
    for _ in range(200):
        phi, q = phi @ phi, q + phi @ q @ phi.T
        if np.max(np.abs(phi)) < 1e-30:
            break
    return q


def _stationary(drift: Array, noise: Array, position: Array, rms: float, smooth: bool) -> Part:
    gain = REAL(rms) / np.sqrt(position @ settled(drift, noise) @ position)
    velocity = position @ drift
    reads = {"position": position, "velocity": velocity}
    if smooth:
        reads["acceleration"] = velocity @ drift
    return Part(drift, noise * gain, settled(drift, noise * gain), reads)


def constant(sigma: float) -> Part:
    row = np.ones(1, REAL)
    return Part(np.zeros((1, 1), REAL), 0 * row, _chain([sigma**2]), {"value": row})


def reading(sigma: float) -> Part:
    """A height that is anew at every node: known only from what reads it."""
    row = np.ones(1, REAL)
    zero = {"velocity": 0 * row, "acceleration": 0 * row}
    return Part(
        np.zeros((1, 1), REAL), 0 * row, _chain([sigma**2]), {"position": row, **zero}, True
    )


def rising(sigma: float, tau_s: float, start_mm: float, mean_mm_s: float) -> Part:
    """States height, velocity, mean velocity: an Ornstein-Uhlenbeck velocity about the mean."""
    drift = _chain([0, 1, 0], [0, -1 / REAL(tau_s), 1 / REAL(tau_s)], [0, 0, 0])
    start = np.diag(np.array([start_mm**2, sigma**2 + mean_mm_s**2, mean_mm_s**2], REAL))
    start[1, 2] = start[2, 1] = mean_mm_s**2
    noise = np.array([0, sigma * np.sqrt(2 / REAL(tau_s)), 0], REAL)
    eye = np.eye(3, dtype=REAL)
    return Part(drift, noise, start, {"position": eye[0], "velocity": eye[1]})


def resonator(rms: float, hz: float, damping: float) -> Part:
    """States displacement, velocity, driven by white noise."""
    w = 2 * REAL(np.pi) * hz
    drift = _chain([0, 1], [-(w**2), -2 * damping * w])
    return _stationary(drift, _chain([0, 1])[0], _chain([1, 0])[0], rms, False)


def mode(rms: float, hz: float, damping: float, force_hz: float = 60.0) -> Part:
    """States displacement, velocity, force, slope: the force is white through two equal poles."""
    w, f = 2 * REAL(np.pi) * hz, 2 * REAL(np.pi) * force_hz
    drift = _chain([0, 1, 0, 0], [-(w**2), -2 * damping * w, 1, 0], [0, 0, 0, 1], [0, 0, 0, 0])
    drift[3, 2:] = -(f**2), -2 * f
    return _stationary(drift, _chain([0, 0, 0, 1])[0], _chain([1, 0, 0, 0])[0], rms, True)


def broad(rms: float, low_hz: float, high_hz: float) -> Part:
    """Density of s / ((s + a)^2 (s + b)^3): shake of unknown modes."""
    a, b = 2 * REAL(np.pi) * low_hz, 2 * REAL(np.pi) * high_hz
    drift = np.diag(np.array([-b, -b, -b, -a, -a], REAL)) + np.diag(np.ones(4, REAL), -1)
    unit = np.eye(5, dtype=REAL)
    # the last state is 1 / (..) of the noise; its derivative is the state before less a times it
    return _stationary(drift, unit[0], drift[4], rms, True)


def carriage(
    acceleration_rms: float, corner_hz: float, start_mm: float = 100.0, start_mm_s: float = 1000.0
) -> Part:
    """Height, velocity and an acceleration that is white through three equal poles."""
    b = 2 * REAL(np.pi) * corner_hz
    force = np.diag(np.array([-b] * 3, REAL)) + np.diag(np.ones(2, REAL), 1)
    unit = np.eye(3, dtype=REAL)
    part = _stationary(force, unit[2], unit[0], acceleration_rms, False)
    drift = np.zeros((5, 5), REAL)
    drift[0, 1] = drift[1, 2] = 1
    drift[2:, 2:] = force
    start = np.diag(np.array([start_mm**2, start_mm_s**2, 0, 0, 0], REAL))
    start[2:, 2:] = part.start
    eye = np.eye(5, dtype=REAL)
    reads = {"position": eye[0], "velocity": eye[1], "acceleration": eye[2]}
    return Part(drift, np.r_[np.zeros(2, REAL), part.noise], start, reads)


class Model:
    """Independent parts side by side, by name."""

    def __init__(self, parts: Mapping[str, Part]) -> None:
        self.parts = dict(parts)
        edges = np.cumsum([0, *(len(p.drift) for p in self.parts.values())])
        self.at = {name: slice(a, b) for name, a, b in zip(self.parts, edges, edges[1:])}
        self.size = int(edges[-1])

    def read(self, what: str, *names: str) -> Array:
        """(D,) the row that reads the sum of a quantity of some parts."""
        row = np.zeros(self.size, REAL)
        for name in names:
            row[self.at[name]] += self.parts[name].reads[what]
        return row

    def start(self) -> Array:
        out = np.zeros((self.size, self.size), REAL)
        for name, part in self.parts.items():
            out[self.at[name], self.at[name]] = part.start
        return out

    def step(self, h: float, renewed: Sequence[str] = ()) -> tuple[Array, Array]:
        """Transition and noise of a step; parts in ``renewed`` are drawn anew at its end."""
        phi, q = np.zeros((2, self.size, self.size), REAL)
        for name, part in self.parts.items():
            place = self.at[name]
            if name in renewed:
                q[place, place] = part.start
            else:
                phi[place, place], q[place, place] = discretised(part, h)
        return phi, q


@dataclass
class Readings:
    """Scalar readings row . x = value + noise, of any number of data sets (columns) at once."""

    node: list[int] = field(default_factory=list)
    row: list[Array] = field(default_factory=list)
    value: list[Array] = field(default_factory=list)
    sigma: list[float] = field(default_factory=list)

    def add(self, nodes: ArrayLike, row: Array, values: ArrayLike, sigma: ArrayLike) -> None:
        """One row read at nodes (M,): values (M,) or (M, S) of S data sets, sigma (M,) or one."""
        at = np.asarray(nodes, int).tolist()
        rows = np.asarray(values, REAL).reshape(len(at), -1)
        self.node += at
        self.row += [row] * len(at)
        self.value += list(rows)
        self.sigma += np.broadcast_to(np.asarray(sigma, float), (len(at),)).tolist()


@dataclass(frozen=True)
class Posterior:
    """At the wanted nodes: mean (W, D, S) of S data sets, covariance (W, D, D)."""

    mean: Array
    covariance: Array

    def of(self, row: Array) -> tuple[Array, Array]:
        """Means (W, S) and standard deviations (W,) of row . x."""
        mean = np.einsum("d,wds->ws", row, self.mean).astype(float)
        variance = np.einsum("d,wde,e->w", row, self.covariance, row)
        return mean, np.sqrt(variance.astype(float))


def smooth(
    model: Model,
    times_s: ArrayLike,
    readings: Readings,
    wanted: ArrayLike,
    *,
    start_mean: Array | None = None,
    renewed: Mapping[int, Sequence[str]] | None = None,
    real: type = np.float64,
) -> Posterior:
    """Kalman filter and modified Bryson-Frazier smoother over nodes at times_s (N,).

    wanted : nodes of the result.  start_mean : (D,).  renewed : parts drawn anew at a node.
    """
    times = np.asarray(times_s, float)
    sets = len(readings.value[0]) if readings.value else 1
    order = np.argsort(readings.node, kind="stable")
    edges = np.searchsorted(np.asarray(readings.node)[order], np.arange(len(times) + 1))
    p = model.start().astype(real)
    x = np.zeros((model.size, sets), real)
    if start_mean is not None:
        x += np.asarray(start_mean, real)[:, None]
    known: dict[tuple[int, tuple[str, ...]], tuple[Array, Array]] = {}
    steps: list[Array] = []
    updates: list[list[tuple[Array, Array, Array, Array]]] = []
    filtered: dict[int, tuple[Array, Array]] = {}
    keep = set(np.asarray(wanted, int).tolist())
    for n in range(len(times)):
        if n:
            h = float(times[n] - times[n - 1])
            fresh = tuple((renewed or {}).get(n, ()))
            key = (round(h * 1e12), fresh)
            if key not in known:
                phi, q = model.step(h, fresh)
                known[key] = phi.astype(real), q.astype(real)
            phi, q = known[key]
            x, p = phi @ x, phi @ p @ phi.T + q
            steps.append(phi)
        here = []
        for i in order[edges[n] : edges[n + 1]]:
            row = readings.row[i].astype(real)
            ph = p @ row
            s = row @ ph + real(readings.sigma[i]) ** 2
            gain, off = ph / s, readings.value[i].astype(real) - row @ x
            x = x + np.outer(gain, off)
            p = p - np.outer(gain, ph)
            p = (p + p.T) / 2
            here.append((row, gain, s, off))
        updates.append(here)
        if n in keep:
            filtered[n] = x, p
    return _backward(model.size, sets, steps, updates, filtered, wanted, real)


def _backward(
    size: int,
    sets: int,
    steps: list[Array],
    updates: list[list[tuple[Array, Array, Array, Array]]],
    filtered: dict[int, tuple[Array, Array]],
    wanted: ArrayLike,
    real: type,
) -> Posterior:
    big, small = np.zeros((size, size), real), np.zeros((size, sets), real)
    means, covariances = {}, {}
    for n in range(len(updates) - 1, -1, -1):
        if n in filtered:
            x, p = filtered[n]
            means[n], covariances[n] = x - p @ small, p - p @ big @ p
        for row, gain, s, off in reversed(updates[n]):
            # C' big C + row row' / s with C = 1 - gain row'
            bg = big @ gain
            cross = np.outer(bg, row)
            big = big - cross - cross.T + np.outer(row, row) * (gain @ bg + 1 / s)
            small = small - np.outer(row, gain @ small) - np.outer(row, off / s)
        if n:
            phi = steps[n - 1]
            big, small = phi.T @ big @ phi, phi.T @ small
    nodes = np.asarray(wanted, int).tolist()
    return Posterior(np.array([means[n] for n in nodes]), np.array([covariances[n] for n in nodes]))
