"""Pictures of a smoothed run: places, velocities, shake, spectra, residuals; and their sections."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.report.page.figures import (
    CAMERA_COLOURS,
    LEFT_OUT,
    MUTED,
    NAIVE,
    RTS,
    SMOOTHED,
    Curve,
    Picture,
    camera_colour,
    draw_curves,
    drawing,
)
from telerig.io.report.plot.spectrum import shake_spectrum, velocity_spectrum
from telerig.io.report.run.smoothing.bubbles import BUBBLE_PICTURES
from telerig.io.report.run.tracking.scene import track_colour
from telerig.io.results.folders.smoothing import (
    AXES,
    PLACE,
    SPEED,
    SmoothingResults,
    column,
    known_parts,
    shake_rms_um,
)
from telerig.short_text import is_number, number
from telerig.spectra import Spectrum
from telerig.statistics import median, rms

PLACES = ("first", "bubbles", "lab", "taken", "velocity", "shake", "spectra", "white")
"""Sections that hold drawings."""


def smoothing_drawings(results: SmoothingResults) -> list[tuple[str, Callable[[], Any]]]:
    """Return (section, function); the function returns a `Picture`, or None without data."""
    axes, up = range(3), int(np.argmax(np.abs(results.up)))
    bubbles = axes if len(results.trajectories) else range(0)
    shaken = sorted(results.cameras, key=lambda c: -_largest_shake_um(results, c))
    drawings: list[tuple[str, Callable[[], Any]]] = [
        *(("lab", partial(places, results, axis)) for axis in bubbles),
        *(("first" if axis == up else "lab", partial(closer, results, axis)) for axis in bubbles),
        *(("taken", partial(taken_off, results, axis)) for axis in bubbles),
        *(("velocity", partial(velocities, results, axis)) for axis in bubbles),
    ]
    for camera in results.cameras if len(results.shake) else ():
        drawings += [("shake", partial(shake_in_time, results, camera, axis))
                     for axis in results.seen(camera)]  # fmt: skip
    drawings += [("spectra", partial(velocity_before_and_after, results, axis)) for axis in axes]
    drawings += [("first" if c == shaken[0] else "spectra", partial(shake_spectra, results, c))
                 for c in results.cameras]  # fmt: skip
    drawings += [
        ("spectra", partial(accelerometer_before_and_after, results, sensor))
        for sensor in accelerometer_names(results)
    ]
    judged = known_parts(results, "whiteness", "expected")
    drawings += [("bubbles", partial(draw, results)) for draw in BUBBLE_PICTURES]
    return [*drawings, *([("white", partial(autocorrelation, results))] if judged else [])]


def _largest_shake_um(results: SmoothingResults, camera: str) -> float:
    return max((shake_rms_um(results, camera, axis) or 0.0 for axis in AXES), default=0.0)


_MOST_BUBBLES = 60
_FEW = 3
_WINDOW = 1_000
_CLOSE = 60
_BANDS = "Bands are ± 2 sd."


def places(results: SmoothingResults, axis: int) -> Picture:
    """Draw one laboratory coordinate of all bubbles, beside naive and RTS for few bubbles."""
    shown = results.bubbles[:_MOST_BUBBLES]
    name, curves = PLACE.format(AXES[axis]), []
    for particle in shown:
        table = results.track(particle)
        t = table["t_s"].to_numpy(float)
        if len(shown) <= _FEW:
            thin = {"linewidth": 0.6}
            curves.append(Curve(t, column(table, f"naive_{name}"), NAIVE, "naive"))
            curves.append(Curve(t, column(table, f"rts_{name}"), RTS, "RTS", style=thin))
        sd = column(table, f"s{name}")
        label = "smoothed" if len(shown) <= _FEW else ""
        curves.append(Curve(t, column(table, name), track_colour(particle), label, sd))
    median_sd = median(column(results.trajectories, f"s{name}"))
    caption = (
        f"{_upside_down(results, axis)}A colour per bubble. {_BANDS} The sd is {_um(median_sd)} "
        "(median): look closer below."
    )
    if len(shown) < len(results.bubbles):
        caption += f" The {len(shown)} longest of {number(len(results.bubbles))} are drawn."
    label = f"lab {AXES[axis]} / mm"
    return _in_time(results, axis, f"{AXES[axis]} against time", label, curves, caption)


def closer(results: SmoothingResults, axis: int) -> Picture:
    """Draw some frames from the middle of the longest track, detrended."""
    table, _ = detail(results)
    first = max(0, (len(table) - _CLOSE) // 2)
    table = table.iloc[first : first + _CLOSE]
    name, t = PLACE.format(AXES[axis]), table["t_s"].to_numpy(float)
    smooth, naive, rts = (column(table, kind + name) for kind in ("", "naive_", "rts_"))
    straight = _straight(t, smooth)
    dots = {"linestyle": "none", "marker": ".", "markersize": 4}
    curves = [
        Curve(t, naive - straight, NAIVE, "naive", style=dots),
        Curve(t, rts - straight, RTS, "RTS"),
        Curve(t, smooth - straight, SMOOTHED, "smoothed", column(table, f"s{name}")),
    ]
    slope = (straight[-1] - straight[0]) / (t[-1] - t[0]) if len(t) > 1 else 0.0
    caption = (
        f"Bubble {results.bubbles[0]}, {number(len(t))} frames of its middle, without a straight "
        f"line of {number(float(slope), 3)} mm/s. {_BANDS}{_marks(table)}"
    )
    label = f"lab {AXES[axis]}, less a line / mm"
    return _in_time(results, axis, f"{AXES[axis]}, closer", label, curves, caption, table)


def taken_off(results: SmoothingResults, axis: int) -> Picture:
    """Draw naive and RTS minus smoothed, against the band of the smoothed path."""
    table, where = detail(results)
    name = PLACE.format(AXES[axis])
    t, smooth = table["t_s"].to_numpy(float), column(table, name)
    sd = 1e3 * column(table, f"s{name}")
    naive, rts = (1e3 * (column(table, kind + name) - smooth) for kind in ("naive_", "rts_"))
    off, own = rms(naive), median(sd)
    times = f", {number(off / own, 2)} times the sd of smoothed" if off and own else ""
    caption = (
        f"Naive minus smoothed is {number(off, 3)} µm RMS{times}; RTS minus smoothed is "
        f"{number(rms(rts), 3)} µm. {_BANDS}{_marks(table)} {where}"
    )
    title, label = f"{AXES[axis]}: what smoothing took off", f"{AXES[axis]}, less smoothed / µm"
    curves = _three(t, np.zeros(len(t)), naive, rts, sd)
    caption += f" {_upside_down(results, axis)}"
    return _in_time(results, axis, title, label, curves, caption, table)


def velocities(results: SmoothingResults, axis: int) -> Picture:
    """Draw the longest track's velocity: smoothed with its band, naive, RTS."""
    table, where = detail(results)
    name = SPEED.format(AXES[axis])
    smooth, naive, rts = (column(table, kind + name) for kind in ("", "naive_", "rts_"))
    sd = column(table, f"s{name}")
    caption = (
        "The naive velocity (differences of raw positions) differs by "
        f"{number(rms(naive - smooth), 3)} mm/s RMS from the smoothed one, whose estimated "
        f"uncertainty is {number(median(sd), 3)} mm/s (1 sd, median over the frames). "
        f"{_BANDS}{_marks(table)} {where} "
        f"{_upside_down(results, axis)}"
    )
    title, label = f"Velocity in {AXES[axis]}", f"v{AXES[axis]} / (mm/s)"
    curves = _three(table["t_s"].to_numpy(float), smooth, naive, rts, sd)
    return _in_time(results, axis, title, label, curves, caption, table)


def detail(results: SmoothingResults) -> tuple[pd.DataFrame, str]:
    """Return the longest track, cut to its middle if very long, and which it is in words."""
    particle = results.bubbles[0]
    table, cut = _middle(results.track(particle), "its middle")
    longest = ", the longest track" if len(results.bubbles) > 1 else ""
    return table, f"Bubble {particle}{longest}{cut.replace(' ', ', ', 1) if cut else '.'}"


def _middle(table: pd.DataFrame, of: str) -> tuple[pd.DataFrame, str]:
    """Return at most `_WINDOW` rows from the middle, and a sentence on it if cut."""
    if len(table) <= _WINDOW:
        return table, ""
    first = (len(table) - _WINDOW) // 2
    return table.iloc[first : first + _WINDOW], f" {number(_WINDOW)} frames of {of}."


def _three(t: Array, smooth: Array, naive: Array, rts: Array, sd: Array) -> list[Curve]:
    """Return three curves, smoothed on top of naive and RTS."""
    return [
        Curve(t, naive, NAIVE, "naive", style={"linewidth": 0.7}),
        Curve(t, rts, RTS, "RTS"),
        Curve(t, smooth, SMOOTHED, "smoothed", sd, style={"linewidth": 1.1}),
    ]


def _in_time(
    results: SmoothingResults,
    axis: int | None,
    title: str,
    label: str,
    curves: Sequence[Curve],
    caption: str,
    table: pd.DataFrame | None = None,
    height_in: float = 2.6,
) -> Picture:
    """A plot against time. axis : of the rig, turned round where it points down; None: upright.

    table : a track, whose frames without an image get red ticks.
    """
    settings: dict[str, Any] = {"xlabel": "t / s", "ylabel": label}
    with drawing(height_in, legend="above", grid=True, **settings) as sheet:
        draw_curves(sheet, curves)
        if table is not None:
            t = table["t_s"].to_numpy(float)[column(table, "observed") == 0]
            sheet.axes.plot(t, np.full(len(t), 0.015), "|", color=LEFT_OUT, markersize=5,
                            transform=sheet.axes.get_xaxis_transform(), zorder=5)  # fmt: skip
        if axis is not None and _upside_down(results, axis):
            sheet.axes.invert_yaxis()
    return Picture(title, sheet.source, caption)


def _upside_down(results: SmoothingResults, axis: int) -> str:
    """Return a remark for an axis that points down, which is drawn reversed; else ""."""
    return "The axis is turned round, so that up is up. " if results.up[axis] < -0.5 else ""


def _straight(t: Array, values: Array) -> Array:
    there = np.isfinite(values)
    if there.sum() < 2:
        return np.full(len(t), median(values) or 0.0)
    return np.asarray(np.polyval(np.polyfit(t[there] - t[0], values[there], 1), t - t[0]))


def _marks(table: pd.DataFrame) -> str:
    missing = int(np.sum(column(table, "observed") == 0))
    return f" Red ticks: {number(missing)} frames without an image of it." if missing else ""


def _um(sd_mm: float | None) -> str:
    return f"{number(None if sd_mm is None else 1e3 * sd_mm, 3)} µm"


_DECADES = 6.0
_PARTLY = 0.2
_MOST_DB = 99.0


def shake_in_time(results: SmoothingResults, camera: str, axis: str) -> Picture:
    """Draw a camera's shake with its band."""
    table, note = _middle(results.shake, "the run's middle")
    t = table["t_s"].to_numpy(float)
    value = 1e3 * column(table, f"{camera}_{axis}_mm")
    sd = 1e3 * column(table, f"s{camera}_{axis}_mm")
    size = shake_rms_um(results, camera, axis)
    caption = (
        f"RMS {number(size, 3)} µm over the run, sd of the estimate {number(median(sd), 3)} µm "
        f"(median). The band is ± 2 sd.{note}"
    )
    depth = results.depth(camera)
    part = 0.0 if depth is None else abs(float(depth[AXES.index(axis)]))
    if part >= _PARTLY:
        caption += (
            f" This axis lies partly ({100 * part:.0f} %) along the camera's depth, which it does "
            "not see: the band holds the prior's spread there."
        )
    index = AXES.index(axis)
    if words := _upside_down(results, index):
        caption += f" {words}"
    title, colour = f"Shake of camera {camera} in {axis}", results.cameras.index(camera)
    curves = [Curve(t, value, camera_colour(colour), sd=sd)]
    return _in_time(results, index, title, f"{axis} / µm", curves, caption, height_in=2.3)


def velocity_before_and_after(results: SmoothingResults, axis: int) -> Picture | None:
    """Draw the spectrum of the bubbles' velocity: naive, RTS, smoothed."""
    kinds = (("naive_", NAIVE, "naive"), ("rts_", RTS, "RTS"), ("", SMOOTHED, "smoothed"))
    found = {
        label: (spectrum, colour)
        for kind, colour, label in kinds
        if (spectrum := _velocity_spectrum(results, kind)) is not None
    }
    if "smoothed" not in found:
        return None
    smooth = found["smoothed"][0]
    caption = ""
    if "naive" not in found:
        caption = "There is no naive trajectory to compare with. "
    elif (naive := found["naive"][0]).density.shape == smooth.density.shape:
        before, after = naive.density[1:, axis], smooth.density[1:, axis]
        gain = 10 * np.log10(np.maximum(before, 1e-30) / np.maximum(after, 1e-30))
        at = int(np.argmax(before - after))
        caption = (
            f"Smoothing takes off most at {number(float(naive.frequency_hz[1 + at]), 3)} Hz: "
            f"{min(gain[at], _MOST_DB):.0f} dB. What the motion itself holds should stay where it "
            "was. "
        )
    curves = [
        Curve(s.frequency_hz[1:], s.density[1:, axis], colour, label, style=_THICK)
        for label, (s, colour) in found.items()
    ]
    title, unit = f"Spectrum of the velocity in {AXES[axis]}", f"v{AXES[axis]} / ((mm/s)²/Hz)"
    return _spectra(title, unit, curves, caption + _resolution(smooth), _modes_hz(results))


def _velocity_spectrum(results: SmoothingResults, kind: str) -> Spectrum | None:
    """Return None where no track is long enough or the columns are empty."""
    try:
        return velocity_spectrum(results.trajectories, kind)
    except InputError:
        return None


def _resolution(spectrum: Spectrum) -> str:
    return f"Welch's estimate, steps of {number(spectrum.step_hz, 2)} Hz."


def shake_spectra(results: SmoothingResults, camera: str) -> Picture | None:
    """Draw the spectrum of a camera's shake on the axes that it sees."""
    spectrum = shake_spectrum(results.shake, camera)
    seen = results.seen(camera)
    if spectrum is None or not seen:
        return None
    frequency, curves, peaks = spectrum.frequency_hz[1:], [], []
    for axis in seen:
        i = AXES.index(axis)
        density = spectrum.density[1:, i]
        curves.append(Curve(frequency, density, CAMERA_COLOURS[i], axis, style=_THICK))
        peaks.append(f"{number(float(frequency[int(np.argmax(density))]), 3)} Hz in {axis}")
    caption = f"Strongest at {', '.join(peaks)}. {_resolution(spectrum)}"
    title = f"Spectrum of the shake of camera {camera}"
    return _spectra(title, "shake / (µm²/Hz)", curves, caption, _modes_hz(results))


_THICK = {"linewidth": 1.1}


def _spectra(
    title: str, label: str, curves: Sequence[Curve], caption: str, marked_hz: Sequence[float] = ()
) -> Picture:
    """Draw densities on logarithmic axes, with dotted lines at ``marked_hz``."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    bottom, top = density_limits([curve.y for curve in curves])
    limits = min(curve.x[0] for curve in curves), max(curve.x[-1] for curve in curves)
    settings: dict[str, Any] = {
        "xlabel": "frequency / Hz",
        "ylabel": label,
        "xscale": "log",
        "yscale": "log",
    }
    with drawing(2.6, legend="above", grid=True, **settings) as sheet:
        for frequency_hz in marked_hz:
            sheet.axes.axvline(frequency_hz, color=MUTED, linewidth=0.7, linestyle=":")
        draw_curves(sheet, curves)
        sheet.axes.set(xlim=limits, ylim=(bottom / 2, top * 2))
        sheet.axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        sheet.axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        sheet.axes.xaxis.set_minor_formatter(NullFormatter())
    return Picture(title, sheet.source, caption)


def density_limits(densities: Sequence[Array]) -> tuple[float, float]:
    """Return the least and the largest density to draw: six decades, or more to show each curve."""
    positive = [y[y > 0] for y in densities if (y > 0).any()] or [np.ones(1)]
    top, least = (float(end(np.concatenate(positive))) for end in (np.max, np.min))
    half_seen = min(float(np.median(y)) for y in positive)
    return max(least, min(half_seen, top * 10**-_DECADES)), top


def _modes_hz(results: SmoothingResults) -> list[float]:
    """Return the frequencies of the model's modes."""
    return [float(mode["frequency_hz"]) for mode in results.part("model").get("modes") or []]


_LITTLE = 0.5


def autocorrelation(results: SmoothingResults) -> Picture:
    """Draw the autocorrelation of the bubbles' pixels by camera, beside the model's."""
    known = known_parts(results, "whiteness", "expected")
    curves = []
    for camera, found in known.items():
        values = np.array(found["autocorrelation"], float)
        index = results.cameras.index(camera) if camera in results.cameras else 0
        lags = np.arange(1.0, len(values) + 1)
        curves.append(Curve(lags, values, camera_colour(index), camera, style={"marker": "o"}))
    model = np.mean([np.array(found["expected"], float) for found in known.values()], 0)
    curves.append(Curve(lags, model, MUTED, "model", style={"linestyle": "--"}))
    settings: dict[str, Any] = {"xlabel": "frames apart", "ylabel": "correlation"}
    with drawing(2.3, legend="above", grid=True, **settings) as sheet:
        draw_curves(sheet, curves)
        sheet.axes.axhline(0, color=MUTED, linewidth=0.7)
        low, high = sheet.axes.get_ylim()
        sheet.axes.set_ylim(min(low, -0.2), max(high, 0.2))
    return Picture(
        "Residuals some frames apart",
        sheet.source,
        "Both coordinates of the bubbles' pixels, outliers left out. The fit follows part of the "
        "noise, so that neighbours differ more than noise does; dashed: by how much, drawn from "
        "the model.",
    )


def accelerometer_before_and_after(results: SmoothingResults, sensor: str) -> Picture | None:
    """Draw spectra of a sensor's readings, of the residuals and of its stated noise."""
    found = known_parts(results, "accelerometer_spectra", "frequency_hz").get(sensor)
    if found is None:
        return None
    frequency, before, after = (
        np.array(found[key], float) for key in ("frequency_hz", "reading", "residual")
    )
    curves = [
        Curve(frequency, before, NAIVE, "readings", style=_THICK),
        Curve(frequency, after, SMOOTHED, "left by the model", style=_THICK),
    ]
    share = float(after.sum() / before.sum()) if before.sum() > 0 else 0.0
    caption = f"The residuals have {number(100 * share, 2)} % of the readings' power"
    noise: Any = found.get("noise")
    if is_number(noise):
        flat = np.full(len(frequency), float(noise))
        curves.append(Curve(frequency, flat, MUTED, "stated noise", style={"linestyle": ":"}))
    if is_number(noise) and noise > 0:
        times = float(np.median(after)) / noise
        caption += f", {number(times, 2)} times the stated noise (median)"
        if times < _LITTLE:
            caption += "; where it is below, the priors allow motion as fast as the noise"
    caption += ". Welch's estimate, over the directions that the model moves the sensor in."
    title = f"Accelerometer {sensor}, before and after"
    return _spectra(title, "(m/s²)²/Hz", curves, caption)


def accelerometer_names(results: SmoothingResults) -> list[str]:
    return list(known_parts(results, "accelerometer_spectra", "frequency_hz"))
