"""Posterior standard deviations on the vertical axis against the design's independent table.

Means do not matter to them, so the measurements are all those of a rig and bubble at rest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from telerig.estimator.smoothing.graph.solve import Options, solve
from telerig.estimator.smoothing.problem.problem import (
    Accelerometer,
    Bubble,
    CarriageModel,
    Mark,
    Observations,
    RigMode,
    ShakeModel,
    SmoothingProblem,
    Stage,
)
from telerig.factors.bubble_motion import BubbleModel, Zigzag
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

UP = np.array([0.0, -1.0, 0.0])
RATE_HZ, FRAMES, SIGMA_PX, MARK_S = 500.0, 750, 0.5, 0.3
RMS = 0.2 / np.sqrt(2)


def shake_model(frequency_hz: float) -> ShakeModel:
    """The vertical axis of scenarios S1 and S2; across it little shakes, to keep the test short."""
    modes = [RigMode(frequency_hz, 0.03, (0, RMS * np.sqrt(0.75), 0))]
    modes += [RigMode(1.6 * frequency_hz, 0.03, (0, RMS * 0.5, 0), camera=j) for j in range(2)]
    bubble = BubbleModel(zigzags=(Zigzag(12.0, 0.03, (0, 0.177, 0)),))
    return ShakeModel(bubble=bubble, modes=tuple(modes), encoder_sigma_mm=0.001)


def scenario(bubbles: int, *, sensors: bool = False, marks: bool = False) -> SmoothingProblem:
    turn = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    pair = (
        Camera.create("left", (1024, 1024), 10.0),
        Camera.create("right", (1024, 1024), 10.0, camera_from_rig=Pose(turn, np.zeros(3))),
    )
    t = np.arange(FRAMES) / RATE_HZ
    zero, frames = np.zeros(3), np.arange(FRAMES)
    item = np.repeat(np.arange(bubbles), 2 * FRAMES)
    camera = np.tile(np.repeat([0, 1], FRAMES), bubbles)
    centre = np.full((len(item), 2), 511.5)
    noise = np.tile(np.eye(2) * SIGMA_PX**2, (len(item), 1, 1))
    pixels = Observations(item, np.tile(frames, 2 * bubbles), camera, centre, noise)
    references, features = Observations.none(), ()
    if marks:
        block = (frames / RATE_HZ / MARK_S).astype(int)
        of = [4 * (2 * block + j) + m for j in range(2) for m in range(4)]
        where = np.concatenate(of)
        seen_by = np.repeat([0, 1], 4 * FRAMES)
        references = Observations(
            where, np.tile(frames, 8), seen_by, np.full((len(where), 2), 511.5),
            np.tile(0.01 * np.eye(2), (len(where), 1, 1)),
        )  # fmt: skip
        features = tuple(Mark(str(i), zero, 100.0) for i in range(where.max() + 1))
    accelerometers = ()
    if sensors:
        grid = np.arange(round(FRAMES / RATE_HZ * 2000)) / 2000
        rest = np.tile(9806.65 * UP, (len(grid), 1))
        sigma = 22.5 * 9.80665e-3 * np.sqrt(1000)
        accelerometers = tuple(
            Accelerometer(str(j), j, grid, rest, np.eye(3), sigma) for j in range(2)
        )
    every = tuple(Bubble(k, 0, FRAMES - 1, zero, np.zeros((FRAMES, 3))) for k in range(bubbles))
    grid = np.arange(round(FRAMES / RATE_HZ * 1000)) / 1000
    stage = Stage(grid, np.zeros(len(grid)))
    return SmoothingProblem(
        pair, t, UP, UP, every, pixels, stage, accelerometers, features, references
    )


SERVO = CarriageModel("force", acceleration_rms_mm_s2=1e-2, servo=(0.1, 15.0, 0.3))


@pytest.mark.parametrize(
    ("frequency_hz", "information", "position_um", "velocity_mm_s"),
    [
        (20.0, "one bubble", 39, 3.9),
        (20.0, "arm accelerometers", 14.7, 2.23),
        (20.0, "references", 13.9, 2.23),
        (20.0, "oracle", 12.8, 2.23),
        (20.0, "five bubbles", 32, 3.1),
        (8.0, "one bubble", 68, 4.8),
        (8.0, "five bubbles", 51, 3.9),
        (8.0, "arm accelerometers", 15.8, 2.23),
        (8.0, "references", 14.3, 2.23),
    ],
)
def test_vertical_standard_deviations_are_those_of_the_table(
    frequency_hz: float, information: str, position_um: float, velocity_mm_s: float
) -> None:
    model = shake_model(frequency_hz)
    if information == "oracle":
        model = model.without_shake()
    if information == "arm accelerometers":
        model = replace(model, carriage=SERVO)
    given = scenario(
        5 if information == "five bubbles" else 1,
        sensors=information == "arm accelerometers",
        marks=information == "references",
    )
    solution = solve(given, model, Options(robust=False))
    found = solution.covariances
    assert found is not None
    layout, middle = solution.graph.bubble, slice(FRAMES // 10, FRAMES - FRAMES // 10)

    def rms(row: np.ndarray) -> float:
        variance = np.einsum("i,fij,j->f", row, found.bubbles[:FRAMES], row)
        return float(np.sqrt(variance[middle].mean()))

    # the table is rounded to 0.5 µm and 0.05 mm/s where it has two digits
    rounding = 0.5 if position_um == round(position_um) else 0.05
    assert 1e3 * rms(layout.position[1]) == pytest.approx(
        position_um, abs=0.01 * position_um + rounding
    )
    rounding = 0.05 if velocity_mm_s != 2.23 else 0.005
    assert rms(layout.velocity[1]) == pytest.approx(
        velocity_mm_s, abs=0.01 * velocity_mm_s + rounding
    )
