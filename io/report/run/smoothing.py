"""The words and tables of a smoothed run's report: verdict, axes, modes, constants, residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from telerig.io.report.page.page import Row, Tile
from telerig.io.report.page.page import Verdict as PageVerdict
from telerig.io.results.folders.smoothing import (
    AXES,
    SPEED,
    SmoothingResults,
    axis_sd,
    known_parts,
    shake_rms_um,
    taken_away,
)
from telerig.io.results.smoothing import Flag, Grade, Mode, Place, Verdict
from telerig.io.results.verdict_words import (
    FLAG_WORDS,
    NOT_JUDGED,
    UNKNOWN_FLAG,
    VERDICT_WORDS,
    consequence_words,
    mode_remedy,
    number_words,
    remedy_words,
    to_resolve,
    words_of_axes,
    words_of_contradiction,
    words_of_use,
)
from telerig.short_text import (
    ABSENT,
    flat_rows,
    is_number,
    name_with_unit,
    number,
    sentence,
    share,
    with_sd,
)

_COLOURS = {
    Verdict.RESOLVED: "good",
    Verdict.PARTIAL: "usable",
    Verdict.UNRESOLVED: "rejected",
    Verdict.CONTRADICTED: "rejected",
}
_HARMLESS = {Flag.SHAKE_BELOW_NOISE}
_HEADS = {
    "eta": "η", "sigma_mm": "sd, µm", "sigma_shake_known_mm": "sd if the shake were known, µm",
    "sigma_encoder_mm": "sd that the encoder's scale and the travel axis add, µm",
    "sigma_offset_mm": "sd of the offset of all places, µm",
}  # fmt: skip
_IN_UM = {"mm": ("µm", 1e3)}


_ELSEWHERE = {"words", "lines", "shake_rms_mm"}


def smoothing_verdict(results: SmoothingResults) -> PageVerdict:
    """Return the verdict of the smoothing, with a remedy if there is one."""
    file = results.file
    (headline, meaning, _), colour, good = NOT_JUDGED, "usable", ""
    if file.verdict is not None:
        colour, good = _COLOURS[file.verdict], number_words(file.axes, file.vertical, file.verdict)
        headline, meaning = VERDICT_WORDS[file.verdict].headline, consequence_words(file)
    of_axes = words_of_axes(file)
    contradicted = file.verdict == Verdict.CONTRADICTED
    sentences = [good, meaning]
    sentences += map(words_of_contradiction, file.contradictions)
    sentences += of_axes if not good and not contradicted else []
    sentences.append("" if contradicted else _size_words(results))
    if file.rig_change is not None and file.rig_change.words:
        sentences.append(f"Rig: {file.rig_change.words}.")
    if file.verdict in (Verdict.PARTIAL, Verdict.UNRESOLVED):
        sentences.append(to_resolve(remedy_words(file.remedies)))
    flags = {flag: f"{flag}: {FLAG_WORDS.get(flag, UNKNOWN_FLAG)}" for flag in file.flags}
    sentences += [text for flag, text in flags.items() if flag in _HARMLESS]
    warnings = [text for flag, text in flags.items() if flag not in _HARMLESS]
    warnings += [sentence(w) for w in file.warnings]
    if warnings and colour == "good":
        colour = "usable"
    known = tuple(dict.fromkeys(s for s in sentences if s))
    return PageVerdict(headline, colour, known, tuple(warnings))


def smoothing_tiles(results: SmoothingResults) -> list[Tile]:
    """Return the most important numbers."""
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
        Tile("Position, 1 sd", f"{_largest(place, 1e3)} µm",
               f"smoothed, median, worst axis{_with_encoder(results)}"),
        Tile("Velocity, 1 sd", f"{_largest(speed)} mm/s", "smoothed, median, worst axis"),
        Tile("Taken from positions", f"{_largest(away, 1e3)} µm",
               "RMS of unsmoothed (triangulated plus encoder) less smoothed, worst axis"),
        Tile("Taken from velocities", f"{_largest(away_speed)} mm/s",
               "RMS of unsmoothed (difference over two frames) less smoothed, worst axis"),
        Tile("Shake", f"{number(None if worst is None else shake[worst], 3)} µm",
               f"RMS, largest: {where}"),
    ]  # fmt: skip


def _with_encoder(results: SmoothingResults) -> str:
    """Return what the sd of trajectories.csv holds beside that of the verdict; "" for nothing."""
    added: list[Any] = [
        axis.content().get("sigma_encoder_mm") for axis in results.file.axes.values()
    ]
    if not any(is_number(value) and value > 0 for value in added):
        return ""
    return "; with what the encoder's scale and the travel axis add to all bubbles alike"


def _largest(values: list[float | None], factor: float = 1.0) -> str:
    known = [value for value in values if value is not None]
    return number(factor * max(known), 3) if known else ABSENT


def use_rows(results: SmoothingResults) -> list[Row]:
    """Return rows of what the run is usable for: grade, quantity, axis, value, assumptions."""
    return [
        Row(
            (
                str(use.grade),
                words_of_use(use),
                use.axis,
                f"{with_sd(use.value, use.sd)} {use.unit.replace('^2', '²')}",
                ", ".join(use.assumes) or "-",
            ),
            strong=use.grade == Grade.NO,
        )
        for use in sorted(results.file.usable_for, key=lambda u: list(Grade).index(u.grade))
    ]


def axis_table(results: SmoothingResults) -> tuple[list[str], list[Row]]:
    """Return heads, a column per axis of the rig, and rows: the verdict and statistics."""
    judged = {name: axis.content() for name, axis in results.file.axes.items()}
    keys = [
        key for key in dict.fromkeys(k for one in judged.values() for k in one)
        if key not in _ELSEWHERE and any(one.get(key) != [] for one in judged.values())
    ]  # fmt: skip
    columns = {
        "sd of velocity, mm/s": [_scaled(v) for v in axis_sd(results, SPEED)],
        "naive minus smoothed, µm": [_scaled(v, 1e3) for v in taken_away(results)],
        "RTS minus smoothed, µm": [_scaled(v, 1e3) for v in taken_away(results, "rts_")],
    }
    name = "sd in trajectories.csv, µm" if "sigma_mm" in keys else "sd, µm"
    columns = {name: [_scaled(v, 1e3) for v in axis_sd(results)]} | columns
    for camera in results.cameras:
        columns[f"shake of {camera}, µm"] = [
            "unseen" if axis in results.unseen(camera)
            else _scaled(shake_rms_um(results, camera, axis))
            for axis in AXES
        ]  # fmt: skip
    rows = []
    for key in keys:
        head = _HEADS.get(key) or name_with_unit(key, _IN_UM)[0]
        cells = (_cell(key, judged.get(axis, {}).get(key)) for axis in AXES)
        rows.append(Row((head, *cells), strong=key == "verdict"))
    rows += [Row((name, *cells)) for name, cells in columns.items()]
    return ["", *(_axis_name(results, axis) for axis in range(3))], rows


def _size_words(results: SmoothingResults) -> str:
    """Return a sentence on residuals of another size than the model leaves; "" for none."""
    known = known_parts(results, "whiteness", "expected").values()
    ratios = [v["rms_sigmas"] / v["expected_rms_sigmas"] for v in known]
    if max(ratios, default=1.0) > _LARGER:
        return (
            f"The pixels' residuals are {number(max(ratios), 2)} times what the model leaves: more "
            "noise or faster motion than it states. Standard deviations of a frame may be too "
            "small by as much."
        )
    if min(ratios, default=1.0) < _SMALLER:
        return (
            f"The pixels' residuals are {number(min(ratios), 2)} of what the model leaves: pixels "
            "scatter less from frame to frame than stated. Standard deviations of a frame may be "
            "too large."
        )
    return ""


def _axis_name(results: SmoothingResults, axis: int) -> str:
    along = float(results.up[axis])
    vertical = {True: " (up)", False: " (down)"}[along > 0] if abs(along) > 0.9 else ""
    return AXES[axis] + vertical


def _cell(key: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return ", ".join(str(item) if isinstance(item, str) else number(item) for item in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key == "eta" and is_number(value):
        return f"{value:.4f}"
    return _scaled(value, name_with_unit(key, _IN_UM)[1])


def _scaled(value: Any, factor: float = 1.0) -> str:
    return number(value * factor, 3) if is_number(value) else "-"


def residual_rows(results: SmoothingResults) -> list[Row]:
    """Return rows of pixel residuals of bubbles and marks: number, outliers, RMS."""
    return [
        Row(
            (
                name,
                number(found.pixels),
                number(found.outliers),
                share(found.outliers, found.pixels),
                number(found.rms_sigmas),
                number(found.median_sigmas),
            )
        )
        for name, found in results.file.residuals.items()
        if found.pixels
    ]


def unseen_words(results: SmoothingResults) -> list[str]:
    """Return a sentence for each camera that does not see its own shake along some rig axes.

    These are the axes along which the camera looks. The sentence names them, and says that the
    figures and the verdict leave out the camera's shake along them. A camera that sees its shake
    along all axes has no sentence.
    """
    words = []
    for camera in results.cameras:
        left_out = results.unseen(camera)
        if left_out:
            axes = " and ".join(left_out)
            words.append(
                f"Camera {camera} looks along {axes} and does not see its own shake there: it is "
                "left out, of the pictures and of the verdict."
            )
    return words


def residual_words(results: SmoothingResults) -> str:
    """Return sentences on what residuals in sigmas mean."""
    text = (
        "A residual is a pixel as it was measured minus the pixel that the smoothed motion "
        "predicts, in sigmas of what was stated for it. Where the stated noise is right these are "
        "near 1, less what the fit takes up; outliers are left out of them."
    )
    for whose, key in (("bubbles'", "pixel_inflation"), ("marks'", "mark_inflation")):
        inflation = results.part("model").get(key)
        if is_number(inflation) and inflation != 1:
            text += f" The noise stated for the {whose} pixels was multiplied by "
            text += f"{number(inflation)}."
    return text


MODE_HEADS = ["what shakes", "Hz", "damping", "RMS, µm", "what would help"]

MOST_ROWS = 30
_PLACES = {
    Place.COMMON: "all cameras alike (carriage, mount)", Place.SERVO: "servo (following error)",
}  # fmt: skip


def mode_rows(results: SmoothingResults) -> tuple[list[Row], str]:
    """Return rows of the shake's modes with remedies, and a sentence on their origin."""
    modes = results.file.modes
    rows = [_mode(mode) for mode in _merged(modes)]
    if not rows:
        return rows, "The model has no modes, and no peak in the spectrum of the shake was found."
    if any(mode.source != "estimate" for mode in modes):
        return rows, "These are the modes of the model that the smoother used."
    return rows, (
        "The model has no modes: these are peaks in the spectrum of the estimated shake. The "
        "damping is that of a single mode that is as wide as the peak, so it is an upper limit "
        "where the run is too short to resolve the peak."
    )


def _merged(modes: Sequence[Mode]) -> list[Mode]:
    """Return modes, those that were learned axis by axis as one with all axes."""
    found: dict[tuple[str, float], Mode] = {}
    for mode in modes:
        key = (mode.where, mode.frequency_hz)
        same = found.setdefault(key, mode)
        if isinstance(mode.rms_mm, tuple) and isinstance(same.rms_mm, tuple):
            largest = tuple(max(pair) for pair in zip(same.rms_mm, mode.rms_mm))
            found[key] = same.model_copy(update={"rms_mm": largest})
    return list(found.values())


def _mode(mode: Mode) -> Row:
    where = f"arm of {mode.camera}" if mode.place == Place.ARM else f"{mode.place} {mode.camera}"
    numbers = (number(mode.frequency_hz), number(mode.damping), _rms_um(mode.rms_mm))
    return Row((_PLACES.get(mode.place, where), *numbers, mode_remedy(mode)))


def _rms_um(rms_mm: Any) -> str:
    """Return the RMS of one axis or of three as text."""
    if is_number(rms_mm):
        return number(1e3 * rms_mm, 3)
    if not isinstance(rms_mm, tuple):
        return ABSENT
    known = [(a, v) for a, v in zip(AXES, rms_mm) if is_number(v) and v > 0]
    return ", ".join(f"{axis}: {number(1e3 * value, 3)}" for axis, value in known) or "0"


def constant_rows(results: SmoothingResults) -> list[Row]:
    """Return rows of the sensors' constants: sensor, constant, value with sd."""
    parts = {"encoder": results.part("encoder")} | dict(results.part("accelerometers"))
    return [
        Row((str(sensor), *named))
        for sensor, values in parts.items()
        if isinstance(values, Mapping)
        for named in _constants(values)
    ]


def mean_rows(results: SmoothingResults) -> list[Row]:
    """Return rows of the first bubbles' mean velocities."""
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
        shown, factor = name_with_unit(name, {"s": ("ms", 1e3)})
        sd: Any = values.get("s" + name)
        text = ABSENT if value is None else _cell(name, value)
        if is_number(value):
            text = with_sd(value * factor, sd * factor if is_number(sd) else None)
            text = text if is_number(sd) else number(value * factor, 4)
        out.append((shown, text))
    return out


_SOURCES = {
    "default": "default frequencies and damping; the pixel noise and the RMS of the shake are "
    "estimated from this run.",
    "learned": "found from this run by maximum likelihood.",
    "given": "given by the user.",
}


def model_rows(results: SmoothingResults) -> list[tuple[str, str]]:
    """Return rows of all hyper-parameters by their names in smoothing.json."""
    model = {k: v for k, v in results.part("model").items() if k != "name"}
    rows = [(name, value) for name, value in flat_rows(model) if value]
    return [(name_with_unit(name)[0], _owner(name, value, results.cameras)) for name, value in rows]


def model_words(results: SmoothingResults) -> str:
    """Return a sentence on the origin of the hyper-parameters."""
    source = str(results.part("model").get("name") or ABSENT)
    return _SOURCES.get(source, source)


def _owner(name: str, value: str, cameras: Sequence[str]) -> str:
    """Return numbers with significant digits, and a camera's index as its name."""
    if name.endswith(".camera"):
        known = value.isdigit() and int(value) < len(cameras)
        return cameras[int(value)] if known else "all alike" if value == "-1" else value
    try:
        return ", ".join(number(float(part), 4) for part in value.split(", ")) or "none"
    except ValueError:
        return value or "none"


WHITENESS_HEADS = ["camera", "residuals are", "next frame", "RMS, sigmas", "p"]
_LARGER, _SMALLER = 1.25, 0.8


def whiteness_rows(results: SmoothingResults) -> list[Row]:
    """Return rows by camera: verdict, correlation and RMS beside the model's, p-value."""
    rows = []
    for camera, found in known_parts(results, "whiteness", "expected").items():
        rho, expected = (np.array(found[key], float) for key in ("autocorrelation", "expected"))
        sizes = (found.get(key) for key in ("rms_sigmas", "expected_rms_sigmas"))
        verdict = str(found.get("verdict"))
        cells = (
            camera, verdict, _beside(float(rho[0]), float(expected[0])), _beside(*sizes),
            number(found.get("p"), 2),
        )  # fmt: skip
        rows.append(Row(cells, strong=verdict == "correlated"))
    return rows


def _beside(seen: Any, expected: Any) -> str:
    return f"{number(seen, 2)} (model {number(expected, 2)})"


def whiteness_words(results: SmoothingResults) -> str:
    """Return sentences on what too large, small or correlated residuals mean."""
    known = known_parts(results, "whiteness", "expected").values()
    if not known:
        return "Not judged: too few frames for it."
    out = [words] if (words := _size_words(results)) else []
    if any(v.get("verdict") == "correlated" for v in known):
        out.append(
            "Residuals of consecutive frames are correlated in another way than a correct model "
            "leaves them. Causes may be motion that the model does not contain, centres that "
            "wander with the bubbles' shapes, or pixel noise that is not as stated. The errors of "
            "neighbouring frames are then more alike than the covariance says."
        )
    return " ".join(out) or (
        "The size of the residuals and their correlation between consecutive frames agree with "
        "what a correct model leaves: the residuals show no unexplained motion."
    )
