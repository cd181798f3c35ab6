"""What is left: correlations of the pixels' residuals, accelerometers before and after."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.page.figures import MUTED, Picture, camera_colour, drawing
from telerig.io.report.page.number_format import is_number, number
from telerig.io.report.page.page import Row
from telerig.io.report.page.series_plot import NAIVE, SMOOTHED, room_left, source_of
from telerig.io.report.run.smoothing.results import SmoothingResults

Array = NDArray[np.float64]

WHITENESS_HEADS = ["camera", "residuals are", "next frame", "RMS, sigmas", "p"]
_LITTLE = 0.5
_LARGER, _SMALLER = 1.25, 0.8


def whiteness_rows(results: SmoothingResults) -> list[Row]:
    """By camera: the verdict, next frame's correlation and RMS beside the model's, a test."""
    rows = []
    for camera, found in _known(results, "whiteness", "expected").items():
        rho, expected = (np.array(found[key], float) for key in ("autocorrelation", "expected"))
        sizes = (found.get(key) for key in ("rms_sigmas", "expected_rms_sigmas"))
        verdict = str(found.get("verdict"))
        cells = (
            camera, verdict, _beside(float(rho[0]), float(expected[0])), _beside(*sizes),
            number(found.get("p"), 2),
        )  # fmt: skip
        rows.append(Row(cells, strong=verdict == "correlated"))
    return rows


def _beside(seen: Any, expected: Any) -> str:
    return f"{number(seen, 2)} (model {number(expected, 2)})"


def whiteness_words(results: SmoothingResults) -> str:
    """What larger, smaller or otherwise correlated residuals mean."""
    known = _known(results, "whiteness", "expected").values()
    if not known:
        return (
            "Not judged: too few frames for it, too many bubbles at once, or sensors far faster "
            "than the frames."
        )
    ratios = [v["rms_sigmas"] / v["expected_rms_sigmas"] for v in known]
    out = []
    if max(ratios) > _LARGER:
        out.append(
            f"Residuals are {number(max(ratios), 2)} times what this model leaves: more noise or "
            "faster motion than it states. The standard deviations are too small."
        )
    elif min(ratios) < _SMALLER:
        out.append(
            f"Residuals are {number(min(ratios), 2)} of what this model leaves: pixels scatter "
            "less from frame to frame than their stated standard deviations."
        )
    if any(v.get("verdict") == "correlated" for v in known):
        out.append(
            "Residuals of neighbouring frames are not alike as the model leaves them: motion that "
            "it does not hold, centres that wander with the bubbles' shapes, or noise that is not "
            "as stated. The standard deviations cannot be relied on."
        )
    return " ".join(out) or (
        "Residuals are as large, and neighbouring frames' as alike, as the fit leaves them where "
        "the model is right: what the images hold of the motion is in the trajectories."
    )


def autocorrelation(results: SmoothingResults) -> Picture | None:
    """Of the bubbles' pixels, against the lag in frames, by camera, beside the model's."""
    known = _known(results, "whiteness", "expected")
    if not known:
        return None
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
