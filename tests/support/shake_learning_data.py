"""Small runs for learning and verdicts: the simulator's motions seen by two ideal cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoothing.problem.problem import (
    Bubble,
    Mark,
    Observations,
    RigMode,
    ShakeModel,
    SmoothingProblem,
)
from telerig.factors.bubble_motion import BubbleModel, Zigzag
from telerig.io.simulation.run.motion import rig_shake, stochastic_paths
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

Array = NDArray[np.float64]

UP = np.array([0.0, -1.0, 0.0])
CAMERAS = (
    Camera.create("left", (1024, 1024), 10.0),
    Camera.create(
        "right", (1024, 1024), 10.0, camera_from_rig=Pose.from_rotvec([0.0, np.pi / 2, 0.0])
    ),
)
COMMON_HZ, ARM_HZ, BUBBLE_HZ, SWING_HZ = 9.0, 20.0, 13.0, 6.0


def true_model(shake_mm: float = 0.2) -> ShakeModel:
    common, arm = np.sqrt(0.75) * shake_mm, 0.5 * shake_mm
    return ShakeModel(
        bubble=BubbleModel(
            zigzags=(
                Zigzag(SWING_HZ, 0.03, (2.0, 0.0, 2.0)),
                Zigzag(BUBBLE_HZ, 0.03, (0.0, 0.18, 0.0)),
            )
        ),
        modes=(
            RigMode(COMMON_HZ, 0.03, (0.0, common, 0.0), force_hz=None),
            RigMode(ARM_HZ, 0.03, (0.0, arm, 0.0), 0, None),
            RigMode(ARM_HZ, 0.03, (0.0, arm, 0.0), 1, None),
        ),
    )


def run(
    rng: np.random.Generator,
    *,
    bubbles: int = 1,
    seconds: float = 1.5,
    rate_hz: float = 200.0,
    shake_mm: float = 0.2,
    sigma_px: float = 0.3,
    marks: int = 0,
    still: bool = False,
    kept: float = 1.0,
    common_hz: float = COMMON_HZ,
    force_hz: float = 60.0,
    hidden_mm: float = 0.0,
    across_mm: float = 0.0,
) -> tuple[SmoothingProblem, Array, Array]:
    """A problem, the truth (bubbles, F, 3) and the shake (2, F, 3); the stage stands still.

    marks : features of each camera fixed to the tank.  still : bubbles do not move either.
    kept : share of pixels that are not lost.  common_hz, force_hz : of the rig's shake.
    hidden_mm : RMS of one more line of the rig, of the same frequency as the bubbles'.
    across_mm : RMS of the shake along x and z.
    """
    frames = round(seconds * rate_hz)
    t = np.arange(frames) / rate_hz
    shake = rig_shake(
        1 / rate_hz, frames, rng, cameras=2, rms_mm=[across_mm, shake_mm, across_mm],
        frequency_hz=common_hz, arm_ratio=ARM_HZ / COMMON_HZ, force_hz=force_hz,
    ).offset_mm  # fmt: skip
    if hidden_mm > 0:
        shake = shake + rig_shake(
            1 / rate_hz, frames, rng, cameras=2, rms_mm=[0.0, hidden_mm, 0.0],
            frequency_hz=BUBBLE_HZ, common_share=1.0, force_hz=force_hz,
        ).offset_mm  # fmt: skip
    lab = np.zeros((bubbles, frames, 3))
    if not still:
        path = stochastic_paths(
            1 / rate_hz, frames, rng, rise_mm_s=np.full(bubbles, 10.0), wander_mm_s=10.0,
            wander_tau_s=0.3, height_oscillation=(0.18, BUBBLE_HZ, 0.03),
            lateral_oscillation=(2.0, SWING_HZ, 0.03),
        )  # fmt: skip
        lab = path.height_mm[..., None] * UP
        lab[..., [0, 2]] += path.lateral_mm
    lab = lab + rng.uniform(-5, 5, (bubbles, 1, 3))
    tracks = tuple(
        Bubble(k, 0, frames - 1, lab[k, 0], lab[k] + rng.normal(0, 0.1, (frames, 3)))
        for k in range(bubbles)
    )
    places = rng.uniform(-20, 20, (2 * marks, 3))
    features = tuple(Mark(f"m{k}", p + rng.normal(0, 0.1, 3)) for k, p in enumerate(places))
    fixed = np.broadcast_to(places[:, None], (2 * marks, frames, 3))
    pixels = _pixels(lab, shake, sigma_px, rng, kept, [(0, 1)] * bubbles)
    return (
        SmoothingProblem(
            CAMERAS, t, UP, UP, tracks, pixels,
            marks=features,
            references=_pixels(fixed, shake, 0.1, rng, 1.0, [(k % 2,) for k in range(2 * marks)]),
        ),
        lab,
        shake,
    )  # fmt: skip


def with_comings_and_goings(
    problem: SmoothingProblem, rng: np.random.Generator, frames: int
) -> SmoothingProblem:
    """The problem, each track cut into several with a gap of a frame between them."""
    bubbles: list[Bubble] = []
    item = np.full(len(problem.observations), -1)
    seen, last = problem.observations, len(problem.t_s)
    for bubble in problem.bubbles:
        first = 0
        while first < last - 3:
            end = min(last, first + int(frames * rng.uniform(0.5, 1.5)))
            inside = (seen.frame >= first) & (seen.frame < end) & (seen.item == bubble.particle)
            item[inside] = len(bubbles)
            guess = bubble.guess_mm[first:end]
            bubbles.append(Bubble(len(bubbles), first, end - 1, guess[0], guess))
            first = end + 1
    kept = replace(seen, item=item).of(item >= 0)
    return replace(problem, bubbles=tuple(bubbles), observations=kept)


def _pixels(
    lab: Array, shake: Array, sigma_px: float, rng: np.random.Generator, kept: float,
    cameras: list[tuple[int, ...]],
) -> Observations:  # fmt: skip
    parts = []
    for k, place in enumerate(lab):
        for c in cameras[k]:
            uv = CAMERAS[c].project(place - shake[c]) + sigma_px * rng.normal(
                size=place[:, :2].shape
            )
            some = np.flatnonzero(rng.random(len(place)) < kept)
            whole = np.full(len(some), k), some, np.full(len(some), c), uv[some]
            parts.append(whole)
    if not parts:
        return Observations.none()
    item, frame, camera, uv = (np.concatenate(p) for p in zip(*parts))
    return Observations(item, frame, camera, uv, np.tile(sigma_px**2 * np.eye(2), (len(uv), 1, 1)))
