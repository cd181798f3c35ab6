"""The commands and code of docs/exports.md run as they stand; the commands' errors in words."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import cv2
import h5py
import numpy as np
import pandas as pd
import pytest
from places import ROOT
from rig_text import FULL
from scipy.io import loadmat, wavfile
from typer.testing import CliRunner

import telerig
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.dataset.tables import read_accelerometer_csv
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.scripts.main import app

PAGE = ROOT / "docs" / "exports.md"
PTV_PAR = "2\na\nb\nc\nd\n1\n0\n1\n1280\n800\n0.012\n0.012\n0\n1\n1\n1\n0\n"


def command(line: str, code: int = 0) -> str:
    result = CliRunner().invoke(app, shlex.split(line)[1:])
    assert result.exit_code == code, result.output + str(result.exception)
    return result.output


def openlpt_text(rotation: np.ndarray, shift: list[float]) -> str:
    def rows(matrix: np.ndarray) -> list[str]:
        return [",".join(repr(float(v)) for v in row) for row in np.atleast_2d(matrix)]

    camera = np.array([[20000.0, 0, 640], [0, 20000.0, 400], [0, 0, 1]])
    turn = cv2.Rodrigues(rotation)[0].reshape(1, 3)
    lines = ["PINHOLE", "None", "None", "800,1280", *rows(camera), "0,0,0,0,0", *rows(turn)]
    lines += [*rows(rotation), *rows(rotation.T), *rows(np.array(shift)), "0,0,0"]
    return "\n".join(lines) + "\n"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset with results, and files of other programs, in the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TELERIG_DEBUG", "1")
    second = Pose.from_rotvec([0, np.pi / 2, 0])
    cameras = [
        Camera.create("left", (512, 512), 10.0, k1=0.004),
        Camera.create("right", (512, 512), 9.9, k1=0.003, camera_from_rig=second),
    ]
    data = tmp_path / "data"
    calibration_from_cameras(cameras).save(data / "results" / "calibration")
    (data / "runs" / "rise").mkdir(parents=True)
    (data / "results" / "rise").mkdir()
    (data / "rig.toml").write_text(FULL.replace("arm_left", "left"))
    table = pd.DataFrame({"frame": [0, 1, 1, 2], "particle": [4, 4, 5, 5]})
    table["t_s"] = 0.01 * table["frame"]
    table[["x_mm", "y_mm", "z_mm"]] = np.arange(12).reshape(4, 3) / 7
    table.to_csv(data / "results" / "rise" / "trajectories.csv", index=False)
    said = {"verdict": "UNRESOLVED", "flags": []}
    (data / "results" / "rise" / "smoothing.json").write_text(json.dumps(said))
    across = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    Path("cam1.txt").write_text(openlpt_text(np.eye(3), [0, 0, 500]))
    Path("cam2.txt").write_text(openlpt_text(across, [0, 0, 450]))
    write_opencv_files(across)
    for i, (where, angle) in enumerate([("0 0 480", 0.0), ("470 0 0", np.pi / 2)], 1):
        text = f"{where}\n0 {angle!r} 0\n1 0 0\n0 1 0\n0 0 1\n0 0\n90\n0 0 50\n"
        Path(f"cam{i}.tif.ori").write_text(text)
        Path(f"cam{i}.tif.addpar").write_text("-1e-5 0 0 0 0 1 0")
    Path("ptv.par").write_text(PTV_PAR)
    wavfile.write("arm.wav", 1000, np.full((500, 3), 0.2, np.float32))
    return tmp_path


def write_opencv_files(rotation: np.ndarray) -> None:
    matrix = np.array([[9000.0, 0, 640], [0, 9000.0, 400], [0, 0, 1]])
    inner = cv2.FileStorage("intrinsics.yml", cv2.FILE_STORAGE_WRITE)
    for i in (1, 2):
        inner.write(f"M{i}", matrix)
        inner.write(f"D{i}", np.array([0.1, 0, 0, 0, 0]))
    inner.write("image_width", 1280)
    inner.write("image_height", 800)
    inner.release()
    outer = cv2.FileStorage("extrinsics.yml", cv2.FILE_STORAGE_WRITE)
    outer.write("R", rotation)
    outer.write("T", np.array([450.0, 0, 450.0]))
    outer.release()


def blocks(kind: str) -> list[str]:
    return re.findall(rf"```{kind}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


def test_commands_of_the_page(place: Path) -> None:
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    assert len(lines) == 9
    said = {line: command(line) for line in lines}
    exports = place / "data" / "results" / "export"
    assert sorted(p.name for p in exports.iterdir()) == (
        ["halcon", "opencv.yml", "rise", "rise.nc"]
    )
    assert "verdict: UNRESOLVED" in said[lines[2]]
    assert loadmat("rise.mat")["trajectories"]["x_mm"][0, 0].shape == (4, 1)
    for program in ("openlpt", "opencv", "openptv"):
        calibration = telerig.load_calibration(f"from-{program}")
        assert calibration.verdict["status"] == "IMPORTED"
        point = np.array([[1.0, 2.0, 3.0]])
        pixels = [calibration.project(i, point) for i in range(2)]
        found = calibration.triangulate(*pixels).points_mm
        np.testing.assert_allclose(found, point, atol=1e-6)
        nominal = Path(f"from-{program}/nominal.toml").read_text()
        assert "telecentricity_per_mm = 0.002" in nominal and "_rotvec_deg" in nominal
    table = read_accelerometer_csv(place / "data/runs/rise/accelerometer.csv", ["left"])
    assert len(table) == 500 and table["t_s"][0] == 0.5
    np.testing.assert_allclose(table["ax_m_s2"], 0.2 * 49.03, rtol=1e-6)


def test_code_of_the_page(place: Path) -> None:
    pytest.importorskip("xarray")
    names: dict[str, object] = {}
    code = blocks("python")
    assert len(code) == 4
    for block in code:
        exec(compile(block, str(PAGE), "exec"), names)
    assert Path("cameras-in-air.yml").is_file() and Path("rise.nc").is_file()


@pytest.mark.parametrize("to", ["hdf5", "trackpy"])
def test_default_run_is_the_only_one(place: Path, to: str) -> None:
    command(f"telerig export data --to {to}")
    if to == "hdf5":
        with h5py.File("data/results/export/rise.h5") as file:
            assert set(file["cameras"]) == {"left", "right"}
            assert file.attrs["verdict"] == "UNRESOLVED"
    else:
        assert len(pd.read_csv("data/results/export/rise.csv")) == 4


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("telerig export data --to word", "use one of: halcon"),
        ("telerig export nowhere --to mat", "no such dataset"),
        ("telerig export data/results/rize --to mat", "did you mean rise?"),
        ("telerig export data --to mat --run rize", "did you mean rise?"),
        ("telerig export data --to halcon --calibration nowhere.json", "no such calibration"),
        ("telerig export data --to halcon --volume 1,2", "six numbers"),
        ("telerig export data --to halcon --volume 90,95,0,1,0,1", "points of the volume"),
        ("telerig export data/runs/rise --to opencv", "neither a dataset nor a folder of results"),
        ("telerig export data --to halcon --run rise", "have it: hdf5, netcdf, mat, vtk, trackpy"),
        ("telerig export data --to vtk --volume 0,1,0,1,0,1", "have it: halcon, opencv"),
        ("telerig export data --to netcdf --calibration x", "opencv, hdf5, mat"),
        ("telerig import opencv extrinsics.yml --out x", "no matrix with one of the names M1"),
        ("telerig import openptv cam1.tif.ori --out x", "sensor is not known"),
        ("telerig import openptv cam1.tif.ori --image-size 3 --pixel-mm 1,1 --out x", "2 num"),
        ("telerig import accelerometer arm.wav --run data/runs/rise --sensor a", "the unit"),
        ("telerig import accelerometer arm.wav --run nowhere --sensor a", "no such run"),
    ],
)
def test_bad_input_is_answered_in_words(place: Path, line: str, words: str) -> None:
    before = {p for p in place.rglob("*") if p.is_file()}
    text = " ".join(command(line, code=2).split())
    assert words in text and "->" in text
    assert {p for p in place.rglob("*") if p.is_file()} == before
