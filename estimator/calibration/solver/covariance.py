"""The joint covariance of a self-calibration, and what of it reaches a triangulated point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.calibration.solver.levenberg_marquardt import Solution
from telerig.estimator.calibration.solver.problem import Problem, parameter_unit
from telerig.estimator.calibration.solver.schur import Posterior
from telerig.estimator.calibration.solver.system import System, images_of
from telerig.rig.camera import Camera
from telerig.rig.pose import hat
from telerig.rig.projection import INDEX
from telerig.rig.triangulation import stacked_jacobian

POSE_COMPONENTS = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")
WHOLE = 4000
"""Numbers in a calibration up to which the covariance of all with all is kept."""


@dataclass(frozen=True)
class JointCovariance:
    """matrix : (D, D) in physical units; names : D strings, ``left.k1``, ``view 03.rx_rad``.

    Of a calibration of more than `WHOLE` numbers, cameras and views only.
    Poses are GTSAM's tangent (rotation, translation) at ``rig_from_...``, right perturbation.
    dots : (N, 3, 3) of each dot.  cross : (C, N, 3) of each dot with cameras and views.
    leverage : (M, 2, 2) J C J^T of each kept dot: the share of its noise that the fit absorbs.
    units : (D',) physical units per unit of the solver, of all numbers.
    """

    names: tuple[str, ...]
    matrix: Array
    dots: Array
    cross: Array
    rig: int
    leverage: Array
    units: Array

    def of_rig_and(self, dots: Ints) -> Array:
        """(P + 3 n, P + 3 n) of the rig block and some of the dots.

        Without the matrix of all with all, from the dots' independence given cameras and views;
        only the two dots of a known distance depend on each other besides.
        """
        common = len(self.cross)
        if len(self.names) > common:
            at = common + (3 * dots[:, None] + np.arange(3)).ravel()
            index = np.concatenate([np.arange(self.rig), at])
            return np.asarray(self.matrix[np.ix_(index, index)])
        known = np.isfinite(np.diag(self.matrix))
        sd = np.sqrt(np.diag(self.matrix)[known])
        correlation = self.matrix[np.ix_(known, known)] / np.outer(sd, sd)
        across = self.cross[:, dots].reshape(common, -1)
        scaled = across[known] / sd[:, None]
        own = (scaled.T @ np.linalg.solve(correlation, scaled)).reshape(len(dots), 3, -1, 3)
        own[np.arange(len(dots)), :, np.arange(len(dots))] = self.dots[dots]
        _, rig = self.rig_block()
        with_rig = across[: self.rig]
        return np.block([[rig, with_rig], [with_rig.T, own.reshape(3 * len(dots), -1)]])

    @property
    def effective_dof(self) -> float:
        """E[sum of squared whitened residuals] = rows - trace(J C J^T)."""
        return float(2 * len(self.leverage) - np.trace(self.leverage, axis1=-2, axis2=-1).sum())

    def widened(self, offset: Array) -> JointCovariance:
        """With the square of a common offset, (D,) in the solver's units, added.

        Dots stay independent given cameras and views where theirs follows from that of those.
        """
        shift = offset * self.units
        whole = shift[: len(self.matrix)]
        common, of_dots = shift[: len(self.cross)], shift[len(self.cross) :].reshape(-1, 3)
        return replace(
            self,
            matrix=self.matrix + np.outer(whole, whole),
            dots=self.dots + of_dots[:, :, None] * of_dots[:, None],
            cross=self.cross + common[:, None, None] * of_dots,
        )

    def rig_block(self) -> tuple[tuple[str, ...], Array]:
        """Names and covariance of the cameras alone: intrinsics, then the second camera's pose."""
        return self.names[: self.rig], self.matrix[: self.rig, : self.rig]


def joint_covariance(
    problem: Problem, solution: Solution, *, leverage: Array | None = None
) -> JointCovariance:
    """Inverse of the information at the solution, from the solver's own factorisation.

    leverage : where it is known already.
    What no measurement touches (the pose of a view that was left out) is infinitely uncertain.

    Raises CalibrationError when it is singular to working precision.
    """
    size = solution.slots["dots"][0].stop
    posterior = solution.equations.posterior(whole=size <= WHOLE)
    matrix = posterior.common if posterior.whole is None else posterior.whole
    matrix = matrix.copy()
    untouched = posterior.untouched[: len(matrix)]
    matrix[untouched, untouched] = np.inf
    units = _units(problem, size)
    rig = sum(len(f) for f in problem.free) + 6 * (len(problem.cameras) - 1)
    if leverage is None:
        leverage = hat_matrix_blocks(problem, solution, posterior)
    names, within = _names(problem)[: len(matrix)], units[: len(matrix)]
    matrix *= within[:, None] * within
    cross = posterior.cross * units[: len(posterior.cross), None, None]
    return JointCovariance(names, matrix, posterior.dots, cross, rig, leverage, units)


def _units(problem: Problem, size: int) -> Array:
    units = np.ones(size)
    at = 0
    for c, camera in enumerate(problem.cameras):
        free = problem.free_indices(c)
        units[at : at + len(free)] = parameter_unit(camera)[free]
        at += len(free)
    return units


def _names(problem: Problem) -> tuple[str, ...]:
    names = [f"{c.name}.{p}" for c, free in zip(problem.cameras, problem.free) for p in free]
    names += [f"{c.name}.{p}" for c in problem.cameras[1:] for p in POSE_COMPONENTS]
    names += [f"view {v}.{p}" for v in problem.views for p in POSE_COMPONENTS]
    names += [f"dot {d}.{p}" for d in problem.dot_ids for p in ("x_mm", "y_mm", "z_mm")]
    return tuple(names)


def hat_matrix_blocks(problem: Problem, solution: Solution, posterior: Posterior) -> Array:
    """(M, 2, 2) J C J^T of each kept dot: the share of its noise that the fit absorbs."""
    system, out = System(problem), np.empty((int(np.sum(problem.weight > 0)), 2, 2))
    for c, obs in enumerate(system.images):
        columns = system.columns(solution.state, c)[:-1].transpose(2, 1, 0)
        for view, first, last in images_of(obs):
            image, dot = columns[first:last], obs.dot[first:last]
            own, place = image[..., -3:], system.views_at + 6 * view
            index = np.r_[system.camera_places[c], place : place + 6]
            across = posterior.cross[index][:, dot].swapaxes(0, 1)
            mixed = image @ across @ np.swapaxes(own, -1, -2)
            alone = image @ posterior.common[np.ix_(index, index)] @ np.swapaxes(image, -1, -2)
            of_dots = own @ posterior.dots[dot] @ np.swapaxes(own, -1, -2)
            rows = system.rows[c][first:last]
            out[rows] = alone + mixed + np.swapaxes(mixed, -1, -2) + of_dots
    return out


def rig_jacobian(
    cameras: tuple[Camera, ...], free: tuple[tuple[str, ...], ...], points_mm: Array
) -> Array:
    """(..., 2C, P) derivative of the pixels of rig points by the rig block's parameters."""
    lens = np.cumsum([0, *map(len, free)])
    out = np.zeros((*points_mm.shape[:-1], 2 * len(cameras), lens[-1] + 6 * (len(cameras) - 1)))
    for c, camera in enumerate(cameras):
        rows = out[..., 2 * c : 2 * c + 2, :]
        in_camera = camera.camera_from_rig.apply(points_mm.reshape(-1, 3)).reshape(points_mm.shape)
        names = [INDEX[name] for name in free[c]]
        _, by_point, rows[..., lens[c] : lens[c + 1]] = camera.pixel_jacobians(in_camera, names)
        if c:
            at = lens[-1] + 6 * (c - 1)
            rows[..., at : at + 6] = np.concatenate([by_point @ hat(in_camera), -by_point], -1)
    return out


def aligned_covariance(
    cameras: tuple[Camera, ...],
    free: tuple[tuple[str, ...], ...],
    covariance: Array,
    points_mm: Array,
) -> Array:
    """(3 N, 3 N) calibration covariance of rig points, their common rigid motion projected out."""
    inner = aligned_shift(cameras, free, points_mm)
    return np.asarray(inner @ covariance @ inner.T)


def aligned_shift(
    cameras: tuple[Camera, ...], free: tuple[tuple[str, ...], ...], points_mm: Array
) -> Array:
    """(3 N, P): rig points by the rig block's parameters, their common rigid motion projected out.

    What is left is the error of shapes, distances and motions inside the rig; where the rig's own
    frame lies is a matter of definition (Baarda's S-transformation to the points' own frame).
    """
    rows = 2 * len(cameras)
    information = np.broadcast_to(np.eye(rows), (len(points_mm), rows, rows))
    shift = point_shift_jacobian(cameras, free, points_mm, information)
    shift = shift.reshape(-1, shift.shape[-1])
    centred = points_mm - points_mm.mean(0)
    motion = np.concatenate([np.tile(np.eye(3), (len(points_mm), 1, 1)), -hat(centred)], -1)
    basis, _ = np.linalg.qr(motion.reshape(-1, 6))
    return np.asarray(shift - basis @ (basis.T @ shift))


def point_shift_jacobian(
    cameras: tuple[Camera, ...],
    free: tuple[tuple[str, ...], ...],
    points_mm: Array,
    information_px: Array,
) -> Array:
    """(..., 3, P): how a triangulated point moves when the rig block's parameters move."""
    _, by_point = stacked_jacobian(cameras, points_mm)
    weighted = np.swapaxes(by_point, -1, -2) @ information_px
    by_rig = rig_jacobian(cameras, free, points_mm)
    return np.asarray(-np.linalg.solve(weighted @ by_point, weighted @ by_rig), np.float64)
