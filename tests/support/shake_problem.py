"""The scenarios of `shake_cases` as problems of the product's smoother, true hyper-parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from shake_cases import (
    ARM_RATIO,
    BIAS_SIGMA,
    DAMPING,
    ENCODER_MM,
    FORCE_HZ,
    MARK_PX,
    MARKS,
    MM_PER_PX,
    SAMPLE_HZ,
    SAMPLE_SIGMA,
    SERVO,
    WANDER,
    ZIGZAG,
    Runs,
    Scenario,
    mark_generation,
)

from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
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

Array = NDArray[np.float64]

UP = np.array([0.0, -1.0, 0.0])
CENTRE = 511.5
CAMERAS = (
    Camera.create("left", (1024, 1024), 1 / MM_PER_PX),
    Camera.create(
        "right",
        (1024, 1024),
        1 / MM_PER_PX,
        camera_from_rig=Pose.from_rotvec([0.0, np.pi / 2, 0.0]),
    ),
)


def true_model(
    scenario: Scenario,
    information: str,
    *,
    carriage: CarriageModel | None = None,
    lateral: tuple[float, float, float] | None = None,
    lateral_shake: float = 0.0,
) -> ShakeModel:
    """The hyper-parameters with which the runs were made.

    lateral : RMS, Hz, damping of a zigzag across.  lateral_shake : across, over the vertical.
    """
    zigzags = [Zigzag(ZIGZAG[1], ZIGZAG[2], (0.0, ZIGZAG[0], 0.0))]
    if lateral is not None:
        zigzags.append(Zigzag(lateral[1], lateral[2], (lateral[0], 0.0, lateral[0])))

    def along(rms: float) -> tuple[float, float, float]:
        return lateral_shake * rms, rms, lateral_shake * rms

    modes = [RigMode(scenario.hz, DAMPING, along(scenario.common_mm), CARRIAGE, FORCE_HZ)]
    modes += [
        RigMode(ARM_RATIO * scenario.hz, DAMPING, along(scenario.own_mm), j, FORCE_HZ)
        for j in range(2)
    ]
    if carriage is None:
        carriage = CarriageModel()
        if information in ("arms", "carriage"):
            # a commanded speed, known to be steady, and the servo's error about it
            carriage = CarriageModel("force", acceleration_rms_mm_s2=1e-2, servo=SERVO)
    model = ShakeModel(
        BubbleModel(*WANDER, zigzags=tuple(zigzags)),
        tuple(modes),
        carriage=carriage,
        encoder_sigma_mm=ENCODER_MM,
        name="true",
    )
    return replace(model, modes=()) if information == "oracle" else model


def problem(scenario: Scenario, information: str, runs: Runs, run: int = 0) -> SmoothingProblem:
    """One of the runs as seen from a carriage that stands still but for its servo's error."""
    bubbles = 5 if information == "five" else 1
    frames = np.arange(scenario.frames)
    seen = runs.image[..., run]
    if information == "oracle":
        seen = seen + runs.offset[None, ..., run]
    item, camera, frame = (
        a.ravel() for a in np.meshgrid(np.arange(bubbles), [0, 1], frames, indexing="ij")
    )
    start = np.zeros(3)
    guess = np.zeros((bubbles, scenario.frames, 3))
    guess[..., 1] = -seen[:bubbles].mean(1)
    marks, references = _marks(scenario, runs, run) if information == "references" else ((), None)
    return SmoothingProblem(
        CAMERAS,
        runs.t_s,
        UP,
        UP,
        tuple(Bubble(k, 0, scenario.frames - 1, start, g) for k, g in enumerate(guess)),
        _pixels(item, frame, camera, seen[item, camera, frame], scenario.noise_px),
        Stage(runs.t_s, runs.encoder[:, run]),
        _sensors(information, runs, run),
        marks,
        Observations.none() if references is None else references,
    )


def _pixels(
    item: NDArray[np.int64],
    frame: NDArray[np.int64],
    camera: NDArray[np.int64],
    height_mm: Array,
    sigma_px: float,
) -> Observations:
    uv = np.stack([np.full(len(item), CENTRE), CENTRE - height_mm / MM_PER_PX], -1)
    return Observations(
        item, frame, camera, uv, np.tile(sigma_px**2 * np.eye(2), (len(item), 1, 1))
    )


def _marks(scenario: Scenario, runs: Runs, run: int) -> tuple[tuple[Mark, ...], Observations]:
    generation = mark_generation(runs.t_s)
    frame, camera, which = (
        a.ravel()
        for a in np.meshgrid(np.arange(scenario.frames), [0, 1], np.arange(MARKS), indexing="ij")
    )
    item = (generation[frame] * 2 + camera) * MARKS + which
    height = runs.marks[camera, which, frame, run]
    marks = tuple(Mark(f"m{i}", np.zeros(3), 100.0) for i in range(int(item.max()) + 1))
    return marks, _pixels(item, frame, camera, height, MARK_PX)


def _sensors(information: str, runs: Runs, run: int) -> tuple[Accelerometer, ...]:
    out = []
    for i in {"arms": (0, 1), "carriage": (2,)}.get(information, ()):
        t = runs.t_s[0] + np.arange(runs.felt.shape[1]) / SAMPLE_HZ
        reading = np.zeros((len(t), 3))
        reading[:, 1] = -9806.65 - runs.felt[i, :, run]
        mount = i if information == "arms" else CARRIAGE
        out.append(Accelerometer(f"a{i}", mount, t, reading, np.eye(3), SAMPLE_SIGMA, BIAS_SIGMA))
    return tuple(out)
