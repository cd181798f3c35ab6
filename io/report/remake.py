"""Every report that a folder's files allow, made again."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from telerig.errors import InputError
from telerig.io.files.names import absent
from telerig.io.results.findings import Status
from telerig.io.results.folders.calibration import CalibrationResults
from telerig.io.results.manifest import replaced_results

Kind = Literal["calibration", "run", "validation", "batch"]

_KINDS: dict[str, Kind] = {
    "calibration.json": "calibration", "tracking.json": "run", "validation.json": "validation",
    "batch.json": "batch",
}  # fmt: skip


@dataclass(frozen=True)
class ResultsFolder:
    """A folder with the results of a calibration, a run or a batch."""

    folder: Path
    kind: Kind


def results_folders(folder: Path) -> tuple[ResultsFolder, ...]:
    """Return the results folders by name in a results folder or a dataset, the calibration first.

    calibration.json, tracking.json, validation.json or batch.json say which kind a folder is.
    Raises InputError where there is none.
    """
    place = Path(folder)
    if not place.is_dir():
        raise absent(place, "folder", "give a folder of results, or a dataset's")
    own = _of(place)
    if own:
        return (own,)
    below = place / "results" if (place / "results").is_dir() else place
    candidates = [below, *below.iterdir()] if below != place else list(below.iterdir())
    found = [r for r in map(_of, sorted(p for p in candidates if p.is_dir())) if r]
    if len(found) > 1:  # an imported calibration has no page, the runs beside it have
        found = [r for r in found if not _is_imported(r)]
    if not found:
        raise InputError(
            "holds no results: no calibration.json, tracking.json, validation.json or batch.json",
            where=str(place),
            todo="run `telerig calibrate`, `telerig track` or `telerig batch` first",
        )  # fmt: skip
    return tuple(sorted(found, key=lambda r: list(_KINDS.values()).index(r.kind)))


def remake_report(results: ResultsFolder, out: Path | None = None) -> Path:
    """Write the page of a results folder into it, or into ``out``; return its path.

    Raises InputError for an ``out`` with results of its own.
    """
    if out is not None:
        if _of(out) is not None and out.resolve() != results.folder.resolve():
            raise InputError(
                "holds other results, whose page would be replaced",
                where=str(out),
                todo="choose another --out",
            )
        return _write_page(results, out, out)
    again = f"telerig report {shlex.quote(str(results.folder))}"
    with replaced_results(results.folder, "report", again=again, inputs={}) as staged:
        return results.folder / _write_page(results, staged, results.folder).name


def _write_page(results: ResultsFolder, out: Path, page_folder: Path) -> Path:
    """Write into ``out`` the page that will lie in ``page_folder``."""
    if results.kind == "calibration":
        from telerig.io.report.calibration.report import write_calibration_report

        return write_calibration_report(results.folder, out, page_folder=page_folder)
    if (results.folder / "validation.json").is_file():
        from telerig.io.report.validation import write_validation_report

        page = write_validation_report(results.folder, out)
        if results.kind == "validation":
            return page
    if results.kind == "run":
        from telerig.io.report.run.report import write_track_report

        return write_track_report(results.folder, out, page_folder=page_folder)
    from telerig.io.report.batch.report import write_batch_report

    return write_batch_report(results.folder, out, page_folder=page_folder)


def _is_imported(results: ResultsFolder) -> bool:
    if results.kind != "calibration":
        return False
    return CalibrationResults(results.folder).file.verdict.status == Status.IMPORTED


def _of(folder: Path) -> ResultsFolder | None:
    if folder.name.startswith("."):
        return None
    kind = next((kind for file, kind in _KINDS.items() if (folder / file).is_file()), None)
    return None if kind is None else ResultsFolder(folder, kind)
