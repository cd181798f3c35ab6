"""The table of what shakes: frequency, damping, RMS, where, and what a mechanic could do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoother.model import CARRIAGE, RigMode, ShakeModel
from telerig.estimator.smoother.solve import Solution

Array = NDArray[np.float64]

_LOWEST_HZ = 2.0
_MOST_PEAKS = 3
_LEAST_SHARE = 0.08
_SIGNIFICANT = 3.0


def shake_modes(solution: Solution) -> list[dict[str, Any]]:
    """Rows {where, frequency_hz, damping, rms_mm (x, y, z), source, remedy}, strongest first.

    Modes of the model as they are (source "model"); without any, peaks in the spectrum of the
    estimated offsets (source "estimate"); peaks of the carriage about its travel are the servo's.
    """
    frame = solution.frame
    names = [c.name for c in frame.problem.cameras]
    if frame.model.modes:
        rows = [_from_model(mode, names) for mode in frame.model.modes]
    else:
        rows = _from_offsets(solution, names)
    rows += _from_carriage(solution)
    return sorted(rows, key=lambda row: -max(row["rms_mm"]))


def _from_model(mode: RigMode, names: Sequence[str]) -> dict[str, Any]:
    where = "common" if mode.camera == CARRIAGE else f"arm {names[mode.camera]}"
    return _row(where, mode.frequency_hz, mode.damping, mode.rms_mm, "model")


def _row(
    where: str, frequency_hz: float, damping: float, rms_mm: Sequence[float], source: str
) -> dict[str, Any]:
    return {
        "where": where,
        "frequency_hz": float(frequency_hz),
        "damping": float(damping),
        "rms_mm": [float(r) for r in rms_mm],
        "source": source,
        "remedy": remedy(where, frequency_hz, damping),
    }


def remedy(where: str, frequency_hz: float, damping: float) -> str:
    """What would make this mode smaller."""
    if where == "servo":
        return "tune the stage's controller: more damping, a softer ramp, less gain at this line"
    if where == "common":
        text = "all cameras move alike: stiffen the mount between carriage and camera bridge, "
        text += "or lighten what hangs on it"
    else:
        text = f"the {where} swings by itself: shorten or brace it, or counterweight its camera"
    if damping < 0.02:
        text += "; it rings: a layer of damping helps as much as stiffness"
    if frequency_hz < 5:
        text += "; so slow a swing is also driven by the travel: ramp the stage up more softly"
    return text


def _from_offsets(solution: Solution, names: Sequence[str]) -> list[dict[str, Any]]:
    """Peaks of the mean of the cameras' offsets, and of what each has beyond it."""
    frame, found = solution.frame, solution.covariances
    if not frame.shake.size or not frame.model.broad_bands:
        return []
    rows = frame.shake.offset[:-1]
    offsets = np.einsum("cid,fd->cfi", rows, solution.state.shake[frame.nodes.of_frame])
    noise = np.zeros(3)
    if found is not None:
        noise = np.einsum("cid,fde,cie->i", rows, found.shake, rows, optimize=True)
        noise = noise / len(rows) / len(frame.problem.t_s)
    seen = np.abs(rows).sum(-1) > 0
    shared = offsets.sum(0) / np.maximum(seen.sum(0), 1)[None]
    out = _peaks(frame.problem.t_s, shared, noise, "common")
    for camera, name in enumerate(names):
        both = seen[camera] & (seen.sum(0) > 1)
        # with two arms alike, half of each arm's own variance went into the mean
        own = (offsets[camera] - shared) * both * np.sqrt(len(names) / max(len(names) - 1, 1))
        out += _peaks(frame.problem.t_s, own, noise, f"arm {name}")
    return out


def _peaks(t_s: Array, values: Array, noise: Array, where: str) -> list[dict[str, Any]]:
    """Lines in (F, 3) series that hold a good share of the variance and rise above its noise."""
    from scipy.signal import periodogram

    step = float(np.median(np.diff(t_s)))
    if len(t_s) < 32 or not np.any(values):
        return []
    grid = np.arange(t_s[0], t_s[-1] + step / 2, step)
    even = np.stack([np.interp(grid, t_s, v) for v in values.T], -1)
    frequency, each = periodogram(even, 1 / step, "hann", axis=0)
    total = each.sum(-1)
    width, variance = frequency[1], float(total.sum() * frequency[1])
    peak = np.r_[False, (total[1:-1] > total[:-2]) & (total[1:-1] >= total[2:]), False]
    peak &= frequency >= max(_LOWEST_HZ, 2 * width)
    out = []
    for i in sorted(np.flatnonzero(peak), key=lambda at: -total[at])[:_MOST_PEAKS]:
        half = _half_width(total, int(i))
        near = slice(max(i - 2 * half, 0), i + 2 * half + 1)
        power = each[near].sum(0) * width
        if power.sum() < _LEAST_SHARE * variance or power.sum() < _SIGNIFICANT * noise.sum() / 10:
            continue
        damping = half * width / frequency[i]
        out.append(_row(where, frequency[i], damping, np.sqrt(power).tolist(), "estimate"))
    return out


def _half_width(total: Array, peak: int) -> int:
    """Bins from a peak to where it has half of its height."""
    below = np.flatnonzero(total[peak:] < total[peak] / 2)
    above = np.flatnonzero(total[peak::-1] < total[peak] / 2)
    sides = [side[0] for side in (below, above) if len(side)]
    return int(max(1, min(sides, default=1)))


def _from_carriage(solution: Solution) -> list[dict[str, Any]]:
    """Following errors: lines of the encoder's record after a smooth travel is taken off."""
    problem, model = solution.frame.problem, solution.frame.model
    if problem.stage is None:
        return []
    t, position = problem.stage.t_s, problem.stage.position_mm
    late = t > t[0] + 0.2 * (t[-1] - t[0])
    if late.sum() < 64:
        return []
    t, position = t[late], position[late]
    x = 2 * (t - t[0]) / (t[-1] - t[0]) - 1
    rest = position - np.polynomial.Chebyshev.fit(x, position, 5)(x)
    noise = _encoder_noise(model)
    values = rest[:, None] * np.abs(problem.axis)
    rows = _peaks(t, values, np.full(3, noise**2 / 3), "servo")
    return [row for row in rows if max(row["rms_mm"]) > _SIGNIFICANT * noise][:1]


def _encoder_noise(model: ShakeModel) -> float:
    return model.encoder_sigma_mm
