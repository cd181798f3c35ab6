"""Write and read results folders so that nobody uses files of two different results together.

Each results folder has a manifest.json with one section per command that writes there: the files
of the command with their hashes, and the fingerprint of its inputs. `replaced_results` writes a
section: it marks the section before it renames the first file and writes the final manifest last.
`reading` is what every reader of a results folder uses: it gets all old files or all new files, or
refuses and names the command that has to run again.
"""

from __future__ import annotations

import fcntl
import os
import time
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

from pydantic import Field, field_validator

from telerig.errors import InputError, TelerigWarning
from telerig.io.files.atomic import (
    check_writable,
    make_parent,
    remove_leftovers,
    rename,
    staged_folder,
    unwritable,
)
from telerig.io.files.hashing import hash_if_there, hashed
from telerig.io.results.inputs import Input, fingerprints
from telerig.io.results.record import Part, Record
from telerig.short_text import counted
from telerig.version import VERSION

NAME = "manifest.json"
RUN_RECORD = "run.json"
LONGEST_COMMAND = 300
"""Characters of a command line that are kept; a batch may name thousands of datasets."""
_SMOOTHED = ("trajectories.csv", "shake.csv", "smoothing.json", "results.h5")
_MARKS = "references.csv"
"""Without a manifest, smoothing would take the marks of an earlier tracking for new ones."""
_OF = {
    "detect": "calibration", "calibrate": "calibration", "track": "run", "smooth": "run",
    "validate": "run", "bubbles": "bubbles", "batch": "batch",
}  # fmt: skip
"""What the results of a command are of; results of different things need folders of their own."""
_OWN = {"run.json", "report.html", "overlays"}
_WRITES = {
    "detect": {"dots.csv", "rejected.csv", "overlays"},
    "calibrate": {
        "calibration.json", "covariance.npz", "uncertainty.npz", "comparison.json", "nominal.toml",
        "dots.csv", "residuals.csv", "rejected.csv", *_OWN,
    },
    "track": {"detections.csv", "tracks.csv", "events.csv", "tracking.json", _MARKS, *_OWN},
    "smooth": {*_SMOOTHED, "bubbles.csv", "bubble_summary.csv", "run.json", "report.html"},
    "validate": {"validation.json", "validation.html"},
    "bubbles": {"detections.csv", "clusters.csv", "overlays"},
    "batch": {"batch.json", "batch.csv", "bubbles.csv", "report.html"},
}  # fmt: skip
"""What a command writes, by the first part of the path in its folder, so that a folder in which it
would replace an input is refused before the work."""
_RECORDED = {"rig.toml", "calibration", "stage_axis", "runs", "truth"}
"""What in a dataset no command may replace."""
_LOCK_WITHIN_S = 30.0
_MOST_TRIES = 20
_LONGEST_NAME, _LONGEST_PATH = 255, 3000
_NO_MANIFEST = (
    "{}: there is no manifest.json, so nobody can check that the files belong together; run the "
    "command again that made this folder"
)


class Written(Part):
    """Hold the fingerprint of one written file.

    rows : number of rows of a CSV table, without its header; None for other files.
    """

    sha256: str
    bytes: int
    rows: int | None = None


class Section(Part):
    """Hold what one command wrote into a results folder.

    again : the command line that makes the files again.
    telerig, finished : the version of telerig and the time (UTC).
    files : the written files by their path relative to the folder.
    inputs : the files that the command used, by their path relative to the folder.

    The following keys are set only while files are being renamed, so they remain if the command is
    killed at that moment.
    found : the hash of every file that changes, as it was before; None where there was none.
    replaces : the section before; None where there was none.
    found_whole : whether the files before were one whole result.

    unfinished : whether the command is still preparing its files; only in its temporary folder.
    """

    again: str = ""
    telerig: str = ""
    finished: str = ""
    files: dict[str, Written] = Field(default_factory=dict)
    inputs: dict[str, Input] = Field(default_factory=dict)
    found: dict[str, str | None] | None = None
    replaces: Section | None = None
    found_whole: bool = True
    unfinished: bool = False

    @field_validator("files", "found", mode="before")
    @classmethod
    def _names_are_inside(cls, names: Any) -> Any:
        for name in names if isinstance(names, dict) else ():
            parts = PurePosixPath(str(name)).parts
            if not parts or ".." in parts or parts[0] == "/" or str(name) == NAME:
                raise ValueError(f"names a file outside the folder: {str(name)[:60]!r}")
        return names

    @field_validator("files", "found", "inputs", mode="before")
    @classmethod
    def _names_are_names(cls, names: Any) -> Any:
        for name in map(str, names if isinstance(names, dict) else ()):
            longest = max(map(len, PurePosixPath(name).parts), default=0)
            if longest > _LONGEST_NAME or len(name) > _LONGEST_PATH or "\0" in name:
                raise ValueError(f"names no file: {name[:60]!r}")
        return names

    def changes(self, folder: Path, *, alone: bool = True) -> dict[str, str]:
        """Return by the path of each input that has changed since in words how, see `Input.change`.

        folder : the results folder.
        """
        found = {name: one.change(folder / name, alone=alone) for name, one in self.inputs.items()}
        return {name: how for name, how in found.items() if how}

    def changing(self) -> set[str]:
        """Return the names of the files that are being renamed or removed."""
        return set(self.found or ())

    def settled(self, folder: Path) -> Section:
        """Return the section to which the files in ``folder`` belong, the new one or the old one.

        Raises InputError when some of the files are old and some are new.
        """
        if self.found is None:
            return self
        now = {name: hash_if_there(folder / name) for name in self.found}
        written = {name: one.sha256 for name, one in self.files.items() if name in self.found}
        if now == dict.fromkeys(self.found) | written:
            return self.model_copy(update={"found": None, "replaces": None})
        if self.found_whole and now == self.found:
            return self.replaces or Section()
        raise InputError(
            "holds files of two different results, because a command was stopped while it replaced "
            "them",
            where=str(folder),
            todo=f"run `{self.again[:LONGEST_COMMAND]}` again",
        )


class Manifest(Record):
    """Hold the content of manifest.json: the sections by the name of the command."""

    KIND: ClassVar[str] = "telerig results"
    AGAIN: ClassVar[str] = (
        "run the command again that made this folder, or delete manifest.json to use the files "
        "without this check"
    )

    schema_: int = Field(1, alias="schema")
    kind: str = KIND
    sections: dict[str, Section] = Field(default_factory=dict)

    @classmethod
    def of_sections(cls, sections: Mapping[str, Section]) -> Manifest:
        """Return the manifest that holds these sections."""
        return cls(schema=cls.SCHEMA, kind=cls.KIND, sections=dict(sections))

    def settled(self, folder: Path) -> Manifest:
        """Return the manifest in which every section describes the files that are in ``folder``.

        A section whose files are a mixture of two results stays as it is. See `Section.settled`.
        """
        sections = {}
        for name, section in self.sections.items():
            try:
                sections[name] = section.settled(folder)
            except InputError:
                continue
        return Manifest.of_sections(sections)


def read_manifest(folder: Path) -> Manifest | None:
    """Read the manifest of a results folder; returns None when there is none.

    Waits while another command is renaming its files. Raises InputError for a manifest that cannot
    be read.
    """
    file = folder / NAME
    if not file.is_file():
        return None
    manifest = Manifest.read(file)
    if any(section.found is not None for section in manifest.sections.values()):
        with _locked(folder, fcntl.LOCK_SH):
            manifest = Manifest.read(file)
    return manifest


@contextmanager
def reading(folder: Path, names: Collection[str]) -> Iterator[None]:
    """Check the files ``names`` of a results folder while the body reads them.

    A file that differs from what telerig wrote, that telerig did not write, or that was removed
    gives a `TelerigWarning`, and so does a whole results folder without a manifest. A folder that
    holds single files only gives none.
    Raises InputError when the files are of two different results, or when a command replaces them
    while they are read.
    """
    before = _checked(folder, names)
    try:
        yield
    finally:
        if _content(folder) != before:
            raise _replaced(folder)


def is_whole(file: Path) -> bool:
    """Return whether a results file exists and is not part of a mixture of two results."""
    if not file.is_file():
        return False
    try:
        manifest = read_manifest(file.parent)
        for section in () if manifest is None else manifest.sections.values():
            if file.name in section.changing():
                section.settled(file.parent)
    except InputError:
        return False
    return True


def _checked(folder: Path, names: Collection[str]) -> bytes:
    """Check files and return the manifest by which they were checked.

    The check is repeated when a command replaced the manifest meanwhile.
    """
    for _ in range(_MOST_TRIES):
        before = _content(folder)
        try:
            doubts = _doubts(folder, read_manifest(folder), set(names))
        except (InputError, OSError):
            if _content(folder) == before:
                raise
            continue
        if _content(folder) == before:
            for words in doubts:
                warnings.warn(words, TelerigWarning, stacklevel=4)
            return before
    raise _replaced(folder)


def _replaced(folder: Path) -> InputError:
    return InputError(
        "was written again while it was being read",
        where=str(folder),
        todo="run the command again",
    )


def _doubts(folder: Path, manifest: Manifest | None, names: set[str]) -> list[str]:
    """Return what a user has to know of the files, one sentence each."""
    if manifest is None:
        return [_NO_MANIFEST.format(folder)] if (folder / RUN_RECORD).is_file() else []
    sections = manifest.sections.values()
    if any(section.unfinished for section in sections):
        return []
    settled = [s.settled(folder) if s.changing() & names else s for s in sections]
    doubts = []
    for name in sorted(names):
        file, entry = folder / name, next((s.files[name] for s in settled if name in s.files), None)
        if not file.is_file():
            if entry is not None:
                doubts.append(f"{file}: is no longer there; the results are used without it")
        elif entry is None:
            doubts.append(f"{file}: was not written into this folder by telerig; it is used")
        elif hashed(file).sha256 != entry.sha256:
            doubts.append(f"{file}: {_difference(file, entry)}; it is used as it is now")
    return doubts


def _difference(file: Path, entry: Written) -> str:
    rows = hashed(file).rows
    if rows is None or entry.rows is None or rows == entry.rows:
        return "was changed after telerig wrote it"
    if rows < entry.rows:
        return f"has {rows} of the {entry.rows} rows that telerig wrote"
    return f"has {counted(rows, 'row')}, telerig wrote {entry.rows}"


@contextmanager
def replaced_results(
    folder: Path, command: str, *, again: str, inputs: Mapping[str, Input]
) -> Iterator[Path]:
    """Yield an empty temporary folder whose files replace those of ``command`` in ``folder``.

    Until the body ends, ``folder`` is as before. Then the new files are renamed into it, the files
    that the command wrote earlier and did not write again are removed, and all other files stay.
    Whoever reads the folder gets the old result or the new one, also after a kill at any moment.

    command : the name of the section.
    again : the command line that makes the files again.
    inputs : the fingerprints of the inputs by path relative to ``folder``, see `fingerprints`.

    Raises InputError as `check_place` does.
    """
    again = again if len(again) <= LONGEST_COMMAND else again[:LONGEST_COMMAND] + " ..."
    section = Section(again=again, telerig=VERSION, inputs=dict(inputs))
    check_place(folder, command, inputs)
    with staged_folder(folder) as staged:
        before = _old(folder).sections
        sections = {
            **before,
            command: section.model_copy(update={"unfinished": True}),
        }
        if folder.is_dir() and staged.parent.samefile(folder):
            sections = {name: _one_deeper(one) for name, one in sections.items()}
        Manifest.of_sections(sections).write(staged / NAME)
        yield staged
        (staged / NAME).unlink()
        paths = sorted(path for path in staged.rglob("*") if path.is_file())
        files = {path.relative_to(staged).as_posix(): _entry(path) for path in paths}
        for name in (NAME, *files):
            _make_room(folder / name)
        assert not set(files) & set(inputs), "`_WRITES` lacks a file"
        remove_leftovers(folder)
        done = datetime.now(UTC).isoformat(timespec="seconds")
        new = section.model_copy(update={"files": files, "finished": done})
        with _locked(folder, fcntl.LOCK_EX):
            _replace(staged, folder, command, new)


def check_place(folder: Path, command: str, inputs: Collection[str] = ()) -> None:
    """Check that a command can write its results into a folder; for before its work.

    inputs : paths relative to ``folder``, the keys of `fingerprints`.

    Raises InputError when the folder cannot be written, when it holds results of another kind, and
    when a file would replace an input.
    """
    check_writable(folder)
    before = _old(folder).sections
    for name in before if command != "report" else ():
        if name != "report" and _OF.get(name) != _OF[command]:
            what = f"holds results of `telerig {name}`, of which some files would be replaced"
            raise InputError(what, where=str(folder), todo="choose another --out")
    for name in inputs:
        if PurePosixPath(name).parts[:1] and PurePosixPath(name).parts[0] in _WRITES[command]:
            raise InputError(
                "would be written over, and these results are made from it",
                where=str(folder / name),
                todo="choose another --out",
            )


def check_file(file: Path, option: str = "--out") -> None:
    """Check that a single file may be written; for before the work.

    Raises InputError for a folder, for what was recorded in a dataset, and for a file of results.
    """
    if file.is_dir():
        todo = f"give {option} the name of a file"
        raise InputError("is a folder, a file must be written there", where=str(file), todo=todo)
    if not file.exists():
        return
    place = file.resolve()
    for folder in place.parents:
        inside = place.relative_to(folder)
        if (folder / "rig.toml").is_file() and inside.parts[0] in _RECORDED:
            what = f"belongs to the dataset {folder} and would be written over"
            raise InputError(what, where=str(file), todo=f"choose another {option}")
        manifest = _old(folder)
        for name, section in manifest.sections.items():
            if inside.as_posix() in section.files:
                what = f"is a result of `telerig {name}` and would be written over"
                raise InputError(what, where=str(file), todo=f"choose another {option}")


def _one_deeper(section: Section) -> Section:
    """Return a section whose inputs are named from a folder inside the one that it was made for."""
    inputs = {(Path("..") / name).as_posix(): one for name, one in section.inputs.items()}
    return section.model_copy(update={"inputs": inputs})


def _old(folder: Path) -> Manifest:
    """Return the manifest of the folder, or what can be known where there is none to be read.

    A smoothing in a folder without a manifest counts as made from the tracks that lie beside it, so
    that it becomes stale when the run is tracked again.
    """
    with suppress(InputError):
        if (folder / NAME).is_file():
            return Manifest.read(folder / NAME)
    files = {n: _entry(folder / n) for n in _SMOOTHED if (folder / n).is_file()}
    if not files:
        return Manifest.of_sections({})
    inputs = fingerprints(folder, [folder / "tracks.csv"])
    return Manifest.of_sections(
        {"smooth": Section(again="telerig smooth RUN", files=files, inputs=inputs)}
    )


def _make_room(file: Path) -> None:
    """Make the folder of a file, before anything is replaced."""
    if file.is_dir():
        raise InputError(
            "is a folder, a file must be written there",
            where=str(file),
            todo="rename the folder or choose another --out",
        )
    make_parent(file)


def _replace(staged: Path, folder: Path, command: str, new: Section) -> None:
    """Rename the staged files into ``folder`` between two versions of its manifest."""
    sections = dict(_old(folder).sections)
    before, whole = sections.pop(command, None), True
    changing = set(new.files)
    if not (folder / NAME).is_file() and command == "track" and (folder / _MARKS).is_file():
        changing.add(_MARKS)
    if before is not None:
        changing |= set(before.files) | before.changing()
        try:
            before = before.settled(folder)
        except InputError:
            before, whole = None, False
    sections = {name: _without(s, new.files) for name, s in sections.items()}
    sections = {name: s for name, s in sections.items() if s.files}
    kept = {name for s in sections.values() for name in s.files}
    changing -= kept
    taken = {"found": {name: hash_if_there(folder / name) for name in sorted(changing)}}
    moving = new.model_copy(update={**taken, "replaces": before, "found_whole": whole})
    Manifest.of_sections({**sections, command: moving}).write(folder / NAME)
    mine = _content(folder)
    for name in new.files:
        rename(staged / name, folder / name)
    for name in sorted(changing - set(new.files)):
        _remove(folder, name)
    if _content(folder) != mine:
        raise InputError(
            "another command wrote into this folder at the same time",
            where=str(folder),
            todo=f"run `{new.again}` again when the other one has ended",
        )
    Manifest.of_sections({**sections, command: new}).write(folder / NAME)


def _without(section: Section, names: Collection[str]) -> Section:
    """Return a section of another command without the files that are taken over from it."""
    kept: dict[str, Any] = {"files": {n: e for n, e in section.files.items() if n not in names}}
    if section.found is not None:
        kept["found"] = {n: h for n, h in section.found.items() if n not in names}
    return section.model_copy(update=kept)


def _remove(folder: Path, name: str) -> None:
    """Remove a file and the folders inside ``folder`` that become empty by it."""
    try:
        (folder / name).unlink(missing_ok=True)
        for parent in list(Path(name).parents)[:-1]:
            (folder / parent).rmdir()
    except FileNotFoundError:
        return
    except OSError as error:
        if (folder / name).exists():
            raise unwritable(folder / name, error) from error


@contextmanager
def _locked(folder: Path, kind: int) -> Iterator[None]:
    """Hold a lock on a folder. File systems without locks, such as some network disks, give none.

    The system releases the lock when the process ends, however it ends.
    """
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        yield
        return
    try:
        _lock(handle, kind)
        yield
    finally:
        os.close(handle)


def _lock(handle: int, kind: int) -> None:
    """Wait for a lock for `_LOCK_WITHIN_S` seconds, then go on without it."""
    end = time.monotonic() + _LOCK_WITHIN_S
    while time.monotonic() < end:
        try:
            fcntl.flock(handle, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(0.02)
        except OSError:
            return
        else:
            return


def _entry(file: Path) -> Written:
    found = hashed(file)
    return Written(sha256=found.sha256, bytes=found.bytes, rows=found.rows)


def _content(folder: Path) -> bytes:
    try:
        return (folder / NAME).read_bytes()
    except OSError:
        return b""
