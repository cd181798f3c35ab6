"""What marks in the tank show of magnifications, of the travel axis and of the encoder."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from shake_runs import run_of

import telerig
from telerig.estimator.sensors.findings import Code, Finding, SensorError
from telerig.estimator.smoothing.problem.problem import ShakeModel, SmoothingProblem
from telerig.estimator.smoothing.sensor_alignment.mark_motion import MarkMotion
from telerig.estimator.smoothing.smooth import problem_of, with_sensors_aligned
from telerig.rig.camera import Camera

ANGLE = np.deg2rad(3.0)
TURNED = (float(np.sin(ANGLE)), -float(np.cos(ANGLE)), 0.0)


def placed(**changes: Any) -> tuple[SmoothingProblem, list[Finding]]:
    run = run_of("S1", 905)
    inputs = run.inputs("references") | changes
    tracks, calibration = inputs.pop("tracks"), inputs.pop("calibration")
    problem, _, _, known = problem_of(tracks, calibration, **inputs)
    return with_sensors_aligned(problem, known)


def refocused(*cameras: str) -> dict[str, Any]:
    """The calibration, from which the magnifications of some cameras now differ by 1 %."""
    known = run_of("S1", 905).calibration

    def of(camera: Camera) -> Camera:
        larger = 1.01 * camera["scale_px_per_mm"]
        return camera.with_parameters(scale_px_per_mm=larger) if camera.name in cameras else camera

    return {"calibration": replace(known, cameras=tuple(map(of, known.cameras)))}


def turned() -> dict[str, Any]:
    rig = run_of("S1", 905).inputs("references")["rig"]
    rig.stage = replace(rig.stage, axis=TURNED)
    return {"rig": rig}


def stretched() -> dict[str, Any]:
    """An encoder that reads 1 % too much."""
    stage = run_of("S1", 905).inputs("references")["stage"]
    return {"stage": stage.assign(position_mm=1.01 * stage["position_mm"])}


def stating(scale_sigma: float | None) -> dict[str, Any]:
    """A rig whose encoder's scale is stated, or not."""
    rig = run_of("S1", 905).inputs("references")["rig"]
    rig.stage = replace(rig.stage, scale_sigma=scale_sigma)
    return {"rig": rig}


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({}, None),
        (refocused("right"), Code.CAMERA_SCALE),
        (refocused("left", "right"), Code.ENCODER_SCALE),
        (stretched(), Code.ENCODER_SCALE),
        (stretched() | stating(0.005), None),
        (stretched() | stating(None), None),
        (turned(), Code.STAGE_AXIS),
    ],
    ids=["sound", "refocused", "both", "stretched", "stated", "assumed", "turned"],
)
def test_changed_magnifications_a_wrong_scale_and_a_wrong_axis_are_refused(
    changes: dict[str, Any], code: Code | None
) -> None:
    _, found = placed(**changes)
    refusals = [f for f in found if f.code is not None]
    assert [f.code for f in refusals] == [code] * bool(code)
    if code is Code.STAGE_AXIS:
        np.testing.assert_allclose(refusals[0].fix["stage_axis"], [0, -1, 0], atol=2e-3)
    if code is Code.ENCODER_SCALE:
        assert refusals[0].fix["encoder_factor"] == pytest.approx(1 / 1.01, abs=1.5e-3)


def test_a_record_that_ends_early_is_no_encoder_that_is_stuck() -> None:
    """Marks that go on after its end say nothing against it."""
    run = run_of("S1", 905)
    stage = run.stage[run.stage["t_s"] < 0.6 * run.t_s[-1]]
    _, found = placed(stage=stage)
    assert [f.code for f in found if f.code is not None] == []
    assert any("covers 60 % of the frames" in f.words for f in found)


def test_a_given_model_that_holds_the_scale_does_not_hide_it() -> None:
    """The motion is right then, and the origin of the laboratory frame 2.3 mm off."""
    inputs = run_of("S1", 905).inputs("references") | stretched() | stating(None)
    with pytest.raises(SensorError, match=r"0\.9902.*its scale is wrong"):
        telerig.smooth(**inputs, model=ShakeModel())


@pytest.mark.slow
def test_the_regression_knows_its_own_errors() -> None:
    """Shake moves all marks alike for a while: the jackknife leaves out what moved together."""
    off = []
    for seed in range(905, 925):
        run = run_of("S1", seed)
        inputs = run.inputs("references")
        tracks, calibration = inputs.pop("tracks"), inputs.pop("calibration")
        marks = MarkMotion.of(problem_of(tracks, calibration, **inputs)[0])
        assert marks is not None
        gain = marks.gain()
        off.append(float((gain.value[0] - 1) / gain.sd[0]))
    # of Student's t with 11 degrees of freedom the RMS is 1.11 +- 0.2
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_records_that_show_late_images_leave_the_encoder_as_late() -> None:
    """Images 10 ms late against the sensors are as late against an encoder beside these."""
    run = run_of("S1", 905)
    tracks, late = run.tracks[run.tracks["frame"] >= 5].copy(), 5
    tracks["frame"] -= late
    t = run.t_s[:-late]
    tracks["t_s"] = t[tracks["frame"]]
    inputs = run.inputs("arms") | {"tracks": tracks, "t_s": t}
    calibration = inputs.pop("calibration")
    problem, _, _, known = problem_of(inputs.pop("tracks"), calibration, **inputs)
    placed, _ = with_sensors_aligned(problem, known)
    assert problem.stage is not None and placed.stage is not None
    assert problem.stage.delay_sigma_s == pytest.approx(0.002)
    assert placed.stage.delay_sigma_s == pytest.approx(0.0102, abs=5e-4)
