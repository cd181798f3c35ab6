"""Damaged files that the fuzz tests once found to be read wrongly."""

from __future__ import annotations

import json
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import tifffile

from telerig.errors import InputError
from telerig.estimator.tracking.tracks import read_track_table
from telerig.io.exchange.importing.accelerometer import Layout, read_accelerations
from telerig.io.exchange.importing.binary_recordings import read_wav
from telerig.io.files.csv_table import Column, read_table
from telerig.io.images.frames import open_frames
from telerig.io.recording.log import MAGIC, scan_log
from telerig.io.report.batch.report import write_batch_report


def test_a_column_without_a_name_gets_one(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    file.write_text('t_s,,"x"\n1,2,a\n', encoding="utf-8")
    assert list(read_table(file, [Column("t_s")], extra=True)) == ["t_s", "Unnamed: 1", "x"]


def test_a_row_that_is_too_long_does_not_make_up_for_one_that_is_too_short(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    columns = [Column("t_s"), Column("z_mm"), Column("note", "text", required=False, blank=True)]
    file.write_text("t_s,z_mm,note\n0.0,9,\n0.1,10,5,x\n0.2,11.0\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"row 3: has 4 cells, the header has 3 \(and 1 more"):
        read_table(file, columns)


def test_a_particle_that_is_infinite_is_a_name(tmp_path: Path) -> None:
    file = tmp_path / "tracks.csv"
    file.write_text("frame,particle,t_s,x_mm,y_mm,z_mm\n0,inf,0,1,2,3\n", encoding="utf-8")
    assert read_track_table(file)["particle"].tolist() == ["inf"]


def test_a_wav_file_without_samples_is_refused(tmp_path: Path) -> None:
    from scipy.io import wavfile

    wavfile.write(tmp_path / "a.wav", 100, np.zeros(0, np.int16))
    with pytest.raises(InputError, match="holds no samples"):
        read_wav(tmp_path / "a.wav")


def test_a_recording_whose_header_states_gigabytes_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "recording.raw"
    file.write_bytes(MAGIC + b"\xf0\xff\xff\xff" + bytes(64))
    with pytest.raises(InputError, match="header is damaged"):
        scan_log(file)


def test_every_fault_of_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "batch.json").write_text('{"jobs": [{"dataset": 3, "host": {}}, 4]}')
    with pytest.raises(InputError) as caught:
        write_batch_report(tmp_path)
    first, others = caught.value.what.split(" (and ")
    faults = [first.split("'")[1], *others.split("'")[1::2]]
    assert len(set(faults)) == len(faults) == 1 + int(others.split()[0])
    assert {"jobs.0.dataset", "jobs.0.kind", "jobs.1"} <= set(faults)


def test_a_batch_whose_job_has_a_faulty_host_is_refused(tmp_path: Path) -> None:
    job = dict.fromkeys(("dataset", "run", "kind", "status", "words"), "") | {"host": ["a"]}
    (tmp_path / "batch.json").write_text(json.dumps({"jobs": [job]}), encoding="utf-8")
    with pytest.raises(InputError, match=r"has a fault at 'jobs\.0\.host'"):
        write_batch_report(tmp_path)


@pytest.mark.parametrize("half", [b"\\ud800", b"\xed\xa0\x80"])
def test_a_batch_with_half_a_surrogate_pair_is_refused(half: bytes, tmp_path: Path) -> None:
    (tmp_path / "batch.json").write_bytes(b'{"jobs": [], "name": "a' + half + b'"}')
    with pytest.raises(InputError, match="surrogate pair"):
        write_batch_report(tmp_path)


@pytest.mark.parametrize("kind", [{"imagej": True}, {"metadata": {"axes": "TYX"}}])
def test_stacks_with_one_page_header_are_still_read(
    kind: dict[str, object], tmp_path: Path
) -> None:
    stack = np.arange(3 * 16 * 24, dtype=np.uint8).reshape(3, 16, 24)
    tifffile.imwrite(tmp_path / "left.tif", stack, photometric="minisblack", **kind)  # type: ignore[arg-type]
    frames = open_frames(tmp_path, "left")
    assert frames is not None and len(frames) == 3
    np.testing.assert_array_equal(frames.read(2), stack[2])


def test_a_counter_that_reads_infinity_is_no_clock(tmp_path: Path) -> None:
    file = tmp_path / "log.txt"
    rows = [f"{'-inf' if i == 20 else i},0.1,{0.01 * i},1.0" for i in range(40)]
    text = ["# data_rate = 1 kHz, range 4 g", ";Headers,count,Ax,Ay,Az", *rows]
    file.write_text("\n".join(text), encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        with suppress(InputError):
            read_accelerations(file, "arm", Layout(unit="g"))


def test_a_logger_file_of_lines_of_megabytes_is_refused_at_once(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text((",".join(f"c{i}" for i in range(100_000)) + "\n") * 20, encoding="utf-8")
    with pytest.raises(InputError, match="begins with a line of more than"):
        read_accelerations(file, "arm", Layout(unit="g"))
