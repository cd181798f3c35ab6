"""Errors that say what is wrong, where, and what to do next."""

from __future__ import annotations

from difflib import get_close_matches


class TelerigError(Exception):
    """Base of every error that telerig raises on purpose.

    ``what`` is the fault, ``where`` the file, row, view, camera or dot, ``todo`` the remedy.
    """

    def __init__(self, what: str, *, where: str = "", todo: str = "") -> None:
        self.what, self.where, self.todo = what, where, todo
        parts = [f"{where}: {what}" if where else what]
        if todo:
            parts.append(todo)
        super().__init__("\n  -> ".join(parts))

    def __reduce__(self) -> tuple[object, ...]:
        return (_rebuild, (type(self), self.what, self.where, self.todo))


def _rebuild(kind: type[TelerigError], what: str, where: str, todo: str) -> TelerigError:
    return kind(what, where=where, todo=todo)


class InputError(TelerigError):
    """A file, table, image or argument that cannot be used as it is."""


class DetectionError(TelerigError):
    """An image in which the target or a bubble cannot be found or numbered."""


class CalibrationError(TelerigError):
    """Measurements that cannot give a calibration, or an estimate that failed its checks."""


class GeometryError(TelerigError):
    """A point outside the region where a camera model can be evaluated or inverted."""


def nearest(word: str, known: list[str]) -> str | None:
    """The known word that is spelled most like ``word``, in any case; None if none is like it."""
    lowered = {name.lower(): name for name in known}
    near = get_close_matches(word.lower(), lowered, n=1, cutoff=0.55)
    return lowered[near[0]] if near else None


def suggestion(word: str, known: list[str]) -> str:
    """What to do about an unknown word: the nearest known one, or all of them."""
    near = nearest(word, known)
    if near:
        return f"did you mean {near}?"
    return "known: " + ", ".join(known) if known else "nothing is known here: remove it"
