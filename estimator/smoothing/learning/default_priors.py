"""Default priors of shake, bubbles and carriage, and their adaptation to a first solution."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.graph.layout import BROAD_BAND, directed, variances
from telerig.estimator.smoothing.graph.solve import Solution, drawn
from telerig.estimator.smoothing.graph.stage_travel import default_scale_sigma, wider_scale_sigma
from telerig.estimator.smoothing.problem.problem import (
    ARMS,
    CARRIAGE,
    DELAY_SIGMA_S,
    FEWEST_BUBBLES,
    Accelerometer,
    BroadBand,
    CarriageModel,
    RigMode,
    ShakeModel,
    SmoothingProblem,
    Stage,
)
from telerig.factors.bubble_motion import BubbleModel, Zigzag
from telerig.factors.state_space import broad_band, forced_mass
from telerig.statistics import parts_without_gaps, robust_sd

SHAKE_RMS_MM = 0.2
_ARM_RMS_MM, _LEAST_RMS_MM = 0.07, 1e-3
"""Of arms without a sensor against the carriage, and of any shake that sensors bound."""
_DEFAULT_SAMPLES = 2.0
"""A default RMS is as sure as that of two independent offsets: within a factor of 1.6."""
_ZIGZAG_HZ = (3.0, 12.0)
_ZIGZAG_GUESS_HZ = 6.5
_ZIGZAG_RMS_MM = 0.5
_ZIGZAG_DAMPING = 0.04
_ZIGZAG_LOG_SIGMA = 0.3
_LEAST_PERIODS, _LEAST_SAMPLES = 1.5, 12
_SHORT_TRACKS, _SHORT_SAMPLES = 100, 16
_HARMONIC_RMS_MM = 0.15
_INTERPOLATION_SHARE = 0.3
_CLEAR = 0.2
_SHAKE_HZ = (1.0, 60.0)
STRONG_MM_S2 = 5000.0
"""Shake whose accelerations are larger gets a steeper tail; see docs/decisions/010."""
DEFAULT_FLOOR = 0.12
"""Of the band. A mode of damping z has 4 z / (pi f) RMS^2 per Hz below it; this is z = 0.05."""


def default_model(
    problem: SmoothingProblem, encoder_sigma_mm: float = ShakeModel.encoder_sigma_mm
) -> ShakeModel:
    """Return default priors for a problem.

    With marks or accelerometers the prior of the shake is a broad band; otherwise it consists of a
    few guessed modes.

    encoder_sigma_mm : standard deviation of an encoder reading.
    """
    bands, modes = _default_bands(problem), tuple[RigMode, ...]()
    marked = problem.stage is not None and len(problem.references) > 0  # else it is held
    if not bands:
        modes = (RigMode(12.0, 0.2, (0.1,) * 3, force_hz=None),)
        cameras = range(len(problem.cameras))
        modes += tuple(RigMode(19.0, 0.2, (0.05,) * 3, j, None) for j in cameras)
    return ShakeModel(
        bubble=default_bubble(problem),
        modes=modes,
        broad_bands=bands,
        carriage=default_carriage(problem, encoder_sigma_mm),
        encoder_sigma_mm=encoder_sigma_mm,
        encoder_scale_sigma=default_scale_sigma(problem.travel) if marked else 0.0,
        accelerometer_delay_sigma_s=DELAY_SIGMA_S if problem.accelerometers else 0.0,
        name="default",
    )


def _default_bands(problem: SmoothingProblem) -> tuple[BroadBand, ...]:
    """Return the broad bands of a run with marks or accelerometers; none for any other.

    Where an arm has no sensor, there is one of the common shake, which the sensors feel, one of
    what all arms do alike along the travel, and one of each arm by itself. None is larger than
    twice the shake that a sensor could feel so: a carriage at rest carries no arms that shake.
    """
    cameras = range(len(problem.cameras))
    if problem.measures_shake:
        return tuple(_band(j, SHAKE_RMS_MM) for j in cameras)
    if not problem.accelerometers:
        return ()
    felt = max(map(_felt_mm_s2, problem.accelerometers))
    most = max(2 * felt / (2 * np.pi * BroadBand.low_hz) ** 2, _LEAST_RMS_MM)
    common, arm = min(SHAKE_RMS_MM, most), min(_ARM_RMS_MM, most)
    alike = replace(_band(ARMS, arm), rms_mm=_triple(arm * np.abs(problem.axis)))
    return (_band(CARRIAGE, common), alike, *(_band(j, arm) for j in cameras))


def _felt_mm_s2(sensor: Accelerometer) -> float:
    """Return the standard deviation of a sensor's readings, of all its axes together."""
    moving = sensor.reading_mm_s2 - np.median(sensor.reading_mm_s2, axis=0)
    return float(np.linalg.norm(robust_sd(moving, axis=0)))


def _band(camera: int, rms_mm: float) -> BroadBand:
    return BroadBand((rms_mm,) * 3, camera, floor=DEFAULT_FLOOR)


def rescaled(model: ShakeModel, factor: Array, frequency_hz: float) -> ShakeModel:
    """Return the broad-band priors with another RMS and dominant frequency.

    factor : (bands, 3) on the RMS.
    frequency_hz : the dominant frequency of the offsets.
    """
    rms_mm = factor * [b.rms_mm for b in model.broad_bands]
    frequency = float(np.clip(frequency_hz, *_SHAKE_HZ))
    offset = _largest_offset(model.broad_bands, rms_mm)
    strong = offset * (2 * np.pi * frequency) ** 2 > STRONG_MM_S2
    shape: dict[str, Any] = {"low_hz": frequency, "high_hz": max(60.0, 1.25 * frequency)}
    if strong:
        shape = {"low_hz": frequency, "high_hz": max(60.0, 2.0 * frequency), "tail": 3}
    bands = [replace(b, rms_mm=_triple(r), **shape) for b, r in zip(model.broad_bands, rms_mm)]
    return replace(model, broad_bands=tuple(bands))


def _largest_offset(bands: Sequence[BroadBand], rms_mm: Array) -> float:
    """Return the largest RMS of a camera's offset along an axis, of common and own bands."""
    common = np.array([b.camera < 0 for b in bands])
    shared = np.square(rms_mm[common]).sum(0)
    return float(np.sqrt((np.square(rms_mm[~common]) + shared).max()))


def default_bubble(problem: SmoothingProblem) -> BubbleModel:
    """Return a zigzag of the frequency that the tracks show, with its second harmonic along the
    vertical.
    """
    frequency, rms = zigzag(problem) or (_ZIGZAG_GUESS_HZ, _ZIGZAG_RMS_MM)
    across, up = 1 - np.abs(problem.up), np.abs(problem.up)
    return BubbleModel(
        zigzags=(
            Zigzag(frequency, _ZIGZAG_DAMPING, _triple(rms * across)),
            Zigzag(2 * frequency, _ZIGZAG_DAMPING, _triple(_HARMONIC_RMS_MM * up)),
        )
    )


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(v) if v > 1e-6 else 0.0 for v in values)
    return x, y, z


def zigzag(problem: SmoothingProblem) -> tuple[float, float] | None:
    """Return frequency (Hz) and RMS (mm) of the bubbles' zigzag; None without usable tracks.

    They come from the Lomb-Scargle spectrum of up to 20 tracks that are long enough for 1.5 periods
    at 3 Hz. Short tracks are fitted by an oscillator instead, because a trend removed from a short
    track leaves a spectral peak at the inverse of its length.
    """
    from scipy.signal import lombscargle

    long, short = list[tuple[Array, Array]](), list[tuple[Array, Array]]()
    for bubble in problem.bubbles:
        t = problem.t_s[bubble.first : bubble.last + 1]
        if len(bubble) >= _LEAST_SAMPLES:
            across = bubble.guess_mm - (bubble.guess_mm @ problem.up)[:, None] * problem.up
            shown = _ZIGZAG_HZ[0] * (t[-1] - t[0]) >= _LEAST_PERIODS
            (long if shown else short).append((t, across))
    if not long:
        return _likely_zigzag(short[:: 1 + len(short) // _SHORT_TRACKS]) if short else None
    trials = np.arange(*_ZIGZAG_HZ, 0.25)
    power, total, samples = np.zeros(len(trials)), 0.0, 0
    for t, across in long[:20]:
        x = (t - t.mean()) / (t[-1] - t[0])
        drift = np.stack([np.ones_like(x), x, x**2], -1)
        rest = across - drift @ np.linalg.lstsq(drift, across, rcond=None)[0]
        power += sum(2 * lombscargle(t, column, 2 * np.pi * trials) for column in rest.T)
        total, samples = total + (rest**2).sum(), samples + 2 * len(t)
    rms = float(np.sqrt(total / samples))
    clear = power.max() > _CLEAR * total and rms > _ZIGZAG_RMS_MM / 2
    frequency = float(trials[power.argmax()]) if clear else _ZIGZAG_GUESS_HZ
    return frequency, max(rms, _ZIGZAG_RMS_MM)


def _likely_zigzag(tracks: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Return frequency and RMS of an oscillator, by restricted maximum likelihood.

    tracks : times (n,) and lateral positions (n, 3). Each has its own mean position and velocity,
        and white noise. The frequency has a log-normal prior.
    """
    trials = np.arange(*_ZIGZAG_HZ, 0.25)
    noise = np.geomspace(1e-8, 1.0, 17)  # variances over the swing's
    omega = 2 * np.pi * trials[:, None, None]
    damped = omega * np.sqrt(1 - _ZIGZAG_DAMPING**2)
    squares = log_det = np.zeros((len(trials), len(noise)))
    count = 0
    for t, across in tracks:
        some = np.linspace(0, len(t) - 1, min(len(t), _SHORT_SAMPLES)).astype(int)
        line = np.stack([np.ones(len(some)), t[some] - t[0]], -1)
        free = np.linalg.qr(line, "complete")[0][:, 2:]
        lag = np.abs(t[some][:, None] - t[some])
        wave = np.cos(damped * lag) + _ZIGZAG_DAMPING * omega / damped * np.sin(damped * lag)
        wave *= np.exp(-_ZIGZAG_DAMPING * omega * lag)
        values, axes = np.linalg.eigh(free.T @ wave @ free)
        variance = np.maximum(values, 0.0)[:, None] + noise[:, None]
        seen = (np.swapaxes(axes, 1, 2) @ (free.T @ across[some])) ** 2
        squares = squares + (seen.sum(-1)[:, None] / variance).sum(-1)
        log_det = log_det + 2 * np.log(variance).sum(-1)
        count += 2 * free.shape[1]
    prior = (np.log(trials / _ZIGZAG_GUESS_HZ) / _ZIGZAG_LOG_SIGMA) ** 2
    cost = log_det + count * np.log(squares / count) + prior[:, None]
    at = np.unravel_index(np.argmin(cost), cost.shape)
    return float(trials[at[0]]), max(float(np.sqrt(squares[at] / count)), _ZIGZAG_RMS_MM)


def default_carriage(problem: SmoothingProblem, encoder_sigma_mm: float) -> CarriageModel:
    """Return the default model of the carriage's motion.

    With accelerometers, or with encoder readings too sparse for linear interpolation, the motion
    between the readings is modelled; otherwise they are interpolated.
    """
    stage = problem.stage
    if stage is None:
        return CarriageModel()
    if not problem.accelerometers and _dense(stage, encoder_sigma_mm):
        return CarriageModel()
    rms = acceleration_rms(stage, encoder_sigma_mm)
    whole = (a for a in problem.accelerometers if not a.unused_axes)
    unread = min((unread_mm_s2(a, stage, problem.axis) for a in whole), default=0.0)
    return CarriageModel("force", acceleration_rms_mm_s2=max(rms, unread, 100.0))


def unread_mm_s2(sensor: Accelerometer, stage: Stage, axis: Array) -> float:
    """Return the RMS acceleration along the travel that a sensor feels between encoder readings.

    An encoder that is read at 20 Hz hides what a servo does at 15 Hz. What all sensors feel of it
    may be the carriage's.

    axis : (3,) direction of travel in the rig frame.
    """
    step = _step_s(stage)
    along = sensor.reading_mm_s2 @ (sensor.axes @ axis)
    samples = round(step / max(float(np.median(np.diff(sensor.t_s))), 1e-9))
    if samples < 2 or len(along) < samples:
        return 0.0
    slow = np.convolve(along, np.ones(samples) / samples, "valid")
    first = samples // 2
    return float(np.std(along[first : first + len(slow)] - slow))


def _dense(stage: Stage, sigma_mm: float) -> bool:
    """Return whether linear interpolation between two readings errs by less than their noise."""
    if len(stage.t_s) < 3:
        return False
    bend = acceleration_rms(stage, sigma_mm) * _step_s(stage) ** 2 / 8
    return bend < _INTERPOLATION_SHARE * max(sigma_mm, 1e-4)


def acceleration_rms(stage: Stage, sigma_mm: float) -> float:
    """Return the RMS (mm/s^2) of `forced_mass` that explains the encoder's readings best.

    It maximises Whittle's likelihood (Arkiv foer Matematik 2, 1953) of their second differences,
    which need no trend taken away. A vibration of the stage is a line: parabolas over many readings
    would not follow it. Gaps of the record are not bridged: a straight line has no acceleration.

    sigma_mm : standard deviation of a reading.
    """
    rms, cost = np.geomspace(1.0, 1e6, 240), np.zeros(240)
    for seen, unit in _spectra(stage):
        noise = 2 * _step_s(stage) * max(sigma_mm, 1e-5) ** 2
        cost += [np.sum(np.log(d := r**2 * unit + noise) + seen / d) for r in rms]
    return float(rms[np.argmin(cost)]) if cost.any() else 1000.0


def encoder_noise_mm(stage: Stage, stated_mm: float) -> float:
    """Return the standard deviation of an encoder's readings, larger than stated if these show it.

    Coarse counts, and times that are not exact, are noise that is white, and a carriage's motion is
    less the faster it is: Whittle's likelihood tells them apart, of spectra whose lines, which are
    vibrations, a running median has taken away. An encoder read at less than the corner frequency
    of the carriage's force shows no noise: a vibration would look like it.
    """
    from scipy.signal import medfilt

    if not 0 < _step_s(stage) * CarriageModel.corner_hz < 1:
        return stated_mm
    sigma, square = (
        max(stated_mm, 1e-5) * np.geomspace(1.0, 1000.0, 90),
        np.geomspace(1.0, 1e12, 120),
    )
    cost, half = np.zeros((len(sigma), len(square))), _LINE_BINS // 2
    for seen, unit in _spectra(stage):
        if len(seen) < _LINE_BINS + _FEWEST_READINGS:
            continue
        calm = medfilt(seen, _LINE_BINS)[half:-half] / np.log(2)
        for row, noise in zip(cost, 2 * _step_s(stage) * sigma**2):
            density = square[:, None] * unit[half:-half] + noise
            row += np.sum(np.log(density) + calm / density, axis=-1)
    least = cost.min(1)
    best = int(np.argmin(least))
    return float(sigma[best]) if least[0] - least[best] > 2 * _CLEAR_NOISE else stated_mm


def _step_s(stage: Stage) -> float:
    return float(np.median(np.diff(stage.t_s))) if len(stage.t_s) > 1 else 0.0


def _spectra(stage: Stage) -> Iterator[tuple[Array, Array]]:
    """Yield of each part of a record without gaps the density of its positions (n,), from their
    second differences, and that of `forced_mass` of unit acceleration."""
    from scipy.signal import welch

    usual = _step_s(stage)
    for mine in parts_without_gaps(stage.t_s):
        if len(mine) < _FEWEST_READINGS:
            continue
        t_s, position_mm = stage.t_s[mine], stage.position_mm[mine]
        steps = np.round(np.diff(t_s) / usual).clip(1).sum()  # a median step would drift from them
        even, step = np.linspace(t_s[0], t_s[-1], int(steps) + 1, retstep=True)
        bend = np.diff(np.interp(even, t_s, position_mm), 2)
        frequency, seen = welch(bend, 1 / step, nperseg=min(len(bend), _SEGMENT), detrend="linear")
        frequency, seen = frequency[2:], seen[2:] / (2 * np.sin(np.pi * frequency[2:] * step)) ** 4
        yield seen, forced_mass(1.0).density(frequency)


_INFLATE_BEYOND = 0.05
_RESCALE_BEYOND = 0.2
_LEAST_REDUCTION, _PRIOR_SAMPLES, _SCALED = 0.05, 1.0, (0.05, 20.0)
_LEAST_SPARE = 0.2
_LEAST_PIXELS = 60
_SD_OF_MEDIAN = 1.16
_FLOORS = np.geomspace(0.03, 0.4, 40)
_FLOOR_SPREAD = np.log(2.0)
_LOW_BAND = 0.4
_FEWEST_BINS = 3
_FEWEST_READINGS, _SEGMENT = 8, 8192
_LINE_BINS, _CLEAR_NOISE = 9, 16.0
"""Width of the running median, and the log-likelihood ratio of more noise than stated: in 50 sound
runs with the noise that is stated it is at most 31, for 1.5 times the noise."""
_UNSEEN_MM = 1e-6
_INDEPENDENT = 0.5
"""Share of independent bins: a tapered spectrum's neighbours, and cameras, are correlated."""


def adapted(solution: Solution, start: ShakeModel | None = None) -> ShakeModel | None:
    """Return the priors adapted to a solution, or None if nothing changes.

    start : the model before any adaptation; None for that of the solution.

    Adapted are the pixel noise, the RMS displacement of broad-band shake and of modes whose
    frequency is a default, and the prior standard deviation of the encoder's scale. Modes that were
    learned from the run keep their RMS.
    """
    model = solution.graph.model
    inflation, of_marks = _noise_factor(solution), _mark_noise_factor(solution)
    better = model
    wide = wider_scale_sigma(solution)
    if wide is not None:
        better = replace(better, encoder_scale_sigma=wide)
    if inflation > 1:
        better = replace(better, pixel_inflation=model.pixel_inflation * inflation)
    if of_marks > 1:
        better = replace(better, mark_inflation=model.mark_inflation * of_marks)
    if model.broad_bands:
        factor = _size_of_bands(solution, (start or model).broad_bands)
        fresh = rescaled(better, factor, _dominant_hz(solution))
        graph = solution.graph
        offsets = graph.offsets(solution.state.shake)
        floor = fitted_floor(
            graph.problem.t_s,
            offsets,
            fresh.broad_bands,
            model.broad_bands,
            _felt_noise(graph.problem),
        )
        moved = abs(np.log(floor / model.broad_bands[0].floor)) if floor else 0.0
        if max(np.max(np.abs(np.log(factor))), moved) > _RESCALE_BEYOND:
            bands = (b if floor is None else replace(b, floor=floor) for b in fresh.broad_bands)
            better = replace(fresh, broad_bands=tuple(bands))
    elif guessed_modes(model):
        factor, faster = _size_of_offsets(solution), _faster(solution)
        if np.max(np.abs(np.log([*factor, faster]))) > _RESCALE_BEYOND:
            modes = (
                replace(
                    m, rms_mm=_triple(np.array(m.rms_mm) * factor),
                    frequency_hz=m.frequency_hz * faster,
                )
                for m in model.modes
            )  # fmt: skip
            better = replace(better, modes=tuple(modes))
    return None if better is model else better


def guessed_modes(model: ShakeModel) -> bool:
    """Return whether the modes are the guess of `default_model`."""
    return model.name == "default" and bool(model.modes)


def _faster(solution: Solution) -> float:
    """Return the factor on the frequencies of guessed modes, so that their motion is as fast as the
    offsets; 1 where three bubbles or more are in sight."""
    if not _is_few(solution):
        return 1.0
    modes = solution.graph.model.modes
    power = np.array([np.sum(np.square(m.rms_mm)) for m in modes])
    guessed = np.sqrt(power @ np.square([m.frequency_hz for m in modes]) / power.sum())
    return float(np.clip(_dominant_hz(solution), *_SHAKE_HZ) / guessed)


def _is_few(solution: Solution) -> bool:
    """Return whether too few bubbles are in sight to tell their motion from the rig's."""
    frames = len(np.unique(solution.graph.frame_of_row))
    return solution.graph.rows < FEWEST_BUBBLES * frames


def _size_of_offsets(solution: Solution) -> Array:
    """Return factors (3,) on the modes' RMS along each axis, so that they explain the offsets.

    The expected square of an estimated offset is the prior variance minus the posterior variance
    (MacKay, Neural Computation 4:415, 1992). The prior RMS counts as one independent offset. Axes
    that the data do not determine keep 1. One or two bubbles, whose wide swings hide the shake
    across them, have the largest factor along all axes.
    """
    graph, found = solution.graph, solution.covariances
    rows, t = graph.shake.offset[:-1], graph.problem.t_s
    prior = np.zeros(rows.shape[:2])
    for mode in graph.model.modes:
        prior[slice(None) if mode.camera == CARRIAGE else mode.camera] += np.square(mode.rms_mm)
    if found is None:
        return np.ones(3)
    left = np.stack([variances(row, found.shake).mean(0) for row in rows])
    reduction = np.sum(prior - left, axis=0)
    known = reduction > _LEAST_REDUCTION * prior.sum(0)
    square = (graph.offsets(solution.state.shake) ** 2).mean(0).sum(0)
    square /= np.where(known, reduction, 1.0)
    samples = 2 * (t[-1] - t[0]) * graph.model.modes[0].frequency_hz
    square = (samples * square + _PRIOR_SAMPLES) / (samples + _PRIOR_SAMPLES)
    factor = np.where(known, np.clip(np.sqrt(square), *_SCALED), 1.0)
    if _is_few(solution) and known.any():
        factor[:] = factor[known].max()
    return factor


def _felt_noise(problem: SmoothingProblem) -> float:
    """Return the density of the accelerometers' noise, (mm/s^2)^2 / Hz; 0 where marks show the
    offsets, slow ones too."""
    if len(problem.references):
        return 0.0
    sensors = (a for a in problem.accelerometers if len(a.t_s) > 1)
    densities = [2 * float(np.median(np.diff(a.t_s))) * a.sigma_mm_s2**2 for a in sensors]
    return float(np.median(densities or [0.0]))


def fitted_floor(
    t_s: Array,
    offsets_mm: Array,
    bands: tuple[BroadBand, ...],
    before: tuple[BroadBand, ...] = (),
    felt_noise: float = 0.0,
) -> float | None:
    """Return the low-frequency floor of the broad bands by Whittle's likelihood of the offsets.

    The floor is the density below the band relative to the density in it. It decides how well the
    slow motion of a bubble is known. The likelihood (Whittle, Arkiv foer Matematik 2, 1953) covers
    the frequencies below 0.4 of the band; the prior is a factor of two about `DEFAULT_FLOOR`.
    Accelerometers show slow offsets o with a noise n that grows as f^-4, so that the estimate is
    G (o + n) with the gain G of Wiener's filter for the prior with which it was made.

    t_s : (F,).
    offsets_mm : (F, C, 3) estimated offsets of the cameras, 0 along unseen axes.
    bands : one for each camera.
    before : those with which the offsets were estimated.
    felt_noise : density of the accelerations' noise, (mm/s^2)^2 / Hz; 0 where offsets are seen.

    Returns None for a short run, and if a band is common to the cameras or steep.
    """
    t = np.asarray(t_s, float)
    if any(b.camera < 0 or b.tail > 2 for b in bands) or not bands[0].floor or len(t) < 2:
        return None
    step = float(np.median(np.diff(t)))
    even = np.arange(t[0], t[-1] + step / 2, step)
    frequency = np.asarray(np.fft.rfftfreq(len(even), step), np.float64)
    low = (frequency * len(even) * step > 1.5) & (frequency <= _LOW_BAND * bands[0].low_hz)
    if np.count_nonzero(low) < _FEWEST_BINS:
        return None
    score = -0.5 * (np.log(_FLOORS / DEFAULT_FLOOR) / _FLOOR_SPREAD) ** 2
    low_hz, high_hz = bands[0].low_hz, bands[0].high_hz  # all have one shape
    unit = [
        broad_band(1.0, low_hz=low_hz, high_hz=high_hz, floor=floor).density(frequency[low])
        for floor in _FLOORS.tolist()
    ]
    noise = felt_noise / (2 * np.pi * frequency[low]) ** 4
    for band, prior in zip(bands, before or bands):
        made = broad_band(
            1.0, low_hz=prior.low_hz, high_hz=prior.high_hz, floor=prior.floor
        ).density(frequency[low])
        for axis in range(3):
            series = np.interp(even, t, offsets_mm[:, band.camera, axis])
            if series.std() < _UNSEEN_MM:
                continue
            gain = prior.rms_mm[axis] ** 2 * made
            gain = gain / (gain + noise)
            density = gain**2 * (band.rms_mm[axis] ** 2 * np.array(unit) + noise)
            seen = _periodogram(series, step)[low]
            score -= _INDEPENDENT * np.sum(np.log(density) + seen / density, axis=-1)
    return float(_FLOORS[np.argmax(score)])


def _periodogram(series: Array, step_s: float) -> Array:
    """Return the one-sided density (F,) of a series (n,) without its trend, with Hann's window."""
    from scipy.signal import detrend, periodogram

    taper: Any = np.hanning(len(series))
    return np.asarray(periodogram(series, 1 / step_s, window=taper, detrend=detrend)[1])


def _size_of_bands(solution: Solution, defaults: Sequence[BroadBand]) -> Array:
    """Return factors (bands, 3) on the RMS of every broad band, by its own share of the offsets;
    the mean along unseen axes.

    defaults : the bands before any adaptation.
    """
    graph, found, at = solution.graph, solution.covariances, 0
    states, layout = graph.shake_at_frames(solution.state.shake), graph.shake
    shown = list[tuple[float, float]]()  # mean squares and posterior variances
    for part, label in zip(layout.components, layout.labels):
        mine, row = slice(at, at + part.size), part.position
        at += part.size
        if label == BROAD_BAND:
            left = 0.0 if found is None else row @ found.shake[:, mine, mine].mean(0) @ row
            shown.append((float(np.mean((states[:, mine] @ row) ** 2)), float(left)))
    out, t, cameras = list[Array](), graph.problem.t_s, graph.problem.cameras
    for band, default in zip(graph.model.broad_bands, defaults, strict=True):
        ways = directed(band.rms_mm, band.camera, cameras)
        own, shown = shown[: len(ways)], shown[len(ways) :]
        if not ways:
            out.append(np.ones(3))
            continue
        prior, first = (
            np.array([rms**2 for _, rms in directed(b.rms_mm, b.camera, cameras)])
            for b in (band, default)
        )
        samples = 2 * (t[-1] - t[0]) * band.low_hz
        square, left_over = np.array(own).T
        larger = fitted_variance(square, left_over, prior, first, samples) / prior
        shares = np.square([way * band.rms_mm for way, _ in ways]) / prior[:, None]
        out.append(larger.mean() + np.linalg.pinv(shares) @ (larger - larger.mean()))
    return np.sqrt(np.clip(out, *np.square(_SCALED)))


def fitted_variance(
    square: Array, left: Array, prior: Array, default: Array, samples: float
) -> Array:
    """Return the variances of shake that a solution shows.

    The expected square of an estimated offset is the prior variance minus the posterior variance,
    so that the prior has to be larger by their ratio (MacKay, Neural Computation 4:415, 1992). What
    the data leave undetermined counts as two samples of the default.

    square, left : mean squares of the estimated offsets, and their posterior variances.
    prior, default : variances of the solution's model, and before any adaptation.
    samples : number of independent offsets.
    """
    known = (1 - left / prior).clip(0.0)
    few = _DEFAULT_SAMPLES * (1 - known)
    return (samples * square + few * default) / (samples * known + few)


def _dominant_hz(solution: Solution) -> float:
    """Return the RMS frequency of the offsets.

    It is the larger of two that are too small where frames are few: the RMS of the velocity over
    2 pi times that of the offset (between frames at 20 Hz a velocity is hardly known, and estimated
    as small), and the frequency of a sine that changes from frame to frame as the offset does.
    """
    graph, place = solution.graph, solution.graph.offsets(solution.state.shake)
    states, pace_s = graph.shake_at_frames(solution.state.shake), np.diff(graph.problem.t_s)
    speed = np.einsum("cid,fd->fci", graph.shake.offset_velocity[:-1], states)
    square, step_s = max(float((place**2).mean()), 1e-12), float(np.median(pace_s))
    moving = float(np.sqrt((speed**2).mean() / square)) / (2 * np.pi)
    change = np.diff(place, axis=0)[pace_s < 1.5 * step_s]
    share = min(float((change**2).mean()) / (4 * square), 1.0)
    return max(moving, float(np.arcsin(np.sqrt(share))) / (np.pi * step_s))


def _noise_factor(solution: Solution) -> float:
    """Return the factor by which the stated pixel noise is too small, at least 1.

    It compares the median squared residuals with those of draws from the model, separately for u
    and v, and takes the larger factor: the centre of a bubble's outline wanders along both, and the
    fit may absorb it along one. Coordinates whose residuals the fit absorbs almost completely do
    not count.
    """
    observed, kept = solution.graph.problem.observations, solution.weights[0] > 0.5
    if solution.covariances is None or not kept.any():
        return 1.0
    drawn_px, found = drawn(solution).pixels, [1.0]
    for k in range(2):
        ratios = [np.zeros(0)]
        for camera in np.unique(observed.camera[kept]):
            mine = kept & (observed.camera == camera)
            left = drawn_px[mine, k] ** 2
            if left.mean() > _LEAST_SPARE:
                ratios.append(solution.residuals[0][mine, k] ** 2 / np.median(left))
        ratio = np.concatenate(ratios)
        found.append(_sure_factor(ratio))
    return max(found)


def _mark_noise_factor(solution: Solution) -> float:
    """Return the factor by which the marks' stated noise is too small, at least 1.

    It compares the changes of their residuals from one sighting to the next with those of draws: a
    mark that moves, or a wrong clock, is no noise, and changes them slowly.
    """
    observed = solution.graph.problem.references
    order = np.lexsort((observed.frame, observed.item, observed.camera))
    same = np.diff(observed.item[order]) == 0
    same &= np.diff(observed.camera[order]) == 0
    if solution.covariances is None or not same.any():
        return 1.0
    kept = same & (np.minimum(*(solution.weights[1][order][i:][: len(same)] for i in (0, 1))) > 0.5)
    left = np.diff(drawn(solution).marks[order], axis=0)[kept] ** 2
    if not len(left) or left.mean() < _LEAST_SPARE:
        return 1.0
    change = np.diff(solution.residuals[1][order], axis=0)[same] ** 2
    return _sure_factor((change / np.median(left)).ravel())


def _sure_factor(ratio: Array) -> float:
    """Return the root of the median of squares over those expected (n,), 1 if it is not clearly
    more."""
    if len(ratio) < _LEAST_PIXELS:
        return 1.0
    factor = float(np.sqrt(np.median(ratio)))
    sure = 1 + max(_INFLATE_BEYOND, 2 * _SD_OF_MEDIAN / np.sqrt(len(ratio)))
    return factor if factor > sure else 1.0
