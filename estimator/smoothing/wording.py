"""A smoothed run in a few lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from telerig.estimator.smoothing.result import Smoothing


_NOTICED = 0.5
_SCALE_FROM = {
    "assumed": "its scale is assumed to 0.1 %; say better with [stage] scale_sigma in rig.toml, or "
    "calibrate it (stage_axis/)",
    "rig.toml": "its scale as rig.toml states it",
    "stage_axis": "its scale as stage_axis/ showed it",
    "run": "its scale as the marks showed it",
    "given": "its scale taken as exact",
}


def _travel_words(found: Smoothing) -> list[str]:
    """Encoder scale, and what of the positions' sd it makes where that is much."""
    encoder, travel = found.summary["encoder"], found.summary["travel"]
    if not encoder:
        return []
    ppm, sd = 1e6 * encoder["scale"], 1e6 * encoder["sscale"]
    words = f"  encoder: {_SCALE_FROM[encoder['scale_from']]} ({ppm:+.0f} +- {sd:.0f} ppm)"
    table = found.trajectories
    if travel and len(table) and "sx_mm" in table:
        share = max(travel["left_open_mm"])
        whole = max(float(np.median(table[f"s{x}_mm"])) for x in "xyz")
        if share > _NOTICED * whole:
            words += (
                f"; {1000 * share:.3g} um of the sd above are that: alike for all bubbles, and "
                "growing with the travel"
            )
    return [words]


def smoothing_words(found: Smoothing) -> str:
    """What `telerig smooth` prints: the verdict first."""
    verdict = found.verdict
    lines = []
    if verdict:
        flags = ", ".join(verdict.get("flags", []))
        lines.append(f"{verdict['verdict']}" + (f" ({flags})" if flags else ""))
        said = verdict.get("words", [])
        lines += [f"  {word}" for word in ([said] if isinstance(said, str) else said)]
    table = found.trajectories
    many = found.summary["bubbles"]
    bubbles = "1 bubble" if many == 1 else f"{many} bubbles"
    lines.append(f"{bubbles} over {found.summary['frames']} frames, priors: {found.model.name}")
    if len(table) and "sx_mm" in table:
        sd = [1000 * float(np.median(table[f"s{x}_mm"])) for x in "xyz"]
        speed = [float(np.median(table[f"sv{x}_mm_s"])) for x in "xyz"]
        lines.append(
            "  position good to {:.3g}, {:.3g}, {:.3g} um (1 sd, x y z, median)".format(*sd)
            + ", velocity to {:.2g}, {:.2g}, {:.2g} mm/s".format(*speed)
        )
    lines += _travel_words(found)
    if "rig_change" in found.summary:
        lines.append(f"  rig: {found.summary['rig_change']['words']}")
    lines += [f"  warning: {warning}" for warning in found.summary.get("warnings", [])]
    return "\n".join(lines)
