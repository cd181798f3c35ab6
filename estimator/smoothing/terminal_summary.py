"""What `telerig smooth` prints: to what the paths are good, and the verdict."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from telerig.io.results.smoothing import SmoothingFile
from telerig.io.results.tracking import share_words
from telerig.io.results.verdict_words import (
    number_words,
    remedy_words,
    to_resolve,
    uses_words,
    words_of_axes,
    words_of_contradiction,
)
from telerig.io.tables.table import CALIBRATION_SHARE, EXTRAPOLATED
from telerig.short_text import counted

if TYPE_CHECKING:
    from telerig.estimator.smoothing.result import Smoothing

_SCALE_FROM = {
    "assumed": "assumed to 0.1 %. State it as [stage] scale_sigma in rig.toml, or calibrate it "
    "with views in stage_axis/",
    "rig.toml": "as stated in rig.toml",
    "stage_axis": "as calibrated from stage_axis/",
    "run": "as measured by the marks of this run",
    "given": "held by the given model",
}


def smoothing_words(found: Smoothing) -> str:
    """Return lines for the terminal: how good the paths are, verdict, encoder and warnings."""
    summary, file = found.summary, SmoothingFile.model_validate(found.verdict)
    lines = []
    if file.verdict is not None:
        flags = ", ".join(file.flags)
        lines += [number_words(file.axes, file.vertical, file.verdict)]
        lines += [str(file.verdict) + (f" ({flags})" if flags else "")]
        lines += [f"  {words_of_contradiction(one)}" for one in file.contradictions]
        lines += [f"  {words}" for words in words_of_axes(file)]
        lines += [f"  {words}" for words in [to_resolve(remedy_words(file.remedies))] if words]
        lines += [f"  {line}" for line in uses_words(file.usable_for)]
        lines = [line for line in lines if line]
    bubbles = counted(summary["bubbles"], "bubble")
    lines.append(f"{bubbles} in {counted(summary['frames'], 'frame')}; priors: {found.model.name}")
    table = found.tables.typical([f"s{x}_mm" for x in "xyz"] + [f"sv{x}_mm_s" for x in "xyz"])
    if len(table) and "sx_mm" in table:
        position = [1000 * float(np.median(table[f"s{x}_mm"])) for x in "xyz"]
        velocity = [float(np.median(table[f"sv{x}_mm_s"])) for x in "xyz"]
        lines.append(
            "  standard deviations (median; x, y, z): position {:.3g}, {:.3g}, {:.3g} µm, velocity "
            "{:.2g}, {:.2g}, {:.2g} mm/s".format(*position, *velocity)
        )
    common = found.tables.typical([*CALIBRATION_SHARE, EXTRAPOLATED]).dropna()
    if len(common) and EXTRAPOLATED in common:
        sd_mm = np.sqrt((common[[*CALIBRATION_SHARE]] ** 2).mean()).to_numpy(float)
        lines += [f"  {words}" for words in share_words(sd_mm, common[EXTRAPOLATED].mean())]
    lines += _encoder_words(found)
    if "rig_change" in summary:
        lines.append(f"  rig: {summary['rig_change']['words']}")
    lines += [f"  warning: {warning}" for warning in summary.get("warnings", [])]
    return "\n".join(lines)


def _encoder_words(found: Smoothing) -> list[str]:
    """Return a sentence on the encoder's scale; none without an encoder."""
    encoder = found.summary["encoder"]
    if not encoder:
        return []
    ppm, sd = 1e6 * encoder["scale"], 1e6 * encoder["sscale"]
    return [f"  encoder: scale {ppm:+.0f} ± {sd:.0f} ppm, {_SCALE_FROM[encoder['scale_from']]}"]
