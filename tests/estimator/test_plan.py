"""Plans of experiments: against exact posteriors of another program, and as a command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import telerig
from telerig.command_options import Experiment
from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.estimator.plan import (
    centre_sigma_px,
    check,
    expect,
    expected_calibration,
    plan_words,
    planned_problem,
    variants,
)
from telerig.io.results.calibration_words import NO_COVARIANCE
from telerig.io.rig_file.description import RigDescription
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.scripts.main import app

pytestmark = pytest.mark.usefixtures("without_advice")

S2 = Experiment(
    500.0, 1.5, sigma_px=0.5, rise_mm_s=280.0, zigzag_mm=1.77, shake_hz=20.0,
    shake_mm=0.2 / np.sqrt(2),
)  # fmt: skip


@pytest.fixture(scope="module")
def tank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plan") / "tank"
    config = run_preset("S2", frames=12)
    config = replace(config, stage=replace(config.stage, accelerometers=()))
    telerig.simulate(config, rng=np.random.default_rng(0), out=folder, images=False)
    return folder


@pytest.fixture(scope="module")
def rig(tank: Path) -> RigDescription:
    """An encoder of 1 µm whose scale is exact."""
    described = telerig.load_dataset(tank).rig
    assert described.stage is not None
    exact = replace(described.stage, position_sigma_mm=0.001, scale_sigma=0.0)
    return replace(described, stage=exact)


@pytest.fixture(scope="module")
def calibration() -> telerig.Calibration:
    cameras = true_cameras(run_preset("S2").calibration)
    return calibration_from_cameras(list(cameras.values()))


@pytest.mark.parametrize(
    ("added", "position_um", "velocity_mm_s", "verdict"),
    [
        ({}, 39.0, 3.9, "UNRESOLVED"),
        pytest.param({"bubbles": 5}, 32.0, 3.1, "PARTIAL", marks=pytest.mark.slow),
        pytest.param({"arms": True}, 14.7, 2.23, "RESOLVED", marks=pytest.mark.slow),
        ({"marks": 4}, 13.9, 2.23, "RESOLVED"),
    ],
)
def test_the_exact_posteriors_of_an_independent_smoother(
    rig: RigDescription, calibration: telerig.Calibration, added: dict[str, int],
    position_um: float, velocity_mm_s: float, verdict: str,
) -> None:  # fmt: skip
    """Of scenario S2 along the vertical: benchmarks/results/shake_table.md."""
    found = expect(rig, calibration, replace(S2, **added))
    assert found.position_um[1] == pytest.approx(position_um, rel=0.08)
    assert found.velocity_mm_s[1] == pytest.approx(velocity_mm_s, rel=0.08)
    assert found.known_um[1] == pytest.approx(12.8, rel=0.04)
    assert found.verdict == verdict


def test_marks_are_where_the_cameras_look(
    rig: RigDescription, calibration: telerig.Calibration
) -> None:
    problem = planned_problem(rig, calibration, replace(S2, marks=4), 0.5)
    seen = problem.references
    counts = pd.Series(1, index=[seen.frame, seen.camera]).groupby(level=[0, 1]).sum()
    assert counts.between(3, 5).all() and len(counts) == 2 * S2.frames
    size = calibration.cameras[0].image_size_px
    assert (seen.uv_px >= 0).all() and (seen.uv_px < size).all()


def test_a_bubbles_centre_is_worse_the_smaller_its_picture_and_the_larger_its_body() -> None:
    sizes = [centre_sigma_px(d) for d in (4.0, 10.0, 40.0, 80.0)]
    assert sizes[0] < 0.03 and sizes[-1] == pytest.approx(0.4, rel=0.01)


def test_the_expected_calibration_is_the_usual_one(tank: Path) -> None:
    data = telerig.load_dataset(tank)
    real, expected = telerig.calibrate(data), expected_calibration(data.rig)
    name = "right.scale_px_per_mm"
    assert expected.sd(name) == pytest.approx(real.sd(name), rel=0.25)


@pytest.mark.parametrize(
    "turns", [{"right": (90.0, 0.0, 0.0)}, {"middle": (0.0, 60.0, 0.0), "right": (0.0, 110.0, 0.0)}]
)
def test_the_expected_calibration_has_the_cameras_where_rig_toml_says(
    turns: dict[str, tuple[float, float, float]], rig: RigDescription
) -> None:
    """A camera that looks from above, or three, of which not all see every view."""
    left = rig.cameras["left"]
    cameras = {name: replace(left, name=name) for name in ("left", *turns)}
    found = expected_calibration(replace(rig, cameras=cameras, rotvec_from_first_deg=turns))
    assert found.verdict["status"] == "GOOD", found.verdict
    for name, turn in turns.items():
        rotvec_deg = np.degrees(found.camera(name).camera_from_rig.rotvec_rad)
        np.testing.assert_allclose(rotvec_deg, turn, atol=0.05)
        assert 0 < found.sd(f"{name}.tx_mm") < 0.05


def test_a_target_that_is_too_large_for_every_pair_of_cameras(rig: RigDescription) -> None:
    turns = {"middle": (0.0, 60.0, 0.0), "right": (0.0, 110.0, 0.0)}
    cameras = {name: replace(rig.cameras["left"], name=name) for name in ("left", *turns)}
    large = replace(rig.target, pitch_mm=(60.0, 60.0))
    described = replace(rig, cameras=cameras, rotvec_from_first_deg=turns, target=large)
    with pytest.raises(InputError, match="no two cameras can see one side") as caught:
        expected_calibration(described)
    assert "smaller target" in str(caught.value) and "tilt_deg" not in str(caught.value)


def test_variants_add_only_what_is_missing(rig: RigDescription) -> None:
    assert "an accelerometer on each arm" in variants(rig, S2)
    assert list(variants(rig, replace(S2, arms=True)))[:2] == ["as planned", "4 marks in each view"]
    large = replace(S2, bubbles=20, rate_hz=1000.0, seconds=1.0)
    assert not {"twice the frame rate", "four more bubbles"} & set(variants(rig, large))


@pytest.mark.parametrize(
    "wrong",
    [{"rate_hz": np.nan}, {"seconds": 0.001}, {"bubbles": 0}, {"marks": -1}, {"shake_mm": -1}],
)
def test_impossible_experiments(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="plan"):
        check(replace(S2, **wrong))


@pytest.mark.parametrize(
    ("field", "flag"),
    [(name, one.flags[0]) for name, one in Experiment.settings().items() if one.flags[0]],
)
def test_every_option_of_the_command_reaches_the_plan(tank: Path, field: str, flag: str) -> None:
    result = CliRunner().invoke(app, ["plan", str(tank), "--quiet", f"{flag}=-1"])
    said = "-1 bubbles in" if field == "bubbles" else f"{field} is -1"
    assert result.exit_code == 2 and said in result.output


def test_a_rig_that_does_not_shake(rig: RigDescription, calibration: telerig.Calibration) -> None:
    """Two bubbles alone would not show that it stands still."""
    for bubbles, verdict in ((2, "UNRESOLVED"), (3, "RESOLVED")):
        quiet = replace(S2, shake_mm=0.0, seconds=0.2, bubbles=bubbles)
        still = expect(rig, calibration, quiet)
        assert still.verdict == verdict
        np.testing.assert_allclose(still.position_um, still.known_um, rtol=1e-3)
        assert NO_COVARIANCE in plan_words(rig, calibration, {"still": quiet}, {"still": still})


def test_the_command_says_what_to_add(tank: Path, tmp_path: Path) -> None:
    line = ["plan", str(tank), "--seconds", "0.1", "--quiet", "--out", str(tmp_path / "plan.csv")]
    result = CliRunner().invoke(app, line)
    assert result.exit_code == 0, result.output
    assert "add: 4 marks in each view" in result.output
    table = pd.read_csv(tmp_path / "plan.csv")
    assert list(table["verdict"][:2]) == ["UNRESOLVED", "RESOLVED"]
    assert CliRunner().invoke(app, [*line, "--rate-hz", "0"]).exit_code == 2
    assert CliRunner().invoke(app, ["plan", str(tmp_path)]).exit_code == 2
