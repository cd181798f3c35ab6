"""A trial recording: planted troubles are named, each by its check, and sound ones are not."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

import telerig
from telerig.command_options import Experiment
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.estimator.doctor import recording
from telerig.estimator.doctor.recording import Recording, check_recording, sensor_shake
from telerig.estimator.sensors.findings import Code, Finding
from telerig.io.dataset.run import RunData
from telerig.io.report import trial as trial_page
from telerig.io.report.page.figures import Figure
from telerig.io.report.page.page import Page
from telerig.io.results.smoothing import Verdict
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.io.simulation.simulate import simulate
from telerig.scripts.main import app

Image = NDArray[np.unsignedinteger[Any]]


@dataclass
class Shown:
    """Images (None for missing ones) in place of a run's."""

    images: list[Image | None]
    rig: None = None

    @property
    def frame_count(self) -> int:
        return len(self.images)

    def image(self, camera: str, frame: int) -> Image | None:
        return self.images[frame]


def pictures(level: float = 170.0, edge: float = 1.0, count: int = 30) -> list[Image | None]:
    """A disc that falls before a backlight whose left edge has a share of the right's."""
    rng = np.random.default_rng(3)
    light = level * np.linspace(edge, 1.0, 128)[None, :] * np.ones((128, 1))
    out: list[Image | None] = []
    for frame in range(count):
        image = light + rng.normal(0, 2, light.shape)
        cv2.circle(image, (64, 30 + 2 * frame), 12, 10, -1, cv2.LINE_AA)
        out.append(np.clip(image, 0, 255).astype(np.uint8))
    return out


def without(images: list[Image | None], frame: int) -> list[Image | None]:
    return [*images[:frame], None, *images[frame + 1 :]]


def twice(images: list[Image | None], frame: int) -> list[Image | None]:
    return [*images[:frame], images[frame - 1], *images[frame + 1 :]]


@pytest.mark.parametrize(
    ("images", "failed"),
    [
        (pictures(), []),
        (pictures(30.0), ["light"]),
        (pictures(300.0), ["saturation"]),
        (pictures(edge=0.1), ["evenness"]),
        (without(pictures(), 7), ["missing frames"]),
        (twice(pictures(), 7), ["doubled frames"]),
        ([None, None], ["images"]),
    ],
)
def test_light_and_frames_of_a_camera(images: list[Image | None], failed: list[str]) -> None:
    run: Any = Shown(images)
    found = [c for c in recording._images(run, "left") if c.status == "failure"]
    assert [c.what.removesuffix(" of left") for c in found] == failed
    assert all(c.todo for c in found)


def of_12_bits(level: float, brightest: float = 0.0) -> list[Image | None]:
    """The pictures at a grey level of 4095, in 16 bits; a pixel of frame 2 may be brighter."""
    images = [image.astype(np.uint16) * 4 for image in pictures(level / 4) if image is not None]
    images[2][0, 0] = max(brightest, images[2][0, 0])
    return list(images)


@pytest.mark.parametrize(
    ("images", "status", "words"),
    [
        (of_12_bits(750), "note", "if the camera has 10 bits, .* of 12 bits it would be 18"),
        (of_12_bits(750, 4095), "failure", "at 18.* % of full scale"),
        (of_12_bits(120), "failure", "at 11.* % of full scale"),
        (of_12_bits(850, 1023), "ok", "at 8.* % of full scale"),
    ],
)
def test_a_depth_that_the_images_do_not_tell_is_said(
    images: list[Image | None], status: str, words: str
) -> None:
    """The depth is judged over all images of the camera, also those not looked at otherwise."""
    run: Any = Shown(images)
    (light,) = [c for c in recording._images(run, "left") if c.what == "light of left"]
    assert light.status == status and re.search(words, light.words), light.words


def test_frames_that_the_times_lack_are_counted() -> None:
    t_s = np.delete(np.arange(100) / 250, [20, 21, 50])
    (check,) = recording._steps(SimpleNamespace(t_s=t_s, frame_count=97))  # type: ignore[arg-type]
    assert check.status == "failure" and check.words.startswith("3 frames of 100")


def test_the_shake_by_an_accelerometer_is_that_of_a_sine() -> None:
    t = np.arange(8000) / 2000
    turn = 2 * np.pi * 31.0
    table = pd.DataFrame({"t_s": t, "sensor": "arm", "ax_m_s2": 0.0, "az_m_s2": 0.0})
    table["ay_m_s2"] = 9.81 + 1e-3 * 0.5 * turn**2 * np.sin(turn * t)
    found = sensor_shake(SimpleNamespace(accelerometers=table))  # type: ignore[arg-type]
    assert found == (pytest.approx(0.5 / np.sqrt(2), rel=0.02), pytest.approx(31.0))


def test_only_refused_sensors_are_left_out() -> None:
    table = pd.DataFrame({"sensor": ["a", "b", "ab"], "t_s": 0.0})
    run: Any = Records(table, pd.DataFrame())
    axes = Finding("", "x.csv, sensor b", "", Code.SENSOR_AXES)
    assert list(recording._without_refused(run, [axes]).accelerometers["sensor"]) == ["a", "ab"]
    encoder = Finding("", "stage.csv", "", Code.ENCODER_SIGN)
    assert recording._without_refused(run, [encoder]).stage is None


@dataclass(frozen=True)
class Records:
    accelerometers: pd.DataFrame | None
    stage: pd.DataFrame | None
    position_mm: None = None


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunData, telerig.Calibration]:
    """Three bubbles from tables, with encoder and a sensor on each arm."""
    base = run_preset("rise")
    config = replace(
        base, frames=150, frame_rate_hz=250.0, bubbles=3,
        stage=replace(base.stage, accelerometers=("left", "right")),
        bubble=replace(base.bubble, d_eq_mm=(3.0, 4.0)),
        motion=replace(base.motion, spread=(0.3, 0.3)),
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("trial") / "rise"
    simulate(config, rng=np.random.default_rng(5), out=folder, images=False)
    cameras = list(true_cameras(config.calibration).values())
    return telerig.load_run(folder / "runs" / "rise"), calibration_from_cameras(cameras)


def failed(found: Recording) -> list[str]:
    return [check.what for check in found.checks if check.status == "failure"]


def test_a_sensor_that_cannot_be_read_costs_no_other_check(
    trial: tuple[RunData, telerig.Calibration],
) -> None:
    """It stopped after its first sample."""
    run, calibration = trial
    assert run.accelerometers is not None
    once = run.accelerometers.groupby("sensor").head(1).reset_index(drop=True)
    found = check_recording(replace(run, accelerometers=once), calibration)
    assert failed(found) == ["sensors"]
    (check,) = [check for check in found.checks if check.what == "sensors"]
    assert "has 1 sample" in check.words and "leave the sensor out" in check.todo
    assert {"times of the frames", "motion"} <= {check.what for check in found.checks}


@pytest.mark.slow
def test_a_sound_recording_passes_and_expects_its_verdict(
    trial: tuple[RunData, telerig.Calibration],
) -> None:
    found = check_recording(*trial)
    assert failed(found) == ([] if found.expected == "RESOLVED" else ["expected verdict"])
    assert found.smoothing is not None
    assert found.expected == found.smoothing.verdict["verdict"]
    assert {"synchrony", "cameras since calibration", "sensors", "expected verdict"} <= {
        check.what for check in found.checks
    }


@pytest.mark.parametrize(
    ("own", "plans", "expected"),
    [
        ("PARTIAL", ("UNRESOLVED", "PARTIAL"), "RESOLVED"),
        ("PARTIAL", ("PARTIAL", "PARTIAL"), "PARTIAL"),
        ("UNRESOLVED", ("RESOLVED", "UNRESOLVED"), "UNRESOLVED"),
        ("CONTRADICTED", ("PARTIAL", "RESOLVED"), "CONTRADICTED"),
        ("RESOLVED", ("PARTIAL", "PARTIAL"), "RESOLVED"),
    ],
)
def test_the_plan_moves_the_recordings_own_verdict(
    own: str, plans: tuple[str, str], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run: Any = SimpleNamespace(rig=1)
    smoothing: Any = SimpleNamespace(verdict={"verdict": own})
    short = Experiment(rate_hz=100.0, seconds=1.0)
    verdicts = {1.0: plans[0], 5.0: plans[1]}
    monkeypatch.setattr(recording, "_planned", lambda *_: short)
    monkeypatch.setattr(recording, "_recorded_rig", lambda *_: None)
    monkeypatch.setattr(
        recording, "expect",
        lambda _, __, plan: SimpleNamespace(verdict=Verdict(verdicts[plan.seconds])),
    )  # fmt: skip
    assert recording._expected(run, run, smoothing, run, 5.0) == expected


def test_a_noise_density_that_is_not_stated_is_no_fault() -> None:
    finding = Finding("estimated", "x.csv, sensor a", "give it", is_fault=False)
    assert recording._of_sensor(finding).status == "note"
    assert recording._of_sensor(replace(finding, is_fault=True)).status == "failure"


def test_without_three_frames_in_a_row_there_is_no_speed() -> None:
    assert recording._exposure(float("nan")).status == "note"


def in_g(run: RunData) -> RunData:
    assert run.accelerometers is not None
    columns = ["ax_m_s2", "ay_m_s2", "az_m_s2"]
    table = run.accelerometers
    return replace(run, accelerometers=table.assign(**{c: table[c] / 9.80665 for c in columns}))


def dead(run: RunData) -> RunData:
    assert run.accelerometers is not None
    return replace(run, accelerometers=run.accelerometers.assign(ay_m_s2=0.0))


def late(run: RunData) -> RunData:
    """The right camera's detections are those of the frame after."""
    table = run.detections
    assert isinstance(table, pd.DataFrame)
    right = table["camera"] == "right"
    shifted = table.assign(frame=table["frame"] - right.astype(int))
    return replace(run, detections=shifted[shifted["frame"] >= 0].reset_index(drop=True))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "named"), [(in_g, "sensors"), (dead, "sensors"), (late, "synchrony")]
)
def test_planted_troubles_are_named(
    trial: tuple[RunData, telerig.Calibration],
    plant: Callable[[RunData], RunData],
    named: str,
) -> None:
    run, calibration = trial
    assert named in failed(check_recording(plant(run), calibration))


@pytest.mark.slow
def test_the_command_looks_at_a_calibrated_run_and_ends_with_1_for_a_trouble(
    tank_copy: Path,
) -> None:
    run = tank_copy / "runs" / "rise"
    file = run / "frames.csv"
    rows = file.read_text().splitlines()
    late = [f"{r.split(',')[0]},{float(r.split(',')[1]) + 0.05}" for r in rows[12:]]
    file.write_text("\n".join([*rows[:12], *late]) + "\n")
    result = CliRunner().invoke(app, ["doctor", str(run), "--json"])
    assert result.exit_code == 1
    checks = {c["what"]: c["status"] for c in json.loads(result.output)}
    assert checks["times of the frames"] == "failure" and checks["motion"] == "ok"
    assert {"shake of left", "expected verdict"} <= set(checks)
    page = (tank_copy / "results" / "rise" / "trial.html").read_text(encoding="utf-8")
    assert 'class="verdict rejected"' in page and "Spectrum of the shake of camera" not in page
    assert page.count("data:image/svg+xml") == 2


def test_the_page_names_the_axis_that_rig_toml_says_is_up(
    tank_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = tank_copy / "rig.toml"
    lines = rig.read_text(encoding="utf-8").splitlines()
    lines = [line for line in lines if not line.startswith("up_left")]
    lines.insert(lines.index("[stage]") + 1, "up_left = [0.0, 0.0, 1.0]")
    rig.write_text("\n".join(lines) + "\n", encoding="utf-8")
    shake = pd.DataFrame({"t_s": [0.0]})
    pages: list[Page] = []

    def trial(run: RunData, *_: Any, **__: Any) -> Any:
        return SimpleNamespace(checks=(), tracks=None, smoothing=SimpleNamespace(shake=shake))

    monkeypatch.setattr(recording, "check_recording", trial)
    monkeypatch.setattr(trial_page, "render_page", lambda page: pages.append(page) or "")
    CliRunner().invoke(app, ["doctor", str(tank_copy / "runs" / "rise")])
    (page,) = pages
    draws = [one.draw for one in page.look if isinstance(one, Figure)]
    assert len(draws) == 4
    assert {draw.keywords.get("up") for draw in draws if isinstance(draw, partial)} == {"z"}


def test_a_run_without_a_calibration_is_told_so(tank_copy: Path) -> None:
    (tank_copy / "results" / "calibration" / "calibration.json").unlink()
    result = CliRunner().invoke(app, ["doctor", str(tank_copy / "runs" / "rise"), "--json"])
    (check,) = [c for c in json.loads(result.output) if c["what"] == "trial recording"]
    assert check["status"] == "note" and check["todo"]
