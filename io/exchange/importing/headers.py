"""What the name of a logger's channel says: the axis, the unit, and whether it counts the time.

Names are those that loggers write into their headers, such as ``X (g)``, ``accel_x [m/s^2]``,
``ay_mg``, ``Time (ms)`` or ``timestamp_us``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
"""Units of time, in s."""

_SPELLINGS = {
    **{f"{length}{per}": f"{length}/s^2" for length in ("m", "cm", "mm", "ft")
       for per in ("/s2", "/s^2", "/s/s", "/(s^2)", "/(s2)", "s-2", "s^-2", "_s2", "_s^2", "ps2")},
    "g": "g", "gn": "g", "g0": "g", "gs": "g", "g-force": "g", "gforce": "g",
    "mg": "mg", "milli-g": "mg", "millig": "mg",
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sek", "sekunden"), "s"),
    **dict.fromkeys(("ms", "msec", "millis", "millisec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "usec", "micros", "microsec", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("min", "minute", "minutes"), "min"),
    **dict.fromkeys(("h", "hr", "hour", "hours"), "h"),
}  # fmt: skip
_OTHER_UNITS = {"deg", "°", "deg/s", "°/s", "dps", "rad/s", "rad", "v", "mv", "t", "ut", "mt",
                "gauss", "pa", "hpa", "kpa", "c", "°c", "degc", "f", "°f", "%", "-", "n", "mm",
                "count", "counts", "lsb", "lux", "hz", "nounits", "n/a", "1"}  # fmt: skip
_WRITTEN = {"⁻²": "^-2", "²": "^2", "⁻": "-", "\u2212": "-", "µ": "u", "μ": "u", "sec^": "s^",
            "/sec": "/s", "**": "^"}  # fmt: skip
_BRACKETS = re.compile(r"[\[(]((?:[^\[\]()]|\([^()]*\))*)[\])]")
_SUFFIX = re.compile(r"[_ ](m_s2|mm_s2|cm_s2|m_s\^2|mps2|[mu]?g|[mun]?s|sec|msec|usec|seconds|"
                     r"min|minutes|h|hr|hours)$")  # fmt: skip
_UNIT_LIKE = re.compile(r"[^\W\d][\w/^²·*%-]{0,11}")

_TIME_WORDS = {"time", "timestamp", "timestamps", "datetime", "elapsed", "epoch", "epoc", "utc",
               "unix", "uptime", "zeit", "uhrzeit", "zeitstempel", "temps", "tiempo", "tempo",
               "tijd", "tid"}  # fmt: skip
_TIME_NAMES = {"t", "x value", "s", "sec", "seconds", "ms", "millis", "milliseconds", "us",
               "micros", "microseconds"}  # fmt: skip
_DATES = {"date", "datum", "fecha"}
_COUNTERS = {"count", "counter", "sample", "samples", "sample no", "sample number", "sample index",
             "index", "idx", "no", "nr", "n", "#", "packetcounter", "packet counter",
             "packet number", "seq", "sequence", "row"}  # fmt: skip
_OTHER_QUANTITY = re.compile(
    r"gyr|mag|angul|angle|rotat|quat|euler|roll|pitch|yaw|vel|temp|press|gps|incl|tilt|theta|phi|"
    r"dps|deg|rad|field|compass|pos|disp|jerk|free|user|std|rms|peak|max|min\b"
)
_AXIS = re.compile(r"(?:^|[^a-z])(?P<a>a|acc|accel|acceleration|accelerometer|beschleunigung)?"
                   r"[\s_.:-]*(?P<axis>[xyz])(?=[^a-z]|$)")  # fmt: skip


def known_unit(text: str) -> str:
    """Return the name in `ACCELERATION_UNITS` or `TIME_UNITS` of a text like "[µs]", or ""."""
    plain = _plain(text)
    return _SPELLINGS.get(plain, "")


def is_unit(text: str) -> bool:
    """Return whether a cell can be a unit in a line of units: a known one, or in brackets."""
    text = text.strip()
    if not text or known_unit(text) or _plain(text) in _OTHER_UNITS:
        return True
    return bool(re.fullmatch(r"[\[(].*[\])]", text))


def unit_in(name: str) -> str:
    """Return the unit that a channel's name states, as `known_unit` names it, or "".

    Another unit in brackets is returned as it stands: ``Channel A (mV)``. A range, ``X (16g)``, is
    no unit.
    """
    inside = [match[1].strip() for match in _BRACKETS.finditer(name)]
    after_comma = _BRACKETS.sub("", name).rpartition(",")[2] if "," in name else ""
    suffix = _SUFFIX.search(name.strip().lower())
    for text in (*inside, after_comma, suffix[1] if suffix else ""):
        if known_unit(text):
            return known_unit(text)
    other = [text for text in inside if _UNIT_LIKE.fullmatch(text)]
    return other[0] if other and _plain(other[0]) in _OTHER_UNITS else ""


def axes_in(names: Iterable[str]) -> list[tuple[str, str, str]]:
    """Return every three channels whose names differ only in their axis x, y, z.

    Names of an acceleration go before plain ``x``, ``y``, ``z``; those of other
    quantities are left out.
    """
    found: dict[bool, dict[str, dict[str, str]]] = {True: {}, False: {}}
    for name in names:
        lower = name.strip().lower()
        if _OTHER_QUANTITY.search(lower):
            continue
        speaks = bool(re.search(r"acc|beschl", lower))
        for match in _AXIS.finditer(lower):
            start, end = match.span("axis")
            template = f"{lower[:start]}{{}}{lower[end:]}"
            explicit = speaks or match["a"] is not None
            found[explicit].setdefault(template, {}).setdefault(match["axis"], name)
    for explicit in (True, False):
        whole = [(axes["x"], axes["y"], axes["z"])
                 for axes in found[explicit].values() if len(axes) == 3]  # fmt: skip
        if whole:
            return whole
    return []


def is_time(name: str) -> bool:
    """Return whether a channel's name says that it holds times."""
    words = _words(name)
    return words in _TIME_NAMES or bool(set(words.split()) & _TIME_WORDS)


def is_date(name: str) -> bool:
    """Return whether a channel's name says that it holds the dates that belong to its times."""
    return _words(name) in _DATES


def is_counter(name: str) -> bool:
    """Return whether a channel's name says that it counts the samples."""
    return _words(name) in _COUNTERS or name.strip() == "#"


def time_unit_in(name: str, stated: Mapping[str, str]) -> str:
    """Return the unit of a channel of times, by its name or as stated, or ""."""
    for unit in (known_unit(stated.get(name, "")), unit_in(name), known_unit(_words(name))):
        if unit in TIME_UNITS:
            return unit
    return ""


def _plain(text: str) -> str:
    text = text.strip()
    while re.fullmatch(r"[\[(][^\[\]()]*(?:\([^()]*\))?[^\[\]()]*[\])]", text):
        text = text[1:-1].strip()
    text = text.lower()
    for written, meant in _WRITTEN.items():
        text = text.replace(written, meant)
    return re.sub(r"[\s·⋅*.]", "", text)


def _words(name: str) -> str:
    """Return the name's words in lower case, without units in brackets and after an underscore."""
    lower = _BRACKETS.sub(" ", name.strip()).partition(",")[0].lower()
    lower = _SUFFIX.sub("", lower.strip())
    return " ".join(re.findall(r"[^\W_]+", lower))
