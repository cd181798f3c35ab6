"""Short texts: numbers with significant digits and units, results at a prompt and in notebooks.

`xarray_dataset` makes datasets of results.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from telerig.errors import need_package

if TYPE_CHECKING:
    import xarray

LONGEST = 160
"""Longest text of a fact in characters; the rest is cut."""

ABSENT = "not available"
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class ShortText:
    """Give an object a short `repr` and a small table in notebooks, both made of its facts.

    A dataclass that inherits from this class needs ``repr=False``.
    """

    def title(self) -> str:
        """Return the kind of the object, its name and its verdict, if it has them."""
        raise NotImplementedError

    def facts(self) -> Mapping[str, str]:
        """Return what a user wants to know first, by name; empty texts are left out."""
        raise NotImplementedError

    def __repr__(self) -> str:
        facts = _shown(self.facts())
        width = max(map(len, facts), default=0)
        return "\n".join([self.title(), *(f"  {n:<{width}}  {text}" for n, text in facts.items())])

    def _repr_html_(self) -> str:
        cell = "<td style='text-align:left'>"
        rows = "".join(
            f"<tr>{cell}<b>{escape(name)}</b></td>{cell}{escape(text)}</td></tr>"
            for name, text in _shown(self.facts()).items()
        )
        return f"<div><b>{escape(self.title())}</b><table>{rows}</table></div>"


def xarray_dataset(
    variables: Mapping[str, tuple[Any, ...]],
    coordinates: Mapping[str, Any],
    about: Mapping[str, str],
) -> xarray.Dataset:
    """Return an `xarray.Dataset` of variables (dimensions, values, attributes), by name.

    about : its attributes. Raises InputError if xarray is not installed.
    """
    of = need_package("xarray", "notebook", "to_xarray").Dataset
    found: xarray.Dataset = of(variables, coordinates, {"Conventions": "CF-1.8", **about})
    return found


def _shown(facts: Mapping[str, str]) -> dict[str, str]:
    short = {name: " ".join(text.split()) for name, text in facts.items()}
    return {
        name: text if len(text) <= LONGEST else f"{text[: LONGEST - 4]} ..."
        for name, text in short.items()
        if text
    }


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, as in "1 frame" and "2 frames"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


MOST_LISTED = 12


def counted_list(texts: Sequence[str], noun: str, between: str = ", ") -> str:
    """Return the number of texts with their noun and the first dozen, as in "2 faults: a, b"."""
    rest = len(texts) - MOST_LISTED
    shown = [*texts[:MOST_LISTED], *([f"and {rest} more"] if rest > 0 else [])]
    return f"{counted(len(texts), noun)}:{between.removeprefix(',')}{between.join(shown)}"


def first_of(sentences: tuple[str, ...] | list[str]) -> str:
    """Return the first sentence and how many more there are; "" for none."""
    more = f" (and {len(sentences) - 1} more)" if len(sentences) > 1 else ""
    return f"{sentences[0][: LONGEST - 20]}{more}" if sentences else ""


def is_number(value: Any) -> bool:
    """Return whether a value is a finite int or float; files write null for other numbers."""
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return plain and math.isfinite(value)


def number(value: Any, digits: int = 3) -> str:
    """Return a number with so many significant digits; an int with all of its digits."""
    if not is_number(value):
        return ABSENT
    if value == 0:
        return "0"
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    exponent = math.floor(math.log10(abs(value)))
    if -4 <= exponent < 7:
        return f"{value:,.{max(0, digits - 1 - exponent)}f}".replace(",", "\u202f")
    return f"{value / 10.0**exponent:.{digits - 1}f}·{_power(exponent)}"


def with_sd(value: Any, sd: Any) -> str:
    """Return a value and its standard deviation, rounded to two digits of the latter."""
    if not is_number(value):
        return ABSENT
    if not is_number(sd) or sd <= 0:
        return number(value, 7)
    largest = max(abs(value), sd)
    exponent = math.floor(math.log10(largest))
    if -3 <= exponent < 6:
        decimals = max(0, 1 - math.floor(math.log10(sd)))
        return f"{value:.{decimals}f} ±\u00a0{sd:.{decimals}f}"
    value, sd = value / 10.0**exponent, sd / 10.0**exponent
    decimals = max(0, 1 - math.floor(math.log10(sd)))
    return f"({value:.{decimals}f} ±\u00a0{sd:.{decimals}f})·{_power(exponent)}"


def share(part: Any, whole: Any) -> str:
    """Return a part in per cent of the whole; 100 % only if they are equal."""
    if not is_number(part) or not is_number(whole) or whole <= 0:
        return ABSENT
    percent = 100 * part / whole
    return "100 %" if part == whole else f"{min(percent, 99.9):.1f} %"


def sentence(text: str) -> str:
    """Return a text with a capital letter and a full stop."""
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")


def no_formula(text: str) -> str:
    """Return a text in which matplotlib takes no name of the user's for a formula."""
    return re.sub(r"(?<!\\)\$", r"\\$", text)


UNITS = {
    "_mm_s2": "mm/s²", "_mm_s": "mm/s", "_mm": "mm", "_um": "µm", "_m_s2": "m/s²", "_hz": "Hz",
    "_s": "s", "_px": "px", "_rad": "rad", "_nats": "log-likelihood ratio (nats)",
}  # fmt: skip
"""Units by the end of a name in the files. Longer ends come first."""


def name_with_unit(
    name: str, shown: Mapping[str, tuple[str, float]] | None = None
) -> tuple[str, float]:
    """Return a name in words with its unit, and the factor from the stored to the shown unit.

    shown : {unit of the file: (unit to show, factor)}.
    """
    end = next((end for end in UNITS if name.endswith(end) and name != end), "")
    unit, factor = (shown or {}).get(UNITS.get(end, ""), (UNITS.get(end, ""), 1.0))
    words = name.removesuffix(end).replace("_", " ").replace(".", ": ")
    return (f"{words}, {unit}" if unit else words), factor


def nice_below(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten up to a value; 1 for 0."""
    if not is_number(value) or value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * power <= value * 1.0001) * power)


def short_names(names: Sequence[str]) -> list[str]:
    """Return names without their common beginning, as 00, 01 for view00, view01."""
    if len(names) < 2:
        return list(names)
    alike = [len(set(letters)) == 1 for letters in zip(*names)]
    shared = names[0][: [*alike, False].index(False)].rstrip("0123456789")
    if any(name == shared for name in names):
        return list(names)
    return [name[len(shared) :] for name in names]


def flat_rows(content: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the leaves of nested mappings and lists as (dotted name, text)."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            yield from flat_rows(value, f"{path}.{key}" if path else str(key))
    elif isinstance(content, list) and any(isinstance(item, Mapping | list) for item in content):
        for i, value in enumerate(content):
            yield from flat_rows(value, f"{path}[{i}]")
    elif isinstance(content, list):
        yield path, ", ".join(_leaf(item) for item in content) or "none"
    else:
        yield path, _leaf(content)


def _leaf(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.9g}"
    return ABSENT if value is None else str(value)


def _power(exponent: int) -> str:
    return "10" + str(exponent).translate(_SUPERSCRIPT)
