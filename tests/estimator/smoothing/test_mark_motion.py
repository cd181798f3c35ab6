"""What marks in the tank show of magnifications, of the travel axis and of the encoder."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from shake_runs import run_of

from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.smoothing.problem.mark_motion import MarkMotion
from telerig.estimator.smoothing.problem.problem import SmoothingProblem
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


@pytest.mark.parametrize(
    ("changes", "code"),
    [({}, None), (refocused("right"), Code.CAMERA_SCALE), (turned(), Code.STAGE_AXIS)],
    ids=["sound", "refocused", "turned"],
)
def test_a_changed_magnification_and_a_wrong_axis_are_refused(
    changes: dict[str, Any], code: Code | None
) -> None:
    _, found = placed(**changes)
    refusals = [f for f in found if f.code is not None]
    assert [f.code for f in refusals] == [code] * bool(code)
    if code is Code.STAGE_AXIS:
        np.testing.assert_allclose(refusals[0].fix["stage_axis"], [0, -1, 0], atol=2e-3)


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
