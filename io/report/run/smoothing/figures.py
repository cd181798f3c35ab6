"""Pictures of a smoothed run: places, velocities, shake, spectra, residuals; and their sections."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.io.report.page.figures import (
    CAMERA_COLOURS,
    LEFT_OUT,
    MUTED,
    NAIVE,
    RTS,
    SMOOTHED,
    Picture,
    above,
    band,
    camera_colour,
    drawing,
    limits,
    line,
    room_left,
    source_of,
)
from telerig.io.report.page.number_format import is_number, number
from telerig.io.report.run.smoothing.numbers import (
    Spectrum,
    column,
    known_parts,
    shake_rms_um,
    shake_spectrum,
    velocity_spectrum,
)
from telerig.io.report.run.smoothing.results import AXES, PLACE, SPEED, SmoothingResults
from telerig.io.report.run.tracking.numbers import median, rms
from telerig.io.report.run.tracking.scene import track_colour

PLACES = ("lab", "taken", "velocity", "shake", "spectra", "white")
"""Sections that hold drawings."""


def smoothing_drawings(results: SmoothingResults) -> list[tuple[str, Callable[[], Any]]]:
    """(section, drawing); a drawing gives a `Picture`, or None where there is nothing to see."""
    axes = range(3)
    bubbles = axes if len(results.trajectories) else range(0)
    drawings: list[tuple[str, Callable[[], Any]]] = [
        *(("lab", partial(places, results, axis)) for axis in bubbles),
        *(("lab", partial(closer, results, axis)) for axis in bubbles),
        *(("taken", partial(taken_off, results, axis)) for axis in bubbles),
        *(("velocity", partial(velocities, results, axis)) for axis in bubbles),
    ]
    for camera in results.cameras if len(results.shake) else ():
        drawings += [("shake", partial(shake_in_time, results, camera, axis))
                     for axis in results.seen(camera)]  # fmt: skip
    drawings += [("spectra", partial(velocity_before_and_after, results, axis)) for axis in axes]
    drawings += [("spectra", partial(shake_spectra, results, c)) for c in results.cameras]
    drawings += [
        ("spectra", partial(accelerometer_before_and_after, results, sensor))
        for sensor in accelerometer_names(results)
    ]
    judged = known_parts(results, "whiteness", "expected")
    return [*drawings, *([("white", partial(autocorrelation, results))] if judged else [])]


_MOST_BUBBLES = 60
_FEW = 3
_WINDOW = 1_000
_CLOSE = 60
_BANDS = "Bands are ± 2 sd."


def places(results: SmoothingResults, axis: int) -> Picture:
    """One lab coordinate of every bubble; up is up. Naive and RTS beneath where bubbles are few."""
    shown = results.bubbles[:_MOST_BUBBLES]
    name, points, few = PLACE.format(AXES[axis]), 0, len(shown) <= _FEW
    with drawing(2.6) as (figure, axes):
        for i, particle in enumerate(shown):
            table = results.track(particle)
            t, value = table["t_s"].to_numpy(float), column(table, name)
            if few:
                line(axes, t, column(table, f"naive_{name}"), NAIVE, "" if i else "naive")
                line(axes, t, column(table, f"rts_{name}"), RTS, "" if i else "RTS", linewidth=0.6)
            band(axes, t, value, column(table, f"s{name}"), track_colour(particle))
            line(axes, t, value, track_colour(particle), "" if i else "smoothed")
            points += (4 if few else 2) * len(t)
        axes.set(xlabel="t / s", ylabel=f"lab {AXES[axis]} / mm")
        room_left(axes)
        if few:
            above(axes, inverted=results.up[axis] < -0.5)
        elif results.up[axis] < -0.5:
            axes.invert_yaxis()
        axes.grid(True)
        source = source_of(figure, points)
    caption = "The axis is turned round, so that up is up. " if results.up[axis] < -0.5 else ""
    sd = median(column(results.trajectories, f"s{name}"))
    caption += f"A colour per bubble. {_BANDS} The sd is {_um(sd)} (median): look closer below."
    if len(shown) < len(results.bubbles):
        caption += f" The {len(shown)} longest of {number(len(results.bubbles))} are drawn."
    return Picture(f"{AXES[axis]} against time", source, caption)


def closer(results: SmoothingResults, axis: int) -> Picture:
    """Some frames of the longest track's middle without their straight line."""
    table, _ = detail(results)
    first = max(0, (len(table) - _CLOSE) // 2)
    table = table.iloc[first : first + _CLOSE]
    name, t = PLACE.format(AXES[axis]), table["t_s"].to_numpy(float)
    smooth, naive, rts = (column(table, kind + name) for kind in ("", "naive_", "rts_"))
    straight = _straight(t, smooth)
    with drawing(2.6) as (figure, axes):
        dots = {"linestyle": "none", "marker": ".", "markersize": 4}
        line(axes, t, naive - straight, NAIVE, "naive", **dots)
        line(axes, t, rts - straight, RTS, "RTS")
        band(axes, t, smooth - straight, column(table, f"s{name}"), SMOOTHED, "± 2 sd")
        line(axes, t, smooth - straight, SMOOTHED, "smoothed")
        _unobserved(axes, table)
        axes.set(xlabel="t / s", ylabel=f"lab {AXES[axis]}, less a line / mm")
        room_left(axes)
        above(axes, inverted=results.up[axis] < -0.5)
        axes.grid(True)
        source = source_of(figure, 4 * len(t))
    slope = (straight[-1] - straight[0]) / (t[-1] - t[0]) if len(t) > 1 else 0.0
    caption = (
        f"Bubble {results.bubbles[0]}, {number(len(t))} frames of its middle, without a straight "
        f"line of {number(float(slope), 3)} mm/s. {_BANDS}{_marks(table)}"
    )
    return Picture(f"{AXES[axis]}, closer", source, caption)


def taken_off(results: SmoothingResults, axis: int) -> Picture:
    """Naive and RTS minus smoothed, against the smoothed band."""
    table, where = detail(results)
    name = PLACE.format(AXES[axis])
    t, smooth = table["t_s"].to_numpy(float), column(table, name)
    sd = 1e3 * column(table, f"s{name}")
    naive, rts = (1e3 * (column(table, kind + name) - smooth) for kind in ("naive_", "rts_"))
    with drawing(2.6) as (figure, axes):
        _three(axes, t, [np.zeros(len(t)), naive, rts], sd)
        _unobserved(axes, table)
        axes.set(xlabel="t / s", ylabel=f"{AXES[axis]}, less smoothed / µm")
        found = limits(naive, rts, 2 * sd, -2 * sd)
        if found:
            axes.set_ylim(*found)
        axes.grid(True)
        room_left(axes)
        above(axes)
        source = source_of(figure, 4 * len(t))
    off, own = rms(naive), median(sd)
    times = f", {number(off / own, 2)} times the sd of smoothed" if off and own else ""
    caption = (
        f"Naive minus smoothed is {number(off, 3)} µm RMS{times}; RTS minus smoothed is "
        f"{number(rms(rts), 3)} µm. {_BANDS}{_marks(table)} {where}"
    )
    return Picture(f"{AXES[axis]}: what smoothing took off", source, caption)


def velocities(results: SmoothingResults, axis: int) -> Picture:
    """The longest track's velocity: smoothed with its band, naive, RTS."""
    table, where = detail(results)
    name = SPEED.format(AXES[axis])
    t = table["t_s"].to_numpy(float)
    smooth, naive, rts = (column(table, kind + name) for kind in ("", "naive_", "rts_"))
    sd = column(table, f"s{name}")
    with drawing(2.6) as (figure, axes):
        _three(axes, t, [smooth, naive, rts], sd)
        _unobserved(axes, table)
        axes.set(xlabel="t / s", ylabel=f"v{AXES[axis]} / (mm/s)")
        room_left(axes)
        axes.grid(True)
        above(axes, inverted=results.up[axis] < -0.5)
        source = source_of(figure, 4 * len(t))
    caption = (
        f"Naive scatters by {number(rms(naive - smooth), 3)} mm/s RMS about smoothed, whose sd is "
        f"{number(median(sd), 3)} mm/s (median). {_BANDS}{_marks(table)} {where}"
    )
    if results.up[axis] < -0.5:
        caption += " The axis is turned round, so that up is up."
    return Picture(f"Velocity in {AXES[axis]}", source, caption)


def detail(results: SmoothingResults) -> tuple[pd.DataFrame, str]:
    """The longest track, its middle where it is very long; and which that is, in words."""
    particle = results.bubbles[0]
    table = results.track(particle)
    what = f"Bubble {particle}"
    if len(results.bubbles) > 1:
        what += ", the longest track"
    if len(table) <= _WINDOW:
        return table, f"{what}."
    first = (len(table) - _WINDOW) // 2
    return table.iloc[first : first + _WINDOW], f"{what}, {number(_WINDOW)} frames of its middle."


def _three(axes: Any, t: Array, values: list[Array], sd: Array) -> None:
    """Smoothed, naive, RTS in this order, smoothed on top."""
    smooth, naive, rts = values
    line(axes, t, naive, NAIVE, "naive", linewidth=0.7)
    line(axes, t, rts, RTS, "RTS", linewidth=0.9)
    band(axes, t, smooth, sd, SMOOTHED, "± 2 sd")
    line(axes, t, smooth, SMOOTHED, "smoothed", linewidth=1.1)


def _straight(t: Array, values: Array) -> Array:
    there = np.isfinite(values)
    if there.sum() < 2:
        return np.full(len(t), median(values) or 0.0)
    return np.asarray(np.polyval(np.polyfit(t[there] - t[0], values[there], 1), t - t[0]))


def _unobserved(axes: Any, table: pd.DataFrame) -> None:
    missing = column(table, "observed") == 0
    t = table["t_s"].to_numpy(float)[missing]
    axes.plot(t, np.full(len(t), 0.015), "|", color=LEFT_OUT, markersize=5,
              transform=axes.get_xaxis_transform(), zorder=5)  # fmt: skip


def _marks(table: pd.DataFrame) -> str:
    missing = int(np.sum(column(table, "observed") == 0))
    return f" Red ticks: {number(missing)} frames without an image of it." if missing else ""


def _um(sd_mm: float | None) -> str:
    return f"{number(None if sd_mm is None else 1e3 * sd_mm, 3)} µm"


_DECADES = 6.0
_PARTLY = 0.2
_MOST_DB = 99.0


def shake_in_time(results: SmoothingResults, camera: str, axis: str) -> Picture:
    """A camera's offset from where the encoder has it, with its band."""
    table = results.shake
    note = ""
    if len(table) > _WINDOW:
        first = (len(table) - _WINDOW) // 2
        table = table.iloc[first : first + _WINDOW]
        note = f" {number(_WINDOW)} frames of the run's middle."
    t = table["t_s"].to_numpy(float)
    value = 1e3 * column(table, f"{camera}_{axis}_mm")
    sd = 1e3 * column(table, f"s{camera}_{axis}_mm")
    colour = camera_colour(results.cameras.index(camera))
    with drawing(2.3) as (figure, axes):
        band(axes, t, value, sd, colour)
        line(axes, t, value, colour)
        axes.set(xlabel="t / s", ylabel=f"{axis} / µm")
        found = limits(value - 2 * sd, value + 2 * sd) or limits(value)
        if found:
            axes.set_ylim(*found)
        room_left(axes)
        axes.grid(True)
        source = source_of(figure, 3 * len(t))
    size = shake_rms_um(results, camera, axis)
    caption = (
        f"RMS {number(size, 3)} µm over the run, sd of the estimate {number(median(sd), 3)} µm "
        f"(median). The band is ± 2 sd.{_oblique(results, camera, axis)}{note}"
    )
    return Picture(f"Shake of camera {camera} in {axis}", source, caption)


def _oblique(results: SmoothingResults, camera: str, axis: str) -> str:
    depth = results.depth(camera)
    part = 0.0 if depth is None else abs(float(depth[AXES.index(axis)]))
    if part < _PARTLY:
        return ""
    return (
        f" This axis lies partly ({100 * part:.0f} %) along the camera's depth, which it does not "
        "see: the band holds the prior's spread there."
    )


def velocity_before_and_after(results: SmoothingResults, axis: int) -> Picture | None:
    """Spectrum of the bubbles' velocity: naive, RTS, smoothed."""
    kinds = (("naive_", NAIVE, "naive"), ("rts_", RTS, "RTS"), ("", SMOOTHED, "smoothed"))
    spectra = {label: (velocity_spectrum(results, kind), colour) for kind, colour, label in kinds}
    found = {label: (s, colour) for label, (s, colour) in spectra.items() if s is not None}
    if "smoothed" not in found:
        return None
    with drawing(2.6) as (figure, axes):
        _mark_modes(axes, results)
        for label, (spectrum, colour) in found.items():
            _draw_spectrum(axes, spectrum, axis, colour, label)
        _finish(axes, [s for s, _ in found.values()], [axis], f"v{AXES[axis]} / ((mm/s)²/Hz)")
        above_log(axes)
        source = source_of(figure, 0)
    caption = _velocity_words(found, axis) + _resolution(found["smoothed"][0])
    return Picture(f"Spectrum of the velocity in {AXES[axis]}", source, caption)


def _velocity_words(found: dict[str, tuple[Spectrum, str]], axis: int) -> str:
    if "naive" not in found:
        return "There is no naive trajectory to compare with. "
    naive, smooth = found["naive"][0], found["smoothed"][0]
    if naive.density.shape != smooth.density.shape:
        return ""
    before, after = naive.density[1:, axis], smooth.density[1:, axis]
    gain = 10 * np.log10(np.maximum(before, 1e-30) / np.maximum(after, 1e-30))
    at = int(np.argmax(before - after))
    return (
        f"Smoothing takes off most at {number(float(naive.frequency_hz[1 + at]), 3)} Hz: "
        f"{min(gain[at], _MOST_DB):.0f} dB. What the motion itself holds should stay where it was. "
    )


def _resolution(spectrum: Spectrum) -> str:
    return f"Welch's estimate, steps of {number(spectrum.step_hz, 2)} Hz."


def shake_spectra(results: SmoothingResults, camera: str) -> Picture | None:
    """Spectrum of a camera's shake on the axes that it sees."""
    spectrum = shake_spectrum(results, camera)
    seen = results.seen(camera)
    if spectrum is None or not seen:
        return None
    with drawing(2.6) as (figure, axes):
        _mark_modes(axes, results)
        for axis in seen:
            i = AXES.index(axis)
            _draw_spectrum(axes, spectrum, i, CAMERA_COLOURS[i], axis)
        _finish(axes, [spectrum], [AXES.index(a) for a in seen], "shake / (µm²/Hz)")
        above_log(axes)
        source = source_of(figure, 0)
    peaks = []
    for axis in seen:
        density = spectrum.density[1:, AXES.index(axis)]
        at = float(spectrum.frequency_hz[1 + int(np.argmax(density))])
        peaks.append(f"{number(at, 3)} Hz in {axis}")
    caption = f"Strongest at {', '.join(peaks)}. {_resolution(spectrum)}"
    return Picture(f"Spectrum of the shake of camera {camera}", source, caption)


def _draw_spectrum(axes: Any, spectrum: Spectrum, axis: int, colour: str, label: str) -> None:
    axes.plot(spectrum.frequency_hz[1:], spectrum.density[1:, axis], color=colour, label=label,
              linewidth=1.1)  # fmt: skip


def _finish(axes: Any, spectra: Sequence[Spectrum], which: Sequence[int], label: str) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    values = np.concatenate([s.density[1:, i] for s in spectra for i in which])
    axes.set(xlabel="frequency / Hz", ylabel=label, xscale="log", yscale="log")
    highest = max(float(s.frequency_hz[-1]) for s in spectra)
    axes.set_xlim(min(float(s.frequency_hz[1]) for s in spectra), highest)
    top = float(values.max()) if len(values) and values.max() > 0 else 1.0
    bottom = max(float(values[values > 0].min(initial=top)), top * 10**-_DECADES)
    axes.set_ylim(bottom / 2, top * 2)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(True)
    room_left(axes)


def above_log(axes: Any) -> None:
    """Room for the legend, on an axis of powers of ten."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** 0.16)
    axes.legend(loc="upper left", ncols=4, columnspacing=1.0, handlelength=1.2, borderaxespad=0.1)


def _mark_modes(axes: Any, results: SmoothingResults) -> None:
    """Dotted lines at the frequencies of the model's modes."""
    model = results.part("model")
    for mode in model.get("modes") or []:
        axes.axvline(float(mode["frequency_hz"]), color=MUTED, linewidth=0.7, linestyle=":")


_LITTLE = 0.5


def autocorrelation(results: SmoothingResults) -> Picture:
    """Of the bubbles' pixels, against the lag in frames, by camera, beside the model's."""
    known = known_parts(results, "whiteness", "expected")
    with drawing(2.3) as (figure, axes):
        for camera, found in known.items():
            lags = np.arange(1, len(found["expected"]) + 1)
            index = results.cameras.index(camera) if camera in results.cameras else 0
            axes.plot(
                lags, np.array(found["autocorrelation"], float), "o-",
                color=camera_colour(index), label=camera, linewidth=0.9,
            )  # fmt: skip
        models = [np.array(found["expected"], float) for found in known.values()]
        axes.plot(lags, np.mean(models, 0), "--", color=MUTED, label="model", linewidth=1.1)
        axes.axhline(0, color=MUTED, linewidth=0.7)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, -0.2), max(high, 0.2))
        axes.set(xlabel="frames apart", ylabel="correlation")
        axes.legend(loc="upper right")
        axes.grid(True)
        room_left(axes)
        source = source_of(figure, 0)
    return Picture(
        "Residuals some frames apart",
        source,
        "Both coordinates of the bubbles' pixels, outliers left out. The fit follows part of the "
        "noise, so that neighbours differ more than noise does; dashed: by how much, drawn from "
        "the model.",
    )


def accelerometer_before_and_after(results: SmoothingResults, sensor: str) -> Picture | None:
    """A sensor's readings, what the model leaves of them, and its stated noise."""
    found = known_parts(results, "accelerometer_spectra", "frequency_hz").get(sensor)
    if found is None:
        return None
    frequency = np.array(found["frequency_hz"], float)
    before, after = (np.array(found[key], float) for key in ("reading", "residual"))
    noise: Any = found.get("noise")
    with drawing(2.6) as (figure, axes):
        axes.plot(frequency, before, color=NAIVE, label="readings", linewidth=1.1)
        axes.plot(frequency, after, color=SMOOTHED, label="left by the model", linewidth=1.1)
        if is_number(noise):
            axes.axhline(noise, color=MUTED, linestyle=":", linewidth=0.9, label="stated noise")
        axes.set(xlabel="frequency / Hz", ylabel="(m/s²)²/Hz", xscale="log", yscale="log")
        axes.legend(loc="upper left", ncols=3)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** 0.16)
        axes.grid(True)
        room_left(axes)
        source = source_of(figure, 0)
    return Picture(
        f"Accelerometer {sensor}, before and after",
        source,
        _accelerometer_words(before, after, noise),
    )


def _accelerometer_words(before: Array, after: Array, noise: Any) -> str:
    share = float(after.sum() / before.sum()) if before.sum() > 0 else 0.0
    text = f"The model leaves {number(100 * share, 2)} % of the readings' power"
    if is_number(noise) and noise > 0:
        times = float(np.median(after)) / noise
        text += f", {number(times, 2)} times the stated noise (median)"
        if times < _LITTLE:
            text += "; where it is below, the priors have room for motion as fast as the noise"
    return text + ". Welch's estimate, over the directions that the model moves the sensor in."


def accelerometer_names(results: SmoothingResults) -> list[str]:
    return list(known_parts(results, "accelerometer_spectra", "frequency_hz"))
