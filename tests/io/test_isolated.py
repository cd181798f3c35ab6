"""Calls in a process of their own: results, errors and crashes come back."""

from __future__ import annotations

import faulthandler
import os
import signal

import numpy as np
import pytest

from telerig.errors import InputError
from telerig.io.machine.parallel import can_fork, isolated


def large(count: int) -> np.ndarray:
    return np.arange(count, dtype=float)


def crash() -> None:
    faulthandler.disable()
    os.kill(os.getpid(), signal.SIGSEGV)


def refuse() -> None:
    raise InputError("no", where="a.mat", todo="yes")


def test_what_is_returned_comes_back() -> None:
    assert isolated(large, 300_000).sum() == 300_000 * 299_999 / 2


def test_what_is_raised_is_raised_here() -> None:
    with pytest.raises(InputError, match=r"a\.mat"):
        isolated(refuse)


@pytest.mark.skipif(not can_fork(), reason="only a single-threaded process on Linux is copied")
def test_a_crash_is_an_error() -> None:
    with pytest.raises(ChildProcessError, match="crashed"):
        isolated(crash)
