"""Work over the cores: order, errors, interrupts."""

import math
import os
import signal
import subprocess
import sys
import threading

import pytest

from telerig.io.machine import parallel
from telerig.io.machine.parallel import cores, ordered_map, quick_workers

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
