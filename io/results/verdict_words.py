"""Hold all words of the smoothing verdict; its codes and numbers are in `smoothing.py`.

The smoother, the report and the terminal make their sentences here. The smoother also stores them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from telerig.io.results.smoothing import (
    AxisVerdict,
    Flag,
    Mode,
    Place,
    Remedy,
    SmoothingFile,
    Verdict,
)


class VerdictWords(NamedTuple):
    """Hold a verdict in words: a page's headline, the consequence, and the words for one axis."""

    headline: str
    consequence: str
    of_axis: str


VERDICT_WORDS = {
    Verdict.RESOLVED: VerdictWords(
        "RESOLVED: the data separate the motion of the bubbles from the shake of the rig",
        "The uncertainty of the shake hardly widens the bands below.",
        "bubble motion and shake are separated",
    ),
    Verdict.PARTIAL: VerdictWords(
        "PARTIAL: the data separate the bubbles' motion from the rig's shake only in part",
        "Part of the shake may still stand in the trajectories, or part of the bubbles' motion in "
        "the shake; the bands below say how much.",
        "shake widens the positions {q:.2g} times",
    ),
    Verdict.UNRESOLVED: VerdictWords(
        "UNRESOLVED: the data cannot separate the bubbles' motion from the rig's shake",
        "What is drawn below as motion of bubbles may be shake, and the other way round: do not "
        "interpret any motion as fast as the shake.",
        "bubble motion and shake cannot be separated",
    ),
    Verdict.CONTRADICTED: VerdictWords(
        "CONTRADICTED: the measurements of this run disagree with each other",
        "At least one record is wrong, or belongs to another time or another axis than stated. Do "
        "not use these results before it is found.",
        "the measurements disagree",
    ),
}

NOT_JUDGED = VerdictWords(
    "Not judged: smoothing.json does not say whether bubble motion and shake are separable",
    "The bands below are right if the model of bubbles and shake is right. Whether the data can "
    "separate the two was not tested.",
    "",
)

FLAG_WORDS: dict[str, str] = {
    Flag.LABEL_AMBIGUOUS: (
        "A line in the spectrum could be the bubbles' or the rig's, and the data do not say whose "
        "it is. The bands are widened by what lies between the two readings."
    ),
    Flag.SHAKE_BELOW_NOISE: (
        "The shake is smaller than what the images can show. It does no harm here: the bubbles' "
        "motion is as good as it would be on a rig that stands still."
    ),
}

REMEDY_WORDS = {
    Remedy.STRIP: "fix a strip of dots to the tank inside both views",
    Remedy.ARMS: "mount one accelerometer on each camera arm",
    Remedy.LONGER: "take a longer record, or one with more bubbles in view",
}

MODE_REMEDIES = {
    Place.SERVO: "Tune the stage's controller: more damping, a softer ramp, less gain at this "
    "frequency.",
    Place.ONE_VIEW: "Only one camera sees this axis, so it is unknown whether its arm or the whole "
    "rig swings. An accelerometer on the carriage would show it.",
    Place.COMMON: "All cameras move alike: stiffen the mount between carriage and camera bridge, "
    "or lighten what hangs on it.",
    Place.ARM: "The arm of camera {camera} swings by itself: shorten or brace it, or counterweight "
    "its camera.",
}
_WEAK_DAMPING, _SLOW_HZ = 0.02, 5.0


def words_of_axis(name: str, axis: AxisVerdict, *, vertical: bool) -> str:
    """Return the verdict along one axis as sentences; the stored ones if a number is missing."""
    sd, sd_known, rms = axis.sigma_mm, axis.sigma_shake_known_mm, axis.shake_rms_mm
    if axis.verdict is None or axis.q is None or sd is None or sd_known is None or rms is None:
        return axis.words
    title = f"{name} (vertical)" if vertical else name
    text = (
        f"{title}: {VERDICT_WORDS[axis.verdict].of_axis.format(q=axis.q)} (standard deviation of a "
        f"position {1e3 * sd:.3g} µm; {1e3 * sd_known:.3g} µm if the shake were known)."
    )
    if Flag.SHAKE_BELOW_NOISE in axis.flags:
        text += f" The shake ({1e3 * rms:.3g} µm RMS) is below the noise."
    if Flag.LABEL_AMBIGUOUS in axis.flags:
        lines = sorted({f"{x.frequency_hz:.3g} Hz" for x in axis.lines if x.ambiguous})
        text += (
            f" The oscillation at {', '.join(lines)} could be the bubble's as well as the rig's."
        )
    return text


def words_of_axes(file: SmoothingFile) -> list[str]:
    """Return the sentences of every axis; those that an older file stores, if it has any."""
    found = [
        words_of_axis(name, axis, vertical=name == file.vertical) if file.vertical else axis.words
        for name, axis in file.axes.items()
    ]
    return [words for words in found if words]


def remedy_words(remedies: Sequence[Remedy]) -> str:
    """Return what to do for the next recording, as a clause; "" for no remedies."""
    return ", or ".join(REMEDY_WORDS[remedy] for remedy in remedies)


def to_resolve(remedy: str) -> str:
    """Return the sentence with a remedy; one that always helps if ``remedy`` is empty."""
    return f"To resolve it, {remedy or remedy_words((Remedy.STRIP, Remedy.ARMS))}."


def mode_remedy(mode: Mode) -> str:
    """Return what would make a vibration smaller; the stored words of an older file."""
    if mode.place is None:
        return mode.remedy
    text = MODE_REMEDIES[mode.place].format(camera=mode.camera)
    if mode.place == Place.SERVO:
        return text
    if mode.damping is not None and mode.damping < _WEAK_DAMPING:
        text += " It rings: a layer of damping helps as much as stiffness."
    if mode.frequency_hz < _SLOW_HZ:
        text += " So slow a swing is also driven by the travel: ramp the stage up more softly."
    return text


def unseen_words(camera: str, depth_axis: Sequence[float]) -> str:
    """Return the sentence on the direction (3,) along which a camera cannot see its shake."""
    depth = ", ".join(f"{v:.2f}" for v in depth_axis)
    return f"Shake of camera {camera} along its own depth ({depth}) cannot be seen."
