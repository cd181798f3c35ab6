"""Recordings of accelerometers, written by the programs that make them and read back."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.io import savemat, wavfile

from telerig.errors import InputError
from telerig.io.dataset.tables import read_accelerometer_csv
from telerig.io.exchange.importing.accelerometer import (
    Layout,
    import_accelerations,
    layout_from,
    read_accelerations,
)
from telerig.io.exchange.importing.records import merge_accelerations
from telerig.rig.units import ACCELERATION_UNITS

Array = NDArray[np.float64]

RATE_HZ = 1000.0
T_S = np.arange(400) / RATE_HZ
TRUE_M_S2 = np.stack([np.sin(60 * T_S), 0.5 * np.cos(90 * T_S), 9.81 + 0.2 * np.sin(40 * T_S)], -1)
GRAVITY = 9.80665


def readings(path: Path, **layout: object) -> tuple[Array, Array]:
    table = read_accelerations(path, "arm", Layout(**layout))  # type: ignore[arg-type]
    assert list(table.columns) == ["t_s", "sensor", "ax_m_s2", "ay_m_s2", "az_m_s2"]
    assert set(table["sensor"]) == {"arm"}
    return table["t_s"].to_numpy(), table[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy()


def check(found: tuple[Array, Array], atol: float = 1e-9, start_s: float = 0.0) -> None:
    np.testing.assert_allclose(found[0], T_S + start_s, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[1], TRUE_M_S2, rtol=0, atol=atol)


def write_text(path: Path, head: list[str], mark: str, comma: bool = False) -> Path:
    rows = [mark.join(repr(float(v)) for v in row) for row in np.c_[T_S, TRUE_M_S2 / GRAVITY]]
    if comma:
        rows = [row.replace(".", ",") for row in rows]
    path.write_text("\n".join(head + rows) + "\n", encoding="utf-8")
    return path


def test_csv_of_loggers(tmp_path: Path) -> None:
    plain = write_text(tmp_path / "a.csv", ["t_s,ax,ay,az"], ",")
    check(readings(plain, unit="g"))
    german = write_text(
        tmp_path / "b.csv", ["Logger 4711", "Kanal;1", "", "Time (s);X;Y;Z"], ";", comma=True
    )
    check(readings(german, unit="g", start_s=2.5), start_s=2.5)
    tabs = write_text(tmp_path / "c.txt", ["clock\tch1\tch2\tch3"], "\t")
    check(readings(tabs, unit="g", time_unit="s", columns=("clock", "ch1", "ch2", "ch3")))
    check(readings(tabs, rate_hz=RATE_HZ, scale_m_s2=GRAVITY, columns=(1, 2, 3)))


def test_wav(tmp_path: Path) -> None:
    """Full scale 20 m/s^2 in 16, 32 bit and float."""
    for kind, step in ((np.int16, 20 / 2**15), (np.int32, 20 / 2**31), (np.float32, 1e-6)):
        whole = np.dtype(kind).kind == "i"
        samples = TRUE_M_S2 / 20 * (2 ** (8 * np.dtype(kind).itemsize - 1) if whole else 1)
        path = tmp_path / f"{np.dtype(kind).name}.wav"
        wavfile.write(path, int(RATE_HZ), (np.round(samples) if whole else samples).astype(kind))
        check(readings(path, scale_m_s2=20.0), atol=max(step, 1e-9))


def test_wav_of_eight_bits_has_its_zero_in_the_middle(tmp_path: Path) -> None:
    wavfile.write(tmp_path / "a.wav", 10, np.array([[128, 0, 192]] * 3, np.uint8))
    _, found = readings(tmp_path / "a.wav", scale_m_s2=20.0)
    np.testing.assert_array_equal(found[0], [0.0, -20.0, 10.0])


def test_mat(tmp_path: Path) -> None:
    names = {"time": T_S, "ax": TRUE_M_S2[:, 0], "ay": TRUE_M_S2[:, 1], "az": TRUE_M_S2[:, 2]}
    savemat(tmp_path / "a.mat", names)
    check(readings(tmp_path / "a.mat", unit="m/s2", time_unit="s"))
    savemat(tmp_path / "b.mat", {"acc": TRUE_M_S2 * 1000})
    check(readings(tmp_path / "b.mat", unit="mm/s2", rate_hz=RATE_HZ))
    (tmp_path / "c.mat").write_bytes(b"nothing")
    with pytest.raises(InputError, match="no MAT file"):
        readings(tmp_path / "c.mat", unit="g")


def test_mat_with_structs(tmp_path: Path) -> None:
    logger = {
        "t": T_S,
        "Acc_X": TRUE_M_S2[:, 0],
        "Acc_Y": TRUE_M_S2[:, 1],
        "Acc_Z": TRUE_M_S2[:, 2],
    }
    savemat(tmp_path / "a.mat", {"logger": {**logger, "name": "arm"}})
    check(readings(tmp_path / "a.mat", unit="m/s2", time_unit="s"))


def test_mat_of_version_7_3(tmp_path: Path) -> None:
    """MATLAB writes its columns as rows of HDF5, and text as numbers with a class."""
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        file["data/time"] = T_S[None]
        for name, column in zip("xyz", TRUE_M_S2.T):
            file[f"data/acc_{name}"] = column[None]
        file["data/name"] = np.array([[97, 114, 109]], np.uint16)
        file["data/name"].attrs["MATLAB_class"] = np.bytes_("char")
        file["#refs#/a"] = T_S[None]
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    content = (tmp_path / "a.mat").read_bytes()
    (tmp_path / "a.mat").write_bytes(head.ljust(512, b"\0") + content[512:])
    check(readings(tmp_path / "a.mat", unit="m/s2", time_unit="s"))
    with pytest.raises(InputError, match=r"data\.acc_x, data\.acc_y, data\.acc_z"):
        readings(tmp_path / "a.mat", unit="m/s2", columns=("name", "x", "y"))
    (tmp_path / "b.mat").write_bytes(head.ljust(512, b"\0") + content[512:700])
    with pytest.raises(InputError, match="no MAT file"):
        readings(tmp_path / "b.mat")


def write_tdms(path: Path, unit: str = "g", groups: int = 1) -> None:
    nptdms = pytest.importorskip("nptdms")
    properties = {"wf_increment": 1 / RATE_HZ, "wf_start_offset": 0.25, "unit_string": unit}
    channels = [
        nptdms.ChannelObject(f"g{i}", name, column / GRAVITY, properties=properties)
        for i in range(groups)
        for name, column in zip(("X", "Y", "Z"), TRUE_M_S2.T)
    ]
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(channels)


def test_tdms(tmp_path: Path) -> None:
    path = tmp_path / "a.tdms"
    write_tdms(path)
    check(readings(path), start_s=0.25)
    write_tdms(path, unit="V", groups=2)
    with pytest.raises(InputError, match="has 2 groups"):
        readings(path)
    with pytest.raises(InputError, match="unit of its readings is 'V'"):
        readings(path, group="g1")
    check(readings(path, group="g1", scale_m_s2=GRAVITY), start_s=0.25)


def test_units_and_channels_are_never_guessed(tmp_path: Path) -> None:
    path = write_text(tmp_path / "a.csv", ["t_s,ax,ay,az"], ",")
    with pytest.raises(InputError, match="does not state the unit"):
        readings(path)
    with pytest.raises(InputError, match="give one of them"):
        readings(path, unit="g", scale_m_s2=2.0)
    with pytest.raises(InputError, match="has no line with the columns ax, ay, nope"):
        readings(path, unit="g", columns=("ax", "ay", "nope"))
    other = write_text(tmp_path / "b.csv", ["clock,p,q,r"], ",")
    with pytest.raises(InputError, match="which columns are x, y and z"):
        readings(other, unit="g")
    with pytest.raises(InputError, match="--rate-hz"):
        readings(other, unit="g", columns=("p", "q", "r"))
    german = write_text(tmp_path / "c.csv", ["Zeit (s);X (g);Y (g);Z (g)"], ";")
    with pytest.raises(InputError, match=r"no times .*\n.*channels: Zeit \(s\), X \(g\)"):
        readings(german)
    with pytest.raises(InputError, match=r"whole names.* header: Zeit \(s\);X \(g\)"):
        readings(german, columns=("Zeit", "X", "Y", "Z"))


def test_a_unit_against_that_in_the_names_is_noted(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t_s,ax_m_s2,ay_m_s2,az_m_s2\n0,1,2,3\n0.1,1,2,3\n")
    assert "another unit" not in " ".join(import_accelerations(path, "arm").notes)
    found = import_accelerations(path, "arm", Layout(unit="g"))
    assert "their names state another unit: m/s^2" in found.notes


def test_the_unit_g_is_the_standard_one() -> None:
    assert ACCELERATION_UNITS["g"] == 9.80665
    assert ACCELERATION_UNITS["mg"] == pytest.approx(9.80665e-3, rel=1e-15)


def test_bad_readings_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t_s,ax,ay,az\n0,1,2,3\n0.1,1,,3\n")
    with pytest.raises(InputError, match="reading 1 of 'ay' is no finite number"):
        readings(path, unit="g")
    path.write_text("t_s,ax,ay,az\n0,1,2,3\n0,1,2,3\n")
    with pytest.raises(InputError, match="times must increase"):
        readings(path, unit="g")
    path.write_text("t_s,ax,ay,az\n0,1,2,3\n1,1,2\n")
    with pytest.raises(InputError, match="row 3"):
        readings(path, unit="g")
    path.write_text("t_s,ax,ay,az\n")
    with pytest.raises(InputError, match="no rows of numbers"):
        readings(path, unit="g")
    with pytest.raises(InputError, match=r"end in \.xyz"):
        (tmp_path / "a.xyz").write_text("")
        readings(tmp_path / "a.xyz")


def test_merging_keeps_other_sensors(tmp_path: Path) -> None:
    path = write_text(tmp_path / "a.csv", ["t_s,ax,ay,az"], ",")
    run = tmp_path / "accelerometer.csv"
    for name in ("left", "right"):
        assert merge_accelerations(read_accelerations(path, name, Layout(unit="g")), run) == []
    halved = read_accelerations(path, "left", Layout(unit="g", columns=("t_s", "ay", "ax", "az")))
    assert merge_accelerations(halved, run) == ["left"]
    table = read_accelerometer_csv(run, ["left", "right"])
    assert (table["sensor"] == "left").sum() == (table["sensor"] == "right").sum() == len(T_S)
    left = table[table["sensor"] == "left"]["ax_m_s2"].to_numpy()
    np.testing.assert_allclose(left, TRUE_M_S2[:, 1], atol=1e-12)


def test_layout_from_words_of_a_command_line() -> None:
    found = layout_from({"columns": "2, 3,z", "scale_m_s2": "98,97.5,99", "unit": None})
    assert found == Layout(columns=(2, 3, "z"), scale_m_s2=(98.0, 97.5, 99.0))
    with pytest.raises(InputError, match="no number"):
        layout_from({"scale_m_s2": "much"})


@pytest.mark.parametrize(
    ("counter", "words"),
    [
        (np.arange(2500) % 1000, "from 999 to 0"),
        (np.r_[np.arange(1800), np.arange(700)], "from 1799 to 0"),
        (np.r_[np.arange(90), 91, 90, np.arange(92, 200)], "from 91 to 90"),
    ],
)
def test_a_counter_that_starts_again_elsewhere_is_refused(
    tmp_path: Path, counter: Array, words: str
) -> None:
    rows = [f"{n},0.1,0.2,9.8" for n in counter.tolist()]
    (tmp_path / "a.csv").write_text("\n".join(["n,x,y,z", *rows]) + "\n")
    with pytest.raises(InputError, match=words):
        readings(tmp_path / "a.csv", columns=("n", "x", "y", "z"), rate_hz=1000.0, unit="g")


def test_a_counter_that_turns_over_counts_missing_samples(tmp_path: Path) -> None:
    n = np.delete(np.arange(600), [40, 41, 256, 257])
    rows = [f"{k % 256},0.1,0.2,9.8" for k in n.tolist()]
    (tmp_path / "a.csv").write_text("\n".join(["n,x,y,z", *rows]) + "\n")
    t_s, _ = readings(tmp_path / "a.csv", columns=("n", "x", "y", "z"), rate_hz=100.0, unit="g")
    np.testing.assert_allclose(t_s, n / 100.0)
