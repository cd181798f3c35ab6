"""The rule for names: of views, runs, sensors, marks and bubbles; `camera_names` has more of it.

A name becomes a file name, a line of another program's script or a cell of a table, so it must be
harmless in each of them. Letters of any language, digits, spaces and most signs are allowed.
"""

from __future__ import annotations

from pathlib import Path
from unicodedata import category

from telerig.errors import InputError, nearest

LONGEST_BYTES = 120
"""File systems allow 255, and a name gets an ending."""

ADVICE = (
    "use letters, digits, spaces, _ and -; a name becomes part of file names, so it has no / and "
    f"no \\, begins with none of . = @ and has at most {LONGEST_BYTES} bytes"
)
_FORBIDDEN = {"Cc": "a control character", "Cf": "an invisible character",
              "Cs": "half a character", "Zl": "a line break", "Zp": "a line break"}  # fmt: skip


def fault_of_name(name: str) -> str:
    """Return what is wrong with a name, in words that complete "the name ..."; "" if nothing is."""
    if not name.strip():
        return "is empty"
    if len(name.encode("utf-8", "surrogatepass")) > LONGEST_BYTES:
        return f"has {len(name)} characters"
    for sign in name:
        if sign in "/\\":
            return f"has a {sign}"
        if category(sign) in _FORBIDDEN:
            return f"has {_FORBIDDEN[category(sign)]} ({sign!a})"
    if name[0] in ".=@":
        return f"begins with {name[0]}"
    return ""


def absent(path: Path, thing: str, otherwise: str) -> InputError:
    """Return the error for a file or folder that does not exist, or for a file in a folder's place.

    thing : what it should have been. otherwise : what to do if there is no similar name.
    """
    if path.is_file():
        todo = f"give its folder, {path.parent}"
        return InputError("is a file, not a folder", where=str(path), todo=todo)
    first = next((p for p in [*path.parents[::-1], path] if not p.exists()), path)
    beside = sorted(p.name for p in first.parent.iterdir()) if first.parent.is_dir() else []
    near = nearest(first.name, beside)
    return InputError(
        f"there is no such {thing}",
        where=str(path),
        todo=f"did you mean {near}?" if near else otherwise,
    )


def check_name(name: str, where: str, thing: str = "name") -> str:
    """Return a name unchanged if it can be part of file names.

    where : the place that the error names. thing : what has the name, for example "camera".
    Raises InputError for a name that `fault_of_name` finds a fault in.
    """
    if fault := fault_of_name(name):
        raise InputError(f"the {thing} {name!r:.80} {fault}", where=where, todo=ADVICE)
    return name
