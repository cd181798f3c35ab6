"""Runs jobs in their order on the cores of this computer or on a Dask cluster, and keeps their
records.

Each job runs in its own process, so a crash does not stop the others. A journal has one file per
job; batch.csv and batch.json hold the records of all jobs.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from graphlib import TopologicalSorter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from telerig.command_options import CalibrationOptions, SmoothingOptions, TrackingOptions
from telerig.errors import InputError, TelerigWarning
from telerig.estimator.batch.jobs import MAIN_RESULT, Job, check_run_name
from telerig.estimator.batch.work import calibrate_dataset, smooth_run, track_run
from telerig.io.files.atomic import write_json_atomic
from telerig.io.files.csv_table import write_table
from telerig.io.machine.parallel import cores
from telerig.io.results.batch import (
    BatchFile,
    has_failed,
    listed,
    verdict_and_flags,
    verdict_counts,
)
from telerig.io.results.manifest import is_whole, read_manifest, replaced_results
from telerig.io.results.smoothing import SmoothingFile
from telerig.io.tables.smoothing import BATCH_BUBBLES, SUMMARY
from telerig.progress import Progress
from telerig.version import VERSION

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration

DONE, KEPT, REJECTED = "done", "kept", "rejected"
FAILED, CRASHED, LEFT_OUT = "failed", "crashed", "left out"
_KEPT_OUTPUT = 2000
_END_WITHIN_S = 5.0
_CHILD = "telerig.scripts.batch_job"
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

_children: set[subprocess.Popen[str]] = set()
_stopped = threading.Event()


def do_job(job: Job, stage: Progress | None = None) -> dict[str, Any]:
    """Do a job in this process.

    stage : is called with the progress; None for nobody.
    Returns a mapping with "status", "words" (the reason of a failure) and "figures".
    """
    if job.only_report:
        return _draw(job)
    if job.kept:
        return _keep(job)
    return {"calibrate": _calibrate, "track": _track, "smooth": _smooth}[job.kind](job, stage)


def _own_calibration(job: Job) -> Calibration:
    """Read the calibration of the job's dataset. Raises InputError for one that was rejected."""
    from telerig.estimator.calibration.result.calibration import load_calibration

    file = Path(job.dataset) / "results" / "calibration" / MAIN_RESULT["calibrate"]
    calibration = load_calibration(file)
    if calibration.rejection:
        todo = "correct its cause and calibrate again, or give another one (--calibration)"
        raise InputError(calibration.rejection, where=str(file), todo=todo)
    return calibration


def _draw(job: Job) -> dict[str, Any]:
    """Write the report of results that exist."""
    from telerig.io.report.remake import remake_report, results_folders

    for results in results_folders(job.results):
        remake_report(results)
    return {"status": DONE, "words": "", "figures": {}}


def perform(job: Job) -> dict[str, Any]:
    """Do a job in a process of its own and return its result. No error is raised.

    The new process ends when this one ends, because its standard input is then closed.
    """
    begun = time.perf_counter()
    result = _outcome(job)
    return {
        **result,
        "seconds": round(time.perf_counter() - begun, 2),
        "host": socket.gethostname(),
    }


def allow() -> None:
    """Allow `perform` to start jobs again after `stop_all`."""
    _stopped.clear()


def stop_all() -> None:
    """End the processes of `perform` in all threads. Jobs that start later fail at once.

    Each process is interrupted as by Ctrl-C, and killed after `_END_WITHIN_S` seconds.
    """
    _stopped.set()
    ending = list(_children)
    try:
        for child in ending:
            child.send_signal(signal.SIGINT)
        deadline = time.monotonic() + _END_WITHIN_S
        for child in ending:
            with suppress(subprocess.TimeoutExpired):
                child.wait(max(0.0, deadline - time.monotonic()))
    finally:
        for child in ending:
            child.kill()


def _outcome(job: Job) -> dict[str, Any]:
    """Run a job in a new process and return its result, or a failure if the process dies."""
    if not Path(job.dataset).is_dir():
        return failure(
            FAILED,
            f"{job.dataset}: the computer that does this job has no such folder; make the folder "
            "available there under the same path",
        )
    environment = {**dict.fromkeys(_ONE_THREAD, "1"), **os.environ}
    child = subprocess.Popen(
        [sys.executable, "-m", _CHILD], env=environment, stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    _children.add(child)
    if _stopped.is_set():
        child.kill()
    try:
        answer, messages = _answer(child, job)
    finally:
        _children.discard(child)
    code = child.returncode
    if code == 0 and answer:
        return dict(json.loads(answer))
    how = f"ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
    tail = messages.strip()[-_KEPT_OUTPUT:]
    return failure(
        CRASHED,
        f"{how}: {tail}"
        if tail
        else f"{how} without a message. A frequent cause is too little memory: try fewer --workers",
    )


def _answer(child: subprocess.Popen[str], job: Job) -> tuple[str, str]:
    """Send the job to a process and return the process's answer and its standard error.

    The standard input of the process stays open until it has answered.
    """
    assert child.stdin and child.stdout and child.stderr
    messages: list[str] = []
    errors = child.stderr
    listener = threading.Thread(target=lambda: messages.append(errors.read()))
    listener.start()
    with suppress(BrokenPipeError):
        child.stdin.write(job.as_json() + "\n")
        child.stdin.flush()
    answer = child.stdout.readline()
    child.wait()
    listener.join()
    with suppress(BrokenPipeError):
        child.stdin.close()
    child.stdout.close()
    errors.close()
    return answer, "".join(messages)


def failure(status: str, words: str) -> dict[str, Any]:
    """Return the result of a job that failed: its status, the reason, and no figures."""
    return {"status": status, "words": words, "figures": {}}


def _keep(job: Job) -> dict[str, Any]:
    """Use the calibration that the dataset has."""
    figures = _calibration_figures(_own_calibration(job))
    return {"status": KEPT, "words": job.kept, "figures": figures}


def _calibration_figures(found: Calibration) -> dict[str, Any]:
    from telerig.io.results.findings import objections

    statistics = ("views", "dots_kept", "share_kept", "rms_px")
    return {
        "verdict": found.verdict["status"],
        "flags": list(dict.fromkeys(one.code.name for one in objections(found.findings or ()))),
        **{name: found.statistics.get(name) for name in statistics},
        "lens_model": found.model.get("name"),
    }


def _calibrate(job: Job, stage: Progress | None) -> dict[str, Any]:
    """Calibrate a dataset and write its results."""
    assert isinstance(job.options, CalibrationOptions)
    found = calibrate_dataset(
        Path(job.dataset), job.results, job.options, again=job.command, report=job.report,
        stage=stage,
    )  # fmt: skip
    verdict, figures = found.verdict, _calibration_figures(found)
    rejected = verdict["status"] == "REJECTED"
    words = "\n".join(verdict["reasons"]) if rejected else found.report()
    return {"status": REJECTED if rejected else DONE, "words": words, "figures": figures}


def _track(job: Job, stage: Progress | None) -> dict[str, Any]:
    """Track a run and write its results."""
    from telerig.estimator.tracking.tracks import tracking_words

    assert isinstance(job.options, TrackingOptions)
    begun, run = time.perf_counter(), Path(job.where)
    check_run_name(run)
    if not job.calibration:
        _own_calibration(job)
    summary = track_run(
        run, job.results, job.options, job.calibrations, again=job.command, report=job.report,
        stage=stage,
    )  # fmt: skip
    figures = {name: summary[name] for name in ("frames", "detections", "points", "tracks")}
    words = tracking_words(summary, time.perf_counter() - begun)
    return {"status": DONE, "words": words, "figures": figures}


def _smooth(job: Job, stage: Progress | None) -> dict[str, Any]:
    """Smooth a tracked run and write its results."""
    from telerig.estimator.smoothing.terminal_summary import smoothing_words

    assert isinstance(job.options, SmoothingOptions)
    if not job.calibration:
        _own_calibration(job)
    found = smooth_run(
        Path(job.where), job.results, job.options, job.calibrations, again=job.command,
        tracks=Path(job.tracks or job.results), report=job.report, stage=stage,
    )  # fmt: skip
    table = found.trajectories
    figures: dict[str, Any] = {
        "verdict": found.verdict.get("verdict", ""),
        "flags": list(found.verdict.get("flags", [])),
        "bubbles": found.summary["bubbles"],
        "frames": found.summary["frames"],
    }
    if len(table):
        figures |= {f"s{x}_um": 1000 * float(np.median(table[f"s{x}_mm"])) for x in "xyz"}
        figures |= {f"sv{x}_mm_s": float(np.median(table[f"sv{x}_mm_s"])) for x in "xyz"}
    return {"status": DONE, "words": smoothing_words(found), "figures": figures}


def summary_line(job: Job, result: Mapping[str, Any], *, whole_path: bool = False) -> str:
    """Return the result of a job in one line for the user.

    result : what `perform` returned, or a record of the journal.
    whole_path : whether the line names the dataset by its full path, as it must if two datasets
    have the same name.
    """
    place = job.dataset if whole_path else Path(job.dataset).name
    what = f"{job.kind} {place}" + (f" {job.run}" if job.run else "")
    verdict = verdict_and_flags(result)
    first = "" if result["status"] == DONE else f": {str(result['words']).splitlines()[0]}"
    how = "done before" if result.get("resumed") else result["status"]
    return f"{what}: {how}" + (f", {verdict}" if verdict else "") + first


COLUMNS = ("dataset", "run", "kind", "status", "verdict", "seconds", "host", "finished")
FIGURES = (
    "views", "dots_kept", "share_kept", "rms_px", "lens_model", "frames", "detections", "points",
    "tracks", "bubbles", "sx_um", "sy_um", "sz_um", "svx_mm_s", "svy_mm_s", "svz_mm_s",
)  # fmt: skip


class Journal:
    """Keeps the records of a batch in its folder ``jobs``, so that it can continue."""

    def __init__(self, batch: Path) -> None:
        self.folder = Path(batch) / "jobs"

    def done(self, job: Job) -> dict[str, Any] | None:
        """Return the job's record if it was done with the same inputs, options and version."""
        record = self.read(job)
        if record is None or record.get("status") != DONE or not is_whole(job.result):
            return None
        same = (record.get("options"), record.get("telerig")) == (job.asked, VERSION)
        manifest = read_manifest(job.results)
        section = None if manifest is None else manifest.sections.get(job.kind)
        fresh = section is not None and not section.changes(job.results, alone=False)
        return record if same and fresh else None

    def read(self, job: Job) -> dict[str, Any] | None:
        """Return the last record of the job, or None if there is none that can be read."""
        try:
            content = json.loads((self.folder / f"{job.name}.json").read_bytes())
        except (OSError, ValueError):
            return None
        return dict(content) if isinstance(content, dict) else None

    def write(self, job: Job, result: Mapping[str, Any]) -> dict[str, Any]:
        """Write the result of a job to the journal and return the record."""
        record = {
            "kind": job.kind, "dataset": job.dataset, "run": job.run, **result,
            "options": job.asked,
            "telerig": VERSION,
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        }  # fmt: skip
        write_json_atomic(self.folder / f"{job.name}.json", record)
        return record


def table_of(records: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return the journal's records of the jobs as a table, one row per job in the given order.

    The columns are `COLUMNS`, `FIGURES` and words, which gives the reason of any status but done.
    """
    rows = []
    for record in records:
        figures = record.get("figures") or {}
        reason = "" if record["status"] == DONE else _first_line(record.get("words"))
        rows.append(
            {name: record.get(name) for name in COLUMNS}
            | {name: figures.get(name) for name in FIGURES}
            | {"verdict": verdict_and_flags(record) or None, "words": reason}
        )
    return pd.DataFrame(rows, columns=[*COLUMNS, *FIGURES, "words"])


def bubbles_of(records: Sequence[Mapping[str, Any]]) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Return the bubbles of all smoothed runs in one table, and the liquid if it is one.

    records : the journal's record of each job. A run whose table cannot be read is left out, with a
    warning.
    """
    parts, fluids = [pd.DataFrame(columns=BATCH_BUBBLES.names())], []
    for record in records:
        place = Path(record["dataset"]) / "results" / record["run"]
        if record["kind"] != "smooth" or record["status"] != DONE:
            continue
        try:
            table = SUMMARY.read(place / SUMMARY.file)
            fluids.append(SmoothingFile.read(place / "smoothing.json").fluid)
        except InputError as error:
            warnings.warn(f"{error}; its bubbles are left out", TelerigWarning, stacklevel=2)
            continue
        table.insert(0, "dataset", record["dataset"])
        table.insert(1, "run", record["run"])
        parts.append(table)
    known = [fluid for fluid in fluids if fluid]
    fluid = known[0] if known and all(one == known[0] for one in known) else {}
    return pd.concat(parts[1:] or parts, ignore_index=True), fluid


def _first_line(words: object) -> str:
    return next(iter(str(words or "").strip().splitlines()), "")


def write_batch(
    records: Sequence[Mapping[str, Any]], folder: Path, *, report: bool = True, again: str = ""
) -> pd.DataFrame:
    """Write batch.csv, bubbles.csv, batch.json and report.html to ``folder``; return the first.

    records : the journal's record of each job.
    report : whether report.html is written.
    again : the command line that makes the files again; "" for `telerig batch`.
    """
    table, (bubbles, fluid) = table_of(records), bubbles_of(records)
    name = Path(folder).resolve().name
    content = {
        "schema": 1, "kind": "telerig batch", "name": name, "jobs": list(records), "fluid": fluid
    }  # fmt: skip
    with replaced_results(folder, "batch", again=again or "telerig batch", inputs={}) as staged:
        write_table(table, staged / "batch.csv")
        write_table(bubbles, staged / "bubbles.csv")
        BatchFile.of(content, staged / "batch.json").write(staged / "batch.json")
        if report:
            from telerig.io.report.batch.report import write_batch_report

            write_batch_report(staged, page_folder=folder)
    return table


def batch_words(records: Sequence[Mapping[str, Any]]) -> str:
    """Return a summary in words: the number of jobs of each kind and status, and why one
    failed or was kept, with what to do.

    records : the journal's record of each job.
    """
    lines = []
    for kind in ("calibrate", "track", "smooth"):
        of_kind = [r for r in records if r["kind"] == kind]
        if of_kind:
            counts = Counter(r["status"] for r in of_kind)
            found = verdict_counts(of_kind)
            lines.append(f"{kind}: {listed(counts)}" + (f" ({listed(found)})" if found else ""))
    for record in records:
        if record["status"] != DONE:
            where = record["dataset"] + (f", run {record['run']}" if record["run"] else "")
            reason = _first_line(record["words"])
            lines.append(f"  {where}: {record['kind']} {record['status']}: {reason}")
            others = str(record["words"] or "").splitlines()
            lines += [f"  {line}" for line in others if line.startswith("  -> ")]
    return "\n".join(lines)


Tell = Callable[[Job, dict[str, Any], int, int], None]
"""Function that is called after each job with (job, its record, number of jobs done, number of
jobs)."""


def run_batch(
    jobs: Sequence[Job], executor: Executor, journal: Journal, *, tell: Tell | None = None
) -> list[dict[str, Any]]:
    """Do all jobs, each after the jobs that it needs, and return their records in the given order.

    A job that ``journal`` records as done with the same inputs is not done again; only a report
    that is wanted but missing is then drawn. If a job fails, the jobs that need its result are left
    out, and their records name the failed job; all others are done.

    executor : runs `perform` of each job. tell : is called after each job.
    """
    by_name = {job.name: job for job in jobs}
    records: dict[str, dict[str, Any]] = {}
    running: dict[Future[dict[str, Any]], Job] = {}
    drawn: dict[str, dict[str, Any]] = {}
    order = TopologicalSorter({job.name: job.needs for job in jobs})
    order.prepare()

    def keep(job: Job, record: dict[str, Any]) -> None:
        records[job.name] = record
        order.done(job.name)
        if tell is not None:
            tell(job, record, len(records), len(jobs))

    while order.is_active():
        ready = [by_name[name] for name in order.get_ready()]
        for job in ready:
            known = _known_record(job, records, journal)
            if known is None:
                running[executor.submit(perform, job)] = job
            elif known["status"] == DONE and job.lacks_report:
                drawn[job.name] = known
                future = executor.submit(perform, replace(job, only_report=True))
                running[future] = job
            else:
                keep(job, known)
        if not ready:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job = running.pop(future)
                result = _result(future)
                if job.name in drawn and result["status"] == DONE:
                    keep(job, drawn[job.name])
                else:
                    keep(job, journal.write(job, result))
    return [records[job.name] for job in jobs]


def _known_record(
    job: Job, records: dict[str, dict[str, Any]], journal: Journal
) -> dict[str, Any] | None:
    """Return the record of a job that need not be done, or None for a job that has to be done."""
    for needed in job.needs:
        if has_failed(records[needed]):
            words = f"needs {needed}, which was {records[needed]['status']}"
            return journal.write(job, failure(LEFT_OUT, words))
    before = journal.done(job)
    return None if before is None else {**before, "resumed": True}


def _result(future: Future[dict[str, Any]]) -> dict[str, Any]:
    """Return the result of a finished job; one that the executor gave up counts as crashed."""
    error = future.exception()
    if error is None:
        return future.result()
    return failure(CRASHED, f"{type(error).__name__}: {error}")


@contextmanager
def local_executor(workers: int | None = None) -> Iterator[Executor]:
    """Context manager of an executor that runs ``workers`` jobs at once, each in its own process.

    workers : None for one per core. Raises InputError for less than one.
    """
    count = cores() if workers is None else workers
    if count < 1:
        raise InputError(f"{count} workers", where="--workers", todo="give 1 or more")
    allow()
    executor = ThreadPoolExecutor(count)
    try:
        yield executor
    except BaseException:
        stop_all()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
