"""The raw log: what is written reads back, damage costs its own entries, a full disk is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from telerig.errors import InputError
from telerig.io.recording.log import (
    MARKER,
    RECEIVED,
    SENT,
    Entry,
    LogHeader,
    RawLog,
    read_log,
    scan_log,
)
from telerig.io.rig_file.description import DeviceDescription

DEVICES = (
    DeviceDescription("encoder", "encoder", "/dev/x", counts_per_mm=-2.5),
    DeviceDescription("Zähler", "frames", "loop://", cameras=("left", "right")),
)
HEADER = LogHeader(123, "2020-01-01T00:00:00+00:00", ("left", "right"), DEVICES)


def entries() -> list[Entry]:
    rng = np.random.default_rng(0)
    sizes = [0, 1, 4, 300, 17, 80, 2000, 5]
    data = [rng.integers(0, 256, n, np.uint8).tobytes() + MARKER * (n % 2) for n in sizes]
    return [Entry((RECEIVED, SENT)[k % 2], k % 2, 10**15 + k, d) for k, d in enumerate(data)]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "run" / "recording.raw"
    with RawLog(path, HEADER) as writer:
        for entry in entries():
            writer.append(entry)
        writer.flush()
    return path


def test_what_is_written_reads_back(log: Path) -> None:
    assert scan_log(log).header == HEADER
    assert list(read_log(log)) == entries()
    assert scan_log(log).damaged_bytes == 0


def test_only_what_was_flushed_is_promised(tmp_path: Path) -> None:
    writer = RawLog(tmp_path / "recording.raw", HEADER)
    writer.append(entries()[0])
    writer.flush()
    writer.append(entries()[1])
    assert list(read_log(writer.path)) == entries()[:1]
    writer.close()


def test_cut_off_anywhere_it_keeps_every_whole_entry(log: Path, tmp_path: Path) -> None:
    data = log.read_bytes()
    torn = tmp_path / "torn.raw"
    begin = data.index(MARKER)
    before = -1
    for length in [*range(begin, begin + 60), *range(begin + 60, len(data) + 1, 97), len(data)]:
        torn.write_bytes(data[:length])
        found = list(read_log(torn))
        assert found == entries()[: len(found)]
        assert len(found) >= before
        before = len(found)
    assert before == len(entries())


def test_zeros_that_a_power_cut_leaves_at_the_end(log: Path) -> None:
    with log.open("ab") as stream:
        stream.write(bytes(4096))
    assert list(read_log(log)) == entries()
    assert scan_log(log).damaged_bytes == 4096


def test_damage_in_the_middle_costs_its_own_entry(log: Path) -> None:
    data = bytearray(log.read_bytes())
    at = data.index(entries()[3].data) + 50
    data[at] ^= 0x10
    log.write_bytes(data)
    assert list(read_log(log)) == [e for k, e in enumerate(entries()) if k != 3]
    assert scan_log(log).damaged_bytes > 300


def test_blocks_do_not_matter(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for size in (2500, 2100, 3001):
        monkeypatch.setattr("telerig.io.recording.log._BLOCK", size)
        assert list(read_log(log)) == entries()


def test_a_recording_is_never_written_over(log: Path) -> None:
    with pytest.raises(InputError, match=r"never written over(.|\n)*another name"):
        RawLog(log, HEADER)


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "no recording"), (b"t_s,position_mm\n1,2\n" * 9, "no recording")],
)
def test_what_is_no_log(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "x.raw"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        scan_log(path)
    with pytest.raises(InputError, match="check the path"):
        scan_log(tmp_path / "absent.raw")


@pytest.mark.parametrize("name", ["a,b\nc", "../x", ""])
def test_a_device_with_a_harmful_name_in_the_header(tmp_path: Path, name: str) -> None:
    path = tmp_path / "x.raw"
    RawLog(path, replace(HEADER, devices=(replace(DEVICES[0], name=name),)))
    with pytest.raises(InputError, match="device"):
        scan_log(path)


def test_a_damaged_header(log: Path) -> None:
    data = bytearray(log.read_bytes())
    data[60] ^= 1
    log.write_bytes(data)
    with pytest.raises(InputError, match="damaged header"):
        scan_log(log)
