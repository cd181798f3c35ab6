"""Batches whose processes are killed, interrupted or left alone."""

import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from batch_dataset import make_dataset

from telerig.command_options import CalibrationOptions
from telerig.estimator.batch import batch as work
from telerig.estimator.batch.batch import Journal, local_executor, perform, run_batch
from telerig.estimator.batch.jobs import Job, jobs_of


def test_a_process_that_is_killed_fails_alone_and_is_done_the_next_time(tmp_path):
    """The work's process dies as when the system runs out of memory."""
    data = make_dataset(tmp_path / "data", 3)
    jobs = jobs_of([data], report=False)[:1]
    killer = threading.Thread(target=_kill_the_first_child)
    killer.start()
    with ThreadPoolExecutor(1) as executor:
        records = run_batch(jobs, executor, Journal(tmp_path / "out"))
    killer.join()
    assert records[0]["status"] == "crashed"
    assert "signal 9" in records[0]["words"]
    assert not (data / "results" / "calibration" / "calibration.json").exists()
    with ThreadPoolExecutor(1) as executor:
        records = run_batch(jobs, executor, Journal(tmp_path / "out"))
    assert records[0]["status"] == "done"


def _kill_the_first_child() -> None:
    while not work._children:
        time.sleep(0.005)
    next(iter(work._children)).kill()


def test_a_job_ends_with_the_process_that_asked_for_it(tmp_path):
    data = make_dataset(tmp_path / "data", 4)
    (job, *_) = jobs_of([data])
    asker = (
        "import sys; from telerig.estimator.batch.batch import perform;"
        "from telerig.estimator.batch.jobs import Job; print(perform(Job.from_json(sys.argv[1])))"
    )
    parent = subprocess.Popen([sys.executable, "-c", asker, job.as_json()])
    child = _child_of(parent.pid)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    deadline = time.monotonic() + 20
    while Path(f"/proc/{child}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{child}").exists()
    leftovers = (
        [p.name for p in (data / "results").glob("*")] if (data / "results").exists() else []
    )
    assert leftovers == []


def _child_of(pid: int) -> int:
    if not Path("/proc/self/task").exists():
        pytest.skip("needs /proc")
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        children = [
            c for task in Path(f"/proc/{pid}/task").iterdir()
            for c in (task / "children").read_text().split()
        ]  # fmt: skip
        if children:
            return int(children[0])
        time.sleep(0.01)
    raise AssertionError("no child was started")


@pytest.mark.parametrize("handler", [signal.default_int_handler, signal.SIG_IGN])
def test_an_interrupted_job_takes_its_temporary_files_away(tmp_path, monkeypatch, handler):
    """Ctrl-C of a batch while a job writes; a shell's background work inherits SIG_IGN."""
    script = (
        "import sys, time; from pathlib import Path\n"
        "from telerig.io.files.atomic import atomic_folder\n"
        "from telerig.scripts import batch_job\n"
        "def write(job):\n"
        "    with atomic_folder(Path(sys.argv[-1])) as beside:\n"
        "        (beside / 'x').write_text('half'); time.sleep(60)\n"
        "batch_job.do_job = write; batch_job.main()\n"
    )
    out = tmp_path / "results"
    begun = work.subprocess.Popen
    monkeypatch.setattr(
        work.subprocess, "Popen",
        lambda _, **rest: begun([sys.executable, "-c", script, str(out)], **rest),
    )  # fmt: skip
    before = signal.signal(signal.SIGINT, handler)
    try:
        with pytest.raises(KeyboardInterrupt), local_executor(1) as executor:
            executor.submit(perform, Job("calibrate", str(tmp_path), CalibrationOptions()))
            deadline = time.monotonic() + 20
            while not list(tmp_path.glob(".results.*.part/x")):
                assert time.monotonic() < deadline
                time.sleep(0.02)
            raise KeyboardInterrupt
    finally:
        signal.signal(signal.SIGINT, before)
    assert list(tmp_path.iterdir()) == []
