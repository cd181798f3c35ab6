"""Sentences on a calibration: how telecentric the lenses are, and that its errors are unknown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from telerig.short_text import with_sd

NO_COVARIANCE = (
    "the uncertainty of the imported calibration is unknown and taken as zero, so standard "
    "deviations of points contain the noise of the pixels only"
)

TELECENTRIC = 1e-3
"""Relative change of the scale over the depth of the views below which a lens is telecentric."""
_SIGNIFICANT = 3.0
"""Standard deviations from which on a change of the scale is one."""
ORDINARY = 0.01
"""Slope of a corner ray beyond which a lens is an ordinary one: no telecentric lens errs by 0.6
degrees."""


def has_ordinary_lens(statistics: Mapping[str, Any]) -> bool:
    """Return whether a lens is an ordinary one by `statistics` of `calibration.json`."""
    of: Mapping[str, Mapping[str, float]] = statistics.get("telecentricity") or {}
    return any(lens["perspective"] > ORDINARY for lens in of.values())


def telecentricity_words(statistics: Mapping[str, Any]) -> list[str]:
    """Return sentences on how far each camera is telecentric.

    statistics : `statistics` of `calibration.json`; without an entry "telecentricity", as of an
    imported calibration, there are no sentences.
    """
    of: Mapping[str, Mapping[str, float]] = statistics.get("telecentricity") or {}
    ordinary = [name for name, lens in of.items() if lens["perspective"] > ORDINARY]
    words = [_ordinary(ordinary, of)] if ordinary else []
    for name, lens in of.items():
        if name in ordinary:
            continue
        depth = lens["depth_mm"]
        change, sd = (100 * depth * lens[key] for key in ("change_per_mm", "sd_per_mm"))
        amount = (
            f"its scale changes by {with_sd(change, sd)} % over the views' {depth:.3g} mm of depth"
        )
        if abs(change) < 100 * TELECENTRIC:
            kind = "telecentric"
        elif abs(change) < _SIGNIFICANT * sd:
            kind = "telecentric as far as these views can show it"
        else:
            kind = "not quite telecentric"
        words.append(f"camera {name} is {kind}: {amount}")
    return words


def _ordinary(names: list[str], of: Mapping[str, Mapping[str, float]]) -> str:
    changes = " and ".join(f"{100 * of[name]['change_per_mm']:.2g}" for name in names)
    kind = "has an ordinary lens" if len(names) == 1 else "have ordinary lenses"
    return (
        f"camera{'s' if len(names) > 1 else ''} {' and '.join(names)} {kind}, not telecentric: "
        f"the scale changes by {changes} % per mm of depth. telerig's model covers "
        "ordinary lenses as a limit only; for richer lens models use OpenCV or mrcal, or go on if "
        "the residuals are at the images' noise"
    )
