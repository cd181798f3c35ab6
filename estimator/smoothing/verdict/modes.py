"""Makes the table of vibration modes: place, frequency, damping ratio and RMS of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.smoothing.graph.layout import variances
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.problem.problem import CARRIAGE, RigMode
from telerig.io.results.smoothing import Mode, Place

_LOWEST_HZ = 2.0
_MOST_PEAKS = 3
_LEAST_SHARE = 0.08
_SIGNIFICANT = 3.0
_LEAST_SAMPLES = 32
_BLUR = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16
"""The spectrum of one record of a random vibration scatters; it is smoothed to find peaks."""
_BLUR_HALF = 1.0
_ALIKE = 0.7
_STRONGER = 2.0


def shake_modes(solution: Solution) -> list[Mode]:
    """Return the model's modes, or peaks in the offsets' spectrum, the strongest first."""
    graph = solution.graph
    names = [c.name for c in graph.problem.cameras]
    rows = _from_offsets(solution, names)
    if graph.model.modes:
        rows = [_from_model(mode, names) for mode in graph.model.modes]
    rows += _from_carriage(solution)
    return sorted(rows, key=lambda row: -np.max(np.asarray(row.rms_mm, float)))


def _mode(
    place: Place, camera: str, frequency_hz: float, damping: float, rms_mm: Sequence[float],
    source: str,
) -> Mode:  # fmt: skip
    return Mode(
        where=f"{place} {camera}".strip(), place=place, camera=camera, frequency_hz=frequency_hz,
        damping=damping, rms_mm=tuple(rms_mm), source=source,
    )  # fmt: skip


def _from_model(mode: RigMode, names: Sequence[str]) -> Mode:
    common = mode.camera == CARRIAGE
    place, camera = (Place.COMMON, "") if common else (Place.ARM, names[mode.camera])
    rms = [float(r) for r in mode.rms_mm]
    return _mode(place, camera, float(mode.frequency_hz), float(mode.damping), rms, "model")


def _from_offsets(solution: Solution, names: Sequence[str]) -> list[Mode]:
    """Return spectral lines of the cameras' offsets, with the part that vibrates.

    Along an axis that two cameras see, coherent lines are common-mode, others belong to one arm or
    to both. A line along an axis that one camera sees belongs to the same part if its frequency is
    the same; otherwise the part is unknown.
    """
    graph, found = solution.graph, solution.covariances
    if not graph.shake.size or not graph.model.broad_bands:
        return []
    rows = graph.shake.offset[:-1]
    offsets = graph.offsets(solution.state.shake).swapaxes(0, 1)
    noise = 0.0
    if found is not None:
        noise = float(np.mean([variances(row, found.shake).sum(1) for row in rows]))
    spectra = _spectra(graph.problem.t_s, offsets)
    if spectra is None:
        return []
    seen = np.abs(rows).sum(-1) > 0
    shared = seen.sum(0) > 1
    out: list[Mode] = []
    for line in _lines(spectra, spectra.own[:, shared].sum((0, 1)), noise):
        out += _owned(spectra, line, seen, shared, names)
    for camera, name in enumerate(names):
        alone = seen[camera] & ~shared
        for line in _lines(spectra, spectra.own[camera, alone].sum(0), noise):
            if not any(_same_line(line, row) for row in out):
                rms = np.sqrt(line.power(spectra.own[camera])) * alone
                out.append(line.row(Place.ONE_VIEW, name, rms))
    return out


@dataclass(frozen=True)
class _Spectra:
    """Spectral densities of (C, n, 3) series.

    frequency_hz : (F,).
    own : (C, 3, F) power.
    cross : (C, C, 3, F) real part of cross spectra.
    """

    frequency_hz: Array
    own: Array
    cross: Array


@dataclass(frozen=True)
class _Line:
    """A spectral peak: its bins, and the half width at half height, which gives the damping."""

    frequency_hz: float
    half_hz: float
    near: slice
    step_hz: float

    def power(self, density: Array) -> Array:
        return np.asarray(density[..., self.near].sum(-1) * self.step_hz)

    def row(self, place: Place, camera: str, rms_mm: Array) -> Mode:
        damping = self.half_hz / self.frequency_hz
        rms = rms_mm.tolist()
        return _mode(place, camera, self.frequency_hz, damping, rms, "estimate")


def _owned(
    spectra: _Spectra, line: _Line, seen: Bools, shared: Bools, names: Sequence[str]
) -> list[Mode]:
    """Return the line as one common mode, or as a mode of one or of all arms."""
    own, cross = line.power(spectra.own), line.power(spectra.cross)
    among = cross[:, :, shared].sum(-1)
    sd = np.sqrt(np.clip(np.diagonal(among), 0, None))
    strongest, weakest = int(sd.argmax()), int(sd.argmin())
    lone = sd[strongest] > _STRONGER * sd[weakest]
    if not lone and among[strongest, weakest] > _ALIKE * sd[strongest] * sd[weakest]:
        rms = np.sqrt((own * seen).sum(0) / np.maximum(seen.sum(0), 1))
        return [line.row(Place.COMMON, "", rms)]
    arms = [strongest] if lone else range(len(names))
    return [line.row(Place.ARM, names[c], np.sqrt(own[c]) * seen[c]) for c in arms]


def _same_line(line: _Line, row: Mode) -> bool:
    reach = 2 * max(line.half_hz, (row.damping or 0.0) * row.frequency_hz) + line.step_hz
    return bool(abs(line.frequency_hz - row.frequency_hz) <= reach)


def _spectra(t_s: Array, series: Array) -> _Spectra | None:
    """Return spectra of series (C, n, 3) at times (n,); None for a short record or no motion."""
    step = float(np.median(np.diff(t_s)))
    if len(t_s) < _LEAST_SAMPLES or not np.any(series):
        return None
    grid = np.arange(t_s[0], t_s[-1] + step / 2, step)
    even = np.array([[np.interp(grid, t_s, v) for v in one.T] for one in series])
    window = np.hanning(len(grid) + 1)[:-1]
    wave = np.fft.rfft((even - even.mean(-1, keepdims=True)) * window, axis=-1)
    cross = np.real(np.einsum("cif,dif->cdif", wave, wave.conj()))
    cross *= 2 * step / (window**2).sum()
    own = np.einsum("ccif->cif", cross)
    frequency = np.asarray(np.fft.rfftfreq(len(grid), step), np.float64)
    return _Spectra(frequency, own, cross)


def _lines(spectra: _Spectra, total: Array, noise_mm2: float) -> list[_Line]:
    """Return the peaks of a density (F,) that exceed the noise and a share of the variance."""
    frequency = spectra.frequency_hz
    width = float(frequency[1])
    variance = float(total.sum() * width)
    even = np.convolve(total, _BLUR, mode="same")
    peak = np.r_[False, (even[1:-1] > even[:-2]) & (even[1:-1] >= even[2:]), False]
    peak &= frequency >= max(_LOWEST_HZ, 2 * width)
    out: list[_Line] = []
    for i in sorted(np.flatnonzero(peak), key=lambda at: -even[at]):
        reach = 2 * _half_width(even, int(i))
        near = slice(max(i - reach, 0), i + reach + 1)
        power = float(total[near].sum() * width)
        if len(out) == _MOST_PEAKS or any(line.near.start <= i < line.near.stop for line in out):
            continue
        if even[near].max() > even[i]:  # a bump on the flank of another line
            continue
        if power < _LEAST_SHARE * variance or power < _SIGNIFICANT * noise_mm2 / 10:
            continue
        half = max(reach / 2 - _BLUR_HALF, 1.0)
        out.append(_Line(float(frequency[i]), half * width, near, width))
    return out


def _half_width(total: Array, peak: int) -> int:
    """Return the number of bins from a peak to where it has half of its height."""
    below = np.flatnonzero(total[peak:] < total[peak] / 2)
    above = np.flatnonzero(total[peak::-1] < total[peak] / 2)
    sides = [side[0] for side in (below, above) if len(side)]
    return int(max(1, min(sides, default=1)))


def _from_carriage(solution: Solution) -> list[Mode]:
    """Return the servo's following error: the encoder's strongest line without its trend."""
    problem, noise = solution.graph.problem, solution.graph.model.encoder_sigma_mm
    if problem.stage is None:
        return []
    t, position = problem.stage.t_s, problem.stage.position_mm
    late = t > t[0] + 0.2 * (t[-1] - t[0])
    if late.sum() < 64:
        return []
    t, position = t[late], position[late]
    x = 2 * (t - t[0]) / (t[-1] - t[0]) - 1
    rest = position - np.polynomial.Chebyshev.fit(x, position, 5)(x)
    spectra = _spectra(t, (rest[:, None] * np.abs(problem.axis))[None])
    if spectra is None:
        return []
    lines = _lines(spectra, spectra.own.sum((0, 1)), noise**2)
    rows = [line.row(Place.SERVO, "", np.sqrt(line.power(spectra.own[0]))) for line in lines]
    return [row for row in rows if np.max(np.asarray(row.rms_mm)) > _SIGNIFICANT * noise][:1]
