"""Pictures of the shake, and spectra before and after."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.page.figures import CAMERA_COLOURS, MUTED, Picture, camera_colour, drawing
from telerig.io.report.page.number_format import number
from telerig.io.report.page.series_plot import (
    NAIVE,
    RTS,
    SMOOTHED,
    band,
    limits,
    line,
    room_left,
    source_of,
)
from telerig.io.report.run.smoothing.numbers import (
    Spectrum,
    column,
    shake_rms_um,
    shake_spectrum,
    velocity_spectrum,
)
from telerig.io.report.run.smoothing.results import AXES, SmoothingResults
from telerig.io.report.run.tracking.numbers import median

Array = NDArray[np.float64]

_WINDOW = 1_000
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


def unseen_words(results: SmoothingResults) -> list[str]:
    """A sentence per camera on the axes that are left out."""
    words = []
    for camera in results.cameras:
        left_out = results.unseen(camera)
        if left_out:
            axes = " and ".join(left_out)
            words.append(
                f"Camera {camera} looks along {axes} and does not see its own shake there: it is "
                "left out, of the pictures and of the verdict."
            )
    return words


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
            _draw(axes, spectrum, axis, colour, label)
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
            _draw(axes, spectrum, i, CAMERA_COLOURS[i], axis)
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


def _draw(axes: Any, spectrum: Spectrum, axis: int, colour: str, label: str) -> None:
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
