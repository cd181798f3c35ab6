"""A smoothed run in a few lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from telerig.estimator.smoother.results import Smoothing


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
    lines += [f"  warning: {warning}" for warning in found.summary.get("warnings", [])]
    return "\n".join(lines)
