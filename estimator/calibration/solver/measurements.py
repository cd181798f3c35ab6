"""Converts a table of dots to a `Problem`, and computes the eccentricity of the measured centres.

Eccentricity: the centre of a dot's image is the image of the dot's centre only for an affine
camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array
from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.solver.problem import Problem
from telerig.factors.calibration import State, pixels
from telerig.rig.camera import Camera
from telerig.rig.target import Target

IMPOSSIBLE_SD = 20.0


def problem_from_dots(dots: pd.DataFrame, cameras: Sequence[Camera], target: Target) -> Problem:
    """Return a `Problem` with every measured dot, in which only the scales of the cameras are free.

    dots : table with the columns view, camera, dot, u_px, v_px, suu_px2, suv_px2, svv_px2.

    Raises InputError for values that are not finite, covariances that are not positive definite,
    cameras or dots that the rig does not have, and rows given twice. Raises CalibrationError if
    there are no dots, if the dots that set the scale are never seen, or if their distance
    contradicts their nominal positions.
    """
    if len(dots) == 0:
        raise CalibrationError(
            "no dots in any image", todo="run `telerig detect` to see why none is found"
        )
    names = [c.name for c in cameras]
    _check(dots, names, target)
    table = dots.sort_values(["view", "camera", "dot"])
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


def _check(table: pd.DataFrame, names: Sequence[str], target: Target) -> None:
    """Raise InputError if some rows cannot be used; the error names the first of them."""
    columns = ["u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"]
    uu, uv, vv = (table[name].to_numpy(float) for name in columns[2:])
    finite = np.isfinite(table[columns].to_numpy(float)).all(1)
    known = ", ".join(repr(n) for n in names)
    faults = {
        "are not finite": (~finite, "remove these rows or measure the dots again"),
        "have no positive definite covariance": (
            finite & ~((uu > 0) & (vv > 0) & (uu * vv > uv**2)),
            "give the standard deviation of each dot's centre",
        ),
        "are of a camera that the rig does not have": (
            ~table["camera"].isin(list(names)).to_numpy(), f"the rig has {known}",
        ),
        "have an id that the target does not have": (
            ~target.known_id(table["dot"]), "compare the target in rig.toml with the table",
        ),
        "are given twice": (
            table.duplicated(["view", "camera", "dot"]).to_numpy(), "keep one of the two rows",
        ),
    }  # fmt: skip
    for what, (bad, todo) in faults.items():
        if bad.any():
            row = table[bad].iloc[0]
            raise InputError(
                f"{int(bad.sum())} of {len(table)} dots {what}",
                where=f"view {row['view']}, camera {row['camera']}, dot {row['dot']}",
                todo=todo,
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
    _check_distance(target)
    a, b = (int(np.searchsorted(ids, d)) for d in target.scale_dots)
    return (a, b), float(target.scale_distance_mm), float(target.scale_sigma_mm)


def _check_distance(target: Target) -> None:
    """Raise CalibrationError if the stated distance is impossible, given the nominal positions and
    their tolerance."""
    assert target.scale_dots is not None and target.scale_distance_mm is not None
    ends = target.nominal_mm(np.array(target.scale_dots))
    nominal = float(np.linalg.norm(ends[1] - ends[0]))
    tolerance = IMPOSSIBLE_SD * np.sqrt(2) * target.print_sigma_mm
    if abs(nominal - target.scale_distance_mm) > tolerance:
        raise CalibrationError(
            f"the distance of dots {target.scale_dots} is {target.scale_distance_mm:g} mm, but "
            f"their nominal places are {nominal:.4g} mm apart and good to "
            f"{target.print_sigma_mm:g} mm each",
            where="rig.toml [target]",
            todo="correct scale_distance_mm, scale_dots or the pitch, or raise print_sigma_mm",
        )


def eccentricity_px(problem: Problem, state: State, rings: int = 2, spokes: int = 8) -> Array:
    """Return the centre of area of each projected disc minus the projection of its centre (M, 2),
    in px.

    The result has one row for each of the M measured dots. Each disc is sampled at ``rings`` radii
    (Gauss-Legendre points in r^2) and ``spokes`` equal angles. Each sample is weighted by the area
    that it covers in the image.
    """
    obs = problem.unweighted()
    radius = problem.target.diameter_mm(problem.dot_ids) / 2
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    centre = pixels(state, obs, problem.rho_mm)
    top, area = np.zeros_like(centre), np.zeros(len(centre))
    step = 1e-3 * float(radius.min())
    for node, weight in zip((nodes + 1) / 2, weights / 2):
        for angle in 2 * np.pi * np.arange(spokes) / spokes:
            reach = np.sqrt(node) * np.array([np.cos(angle), np.sin(angle), 0.0])
            moved = [
                pixels(_shifted(state, radius[:, None] * reach + extra), obs, problem.rho_mm)
                for extra in (np.zeros(3), [step, 0, 0], [0, step, 0])
            ]
            along = np.stack([moved[1] - moved[0], moved[2] - moved[0]], -1)
            piece = weight * np.abs(np.linalg.det(along)) / step**2
            top += piece[:, None] * (moved[0] - centre)
            area += piece
    return np.asarray(top / area[:, None])


def _shifted(state: State, shift_mm: Array) -> State:
    return replace(state, dots_mm=state.dots_mm + shift_mm)
