"""Pictures of the shake: over time, spectra of it and of velocities, accelerometers, residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.report.plot.axes import (
    COLOURS,
    MUTED,
    NAIVE,
    SMOOTHED,
    Curve,
    Vertical,
    axes_of,
    axis_number,
    camera_colour,
    columns_of,
    draw_curves,
    nothing_to_draw,
)
from telerig.io.report.plot.spectrum import shake_spectrum, velocity_spectrum
from telerig.short_text import is_number, no_formula
from telerig.spectra import LEAST_FRAMES

__all__ = ["accelerometer", "offsets", "shake", "spectra", "spectrum", "whiteness"]

_DECADES = 6.0
_WINDOW = 1_000


def shake(
    table: pd.DataFrame,
    camera: str,
    axis: str = "",
    *,
    up: str = "-y",
    axes: Any = None,
) -> Any:
    """Draw a camera's shake over time with bands of ± 2 sd; returns axes.

    table : `Smoothing.shake` or shake.csv; of a long one the middle. axis : of the rig, "x", "y",
    "z" or several of them; "" for those along which it moves. up : the axis that points upwards,
    whose shake is drawn as height. Raises InputError for an unknown camera or axis.
    """
    vertical, first = Vertical.of(up), max(0, (len(table) - _WINDOW) // 2)
    part = table.iloc[first : first + _WINDOW]
    curves = []
    for letter in axis or "xyz":
        number = axis_number(letter)
        t, values = columns_of(part, "t_s", f"{camera}_{letter}_mm", made_by="Smoothing.shake")
        if not (axis or values.any()):
            continue
        name = f"s{camera}_{letter}_mm"
        sd = 1e3 * part[name].to_numpy(float) if name in part else None
        offset = 1e3 * vertical.sign_of(number) * values
        curves.append(Curve(t, offset, COLOURS[number], vertical.name(number), sd))
    if not curves:
        raise nothing_to_draw(f"camera {camera} does not move")
    axes = axes_of(axes, xlabel="t / s", ylabel=f"shake of {no_formula(camera)} / µm")
    draw_curves(axes, curves)
    return axes


def spectrum(
    table: pd.DataFrame,
    camera: str,
    axis: str = "",
    *,
    modes_hz: Sequence[float] = (),
    up: str = "-y",
    axes: Any = None,
) -> Any:
    """Draw the power spectral density of a camera's shake, in µm²/Hz; returns axes.

    table, axis, up : as for `shake`. modes_hz : frequencies that dotted lines mark. Raises
    InputError for an unknown camera and for less than 32 frames.
    """
    vertical = Vertical.of(up)
    columns_of(table, "t_s", *(f"{camera}_{a}_mm" for a in "xyz"), made_by="Smoothing.shake")
    found = shake_spectrum(table, camera)
    if found is None:
        raise nothing_to_draw(f"a spectrum takes {LEAST_FRAMES} frames")
    curves = [
        (vertical.name(number), COLOURS[number], found.frequency_hz[1:], found.density[1:, number])
        for number in map(axis_number, axis or "xyz")
        if axis or found.density[1:, number].any()
    ]
    label = f"shake of {no_formula(camera)} / (µm²/Hz)"
    return _densities(axes, label, curves, modes_hz)


def spectra(
    trajectories: pd.DataFrame,
    axis: str = "",
    *,
    modes_hz: Sequence[float] = (),
    up: str = "-y",
    axes: Any = None,
) -> Any:
    """Draw the power spectral density of the bubbles' velocity; returns axes.

    trajectories : `Smoothing.trajectories` or bubbles.csv: the mean over the longest tracks. axis :
    "x", "y" or "z", of which the naive velocity is drawn beside the smoothed one; "" for the
    smoothed velocity along all three. modes_hz, up : as for `spectrum`. Raises InputError for
    tracks below 32 frames.
    """
    vertical, smooth = Vertical.of(up), velocity_spectrum(trajectories)
    hz = smooth.frequency_hz[1:]
    if not axis:
        curves = [(vertical.name(i), COLOURS[i], hz, smooth.density[1:, i]) for i in range(3)]
        return _densities(axes, "velocity / ((mm/s)²/Hz)", curves, modes_hz)
    number = axis_number(axis)
    curves = [("smoothed", SMOOTHED, hz, smooth.density[1:, number])]
    try:
        naive = velocity_spectrum(trajectories, "naive_")
    except InputError:
        pass
    else:
        before = naive.density[1:, number]
        curves.insert(0, ("before smoothing", NAIVE, naive.frequency_hz[1:], before))
    return _densities(axes, f"v{axis} / ((mm/s)²/Hz)", curves, modes_hz)


def accelerometer(found: Mapping[str, Any], *, axes: Any = None) -> Any:
    """Draw spectra of an accelerometer's readings, of their residuals and of the stated noise.

    found : an entry of ``summary["accelerometer_spectra"]`` of a `telerig.Smoothing`. Returns axes.
    """
    hz, before, after = (
        np.array(found[key], float) for key in ("frequency_hz", "reading", "residual")
    )
    curves = [("readings", NAIVE, hz, before), ("left by the model", SMOOTHED, hz, after)]
    noise: Any = found.get("noise")
    if is_number(noise):
        curves.append(("stated noise", MUTED, hz, np.full(len(hz), float(noise))))
    return _densities(axes, "acceleration / ((m/s²)²/Hz)", curves)


def offsets(
    t_s: Sequence[float],
    off_um: Sequence[Sequence[float]],
    sd_um: Sequence[Sequence[float]],
    *,
    axes: Any = None,
) -> Any:
    """Draw how far a smoothed mark is from its mean, with bands of ± 2 sd; returns axes.

    t_s : (N,). off_um, sd_um : (3, N) along x, y, z, or (2, N) along u, v; `t_s`, `off_um` and
    `sd_um_of_time` of a mark in what `telerig validate` writes.
    """
    axes = axes_of(axes, xlabel="t / s", ylabel="off / µm")
    names = "xyz" if len(off_um) == 3 else "uv"
    draw_curves(axes, (
        Curve(np.array(t_s), np.array(off), COLOURS[i], names[i], np.array(sd))
        for i, (off, sd) in enumerate(zip(off_um, sd_um))
    ))  # fmt: skip
    return axes


def whiteness(found: Mapping[str, Any], *, axes: Any = None) -> Any:
    """Draw the autocorrelation of the bubbles' residuals by camera, beside the model's.

    found : ``summary["whiteness"]`` of a `telerig.Smoothing`. Returns axes. Raises InputError where
    nothing was judged.
    """
    known = {name: one for name, one in found.items() if "expected" in one}
    if not known:
        raise nothing_to_draw("the residuals of this run were not judged")
    curves = []
    for i, (camera, one) in enumerate(known.items()):
        values = np.array(one["autocorrelation"], float)
        lags, style = np.arange(1.0, len(values) + 1), {"marker": "o"}
        curves.append(Curve(lags, values, camera_colour(i), no_formula(camera), style=style))
    model = np.mean([np.array(one["expected"], float) for one in known.values()], 0)
    lags = np.arange(1.0, len(model) + 1)
    curves.append(Curve(lags, model, MUTED, "model", style={"linestyle": "--"}))
    axes = axes_of(axes, xlabel="frames apart", ylabel="correlation")
    draw_curves(axes, curves)
    axes.axhline(0, color=MUTED, linewidth=0.7)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -0.2), max(high, 0.2))
    return axes


def _densities(
    axes: Any,
    label: str,
    curves: Sequence[tuple[str, str, Array, Array]],
    modes_hz: Sequence[float] = (),
) -> Any:
    """Draw densities (name, colour, Hz, density) on logarithmic axes."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    if not curves:
        raise nothing_to_draw("no axis moves")
    bottom, top = density_limits([density for *_, density in curves])
    axes = axes_of(axes, xlabel="frequency / Hz", ylabel=label, xscale="log", yscale="log")
    for frequency_hz in modes_hz:
        axes.axvline(frequency_hz, color=MUTED, linewidth=0.7, linestyle=":")
    draw_curves(axes, (Curve(hz, y, colour, name, style={"linewidth": 1.1})
                       for name, colour, hz, y in curves))  # fmt: skip
    low, high = min(hz[0] for _, _, hz, _ in curves), max(hz[-1] for _, _, hz, _ in curves)
    axes.set(xlim=(low, high), ylim=(bottom / 2, top * 2))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    return axes


def density_limits(densities: Sequence[Array]) -> tuple[float, float]:
    """Return the least and the largest density to draw: six decades, or more to show each curve."""
    positive = [y[y > 0] for y in densities if (y > 0).any()] or [np.ones(1)]
    top, least = (float(end(np.concatenate(positive))) for end in (np.max, np.min))
    half_seen = min(float(np.median(y)) for y in positive)
    return max(least, min(half_seen, top * 10**-_DECADES)), top
