"""How the cameras have moved relative to each other since the calibration, from ray misses.

The two rays of a pair miss each other along the common perpendicular n of both lines of sight. If
the second camera has moved by v and rotated by w, the ray miss at a rig point p is n . (v + w x p),
a constant plus a slope along both lines of sight. Ray misses therefore identify three of the six
components of the pose between two telecentric cameras: the shift along n, and the two rotations
about axes perpendicular to n (roll about the second camera's own axis, and pitch). The others move
the triangulated point but cause no ray miss; they keep their calibrated values. With perspective
lenses more components are identifiable, and are estimated too. Beside them it is estimated how much
later than the first camera the second one exposes: its pixels are then ahead by their speed times
the delay.
The noise of ray misses comes from pixels, differential shake and bubbles that change shape. It is a
Gaussian process in time, whose hyper-parameters are learned: white noise of each pair, damped
oscillations that are common to all pairs of a frame (shake), and an Ornstein-Uhlenbeck process for
each bubble, because the centre of its outline wanders about its centre of volume. Only the spectral
density near 0 Hz limits the estimate of a constant; the usual standard error of a mean would be
wrong, because ray misses are correlated in time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.errors import CalibrationError, InputError
from telerig.estimator.bubbles.pairing.model import Finding
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.triangulation import (
    LEAST_SINE,
    POSE_COMPONENTS,
    midpoint,
    nearly_parallel,
    rig_jacobian,
    stacked_jacobian,
)
from telerig.statistics import robust_sd

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.bubbles.pairing.model import PairModel
    from telerig.estimator.calibration.result.calibration import Calibration


Prior = tuple[Array, Array]

_PEAKS = 3
_MOST_MODES = 2
_LEAST_LOG_RATIO = 3.0
_WANDER_S = 0.1
_CYCLES = 5.0
_FACTOR_3, _FACTOR_10 = np.log(3.0), np.log(10.0)
_INDEPENDENT = 0.5
"""Weight of each bin of a spectrum, because neighbouring bins of a tapered spectrum are
correlated."""

_FIRST_BIN = 2
_LEAST_FRAMES = 16
_LEAST_CYCLES = 4.0
"""An oscillation with fewer cycles in a stretch cannot be distinguished from a slow wander."""

_MOST_APART = 4


@dataclass(frozen=True)
class Series:
    """M ray misses in time, which are linear in K unknown numbers of unit prior variance.

    The unknowns are the errors of the calibration and the movement.

    frame, bubble : (M,) indices.
    t_s : (M,) times.
    miss_mm : (M,) ray misses.
    relative : (M,) variance of each ray miss due to its pixels, divided by the median of these.
    by_unknowns : (M, K) derivative of the ray misses with respect to the unknowns, in mm.
    """

    frame: Ints
    bubble: Ints
    t_s: Array
    miss_mm: Array
    relative: Array
    by_unknowns: Array

    def __len__(self) -> int:
        return len(self.miss_mm)

    def of(self, keep: Bools) -> Series:
        """Return the rows that are kept; keep : (N,)."""
        return Series(*(getattr(self, column.name)[keep] for column in fields(self)))

    def residuals(self) -> Array:
        """Return the ray misses (M,) in mm minus what a least-squares fit of the unknowns gives."""
        fit = np.linalg.lstsq(self.by_unknowns, self.miss_mm, rcond=None)[0]
        return np.asarray(self.miss_mm - self.by_unknowns @ fit)


@dataclass(frozen=True)
class Noise:
    """The hyper-parameters of the noise of ray misses.

    white_mm : standard deviation of each pair's white noise.
    wander_mm, wander_s : RMS and correlation time of each bubble's Ornstein-Uhlenbeck process, the
        wander of its outline's centre.
    shake : RMS (mm), decay time (s) and frequency (Hz) of each oscillation that all pairs of a
        frame share.
    """

    white_mm: float
    wander_mm: float
    wander_s: float
    shake: tuple[tuple[float, float, float], ...] = ()

    def own(self, lag_s: Array) -> Array:
        """Return the autocovariance (mm^2) of a bubble's wander at the lags (s), in their shape."""
        return np.asarray(self.wander_mm**2 * np.exp(-np.abs(lag_s) / self.wander_s))

    def common(self, lag_s: Array) -> Array:
        """Return the autocovariance (mm^2) of the shake at the lags (s), in their shape.

        The shake is a sum of damped resonators.
        """
        out = np.zeros_like(lag_s)
        for rms, decay, hz in self.shake:
            lag, turn = np.abs(lag_s), 2 * np.pi * hz
            wave = np.cos(turn * lag) + np.sin(turn * lag) / (turn * decay)
            out += rms**2 * np.exp(-lag / decay) * wave
        return out

    def slopes(self, lag_s: Array) -> tuple[Array, Array]:
        """Return the derivatives of `own` and `common` with respect to the hyper-parameters.

        They are with respect to the logarithms of (wander_mm, wander_s), as (2, L) at L lags, and
        of (RMS, decay time, frequency) of each of n oscillations, as (3 n, L).
        """
        lag, own = np.abs(lag_s), self.own(lag_s)
        common = []
        for rms, decay, hz in self.shake:
            turn = 2 * np.pi * hz
            cos, sin = np.cos(turn * lag), np.sin(turn * lag) / (turn * decay)
            scale = rms**2 * np.exp(-lag / decay)
            by_decay = lag / decay * (cos + sin) - sin
            by_hz = lag / decay * cos - sin - (turn * lag) * (turn * decay) * sin
            common += [2 * scale * (cos + sin), scale * by_decay, scale * by_hz]
        return np.array([2 * own, own * lag / self.wander_s]), np.reshape(common, (-1, len(lag)))

    def covariance(self, series: Series) -> Array:
        """Return the covariance (M, M) in mm^2 of M ray misses for fixed unknowns."""
        t, index = np.unique(series.t_s, return_inverse=True)
        at = np.ix_(index, index)
        lag = t[:, None] - t
        same = series.bubble[:, None] == series.bubble
        out = self.common(lag)[at] + np.where(same, self.own(lag)[at], 0.0)
        out[np.diag_indices(len(out))] += self.white_mm**2 * series.relative
        return np.asarray(out)


@dataclass(frozen=True)
class _Spectrum:
    """A tapered periodogram from bin `_FIRST_BIN` on, and what is needed for its expectation.

    overlap : autocorrelation of the taper.
    common, single : shares of the shake's and of a single bubble's variance in the series.
    """

    power: Array
    step_s: float
    overlap: Array
    common: float
    single: float

    def expected(self, noise: Noise) -> Array:
        """Return the expectation of the periodogram, which includes leakage and aliasing."""
        covariance = self.common * noise.common(self._lag_s) + self.single * noise.own(self._lag_s)
        covariance[0] += self.single * noise.white_mm**2
        turned = covariance * self.overlap
        density = 2 * np.fft.rfft(turned).real - turned[0]
        return np.asarray(density[self._bins].clip(1e-18))

    @property
    def _lag_s(self) -> Array:
        return np.asarray(np.arange(len(self.overlap)) * self.step_s, np.float64)

    @property
    def _bins(self) -> slice:
        return slice(_FIRST_BIN, _FIRST_BIN + len(self.power))

    def cost(self, noise: Noise) -> tuple[float, Array]:
        """Return the negative debiased Whittle log-likelihood, and its derivative by logarithms.

        Sykulski et al., Biometrika 106:251, 2019.
        """
        density = self.expected(noise)
        cost = float(_INDEPENDENT * (np.log(density) + self.power / density).sum())
        by_density = np.zeros(len(self.overlap))
        by_density[self._bins] = _INDEPENDENT * (1 - self.power / density) / density
        by_covariance = 2 * np.fft.fft(by_density).real * self.overlap
        by_covariance[0] /= 2
        own, common = noise.slopes(self._lag_s)
        white = self.single * 2 * noise.white_mm**2 * by_covariance[0]
        rest = np.concatenate([self.single * own, self.common * common]) @ by_covariance
        return cost, np.concatenate([[white], rest])


def learned_noise(parts: list[Series]) -> Noise:
    """Return the most probable noise model of the ray misses of a run.

    parts : stretches of the run; the spectra of their residuals are used. At most two oscillations
    (one for the arm of each camera) are added, as long as each raises the log posterior by
    `_LEAST_LOG_RATIO`.
    """
    spread = max(float(np.concatenate([p.residuals() for p in parts]).std()), 1e-7)
    start = np.log([spread / 2, spread / 4, _WANDER_S])
    spectra = [s for p in parts for s in _spectra(p)]
    if not spectra:
        return Noise(spread, spread / 4, _WANDER_S)
    prior: Prior = (start, np.array([_FACTOR_10, _FACTOR_10, _FACTOR_3]))
    best, score = _fitted(spectra, start, prior)
    for _ in range(_MOST_MODES):
        trials = []
        for hz in _peaks(spectra[0], _noise(best)):
            mode = np.log([spread / 2, _CYCLES / hz, hz])
            richer = (
                np.concatenate([prior[0], mode]),
                np.concatenate([prior[1], [_FACTOR_10, _FACTOR_3, 0.1]]),
            )
            trials.append((*_fitted(spectra, np.concatenate([best, mode]), richer), richer))
        found = min(trials, key=lambda t: t[1], default=None)
        if found is None or found[1] > score - _LEAST_LOG_RATIO:
            break
        best, score, prior = found
    return _noise(best)


def _fitted(spectra: list[_Spectrum], start: Array, prior: Prior) -> tuple[Array, float]:
    """Return the logarithms of the hyper-parameters, and the negative log posterior there."""
    from scipy.optimize import minimize

    def cost(log: Array) -> tuple[float, Array]:
        noise, off = _noise(log), (log - prior[0]) / prior[1]
        costs, slopes = zip(*(s.cost(noise) for s in spectra))
        return 0.5 * float(off @ off) + sum(costs), np.sum(slopes, axis=0) + off / prior[1]

    box = [(s - 8.0, s + 4.0) for s in start]
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=box, options={"maxiter": 60})
    return np.asarray(found.x), float(found.fun)


def _noise(log: Array) -> Noise:
    white, wander, tau, *rest = (float(v) for v in np.exp(log))
    return Noise(white, wander, tau, tuple(zip(rest[0::3], rest[1::3], rest[2::3])))


def _spectra(part: Series) -> list[_Spectrum]:
    """Return spectra of each frame's mean ray miss, and of single bubbles' deviations from it."""
    left = part.residuals()
    t, index = np.unique(part.t_s, return_inverse=True)
    if len(t) < _LEAST_FRAMES:
        return []
    count = np.bincount(index)
    mean = np.bincount(index, left) / count
    share = float((1 / count).mean())
    out = [_spectrum(t, mean, 1.0, share)]
    apart = left - mean[index]
    bubbles, seen = np.unique(part.bubble, return_counts=True)
    for bubble in bubbles[np.argsort(-seen)][:_MOST_APART] if share < 1 else ():
        mine = (part.bubble == bubble) & (count[index] > 1)
        if mine.sum() >= _LEAST_FRAMES:
            rest = float((1 - 1 / count[index[mine]]).mean())
            out.append(_spectrum(part.t_s[mine], apart[mine], 0.0, rest))
    return out


def _spectrum(t_s: Array, values: Array, common: float, single: float) -> _Spectrum:
    step = float(np.median(np.diff(t_s)))
    even = np.arange(t_s[0], t_s[-1] + step / 2, step)
    series = np.interp(even, t_s, values)
    taper = np.hanning(len(even) + 2)[1:-1]
    taper /= np.sqrt((taper**2).sum())
    power = np.abs(np.fft.rfft(series * taper)) ** 2
    overlap = np.correlate(taper, taper, "full")[len(taper) - 1 :]
    last = (len(even) - 1) // 2
    return _Spectrum(power[_FIRST_BIN : last + 1], step, np.asarray(overlap), common, single)


def _peaks(spectrum: _Spectrum, noise: Noise) -> list[float]:
    """Return frequencies (Hz) apart that exceed the noise model's spectrum most."""
    ratio = spectrum.power / spectrum.expected(noise)
    length = len(spectrum.overlap) * spectrum.step_s
    hz = np.arange(_FIRST_BIN, _FIRST_BIN + len(ratio)) / length
    picked: list[float] = []
    for i in np.argsort(-ratio * spectrum.power):
        if hz[i] * length >= _LEAST_CYCLES and all(abs(hz[i] - p) > 0.15 * p for p in picked):
            picked.append(float(hz[i]))
        if len(picked) == _PEAKS:
            break
    return picked


def information(series: Series, noise: Noise) -> tuple[Array, Array, Array]:
    """Return what a stretch of M ray misses says about the K unknowns.

    Returns the matrix (K, K) and right-hand side (K,) of the normal equations, without the prior,
    and the leave-one-out residuals (M,) in standard deviations, for the unknowns that fit this
    stretch best.
    """
    from scipy.linalg import cho_solve, cholesky

    lower = cholesky(noise.covariance(series), lower=True, check_finite=False)
    inverse = cho_solve((lower, True), np.eye(len(lower)), check_finite=False)
    matrix = series.by_unknowns.T @ inverse @ series.by_unknowns
    right = series.by_unknowns.T @ (inverse @ series.miss_mm)
    best = np.linalg.solve(matrix + np.eye(len(matrix)), right)
    off = inverse @ (series.miss_mm - series.by_unknowns @ best)
    return matrix, right, off / np.sqrt(np.diagonal(inverse))


Free = tuple[tuple[str, ...], ...]
Pair = tuple[Camera, Camera]

POSE = len(POSE_COMPONENTS)
FALSE_ALARM = 1e-4
"""Probability of reporting a movement if there is none."""

LATE_SIGMAS = 5.0
"""Cameras are said not to be synchronous if the delay exceeds so many standard deviations."""

_LATE_S = 0.01
"""Prior standard deviation of the delay."""

_LEAST_EFFECT = 0.02
"""A direction of movement is estimated if its ray misses are larger than this share of those of the
direction with the largest ray misses."""

_NOT_IDENTIFIED = 0.5
"""A rotation is not reported if its posterior standard deviation is larger than this share of the
prior one."""

_GRID = 0.7
_SINGULAR = 1e-10


@dataclass(frozen=True)
class DriftPrior:
    """Prior standard deviations of how far a camera has moved since the calibration.

    The movement is that against the others, along and about each axis of the camera. The defaults
    are wide. Raises InputError for values that are not positive.
    """

    rotation_rad: float = 5e-3
    translation_mm: float = 0.2

    def __post_init__(self) -> None:
        if not (self.rotation_rad > 0 and self.translation_mm > 0):
            raise InputError(
                f"the prior standard deviations of a movement are {self.rotation_rad} rad and "
                f"{self.translation_mm} mm",
                todo="give two positive numbers",
            )


@dataclass(frozen=True)
class RigChange:
    """The movement of a camera relative to another, the first of a pair, since the calibration.

    camera : name of the camera.
    tangent, covariance : (6,), (6, 6) movement as a tangent of the pose rig_from_<camera>, with the
        components `POSE_COMPONENTS`; 0 in directions that ray misses do not identify.
    place_mm : (3,) mean position of the bubbles in the rig frame, to which the offset refers.
    values, sigmas, prior_sigmas : (3,) estimate, standard deviation and prior standard deviation of
        the offset along the common perpendicular (mm), the roll and the pitch (rad).
    chance : p-value of the hypothesis that nothing has moved.
    pairs : number of pairs used.
    refined : pose rig_from_<camera> that calibration and run give together, or None.
    against : name of the other camera.
    culprit : of more than two cameras the one that has moved, if all others agree; else "".
    late_s, slate_s : how much later it exposes than the other camera, and the standard deviation;
        nan if it was not estimated.
    """

    camera: str
    tangent: Array
    covariance: Array
    place_mm: Array
    values: Array
    sigmas: Array
    prior_sigmas: Array
    chance: float
    pairs: int
    refined: Pose | None = None
    against: str = ""
    culprit: str = ""
    late_s: float = float("nan")
    slate_s: float = float("nan")

    @property
    def moved(self) -> bool:
        """Whether calibration errors, shake and bubble shapes do not explain the ray misses."""
        return self.chance < FALSE_ALARM

    @property
    def unsynchronised(self) -> bool:
        """Whether the cameras do not expose at the same time."""
        return abs(self.late_s) > LATE_SIGMAS * self.slate_s

    def size_words(self) -> str:
        """Return the identifiable part of the movement in words, with standard deviations."""
        offset, *turns = zip(1e6 * self.values, 1e6 * self.sigmas)
        size = _rounded(offset[0] / 1000, offset[1] / 1000)
        text = f"by {size} µm perpendicular to both optical axes"
        identified = self.sigmas[1:] < _NOT_IDENTIFIED * self.prior_sigmas[1:]
        each = zip(("rolled", "pitched"), turns, identified)
        turned = [f"{name} by {_rounded(*turn)} µrad" for name, turn, known in each if known]
        return (
            ", ".join([text, *turned]) if turned else f"{text} (its rotations cannot be determined)"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the content of ``rig_change`` in smoothing.json and tracking.json."""
        names = ("offset_mm", "roll_rad", "pitch_rad")
        out: dict[str, Any] = {"camera": self.camera, "moved": self.moved, "chance": self.chance}
        out |= {"against": self.against, "culprit": self.culprit}
        out |= {n: float(v) for n, v in zip(names, self.values)}
        out |= {f"s{n}": float(s) for n, s in zip(names, self.sigmas)}
        if np.isfinite(self.late_s):
            out |= {"late_s": self.late_s, "slate_s": self.slate_s}
        out |= {
            "place_mm": self.place_mm.tolist(),
            "components": list(POSE_COMPONENTS),
            "tangent": self.tangent.tolist(),
            "covariance": self.covariance.tolist(),
            "pairs": self.pairs,
            "not_seen": "Shifts in the plane of both lines of sight and the angle between them "
            "cause no ray miss. They keep their calibrated values.",
        }
        if self.refined is not None:
            out["rig_from_camera"] = {
                "rotation": self.refined.rotation.tolist(),
                "translation_mm": self.refined.translation_mm.tolist(),
            }
        return out


def _rounded(value: float, sd: float) -> str:
    """Return value ± standard deviation as text, to two digits of the latter."""
    digits = max(0, 1 - math.floor(math.log10(sd))) if sd > 0 else 2
    return f"{value:+.{digits}f} ± {sd:.{digits}f}"


def common_perpendicular(cameras: Pair) -> tuple[Array, Array]:
    """Return the common perpendicular of the two lines of sight.

    Returns its unit vector n (3,), in the direction of first x second line of sight, and the point
    (3,) in mm midway between the two lines where they come closest, both in the rig frame. Raises
    CalibrationError for cameras that look along one line.
    """
    rays = [c.unproject((np.array(c.image_size_px, float)[None] - 1) / 2) for c in cameras]
    cross = np.cross(rays[0][1], rays[1][1])[0]
    sine = float(np.linalg.norm(cross))
    if sine < LEAST_SINE:
        raise CalibrationError(
            "both cameras have the same line of sight",
            todo="a movement can be found only between cameras with different lines of sight",
        )
    middle, _ = midpoint(*rays[0], *rays[1])
    return cross / sine, middle[0]


@dataclass(frozen=True)
class RayMisses:
    """M ray misses along the common perpendicular.

    miss_mm : (M,).
    variance_mm2 : (M,) variances due to the pixels' noise.
    by_rig : (M, P) derivatives with respect to the P parameters of the rig, see `rig_jacobian`.
    by_pixel : (M, 2, 2) derivatives with respect to the pixels (u, v) in both cameras.
    """

    miss_mm: Array
    variance_mm2: Array
    by_rig: Array
    by_pixel: Array


def ray_misses(
    cameras: Pair,
    free: Free,
    points_mm: Array,
    uv_px: Array | None = None,
    covariance_px2: Array | None = None,
) -> RayMisses:
    """Return the ray misses of M pairs of pixels.

    free : for each camera the names of its free intrinsics.
    points_mm : (M, 3) points in the rig frame near the pairs, at which the cameras are linearised.
    uv_px : (M, 2, 2) the pixels (u, v) of each pair in both cameras; None sets the misses to 0.
    covariance_px2 : (M, 2, 2, 2) of these pixels; None sets the variances to 0.

    The left null vector of the projection's Jacobian combines a pair's four pixel coordinates such
    that the position of the point has no effect. It is scaled such that the ray miss equals the
    shift of the second camera along the common perpendicular.
    """
    n, _ = common_perpendicular(cameras)
    predicted, by_point = stacked_jacobian(cameras, points_mm)
    null = np.linalg.svd(by_point)[0][..., :, 3]
    scale = -np.einsum("mi,mij,j->m", null[:, 2:], by_point[:, 2:], n)
    null = null / scale[:, None]
    by_rig = np.einsum("mi,mip->mp", null, rig_jacobian(cameras, free, points_mm))
    miss, variance = np.zeros(len(points_mm)), np.zeros(len(points_mm))
    if uv_px is not None:
        miss = np.einsum("mi,mi->m", null, uv_px.reshape(-1, 4) - predicted)
    by_pixel = null.reshape(-1, 2, 2)
    if covariance_px2 is not None:
        variance = np.einsum("mci,mcij,mcj->m", by_pixel, covariance_px2, by_pixel)
    return RayMisses(miss, variance, by_rig, by_pixel)


@dataclass(frozen=True)
class Movement:
    """A movement of one of C cameras since the calibration, before it is known.

    moved, against : indices of the camera, and of another with which it makes ray misses.
    by_movement : (6 (C - 1), 6) derivative of the poses of all cameras but the first, which the rig
        frame moves with, by the movement.
    covariance : (6, 6) prior covariance of the movement: rotation (rad), translation (mm).
    """

    moved: int
    against: int
    by_movement: Array
    covariance: Array

    @staticmethod
    def of(cameras: Sequence[Camera], moved: int, against: int, prior: DriftPrior) -> Movement:
        """Return the movement of a camera with the prior of `drift_covariance`."""
        by = np.zeros((len(cameras) - 1, POSE, POSE))
        if moved:
            by[moved - 1] = np.eye(POSE)
        else:  # the others move in the frame of the first
            for j, camera in enumerate(cameras[1:]):
                by[j] = -camera.camera_from_rig.adjoint()
        covariance = drift_covariance(cameras, prior, moved)
        return Movement(moved, against, by.reshape(-1, POSE), covariance)

    def pair(self, cameras: Sequence[Camera]) -> Pair:
        """Return the camera that it is against, and the camera that moves."""
        return cameras[self.against], cameras[self.moved]

    def applied(self, cameras: Sequence[Camera], tangent: Array) -> tuple[Camera, ...]:
        """Return the cameras after a movement (6,)."""
        steps = (self.by_movement @ tangent).reshape(-1, POSE)
        poses = (moved_pose(c.camera_from_rig.inverse(), t) for c, t in zip(cameras[1:], steps))
        others = (replace(c, camera_from_rig=p.inverse()) for c, p in zip(cameras[1:], poses))
        return (cameras[0], *others)


def drift_covariance(cameras: Sequence[Camera], prior: DriftPrior, moved: int = 1) -> Array:
    """Return the prior covariance (6, 6) of a movement of one camera.

    Directions of movement that hardly move any pixels from those of one point, in the volume that
    the cameras see, have the variance 0. The components are `POSE_COMPONENTS` (rad, mm).
    """
    others = [c for k, c in enumerate(cameras) if k != moved]
    every = (*others, cameras[moved])
    beside = next((c for c in others if not nearly_parallel((c, every[-1]))), others[0])
    _, middle = common_perpendicular((beside, every[-1]))
    reach = min(min(c.image_size_px) / c["scale_px_per_mm"] / 2 for c in cameras)
    steps = _GRID * reach * np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), -1).reshape(-1, 3)
    _, by_point = stacked_jacobian(every, middle + steps)
    by_pose = rig_jacobian(every, ((),) * len(every), middle + steps)[..., -POSE:]
    rows = by_pose - by_point @ (np.linalg.pinv(by_point) @ by_pose)
    sigma = np.repeat([prior.rotation_rad, prior.translation_mm], 3)
    _, strength, directions = np.linalg.svd(rows.reshape(-1, POSE) * sigma, full_matrices=False)
    seen = directions[strength > _LEAST_EFFECT * strength[0]]
    return np.asarray(sigma[:, None] * (seen.T @ seen) * sigma)


def rig_change_from(
    cameras: Pair,
    tangent: Array,
    covariance: Array,
    prior: Array,
    place_mm: Array,
    pairs: int,
    refined: Pose | None = None,
) -> RigChange:
    """Return a movement with offset, roll and pitch, from its tangent.

    tangent, covariance, prior : (6,), (6, 6), (6, 6) estimate, its covariance and the covariance of
        its prior.
    place_mm : (3,) point to which the offset refers.
    pairs, refined : see `RigChange`.
    """
    rows = offset_roll_pitch(cameras, place_mm)
    sigmas, priors = (np.sqrt(np.diagonal(rows @ c @ rows.T).clip(0)) for c in (covariance, prior))
    return RigChange(
        cameras[1].name, tangent, covariance, place_mm, rows @ tangent, sigmas, priors,
        p_value_of(tangent, covariance, prior), pairs, refined, cameras[0].name,
    )  # fmt: skip


def offset_roll_pitch(cameras: Pair, place_mm: Array) -> Array:
    """Return the matrix (3, 6) that gives offset (mm), roll and pitch (rad) of a movement.

    It is applied to the movement's tangent (6,) of the second camera's pose rig_from_camera.
    place_mm : (3,) point in the rig frame to which the offset refers.
    """
    n, _ = common_perpendicular(cameras)
    pose = cameras[1].camera_from_rig
    across = pose.rotation @ n
    at = pose.apply(place_mm[None])[0]
    pitch = np.cross([0.0, 0.0, 1.0], across)
    offset = np.concatenate([np.cross(at, across), across])
    roll = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    return np.stack([offset, roll, np.concatenate([pitch / np.linalg.norm(pitch), np.zeros(3)])])


def p_value_of(tangent: Array, covariance: Array, prior: Array) -> float:
    """Return the p-value of an estimated movement under the hypothesis that nothing has moved.

    It is a chi-square test over the directions with a prior variance above 0. The prior shrinks the
    estimate towards 0, so the true p-value is smaller.

    tangent, covariance, prior : (6,), (6, 6), (6, 6) estimate, its covariance and the covariance of
    its prior.
    """
    from scipy.special import chdtrc

    basis = covariance_root(prior)
    if not basis.shape[1]:
        return 1.0
    inverse = np.linalg.pinv(basis)
    value, spread = inverse @ tangent, inverse @ covariance @ inverse.T
    return float(chdtrc(len(value), value @ np.linalg.solve(spread, value)))


def covariance_root(covariance: Array, singular: float = _SINGULAR) -> Array:
    """Return a matrix R (P, k) with R R^T = covariance (P, P) of rank k.

    singular : eigenvalues of the correlation matrix below this share of the largest one count as 0.
    """
    unit = _scale(covariance)
    values, vectors = np.linalg.eigh(covariance / unit[:, None] / unit)
    kept = values > singular * max(float(values[-1]), singular)
    return np.asarray(unit[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def _scale(covariance: Array) -> Array:
    """Return the standard deviations (P,) of a covariance (P, P), with 1 in place of 0."""
    sd = np.sqrt(np.diagonal(covariance).clip(0))
    return np.where(sd > 0, sd, 1.0)


def rig_block(calibration: Calibration) -> tuple[Array, Free]:
    """Return the covariance (P, P) of the cameras' parameters, and for each camera the names of its
    free intrinsics.

    The P parameters are ordered as in `rig_jacobian`. A calibration without a covariance gives a
    matrix of zeros and no free intrinsics.
    """
    if calibration.covariance.size:
        return calibration.covariance, calibration.free
    count = len(calibration.cameras)
    return np.zeros((POSE * (count - 1), POSE * (count - 1))), ((),) * count


def with_drift(covariance: Array, movement: Movement) -> Array:
    """Return the covariance (P, P) of the cameras' parameters with that of a movement added."""
    by, total = movement.by_movement, covariance.copy()
    total[-len(by) :, -len(by) :] += by @ movement.covariance @ by.T
    return total


def drift_posterior(
    rig: Array, rig_covariance: Array, prior_rig: Array, movement: Movement
) -> tuple[Array, Array]:
    """Return the movement (6,) of a camera, and its covariance (6, 6).

    A run determines only the sum of the calibration's error and the movement. By Gaussian
    conditioning, the movement is a gain times this sum.

    rig, rig_covariance : (P,), (P, P) posterior of the sum, for the cameras' P parameters.
    prior_rig : (P, P) covariance of the calibration.
    """
    total, drift = with_drift(prior_rig, movement), movement.covariance
    unit = _scale(total)
    inverse = np.linalg.pinv(total / unit[:, None] / unit, rcond=1e-13, hermitian=True)
    gain = np.zeros((POSE, len(total)))
    gain[:, -len(movement.by_movement) :] = drift @ movement.by_movement.T
    gain = (gain / unit) @ inverse / unit
    left = drift - gain @ total @ gain.T
    return gain @ rig, left + gain @ rig_covariance @ gain.T


def moved_pose(rig_from_camera: Pose, tangent: Array) -> Pose:
    """Return the pose after a small step (6,) (rotation, translation), a right perturbation."""
    return rig_from_camera @ Pose(rotation_from_rotvec(tangent[:3]), tangent[3:])


LEAST_PAIRS = 20
LEAST_SEEN_S = 0.5
"""Least total duration of all tracks for a verdict. In a shorter time, wander of the outlines'
centres cannot be distinguished from a movement."""

_LEAST_CONFIDENCE = 0.9
_DOUBTFUL = "shared|ambiguous|merged|border"
_FAR_SIGMAS = 6.0
_OUTLIER_SIGMAS = 4.5
_LEAST = 4
"""With fewer frames in a run, or fewer pairs in a stretch, nothing is estimated."""
_MOST_COLLECTED = 100_000
_MOST_ROWS = 520
_MOST_STRETCHES = 10
_STRETCH_S = 2.0
_LEARNED_FROM = 2
_PASSES = 3
_SHAPE_PX = 0.02
"""Standard deviation of the constant error of each bubble's centre in each view that its outline
does not reveal."""


class PairCollector:
    """Collects the reliable pairs of a run while it is tracked, and estimates a movement.

    Of a long run it keeps the pairs of every second, fourth, ... frame, since `stretches` use no
    more than some thousand of all.
    """

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.parts: list[pd.DataFrame] = []
        self.every, self.first = 1, 0

    def add(self, tracks: pd.DataFrame) -> None:
        """Add the reliable pairs of a part of the tracks."""
        import pandas as pd

        cameras = [c.name for c in self.calibration.cameras]
        names = pair_columns(cameras) + _speed_columns(cameras)
        moving = with_speeds(tracks, cameras)
        found = moving.loc[_reliable(tracks), [n for n in names if n in moving]]
        if not self.parts and len(found):
            self.first = int(found["frame"].iloc[0])
        self.parts.append(self._thinned(found))
        if sum(map(len, self.parts)) > _MOST_COLLECTED:
            self.every *= 2
            self.parts = [self._thinned(pd.concat(self.parts, ignore_index=True))]

    def _thinned(self, pairs: pd.DataFrame) -> pd.DataFrame:
        return pairs[(pairs["frame"] - self.first) % self.every == 0]

    def found(self) -> RigChange | None:
        """Return the movement that all collected rows give, or None if there are too few.

        Of more than two cameras it is that of the pair which contradicts the calibration most.
        """
        changes = self.changes()
        if not changes:
            return None
        least = min((change for change, _ in changes.values()), key=lambda change: change.chance)
        alone = culprit(changes, len(self.calibration.cameras))
        name = "" if alone is None else self.calibration.cameras[alone].name
        return replace(least, culprit=name)

    def changes(self, prior: DriftPrior | None = None) -> Changes:
        """Return `rig_changes` of all collected rows."""
        import pandas as pd

        filled = [p for p in self.parts if len(p)]
        if not filled:
            return {}
        return rig_changes(pd.concat(filled, ignore_index=True), self.calibration, prior)


Changes = dict[tuple[int, int], "tuple[RigChange, Noise]"]


def rig_changes(
    tracks: pd.DataFrame, calibration: Calibration, prior: DriftPrior | None = None
) -> Changes:
    """Return `rig_change` of each pair of cameras whose lines of sight are not parallel."""
    changes: Changes = {}
    for pair in combinations(range(len(calibration.cameras)), 2):
        two = calibration.subset(*pair)
        if not nearly_parallel((two.cameras[0], two.cameras[1])):
            found = rig_change(_seen_by(tracks, two), two, prior)
            if found is not None:
                changes[pair] = found
    return changes


def culprit(changes: Changes, cameras: int) -> int | None:
    """Return which of more than two cameras has moved, if all pairs of it say so and no others."""
    moved = {pair for pair, (change, _) in changes.items() if change.moved}
    alone = [c for c in range(cameras) if moved == {pair for pair in changes if c in pair}]
    return alone[0] if len(moved) > 1 and len(alone) == 1 else None


def _seen_by(table: pd.DataFrame, calibration: Calibration) -> pd.DataFrame:
    """Return the rows that both cameras of a calibration see, with the miss of their two rays."""
    names = [c.name for c in calibration.cameras]
    both = np.isfinite(table[[f"{name}_u_px" for name in names]].to_numpy(float)).all(1)
    mine: pd.DataFrame = table.loc[both]
    uv, _ = _pixels(mine, names)
    rays = [c.unproject(uv[:, i]) for i, c in enumerate(calibration.cameras)]
    return mine.assign(ray_miss_mm=midpoint(*rays[0], *rays[1])[1])


def _speed_columns(cameras: Sequence[str]) -> list[str]:
    return [f"{camera}_{axis}_px_s" for camera in cameras for axis in "uv"]


def with_speeds(tracks: pd.DataFrame, cameras: Sequence[str]) -> pd.DataFrame:
    """Return a table of tracks with the speed of each pixel (px/s), unless it has them.

    They are central differences; 0 where a bubble was not seen in the frame before or after.
    """
    columns = _speed_columns(cameras)
    if columns[0] in tracks:
        return tracks
    order = np.lexsort((tracks["frame"], tracks["particle"]))
    pixels = [f"{camera}_{axis}_px" for camera in cameras for axis in "uv"]
    frame, particle = (tracks[c].to_numpy()[order] for c in ("frame", "particle"))
    t_s, uv = (tracks[c].to_numpy(float)[order] for c in ("t_s", pixels))
    beside = (frame[2:] - frame[:-2] == 2) & (particle[2:] == particle[:-2])
    speed = np.zeros(uv.shape)
    inner = np.flatnonzero(beside)
    speed[1 + inner] = (uv[2 + inner] - uv[inner]) / (t_s[2 + inner] - t_s[inner])[:, None]
    back = np.empty_like(speed)
    back[order] = np.nan_to_num(speed)
    return tracks.assign(**dict(zip(columns, back.T)))


def pair_columns(cameras: Sequence[str]) -> list[str]:
    """Return the names of the columns of tracks.csv that `rig_change` uses."""
    pixels = ("u_px", "v_px", "du_px", "dv_px", "suu_px2", "suv_px2", "svv_px2")
    base = ["frame", "particle", "t_s", "x_mm", "y_mm", "z_mm", "ray_miss_mm"]
    return base + [f"{c}_{p}" for c in cameras for p in pixels]


def rig_change(
    tracks: pd.DataFrame, calibration: Calibration, prior: DriftPrior | None = None
) -> tuple[RigChange, Noise] | None:
    """Estimate how the second camera has moved since the calibration, from the tracks of a run.

    tracks : table with the columns `pair_columns`. prior : of the movement; None for `DriftPrior`.
    Returns the movement and the noise model of the ray misses; None if there are fewer than
    `LEAST_PAIRS` reliable pairs, or not exactly two cameras.
    """
    if len(calibration.cameras) != 2 or len(tracks) < LEAST_PAIRS:
        return None
    cameras = (calibration.cameras[0], calibration.cameras[1])
    names = [c.name for c in cameras]
    table = _without_outliers(with_speeds(tracks, names).loc[_reliable(tracks)])
    if len(table) < LEAST_PAIRS or table["frame"].nunique() < _LEAST:
        return None
    movement = Movement.of(cameras, 1, 0, prior or DriftPrior())
    drift = movement.covariance
    covariance, free = rig_block(calibration)
    root = covariance_root(with_drift(covariance, movement), singular=1e-12)

    def series_of(part: pd.DataFrame) -> Series:
        misses = ray_misses(cameras, free, _points(part), *_pixels(part, names))
        speed = part[_speed_columns(names)].to_numpy(float).reshape(-1, 2, 2)
        # half of it in each view, for then errors of both speeds and curved paths cancel
        by_delay = 0.5 * _LATE_S * np.einsum("mci,mci,c->m", misses.by_pixel, speed, [-1.0, 1.0])
        return Series(
            part["frame"].to_numpy(np.int64),
            part["particle"].to_numpy(np.int64),
            part["t_s"].to_numpy(float),
            misses.miss_mm,
            misses.variance_mm2 / float(np.median(misses.variance_mm2)),
            np.column_stack([misses.by_rig @ root, by_delay]),
        )

    scale = min(c["scale_px_per_mm"] for c in cameras)
    found = _estimate(table, series_of, np.sqrt(2) * _SHAPE_PX / scale)
    if found is None:
        return None
    unit, spreads, noise, used = found
    late, slate = _LATE_S * float(unit[-1]), _LATE_S * float(np.sqrt(spreads[1][-1, -1]))
    if abs(late) <= LATE_SIGMAS * slate:  # then the cameras are taken to be synchronous
        hold = np.eye(len(unit))
        hold[:, -1] -= spreads[0][:, -1] / spreads[0][-1, -1]
        unit, spreads = hold @ unit, (hold @ spreads[0] @ hold.T, hold @ spreads[1] @ hold.T)
    rig = root @ unit[:-1]
    (tangent, own), (_, with_shapes) = (
        drift_posterior(rig, root @ spread[:-1, :-1] @ root.T, covariance, movement)
        for spread in spreads
    )
    change = rig_change_from(cameras, tangent, own, drift, _points(table).mean(0), used)
    t = np.unique(table["t_s"].to_numpy(float))
    seen_s = float(np.median(np.diff(t)) * len(table))
    chance = p_value_of(tangent, with_shapes, drift) if seen_s >= LEAST_SEEN_S else 1.0
    return replace(change, chance=chance, late_s=late, slate_s=slate), noise


def _reliable(tracks: pd.DataFrame) -> Bools:
    """Return which rows have pixels in both views, high confidence and no doubtful flag."""
    keep = np.isfinite(tracks["ray_miss_mm"].to_numpy(float))
    if "confidence" in tracks:
        keep &= ~(tracks["confidence"].to_numpy(float) < _LEAST_CONFIDENCE)
    if "flags" in tracks:
        keep &= ~tracks["flags"].fillna("").astype(str).str.contains(_DOUBTFUL).to_numpy()
    return np.asarray(keep)


def _without_outliers(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows whose ray miss is near all others', with particles numbered from 0."""
    miss = table["ray_miss_mm"].to_numpy(float)
    if not len(miss):
        return table
    middle = np.median(miss)
    spread = float(robust_sd(miss - middle))
    near = np.abs(miss - middle) <= _FAR_SIGMAS * max(spread, 1e-6)
    bubble = np.unique(table["particle"], return_inverse=True)[1].astype(np.int64)
    kept: pd.DataFrame = table.assign(particle=bubble).loc[near]
    return kept


def _points(table: pd.DataFrame) -> Array:
    return table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)


def _pixels(table: pd.DataFrame, cameras: list[str]) -> tuple[Array, Array]:
    """Return the centres (M, 2, 2) of pairs in two cameras, of volume if known, and covariances."""
    uv, spread = [], []
    for name in cameras:
        centre = table[[f"{name}_u_px", f"{name}_v_px"]].to_numpy(float)
        shift = [f"{name}_du_px", f"{name}_dv_px"]
        if shift[0] in table:
            centre = centre + np.nan_to_num(table[shift].to_numpy(float))
        names = [f"{name}_{c}" for c in ("suu_px2", "suv_px2", "suv_px2", "svv_px2")]
        uv.append(centre)
        spread.append(table[names].to_numpy(float).reshape(-1, 2, 2))
    return np.stack(uv, 1), np.stack(spread, 1)


REFINE = ", or smooth the run with --refine-rig"


def with_change(
    pairs: Mapping[tuple[int, int], PairModel],
    change: RigChange | None,
    calibration: Calibration,
    misplaced: tuple[int, float, float] | None = None,
) -> dict[str, Any]:
    """Return the part ``pairs`` of tracking.json.

    pairs : the statistics of each pair of cameras; of more than two cameras the numbers are those
    of the pair with the largest gaps. change : the estimated movement, or None. If a camera has
    moved, the sentence on this replaces the one on an offset of the calibration. misplaced : as in
    `RigModel`.
    """
    moved = change is not None and change.moved
    without = [Finding.CALIBRATION_OFFSET] if moved else []
    names = [camera.name for camera in calibration.cameras]
    words = [
        text if len(names) == 2 else f"{names[a]} and {names[b]}: {text}"
        for (a, b), own in pairs.items()
        for text in own.sentences(without)
    ]
    if change is not None and moved:
        unsure = "" if np.any(calibration.covariance) else " (or the calibration was never right)"
        words.append(
            f"Camera {change.camera!r} has moved against {change.against!r} since the "
            f"calibration{unsure}, {change.size_words()}. All positions are wrong because of this "
            f"movement. Calibrate again{REFINE if len(names) == 2 or change.culprit else ''}."
        )
    if change is not None and change.unsynchronised:
        late = _rounded(1e3 * change.late_s, 1e3 * change.slate_s)
        words.append(
            f"Camera {change.camera!r} exposes {late} ms after {change.against!r}: positions of "
            "moving bubbles are off by up to the way that they move in this time, and ray misses "
            "are larger. Trigger both cameras by one signal, and compare their delays."
        )
    if change is not None and change.culprit:
        words.append(f"The other cameras agree, so it is {change.culprit!r} that has moved.")
    if misplaced is not None:
        camera, u, v = misplaced
        words.append(
            f"This is a calibration problem: the images of camera {names[camera]!r} lie {u:+.2f} "
            f"px in u and {v:+.2f} px in v from where the other cameras' points are expected in "
            "them. "
            "The grouping is not affected, but all positions are: calibrate the rig again."
        )
    problem = moved or misplaced is not None
    worst = max(pairs.values(), key=lambda own: own.gap_rms_px)
    return {
        "bias_px": worst.bias_px,
        "scatter_px": worst.scatter_px,
        "frame_px": worst.frame_px,
        "rms_px": worst.rms_px,
        "calibration_problem": problem or any(m.calibration_problem for m in pairs.values()),
        "words": words,
    }


def stretches(table: pd.DataFrame) -> list[pd.DataFrame]:
    """Return parts of a table of tracks, with at most about 520 pairs each, spread over the run.

    If many bubbles are seen, the parts use only every second, third, ... frame.
    """
    frames, counts = np.unique(table["frame"].to_numpy(np.int64), return_counts=True)
    most = max(4, int(_MOST_ROWS / float(counts.mean())))
    first = table.drop_duplicates("frame").sort_values("frame")["t_s"].to_numpy(float)
    step = float(np.median(np.diff(first)))
    thin = max(1, int(np.ceil(min(_STRETCH_S, float(np.ptp(first))) / step / most)))
    used = frames[::thin]
    parts = min(max(1, round(len(used) / most)), _MOST_STRETCHES)
    length = min(most, len(used) // parts)
    starts = np.linspace(0, len(used) - length, parts).astype(int)
    by_frame = table.set_index("frame", drop=False)
    by_frame.index.name = None
    return [by_frame.loc[used[s : s + length]].reset_index(drop=True) for s in starts]


def _estimate(
    table: pd.DataFrame, series_of: Callable[[Any], Series], shape_mm: float
) -> tuple[Array, tuple[Array, Array], Noise, int] | None:
    """Return unknowns (K,) of unit prior variance, two covariances, the noise and number of pairs.

    The second covariance includes a constant ray miss (sd shape_mm) of each bubble due to its
    shape. Returns None if too few pairs remain without outliers.
    """
    parts = [series_of(part) for part in stretches(table)]
    some = np.unique(np.linspace(0, len(parts) - 1, _LEARNED_FROM).astype(int))
    noise = learned_noise([parts[i] for i in some])
    size = parts[0].by_unknowns.shape[1]
    for last in range(_PASSES):
        matrix, right = np.eye(size), np.zeros(size)
        kept = []
        for part in parts:
            added, value, sigmas = information(part, noise)
            matrix, right = matrix + added, right + value
            kept.append(part.of(np.abs(sigmas) < _OUTLIER_SIGMAS))
        if last == _PASSES - 1 or list(map(len, kept)) == list(map(len, parts)):
            break
        parts = [p for p in kept if len(p) >= _LEAST]
        if not parts:
            return None
        noise = learned_noise(parts[:_LEARNED_FROM])
    covariance: Array = np.asarray(np.linalg.inv(matrix), np.float64)
    bubbles = len(np.unique(np.concatenate([p.bubble for p in parts])))
    with_shapes = covariance + _shape_share(parts, covariance, noise, shape_mm) / bubbles
    pairs = sum(map(len, parts))
    return np.asarray(covariance @ right), (covariance, with_shapes), noise, pairs


def _shape_share(parts: list[Series], covariance: Array, noise: Noise, shape_mm: float) -> Array:
    """Return the covariance (K, K) due to a constant ray miss of one bubble in the whole run."""
    response = np.zeros(len(covariance))
    for part in parts:
        constant = replace(part, miss_mm=np.full(len(part), shape_mm))
        response = response + information(constant, noise)[1]
    shift = covariance @ response
    return np.outer(shift, shift)
