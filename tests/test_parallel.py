"""Work over the cores: order, errors, and processes that stand by."""

import os
import signal
import threading
import time

import pytest

from telerig.io import parallel
from telerig.io.parallel import cores, crew, get_ready, ordered_map, quick_workers, standing_by

several_cores = pytest.mark.skipif(
    cores() < 2 or not parallel.can_fork(), reason="needs two cores and a system that can fork"
)


def _slow_square(number: int) -> int:
    time.sleep(0.02 * (number % 3))
    return number * number


def _fail_at_three(number: int) -> int:
    if number == 3:
        raise ValueError("three")
    return number


def _process(_: int) -> int:
    time.sleep(0.05)
    return os.getpid()


def _interrupted(_: int) -> str:
    os.kill(os.getpid(), signal.SIGINT)
    return "went on"


def _mark() -> None:
    os.environ["TELERIG_TEST_READY"] = "yes"
    time.sleep(0.2)


def _ready(_: int) -> str | None:
    time.sleep(0.05)
    return os.environ.get("TELERIG_TEST_READY")


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_tasks(workers):
    assert list(ordered_map(_slow_square, range(9), workers)) == [n * n for n in range(9)]


@several_cores
def test_a_crew_gives_the_same_results_from_processes_that_stay():
    assert standing_by() == 1
    with crew():
        assert standing_by() == cores()
        assert list(ordered_map(_slow_square, range(9), 2)) == [n * n for n in range(9)]
        first = set(ordered_map(_process, range(8), 2))
        second = set(ordered_map(_process, range(8), 2))
    assert first == second
    assert os.getpid() not in first
    assert standing_by() == 1


@several_cores
def test_an_error_in_a_process_is_raised_here_and_the_crew_goes_on():
    with crew():
        with pytest.raises(ValueError, match="three"):
            list(ordered_map(_fail_at_three, range(6), 2))
        assert list(ordered_map(_slow_square, [2], 2)) == [4]


@several_cores
def test_the_processes_leave_an_interrupt_to_their_parent():
    with crew():
        assert list(ordered_map(_interrupted, [0, 1], 2)) == ["went on", "went on"]


@several_cores
def test_every_process_gets_ready():
    with crew():
        get_ready(_mark)
        time.sleep(0.1)
        assert set(ordered_map(_ready, range(8), 2)) == {"yes"}
    assert "TELERIG_TEST_READY" not in os.environ


def test_with_a_second_thread_running_there_is_no_crew():
    end = threading.Event()
    thread = threading.Thread(target=end.wait)
    thread.start()
    try:
        with crew():
            assert standing_by() == 1
            assert quick_workers(5) == 1
            assert list(ordered_map(_slow_square, range(4), standing_by())) == [0, 1, 4, 9]
    finally:
        end.set()
        thread.join()
