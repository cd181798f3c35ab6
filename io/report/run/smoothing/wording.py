"""A smoothed run in words: the verdict with its remedy, and the numbers behind it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from telerig.io.report.page.number_format import ABSENT, is_number, number, sentence, share
from telerig.io.report.page.page import Figure, Row
from telerig.io.report.run.smoothing.numbers import axis_sd, shake_rms_um, taken_away
from telerig.io.report.run.smoothing.results import AXES, SPEED, SmoothingResults
from telerig.io.report.run.tracking.results import TrackResults
from telerig.io.report.run.tracking.tables import Verdict

REMEDY = (
    "fix a strip of dots to the tank where both cameras see it, or put one accelerometer on each "
    "camera arm, and record again."
)
_NOT_JUDGED = (
    "Not judged: nothing says how far bubble motion and shake were told apart",
    "usable",
    "The bands below hold if the model of bubbles and shake is right; whether the data could have "
    "shown otherwise was not tested.",
)
_MEANING = {
    "RESOLVED": (
        "RESOLVED: the bubbles' motion and the rig's shake are told apart",
        "good",
        "The shake is known so well that it hardly widens the bands below.",
    ),
    "PARTIAL": (
        "PARTIAL: the bubbles' motion and the rig's shake are told apart in part",
        "usable",
        "Part of the shake may still stand in the trajectories, or part of the bubbles' motion in "
        "the shake; the bands below say how much.",
    ),
    "UNRESOLVED": (
        "UNRESOLVED: these data do not tell the bubbles' motion from the rig's shake",
        "rejected",
        "What is drawn below as the bubbles' motion may be shake, and the other way round: do not "
        "read anything from it that is as fast as the shake.",
    ),
}
_FLAGS = {
    "LABEL_AMBIGUOUS": (
        "A line in the spectrum could be the bubbles' or the rig's, and the data do not say whose "
        "it is. The bands are widened by what lies between the two readings."
    ),
    "SHAKE_BELOW_NOISE": (
        "The shake is smaller than what the images can show. It does no harm here: the bubbles' "
        "motion is as good as it would be on a rig that stands still."
    ),
}
_HARMLESS = {"SHAKE_BELOW_NOISE"}
_REMEDY_KEYS = ("remedy", "remedies")
_NAMES = {
    "eta": "η", "sigma_mm": "sd, µm", "sigma_shake_known_mm": "sd if the shake were known, µm",
}  # fmt: skip
_OPEN_NATS = 5.0
_NEXT_AXIS = re.compile(r"(?<=\.) (?=[xyz](?: \([a-z]+\))?: |To resolve it)")
_ELSEWHERE = {"words", "lines", "shake_rms_mm", *_REMEDY_KEYS}


def smoothing_verdict(results: SmoothingResults, tracks: TrackResults) -> Verdict:
    """What the smoother says of itself, with the remedy where there is one to take."""
    content = results.content
    word = str(content.get("verdict") or "").strip()
    headline, colour, meaning = _MEANING.get(
        word.upper(), (word.replace("_", " "), "usable", "") if word else _NOT_JUDGED
    )
    sentences = [meaning, *_by_axis(strings(content.get("words")))]
    sentences += [f"Rig: {_micro(w)}." for w in strings(results.part("rig_change").get("words"))]
    if word.upper() in ("PARTIAL", "UNRESOLVED"):
        sentences += _remedy(content, " ".join(sentences))
    flags = {
        flag: f"{flag}: {_FLAGS.get(flag, flag.replace('_', ' ').lower())}"
        for flag in strings(content.get("flags"))
    }
    sentences += [text for flag, text in flags.items() if flag in _HARMLESS]
    warnings = [text for flag, text in flags.items() if flag not in _HARMLESS]
    warnings += [_micro(sentence(w)) for w in strings(content.get("warnings"))]
    warnings += _stale(results, tracks)
    if warnings and colour == "good":
        colour = "usable"
    known = tuple(dict.fromkeys(s for s in sentences if s))
    return Verdict(headline, colour, known, tuple(warnings))


def _remedy(content: Mapping[str, Any], told: str) -> list[str]:
    """What to do about it, unless that has been told."""
    given = [text for key in _REMEDY_KEYS for text in strings(content.get(key))] or [REMEDY]
    fresh = [text for text in given if text.rstrip(".").lower() not in told.lower()]
    return [f"To resolve it: {_micro(' '.join(fresh))}"] if fresh else []


def _by_axis(texts: list[str]) -> list[str]:
    """A sentence per axis by itself."""
    return [_micro(part) for text in texts for part in _NEXT_AXIS.split(text)]


def _micro(text: str) -> str:
    return re.sub(r"\bum\b", "µm", text)


def strings(value: Any) -> list[str]:
    """A text or a list of them as a list."""
    if isinstance(value, str):
        return [value] if value.strip() else []
    return [str(item) for item in value] if isinstance(value, list) else []


def _stale(results: SmoothingResults, tracks: TrackResults) -> list[str]:
    strange = sorted(set(results.bubbles) - {int(k) for k in tracks.tracks["particle"].unique()})
    if not strange:
        return []
    some = ", ".join(str(k) for k in strange[:5]) + (", ..." if len(strange) > 5 else "")
    return [
        f"Bubbles {some} of trajectories.csv are not in tracks.csv: the run was tracked again "
        "after it was smoothed. Smooth it again (`telerig smooth`)."
    ]


def smoothing_figures(results: SmoothingResults) -> list[Figure]:
    """What a reader wants first."""
    place, speed = axis_sd(results), axis_sd(results, SPEED)
    away, away_speed = taken_away(results), taken_away(results, pattern=SPEED)
    shake = {
        (camera, axis): rms
        for camera in results.cameras
        for axis in AXES
        if (rms := shake_rms_um(results, camera, axis)) is not None
    }
    worst = max(shake, key=lambda key: shake[key], default=None)
    where = "the estimate, about its mean" if worst is None else f"camera {worst[0]}, {worst[1]}"
    return [
        Figure("Position, 1 sd", f"{_largest(place, 1e3)} µm", "smoothed, median, worst axis"),
        Figure("Velocity, 1 sd", f"{_largest(speed)} mm/s", "smoothed, median, worst axis"),
        Figure("Taken from positions", f"{_largest(away, 1e3)} µm",
               "RMS of naive (triangulated, encoder added) minus smoothed, worst axis"),
        Figure("Taken from velocities", f"{_largest(away_speed)} mm/s",
               "RMS of naive (difference over two frames) minus smoothed, worst axis"),
        Figure("Shake", f"{number(None if worst is None else shake[worst], 3)} µm",
               f"RMS, largest: {where}"),
    ]  # fmt: skip


def _largest(values: list[float | None], factor: float = 1.0) -> str:
    known = [value for value in values if value is not None]
    return number(factor * max(known), 3) if known else ABSENT


def axis_table(results: SmoothingResults) -> tuple[list[str], list[Row]]:
    """Heads, a column per rig axis, and rows: what was judged, then what the tables hold."""
    judged = judged_axes(results.content)
    keys = [
        key for key in dict.fromkeys(k for one in judged.values() for k in one)
        if key not in _ELSEWHERE and any(one.get(key) != [] for one in judged.values())
    ]  # fmt: skip
    columns = {
        "sd of velocity, mm/s": [_scaled(v) for v in axis_sd(results, SPEED)],
        "naive minus smoothed, µm": [_scaled(v, 1e3) for v in taken_away(results)],
        "RTS minus smoothed, µm": [_scaled(v, 1e3) for v in taken_away(results, "rts_")],
    }
    if "sigma_mm" not in keys:
        columns = {"sd, µm": [_scaled(v, 1e3) for v in axis_sd(results)]} | columns
    for camera in results.cameras:
        columns[f"shake of {camera}, µm"] = [
            "unseen" if axis in results.unseen(camera)
            else _scaled(shake_rms_um(results, camera, axis))
            for axis in AXES
        ]  # fmt: skip
    rows = [
        Row((_head(key), *(_cell(key, judged.get(axis, {}).get(key)) for axis in AXES)),
            strong=key == "verdict")
        for key in keys
    ]  # fmt: skip
    rows += [Row((name, *cells)) for name, cells in columns.items()]
    return ["", *(_axis_name(results, axis) for axis in range(3))], rows


def judged_axes(content: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """What smoothing.json says of each axis, wherever it does; empty when nothing was judged."""
    for part in (content.get("axes"), content.get("per_axis"), content):
        if isinstance(part, Mapping):
            found = {a: part[a] for a in AXES if isinstance(part.get(a), Mapping)}
            if found:
                return found
    return {}


def _axis_name(results: SmoothingResults, axis: int) -> str:
    along = float(results.up[axis])
    vertical = {True: " (up)", False: " (down)"}[along > 0] if abs(along) > 0.9 else ""
    return AXES[axis] + vertical


def _head(key: str) -> str:
    if key in _NAMES:
        return _NAMES[key]
    for unit, shown in (("_mm_s", ", mm/s"), ("_mm", ", µm"), ("_um", ", µm"), ("_hz", ", Hz"),
                        ("_nats", ", nats")):  # fmt: skip
        if key.endswith(unit):
            return key.removesuffix(unit).replace("_", " ") + shown
    return key.replace("_", " ")


def _cell(key: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return ", ".join(str(item) if isinstance(item, str) else number(item) for item in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key == "eta" and is_number(value):
        return f"{value:.4f}"
    return _scaled(value, 1e3 if key.endswith("_mm") else 1.0)


def _scaled(value: Any, factor: float = 1.0) -> str:
    return number(value * factor, 3) if is_number(value) else "-"


def swap_rows(results: SmoothingResults) -> list[Row]:
    """Lines whose owner could be another: Hz, axes, RMS, what the other reading costs, owner."""
    alike: dict[tuple[str, str, str], list[tuple[str, Mapping[str, Any]]]] = {}
    for axis, judged in judged_axes(results.content).items():
        lines = judged.get("lines")
        for line in lines if isinstance(lines, list) else ():
            if isinstance(line, Mapping):
                hz, owner = number(line.get("frequency_hz")), str(line.get("owner") or ABSENT)
                alike.setdefault((hz, owner, _told(line)), []).append((axis, line))
    return [_swap_row(*key, lines) for key, lines in alike.items()]


def _told(line: Mapping[str, Any]) -> str:
    cost: Any = line.get("other_owner_costs_nats")
    if line.get("ambiguous"):
        return "open"
    return (
        "told by the data" if is_number(cost) and cost >= _OPEN_NATS else "told by what bubbles do"
    )


def _swap_row(hz: str, owner: str, told: str, lines: list[tuple[str, Mapping[str, Any]]]) -> Row:
    """One line on all of its axes; of the costs the least."""
    axes = ", ".join(axis for axis, _ in lines)
    sizes = ", ".join(_scaled(line.get("rms_mm"), 1e3) for _, line in lines)
    costs = [line.get("other_owner_costs_nats") for _, line in lines]
    least = min((float(c) for c in costs if c is not None and is_number(c)), default=None)
    cost = ABSENT if least is None else f"{round(least, 1) + 0.0:.1f}"
    return Row((hz, axes, sizes, cost, owner, told), strong=told == "open")


def residual_rows(results: SmoothingResults) -> list[Row]:
    """Pixels of bubbles and references: how many, outliers, residuals in sigmas."""
    rows = []
    for name, found in results.part("residuals").items():
        if not isinstance(found, Mapping) or not found.get("pixels"):
            continue
        outliers = found.get("outliers")
        cells = (
            number(found["pixels"]), number(outliers), share(outliers, found["pixels"]),
            number(found.get("rms_sigmas")), number(found.get("median_sigmas")),
        )  # fmt: skip
        rows.append(Row((str(name), *cells)))
    return rows


def residual_words(results: SmoothingResults) -> str:
    """What the sigmas mean, and what was done about them."""
    text = (
        "A residual is a pixel as it was measured minus the pixel that the smoothed motion "
        "predicts, in sigmas of what was stated for it. Where the stated noise is right these are "
        "near 1, less what the fit takes up; outliers are left out of them."
    )
    inflation = results.part("model").get("pixel_inflation")
    if is_number(inflation) and inflation != 1:
        text += f" The noise stated for the bubbles' pixels was multiplied by {number(inflation)}."
    return text
