"""What one more view would do to the calibration's uncertainty in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.quality.truth import working_volume
from telerig.estimator.calibration.solver.covariance import JointCovariance, aligned_shift
from telerig.estimator.calibration.solver.problem import Problem, cameras_from_state
from telerig.estimator.calibration.views.candidate_poses import Candidates, dots_seen, observations
from telerig.factors.projection import State, whitened_residuals

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_BATCH_ROWS = 4000


@dataclass(frozen=True)
class ViewGain:
    """What views do to the covariance of cameras and dots.

    covariance : (P + 3 n, P + 3 n) of the rig block and of ``dots``, (n,) sorted, which alone can
    be asked for.  root : (P, R), root root^T weighs the rig block by the variance of points in
    space.  whitener : (2,) 1 / px.
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
        shift = aligned_shift((cameras[0], cameras[1]), problem.free, points)
        covariance, dots = joint.of_rig_and(np.unique(dots)), np.unique(dots)
        triangle = np.asarray(np.linalg.qr(shift, mode="r")).T
        noise = [_noise_px(problem, c) for c in (0, 1)]
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
        """(K,) standard deviation per axis with each of the views added, seen at ``dots``."""
        batch = max(1, _BATCH_ROWS // (4 * len(dots)))
        parts = [
            self._less(poses.some(np.arange(i, min(i + batch, len(poses)))), dots)
            for i in range(0, len(poses), batch)
        ]
        return self._um(np.concatenate(parts))

    def _less(self, poses: Candidates, dots: Ints) -> Array:
        """(K,) by how much the summed variance of points falls.

        With A the view's rows, its pose projected out, and C the covariance: the trace of
        root^T C A^T (1 + A C A^T)^-1 A C root.
        """
        by_rig, by_dot, by_pose = self._rows(poses, dots)
        rig, count = len(self.root), len(poses)
        at = rig + (3 * np.searchsorted(self.dots, dots)[:, None] + np.arange(3)).ravel()
        c_rr, c_rd = self.covariance[:rig, :rig], self.covariance[:rig, at]
        c_dd = self.covariance[np.ix_(at, at)].reshape(len(dots), 3, -1)
        flat = by_rig.reshape(count, -1, rig)
        size = flat.shape[1]
        # rows go dot by dot, four each, so that dots multiply block by block
        left = by_dot @ c_dd
        left = left.reshape(count, size, len(dots), 3).transpose(0, 2, 1, 3)
        both = (left @ np.swapaxes(by_dot, -1, -2)).transpose(0, 2, 1, 3).reshape(count, size, size)
        cross = flat @ c_rd
        cross = cross.reshape(count, size, len(dots), 3).transpose(0, 2, 1, 3)
        cross = (cross @ np.swapaxes(by_dot, -1, -2)).transpose(0, 2, 1, 3)
        cross = cross.reshape(count, size, size)
        both = both + cross + np.swapaxes(cross, -1, -2) + flat @ c_rr @ np.swapaxes(flat, -1, -2)
        own = (by_dot @ (c_rd.T @ self.root).reshape(len(dots), 3, -1)).reshape(count, size, -1)
        onto = own + flat @ (c_rr @ self.root)
        basis, _ = np.linalg.qr(by_pose.reshape(count, size, 6))
        back = np.swapaxes(basis, -1, -2)
        half = both - basis @ (back @ both)
        both = half - (half @ basis) @ back + np.eye(size)
        onto = onto - basis @ (back @ onto)
        return np.asarray(np.sum(onto * np.linalg.solve(both, onto), axis=(-1, -2)))

    def _rows(self, poses: Candidates, dots: Ints) -> tuple[Array, Array, Array]:
        """(K, n, 4, P), (K, n, 4, 3), (K, n, 4, 6) whitened derivatives, dot by dot."""
        problem, count = self.problem, len(poses)
        stand_for = np.sqrt(len(problem.dot_ids) / len(dots))
        obs = observations(problem, poses.plate_shift, dots, stand_for * self.whitener)
        visible, _ = dots_seen(problem, self.state, poses, dots)
        obs.whitener[~visible.ravel()] = 0.0
        state = State(
            self.state.intrinsics, self.state.rig_from_camera, poses.rig_from_target,
            self.state.dots_mm,
        )  # fmt: skip
        found = whitened_residuals(state, obs, problem.rho_mm)
        by_rig = np.zeros((count, 2, len(dots), 2, len(self.root)))
        full = found.by_intrinsics.reshape(count, 2, len(dots), 2, -1)
        at = 0
        for c in (0, 1):
            free = problem.free_indices(c)
            by_rig[:, c, ..., at : at + len(free)] = full[:, c][..., free]
            at += len(free)
        by_rig[:, 1, ..., at:] = found.by_camera.reshape(count, 2, len(dots), 2, 6)[:, 1]
        parts = (by_rig, found.by_dot, found.by_view)
        a, b, c_ = (
            p.reshape(count, 2, len(dots), 2, -1)
            .transpose(0, 2, 1, 3, 4)
            .reshape(count, len(dots), 4, -1)
            for p in parts
        )
        return a, b, c_


def _noise_px(problem: Problem, camera: int) -> float:
    kept = (problem.weight > 0.5) & (problem.camera == camera)
    rows = problem.covariance_px2[kept if kept.any() else slice(None)]
    return float(np.sqrt(np.median(np.trace(rows, axis1=-2, axis2=-1)) / 2))
