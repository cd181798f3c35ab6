"""What `telerig smooth` prints: the verdict first."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from telerig.io.results.smoothing import Contradiction, Use
from telerig.io.results.tracking import CALIBRATION_SHARE, EXTRAPOLATED, share_words
from telerig.io.results.verdict_words import to_resolve, uses_words, words_of_contradiction

if TYPE_CHECKING:
    from telerig.estimator.smoothing.result import Smoothing

_MUCH = 0.5
_SCALE_FROM = {
    "assumed": "assumed to 0.1 %. State it as [stage] scale_sigma in rig.toml, or calibrate it "
    "with views in stage_axis/",
    "rig.toml": "as stated in rig.toml",
    "stage_axis": "as calibrated from stage_axis/",
    "run": "as measured by the marks of this run",
    "given": "taken as exact",
}


def smoothing_words(found: Smoothing) -> str:
    """Return lines for the terminal: verdict, standard deviations, encoder and warnings."""
    verdict, summary = found.verdict, found.summary
    lines = []
    if "verdict" in verdict:
        flags = ", ".join(verdict.get("flags", ()))
        lines.append(verdict["verdict"] + (f" ({flags})" if flags else ""))
        found_off = [Contradiction.model_validate(c) for c in verdict.get("contradictions", ())]
        lines += [f"  {words_of_contradiction(one)}" for one in found_off]
        lines += [f"  {axis['words']}" for axis in verdict.get("axes", {}).values()]
        if verdict.get("remedy"):
            lines.append(f"  {to_resolve(verdict['remedy'])}")
        usable = [Use.model_validate(use) for use in verdict.get("usable_for", ())]
        lines += [f"  {line}" for line in uses_words(usable)]
    bubbles = "1 bubble" if summary["bubbles"] == 1 else f"{summary['bubbles']} bubbles"
    lines.append(f"{bubbles} in {summary['frames']} frames; priors: {found.model.name}")
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
    """Return a sentence on the encoder's scale and its effect on the positions' sd."""
    encoder, travel = found.summary["encoder"], found.summary["travel"]
    if not encoder:
        return []
    ppm, sd = 1e6 * encoder["scale"], 1e6 * encoder["sscale"]
    lines = [f"  encoder: scale {ppm:+.0f} ± {sd:.0f} ppm, {_SCALE_FROM[encoder['scale_from']]}"]
    table = found.tables.typical([f"s{x}_mm" for x in "xyz"])
    if travel and len(table) and "sx_mm" in table:
        share = max(travel["left_open_mm"])
        if share > _MUCH * max(float(np.median(table[f"s{x}_mm"])) for x in "xyz"):
            lines.append(
                f"  {1000 * share:.3g} µm of the positions' standard deviation come from the "
                "encoder's scale and the travel axis. They are the same for all bubbles and grow "
                "with the travel."
            )
    return lines
