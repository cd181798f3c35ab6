"""What is left: correlations of the pixels' residuals, accelerometers before and after."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.figures_common import MUTED, Picture, camera_colour, drawing
from telerig.io.report.page import Row
from telerig.io.report.smoothing_drawing import NAIVE, SMOOTHED, room_left, source_of
from telerig.io.report.smoothing_results import SmoothingResults
from telerig.io.report.words import is_number, number

Array = NDArray[np.float64]

WHITENESS_HEADS = ["camera", "residuals are", "next frame", "largest", "Ljung-Box p"]
_LITTLE = 0.5


def whiteness_rows(results: SmoothingResults) -> list[Row]:
    """By camera: the verdict, correlation from one frame to the next and the largest, p."""
    rows = []
    for camera, found in _known(results, "whiteness", "autocorrelation").items():
        rho = np.array(found["autocorrelation"], float)
        verdict = str(found.get("verdict"))
        cells = (
            camera, verdict, number(float(rho[0]), 2), number(float(np.abs(rho).max()), 2),
            number(found.get("p"), 2),
        )  # fmt: skip
        rows.append(Row(cells, strong=verdict == "correlated"))
    return rows


def whiteness_words(results: SmoothingResults) -> str:
    """What correlated residuals would mean."""
    verdicts = {str(v.get("verdict")) for v in _known(results, "whiteness", "p").values()}
    if not verdicts:
        return "Too few frames to tell whether residuals of one frame and the next are alike."
    if "correlated" in verdicts:
        return (
            "Residuals of neighbouring frames are alike: motion that the model does not hold, or "
            "centres that wander with the bubbles' shapes. The standard deviations are too small."
        )
    return (
        "Residuals of neighbouring frames have next to nothing in common: what the images hold of "
        "the motion is in the trajectories."
    )


def autocorrelation(results: SmoothingResults) -> Picture | None:
    """Of the bubbles' pixels, against the lag in frames, by camera."""
    known = _known(results, "whiteness", "autocorrelation")
    if not known:
        return None
    with drawing(2.3) as (figure, axes):
        for camera, found in known.items():
            rho = np.array(found["autocorrelation"], float)
            lags = np.arange(1, len(rho) + 1)
            index = results.cameras.index(camera) if camera in results.cameras else 0
            axes.plot(lags, rho, "o-", color=camera_colour(index), label=camera, linewidth=0.9)
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
        "Both coordinates of the bubbles' pixels, outliers left out. The fit takes up the slow "
        "part of the noise: small negative values are right.",
    )


def accelerometer_before_and_after(results: SmoothingResults, sensor: str) -> Picture | None:
    """A sensor's readings, what the model leaves of them, and its stated noise."""
    found = _known(results, "accelerometer_spectra", "frequency_hz").get(sensor)
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
        f"Accelerometer {sensor}, before and after", source, _words(before, after, noise)
    )


def _words(before: Array, after: Array, noise: Any) -> str:
    share = float(after.sum() / before.sum()) if before.sum() > 0 else 0.0
    text = f"The model leaves {number(100 * share, 2)} % of the readings' power"
    if is_number(noise) and noise > 0:
        times = float(np.median(after)) / noise
        text += f", {number(times, 2)} times the stated noise (median)"
        if times < _LITTLE:
            text += "; where it is below, the priors have room for motion as fast as the noise"
    return text + ". Welch's estimate, over the directions that the model moves the sensor in."


def accelerometer_names(results: SmoothingResults) -> list[str]:
    return list(_known(results, "accelerometer_spectra", "frequency_hz"))


def _known(results: SmoothingResults, part: str, needed: str) -> dict[str, Mapping[str, Any]]:
    return {
        str(name): found
        for name, found in results.part(part).items()
        if isinstance(found, Mapping) and needed in found
    }
