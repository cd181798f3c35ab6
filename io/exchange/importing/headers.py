"""The names that loggers give to columns of times and accelerations, and the units in them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from telerig.rig.units import ACCELERATION_UNITS

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
"""Units of time, in s."""

_AXIS = ("{}", "a{}", "acc{}", "accel{}", "acceleration{}", "accelerometer{}", "{}axis", "{}accel")
"""Known names of an axis, of which only the letters count."""
_TIME = {"t", "time", "timestamp", "elapsed", "epoch", "xvalue"}
_LOOKS = {"µ": "u", "μ": "u", "²": "2", "⁻": "-", "\u2212": "-", "sec": "s", "_": "/",
          **dict.fromkeys("^·.() ", "")}  # fmt: skip
_UNIT = re.compile(
    r"\s*(?:[\[(](?P<inside>.*)[\])]|,\s*(?P<after>[^,]+)|"
    r"_(?P<end>[cm]?m_s2|ft_s2|m?g|[mun]?s|min|h))$"
)


def known_unit(text: str) -> str:
    """Return the name in `ACCELERATION_UNITS` or `TIME_UNITS` of a text like "µs"; "" of others."""
    plain = text.strip().lower()
    for written, meant in _LOOKS.items():
        plain = plain.replace(written, meant)
    plain = re.sub(r"(m|ft)s-2", r"\1/s2", plain).replace("/s/s", "/s2").replace("s2", "s^2")
    return plain if plain in ACCELERATION_UNITS or plain in TIME_UNITS else ""


def unit_in(name: str) -> str:
    """Return the unit in a name like ``X (g)``, ``X Accel, g``, ``ax_m_s2``; "" without one."""
    found = _UNIT.search(name.strip())
    return known_unit(next(filter(None, found.groups()), "")) if found else ""


def known_columns(
    names: Sequence[str], units: Mapping[str, str]
) -> tuple[str | None, tuple[str, str, str] | None]:
    """Return the known name of the times, of two the one with a unit, and the names of x, y and z.

    units : those that are stated apart from the names. None stands for what is not there, or for
    axes that are there twice.
    """
    plain = [_letters(name) for name in names]
    times = [name for name, letters in zip(names, plain) if letters in _TIME]
    times.sort(key=lambda name: not (units.get(name) or unit_in(name)))
    sets = [tuple(form.format(axis) for axis in "xyz") for form in _AXIS]
    found = [one for one in sets if all(plain.count(axis) == 1 for axis in one)]
    axes = tuple(names[plain.index(axis)] for axis in found[0]) if len(found) == 1 else None
    return (times[0] if times else None), axes  # type: ignore[return-value]


def _letters(name: str) -> str:
    """Return the letters of a name without its unit and without the names of its structs."""
    return re.sub(r"[^a-z]", "", _UNIT.sub("", name.strip()).rpartition(".")[2].lower())
