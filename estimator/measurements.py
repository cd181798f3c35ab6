"""From a table of dots to a `Problem`: indices, priors, handedness."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.errors import CalibrationError, InputError
from telerig.estimator.initial import image_maps
from telerig.estimator.problem import Problem
from telerig.rig.camera import Camera
from telerig.rig.target import Target

Array = NDArray[np.float64]


def problem_from_dots(dots: pd.DataFrame, cameras: Sequence[Camera], target: Target) -> Problem:
    """A `Problem` with every measured dot, model "none".

    dots : columns view, camera, dot, u_px, v_px, suu_px2, suv_px2, svv_px2.

    Raises InputError for values that are not finite, CalibrationError when there are no dots or
    the dots that set the scale are never seen.
    """
    if len(dots) == 0:
        raise CalibrationError("no dots in any image", todo="run `telerig detect` and look at why")
    names = [c.name for c in cameras]
    table = dots[dots["camera"].isin(names)].sort_values(["view", "camera", "dot"])
    _check_finite(table)
    views = tuple(sorted(table["view"].astype(str).unique(), key=_natural))
    ids = np.unique(table["dot"].to_numpy(np.int64))
    camera = _index(table["camera"], names)
    view = _index(table["view"].astype(str), views)
    order = np.lexsort((table["dot"].to_numpy(), camera, view))
    table = table.iloc[order]
    covariance = np.empty((len(table), 2, 2))
    covariance[:, 0, 0] = table["suu_px2"]
    covariance[:, 1, 1] = table["svv_px2"]
    covariance[:, 0, 1] = covariance[:, 1, 0] = table["suv_px2"]
    sigma = [target.print_sigma_mm, target.print_sigma_mm, target.flatness_sigma_mm]
    return Problem(
        cameras=tuple(cameras),
        target=target,
        views=views,
        dot_ids=ids,
        nominal_mm=target.nominal_mm(ids),
        dot_sigma_mm=np.tile(sigma, (len(ids), 1)),
        view=view[order],
        camera=camera[order],
        dot=np.searchsorted(ids, table["dot"].to_numpy(np.int64)),
        uv_px=table[["u_px", "v_px"]].to_numpy(float),
        covariance_px2=covariance,
        weight=np.ones(len(table)),
        free=tuple(("scale_px_per_mm",) for _ in cameras),
        scale=_scale(target, ids),
        plate_shift=np.zeros((len(views), len(cameras))),
    )


def _index(column: pd.Series[str], names: Sequence[str]) -> NDArray[np.int64]:
    numbers = column.map({name: i for i, name in enumerate(names)})
    return np.asarray(numbers, dtype=np.int64)


def _natural(name: str) -> tuple[int, float, str]:
    return (0, float(name), name) if name.isdigit() else (1, 0.0, name)


def _check_finite(table: pd.DataFrame) -> None:
    columns = ["u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"]
    bad = ~np.isfinite(table[columns].to_numpy(float)).all(1)
    if bad.any():
        row = table[bad].iloc[0]
        raise InputError(
            f"{int(bad.sum())} dot(s) are not finite",
            where=f"view {row['view']}, camera {row['camera']}, dot {row['dot']}",
            todo="remove these rows or measure the dots again",
        )


def _scale(target: Target, ids: NDArray[np.int64]) -> tuple[tuple[int, int], float, float] | None:
    if target.scale_dots is None or target.scale_distance_mm is None:
        return None
    missing = [d for d in target.scale_dots if d not in ids]
    if missing:
        raise CalibrationError(
            f"dot(s) {missing}, whose distance sets the scale, are in no image",
            where="rig.toml [target] scale_dots",
            todo="name two dots that are seen, or leave scale_dots out to trust the nominal pitch",
        )
    a, b = (int(np.searchsorted(ids, d)) for d in target.scale_dots)
    return (a, b), float(target.scale_distance_mm), float(target.scale_sigma_mm)


def handedness(problem: Problem) -> dict[tuple[int, int], int]:
    """(view, camera) -> +1 or -1: the sign of d(u, v) / d(x, y) of each image."""
    maps = image_maps(problem, problem.nominal_mm)
    return {k: int(np.sign(np.linalg.det(m.jacobian))) for k, m in maps.items()}
