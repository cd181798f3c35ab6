"""`telerig import`: recordings of accelerometers are added to a run, listed and removed."""

from __future__ import annotations

import shlex
import tomllib
from pathlib import Path

import numpy as np
import pytest
from rig_text import FULL
from typer.testing import CliRunner

from telerig.io.dataset.tables import read_accelerometer_csv
from telerig.io.exchange.importing.accelerometer import import_accelerations
from telerig.io.exchange.importing.sensor_table import sensor_toml
from telerig.scripts.main import app

RUN = "data/runs/rise"


def command(line: str, code: int = 0) -> str:
    result = CliRunner().invoke(app, shlex.split(line)[1:])
    assert result.exit_code == code, result.output + str(result.exception)
    return result.output


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset with a run of 101 frames from 1 s to 2 s, and a logger's record of 4 s."""
    monkeypatch.chdir(tmp_path)
    run = tmp_path / RUN
    run.mkdir(parents=True)
    (tmp_path / "data" / "rig.toml").write_text(FULL)
    (run / "run.toml").write_text("frame_rate_hz = 100.0\nstart_s = 1.0\n")
    rows = "".join(
        f"{i},{camera},{300 + i},200\n" for i in range(101) for camera in ("left", "right")
    )
    (run / "detections.csv").write_text("frame,camera,u_px,v_px\n" + rows)
    rng = np.random.default_rng(3)
    t_s = np.arange(4000) / 1000
    a_g = rng.normal(0, 1e-3, (4000, 3)) + [0, 0, 1]
    table = "".join(f"{t:.3f},{x:.6f},{y:.6f},{z:.6f}\n" for t, (x, y, z) in zip(t_s, a_g))
    (tmp_path / "arm.csv").write_text("Time (s),X (g),Y (g),Z (g)\n" + table)
    return tmp_path


def test_a_record_is_imported_listed_and_removed(place: Path) -> None:
    said = command(f"telerig import accelerometer arm.csv --run {RUN} --sensor arm_left")
    assert "x, y, z are the channels 'X (g)', 'Y (g)', 'Z (g)' in g" in said
    assert "arm_left: 4000 readings from 0 to 3.999 s at 1000 Hz" in said
    assert " m/s^2, 9.807 in all (gravity at rest: 9.81)" in said
    assert (
        "75 % of them are outside the run's time (1 to 2 s): the first at 0 s, the last at 3.999 s"
    ) in said
    assert 'add clock = "unknown" to [accelerometers.arm_left]' in said
    assert said.endswith(f"written: {RUN}/accelerometer.csv\n")
    listed = command(f"telerig import --list {RUN}")
    assert listed in said
    before = (place / RUN / "accelerometer.csv").read_bytes()
    wrong = command(f"telerig import --list {RUN} --remove arm_lefd", code=2)
    assert "has no readings of 'arm_lefd'" in wrong and "did you mean arm_left?" in wrong
    assert (place / RUN / "accelerometer.csv").read_bytes() == before
    said = command(f"telerig import --list {RUN} --remove arm_left")
    assert said == (
        f"removed: 4000 readings of arm_left\n{RUN}: there are no recordings of accelerometers\n"
    )
    assert not (place / RUN / "accelerometer.csv").exists()


def test_removing_keeps_other_sensors(place: Path) -> None:
    with (place / "data" / "rig.toml").open("a") as file:
        file.write(
            '[accelerometers.base]\nmounted_on = "carriage"\naxes = [[1,0,0],[0,1,0],[0,0,1]]\n'
            "noise_density_ug_sqrt_hz = 100\n"
        )
    command(f"telerig import accelerometer arm.csv --run {RUN} --sensor arm_left --start-s 0.1")
    command(f"telerig import accelerometer arm.csv --run {RUN} --sensor base --start-s 20")
    said = command(f"telerig import --list {RUN} --remove arm_left")
    assert "base: 4000 readings from 20 to 23.999 s" in said and "100 % of them" in said
    assert "seems to have its own clock" in said and '"unknown"' in said and "--start-s" in said
    table = read_accelerometer_csv(place / RUN / "accelerometer.csv", None)
    assert set(table["sensor"]) == {"base"} and len(table) == 4000


def test_a_sensor_that_rig_toml_does_not_know_is_refused_with_the_lines_to_add(place: Path) -> None:
    said = command(f"telerig import accelerometer arm.csv --run {RUN} --sensor arm", code=2)
    assert "there is no accelerometer 'arm' (there are: arm_left)" in said
    assert not (place / RUN / "accelerometer.csv").exists()
    lines = said[said.index("[accelerometers.arm]") :]
    table = tomllib.loads(lines)["accelerometers"]["arm"]
    assert table["mounted_on"] == "left" and table["clock"] == "unknown"
    with (place / "data" / "rig.toml").open("a") as file:
        file.write(lines)
    said = command(f"telerig import accelerometer arm.csv --run {RUN} --sensor arm")
    assert "does not state the clock" not in said


def test_the_lines_to_add_follow_from_the_record(place: Path) -> None:
    """Gravity gives the vertical axis, the scatter of neighbours the noise density."""
    table = import_accelerations(place / "arm.csv", "arm").table
    found = tomllib.loads(sensor_toml("arm", table, ["left", "right"]))["accelerometers"]["arm"]
    assert found["noise_density_ug_sqrt_hz"] == pytest.approx(1e3 / np.sqrt(500), rel=0.1)
    columns = ["ax_m_s2", "ay_m_s2", "az_m_s2"]
    for turn in ([0, 1, 2], [2, 0, 1], [0, 2, 1]):
        for sign in (1, -1):
            turned = table.copy()
            turned[columns] = sign * table[columns].to_numpy()[:, turn]
            sensor = tomllib.loads(sensor_toml("arm", turned, ["left"]))["accelerometers"]["arm"]
            axes = np.array(sensor["axes"])
            np.testing.assert_allclose(turned[columns].mean() @ axes, [0, -9.80665, 0], atol=1e-2)
            assert np.linalg.det(axes) == pytest.approx(1)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("telerig import --list nowhere", "there is no such run"),
        ("telerig import --remove arm", "--list DATASET/runs/NAME"),
        (f"telerig import --list {RUN} openlpt a --out b", "--list and openlpt are given"),
        (f"telerig import accelerometer arm.csv --run {RUN} --sensor a --unit lb", "--unit g"),
    ],
)
def test_bad_options_are_answered_in_words(place: Path, line: str, words: str) -> None:
    text = " ".join(command(line, code=2).split())
    assert words in text and "->" in text
