"""`telerig init` makes what can be loaded; `telerig doctor` names what is wrong and what to do."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from target_pictures import draw, pixel_from_mm
from typer.testing import CliRunner

from telerig.estimator.doctor import checks as doctor
from telerig.estimator.doctor.checks import check_dataset, check_installation, check_ports
from telerig.io.dataset.new_dataset import NewCamera, new_dataset
from telerig.io.rig_file.rig_file import read_rig_toml
from telerig.io.simulation.presets import run_preset
from telerig.io.simulation.simulate import simulate
from telerig.rig.target import Target
from telerig.scripts.main import app


def _asked(*arguments: str):
    return CliRunner().invoke(app, list(arguments))


@pytest.fixture(scope="module")
def rise(tmp_path_factory) -> Path:
    """Views as dots and a run as detections, with encoder and arm sensors."""
    config = run_preset("rise", frames=20)
    config = replace(config, stage=replace(config.stage, accelerometers=("left", "right")))
    folder = tmp_path_factory.mktemp("doctor") / "rise"
    simulate(config, rng=np.random.default_rng(1), out=folder, images=False)
    return folder


@pytest.fixture
def data(rise, tmp_path) -> Path:
    return Path(shutil.copytree(rise, tmp_path / "rise"))


def _of(checks, what: str, status: str) -> str:
    """The words of the only check of that name and status."""
    (found,) = [c for c in checks if c.what == what and c.status == status]
    return f"{found.words} {found.todo}"


def test_init_makes_a_rig_file_that_says_what_was_asked(tmp_path):
    result = _asked("init", str(tmp_path / "tank"), "--cameras", "front,side", "--size", "1280x800",
                    "--scale", "12.5", "--angle", "-75")  # fmt: skip
    assert result.exit_code == 0, result.output
    rig = read_rig_toml(tmp_path / "tank" / "rig.toml")
    assert list(rig.cameras) == ["front", "side"]
    assert rig.cameras["side"].image_size_px == (1280, 800)
    assert rig.cameras["front"].scale_px_per_mm == 12.5
    assert rig.rotvec_from_first_deg == {"side": (0.0, -75.0, 0.0)}
    assert rig.name == "tank"
    assert (tmp_path / "tank" / "calibration" / "side").is_dir()
    assert (tmp_path / "tank" / "runs").is_dir()


def test_init_from_images_says_where_the_images_go(tmp_path):
    target = Target(rows=4, columns=5, pitch_mm=(7.0, 7.0), dot_diameter_mm=2.4)
    image, _ = draw(target, pixel_from_mm(8.0, 20, 5, False), size_px=400)
    for name in ("left/00_0", "right/00_1"):
        (tmp_path / "images" / name).parent.mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "images" / f"{name}.png"), image)
    tank, images = tmp_path / "tank", str(tmp_path / "images")
    result = _asked("init", str(tank), "--from-images", images, "--pitch", "7")
    assert result.exit_code == 0, result.output
    text = result.output.replace("\n", " ")
    for name in ("left", "right"):
        assert f"{images}/{name} to {tank}/calibration/{name}" in text
    assert "no view has an image of every camera" in text
    (tank / "rig.toml").unlink()
    for name in ("left", "right"):
        (tmp_path / "images" / name).replace(tank / "calibration" / name)
    result = _asked("init", str(tank), "--from-images", str(tank / "calibration"), "--pitch", "7")
    assert result.exit_code == 0, result.output
    assert f"next: edit {tank}/rig.toml" in result.output.replace("\n", " "), "they are there"


def test_init_of_four_cameras(tmp_path):
    result = _asked("init", str(tmp_path / "tank"), "--cameras", "a,b,c,d", "--angle", "40")
    assert result.exit_code == 0, result.output
    rig = read_rig_toml(tmp_path / "tank" / "rig.toml")
    assert list(rig.cameras) == ["a", "b", "c", "d"]
    assert rig.rotvec_from_first_deg == {"b": (0, 40, 0), "c": (0, 80, 0), "d": (0, 120, 0)}
    assert rig.tracking_cameras == ("a", "b", "c", "d")
    assert all((tmp_path / "tank" / "calibration" / name).is_dir() for name in "abcd")


def test_init_of_a_folder_whose_name_toml_would_misread(tmp_path):
    file, *_ = new_dataset(tmp_path / 'q\\uses "both"\nü')
    assert read_rig_toml(file).name == "quses bothü"


@pytest.mark.parametrize("option", ["--angle", "--scale"])
def test_init_that_is_refused_leaves_nothing_in_the_way(tmp_path, option):
    assert _asked("init", str(tmp_path / "tank"), option, "inf").exit_code == 2
    assert not (tmp_path / "tank").exists()
    assert _asked("init", str(tmp_path / "tank")).exit_code == 0


def test_every_example_in_the_rig_file_can_be_switched_on(tmp_path):
    file, *_ = new_dataset(tmp_path / "tank")
    lines = file.read_text().splitlines()
    on = [line[2:] if line.startswith(("# [", "# telecentr", "# scale_")) or
          (line.startswith("# ") and " = " in line.split("#")[1]) else line
          for line in lines]  # fmt: skip
    file.write_text("\n".join(on))
    rig = read_rig_toml(file)
    assert rig.accelerometers["arm_left"].mounted_on == "left"
    assert rig.devices["encoder"].kind == "encoder"
    assert rig.walls["left"].indices == (1.0, 1.52, 1.333)
    assert rig.stage is not None and rig.stage.scale_sigma == 0.001


def test_init_never_writes_over_a_rig_file(tmp_path):
    (tmp_path / "rig.toml").write_text("mine")
    result = _asked("init", str(tmp_path))
    assert result.exit_code == 2
    assert "there is a rig.toml already" in result.output
    assert (tmp_path / "rig.toml").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--cameras", "a,b,c,d,e"], "name one to 4"),
        (["--cameras", "left,left"], "two cameras have one name"),
        (["--cameras", "left,carriage"], "'carriage'"),
        (["--size", "512"], "give width and height"),
        (["--scale", "0"], "give a positive number"),
    ],
)
def test_init_refuses_what_cannot_be(tmp_path, arguments, words):
    result = _asked("init", str(tmp_path / "new"), *arguments)
    assert result.exit_code == 2
    assert words in result.output
    assert not (tmp_path / "new" / "rig.toml").exists()


def test_the_installation_that_runs_these_tests_is_whole():
    checks = list(check_installation())
    assert [c for c in checks if c.status == "failure"] == []
    assert {"Python", "gtsam", "numpy", "pyserial", "one OpenCV"} <= {c.what for c in checks}
    major = cv2.__version__.split(".")[0]
    assert f"major version {major}" in _of(checks, "one OpenCV", "ok")


def test_two_distributions_of_opencv_are_told_apart(monkeypatch):
    class Rival:
        metadata = {"Name": "opencv-contrib-python"}  # noqa: RUF012

    monkeypatch.setattr(doctor, "distributions", lambda: [Rival()])
    words = _of(check_installation(), "one OpenCV", "warning")
    assert "opencv-contrib-python" in words and "pip uninstall" in words


def test_a_package_that_is_missing_or_broken_is_a_failure(monkeypatch):
    monkeypatch.setattr(doctor, "_required", lambda: ["no-such-package", "numpy"])
    assert "pip install no-such-package" in _of(check_installation(), "no-such-package", "failure")

    def broken(name: str) -> None:
        raise ImportError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr(doctor.importlib, "import_module", broken)
    assert "libGL.so.1" in _of(check_installation(), "numpy", "failure")


class _Port:
    def __init__(self, device: Path) -> None:
        self.device, self.description = str(device), "FT232R"


def test_a_slow_latency_timer_is_named_with_the_remedy(tmp_path, monkeypatch):
    device = tmp_path / "ttyUSB0"
    device.touch()
    (tmp_path / "sys" / "ttyUSB0").mkdir(parents=True)
    timer = tmp_path / "sys" / "ttyUSB0" / "latency_timer"
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [_Port(device)])
    timer.write_text("16\n")
    words = _of(check_ports(tmp_path / "sys"), f"{device} latency timer", "warning")
    assert "16 ms" in words and f"tee {timer}" in words
    timer.write_text("1\n")
    assert "1 ms" in _of(check_ports(tmp_path / "sys"), f"{device} latency timer", "ok")


def test_a_port_that_may_not_be_opened_is_named(tmp_path, monkeypatch):
    device = tmp_path / "ttyUSB0"
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [_Port(device)])
    assert "dialout" in _of(check_ports(tmp_path), str(device), "warning")


def test_views_of_one_camera_are_named(data):
    file = data / "calibration" / "dots.csv"
    dots = pd.read_csv(file)
    alone = sorted(set(dots["view"]))[1]
    dots[(dots["view"] != alone) | (dots["camera"] == "left")].to_csv(file, index=False)
    views = _of(list(check_dataset(data)), "views", "ok")
    assert f"1 of them from one camera only ({alone})" in views


def test_a_sound_dataset_has_nothing_to_mend(data):
    checks = list(check_dataset(data))
    assert {c.status for c in checks} <= {"ok", "note"}, checks
    assert "12 views from dots" in _of(checks, "views", "ok")
    assert "20 frames from detections" in _of(checks, "run rise", "ok")
    assert "one camera" not in _of(checks, "views", "ok")
    sensors = _of(checks, "run rise sensors", "ok")
    assert "encoder 1000 Hz" in sensors and "arm_left 2000 Hz" in sensors


def test_the_disk_must_hold_the_results_of_all_frames_whatever_their_files(data, monkeypatch):
    free = shutil.disk_usage(data)._replace(free=30_000_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: free)
    assert "30 GB free" in _of(check_dataset(data), "disk", "ok")
    monkeypatch.setattr(doctor, "_RESULT_BYTES_PER_FRAME", 2_000_000_000)
    assert "results may need 40 GB" in _of(check_dataset(data), "disk", "warning")


def test_every_fault_of_a_run_is_found(data):
    run = data / "runs" / "rise"
    stage = run / "stage.csv"
    rows = stage.read_text().splitlines()
    shifted = [f"{float(r.split(',')[0]) + 3600},{r.split(',', 1)[1]}" for r in rows[1:]]
    stage.write_text("\n".join([rows[0], *shifted]) + "\n")
    assert "does not overlap" in _of(check_dataset(data), "run rise sensors", "failure")
    stage.write_text("time,position\n0,0\n")
    assert "stage.csv" in _of(check_dataset(data), "run rise", "failure")


def test_lost_frames_are_noted(data):
    file = data / "runs" / "rise" / "frames.csv"
    rows = file.read_text().splitlines()
    late = [f"{r.split(',')[0]},{float(r.split(',')[1]) + 0.05}" for r in rows[15:]]
    file.write_text("\n".join([*rows[:15], *late]) + "\n")
    assert "1 step longer than" in _of(check_dataset(data), "run rise frames.csv", "note")


def test_an_empty_dataset_is_told_what_to_put_where(tmp_path):
    new_dataset(tmp_path / "tank")
    checks = list(check_dataset(tmp_path / "tank"))
    assert "calibration/<camera>/<view>.tif" in _of(checks, "views", "warning")
    assert "runs/<name>" in _of(checks, "runs", "note")


def test_views_in_two_forms_are_not_called_missing(data):
    for camera in ("left", "right"):
        (data / "calibration" / camera).mkdir()
        picture = data / "calibration" / camera / "view00.png"
        cv2.imwrite(str(picture), np.zeros((512, 512), np.uint8))
    views = _of(list(check_dataset(data)), "views", "warning")
    assert "both images and dots.csv" in views and "--from dots" in views


def test_what_a_killed_command_left_is_named(tmp_path):
    new_dataset(tmp_path / "tank")
    assert not [c for c in check_dataset(tmp_path / "tank") if c.what == "left over"]
    half = tmp_path / "tank" / "results" / ".rise.12-ab.part"
    (half / "overlays").mkdir(parents=True)
    said = _of(list(check_dataset(tmp_path / "tank")), "left over", "note")
    assert "1 half-written: results/.rise.12-ab.part" in said


def test_images_of_the_wrong_size_are_found(tmp_path):
    new_dataset(tmp_path / "tank", [NewCamera(n, (64, 48)) for n in ("left", "right")])
    for camera in ("left", "right"):
        for view in range(6):
            picture = np.full((48, 64 if camera == "left" else 60), 90, np.uint8)
            cv2.imwrite(str(tmp_path / "tank" / "calibration" / camera / f"{view}.png"), picture)
    checks = list(check_dataset(tmp_path / "tank"))
    assert "6, uint8" in _of(checks, "images of left", "ok")
    assert "60 x 48" in _of(checks, "images of right", "failure")
    assert "6 views" in _of(checks, "views", "note")


def _bubbles_warning(tank, size_px, pictures):
    """What the doctor warns of a run whose two images of each camera are these."""
    new_dataset(tank, [NewCamera(n, (size_px, size_px)) for n in pictures])
    for camera, grey in pictures.items():
        folder = tank / "runs" / "swarm" / camera
        folder.mkdir(parents=True)
        picture = cv2.GaussianBlur(grey, (0, 0), 1.0).astype(np.uint8)
        for frame in range(2):
            cv2.imwrite(str(folder / f"{frame:06d}.png"), picture)
    (tank / "runs" / "swarm" / "frames.csv").write_text("frame,t_s\n0,0.0\n1,0.01\n")
    return _of(list(check_dataset(tank)), "run swarm bubbles", "warning")


def test_a_run_with_crowded_images_is_warned_about(tmp_path):
    """Nine discs cover 17 % of the left images, one large one as much of the right images."""
    v, u = np.mgrid[:200, :200]
    places = {"left": [(i, j) for i in (40, 100, 160) for j in (40, 100, 160)], "right": [(99, 99)]}
    pictures = {camera: np.full((200, 200), 200.0) for camera in places}
    for camera, radius in (("left", 15.5), ("right", 46.5)):
        for x, y in places[camera]:
            pictures[camera][np.hypot(u - x, v - y) < radius] = 20.0
    said = _bubbles_warning(tmp_path / "tank", 200, pictures)
    assert "camera left: bubbles cover 17%" in said and "beyond 10%" in said


def test_a_run_that_is_not_backlit_is_warned_about(tmp_path):
    v, u = np.mgrid[:400, :400]
    pictures = {"left": np.full((400, 400), 200.0), "right": np.full((400, 400), 60.0)}
    for grey in pictures.values():
        for x, y in [(i, j) for i in range(60, 400, 90) for j in range(60, 400, 90)]:
            far = np.hypot(u - x, v - y)
            grey[far < 18.0] = 200.0
            grey[far < 10.0] = 20.0
    said = _bubbles_warning(tmp_path / "tank", 400, pictures)
    assert "camera right: 16 outlines are dark hearts" in said and "camera left" not in said


def test_the_command_prints_json_and_its_exit_code_says_whether_all_is_well(data, tmp_path):
    good = _asked("doctor", str(data), "--json")
    assert good.exit_code == 0, good.output
    content = json.loads(good.output)
    assert {"what", "status", "words", "todo"} == set(content[0])
    bad = _asked("doctor", str(tmp_path / "nowhere"))
    assert bad.exit_code == 1
    assert "FAILURE dataset" in bad.output
    assert "ok      Python" in bad.output
    gone = _asked("doctor", str(data / "runs" / "gone"), "--quiet")
    assert gone.exit_code == 1 and "there is no such run" in gone.output
    quiet = _asked("doctor", str(tmp_path / "nowhere"), "--quiet")
    first, *_, last = quiet.output.splitlines()
    assert first.startswith("FAILURE dataset") and last.endswith("checks ok")


def test_the_time_and_memory_of_a_run_are_estimated(data: Path) -> None:
    checks = list(check_dataset(data / "runs" / "rise"))
    words = next(c.words for c in checks if "tracking takes about" in c.words)
    assert "bubbles in sight: 1;" in words and "smoothing about" in words and "MB" in words
    assert not [c for c in checks if c.what.startswith("run ") and "rise" not in c.what]


@pytest.mark.parametrize(
    "command",
    [("init", ""), ("calibrate", "", "--out", "x"), ("simulate", "rise", "--out="),
     ("batch", "a", ""), ("import", "opencv", "", "--out", "x")],
    ids=" ".join,
)  # fmt: skip
def test_an_empty_name_of_a_folder_is_refused(
    command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, list(command))
    assert done.exit_code == 2
    named = "--out" if "--out=" in command else "an argument"
    assert f"{named} is empty: leave it out" in " ".join(done.output.split())
    assert not list(tmp_path.iterdir())


def test_the_current_folder_can_be_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(app, ["init", "."]).exit_code == 0
    assert (tmp_path / "rig.toml").is_file()
