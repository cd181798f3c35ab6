"""How much of another motion a motion has, by frequency band: the response of an arm to the stage.

An arm is a structure with resonances: it follows the stage with the gain 1 below them only, and
beyond one in the opposite direction. A factor between two records is therefore what all bands agree
in, and their disagreement is its uncertainty (DerSimonian and Laird, Control. Clin. Trials 7:177,
1986, with a prior for few bands). The bands count in which both motions are coherent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.sensors.record_numbers import runs

FALSE_ALARMS = 1e-3
"""Share of sound runs in which a factor between two records may be called wrong."""

FAR_SDS = NormalDist().inv_cdf(1 - FALSE_ALARMS / 2)
"""Standard deviations that chance exceeds as rarely."""

_ARM_SD, _ARM_BANDS = 0.5, 3.0
"""Standard deviation of the logarithm of an arm's gain in a band before anything is measured, and
the number of bands that this counts for: half of the arms' gains are between 0.7 and 1.4."""

_TURNED_BANDS = 3
"""A lightly damped arm is opposed to the stage from its resonance up to the next, which is hardly
eight times as high; three bands span that."""

_LOWEST, _LEAST_BINS = 2, 4
"""First of the frequencies in the lowest band, and their number."""

_LEAST_RUN = 0.5
"""Runs of samples that are shorter than this share of the longest one are left out."""


@dataclass(frozen=True)
class Response:
    """The response in K bands in which two motions are coherent.

    band : (K,) number of the band, the same frequencies in all records as long as `known`; each is
        twice as wide as the one below.
    log_gain : (K,) complex logarithm of output over input, if all noise is in the output.
    coherence : (K,) squared; the gain over it is that if all noise is in the input.
    variance : (K,) of the real part of log_gain, by chance alone.
    """

    band: Ints
    log_gain: Array
    coherence: Array
    variance: Array

    @classmethod
    def of(cls, output: Array, motion: Array, known: Bools) -> Response:
        """Return the response of an output (N,) to a motion (N,); known : (N,) which samples.

        How many independent frequencies a band has follows from what the coherence of these
        spectra would be with random phases: a single line is always coherent, and shows nothing.
        Every run of samples has a Hann taper and a mean of its own: cut off, slow motions of both
        would leak into all bands, coherent with each other. What is slower than a run counts as
        little as what is slower than a record without gaps.
        """
        taper, both, longest = _tapered(known, output, motion)
        if not longest:
            return cls(np.zeros(0, int), *np.zeros((3, 0)))
        # a sum over neighbouring frequencies has so many times the variance that independent ones
        # would give it: 1.94 without gaps (Percival and Walden, Spectral Analysis, 1993, table 248)
        alike = len(taper) * float((taper**4).sum() / (taper**2).sum() ** 2)
        least = round(_LOWEST * len(taper) / longest)
        band, gains, coherences, variances = [], [], [], []
        low, high = _LOWEST, _LOWEST + _LEAST_BINS
        first = high
        while high <= len(both[0]):
            y, x = (spectrum[low:high] for spectrum in both)
            cross, power = complex(np.vdot(x, y)), float(np.vdot(x, x).real)
            whole = power * float(np.vdot(y, y).real)
            by_chance = float((np.abs(x) ** 2) @ (np.abs(y) ** 2)) * alike
            coherence = min(abs(cross) ** 2 / whole, 1 - 1e-9) if whole > 0 else 0.0
            count = whole / by_chance if by_chance > 0 else 1.0
            if low >= least and count > 1 and (1 - coherence) ** (count - 1) < FALSE_ALARMS:
                band.append(round(np.log2(high / first * len(known) / len(taper))))
                gains.append(np.log(cross / power))
                coherences.append(coherence)
                variances.append((1 - coherence) / (2 * count * coherence))
            low, high = high, 2 * high
        return cls(np.array(band, int), *map(np.array, (gains, coherences, variances)))


def _tapered(known: Bools, *series: Array) -> tuple[Array, list[NDArray[np.complex128]], int]:
    """Return a taper over the longer runs of known samples (N,), from the first of them to the
    last, the spectra there of series (N,) without their means in each, and the length of the
    longest run, 0 without any."""
    found = [run for run in runs(known) if run[1] - run[0] > 2]  # of three samples one is left
    longest = max((end - first for first, end in found), default=0)
    found = [run for run in found if run[1] - run[0] >= _LEAST_RUN * longest]
    if not found:
        return np.zeros(0), [np.zeros(0, complex) for _ in series], 0
    begin, length = found[0][0], found[-1][1] - found[0][0]
    taper, level = np.zeros(length), [np.zeros(length) for _ in series]
    for first, end in found:
        taper[first - begin : end - begin] = np.hanning(end - first)
        for out, values in zip(level, series):
            out[first - begin : end - begin] = values[first:end] - values[first:end].mean()
    return taper, [np.fft.rfft(taper * values) for values in level], longest


@dataclass(frozen=True)
class CommonGain:
    """The factor from a motion to all outputs in all bands.

    gain : positive, the geometric mean of the bands'.
    low, high : bounds of its logarithm, as the noise is in the outputs or in the motion.
    sd : standard deviation of its logarithm, which contains the bands' disagreement.
    degrees : degrees of freedom of this.
    turned, upright : number of bands in which all outputs are clearly opposed, or clearly parallel.
    """

    gain: float
    low: float
    high: float
    sd: float
    degrees: float
    turned: int
    upright: int

    @classmethod
    def of(cls, responses: Sequence[Response]) -> CommonGain | None:
        """Return the factor that the responses of all outputs show; None if none is coherent."""
        band = np.concatenate([r.band for r in responses]) if responses else np.zeros(0, int)
        if not len(band):
            return None
        gains, coherence, variance = (
            np.concatenate([getattr(r, name) for r in responses])
            for name in ("log_gain", "coherence", "variance")
        )
        names, index = np.unique(band, return_inverse=True)
        weight = 1 / variance
        total = np.bincount(index, weight)
        each = np.bincount(index, weight * gains.real) / total
        bound = np.bincount(index, weight * np.log(coherence)) / total
        cosine = [np.cos(gains.imag[index == k]) for k in range(len(names))]
        prior = _ARM_BANDS * _ARM_SD**2
        degrees = _ARM_BANDS + len(names) - 1
        middle = float(each.mean())
        spread = (prior + float(((each - middle) ** 2).sum())) / degrees
        sd = float(np.sqrt((spread + (1 / total).mean()) / len(names)))
        return cls(
            float(np.exp(middle)), middle, middle - float(bound.mean()), sd, degrees,
            sum(bool((c < -0.5).all()) for c in cosine),
            sum(bool((c > 0.5).all()) for c in cosine),
        )  # fmt: skip

    @property
    def reach(self) -> float:
        """How far the logarithm may be from its bounds at the stated rate of false alarms."""
        from scipy.stats import t

        return float(self.sd * t.isf(FALSE_ALARMS / 2, self.degrees))

    @property
    def opposed(self) -> bool:
        """Whether the outputs are opposed to the motion in too many bands for resonances."""
        return self.turned >= _TURNED_BANDS and not self.upright

    def excludes(self, factor: float) -> bool:
        """Return whether a positive factor is excluded at the stated rate of false alarms."""
        at = np.log(factor)
        return bool(max(self.low - at, at - self.high) > self.reach)
