"""What one more view would do to the calibration's uncertainty in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.quality.uncertainty_map import working_volume
from telerig.estimator.calibration.solver.covariance import JointCovariance, aligned_shift
from telerig.estimator.calibration.solver.problem import Problem, cameras_from_state
from telerig.estimator.calibration.views.poses import Candidates, dots_seen, predicted
from telerig.factors.projection import State, whitened_residuals

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class ViewGain:
    """What views do to the covariance of cameras and dots.

    covariance : (P + 3 n, P + 3 n) of the rig block and of ``dots``, (n,) sorted, which alone can
    be asked for.  root : (P, R), root root^T weighs the rig block by the variance of points in
    space.  whitener : (C,) 1 / px.
    """

    problem: Problem
    state: State
    covariance: Array
    dots: Ints
    root: Array
    whitener: Array
    points_mm: Array

    @staticmethod
    def of(problem: Problem, state: State, joint: JointCovariance, dots: Ints) -> ViewGain:
        cameras = cameras_from_state(problem, state)
        points = working_volume(cameras)
        shift = aligned_shift(cameras, problem.free, points)
        covariance, dots = joint.of_rig_and(np.unique(dots)), np.unique(dots)
        triangle = np.asarray(np.linalg.qr(shift, mode="r")).T
        noise = [_noise_px(problem, c) for c in range(len(cameras))]
        return ViewGain(problem, state, covariance, dots, triangle, 1 / np.array(noise), points)

    @property
    def before_um(self) -> float:
        return float(self._um(np.zeros(1))[0])

    @property
    def size_um(self) -> float:
        """Of points that are all wrong by the factor that target and distance leave open."""
        problem = self.problem
        plane = (problem.nominal_mm - problem.nominal_mm.mean(0))[:, :2]
        known = float(np.sum((plane / problem.dot_sigma_mm[:, :2]) ** 2))
        if problem.scale is not None:
            known += (problem.scale[1] / problem.scale[2]) ** 2
        spread = (self.points_mm - self.points_mm.mean(0)).std()
        return float(1e3 * spread / np.sqrt(known))

    def _um(self, less: Array) -> Array:
        rig = len(self.root)
        whole = np.sum((self.covariance[:rig, :rig] @ self.root) * self.root)
        return np.asarray(1e3 * np.sqrt(np.maximum(whole - less, 0) / self.points_mm.size))

    def after_um(self, poses: Candidates, dots: Ints) -> Array:
        """(K,) standard deviation per axis with each of the views added, seen at ``dots``.

        With A the view's rows, its pose projected out, and C the covariance, the summed variance of
        points falls by the trace of root^T C A^T (1 + A C A^T)^-1 A C root.
        """
        rows, by_pose = self._rows(poses, dots)
        rig = len(self.root)
        place = rig + (3 * np.searchsorted(self.dots, dots)[:, None] + np.arange(3)).ravel()
        index = np.r_[np.arange(rig), place]
        covariance = self.covariance[np.ix_(index, index)]
        basis, _ = np.linalg.qr(by_pose)
        rows = rows - basis @ (np.swapaxes(basis, -1, -2) @ rows)
        onto = rows @ covariance
        both = onto @ np.swapaxes(rows, -1, -2) + np.eye(rows.shape[1])
        by_points = onto[..., :rig] @ self.root
        return self._um(np.sum(by_points * np.linalg.solve(both, by_points), axis=(-1, -2)))

    def _rows(self, poses: Candidates, dots: Ints) -> tuple[Array, Array]:
        """Whitened derivatives of K views: (K, 2 C n, P + 3 n) by rig and dots, (K, 2 C n, 6)."""
        count, problem, rig = len(self.problem.cameras), self.problem, len(self.root)
        stand_for = np.sqrt(len(problem.dot_ids) / len(dots))
        state, obs = predicted(problem, self.state, poses, dots, stand_for * self.whitener)
        visible, _ = dots_seen(problem, self.state, poses, dots)
        obs.whitener[~visible.ravel()] = 0.0
        found = whitened_residuals(state, obs, problem.rho_mm)
        shape = (len(poses), count, len(dots), 2)
        rows = np.zeros((*shape, rig + 3 * len(dots)))
        by_intrinsics = found.by_intrinsics.reshape(*shape, -1)
        at = 0
        for c in range(count):
            free = problem.free_indices(c)
            rows[:, c, ..., at : at + len(free)] = by_intrinsics[:, c][..., free]
            at += len(free)
        by_camera = found.by_camera.reshape(*shape, 6)
        for c in range(1, count):
            rows[:, c, ..., at : at + 6] = by_camera[:, c]
            at += 6
        by_dot = found.by_dot.reshape(*shape, 3)
        for i, start in enumerate(range(rig, rows.shape[-1], 3)):
            rows[:, :, i, :, start : start + 3] = by_dot[:, :, i]
        by_view = found.by_view.reshape(len(poses), -1, 6)
        return rows.reshape(len(poses), 2 * count * len(dots), -1), by_view


def _noise_px(problem: Problem, camera: int) -> float:
    kept = (problem.weight > 0.5) & (problem.camera == camera)
    rows = problem.covariance_px2[kept if kept.any() else slice(None)]
    return float(np.sqrt(np.median(np.trace(rows, axis1=-2, axis2=-1)) / 2))
