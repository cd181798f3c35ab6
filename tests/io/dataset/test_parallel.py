"""Work over the cores: order, errors, interrupts."""

import math
import os
import signal
import subprocess
import sys
import threading

import pytest

from telerig.io.machine import parallel
from telerig.io.machine.parallel import assistant, cores, ordered_map, quick_workers

forks = pytest.mark.skipif(not parallel.can_fork(), reason="needs a system that can fork")


def _fail_at_three(number: int) -> int:
    if number == 3:
        raise ValueError("three")
    return number


def _interrupted(_: int) -> str:
    os.kill(os.getpid(), signal.SIGINT)
    return "went on"


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_tasks(workers):
    tasks = [3000, 1, 2000, 2, 1000, 3]
    assert list(ordered_map(math.factorial, tasks, workers)) == [math.factorial(n) for n in tasks]


@forks
def test_an_error_in_a_process_is_raised_here():
    with pytest.raises(ValueError, match="three"):
        list(ordered_map(_fail_at_three, range(6), 2))


@forks
def test_the_processes_leave_an_interrupt_to_their_parent():
    assert list(ordered_map(_interrupted, [0, 1], 2)) == ["went on", "went on"]


@forks
def test_the_processes_end_though_the_parent_handles_their_signal():
    script = (
        "import signal, time; from telerig.io.machine.parallel import ordered_map\n"
        "signal.signal(signal.SIGTERM, lambda *_: None)\n"
        "results = ordered_map(time.sleep, [0.05] * 40, 2)\n"
        "next(results); results.close(); print('ended')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "ended\n"


def test_short_work_stays_in_this_process_while_a_second_thread_runs():
    end = threading.Event()
    thread = threading.Thread(target=end.wait)
    thread.start()
    try:
        assert quick_workers(5) == 1
    finally:
        end.set()
        thread.join()


@pytest.mark.parametrize(("stated", "known"), [("3", 3), ("0", None), ("many", None)])
def test_the_cores_can_be_stated(monkeypatch, stated, known):
    monkeypatch.delenv("TELERIG_CORES", raising=False)
    here = cores()
    monkeypatch.setenv("TELERIG_CORES", stated)
    assert cores() == (known or here)


def _die() -> None:
    os._exit(1)


def _die_elsewhere(process: int) -> int:
    """Unless called in that process."""
    if os.getpid() != process:
        os._exit(1)
    return process


@forks
def test_an_assistant_does_what_it_is_asked_in_a_process_that_has_prepared_itself(monkeypatch):
    monkeypatch.setenv("TELERIG_CORES", "2")
    with assistant(lambda: os.environ.update(TELERIG_TEST="ready")) as call:
        assert call(math.factorial, 20) == math.factorial(20)
        assert call(os.getenv, "TELERIG_TEST") == "ready" and os.getenv("TELERIG_TEST") is None
        with pytest.raises(ValueError, match="three") as caught:
            call(_fail_at_three, 3)
        assert "_fail_at_three" in "".join(caught.value.__notes__), "where it happened there"
        process = call(os.getpid)
        call(os.kill, process, signal.SIGINT)
        assert call(os.getpid) == process != os.getpid()
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


@forks
def test_an_assistant_works_while_this_process_goes_on(monkeypatch):
    monkeypatch.setenv("TELERIG_CORES", "2")
    with assistant(int) as call:
        first, failed = call.begin(os.getpid), call.begin(_fail_at_three, 3)
        large = call.begin(bytes, 1 << 22)  # more than the system keeps on the way
        assert call(os.getpid) == first() == first() != os.getpid()
        with pytest.raises(ValueError, match="three"):
            failed()
        assert large() == bytes(1 << 22)
        dies, after = call.begin(_die_elsewhere, os.getpid()), call.begin(os.getpid)
        assert dies() == after() == os.getpid(), "done here"


@forks
@pytest.mark.parametrize("prepare", [_die, lambda: 1 / 0, int])
def test_without_an_assistant_the_work_is_done_here(monkeypatch, prepare):
    monkeypatch.setenv("TELERIG_CORES", "1" if prepare is int else "2")
    with assistant(prepare) as call:
        asked = call.begin(os.getpid)
        assert call(os.getpid) == asked() == os.getpid()
