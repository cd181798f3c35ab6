"""Finds the samples of an accelerometer that cannot be right: spikes, clipped and frozen ones.

`screened` masks them one by one; what it misses gets less weight in the smoothing graph.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.findings import Finding
from telerig.estimator.sensors.given import Sensor
from telerig.estimator.sensors.record_numbers import noise_density, sampling_rate
from telerig.estimator.sensors.spikes import shifted_samples, spike_samples
from telerig.estimator.sensors.stopped import clippings, frozen_samples
from telerig.rig.units import MICRO_G_M_S2
from telerig.statistics import GAP_STEPS

_MOST_MASKED = 0.5
_MOST_CLIPPED = 0.1


def screened(sensor: Sensor) -> tuple[Sensor, list[Finding]]:
    """Return the sensor without samples that cannot be right, and warnings that count them.

    These samples are masked (``kept``), and their readings are interpolated, because filters need
    a complete record. An axis that is often clipped or never changes is not used. If the noise
    density is not stated, it is estimated.
    """
    t, reading, where = sensor.t_s, sensor.reading_m_s2, sensor.where
    findings: list[Finding] = []

    def warn(words: str, masked: Bools) -> None:
        first = float(t[np.argmax(masked)])
        findings.append(Finding(f"{words}, the first at {first:.6g} s", where))

    unused = set(np.flatnonzero(np.ptp(reading, axis=0) == 0).tolist())
    for axis in sorted(unused):
        words = f"a{'xyz'[axis]} never changes: the sensor is stuck, or not connected"
        findings.append(Finding(f"{words}, and the axis is not used", where))
    clipped = np.zeros(len(t), bool)
    for found in clippings(reading, sensor.range_m_s2):
        count, name = np.count_nonzero(found.samples), f"a{'xyz'[found.axis]}"
        often = count > _MOST_CLIPPED * len(t)
        words = f"{count} of {len(t)} samples of {name} are clipped at {found.value:.4g} m/s^2: "
        words += "the sensor's range is too small"
        if often:
            unused.add(found.axis)
        else:
            clipped |= found.samples
        warn(f"{words}, and {f'{name} is' if often else 'they are'} not used", found.samples)
    density = sensor.noise_density_ug_sqrt_hz
    if density is None:
        density = noise_density(t, np.delete(reading, list(unused), axis=1))
        words = f"no noise density is given; {density:.3g} ug/sqrt(Hz) are estimated"
        todo = "give noise_density_ug_sqrt_hz from the data sheet"
        findings.append(Finding(words, where, todo, is_fault=False))
    sigma = density * MICRO_G_M_S2 * np.sqrt(sampling_rate(t) / 2)
    frozen = frozen_samples(reading, sigma) & ~clipped
    if frozen.any():
        words = f"{np.count_nonzero(frozen)} of {len(t)} samples repeat the one before: the sensor "
        warn(f"{words}had stopped, and they are not used", frozen)
    axes = [a for i, a in enumerate(reading.T) if i not in unused]
    spikes = np.any([np.zeros(len(t), bool), *map(spike_samples, axes)], axis=0)
    spikes &= ~clipped & ~frozen
    if spikes.any():
        warn(f"{np.count_nonzero(spikes)} of {len(t)} samples are spikes and are not used", spikes)
    shifted = shifted_samples(np.delete(reading, list(unused), axis=1)) & ~clipped & ~frozen
    if shifted.any():
        words = (
            f"{np.count_nonzero(shifted)} of {len(t)} samples are offset from the samples before "
        )
        warn(f"{words}and after them (a loose cable?): they are not used", shifted)
    findings += _gaps(t, where)
    kept = ~(clipped | frozen | spikes | shifted)
    filled = reading
    if not kept.all() and kept.any():
        filled = np.stack([np.interp(t, t[kept], a[kept]) for a in reading.T], -1)
    return replace(
        sensor, reading_m_s2=filled, kept=kept, noise_density_ug_sqrt_hz=density,
        unused_axes=tuple(sorted(unused)),
    ), findings  # fmt: skip


def mostly_masked(sensor: Sensor) -> Finding | None:
    """Return a warning if so much of the record is not used that the sensor has to be left out."""
    share = 1 - float(sensor.kept.mean())
    if share <= _MOST_MASKED and len(sensor.unused_axes) < 3:
        return None
    what = "none of its axes" if len(sensor.unused_axes) == 3 else f"{100 * share:.0f} % of its"
    words = f"{what} can be used" if "axes" in what else f"{what} samples cannot be used"
    todo = "record again with a wider range, or repair the sensor"
    return Finding(f"{words}, so the sensor is left out", sensor.where, todo)


def _gaps(t: Array, where: str) -> list[Finding]:
    """Return a warning about steps in which samples are missing."""
    steps = np.diff(t)
    gaps = np.flatnonzero(steps > GAP_STEPS * np.median(steps))
    if not len(gaps):
        return []
    words = (
        f"samples are missing in {len(gaps)} gap{'s' * (len(gaps) > 1)}, the first of "
        f"{1000 * steps[gaps[0]]:.3g} ms at {t[gaps[0]]:.6g} s, the longest of "
        f"{1000 * steps[gaps].max():.3g} ms"
    )
    return [Finding(words, where)]
