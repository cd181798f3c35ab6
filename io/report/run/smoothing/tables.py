"""Tables of a smoothed run's report: modes with their remedies, constants, hyper-parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from telerig.io.report.page.number_format import ABSENT, flat_rows, is_number, number, with_sd
from telerig.io.report.page.page import Row
from telerig.io.report.run.smoothing.numbers import Line, shake_lines
from telerig.io.report.run.smoothing.results import AXES, SmoothingResults

MODE_HEADS = ["what shakes", "Hz", "damping", "RMS, µm", "what helps"]

MOST_ROWS = 30
_LIGHTLY_DAMPED = 0.02
_COMMON = (
    "stiffer carriage guide or mount of the arms; heavy parts closer to the guide; gentler ramps"
)
_ARM = (
    "shorter or stiffer arm (a third shorter raises the frequency 1.8 times), less weight at its "
    "end, a counterweight"
)
_DAMPING = "a damping layer or a tuned absorber"
_SERVO = "the controller: a notch at {} Hz, less gain, smoother set points"
_FOLLOWING = "servo (following error)"
_PITCH = "stiffen the arm against twisting; camera's weight on the arm's axis"
_UNKNOWN_ARM = (
    "no other camera sees this axis: an accelerometer on the carriage tells whether it is the "
    "carriage or the arm"
)


def mode_rows(results: SmoothingResults) -> tuple[list[Row], str]:
    """The shake's modes and where they come from: learned or given, else peaks of the estimate."""
    judged = [m for m in results.content.get("modes") or [] if isinstance(m, Mapping)]
    model = results.part("model")
    known = [m for m in judged if m.get("source") != "estimate"]
    modes = known or [m for m in model.get("modes") or [] if isinstance(m, Mapping)]
    rows = [_mode(mode, results.cameras) for mode in _merged(modes)]
    rows += [_pitch(m, results.cameras) for m in model.get("pitches") or []
             if isinstance(m, Mapping)]  # fmt: skip
    servo = dict(model.get("carriage") or {}).get("servo")
    followed = [_mode(m, results.cameras) for m in judged if m.get("where") == "servo"]
    if isinstance(servo, list) and len(servo) == 3:
        followed = [_servo(*servo)]
    if rows:
        return rows + followed, "The modes of the model that the smoother used."
    groups = _grouped(shake_lines(results))[:MOST_ROWS]
    lines = [_line(group, results.cameras) for group in groups]
    if not lines:
        return followed, (
            "The model has no modes, and no peak stands out of the spectrum of the estimated shake."
        )
    return lines + followed, (
        "The model has no modes: these are the peaks in the spectrum of the estimated shake, and "
        "how alike the cameras move there. Damping is that of a single mode as wide as the peak, "
        "roughly; “below” where the run is too short to tell."
    )


def _merged(modes: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """A mode that is learned axis by axis as one, with the RMS of all of its axes."""
    found: dict[Any, dict[str, Any]] = {}
    for mode in modes:
        key = (mode.get("where", mode.get("camera")), mode.get("frequency_hz"))
        same, rms_mm = found.setdefault(key, dict(mode)), mode.get("rms_mm")
        if isinstance(rms_mm, list) and isinstance(same.get("rms_mm"), list):
            same["rms_mm"] = [
                max((v for v in pair if is_number(v)), default=0.0)
                for pair in zip(same["rms_mm"], rms_mm)
            ]
    return list(found.values())


def _mode(mode: Mapping[str, Any], cameras: Sequence[str]) -> Row:
    where, remedy = _place(mode.get("where", mode.get("camera")), cameras)
    damping: Any = mode.get("damping")
    helps = [text for key in ("remedy", "remedies") for text in _texts(mode.get(key))]
    if not helps:
        helps = [remedy] if remedy else []
        if is_number(damping) and damping < _LIGHTLY_DAMPED:
            helps.append(_DAMPING)
    cells = (number(mode.get("frequency_hz")), number(damping), _rms_um(mode.get("rms_mm")))
    return Row((where, *cells, "; ".join(helps)))


def _texts(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value]
    return [str(v) for v in value] if isinstance(value, list) else []


def _place(camera: Any, cameras: Sequence[str]) -> tuple[str, str]:
    """In words, and the remedy."""
    if isinstance(camera, int) and 0 <= camera < len(cameras):
        camera = cameras[camera]
    name = str(camera).removeprefix("arm ")
    if name in cameras:
        return f"arm of {name}", _ARM
    if camera == -1 or str(camera).lower() in ("common", "carriage", "none"):
        return "all cameras alike (carriage, mount)", _COMMON
    if camera == "servo":
        return _FOLLOWING, _SERVO.format("its")
    return str(camera), ""


def _rms_um(rms_mm: Any) -> str:
    """Of one axis or three."""
    if is_number(rms_mm):
        return number(1e3 * rms_mm, 3)
    if not isinstance(rms_mm, list):
        return ABSENT
    known = [(a, v) for a, v in zip(AXES, rms_mm) if is_number(v) and v > 0]
    return ", ".join(f"{axis}: {number(1e3 * value, 3)}" for axis, value in known) or "0"


def _pitch(mode: Mapping[str, Any], cameras: Sequence[str]) -> Row:
    where, _ = _place(mode.get("camera"), cameras)
    rms: Any = mode.get("rms_rad")
    angle = f"{number(math.degrees(rms), 2)}°" if is_number(rms) else ABSENT
    return Row((f"{where}, turning", number(mode.get("frequency_hz")),
                number(mode.get("damping")), angle, _PITCH))  # fmt: skip


def _servo(rms_mm: Any, frequency_hz: Any, damping: Any) -> Row:
    return Row((_FOLLOWING, number(frequency_hz), number(damping),
                _rms_um(rms_mm), _SERVO.format(number(frequency_hz))))  # fmt: skip


def _grouped(lines: Sequence[Line]) -> list[list[Line]]:
    """Lines of about one frequency together, the strongest first."""
    groups: list[list[Line]] = []
    for line in lines:
        near = [g for g in groups if abs(g[0].frequency_hz - line.frequency_hz) <= line.width_hz]
        if near:
            near[0].append(line)
        else:
            groups.append([line])
    return groups


def _line(lines: Sequence[Line], cameras: Sequence[str]) -> Row:
    shared = [line for line in lines if not line.alone or len(cameras) == 1]
    where, remedy = {
        "common": ("all cameras alike (carriage, mount)", _COMMON),
        "apart": ("cameras not alike (arms)", _ARM),
        "": (f"camera {' and '.join(sorted({line.where for line in lines}))}", _UNKNOWN_ARM),
    }.get(name := shared[0].where if shared else "", (f"camera {name} (arm)", _ARM))
    first = lines[0]
    if first.damping < _LIGHTLY_DAMPED and not first.upper:
        remedy += f"; {_DAMPING}"
    damping = ("below " if first.upper else "") + number(first.damping, 2)
    sizes = ", ".join(f"{line.axis}: {number(line.rms_um, 3)}" for line in lines)
    return Row((where, number(first.frequency_hz), damping, sizes, remedy))


_CONSTANTS = (
    ("_mm_s2", ", mm/s²", 1.0), ("_mm_s", ", mm/s", 1.0), ("_s", ", ms", 1e3),
)  # fmt: skip


def constant_rows(results: SmoothingResults) -> list[Row]:
    """Constants of encoder and accelerometers: sensor, what, value with its sd."""
    parts = {"encoder": results.part("encoder")} | dict(results.part("accelerometers"))
    return [
        Row((str(sensor), *named))
        for sensor, values in parts.items()
        if isinstance(values, Mapping)
        for named in _constants(values)
    ]


def mean_rows(results: SmoothingResults) -> list[Row]:
    """Mean velocities of the bubbles: the first rows."""
    rows = []
    for particle, values in results.part("bubble_means").items():
        if isinstance(values, Mapping):
            cells = [with_sd(values.get(f"{a}_mm_s"), values.get(f"s{a}_mm_s")) for a in AXES]
            rows.append(Row((str(particle), *cells)))
    return rows[:MOST_ROWS]


def _constants(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    out = []
    for name, value in values.items():
        if name[:1] == "s" and name[1:] in values:
            continue
        shown, factor = name.replace("_", " "), 1.0
        for ending, unit, times in _CONSTANTS:
            if name.endswith(ending) and name != ending:
                shown, factor = name.removesuffix(ending).replace("_", " ") + unit, times
                break
        sd: Any = values.get("s" + name)
        text = with_sd(value * factor, sd * factor) if is_number(value) and is_number(sd) else (
            number(value * factor, 4) if is_number(value) else ABSENT)  # fmt: skip
        out.append((shown, text))
    return out


_UNITS = (
    ("_mm_s2", "mm/s²"), ("_mm_s", "mm/s"), ("_mm", "mm"), ("_hz", "Hz"), ("_s", "s"),
    ("_px", "px"), ("_rad", "rad"),
)  # fmt: skip


_SOURCES = {
    "default": "fixed priors, with noise and size of the shake adapted to the data.",
    "learned": "found from this run by maximum likelihood.",
    "given": "given by the user.",
}


def model_rows(results: SmoothingResults) -> list[tuple[str, str]]:
    """Every hyper-parameter by its name in `smoothing.json`."""
    model = {k: v for k, v in results.part("model").items() if k != "name"}
    rows = [(name, value) for name, value in flat_rows(model) if value]
    return [(_readable(name), _owner(name, value, results.cameras)) for name, value in rows]


def model_words(results: SmoothingResults) -> str:
    """Where the hyper-parameters come from."""
    source = str(results.part("model").get("name") or ABSENT)
    return f"{source}: {_SOURCES[source]}" if source in _SOURCES else source


def _readable(name: str) -> str:
    for ending, unit in _UNITS:
        if name.endswith(ending):
            name = f"{name.removesuffix(ending)}, {unit}"
            break
    return name.replace("_", " ").replace(".", ": ")


def _owner(name: str, value: str, cameras: Sequence[str]) -> str:
    """Numbers with the digits that matter; a camera's index as its name."""
    if name.endswith(".camera"):
        known = value.isdigit() and int(value) < len(cameras)
        return cameras[int(value)] if known else "all alike" if value == "-1" else value
    try:
        return ", ".join(number(float(part), 4) for part in value.split(", ")) or "none"
    except ValueError:
        return value or "none"
