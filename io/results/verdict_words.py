"""Hold the words of the smoothing verdict; its codes and numbers are in `smoothing.py`."""

from __future__ import annotations

from typing import NamedTuple

from telerig.io.results.smoothing import Flag, Verdict


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

REMEDY = (
    "fix a strip of dots to the tank where both cameras see it, or put one accelerometer on each "
    "camera arm, and record again."
)
