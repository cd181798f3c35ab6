"""Grades what a run is usable for: quantities of the bubbles with their standard deviations.

A run can be usable although the verdict is bad: with 0.5 mm of unknown shake in every position,
the mean velocity over a second is still known to a few mm/s. Standard deviations of means, spectra
and amplitudes come from draws of the posterior, which contain its correlation in time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from telerig.arrays import Array
from telerig.estimator.physics.oscillation import zigzag
from telerig.estimator.smoothing.graph.draws import DRAWS, Draws
from telerig.estimator.smoothing.graph.layout import variances
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.graph.stage_travel import considered_variance, offset_sigma
from telerig.io.results.smoothing import Grade, Quantity, Use
from telerig.io.tables.smoothing import AXES

GOOD, LIMITED = 10.0, 3.0
"""Signal over standard deviation from which a quantity is called good, or limited."""
_UPRIGHT = 0.5
"""Cosine to the vertical from which a rig axis has no zigzag."""
_MOST_BUBBLES, _LEAST_FRAMES = 5, 20
_CLEAR_POWER = 9.0


def uses(
    solution: Solution, draws: Draws, inflation: Sequence[float] = (1.0, 1.0, 1.0)
) -> list[Use]:
    """Return velocity, path, place, acceleration and zigzag with sd and grade, by axis.

    The list is empty without bubbles or covariances.

    draws : random draws at the solution.
    inflation : (3,) factors of the standard deviations. If one is above 1, no grade is better than
        LIMITED.
    """
    graph = solution.graph
    if solution.covariances is None or not graph.rows:
        return []
    lengths = np.diff(graph.first_row)
    most = _MOST_BUBBLES * max(1, DRAWS // draws.errors.shape[-1])
    chosen = np.argsort(-lengths, kind="stable")[:most]
    chosen = chosen[lengths[chosen] >= _LEAST_FRAMES]
    if not len(chosen):
        return []
    widen = np.asarray(inflation)
    errors, place, speed = draws.of_family(graph, "bubbles"), *considered_variance(solution)
    whole = solution.velocity_variances() + speed
    shared = offset_sigma(solution)
    paths = [_Path(solution, errors, (place, speed, whole, shared), int(b), widen) for b in chosen]
    best = Grade.LIMITED if np.any(widen > 1) else Grade.GOOD
    out = []
    for axis in range(3):
        for use in _of_axis(solution, paths, axis):
            order = list(Grade)
            grade = max(use.grade, best, key=order.index)
            out.append(use.model_copy(update={"grade": grade}))
    return out


class _Path:
    """One bubble: times (n,), positions and velocities (n, 3), K draws of the positions' errors (n,
    3, K), and its zigzag across the vertical.
    """

    def __init__(
        self, solution: Solution, errors: Array, known: tuple[Array, ...], bubble: int, widen: Array
    ) -> None:
        """Collect a bubble's states.

        errors : (rows, d, K) draws of the errors of all bubbles.
        known : variances (rows, 3) by encoder and travel axis of places and velocities, and all
            those of velocities; and standard deviation (3,) of an offset of all places.
        widen : (3,) factors of the standard deviations.
        """
        graph, found = solution.graph, solution.covariances
        assert found is not None
        rows = np.arange(graph.first_row[bubble], graph.first_row[bubble + 1])
        states = solution.state.bubbles[rows]
        self.rows, self.widen = rows, widen
        self.t_s = graph.problem.t_s[graph.frame_of_row[rows]]
        place, speed, whole = (variance[rows] for variance in known[:3])
        row = graph.bubble.position
        drawn = graph.bubble_basis(rows) @ errors[rows]
        error = np.einsum("id,ndk->nik", row, drawn)
        variance = variances(row, found.bubbles[rows])
        scale = np.sqrt(variance.mean(0) / (error**2).mean((0, 2)).clip(1e-300))
        self.errors = error * (scale * widen)[None, :, None]
        self.place = states @ row.T
        self.place_sd = np.hypot(np.sqrt(variance + place) * widen, known[3])
        self.speed = solution.velocities_mm_s[rows]
        self.speed_sd = np.sqrt(whole) * widen
        self.mean_speed_variance = speed.mean(0) * widen**2
        self.lateral = np.flatnonzero(np.abs(graph.problem.up) <= _UPRIGHT)
        turned = np.einsum("id,ndk->nik", graph.bubble.velocity, drawn) * widen[:, None]
        self.zigzag = zigzag(
            self.t_s, self.speed[:, self.lateral],
            turned[:, self.lateral].reshape(len(rows), -1),
        )  # fmt: skip

    @property
    def span_s(self) -> float:
        return float(self.t_s[-1] - self.t_s[0])

    def spectrum(self, values: Array) -> tuple[Array, Array]:
        """Return frequencies (F,) and power (F, ...) of values (n, ...) after removing linear
        trends.
        """
        from scipy.signal import detrend

        step = float(np.median(np.diff(self.t_s)))
        taper = np.hanning(len(values)).reshape(-1, *[1] * (values.ndim - 1))
        level = np.asarray(detrend(values, axis=0)) * taper
        power = np.abs(np.fft.rfft(level, axis=0)) ** 2 / (taper**2).sum() / len(values) * 2
        return np.asarray(np.fft.rfftfreq(len(values), step)), np.asarray(power)


def _of_axis(solution: Solution, paths: Sequence[_Path], axis: int) -> Iterator[Use]:
    problem = solution.graph.problem
    along = abs(float(problem.axis[axis])) > 0.5 and problem.stage is not None
    assumes = ("encoder",) if along and not len(problem.references) else ()
    name = AXES[axis]

    def use(quantity: Quantity, found: Sequence[tuple[float, float]], unit: str) -> Use:
        value, sd = (float(np.median(column)) for column in zip(*found))
        return Use(
            quantity=quantity, axis=name, value=value, sd=sd, unit=unit,
            grade=grade_of(value, sd), assumes=assumes,
        )  # fmt: skip

    yield use(Quantity.MEAN_VELOCITY, [_mean_velocity(p, axis) for p in paths], "mm/s")
    yield use(
        Quantity.VELOCITY,
        [(_rms(p.speed[:, axis]), _rms(p.speed_sd[:, axis])) for p in paths], "mm/s",
    )  # fmt: skip
    below = float(np.median([_clear_hz(p, axis) for p in paths]))
    moved = solution.accelerations
    if moved is not None:
        value, sd = moved.value_mm_s2[:, axis], moved.sd_mm_s2[:, axis]
        each = [(_rms(value[p.rows]), _rms(sd[p.rows]) * p.widen[axis]) for p in paths]
        acceleration = use(Quantity.ACCELERATION, each, "mm/s^2")
        yield acceleration.model_copy(update={"below_hz": float(moved.bandwidth_hz[axis]) or None})
    path = use(Quantity.PATH, [_band_rms(p, axis, below) for p in paths], "mm")
    if not below:
        path = path.model_copy(update={"grade": Grade.NO})
    yield path.model_copy(update={"below_hz": below or None})
    each = [(_band_rms(p, axis, 0.0)[0], _rms(p.place_sd[:, axis])) for p in paths]
    yield use(Quantity.PLACE, each, "mm")
    swings = [
        (z.frequency_hz, z.s_frequency_hz, float(z.amplitudes[p.lateral == axis][0]), z.s_major)
        for p in paths
        if (z := p.zigzag) is not None and axis in p.lateral
    ]
    if swings:
        hz, hz_sd, mm, mm_sd = zip(*swings, strict=True)
        yield use(Quantity.ZIGZAG_AMPLITUDE, list(zip(mm, mm_sd)), "mm")
        yield use(Quantity.ZIGZAG_FREQUENCY, list(zip(hz, hz_sd)), "Hz")


def grade_of(value: float, sd: float) -> Grade:
    """Return the grade for the ratio of a value to its standard deviation."""
    ratio = abs(value) / sd if sd > 0 else np.inf
    return Grade.GOOD if ratio >= GOOD else Grade.LIMITED if ratio >= LIMITED else Grade.NO


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _mean_velocity(path: _Path, axis: int) -> tuple[float, float]:
    """Return the mean velocity from the first to the last frame, mm/s, with its sd."""
    place, error = path.place[:, axis], path.errors[:, axis]
    variance = np.mean(((error[-1] - error[0]) / path.span_s) ** 2)
    sd = np.sqrt(variance + path.mean_speed_variance[axis])
    return float((place[-1] - place[0]) / path.span_s), float(sd)


def _clear_hz(path: _Path, axis: int) -> float:
    """Return the frequency up to which the path's power is 9 times its errors', or 0."""
    frequency, power = path.spectrum(path.place[:, axis])
    noise = path.spectrum(path.errors[:, axis])[1].mean(-1)
    three = np.ones(3) / 3
    clear = np.convolve(power, three, "same") > _CLEAR_POWER * np.convolve(noise, three, "same")
    first = np.flatnonzero(~clear[1:])
    last = int(first[0]) if len(first) else len(frequency) - 1
    return float(frequency[last])


def _band_rms(path: _Path, axis: int, below_hz: float) -> tuple[float, float]:
    """Return the RMS (mm) of the path about a line, and of its errors, up to a frequency."""
    frequency, power = path.spectrum(path.place[:, axis])
    noise = path.spectrum(path.errors[:, axis])[1].mean(-1)
    band = frequency <= (below_hz or np.inf)
    return float(np.sqrt(power[band].sum())), float(np.sqrt(noise[band].sum()))
