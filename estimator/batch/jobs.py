"""Lists the jobs for a list of datasets, in an order in which they can be done."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast, get_args

from telerig.command_options import (
    KINDS,
    CalibrationOptions,
    Kind,
    Options,
    ShakePriors,
    SmoothingOptions,
    TrackingOptions,
)
from telerig.errors import InputError
from telerig.io.dataset.dataset import load_dataset
from telerig.io.files.names import absent
from telerig.io.results.folders.calibration import CalibrationResults

MAIN_RESULT = {"calibrate": "calibration.json", "track": "tracks.csv", "smooth": "trajectories.csv"}
RESERVED = "calibration"
"""No run can have this name, because results/calibration holds the results of the calibration."""


@dataclass(frozen=True)
class Job:
    """The calibration of one dataset, or the tracking or smoothing of one run; paths are text.

    options : the options of its kind.
    run : name of the run; "" for a calibration.
    calibration : calibration.json to use; "" for that of the dataset.
    tracks : tracks.csv or its folder; "" for the run's results folder.
    report : whether to write report.html.
    only_report : whether to write nothing else.
    kept : why the dataset is not calibrated, but has the calibration that it had before; else "".
    needs : names of the jobs that have to be done before.
    """

    kind: Kind
    dataset: str
    options: Options
    run: str = ""
    calibration: str = ""
    tracks: str = ""
    report: bool = True
    only_report: bool = False
    kept: str = ""
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
    def calibrations(self) -> list[Path] | None:
        """The calibration to use; None for that of the dataset."""
        return [Path(self.calibration)] if self.calibration else None

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
        places = {"--calibration": [self.calibration], "--tracks": [self.tracks]}
        return command_line(self.kind, self.where, self.options, places, report=self.report)

    @property
    def asked(self) -> str:
        """Return as text what the result depends on besides the inputs and the version."""
        same = replace(self, options=type(self.options)(), report=True, only_report=False)
        return same.as_json() + json.dumps(self.options.record())

    def as_json(self) -> str:
        """Return the job as one line of JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, line: str) -> Job:
        """Return the job that `as_json` has written."""
        content = json.loads(line)
        options = {k: tuple(v) if isinstance(v, list) else v for k, v in content["options"].items()}
        made = {"options": KINDS[content["kind"]](**options), "needs": tuple(content["needs"])}
        return cls(**{**content, **made})


def command_line(
    kind: Kind,
    where: str,
    options: Options,
    places: Mapping[str, Iterable[Any]],
    *,
    report: bool = True,
) -> str:
    """Return the command line of a kind of job.

    where : the dataset or the run. places : the folders and files of each option that names some;
    those that are empty or None are left out.
    """
    named = [word for option, of in places.items() for one in of if one for word in (option, one)]
    words = ["telerig", kind, where, *map(str, named), *options.words()]
    return shlex.join(words if report else [*words, "--no-report"])


def jobs_of(
    datasets: Iterable[Path],
    *,
    calibration: Path | None = None,
    calibrating: CalibrationOptions | None = None,
    tracking: TrackingOptions | None = None,
    smoothing: SmoothingOptions | None = None,
    tracks: Path | None = None,
    report: bool = True,
    only: Sequence[str] = (),
    strict: bool = False,
) -> list[Job]:
    """Return the jobs of a batch: calibration, tracking and smoothing of every dataset.

    A job stands after the jobs that it needs. A dataset without views of the target must have been
    calibrated before. One that was, and has no views or has them both as images and as dots.csv, is
    not calibrated again: its calibration is `Job.kept`.

    calibration : a calibration.json to use for all datasets, none of which is then calibrated.
    calibrating, tracking, smoothing : options of the kinds of jobs; None for the defaults.
    report : see `Job`.
    tracks : folder with a folder of tracks for each run, if nothing is tracked; None for the
        results folders.
    only : kinds of jobs (`KINDS`) and names of runs to do; all if empty.
    strict : whether a dataset that cannot be used raises InputError; otherwise it becomes a
        calibration job that fails.

    Raises InputError for folders that do not exist or are named twice, for unknown runs, for
    options of jobs that are not done, and if there is no job.
    """
    kinds, only = kinds_and_runs(only)
    if tracks is not None and "track" in kinds:
        raise InputError(
            "--tracks is given, but this command would track the runs anew",
            todo="add --only smooth, or leave --tracks out",
        )
    places = _checked(datasets)
    options: dict[Kind, Options] = {
        "calibrate": calibrating or CalibrationOptions(),
        "track": tracking or TrackingOptions(),
        "smooth": smoothing or SmoothingOptions(),
    }
    for kind, given in options.items():
        if kind in kinds and not (kind == "calibrate" and calibration is not None):
            continue
        for name, setting in given.settings().items():
            if getattr(given, name) != getattr(type(given), name):
                raise InputError(
                    f"{setting.in_batch or setting.flags[0]} is an option of {kind}, which this "
                    "command does not do",
                    todo="leave it out, or change --only or --calibration",
                )
    shared: dict[str, Any] = {
        "calibration": "" if calibration is None else str(Path(calibration).resolve()),
        "report": report,
    }
    jobs: list[Job] = []
    for place in places:
        try:
            jobs += _jobs_of_one(place, kinds, only, options, shared)
        except InputError:
            if strict:
                raise
            jobs.append(Job("calibrate", str(place), options["calibrate"], **shared))
    _check_only(jobs, only)
    if all(job.kept for job in jobs):
        raise InputError(
            "there is nothing to do: no dataset has a run, and none is to be calibrated",
            where=", ".join(map(str, places)),
            todo="put recordings into runs/NAME, or change --only or --calibration",
        )
    return jobs if tracks is None else _with_tracks(jobs, tracks)


def kinds_and_runs(only: Iterable[str]) -> tuple[tuple[Kind, ...], list[str]]:
    """Return the kinds of jobs and the names of runs among the words of `--only`.

    If no kind is named, all kinds are returned.
    """
    words = list(only)
    kinds = tuple(kind for kind in KINDS if kind in words)
    return kinds or tuple(KINDS), [word for word in words if word not in KINDS]


def shake_of_model(
    calibrating: CalibrationOptions, smoothing: SmoothingOptions, only: Iterable[str]
) -> tuple[CalibrationOptions, SmoothingOptions]:
    """Return the options as `run` and `batch` mean them.

    Where only smoothing is done, `--model` has the meaning that it has for `telerig smooth`, unless
    `--shake` is given, too. Raises InputError for a model of jobs that are not done.
    """
    plain = CalibrationOptions.model
    if kinds_and_runs(only)[0] == ("smooth",):
        if smoothing.model == SmoothingOptions.model:
            if calibrating.model not in get_args(ShakePriors):
                todo = f"with --only smooth use one of: {', '.join(get_args(ShakePriors))}"
                raise InputError(f"--model {calibrating.model} names no priors", todo=todo)
            smoothing = replace(smoothing, model=cast(ShakePriors, calibrating.model))
        return replace(calibrating, model=plain), smoothing
    if calibrating.model == "default":
        todo = "give --shake default for the shake's priors; --model names a lens model here"
        raise InputError("--model default is no lens model", todo=todo)
    return calibrating, smoothing


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
    place: Path,
    kinds: Sequence[Kind],
    only: Sequence[str],
    options: Mapping[Kind, Options],
    shared: Mapping[str, Any],
) -> list[Job]:
    given = bool(shared["calibration"])
    calibrated_before = (place / "results" / "calibration" / "calibration.json").is_file()
    calibrates = "calibrate" in kinds and not given
    data = load_dataset(place, need_views=calibrates and not calibrated_before)
    jobs = []
    if calibrates:
        kept = ""
        if not data.views:
            both = (place / "calibration" / "dots.csv").is_file()
            kept = (
                ("both images and calibration/dots.csv" if both else "no views of the target")
                + " are there, so the calibration made before is used"
                + both * "\n  -> to make it anew: `telerig calibrate` --from images or --from dots"
            )
        jobs.append(Job("calibrate", str(place), options["calibrate"], kept=kept, **shared))
    calibrated = tuple(job.name for job in jobs)
    for run in data.runs:
        if only and run not in only:
            continue
        needs = calibrated
        for kind in (kind for kind in kinds if kind != "calibrate"):
            jobs.append(Job(kind, str(place), options[kind], run, needs=needs, **shared))
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


def check_options(calibration: Path | None, options: CalibrationOptions) -> None:
    """Raise InputError for a calibration that does not exist, and for unknown lens models."""
    from telerig.errors import CalibrationError
    from telerig.estimator.calibration.calibrate import check_options as check

    if calibration is not None:
        CalibrationResults.at(calibration)
    try:
        check(**options.keywords)
    except CalibrationError as error:
        raise InputError(error.what, where="--model", todo=error.todo) from error
