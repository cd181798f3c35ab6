"""Hold all words of the smoothing verdict; its codes and numbers are in `smoothing.py`.

The smoother, the report and the terminal make their sentences here. The smoother also stores them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from telerig.io.results.smoothing import (
    RESOLVED_ETA,
    RESOLVED_Q,
    AxisVerdict,
    Contradiction,
    Disagreement,
    Flag,
    Grade,
    Mode,
    Place,
    Quantity,
    Remedy,
    SmoothingFile,
    Use,
    Verdict,
)
from telerig.io.tables.smoothing import AXES
from telerig.short_text import number, share

_MUCH = 0.5
"""Share of a position's standard deviation from which on what the encoder adds is named."""


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
        "Motion at the frequencies of the shake may be the bubbles' or the rig's; the bands below "
        "hold this uncertainty.",
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
    Flag.SHAKE_BELOW_NOISE: (
        "The shake is smaller than what the images can show. It does no harm here: the bubbles' "
        "motion is as good as it would be on a rig that stands still."
    ),
    Flag.SHAKE_UNMEASURED: (
        "In most frames nothing but the motion of one or two bubbles shows the shake, and the data "
        "do not say what of it is the rig's. The bands hold if the assumptions about "
        "bubbles and shake are right, which nothing tests."
    ),
    Flag.ARMS_UNMEASURED: (
        "The accelerometer on the carriage does not measure how the cameras' arms move on it, and "
        "one or two bubbles alone show that. What is taken for this motion may be the bubble's."
    ),
}
UNKNOWN_FLAG = (
    "A condition that this version does not know: another version of telerig wrote it. Smooth the "
    "run again for today's verdict."
)

REMEDY_WORDS = {
    Remedy.STRIP: "fix a strip of dots to the tank inside both views",
    Remedy.ARMS: "mount one accelerometer on each camera arm",
    Remedy.BARE_ARMS: "mount an accelerometer on the camera arm that has none",
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


def number_words(
    axes: Mapping[str, AxisVerdict], vertical: str, verdict: Verdict | None = None
) -> str:
    """Return the numbers of a verdict: how much of the shake is removed along the vertical,
    and to what the paths are good.

    axes : the verdicts by axis.
    vertical : the axis nearest to the vertical. Returns "" where it or its numbers are missing, and
    where measurements disagree, so that no path is good to anything.
    verdict : of the run.
    """
    if Verdict.CONTRADICTED in (verdict, *(axis.verdict for axis in axes.values())):
        return ""
    sds = {name: axis.sigma_mm for name, axis in axes.items() if axis.sigma_mm is not None}
    if vertical not in sds:
        return ""
    where: dict[str, list[str]] = {}
    for name, sd in sds.items():
        if name != vertical:
            where.setdefault(f"{number(1e3 * sd, 2)} µm", []).append(name)
    good = [f"paths good to {number(1e3 * sds[vertical], 2)} µm (1 sd)"]
    good += [f"{sd} in {' and '.join(names)}" for sd, names in where.items()]
    removed = _removed(axes[vertical])
    text = f"Vertical: {removed}{'; ' if removed else ''}{', '.join(good)}"
    if any(Flag.SHAKE_UNMEASURED in axis.flags for axis in axes.values()):
        text += ", if the assumptions about bubbles and shake are right"
    more = max(((axis.sigma_encoder_mm or 0.0, name) for name, axis in axes.items()), default=None)
    if more is not None and more[0] > _MUCH * sds.get(more[1], 0.0):
        text += (
            f". The encoder's scale and the travel axis add {number(1e3 * more[0], 2)} µm along "
            f"{more[1]}, which are the same for all bubbles and grow with the travel"
        )
    offset = max(((axis.sigma_offset_mm or 0.0, name) for name, axis in axes.items()), default=None)
    if offset is not None and offset[0] > _MUCH * sds.get(offset[1], 0.0):
        text += (
            f". Places of all bubbles share an unknown offset of {number(1e3 * offset[0], 2)} µm "
            f"along {offset[1]}; motion is free of it"
        )
    return f"{text}."


def _removed(axis: AxisVerdict) -> str:
    """Return how much of the shake is removed along an axis; "" where this is not known."""
    if Flag.SHAKE_BELOW_NOISE in axis.flags:
        return "the shake is below the noise"
    if axis.eta is None or axis.verdict == Verdict.CONTRADICTED:
        return ""
    return f"{share(axis.eta, 1.0)} of the shake's variance removed"


def words_of_axis(name: str, axis: AxisVerdict, *, vertical: bool) -> str:
    """Return the verdict along one axis as sentences; "" if a number is missing.

    name : of the axis. vertical : whether the axis is the one nearest to the vertical.
    """
    sd, sd_known, rms = axis.sigma_mm, axis.sigma_shake_known_mm, axis.shake_rms_mm
    if axis.verdict is None or axis.q is None or sd is None or sd_known is None or rms is None:
        return ""
    title = f"{name} (vertical)" if vertical else name
    removed = "" if Flag.SHAKE_BELOW_NOISE in axis.flags else _removed(axis)
    text = (
        f"{title}: {VERDICT_WORDS[axis.verdict].of_axis.format(q=axis.q)} ({removed}"
        f"{'; ' if removed else ''}standard deviation of a position {1e3 * sd:.3g} µm; "
        f"{1e3 * sd_known:.3g} µm if the shake were known)."
    )
    if Flag.SHAKE_BELOW_NOISE in axis.flags:
        text += f" The shake ({1e3 * rms:.3g} µm RMS) is below the noise."
    if Flag.SHAKE_UNMEASURED in axis.flags:
        text += " Nothing but the motion of one or two bubbles shows the shake."
    if Flag.ARMS_UNMEASURED in axis.flags:
        text += (
            " Nothing but the motion of one or two bubbles shows how the arms move on the carriage."
        )
    return text


_WORDS_OF_TEST = {
    Disagreement.RESIDUALS: "residuals are {factor} times as large as the noise allows",
    Disagreement.OUTLIERS: "{factor} times as many pixels as can be outliers do not fit",
    Disagreement.BIAS: "the bias is {factor} standard deviations from 0; unit, axes or gravity may "
    "be wrong",
    Disagreement.DELAY: "the delay is {factor} standard deviations from the stated one",
    Disagreement.SPEED: "the bubbles' mean speed is {factor} times the highest possible one",
    Disagreement.SHIFT: "their images in camera {camera} shift together{hz} against the rest, "
    "{factor} standard deviations more than noise; was a camera touched, or does what it looks "
    "through move?",
    Disagreement.TURN: "their images in camera {camera} turn together{hz}, {factor} standard "
    "deviations more than noise; did the camera roll?",
    Disagreement.GROWTH: "their images in camera {camera} grow or shrink together{hz}, {factor} "
    "standard deviations more than noise; was the camera refocused or moved?",
}


def words_of_contradiction(one: Contradiction) -> str:
    """Return the sentence on one contradiction."""
    who = f"{one.source} disagrees with the other measurements"
    if one.against:
        who = " and ".join((one.source, ", ".join(one.against))) + " disagree"
    axis = f" along {one.axis}" if one.axis else ""
    why = ""
    if one.test is not None:
        factor = f"{one.statistic:.2g}" if one.statistic < 100 else f"{one.statistic:.0f}"
        hz = "" if one.hz is None else f" at {one.hz:.3g} Hz"
        text = _WORDS_OF_TEST[one.test].format(factor=factor, camera=one.camera, hz=hz)
        why = f" ({one.source}: {text})"
    return f"{who}{axis} from {one.from_s:.3g} s to {one.to_s:.3g} s{why}."


def conclusion_words(file: SmoothingFile) -> str:
    """Return the verdict of a run as one sentence, with the reason if it is not RESOLVED.

    Returns "" for a run without a verdict.
    """
    if file.verdict is None:
        return ""
    if file.verdict == Verdict.RESOLVED:
        return f"{VERDICT_WORDS[file.verdict].headline}."
    if file.contradictions:
        return f"{file.verdict}: {words_of_contradiction(file.contradictions[0])}"
    worst = [(name, axis) for name, axis in file.axes.items() if axis.verdict == file.verdict]
    return f"{file.verdict}: {_why(*worst[0])}." if worst else f"{file.verdict}."


def _why(name: str, axis: AxisVerdict) -> str:
    """Return why an axis without contradictions is not RESOLVED."""
    if Flag.SHAKE_UNMEASURED in axis.flags:
        return f"nothing but the motion of one or two bubbles shows the shake along {name}"
    if Flag.ARMS_UNMEASURED in axis.flags:
        return f"nothing but the motion of one or two bubbles shows how the arms move along {name}"
    left = share(1.0 - (axis.eta or 0.0), 1.0)
    return (
        f"along {name}, {left} of the shake's variance is left and widens the positions "
        f"{axis.q or 1.0:.2g} times ({100 * (1 - RESOLVED_ETA):.0f} % or {RESOLVED_Q:g} times is "
        "RESOLVED)"
    )


def contradiction_words(found: Sequence[Contradiction]) -> str:
    """Return the sentences on all contradictions, the worst first."""
    return " ".join(words_of_contradiction(one) for one in found)


def consequence_words(file: SmoothingFile) -> str:
    """Return what the verdict of this run means for the uncertainty bands in the plots."""
    if file.verdict is None:
        return NOT_JUDGED.consequence
    text = VERDICT_WORDS[file.verdict].consequence
    known = [
        (axis.q, name, axis.sigma_mm, axis.sigma_shake_known_mm)
        for name, axis in file.axes.items()
        if axis.q is not None and axis.sigma_mm is not None
        and axis.sigma_shake_known_mm is not None
    ]  # fmt: skip
    if file.verdict == Verdict.RESOLVED and known and max(known)[0] > RESOLVED_Q:
        q, name, sd, sd_known = max(known)
        text = (
            f"The data remove at least {100 * RESOLVED_ETA:.0f} % of the shake's variance. What is "
            f"left of it widens the bands below up to {q:.2g} times (along {name}: "
            f"{1e3 * sd:.3g} µm now; {1e3 * sd_known:.3g} µm if the shake were known)."
        )
    if file.verdict == Verdict.CONTRADICTED and file.inflation:
        factors = ", ".join(f"{a} {f:.2g}" for a, f in zip(AXES, file.inflation))
        text += f" The standard deviations have been multiplied ({factors}) because of it."
    return text


QUANTITY_WORDS = {
    Quantity.MEAN_VELOCITY: "mean velocity",
    Quantity.VELOCITY: "velocity in a frame",
    Quantity.ACCELERATION: "acceleration in a frame",
    Quantity.PATH: "path about a line",
    Quantity.PLACE: "place in the laboratory",
    Quantity.ZIGZAG_AMPLITUDE: "zigzag amplitude",
    Quantity.ZIGZAG_FREQUENCY: "zigzag frequency",
}


def words_of_use(use: Use) -> str:
    """Return the name of a quantity, with the frequency up to which it counts."""
    words = QUANTITY_WORDS[use.quantity]
    return words if use.below_hz is None else f"{words} below {float(f'{use.below_hz:.2g}'):g} Hz"


_LESS_NOISE = (
    "Against the pixels' noise: more pixels per mm, sharper images, or means over more bubbles and "
    "a longer record."
)


def words_of_refusals(file: SmoothingFile) -> list[str]:
    """Return why a run does not determine what is graded NO, axis by axis, and what to add.

    Nothing is said of a run whose measurements disagree: that is why, and what widens its numbers.
    """
    if file.verdict == Verdict.CONTRADICTED:
        return []
    lines, shaken = [], set()
    for name in AXES:
        refused = [u for u in file.usable_for if u.axis == name and u.grade == Grade.NO]
        what = [
            f"{words_of_use(use)} ({abs(use.value) / use.sd:.2g} of its standard deviations)"
            for use in refused
            if use.value is not None and use.sd
        ]
        if not what:
            continue
        axis = file.axes.get(name, AxisVerdict())
        by_shake = (axis.q or 1.0) > RESOLVED_Q
        shaken.add(by_shake)
        text = f"Along {name}, {' and '.join(what)}: "
        part = "mostly" if (axis.q or 1.0) ** 2 > 2 else "partly"
        text += f"{part} because of the shake" if by_shake else "because of the pixels' noise"
        if by_shake and axis.sigma_mm and axis.sigma_shake_known_mm:
            text += (
                f" (standard deviation of a position {1e3 * axis.sigma_mm:.3g} µm; "
                f"{1e3 * axis.sigma_shake_known_mm:.3g} µm if the shake were known)"
            )
        path = any(use.quantity == Quantity.PATH and use.below_hz is None for use in refused)
        text += ". At no frequency is the path nine times the power of its errors." if path else "."
        lines.append(text)
    if True in shaken and file.remedies:
        lines.append(to_resolve(remedy_words(file.remedies)))
    if False in shaken:
        lines.append(_LESS_NOISE)
    return lines


def uses_words(found: Sequence[Use]) -> list[str]:
    """Return a line for each grade with the quantities and axes that have it."""
    lines = []
    for grade, start in (
        (Grade.GOOD, "good for"),
        (Grade.LIMITED, "limited for"),
        (Grade.NO, "not good for"),
    ):
        axes: dict[str, list[str]] = {}
        for use in found:
            if use.grade == grade:
                axes.setdefault(QUANTITY_WORDS[use.quantity], []).append(use.axis)
        if axes:
            parts = [f"{what} ({', '.join(which)})" for what, which in axes.items()]
            lines.append(f"{start}: {', '.join(parts)}")
    assumed = sorted({name for use in found for name in use.assumes})
    if assumed:
        lines.append(
            f"nothing in this run confirms the sign, unit and scale of: {', '.join(assumed)}"
        )
    return lines


def words_of_axes(file: SmoothingFile) -> list[str]:
    """Return the sentences of every axis."""
    vertical = file.vertical
    found = [words_of_axis(n, axis, vertical=n == vertical) for n, axis in file.axes.items()]
    return [words for words in found if words]


def remedy_words(remedies: Sequence[Remedy]) -> str:
    """Return what to do for the next recording, as a clause; "" for no remedies."""
    return ", or ".join(REMEDY_WORDS[remedy] for remedy in remedies)


def to_resolve(remedy: str) -> str:
    """Return the sentence "To resolve it, ..." with a remedy; "" without one."""
    return f"To resolve it, {remedy}." if remedy else ""


def mode_remedy(mode: Mode) -> str:
    """Return what would make a vibration smaller."""
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
