"""Each fault that hostile files once caused: the bound or the rule that refuses it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
from calibration_folder import write_calibration_folder
from rig_text import FULL
from scipy.io import wavfile

import telerig
from telerig.errors import InputError
from telerig.io.exchange.export.halcon import export_halcon, halcon_cameras, write_halcon
from telerig.io.exchange.export.volume import working_volume
from telerig.io.exchange.formats import export_cameras, export_results
from telerig.io.exchange.importing.accelerometer import Layout, read_accelerations
from telerig.io.files.csv_table import MOST_COLUMNS, Column, read_table
from telerig.io.files.names import check_name, fault_of_name
from telerig.io.files.toml import toml_content
from telerig.io.images.read import read_image
from telerig.io.rig_file.rig_file import description_from_toml
from telerig.rig.camera import Camera

HOSTILE = ("/abs/path", "../../x", "..", ".x", "a/b", "a\nb", "a\x1b[2J", "\u202ea", "", " ",
           "a\\b", "=cmd|' /C calc'!A0", "@SUM(1)", "x" * 300)  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_name_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=r"file\.toml: the camera .* ") as caught:
        check_name(name, "file.toml", "camera")
    assert "\x1b" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize("name", ["left", "Zähler 1", "名前", "left-2", "view 07 (b)", "it's", "7"])
def test_names_in_any_language_are_allowed(name: str) -> None:
    assert fault_of_name(name) == ""


def test_an_allowed_name_stays_one_file_in_its_folder() -> None:
    rng, allowed = np.random.default_rng(0), 0
    for _ in range(500):
        points = rng.choice([0x30, 0x80, 0x3000, 0x110000], rng.integers(1, 6))
        name = "".join(chr(int(rng.integers(top))) for top in points)
        if not fault_of_name(name):
            file = Path("/folder") / f"{name}_pose.dat"
            assert file.parent == Path("/folder") and len(file.name.encode()) < 255
            assert name.splitlines() == [name] and "\0" not in name
            allowed += 1
    assert 10 < allowed < 490


@pytest.mark.parametrize("name", ["outside", "../../x", 'a"b\nsystem_call(1)'])
def test_a_camera_of_a_calibration_writes_nothing_outside(tmp_path: Path, name: str) -> None:
    folder = write_calibration_folder(tmp_path / "results", 2)
    file, target = folder / "calibration.json", tmp_path / "precious"
    target.write_text("as before")
    evil = str(target) if name == "outside" else name
    content = json.loads(file.read_text())
    content["cameras"][evil] = content["cameras"].pop("right")
    file.write_text(json.dumps(content))
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=r"calibration\.json.*the name"):
        export_results(file, "halcon", out=tmp_path / "out")
    assert target.read_text() == "as before" and sorted(tmp_path.rglob("*")) == before


def test_exports_refuse_a_camera_that_python_code_named(tmp_path: Path) -> None:
    cameras = [Camera.create(name, (512, 512), 10.0) for name in ("left", "../x")]
    for to in ("halcon", "opencv"):
        with pytest.raises(InputError, match="the camera"):
            export_cameras(cameras, to, tmp_path / "out")
    with pytest.raises(InputError, match="the camera"):
        write_halcon(halcon_cameras(cameras[1:]), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_quotes_in_a_name_stay_in_the_comment_of_a_script(tmp_path: Path) -> None:
    camera = Camera.create("a'b\"", (512, 512), 10.0)
    export_halcon([camera], tmp_path / "out", working_volume([camera]))
    lines = (tmp_path / "out" / "cameras.hdev.txt").read_text().splitlines()
    assert all(line[:1] in ("", "*") or line.startswith(("CamParam", "Pose")) for line in lines)


def test_a_sensor_of_the_rig_file_follows_the_rule() -> None:
    text = FULL.replace("[accelerometers.arm_left]", '[accelerometers."../arm"]')
    assert text != FULL
    with pytest.raises(InputError, match="has a /"):
        description_from_toml(text, where="rig.toml")


@pytest.mark.parametrize(
    "text",
    ["a." * 100_000 + "b = 1", "[" + "a." * 100_000 + "b]", "x = " + "[" * 50_000, "x=1" * 5_000],
)  # fmt: skip
def test_toml_is_bounded_before_it_is_parsed(text: str) -> None:
    with pytest.raises(InputError, match=r"rig\.toml") as caught:
        toml_content(text, "rig.toml", "correct it")
    assert len(str(caught.value)) < 1000


def test_a_table_of_too_many_columns_is_refused_at_once(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    columns = 100_000
    file.write_text("x" + "".join(f",c{i}" for i in range(columns)) + "\n" + "1" + ",1" * columns)
    with pytest.raises(InputError, match=rf"t\.csv row 1.*{columns + 1} columns; {MOST_COLUMNS}"):
        read_table(file, [Column("x")], extra=True)


@pytest.mark.parametrize("cell", ["1e308", "nan", "9" * 400, "a\x00b"])
def test_a_number_that_no_measurement_has_is_refused(tmp_path: Path, cell: str) -> None:
    file = tmp_path / "t.csv"
    file.write_text(f"x,n\n1,2\n{cell},3\n")
    with pytest.raises(InputError, match=r"t\.csv row 3"):
        read_table(file, [Column("x"), Column("n", "whole")])


def test_an_image_too_large_for_the_memory_is_refused_from_its_header(tmp_path: Path) -> None:
    file = tmp_path / "large.tif"
    tifffile.imwrite(file, np.zeros((64, 64), np.uint8), compression="zlib")
    content = bytearray(file.read_bytes())
    for tag in (256, 257):  # width and height, SHORT or LONG, of a little-endian file
        at = content.index(tag.to_bytes(2, "little"), 8)
        content[at + 8 : at + 12] = (50_000).to_bytes(4, "little")
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"large\.tif: is 50000 x 50000 px, 2.5 GB"):
        read_image(file)


def test_a_sound_file_that_ends_too_early_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "arm.wav"
    wavfile.write(file, 1000, np.zeros((100, 3), np.int16))
    whole = file.read_bytes()
    for length in range(0, len(whole) - 1, 7):
        file.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"arm\.wav"):
            read_accelerations(file, "arm", Layout(scale_m_s2=1.0))


def test_damaged_tracks_are_refused_with_their_row(tmp_path: Path) -> None:
    from tracked_folder import write_folder

    sound = write_folder(tmp_path / "sound", bubbles=2, frames=8, drawn=False)
    for name, change in (
        ("tracks.csv", lambda t: t.replace("x_mm", "X", 1)),
        ("tracks.csv", lambda t: t[: len(t) // 2]),
        ("detections.csv", lambda t: t + "1,2\n"),
        ("events.csv", lambda t: "\udcff" + t),
    ):
        folder = shutil.copytree(sound, tmp_path / "damaged", dirs_exist_ok=True)
        text = change((folder / name).read_text())
        (folder / name).write_bytes(text.encode("utf-8", "surrogateescape"))
        with pytest.raises(InputError, match=name):
            telerig.load_tracks(folder)


def test_a_message_fits_a_screen_and_holds_no_control_characters() -> None:
    error = InputError("x" * 10**6 + "\x1b", where="\u202e" * 10**5, todo="é" * 10**5)
    assert len(str(error).encode()) <= 4096
    assert str(InputError(error.what, where=error.where, todo=error.todo)) == str(error)
    assert str(InputError("\x1b[2J", where="a\ud800")) == "a\\ud800: \\x1b[2J"
