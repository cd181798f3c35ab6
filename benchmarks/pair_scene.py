"""Detections of random bubbles in two views 90 degrees apart, with who is who."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.estimator.bubbles.pairing.evidence import Prediction
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

Array = NDArray[np.float64]

SCALE = 20.0
CAMERAS = (
    Camera.create("left", (1280, 800), SCALE),
    Camera.create(
        "right", (1280, 800), SCALE, camera_from_rig=Pose.from_rotvec([0.0, np.pi / 2, 0.0])
    ),
)


@dataclass(frozen=True)
class PairScene:
    """What a run looks like; px unless named otherwise.

    sigma : lowest and highest noise of a detection's centre; the sizes' noise is 0.7 of it.
    size_spread, shape_spread : relative. seen : chance that a view finds a bubble. clutter : mean
    number of detections per view that are no bubble. bias, shake : added to the first view along
    the shared coordinate, for the run and, RMS, for each frame.
    """

    bubbles: int = 20
    sigma: tuple[float, float] = (0.05, 0.2)
    size_spread: float = 0.2
    shape_spread: float = 0.05
    seen: float = 0.97
    clutter: float = 0.5
    bias: float = 0.0
    shake: float = 0.0
    history: bool = False


@dataclass(frozen=True)
class PairFrame:
    """Both tables (column ``bubble``: who it is, negative for clutter) and a prediction."""

    first: pd.DataFrame
    second: pd.DataFrame
    predicted: Prediction | None


def random_frame(scene: PairScene, rng: np.random.Generator) -> PairFrame:
    """One frame of a run; rows in random order."""
    count = scene.bubbles
    points = rng.uniform([-30, -19, -30], [30, 19, 30], (count, 3))
    radius = 16.0 * np.exp(rng.normal(0, scene.size_spread, count))
    flat = np.clip(rng.normal(0, scene.shape_spread, count), -0.3, 0.3)
    offset = scene.bias + rng.normal(0, scene.shake)
    tables = []
    for c, camera in enumerate(CAMERAS):
        sigma = rng.uniform(*scene.sigma, count)
        uv = camera.project(points) + sigma[:, None] * rng.normal(size=(count, 2))
        uv[:, 1] += offset if c == 0 else 0.0
        width = radius * (1 + flat) * np.exp(rng.normal(0, scene.shape_spread / 2, count))
        sides = np.stack([width, radius * (1 - flat)], -1)
        sides = sides + 0.7 * sigma[:, None] * rng.normal(size=(count, 2))
        keep = rng.random(count) < scene.seen
        table = _table(uv, sides, sigma, np.arange(count))[keep]
        wrong = rng.poisson(scene.clutter)
        clutter = _table(
            rng.uniform(0, [1279, 799], (wrong, 2)),
            np.tile(16.0 * np.exp(rng.normal(0, scene.size_spread, (wrong, 1))), 2),
            np.full(wrong, 0.1),
            -1 - np.arange(wrong),
        )
        both = pd.concat([table, clutter]) if wrong else table
        tables.append(both.iloc[rng.permutation(len(both))].reset_index(drop=True))
    predicted = None
    if scene.history:
        sd = 0.05
        guess = points + rng.normal(0, sd, points.shape)
        covariance = np.tile(np.eye(3) * sd**2, (count, 1, 1))
        predicted = Prediction(np.arange(count), guess, covariance, 2 * radius / SCALE)
    return PairFrame(tables[0], tables[1], predicted)


def _table(uv: Array, sides: Array, sigma: Array, bubble: Array) -> pd.DataFrame:
    wide = sides[:, 0] >= sides[:, 1]
    return pd.DataFrame(
        {
            "u_px": uv[:, 0],
            "v_px": uv[:, 1],
            "suu_px2": sigma**2,
            "suv_px2": 0.0,
            "svv_px2": sigma**2,
            "a_px": sides.max(1, initial=0.0),
            "b_px": sides.min(1, initial=np.inf),
            "angle_rad": np.where(wide, 0.0, np.pi / 2),
            "bubble": bubble,
        }
    )
