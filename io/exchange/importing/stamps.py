"""Convert the stamps of a logger's clock, dates and times of day as text, to seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date
from itertools import pairwise

import numpy as np

from telerig.arrays import Array

_DATE = r"(?P<first>\d{1,4})(?P<mark>[-/.])(?P<second>\d{1,2})(?P=mark)(?P<third>\d{1,4})"
_CLOCK = (
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2}):(?P<sec>\d{2}(?:[.,]\d+)?)"
    r"\s*(?P<half>[AaPp])?(?:\.?[Mm]\.?)?(?:\s*(?:Z|UTC|GMT|[+-]\d{2}:?\d{2}))?"
)
_STAMP = re.compile(rf"(?:{_DATE})?[T\s]*(?:{_CLOCK})?")
_DAY_S = 86400.0


def is_stamp(text: str) -> bool:
    """Return whether a text is a date, a time of day, or both."""
    match = _STAMP.fullmatch(text.strip())
    return bool(match and (match["first"] or match["hour"]))


def seconds_of(stamps: Sequence[str]) -> Array | None:
    """Return the times (N,) in s since the first of N time stamps; None if one is no time of day.

    Stamps may have no dates, and may pass midnight. In dates with slashes, day and month are in the
    order that is possible and that gives the shorter record. A time zone is ignored.
    """
    matches = [_STAMP.fullmatch(text.strip()) for text in stamps]
    clock, dates = np.empty(len(matches)), []
    for i, match in enumerate(matches):
        if match is None or match["hour"] is None:
            return None
        hour = int(match["hour"])
        if match["half"]:
            hour = hour % 12 + (12 if match["half"] in "Pp" else 0)
        second = float(match["sec"].replace(",", "."))
        clock[i] = 3600 * hour + 60 * int(match["minute"]) + second
        dates.append((match["mark"], match["first"], match["second"], match["third"]))
    if all(one[0] is None for one in dates):
        turns = np.diff(clock, prepend=clock[:1]) < -_DAY_S / 2
        return np.asarray(clock - clock[0] + _DAY_S * np.cumsum(turns))
    days = _days(dates)
    if days is None:
        return None
    return np.asarray(_DAY_S * (days - days[0]) + (clock - clock[0]))


def _days(dates: Sequence[tuple[str | None, ...]]) -> Array | None:
    """Return the (N,) number of each date's day; None if there is no order that fits them all."""
    different = dict.fromkeys(dates)
    tries = []
    for month_first in (False, True):
        numbers = {one: _day(one, month_first) for one in different}
        if all(n is not None for n in numbers.values()):
            tries.append([float(numbers[one] or 0) for one in dates])
    if not tries:
        return None
    forward = [t for t in tries if all(a <= b for a, b in pairwise(t))] or tries
    return np.array(min(forward, key=lambda t: max(t) - min(t)))


def _day(parts: tuple[str | None, ...], month_first: bool) -> int | None:
    """Return the day's number; year-month-day is recognised, else the order is given."""
    mark, *texts = parts
    if mark is None or any(text is None for text in texts):
        return None
    a, b, c = (int(text or 0) for text in texts)
    if len(texts[0] or "") == 4:
        year, month, day = a, b, c
    else:
        year = c if c > 99 else 2000 + c
        month, day = (a, b) if month_first and mark != "." else (b, a)
    try:
        return date(year, month, day).toordinal()
    except ValueError:
        return None
