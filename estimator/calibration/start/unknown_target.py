"""The target's shape from its images alone, when the dots' positions are not known.

Affine factorisation of planar tracks (Tomasi and Kanade, IJCV 9:137, 1992), upgraded to metric
with the telecentric constraint: two rows of a scaled rotation. With M_v the (2, 2) map of view v
in factor coordinates, C = Q Q^T the metric and d = det C, the first camera (scale 1) gives

    1 - tr(M_v C M_v^T) + det(M_v)^2 d = 0,

linear in (c11, c12, c22, d): four views. See docs/theory.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import orthogonal_procrustes

from telerig.arrays import Array
from telerig.errors import CalibrationError
from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.thresholds import LEAST_VIEWS
from telerig.estimator.dots.grid.lattice import fit_affine


def dots_from_images(problem: Problem) -> Array:
    """Return positions (N, 3) in mm of a target's dots that are not known beforehand.

    They follow from the pixels and the known distance of two dots. The frame is chosen such that
    the positions are as near as possible to the nominal ones.
    Raises CalibrationError if the views do not determine the target's shape.
    """
    maps, plane = _factorise(problem)
    views = np.bincount([c for _, c in maps], minlength=len(problem.cameras))
    one = 0 if views[0] >= LEAST_VIEWS else int(views.argmax())
    metric = _metric([m for (_, c), m in maps.items() if c == one])
    # M plane^T = (M L) (L^-1 plane^T) with C = L L^T: rows of M L are rows of a scaled rotation
    shape = plane @ np.linalg.inv(np.linalg.cholesky(metric)).T
    shape = shape * _scale_factor(problem, shape)
    return _onto_nominal(shape, problem.nominal_mm)


def _factorise(problem: Problem, sweeps: int = 200) -> tuple[dict[tuple[int, int], Array], Array]:
    """Return maps (2, 2) per image and places (N, 2), by alternating least squares over gaps."""
    images = {}
    for v in range(len(problem.views)):
        for c in range(len(problem.cameras)):
            rows = (problem.view == v) & (problem.camera == c) & problem.kept
            if rows.sum() >= 4:
                images[v, c] = (problem.dot[rows], problem.uv_px[rows])
    plane = problem.nominal_mm[:, :2].copy()
    plane = (plane - plane.mean(0)) / np.maximum(plane.std(0), 1e-9)
    maps: dict[tuple[int, int], Array] = {}
    previous = np.inf
    for _ in range(sweeps):
        maps = {k: fit_affine(plane[dots], uv)[:2] for k, (dots, uv) in images.items()}
        plane, misfit = _plane_points(images, maps, len(plane))
        middle = plane.mean(0)
        whiten = np.linalg.inv(np.linalg.cholesky(np.cov((plane - middle).T)))
        plane = (plane - middle) @ whiten.T
        if abs(previous - misfit) <= 1e-12 * misfit:
            break
        previous = misfit
    maps = {k: fit_affine(plane[dots], uv)[:2] for k, (dots, uv) in images.items()}
    return {k: m[:, :2] for k, m in maps.items()}, plane


def _plane_points(
    images: dict[tuple[int, int], tuple[NDArray[np.int64], Array]],
    maps: dict[tuple[int, int], Array],
    count: int,
) -> tuple[Array, float]:
    normal = np.tile(1e-12 * np.eye(2), (count, 1, 1))
    right = np.zeros((count, 2))
    for k, (dots, uv) in images.items():
        linear = maps[k][:, :2]
        normal[dots] += linear.T @ linear
        right[dots] += (uv - maps[k][:, 2]) @ linear
    plane = np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], np.float64)
    misfit = 0.0
    for k, (dots, uv) in images.items():
        misfit += float(((plane[dots] @ maps[k][:, :2].T + maps[k][:, 2] - uv) ** 2).sum())
    return plane, misfit


def _metric(maps: list[Array]) -> Array:
    """Return (2, 2) C = Q Q^T from the maps of one camera, the first where it has views enough."""
    if len(maps) < LEAST_VIEWS:
        raise CalibrationError(
            f"no camera has more than {len(maps)} usable views; a target whose dot positions are "
            f"unknown needs at least {LEAST_VIEWS}",
            todo="add views with the plate tilted by other angles and about other axes",
        )
    size = np.mean([np.linalg.norm(m) for m in maps])
    rows = []
    for m in (m / size for m in maps):
        a, b, c = (m[:, 0] @ m[:, 0], m[:, 0] @ m[:, 1], m[:, 1] @ m[:, 1])
        rows.append([a, 2 * b, c, -(np.linalg.det(m) ** 2)])
    design = np.array(rows)
    solution, _, rank, singular = np.linalg.lstsq(design, np.ones(len(design)), rcond=None)
    c11, c12, c22, _ = solution
    metric = np.array([[c11, c12], [c12, c22]])
    if rank < 4 or singular[-1] < 1e-6 * singular[0] or np.linalg.eigvalsh(metric)[0] <= 0:
        raise CalibrationError(
            "these views do not determine the distances and angles between the target's dots, "
            "which are unknown before the calibration",
            todo="add views with the plate tilted by other angles and about other axes, or give "
            "the dots' nominal positions with a print_sigma_mm of less than a tenth of their "
            "spacing in rig.toml [target]",
        )
    return metric


def _scale_factor(problem: Problem, shape: Array) -> float:
    if problem.scale is not None:
        (a, b), distance, _ = problem.scale
        return float(distance / np.linalg.norm(shape[a] - shape[b]))
    nominal = problem.nominal_mm[:, :2]
    return float(np.sqrt(np.var(nominal, axis=0).sum() / np.var(shape, axis=0).sum()))


def _onto_nominal(shape: Array, nominal_mm: Array) -> Array:
    target = nominal_mm[:, :2]
    a, b = shape - shape.mean(0), target - target.mean(0)
    turn, _ = orthogonal_procrustes(a, b)
    return np.asarray(np.c_[a @ turn + target.mean(0), np.zeros(len(shape))])
