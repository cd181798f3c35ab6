"""Lists the jobs for a list of datasets, in an order in which they can be done."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from telerig.errors import InputError
from telerig.io.dataset.dataset import load_dataset
from telerig.io.files.names import absent

Kind = Literal["calibrate", "track", "smooth"]
KINDS: tuple[Kind, ...] = ("calibrate", "track", "smooth")
SHAKE_MODELS = ("auto", "default")
"""The priors of the shake that `telerig smooth --model` can name."""

MAIN_RESULT = {"calibrate": "calibration.json", "track": "tracks.csv", "smooth": "trajectories.csv"}
RESERVED = "calibration"
"""No run can have this name, because results/calibration holds the results of the calibration."""


@dataclass(frozen=True)
class Job:
    """The calibration of one dataset, or the tracking or smoothing of one run; paths are text.

    run : name of the run; "" for a calibration.
    calibration : calibration.json to use; "" for that of the dataset.
    model, medium : options of a calibration, see `telerig.calibrate`.
    shake, refine_rig, accept : options of a smoothing, see `telerig.smooth`.
    cluster : address of the Dask scheduler whose workers detect bubbles; "" for this computer.
    tracks : tracks.csv or its folder; "" for the run's results folder.
    report : whether to write report.html.
    only_report : whether to write nothing else.
    needs : names of the jobs that have to be done before.
    """

    kind: Kind
    dataset: str
    run: str = ""
    calibration: str = ""
    model: str = "auto"
    medium: str = "air"
    shake: str = "auto"
    refine_rig: bool = False
    accept: tuple[str, ...] = ()
    cluster: str = ""
    tracks: str = ""
    report: bool = True
    only_report: bool = False
    needs: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """A name that is unique within a batch and can be a file name."""
        place = Path(self.dataset)
        mark = hashlib.sha256(str(place).encode()).hexdigest()[:6]
        return ".".join(filter(None, (place.name, mark, self.run, self.kind)))

    @property
    def where(self) -> str:
        """The place of the data, for messages."""
        return f"{self.dataset}/runs/{self.run}" if self.run else self.dataset

    @property
    def results(self) -> Path:
        """The folder to which the job writes."""
        return Path(self.dataset) / "results" / (self.run or "calibration")

    @property
    def result(self) -> Path:
        """The file that exists when the job is done."""
        return self.results / MAIN_RESULT[self.kind]

    @property
    def lacks_report(self) -> bool:
        """Whether the report that the job should write does not exist."""
        return self.report and not (self.results / "report.html").is_file()

    @property
    def command(self) -> str:
        """The command line that does the same as the job."""
        words = ["telerig", self.kind, self.where]
        if self.calibration:
            words += ["--calibration", self.calibration]
        if self.kind == "calibrate":
            words += [f"--model={self.model}", f"--medium={self.medium}"]
        if self.kind == "track" and self.cluster:
            words += ["--cluster", self.cluster]
        if self.kind == "smooth":
            words += self._smoothing_options()
        return shlex.join(words if self.report else [*words, "--no-report"])

    def _smoothing_options(self) -> list[str]:
        words = ["--tracks", self.tracks] if self.tracks else []
        words += [f"--model={self.shake}"] if self.shake != "auto" else []
        words += ["--refine-rig"] if self.refine_rig else []
        return [*words, *(word for code in self.accept for word in ("--accept", code))]

    @property
    def options(self) -> str:
        """Return as text what the result depends on besides the inputs and the version."""
        return replace(self, report=True, only_report=False, cluster="").as_json()

    def as_json(self) -> str:
        """Return the job as one line of JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, line: str) -> Job:
        """Return the job that `as_json` has written."""
        content = json.loads(line)
        return cls(**{**content, **{key: tuple(content[key]) for key in ("needs", "accept")}})


def jobs_of(
    datasets: Iterable[Path],
    *,
    calibration: Path | None = None,
    model: str = "auto",
    medium: str = "air",
    shake: str = "auto",
    refine_rig: bool = False,
    accept: Sequence[str] = (),
    cluster: str | None = None,
    tracks: Path | None = None,
    report: bool = True,
    only: Sequence[str] = (),
    strict: bool = False,
) -> list[Job]:
    """Return the jobs of a batch: calibration, tracking and smoothing of every dataset.

    A job stands after the jobs that it needs. A dataset without views of the target must have been
    calibrated before.

    calibration : a calibration.json to use for all datasets, none of which is then calibrated.
    model, medium, shake, refine_rig, accept, cluster, report : see `Job`.
    tracks : folder with a folder of tracks for each run, if nothing is tracked; None for the
        results folders.
    only : kinds of jobs (`KINDS`) and names of runs to do; all if empty.
    strict : whether a dataset that cannot be used raises InputError; otherwise it becomes a
        calibration job that fails.

    Raises InputError for folders that do not exist or are named twice, for unknown runs, and for
    options of jobs that are not done.
    """
    kinds, only = kinds_and_runs(only)
    if tracks is not None and "track" in kinds:
        raise InputError(
            "--tracks is given, but this command would track the runs anew",
            todo="add --only smooth, or leave --tracks out",
        )
    places = _checked(datasets)
    shared: dict[str, Any] = {
        "calibration": "" if calibration is None else str(Path(calibration).resolve()),
        "model": model,
        "medium": medium,
        "shake": shake,
        "refine_rig": refine_rig,
        "accept": tuple(accept),
        "cluster": cluster or "",
        "report": report,
    }
    jobs: list[Job] = []
    for place in places:
        try:
            jobs += _jobs_of_one(place, kinds, only, shared)
        except InputError:
            if strict:
                raise
            jobs.append(Job("calibrate", str(place), **shared))
    _check_only(jobs, only)
    return jobs if tracks is None else _with_tracks(jobs, tracks)


def kinds_and_runs(only: Iterable[str]) -> tuple[tuple[Kind, ...], list[str]]:
    """Return the kinds of jobs and the names of runs among the words of `--only`.

    If no kind is named, all kinds are returned.
    """
    words = list(only)
    kinds = tuple(kind for kind in KINDS if kind in words)
    return kinds or KINDS, [word for word in words if word not in KINDS]


def shake_model(model: str, shake: str | None, only: Iterable[str]) -> tuple[str, str]:
    """Return the lens model and the shake's priors that `--model` and `--shake` mean.

    Where only smoothing is done, `--model` has the meaning that it has for `telerig smooth`. Raises
    InputError for unknown priors, and for a model of jobs that are not done.
    """
    smooths_only = kinds_and_runs(only)[0] == ("smooth",)
    if smooths_only and shake is None:
        model, shake = "auto", model
    elif model == "default":
        todo = "give --shake default for the shake's priors; --model names a lens model here"
        raise InputError("--model default is no lens model", todo=todo)
    if (shake or "auto") not in SHAKE_MODELS:
        option = "--model" if smooths_only else "--shake"
        todo = f"use one of: {', '.join(SHAKE_MODELS)}"
        raise InputError(f"{option} {shake}: there is no such choice", todo=todo)
    return model, shake or "auto"


def _with_tracks(jobs: Sequence[Job], tracks: Path) -> list[Job]:
    """Return the jobs with the folder of each run's tracks.

    Raises InputError for two runs with the same name.
    """
    folders = [str(tracks.resolve() / job.run) if job.kind == "smooth" else "" for job in jobs]
    check_distinct([folder for folder in folders if folder], "--tracks")
    return [replace(job, tracks=folder) for job, folder in zip(jobs, folders)]


def check_distinct(folders: Sequence[str], option: str) -> None:
    """Raise InputError if two runs would use the same folder.

    folders : folder of each run. option : command-line option that named their common parent.
    """
    twice = next((folder for folder in folders if folders.count(folder) > 1), None)
    if twice is not None:
        raise InputError(
            f"several runs are named {Path(twice).name!r}, so they would share one folder in that "
            f"of {option}",
            todo=f"use a command for each of these runs, each with another {option}",
        )


def _jobs_of_one(
    place: Path, kinds: Sequence[Kind], only: Sequence[str], shared: Mapping[str, Any]
) -> list[Job]:
    given = bool(shared["calibration"])
    calibrated_before = (place / "results" / "calibration" / "calibration.json").is_file()
    calibrates = "calibrate" in kinds and not given
    data = load_dataset(place, need_views=calibrates and not calibrated_before)
    jobs = [Job("calibrate", str(place), **shared)] if data.views and calibrates else []
    calibrated = tuple(job.name for job in jobs)
    for run in data.runs:
        if only and run not in only:
            continue
        needs = calibrated
        for kind in (kind for kind in KINDS[1:] if kind in kinds):
            jobs.append(Job(kind, str(place), run, needs=needs, **shared))
            needs = (*needs, jobs[-1].name)
    return jobs


def _checked(datasets: Iterable[Path]) -> list[Path]:
    places = [Path(place).resolve() for place in datasets]
    for place in places:
        if not place.is_dir():
            raise absent(place, "folder", "give folders with a rig.toml")
        if places.count(place) > 1:
            raise InputError("the dataset is named twice", where=str(place), todo="name it once")
    return places


def _check_only(jobs: Sequence[Job], only: Sequence[str]) -> None:
    known = sorted({job.run for job in jobs if job.run})
    for run in only:
        if run not in known:
            raise InputError(
                f"no dataset has a run {run!r}", where="--only",
                todo="give --only the name of a folder in runs/ or a kind of job "
            f"({', '.join(KINDS)}), or leave it out",
            )  # fmt: skip


def share_of(jobs: Sequence[Job], index: int, of: int) -> list[Job]:
    """Return the jobs of every ``of``-th dataset, beginning with dataset ``index`` (from 0).

    The jobs of a dataset stay together, because they need each other.
    """
    places = list(dict.fromkeys(job.dataset for job in jobs))
    mine = set(places[index::of])
    return [job for job in jobs if job.dataset in mine]


def check_run_name(run: Path) -> None:
    """Raise InputError for a run whose results would be mixed with those of the calibration."""
    place = Path(run).resolve()
    if place.name == RESERVED and place.parent.name == "runs":
        raise InputError(
            "a run with this name would write into the results of the calibration",
            where=str(run), todo="rename the folder",
        )  # fmt: skip


def check_options(calibration: Path | None, model: str, medium: str = "air") -> None:
    """Raise InputError for a calibration that does not exist, an unknown lens model or medium."""
    from telerig.errors import CalibrationError
    from telerig.estimator.calibration.calibrate import checked_medium
    from telerig.rig.lens_parameters import checked_model

    if calibration is not None and not Path(calibration).exists():
        todo = "give the calibration.json that `telerig calibrate` wrote"
        raise absent(Path(calibration), "calibration", todo)
    try:
        checked_model(model)
    except CalibrationError as error:
        raise InputError(f"--model {model}", todo=error.todo) from error
    checked_medium(medium)
