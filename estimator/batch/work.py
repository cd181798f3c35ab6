"""Doing one job: in this process, or in a process of its own that may die without harm."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from telerig.estimator.batch.jobs import Job, check_run_name

Stage = Callable[[str, int, int], None]

DONE, REJECTED, FAILED, CRASHED, LEFT_OUT = "done", "rejected", "failed", "crashed", "left out"
_KEPT_OUTPUT = 2000
_END_WITHIN_S = 5.0
_CHILD = "telerig.scripts.batch_job"
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

_children: set[subprocess.Popen[str]] = set()
_stopped = threading.Event()


def do_job(job: Job, stage: Stage | None = None) -> dict[str, Any]:
    """Do it in this process; returns status, words and figures. Raises telerig's errors."""
    return {"calibrate": _calibrate, "track": _track, "smooth": _smooth}[job.kind](job, stage)


def perform(job: Job) -> dict[str, Any]:
    """Do it in a process of its own; returns its result and never raises.

    That process ends when this one does, because its standard input closes.
    """
    begun = time.perf_counter()
    result = _outcome(job)
    return {
        **result,
        "seconds": round(time.perf_counter() - begun, 2),
        "host": socket.gethostname(),
    }


def allow() -> None:
    """Let `perform` begin work again after `stop_all`."""
    _stopped.clear()


def stop_all() -> None:
    """End the processes of `perform` in all threads; jobs that begin later fail at once.

    Each process is interrupted as by Ctrl-C, so that it removes its temporary files, and killed if
    it has not ended after `_END_WITHIN_S`.
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
    if not Path(job.dataset).is_dir():
        return failure(
            FAILED, f"{job.dataset}: this machine has no such folder; share it with this machine"
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
        f"{how}: {tail}" if tail else f"{how} without a message; was there too little memory?",
    )


def _answer(child: subprocess.Popen[str], job: Job) -> tuple[str, str]:
    """The answer of the process, and its standard error.

    Its standard input stays open until it has answered.
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
    """The result of a job that failed."""
    return {"status": status, "words": words, "figures": {}}


def _calibrate(job: Job, stage: Stage | None) -> dict[str, Any]:
    from telerig.estimator.calibration.calibrate import run_calibration
    from telerig.estimator.calibration.results_folder import write_report, write_results
    from telerig.io.dataset.dataset import load_dataset

    begun = time.perf_counter()
    data = load_dataset(Path(job.dataset))
    run = run_calibration(data, model=job.model, medium=job.medium, stage=stage, pictures=True)
    found = run.calibration
    write_results(
        data, run, job.results, command="run",
        options={"model": job.model, "medium": job.medium},
        seconds={"calibrate": time.perf_counter() - begun},
        report=write_report if job.report else None,
    )  # fmt: skip
    figures = {
        "verdict": found.verdict["status"],
        **{k: found.statistics[k] for k in ("views", "dots_kept", "share_kept", "rms_px")},
        "lens_model": found.model.get("name"),
    }
    status = REJECTED if found.verdict["status"] == "REJECTED" else DONE
    return {"status": status, "words": found.report(), "figures": figures}


def _track(job: Job, stage: Stage | None) -> dict[str, Any]:
    from telerig.estimator.tracking.calibration_of_run import calibration_for
    from telerig.estimator.tracking.results_folder import write_tracking
    from telerig.estimator.tracking.track import TrackOptions
    from telerig.estimator.tracking.tracks import tracking_words
    from telerig.io.dataset.run import load_run

    begun = time.perf_counter()
    run = Path(job.dataset) / "runs" / job.run
    check_run_name(run)
    calibration, files = calibration_for(run, [Path(job.calibration)] if job.calibration else None)
    options = TrackOptions()
    record = {
        "command": "run", "options": {"min_diameter_px": options.min_diameter_px}, "inputs": files,
    }  # fmt: skip
    summary = write_tracking(
        load_run(run), calibration, job.results, options=options, record=record,
        report=job.report, stage=stage,
    )  # fmt: skip
    figures = {name: summary[name] for name in ("frames", "detections", "points", "tracks")}
    words = tracking_words(summary, time.perf_counter() - begun)
    return {"status": DONE, "words": words, "figures": figures}


def _smooth(job: Job, stage: Stage | None) -> dict[str, Any]:
    from telerig.estimator.smoothing.results_folder import smooth_run
    from telerig.estimator.smoothing.terminal_summary import smoothing_words
    from telerig.estimator.tracking.calibration_of_run import calibration_for
    from telerig.io.dataset.run import load_run

    run = Path(job.dataset) / "runs" / job.run
    calibration, files = calibration_for(run, [Path(job.calibration)] if job.calibration else None)
    found = smooth_run(
        load_run(run), calibration, job.results, job.results, inputs=files, report=job.report,
        stage=stage,
    )  # fmt: skip
    table = found.trajectories
    figures: dict[str, Any] = {
        "verdict": " ".join([found.verdict.get("verdict", ""), *found.verdict.get("flags", [])]),
        "bubbles": found.summary["bubbles"],
        "frames": found.summary["frames"],
    }
    if len(table):
        figures |= {f"s{x}_um": 1000 * float(np.median(table[f"s{x}_mm"])) for x in "xyz"}
        figures |= {f"sv{x}_mm_s": float(np.median(table[f"sv{x}_mm_s"])) for x in "xyz"}
    return {"status": DONE, "words": smoothing_words(found), "figures": figures}


def summary_line(job: Job, result: Mapping[str, Any], *, whole_path: bool = False) -> str:
    """The result of a job in one line. whole_path : for datasets that have the same name."""
    place = job.dataset if whole_path else Path(job.dataset).name
    what = f"{job.kind} {place}" + (f" {job.run}" if job.run else "")
    verdict = result["figures"].get("verdict")
    first = "" if result["status"] == DONE else f": {str(result['words']).splitlines()[0]}"
    how = "done before" if result.get("resumed") else result["status"]
    return f"{what}: {how}" + (f", {verdict}" if verdict else "") + first
