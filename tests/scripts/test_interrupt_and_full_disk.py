"""Commands that are interrupted, or that the operating system does not let write."""

from __future__ import annotations

import errno
import hashlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from telerig.errors import InputError
from telerig.io.files.atomic import atomic_folder, atomic_path
from telerig.scripts.main import app

runner = CliRunner()
pytestmark = pytest.mark.usefixtures("without_advice", "known_low_passes", "undrawn")


@contextmanager
def largest_file(size_bytes: int) -> Iterator[None]:
    """Let the operating system refuse to write more into any file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def contents(folder: Path) -> dict[str, str]:
    files = [p for p in folder.rglob("*") if p.is_file()]
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


COMMANDS = {
    "calibrate": ("calibrate", "{set}", "--model", "radial", "--quiet"),
    "track": ("track", "{set}/runs/rise", "--quiet"),
    "smooth": ("smooth", "{set}/runs/rise", "--model", "default", "--quiet"),
    "hdf5": ("export", "{set}/results/rise", "--to", "hdf5", "--out", "{set}/out.h5"),
    "netcdf": ("export", "{set}/results/rise", "--to", "netcdf", "--out", "{set}/out.nc"),
    "matlab": ("export", "{set}/results/rise", "--to", "mat", "--out", "{set}/out.mat"),
    "trackpy": ("export", "{set}/results/rise", "--to", "trackpy", "--out", "{set}/out.csv"),
    "opencv": ("export", "{set}/results/calibration", "--to", "opencv", "--out", "{set}/o.yaml"),
}


@pytest.mark.parametrize(
    ("name", "size_bytes"),
    [*((name, 6_000) for name in COMMANDS), ("track", 100), ("trackpy", 100), ("opencv", 100)],
)
def test_a_full_disk_leaves_the_old_results_and_says_what_to_do(
    name: str, size_bytes: int, tank: Path, tmp_path: Path
) -> None:
    data = tmp_path / "set"
    shutil.copytree(tank, data)
    before = contents(data)
    with largest_file(size_bytes):
        done = runner.invoke(app, [part.format(set=data) for part in COMMANDS[name]])
    text = done.output + done.stderr
    if done.exit_code == 0:  # so small a file
        assert name in ("opencv", "trackpy")
        return
    assert done.exit_code == 2, text
    assert "make room on the disk, then run the command again" in text
    assert ".part" not in text
    assert contents(data) == before


def test_a_folder_that_disappears_while_it_is_written_is_named(tmp_path: Path) -> None:
    again = pytest.raises(InputError, match="run the command again")
    with again as caught, atomic_folder(tmp_path / "results") as staged:
        shutil.rmtree(staged)
        (staged / "tracks.csv").write_text("frame\n", encoding="utf-8")
    assert caught.value.where == str(tmp_path / "results")


@pytest.mark.parametrize(
    ("number", "advice"), [(errno.EDQUOT, "make room"), (errno.EROFS, "can be written")]
)
def test_errors_of_the_system_in_writing_are_told_apart(
    number: int, advice: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=advice), atomic_path(tmp_path / "a.csv"):
        raise OSError(number, os.strerror(number))
    assert not list(tmp_path.iterdir())


def test_an_error_of_reading_is_not_taken_for_one_of_writing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "a.csv"):
        (tmp_path / "elsewhere" / "b.csv").read_text(encoding="utf-8")


def interrupted(arguments: list[str], after_s: float) -> tuple[int, str]:
    """Exit code and output of a command whose process group gets Ctrl-C, so long after it began.

    Before that Python itself starts, which takes long on a busy machine.
    """
    begun = "from telerig.scripts.start import run; print(flush=True); run()"
    command = [sys.executable, "-c", begun, *arguments]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(after_s)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=120)
    return process.returncode, out + err


def check_interrupts(moments_s: list[float], tank: Path, tmp_path: Path) -> None:
    for k, after_s in enumerate(moments_s):
        out = tmp_path / f"out{k}"
        code, text = interrupted(["calibrate", str(tank), "--out", str(out)], after_s)
        assert code in (0, 130, -signal.SIGINT), (after_s, code, text)
        for word in ("Traceback", "Exception", "fault of telerig", "terminate called"):
            assert word not in text, (after_s, text)
        assert code == 0 or not out.exists() or (out / "report.html").is_file()


def test_ctrl_c_at_any_moment_prints_no_traceback(tank: Path, tmp_path: Path) -> None:
    check_interrupts([0.05, 1.0], tank, tmp_path)


@pytest.mark.slow
def test_ctrl_c_at_a_hundred_moments(tank: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    check_interrupts(list(rng.uniform(0.1, 5.0, 100)), tank, tmp_path)


IN_PIECES = """
import sys, time
from telerig.estimator.smoothing import pieces, smooth
from telerig.factors.bubble_motion import Inertia
pieces.MOST_FRAMES, pieces._FRAMES = 12, 6
smooth.learned_inertia = lambda _: Inertia((0.001,) * 3)
solve, calls, stop = pieces.solve, [], int(sys.argv.pop(1))
def slow(*arguments):
    calls.append(None)
    if len(calls) == stop:
        print("stopped", flush=True)
        time.sleep(60)
    return solve(*arguments)
pieces.solve = slow
from telerig.scripts.start import run
run()
"""
"""telerig, with runs of more than 12 frames smoothed in pieces of six; it waits at a piece."""


def test_ctrl_c_in_the_first_round_of_a_long_run_and_again(tank: Path, tmp_path: Path) -> None:
    def smoothing(out: str, stop: int = 0) -> tuple[int, str]:
        command = [
            sys.executable, "-c", IN_PIECES, str(stop), "smooth", str(tank / "runs" / "rise"),
            "--model", "default", "--no-report", "--out", str(tmp_path / out),
        ]  # fmt: skip
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            start_new_session=True,
        ) as process:  # fmt: skip
            if stop:
                assert process.stdout is not None
                assert process.stdout.readline() == "stopped\n"
                os.killpg(process.pid, signal.SIGINT)
            _, said = process.communicate(timeout=120)
        return process.returncode, said

    code, said = smoothing("parts", stop=3)
    assert code == 130, said
    assert "interrupted; no file is half-written" in said
    assert [p.name for p in tmp_path.iterdir()] == [".parts.smoothing"]
    code, said = smoothing("parts")
    assert code == 0, said
    assert "what is constant along the run, going on, 2 of 4 pieces are finished" in said
    code, said = smoothing("whole")
    assert code == 0, said
    assert "going on" not in said
    assert {p.name for p in tmp_path.iterdir()} == {"parts", "whole"}
    for name in ("trajectories.csv", "shake.csv", "bubbles.csv"):
        one, other = ((tmp_path / place / name).read_bytes() for place in ("parts", "whole"))
        assert one == other
