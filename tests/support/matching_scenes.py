"""Two cameras and what they see of known bubbles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.estimator.bubbles.pairing.evidence import Prediction
from telerig.estimator.bubbles.pairing.groups import (
    Groups,
    View,
    candidates_of,
    compared,
    match,
    views_of,
)
from telerig.estimator.bubbles.pairing.learning import default_model
from telerig.estimator.bubbles.pairing.model import RigModel
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

Array = NDArray[np.float64]
Frame = tuple[pd.DataFrame, pd.DataFrame]


def rig(angle_deg: float = 90.0, **lens: float) -> tuple[Camera, Camera]:
    turn = Pose.from_rotvec([0.0, np.radians(angle_deg), 0.0])
    return (
        Camera.create("left", (1280, 800), 20.0, **lens),
        Camera.create("right", (1280, 800), 20.0, camera_from_rig=turn, **lens),
    )


def table(uv: Any, semi_axes: Any = 16.0, sigma: Any = 0.1, angle: Any = 0.0) -> pd.DataFrame:
    uv = np.asarray(uv, float).reshape(-1, 2)
    a, b = np.broadcast_to(np.asarray(semi_axes, float), (len(uv), 2)).T
    return pd.DataFrame(
        {
            "u_px": uv[:, 0], "v_px": uv[:, 1], "suu_px2": np.square(sigma), "suv_px2": 0.0,
            "svv_px2": np.square(sigma), "a_px": a, "b_px": b, "angle_rad": angle,
        }
    )  # fmt: skip


def views(
    first: pd.DataFrame, second: pd.DataFrame, cameras: tuple[Camera, Camera]
) -> tuple[View, View]:
    one, two = views_of((first, second), default_model(cameras))
    return one, two


def geometry(first: pd.DataFrame, second: pd.DataFrame, cameras: tuple[Camera, Camera]) -> Any:
    """Of each of N1 first with each of N2 second detections: arrays (N1, N2)."""
    one, two = views(first, second, cameras)
    return compared(cameras, one.take(np.s_[:, None]), two.take(None))


def match_tables(
    tables: Sequence[pd.DataFrame], model: RigModel, predicted: Prediction | None = None
) -> Groups:
    """The groups of one frame, from the tables of all cameras."""
    _, _, ((groups, rays),) = candidates_of([tables], model)
    return match(groups, rays, model, predicted)[1]


def groups_of(tables: Sequence[pd.DataFrame], model: RigModel, rows: NDArray[np.int64]) -> Groups:
    """Groups of given rows of all cameras' tables."""
    return Groups.of(model, views_of(tables, model), rows)


def frame(
    rng: np.random.Generator,
    count: int = 20,
    *,
    sigma: float = 0.1,
    spread: float = 0.2,
    shift: Any = 0.0,
    seen: float = 0.97,
    clutter: float = 0.5,
    at: Array | None = None,
) -> tuple[Frame, Array, Array]:
    """Tables with a column ``bubble``, points and radii (mm)."""
    points = rng.uniform([-30, -19, -30], [30, 19, 30], (count, 3)) if at is None else at
    count = len(points)
    radius = 16.0 * np.exp(rng.normal(0, spread, count))
    tables = []
    for c, camera in enumerate(rig()):
        uv = camera.project(points) + sigma * rng.normal(size=(count, 2))
        uv[:, 1] += shift if c == 0 else 0.0
        size = radius[:, None] * (1 + 0.02 * rng.normal(size=(count, 1))) + [0.2, 0.0]
        size = size + 0.7 * sigma * rng.normal(size=(count, 1))
        good = table(uv, size, sigma).assign(bubble=np.arange(count))[rng.random(count) < seen]
        number = rng.poisson(clutter)
        wrong = table(rng.uniform(0, [1279, 799], (number, 2)), 16.0, sigma).assign(bubble=-1)
        both = pd.concat([good, wrong])
        tables.append(both.iloc[rng.permutation(len(both))])
    return (tables[0], tables[1]), points, radius / 20.0


def truth(tables: Frame, pairs: Any) -> NDArray[np.bool_]:
    who = [t["bubble"].to_numpy() for t in tables]
    return np.asarray(
        (who[0][pairs.rows[:, 0]] >= 0) & (who[0][pairs.rows[:, 0]] == who[1][pairs.rows[:, 1]])
    )


def recall_and_precision(frames: list[Frame], matches: list[Any]) -> tuple[float, float]:
    right = sum(int(truth(f, m).sum()) for f, m in zip(frames, matches))
    there = sum(len(np.intersect1d(a.bubble[a.bubble >= 0], b.bubble)) for a, b in frames)
    return right / there, right / sum(len(m) for m in matches)
