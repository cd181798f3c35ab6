"""A disk that fills, a folder that is deleted or cannot be written: nothing recorded is lost."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from simulated_log import simulated_log

from telerig.errors import InputError
from telerig.io.recording.log import RECEIVED, Entry, LogHeader, RawLog
from telerig.io.recording.replay import replay
from telerig.io.recording.session import LOG_NAME, Status, record
from telerig.io.recording.simulated.devices import (
    SimulatedPorts,
    practice_devices,
    practice_rig,
)
from telerig.io.rig_file.rig_file import write_rig_toml


def telerig(*arguments: str | Path, most_bytes: int) -> subprocess.CompletedProcess[str]:
    """Run a command that may write no file longer than this, as on a full disk (EFBIG)."""
    return subprocess.run(
        [sys.executable, "-m", "telerig.scripts.main", *map(str, arguments)],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes)),
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


def test_a_recording_on_a_disk_that_fills(tmp_path: Path) -> None:
    with SimulatedPorts(practice_devices(), tmp_path / "p", np.random.default_rng(0)) as ports:
        write_rig_toml(practice_rig(ports.devices), tmp_path / "rig.toml")
        run = tmp_path / "runs" / "one"
        said = telerig("record", run, "--seconds", "60", "--quiet", most_bytes=100_000)
    assert said.returncode == 2, said.stderr
    assert "disk is full" in said.stderr and "make room" in said.stderr
    assert [p.name for p in run.iterdir()] == [LOG_NAME]
    found = replay(run / LOG_NAME)
    assert not found.ended and min(len(r.t_s) for r in found.records) > 20
    said = telerig("record", "--replay", run, most_bytes=10_000)
    assert said.returncode == 2 and "make room" in said.stderr, said.stderr
    assert [p.name for p in run.iterdir()] == [LOG_NAME], "no half of a table"
    said = telerig("record", "--replay", run, most_bytes=10**9)
    assert said.returncode == 0 and (run / "stage.csv").is_file()


def test_a_log_that_cannot_be_begun_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=r"disk is full(.|\n)*make room, then run again"):
        RawLog(tmp_path / "run" / LOG_NAME, LogHeader(0, "now", (), ()))
    assert not (tmp_path / "run" / LOG_NAME).exists(), "so that the run can be recorded again"
    monkeypatch.undo()
    RawLog(tmp_path / "run" / LOG_NAME, LogHeader(0, "now", (), ())).close()


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS])
def test_a_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(InputError, match=r"cannot be written(.|\n)*folder that can be written"):
        RawLog(tmp_path / LOG_NAME, LogHeader(0, "now", (), ()))


def test_a_folder_that_is_deleted_while_it_records(tmp_path: Path) -> None:
    run = tmp_path / "run"

    def delete(status: Status) -> None:
        if status.seconds > 1.2:
            shutil.rmtree(run, ignore_errors=True)

    ports = SimulatedPorts(practice_devices()[:1], tmp_path / "p", np.random.default_rng(0))
    with ports, pytest.raises(InputError, match=r"was deleted(.|\n)*--replay"):
        record(ports.devices, run, seconds=20.0, tell=delete)
    (one,) = replay(run / LOG_NAME).records
    assert len(one.t_s) > 1000 and np.all(np.diff(one.values["t"]) % 2**32 == 1000)


def test_a_deleted_log_that_cannot_be_made_again_says_so(tmp_path: Path) -> None:
    log = RawLog(tmp_path / "run" / LOG_NAME, LogHeader(0, "now", (), ()))
    shutil.rmtree(tmp_path / "run")
    (tmp_path / "run").write_text("a file in its place")
    log.append(Entry(RECEIVED, 0, 1, b"x"))
    with pytest.raises(InputError, match="cannot be written"):
        log.flush()
    log.close()


def test_a_replay_into_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    simulated_log(tmp_path / LOG_NAME, practice_devices()[:1], 1.0, np.random.default_rng(0))
    (tmp_path / "file").write_text("")
    said = telerig(
        "record", "--replay", tmp_path, "--out", tmp_path / "file" / "x", most_bytes=10**9
    )
    assert said.returncode == 2
    assert "file: is a file, a folder of results must be written there" in said.stderr
