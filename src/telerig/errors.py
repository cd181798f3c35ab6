"""The errors that telerig raises. Each one says what is wrong, where, and what to do next."""

from __future__ import annotations

from difflib import get_close_matches
from importlib import import_module
from typing import Any
from unicodedata import category

LONGEST_BYTES = {"where": 600, "what": 2000, "todo": 900}
"""The longest parts of a message in bytes: together they fill a terminal's screen.

A file can hold a name of any length, and a message repeats what it found."""


class TelerigError(Exception):
    """This is the base class of every error that telerig raises on purpose.

    what : the fault.
    where : the file, row, camera, view, frame or dot in which it is.
    todo : what the user can do about it.
    code : the name by which a user can accept the fault (`--accept CODE`); "" if nobody can.

    Parts longer than `LONGEST_BYTES` are cut, and control characters are shown as escapes, because
    a terminal would obey them.
    """

    def __init__(self, what: str, *, where: str = "", todo: str = "", code: str = "") -> None:
        self.code = code
        self.what, self.where = _printable(what, "what"), _printable(where, "where")
        self.todo = _printable(todo, "todo")
        parts = [f"{self.where}: {self.what}" if where else self.what]
        if todo:
            parts.append(self.todo)
        super().__init__("\n  -> ".join(parts))

    def __reduce__(self) -> tuple[object, ...]:
        return (_rebuild, (type(self), self.what, self.where, self.todo, self.code))


def _printable(text: str, part: str) -> str:
    """Return the text without control characters, cut to the length of its part of a message."""
    longest = LONGEST_BYTES[part]
    start = text[: longest + 1]
    shown = "".join(
        c if c == "\n" or category(c) not in ("Cc", "Cf", "Cs") else ascii(c)[1:-1] for c in start
    )
    encoded = shown.encode("utf-8")
    if len(text) == len(start) and len(encoded) <= longest:
        return shown
    end = f" ... ({len(text)} characters)"
    return encoded[: longest - len(end)].decode("utf-8", "ignore") + end


def _rebuild(kind: type[TelerigError], what: str, where: str, todo: str, code: str) -> TelerigError:
    return kind(what, where=where, todo=todo, code=code)


class InputError(TelerigError):
    """A file, table, image or argument cannot be used as it is."""


LOAD = "give what telerig.calibrate or telerig.load_calibration returns"
"""The advice for an argument that is no calibration."""


def need_kind(value: object, attribute: str, where: str, todo: str) -> None:
    """Raise InputError for an argument that lacks an attribute, so that it is of a wrong kind.

    where : the function of the library. todo : what to give it.
    """
    if not hasattr(value, attribute):
        raise InputError(f"was given a {type(value).__name__}", where=where, todo=todo)


def need_package(module: str, extra: str, what: str) -> Any:
    """Import and return a package that is an optional dependency.

    extra : its name, as in ``pip install 'telerig[tdms]'``. what : what needs it.
    Raises InputError, with what to install, where it is missing.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(
            f"{what} needs {module}, which is not installed",
            todo=f"pip install 'telerig[{extra}]'",
        ) from error


class DetectionError(TelerigError):
    """The target or a bubble cannot be found in an image, or the dots cannot be numbered."""


class CalibrationError(TelerigError):
    """The measurements cannot give a calibration, or an estimate failed its checks."""


class GeometryError(TelerigError):
    """A point lies outside the region in which a camera model can be evaluated or inverted."""


class TelerigWarning(UserWarning):
    """Something is used although it may not be what the user expects."""


_FEW_LETTERS = 5


def nearest(word: str, known: list[str]) -> str | None:
    """Return the name in ``known`` that is spelled most like ``word``, or None if no name is
    similar.

    Upper and lower case are treated as equal. The only name that begins with a long word comes
    first.
    """
    lowered = {name.lower(): name for name in known}
    longer = [name for name in lowered if name.startswith(word.lower())]
    if len(longer) == 1 and len(word) > _FEW_LETTERS:
        return lowered[longer[0]]
    near = get_close_matches(word.lower(), lowered, n=1, cutoff=0.55)
    return lowered[near[0]] if near else None


def suggestion(word: str, known: list[str]) -> str:
    """Return the advice for an unknown word: the most similar known name, or a list of all known
    names."""
    near = nearest(word, known)
    if near:
        return f"did you mean {near}?"
    return "known: " + ", ".join(known) if known else "nothing is known here: remove it"
