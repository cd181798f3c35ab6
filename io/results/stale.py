"""Find results that are stale: made from inputs that have changed since."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from telerig.errors import InputError, suggestion
from telerig.io.results.manifest import LONGEST_COMMAND, Section, read_manifest

STALE = "stale"
ACCEPTED = (STALE,)
"""Codes of what an export may be told to accept."""
_MOST_SHOWN = 4
_LONGEST_NAME = 80


def stale(folder: Path, names: Collection[str] | None = None) -> tuple[str, ...]:
    """Return one sentence for each stale result on which files of a results folder depend.

    folder : a results folder. names : the files in it that count; None for all.
    A result is stale when a recorded input of it has changed, or was itself made from inputs that
    have changed since. The sentences are in the order in which the commands have to run again. A
    folder without a manifest has none.
    """
    found: dict[tuple[Path, str], str] = {}
    _search(folder, names, found)
    return tuple(sentence for sentence in found.values() if sentence)


def refuse_stale(
    folder: Path, names: Collection[str], accept: Collection[str] = ()
) -> tuple[str, ...]:
    """Raise InputError when one of the files is stale, unless ``accept`` holds "stale".

    Returns the sentences of `stale` that were accepted.
    """
    for code in accept:
        if code not in ACCEPTED:
            raise InputError(
                f"--accept {code}: there is no such code", todo=suggestion(code, list(ACCEPTED))
            )
    found = stale(folder, names)
    if found and STALE not in accept:
        raise InputError(
            " ".join(found),
            where=str(folder),
            todo='or export the results as they are: --accept stale (in Python accept=["stale"])',
        )
    return found


def _search(
    folder: Path, names: Collection[str] | None, found: dict[tuple[Path, str], str]
) -> bool:
    """Add the stale results of a folder to ``found``, after those from which they were made.

    Returns whether one of them is stale.
    """
    try:
        manifest = read_manifest(folder)
    except InputError:
        return False
    if manifest is None:
        return False
    any_stale = False
    for command, section in manifest.settled(folder).sections.items():
        if names is not None and not section.unfinished and not set(names) & set(section.files):
            continue
        key = (folder.resolve(), command)
        if key not in found:
            found[key] = ""
            sentence = _sentence(folder, section, found)
            del found[key]
            found[key] = sentence
        any_stale |= bool(found[key])
    return any_stale


def _sentence(folder: Path, section: Section, found: dict[tuple[Path, str], str]) -> str:
    reasons, changes = [], section.changes(folder)
    for name in section.inputs:
        path = folder / name
        shown = name.lstrip("./")[-_LONGEST_NAME:]
        upstream = path.is_file() and _search(path.parent, [path.name], found)
        if name in changes:
            reasons.append(f"{shown} {changes[name]}")
        elif upstream:
            reasons.append(f"{shown} is stale itself")
    if not reasons:
        return ""
    more = len(reasons) - _MOST_SHOWN
    listed = ", ".join(reasons[:_MOST_SHOWN]) + (f" and {more} more" if more > 0 else "")
    words = (
        f"The results of `{section.again[:LONGEST_COMMAND]}` are stale ({listed}); run it again."
    )
    return " ".join(words.split())  # one line, as exports write it into comments
